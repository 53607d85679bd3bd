//! The kernel against its reference. Shading is compared on the GPU's own G-buffer, element by element; the two G-buffers are compared
//! apart, because a rasteriser snaps vertices to 1/256 of a pixel and so decides some silhouette pixels otherwise than a ray does.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::super::kernel::{Kernel, LightUniform, PointLightUniform, ShadingUniform};
use super::super::reference::{PagedCubes, PagesTouched, Reference};
use super::bumps::{bumped, components, hills};
use super::corrected::{NEAR, with_liars};
use super::fixture::{MemoryPages, WORLD, World, starve};
use super::reflections::facing_itself;
use super::{BLENDS, EVERYTHING, odd_cameras, settings};
use crate::geometry::{Camera, Mapping, NormalMap};
use crate::gpu::layout_check::assert_same_layout;
use crate::gpu::{GpuError, test_gpu};
use crate::images::{Tolerance, count_beyond, elements_agree};
use crate::radiometry::brdf::tests as brdf_tests;
use crate::radiometry::brdf::{AnalyticBrdf, BrdfModel, CookTorrance, Measured, Ward};
use crate::radiometry::dielectric::{Body, Dielectric};
use crate::render::{Backend, RenderError, Renderer};
use crate::representations::g_buffer::{GBufferPixel, Seen};
use crate::representations::offset_surface_light_field::{
    Blend, Bumps, Component, Filter, Gloss, GlossBrdf, Integration, OffsetSurfaceLightField, Order, Settings,
};
use crate::representations::{
    Answer, CountingSource, CpuKernel, FrameRequest, GpuFrameStats, GpuKernel, Original, Outputs, Pixels, Provenance, Refine,
    RenderError as Error, Representation, Settings as AnySettings, Uploads,
};
use crate::scenes::{PointLight, Relighting};
use crate::textures::{ContentHash, PixelFormat};

const BUDGET: u64 = 256 << 20;
const COMPONENTS: [Component; 3] = [Component::Reconstruction, Component::Mirror, Component::Full];

struct Twins {
    kernel: Kernel,
    reference: Reference,
    field: Arc<OffsetSurfaceLightField>,
    pages: MemoryPages,
    table: Option<Arc<Measured>>,
    normal_map: Option<Arc<NormalMap>>,
}

impl Twins {
    // None without a GPU, which REQUIRE_GPU=1 turns into a failure.
    fn new((field, pages): (OffsetSurfaceLightField, MemoryPages), budget_bytes: u64) -> Option<Self> {
        let gpu = test_gpu()?;
        let field = Arc::new(field);
        let kernel = Kernel::new(gpu, field.clone(), budget_bytes).unwrap();
        Some(Self { kernel, reference: Reference::new(field.clone()), field, pages, table: None, normal_map: None })
    }

    fn on_gpu(&mut self, camera: &Camera, settings: Settings) -> Result<(Pixels, GpuFrameStats), Error> {
        let settings = AnySettings::OffsetSurfaceLightField(settings);
        let uploads = Uploads { table: self.table.as_ref(), normal_map: self.normal_map.as_ref() };
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads };
        self.kernel.render(&request, &CountingSource::new(&self.pages))
    }

    fn uploads(&self) -> Uploads<'_> {
        Uploads { table: self.table.as_ref(), normal_map: self.normal_map.as_ref() }
    }

    // The reference's shading of a G-buffer, whoever made it.
    fn shaded(&self, camera: &Camera, settings: Settings, g_buffer: &[GBufferPixel]) -> (Vec<f32>, Vec<Provenance>) {
        let source = CountingSource::new(&self.pages);
        let touched = PagesTouched::new(self.field.page_count());
        let asides = self.reference.asides(&settings, &self.uploads(), &source).unwrap();
        let mut cubes = PagedCubes::new(&self.field, &source, &touched, asides);
        let width = camera.intrinsics().width_px;
        let mut pixels = (Vec::new(), Vec::new());
        for (at, pixel) in g_buffer.iter().enumerate() {
            let (i, j) = (at as u32 % width, at as u32 / width);
            let result = self.reference.shade(&settings, camera, (i, j), pixel, &mut cubes).unwrap();
            pixels.0.extend(result.radiance.to_array());
            pixels.1.push(result.provenance);
        }
        pixels
    }
}

// The same where at most `ties` pixels, too, have another colour.
fn agree_but_for(theirs: (&[f32], &[Provenance]), ours: (&[f32], &[Provenance]), tolerance: &Tolerance, ties: usize) -> Result<(), String> {
    let differs = |at: &usize| elements_agree(&theirs.0[3 * at..3 * at + 3], &ours.0[3 * at..3 * at + 3], tolerance).is_err();
    let different: Vec<usize> = (0..theirs.1.len()).filter(differs).collect();
    if different.len() > ties { Err(format!("{} pixels differ, the first {:?}", different.len(), different[0])) } else { Ok(()) }
}

// Where both name the same sample, colours must agree within `tolerance`; at most `ties` pixels may name another.
fn agree(ours: (&[f32], &[Provenance]), theirs: (&[f32], &[Provenance]), tolerance: &Tolerance, ties: usize) -> Result<(), String> {
    let mut other_sample = 0;
    for (at, (a, b)) in ours.1.iter().zip(theirs.1).enumerate() {
        if a != b {
            other_sample += 1;
            continue;
        }
        let range = 3 * at..3 * at + 3;
        let report = count_beyond(&ours.0[range.clone()], &theirs.0[range], tolerance).map_err(|e| e.to_string())?;
        if report.beyond > 0 {
            return Err(format!("pixel {at} from {a:?}: {report:?}"));
        }
    }
    if other_sample > ties { Err(format!("{other_sample} pixels name another sample")) } else { Ok(()) }
}

const WIDTH: u32 = 80;
const HEIGHT: u32 = 60;
// Where two candidates tie (equal distances to the horizon, equal weights or cosines), rounding decides; 0.2 % of the pixels.
const TIES: usize = (WIDTH * HEIGHT) as usize / 500;

fn every_setting_agrees(world: &World, kept: usize) {
    let (mut field, pages) = world.build();
    starve(&mut field, kept);
    every_setting_agrees_of(world, (field, pages));
}

fn every_setting_agrees_of(world: &World, (field, pages): (OffsetSurfaceLightField, MemoryPages)) {
    let Some(mut twins) = Twins::new((field, pages), BUDGET) else { return };
    let camera = world.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), WIDTH, HEIGHT);
    let filters = [Filter::Bilinear, Filter::Footprint];
    for (component, filter) in COMPONENTS.into_iter().flat_map(|c| filters.map(|f| (c, f))) {
        for blend in BLENDS {
            let settings = Settings { filter, ..settings(component, blend) };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
            let hits = provenance.iter().filter(|p| matches!(p.answer(), Answer::Hit | Answer::Filled)).count();
            assert!(hits > 500, "{settings:?}: the object fills only {hits} pixels");
        }
    }
}

#[test]
fn shading_agrees_on_every_setting() {
    every_setting_agrees(&WORLD, 4);
}

/// 40 × 30 pixels of 4096 directions take two submissions.
#[test]
fn glossy_frames_in_ranges_have_no_seam() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(0.4, 0.3, 1.5), Vec3::ZERO, 40, 30);
    let brdf: AnalyticBrdf = serde_json::from_str(r#"{"model": "lambert", "albedo": [0.5, 0.6, 0.7]}"#).unwrap();
    let of =
        |directions| Settings { filter: Filter::Footprint, ..settings(Component::Glossy(Gloss::of(brdf, directions)), Blend::Distance) };
    let (whole, _) = twins.on_gpu(&camera, of(1024)).unwrap();
    let (parts, _) = twins.on_gpu(&camera, of(4096)).unwrap();
    let (_, stats) = twins.on_gpu(&camera, of(4096)).unwrap();
    assert_eq!(stats.passes, 2);
    // Four times the directions are another estimate of the same smooth integral.
    let largest = whole.color.iter().zip(&parts.color).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
    assert!(largest < 0.02, "{largest}");
}

#[test]
fn glossy_shading_agrees_for_every_model() {
    let world = World { room: 2.6, ..WORLD };
    let Some(mut twins) = Twins::new(world.build(), BUDGET) else { return };
    let camera = world.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), 40, 30);
    let models = [
        r#"{"model": "lambert", "albedo": [0.5, 0.6, 0.7]}"#,
        r#"{"model": "phong", "diffuse": [0.2, 0.2, 0.2], "specular": [0.5, 0.5, 0.5], "exponent": 50}"#,
        r#"{"model": "ashikhmin_shirley", "diffuse": [0.3, 0.1, 0.1], "specular": [0.5, 0.5, 0.5], "exponent_u": 10, "exponent_v": 300}"#,
        r#"{"model": "cook_torrance", "alpha_x": 0.3, "alpha_y": 0.2, "f0": [0.9, 0.7, 0.3]}"#,
        r#"{"model": "lafortune", "diffuse": [0.1, 0.1, 0.1], "lobes": [{"reflectance": [0.5, 0.5, 0.5], "direction": [-1, -1, 1], "exponent": 20}]}"#,
        r#"{"model": "ward", "diffuse": [0.1, 0.1, 0.1], "specular": [0.4, 0.4, 0.4], "alpha_x": 0.3, "alpha_y": 0.2}"#,
    ];
    for brdf in models.map(|json| serde_json::from_str::<AnalyticBrdf>(json).unwrap()) {
        let reads = [(Blend::Average, Filter::Bilinear), (Blend::Corrected, Filter::Footprint), (Blend::EnvironmentMap, Filter::Footprint)];
        for ((blend, filter), pass) in reads.into_iter().flat_map(|read| [0, 5].map(|pass| (read, pass))) {
            let settings = Settings { filter, ..settings(Component::Glossy(Gloss { pass, ..Gloss::of(brdf, 12) }), blend) };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
        }
    }
}

/// Narrow, wide and brushed highlights.
#[test]
fn looks_over_whole_highlights_agree() {
    let world = World { room: 2.6, ..WORLD };
    let Some(mut twins) = Twins::new(world.build(), BUDGET) else { return };
    let camera = world.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), 40, 30);
    let models = [
        r#"{"model": "phong", "diffuse": [0, 0, 0], "specular": [0.5, 0.5, 0.5], "exponent": 50}"#,
        r#"{"model": "ashikhmin_shirley", "diffuse": [0, 0, 0], "specular": [0.5, 0.5, 0.5], "exponent_u": 10, "exponent_v": 3000}"#,
        r#"{"model": "ashikhmin_shirley", "diffuse": [0, 0, 0], "specular": [0.5, 0.5, 0.5], "exponent_u": 30000, "exponent_v": 30000}"#,
        r#"{"model": "cook_torrance", "alpha_x": 0.3, "alpha_y": 0.02, "f0": [0.9, 0.7, 0.3]}"#,
        r#"{"model": "ward", "diffuse": [0, 0, 0], "specular": [0.4, 0.4, 0.4], "alpha_x": 0.1, "alpha_y": 0.2}"#,
    ];
    for brdf in models.map(|json| serde_json::from_str::<AnalyticBrdf>(json).unwrap()) {
        for blend in [Blend::Average, Blend::Normal { exponent: 4.0 }, Blend::Corrected, Blend::EnvironmentMap] {
            let gloss = Gloss { integration: Integration::Prefiltered, ..Gloss::of(brdf, 1) };
            let settings = Settings { filter: Filter::Footprint, ..settings(Component::Glossy(gloss), blend) };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
            // Directions drawn show something else.
            let drawn = Gloss { integration: Integration::MonteCarlo, ..gloss };
            let (other, _) = twins.on_gpu(&camera, Settings { component: Component::Glossy(drawn), ..settings }).unwrap();
            assert_ne!(other.color, pixels.color, "{settings:?}");
        }
    }
}

#[test]
fn glossy_shading_agrees_where_sample_points_are_integrated_one_by_one_and_for_tables() {
    let Some(mut twins) = Twins::new(World { room: 2.6, ..WORLD }.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), 40, 30);
    let ward: AnalyticBrdf = Ward::new(Vec3::new(0.2, 0.1, 0.1), Vec3::new(0.4, 0.4, 0.5), Vec2::splat(0.2)).unwrap().into();
    let BrdfModel::Measured(table) = brdf_tests::measured(&ward.into()) else { unreachable!("a table") };
    twins.table = Some(table);
    let named = GlossBrdf::Measured(ContentHash::of(b"of a test"));
    let orders = [Order::BlendFirst, Order::IntegrateFirst];
    let reads = [
        (Blend::Average, Filter::Bilinear),
        (Blend::Reflection { exponent: 8.0 }, Filter::Footprint),
        (Blend::Corrected, Filter::Footprint),
        (Blend::EnvironmentMap, Filter::Footprint),
    ];
    for (brdf, order) in [GlossBrdf::Analytic(ward), named].into_iter().flat_map(|b| orders.map(|order| (b, order))) {
        for ((blend, filter), pass) in reads.into_iter().flat_map(|read| [0, 3].map(|pass| (read, pass))) {
            let settings = Settings { filter, ..settings(Component::Glossy(Gloss { order, pass, ..Gloss::of(brdf, 12) }), blend) };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            // Of 12 directions a pixel some lie so near an edge of the table's cells that rounding decides which it is.
            let ties = if brdf == named { 4 * TIES } else { TIES };
            agree_but_for((&color, &provenance), ours, &Tolerance::F32_LOOKUP, ties).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
            // The other order is another picture, but where weights are a direction's own or there is one cube map.
            let other = Gloss { order: if order == orders[0] { orders[1] } else { orders[0] }, pass, ..Gloss::of(brdf, 12) };
            let other = twins.shaded(&camera, Settings { component: Component::Glossy(other), ..settings }, &g_buffer).0;
            let is_same = matches!(blend, Blend::Corrected | Blend::EnvironmentMap);
            assert_eq!(other == color, is_same, "{settings:?}");
        }
    }
    // What was not sent is not guessed.
    twins.table = None;
    let unknown = GlossBrdf::Measured(ContentHash::of(b"of another"));
    let outcome = twins.on_gpu(&camera, settings(Component::Glossy(Gloss::of(unknown, 12)), Blend::Average));
    assert!(matches!(outcome, Err(Error::NoTable { .. })), "{outcome:?}");
}

#[test]
fn reflections_agree_where_the_object_sees_itself() {
    let Some(mut twins) = Twins::new(facing_itself(&World { room: 5.0, ..WORLD }), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.0, 0.5, 2.6), Vec3::new(0.1, -0.1, 0.0), WIDTH, HEIGHT);
    let reads = [(Blend::Average, Filter::Bilinear), (Blend::Corrected, Filter::Footprint), (Blend::EnvironmentMap, Filter::Footprint)];
    for (component, (blend, filter)) in [Component::Mirror, Component::Full].into_iter().flat_map(|c| reads.map(|read| (c, read))) {
        let once = Settings { filter, ..settings(component, blend) };
        let (_, _) = twins.on_gpu(&camera, once).unwrap();
        let g_buffer = twins.kernel.read_g_buffer();
        let mut before = twins.shaded(&camera, once, &g_buffer).0;
        for reflections in [2, 3] {
            let settings = Settings { reflections, ..once };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            // At the rim of what is met rounding decides, too.
            agree_but_for((&color, &provenance), ours, &Tolerance::F32_LOOKUP, 2 * TIES).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
            let changed = before.chunks(3).zip(color.chunks(3)).filter(|(a, b)| a != b).count();
            // Of a ball and a part of another the third reflection is seldom on either.
            let least = if reflections == 2 { 40 } else { 1 };
            assert!(changed >= least, "{settings:?}: only {changed} pixels see another reflection");
            before = color;
        }
    }
}

/// Turned, lit, and both, of every term; in the open and in a room, where nothing comes from infinity.
#[test]
fn shading_agrees_in_other_light() {
    let brdf: AnalyticBrdf =
        serde_json::from_str(r#"{"model": "cook_torrance", "alpha_x": 0.3, "alpha_y": 0.2, "f0": [0.9, 0.7, 0.3]}"#).unwrap();
    let components = COMPONENTS.into_iter().chain([Component::Glossy(Gloss::of(brdf, 6))]);
    let sun = [PointLight { position: Vec3::new(1.5, 1.2, 1.6), intensity: Vec3::new(3.0, 2.0, 1.0) }];
    let lamps = [sun[0], PointLight { position: Vec3::new(-2.0, 0.4, 0.9), intensity: Vec3::new(0.0, 1.0, 2.0) }];
    let lights = [(1.0, &lamps[..0]), (0.0, &lamps[..]), (-2.5, &sun[..])].map(|(turn, lamps)| Relighting::new(turn, lamps).unwrap());
    let odd = World { face_size: 22, pixel: PixelFormat::F32, ..WORLD };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), 40, 30);
    let worlds = [WORLD, World { room: 2.6, ..WORLD }, odd];
    let Some(mut all) = worlds.into_iter().map(|world| Twins::new(world.build(), BUDGET)).collect::<Option<Vec<_>>>() else { return };
    for (component, world) in components.flat_map(|c| [0, 1, 2].map(|world| (c, world))) {
        // The open world sees all three; each pipeline takes seconds to compile.
        let lights = if world == 0 { &lights[..] } else { &lights[2..] };
        for (light, (blend, filter)) in lights.iter().flat_map(|l| OTHER_LIGHT_READS.map(|read| (*l, read))) {
            let (settings, twins) = (Settings { filter, light, ..settings(component, blend) }, &mut all[world]);
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            // A candidate of which rounding decides whether it sees a light is as a tie.
            agree_but_for((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap_or_else(|e| panic!("{settings:?}: {e}"));
            // Point lights are not seen in mirrors, and nothing in a room comes from infinity.
            let unlit = twins.shaded(&camera, Settings { light: Relighting::NONE, ..settings }, &g_buffer).0;
            let is_same = component == Component::Mirror && (!light.turns() || world == 1);
            assert!(is_same || agree((&unlit, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).is_err(), "{settings:?} changes nothing");
        }
    }
}

const OTHER_LIGHT_READS: [(Blend, Filter); 2] =
    [(Blend::Normal { exponent: 4.0 }, Filter::Bilinear), (Blend::Corrected, Filter::Footprint)];

#[test]
fn shading_agrees_for_clear_bodies() {
    for world in [WORLD, World { room: 2.6, ..WORLD }] {
        let (mut field, pages) = world.build();
        starve(&mut field, 0);
        let Some(mut twins) = Twins::new((field, pages), BUDGET) else { return };
        let camera = world.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), 40, 30);
        for (body, (blend, filter)) in [Body::Solid, Body::Thin].into_iter().flat_map(|b| OTHER_LIGHT_READS.map(|read| (b, read))) {
            let of = |index| Settings { filter, ..settings(Component::Refraction(Dielectric::new(index, body).unwrap()), blend) };
            let (pixels, _) = twins.on_gpu(&camera, of(1.5)).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            let (color, provenance) = twins.shaded(&camera, of(1.5), &g_buffer);
            // A ray that passes an edge of two triangles may meet either, and grazing ones part.
            agree_but_for((&color, &provenance), ours, &Tolerance::F32_LOOKUP, 2 * TIES)
                .unwrap_or_else(|e| panic!("{body:?} {blend:?}: {e}"));
            let other = twins.shaded(&camera, of(1.7), &g_buffer).0;
            assert!(
                agree_but_for((&other, &provenance), ours, &Tolerance::F32_LOOKUP, 2 * TIES).is_err(),
                "{body:?} {blend:?}: as with another index"
            );
        }
    }
}

#[test]
fn shading_agrees_on_every_setting_in_a_room() {
    every_setting_agrees(&World { room: 2.6, ..WORLD }, 4);
}

#[test]
fn shading_agrees_on_every_setting_where_sample_points_see_something_else() {
    every_setting_agrees_of(&NEAR, with_liars(|cube| cube % 3 != 0, 1e-4));
}

#[test]
fn reconstructions_agree_of_what_was_captured_as_authored() {
    for (world, kept, lies) in [(&WORLD, 4, false), (&WORLD, 3, false), (&WORLD, 1, false), (&NEAR, 4, true)] {
        let (mut field, pages) = if lies { with_liars(|cube| cube % 3 != 0, 1e-4) } else { world.build() };
        starve(&mut field, kept);
        field.parameters.original = Original::AsAuthored;
        let Some(mut twins) = Twins::new((field, pages), BUDGET) else { return };
        let camera = world.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), WIDTH, HEIGHT);
        for (blend, filter) in BLENDS.into_iter().flat_map(|blend| [Filter::Bilinear, Filter::Footprint].map(|filter| (blend, filter))) {
            let settings = Settings { filter, ..settings(Component::Reconstruction, blend) };
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let (color, provenance) = twins.shaded(&camera, settings, &twins.kernel.read_g_buffer());
            let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap_or_else(|e| panic!("{kept} kept, {settings:?}: {e}"));
        }
        let other_light = Settings { light: Relighting::new(1.0, &[]).unwrap(), ..settings(Component::Reconstruction, Blend::Average) };
        for refused in [other_light, settings(Component::Full, Blend::Average)] {
            assert!(matches!(twins.on_gpu(&camera, refused), Err(Error::AsAuthored)), "{refused:?}");
            let any = AnySettings::OffsetSurfaceLightField(refused);
            let request =
                FrameRequest { camera: &camera, settings: &any, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
            let on_cpu = twins.reference.render(&request, &CountingSource::new(&twins.pages));
            assert!(matches!(on_cpu, Err(Error::AsAuthored)), "{refused:?}");
        }
    }
}

#[test]
fn shading_agrees_on_every_setting_where_samples_are_missing() {
    every_setting_agrees(&WORLD, 1);
    every_setting_agrees(&WORLD, 0);
}

#[test]
fn shading_agrees_on_every_setting_for_pages_in_f32_and_odd_sizes() {
    every_setting_agrees(&World { pixel: PixelFormat::F32, face_size: 21, ..WORLD }, 3);
}

#[test]
fn the_comparison_notices_another_blend_and_a_shifted_image() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let (average, normal) = (settings(Component::Mirror, Blend::Average), settings(Component::Mirror, Blend::Normal { exponent: 100.0 }));
    let (pixels, _) = twins.on_gpu(&camera, average).unwrap();
    let g_buffer = twins.kernel.read_g_buffer();
    let ours = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
    let (color, provenance) = twins.shaded(&camera, average, &g_buffer);
    agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).unwrap();
    let (color, provenance) = twins.shaded(&camera, normal, &g_buffer);
    assert!(agree((&color, &provenance), ours, &Tolerance::F32_LOOKUP, TIES).is_err());
    let mut shifted = pixels.color.clone();
    shifted.rotate_right(3);
    assert!(agree((&shifted, ours.1), ours, &Tolerance::F32_LOOKUP, TIES).is_err());
}

#[test]
fn both_g_buffers_show_the_same_but_for_silhouettes() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    for origin in [Vec3::new(1.2, 0.9, 2.4), Vec3::new(-2.0, 0.3, -1.0), Vec3::new(0.2, 4.0, 0.1), Vec3::new(0.0, 0.1, 0.2)] {
        let camera = WORLD.camera(origin, Vec3::ZERO, WIDTH, HEIGHT);
        twins.on_gpu(&camera, settings(Component::Reconstruction, Blend::Distance)).unwrap();
        let (rasterized, traced) = (twins.kernel.read_g_buffer(), twins.reference.g_buffer(&camera));
        let mut other = 0;
        for (at, (ours, theirs)) in rasterized.iter().zip(&traced).enumerate() {
            if ours.a[2] != theirs.a[2] {
                other += 1;
                assert!(is_at_an_edge(&traced, at), "pixel {at} from {origin}: {ours:?} where a ray finds {theirs:?}");
                continue;
            }
            // uv of nothing is zero in both; interpolation over a triangle adds a few roundings of its extent.
            let report = count_beyond(&theirs.a, &ours.a, &Tolerance::F32_LOOKUP).unwrap();
            assert_eq!(report.beyond, 0, "pixel {at} from {origin}: {ours:?} where a ray finds {theirs:?}");
            // A step between facets is a step between vertex pairs, not in the interpolated normal: it is continuous, as is the
            // bilinear floor and the environment.
            let report = count_beyond(&theirs.b, &ours.b, &Tolerance::F32_LOOKUP).unwrap();
            assert_eq!(report.beyond, 0, "pixel {at} from {origin}: {ours:?} where a ray finds {theirs:?}");
        }
        // 1/256 of a pixel along outlines of a few hundred pixels.
        assert!(other <= 20, "{other} pixels differ from {origin}");
    }
}

// Whether a neighbour shows something else.
fn is_at_an_edge(g_buffer: &[GBufferPixel], at: usize) -> bool {
    let (width, height) = (WIDTH as i32, HEIGHT as i32);
    let (i, j) = (at as i32 % width, at as i32 / width);
    let around = (-1..=1).flat_map(|dj| (-1..=1).map(move |di| (i + di, j + dj)));
    let inside = around.filter(|(i, j)| (0..width).contains(i) && (0..height).contains(j));
    let mut seen = inside.map(|(i, j)| g_buffer[(j * width + i) as usize].a[2]);
    seen.any(|code| code != g_buffer[at].a[2])
}

#[test]
fn frames_of_several_bands_have_no_seam() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let settings = settings(Component::Full, Blend::Normal { exponent: 4.0 });
    // 1024 × 700 pixels take two bands of 2¹⁹.
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, 1024, 700);
    let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
    assert_eq!(pixels.color.len(), 3 * 1024 * 700);
    let field: Arc<dyn Representation> = twins.field.clone();
    let any = AnySettings::OffsetSurfaceLightField(settings);
    let request = FrameRequest { camera: &camera, settings: &any, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
    let cpu = Renderer::cpu_only().render(&field, &twins.pages, &request, None).unwrap().pixels;
    // Silhouettes and ties alone differ: some hundreds of 716 800 pixels.
    let report = count_beyond(&cpu.color, &pixels.color, &Tolerance::F32_LOOKUP).unwrap();
    assert!(report.beyond < 3 * 1000, "{report:?}");
    let report = count_beyond(cpu.depth.as_ref().unwrap(), pixels.depth.as_ref().unwrap(), &Tolerance::F32_LOOKUP).unwrap();
    assert!(report.beyond < 200, "{report:?}");
}

#[test]
fn pages_come_once_and_stay() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let mirror = settings(Component::Mirror, Blend::Average);
    let (first, stats) = twins.on_gpu(&camera, mirror).unwrap();
    assert_eq!((stats.passes, stats.pages_uploaded), (2, first.pages_needed));
    let (again, stats) = twins.on_gpu(&camera, mirror).unwrap();
    assert_eq!((stats.passes, stats.pages_uploaded), (1, 0));
    assert_eq!(first, again);
}

#[test]
fn a_frame_that_cannot_be_drawn_falls_back_to_the_cpu_and_says_why() {
    if test_gpu().is_none() {
        return;
    }
    let (field, pages) = WORLD.build();
    let field: Arc<dyn Representation> = Arc::new(field);
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let any = AnySettings::OffsetSurfaceLightField(settings(Component::Mirror, Blend::Average));
    let request = FrameRequest {
        camera: &camera,
        settings: &any,
        outputs: Outputs { depth: false, provenance: false },
        refine: Refine::Whole,
        uploads: Uploads::NONE,
    };
    let small = Renderer::with_gpu(1 << 20).unwrap();
    assert_eq!(small.default_backend(), Backend::Gpu);
    let frame = small.render(&field, &pages, &request, None).unwrap();
    assert_eq!(frame.stats.backend, Backend::Cpu);
    assert!(frame.stats.fallback.unwrap().contains("bytes of graphics memory"));
    let large = Renderer::with_gpu(BUDGET).unwrap();
    let frame = large.render(&field, &pages, &request, None).unwrap();
    assert_eq!((frame.stats.backend, frame.stats.fallback), (Backend::Gpu, None));
    assert!(frame.stats.page_use.hits > 0 && large.gpu_bytes() > 0 && large.gpu_bytes() <= BUDGET);
    assert_eq!((frame.pixels.depth, frame.pixels.provenance), (None, None));
}

/// In software alone: its loops end too early, and it would not say so.
#[test]
fn a_frame_of_many_directions_is_not_drawn_in_software() {
    let Some(gpu) = test_gpu().filter(|gpu| gpu.is_software()) else { return };
    let (field, pages) = World { room: 2.6, ..WORLD }.build();
    let mut kernel = Kernel::new(gpu, Arc::new(field), BUDGET).unwrap();
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, 8, 6);
    let brdf: AnalyticBrdf = CookTorrance::new(Vec2::splat(0.3), Vec3::splat(0.9), Vec3::ONE).unwrap().into();
    for (blend, directions, is_drawn) in [
        (Blend::Corrected, 64, true),
        (Blend::Corrected, 65, false),
        (Blend::Average, 256, true),
        (Blend::Average, 257, false),
        (Blend::EnvironmentMap, 257, true),
    ] {
        let any = AnySettings::OffsetSurfaceLightField(settings(Component::Glossy(Gloss::of(brdf, directions)), blend));
        let outputs = Outputs { depth: false, provenance: false };
        let request = FrameRequest { camera: &camera, settings: &any, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let drawn = kernel.render(&request, &CountingSource::new(&pages));
        assert_eq!(drawn.is_ok(), is_drawn, "{blend:?} {directions}");
        if let Err(error) = drawn {
            let named = format!("glossy pixel in directions a pass needs {directions}, the adapter allows {}", directions - 1);
            assert!(error.to_string().ends_with(&named), "{error}");
        }
    }
}

#[test]
fn a_pixel_that_needs_more_pages_than_there_are_slots_is_refused() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    // The average of four sample points takes four pages, at least.
    twins.kernel.set_slots(3);
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let outcome = twins.on_gpu(&camera, settings(Component::Mirror, Blend::Average));
    assert!(matches!(outcome, Err(RenderError::Gpu(GpuError::TooManyPages { needed, capacity })) if needed > capacity), "{outcome:?}");
}

#[test]
fn no_camera_makes_a_nan_leave_the_gpu() {
    if test_gpu().is_none() {
        return;
    }
    let (mut field, pages) = WORLD.build();
    starve(&mut field, 0);
    let field: Arc<dyn Representation> = Arc::new(field);
    let renderer = Renderer::with_gpu(BUDGET).unwrap();
    for (number, camera) in odd_cameras(&WORLD).into_iter().enumerate() {
        for blend in BLENDS {
            let any = AnySettings::OffsetSurfaceLightField(settings(Component::Full, blend));
            let request =
                FrameRequest { camera: &camera, settings: &any, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
            let frame = renderer.render(&field, &pages, &request, None).unwrap();
            // The last two have focal lengths that no rasteriser stands; the CPU takes them.
            let expected = if number < 6 { Backend::Gpu } else { Backend::Cpu };
            assert_eq!(frame.stats.backend, expected, "{:?}", frame.stats.fallback);
            assert!(frame.pixels.color.iter().all(|c| c.is_finite()), "{blend:?} from {:?}", camera.pose());
            assert!(frame.pixels.depth.unwrap().iter().all(|d| *d > 0.0));
        }
    }
}

#[test]
fn a_missing_page_is_an_error_that_names_it() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    twins.pages.0.truncate(7);
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let outcome = twins.on_gpu(&camera, settings(Component::Mirror, Blend::Average));
    assert!(matches!(outcome, Err(RenderError::Store(_))), "{outcome:?}");
}

#[test]
fn frames_with_a_normal_map_agree() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    twins.normal_map = Some(Arc::new(hills(0.6)));
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::new(0.1, -0.1, 0.0), WIDTH, HEIGHT);
    for (component, filter) in components().into_iter().flat_map(|c| [Filter::Footprint, Filter::Bilinear].map(|f| (c, f))) {
        // One look is over what a filter reads.
        if filter == Filter::Bilinear && settings(component, Blend::Average).is_prefiltered() {
            continue;
        }
        for blend in [Blend::Normal { exponent: 4.0 }, Blend::Corrected] {
            let settings = bumped(Settings { filter, ..settings(component, blend) }, -1.5, 2.5);
            let (pixels, _) = twins.on_gpu(&camera, settings).unwrap();
            let g_buffer = twins.kernel.read_g_buffer();
            let (color, provenance) = twins.shaded(&camera, settings, &g_buffer);
            let theirs = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
            // Where a ray just leaves, or just enters, rounding decides.
            let agreed = agree_but_for(theirs, (&color, &provenance), &Tolerance::F32_LOOKUP, TIES);
            agreed.unwrap_or_else(|e| panic!("{component:?} {filter:?} {blend:?}: {e}"));
        }
    }
    // Another map in its place, of another size, and none.
    twins.normal_map = Some(Arc::new(NormalMap::new(1, 2, [Vec2::X, Vec2::Y]).unwrap()));
    let other = Settings {
        bumps: Some(Bumps { map: ContentHash([4; 32]), mapping: Mapping { strength: 0.2, repeat: 1.0 } }),
        ..settings(Component::Mirror, Blend::Average)
    };
    let (pixels, _) = twins.on_gpu(&camera, other).unwrap();
    let (color, provenance) = twins.shaded(&camera, other, &twins.kernel.read_g_buffer());
    let theirs = (pixels.color.as_slice(), pixels.provenance.as_deref().unwrap());
    agree_but_for(theirs, (&color, &provenance), &Tolerance::F32_LOOKUP, TIES).unwrap();
}

#[test]
fn a_flat_normal_map_is_none_on_the_device_too_and_counts_in_its_budget() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    let settings = Settings { filter: Filter::Footprint, ..settings(Component::Mirror, Blend::Corrected) };
    let (without, _) = twins.on_gpu(&camera, settings).unwrap();
    let before = twins.kernel.bytes();
    twins.normal_map = Some(Arc::new(NormalMap::new(512, 512, vec![Vec2::ZERO; 512 * 512]).unwrap()));
    let (with, _) = twins.on_gpu(&camera, bumped(settings, 1.0, 1.0)).unwrap();
    elements_agree(&with.color, &without.color, &Tolerance::F32_LOOKUP).unwrap();
    // Four bytes a texel in place of one texel of sixteen.
    assert_eq!(twins.kernel.bytes() - before, 4 * 512 * 512 - 16);
    // A larger one than there is room for is refused, and the device goes on without.
    twins.normal_map = Some(Arc::new(NormalMap::new(4096, 4096, vec![Vec2::ZERO; 4096 * 4096]).unwrap()));
    twins.kernel.set_slots(100);
    let refused = twins.on_gpu(&camera, bumped(settings, 1.0, 1.0)).unwrap_err();
    assert!(refused.to_string().contains("a normal map"), "{refused}");
    assert_eq!(twins.on_gpu(&camera, settings).unwrap().0.color, without.color);
}

#[test]
fn the_g_buffer_names_parts_and_what_is_not_the_object() {
    let Some(mut twins) = Twins::new(WORLD.build(), BUDGET) else { return };
    let camera = WORLD.camera(Vec3::new(1.2, 0.9, 2.4), Vec3::ZERO, WIDTH, HEIGHT);
    twins.on_gpu(&camera, settings(Component::Reconstruction, Blend::Distance)).unwrap();
    let seen: Vec<Seen> = twins.kernel.read_g_buffer().iter().map(|p| Seen::from_code(p.a[2])).collect();
    for expected in [Seen::Background, Seen::Nothing, Seen::Object { part: 4 }, Seen::Object { part: 2 }] {
        assert!(seen.contains(&expected), "{expected:?}");
    }
}

#[test]
fn the_uniform_lies_in_memory_as_wgsl_has_it() {
    assert_same_layout!(
        super::super::KERNEL_SOURCE,
        "Shading",
        ShadingUniform {
            specular_reflectance,
            exponent,
            face_size,
            map_size,
            baseline_cube,
            stamp,
            coarse_level,
            coarsest_level,
            face_count,
            first_pixel,
            end_pixel,
            pixel_scale,
            directions,
            block_shift,
            first_direction,
            refraction_index,
            first_packet,
            reflections,
            normal_map_size,
            normal_strength,
            normal_repeat
        }
    );
    assert_same_layout!(
        super::super::KERNEL_SOURCE,
        "LightInfo",
        LightUniform { turn_cos, turn_sin, environment_size, environment_base, point_light_count, point_lights }
    );
    assert_same_layout!(super::super::KERNEL_SOURCE, "PointLight", PointLightUniform { position, intensity });
}
