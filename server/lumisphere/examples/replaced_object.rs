//! Another object in stored light, on `gazebo`: the cup where the teapot stood, beside the same cup captured there. Prints what each
//! took, and errors against path-traced truth; writes the pictures where it is told to. Figures go to docs/measurements.md.
//!
//! ```text
//! cargo build --workspace --examples --features lumisphere-server/h264
//! target/debug/examples/replaced_object PICTURES
//! ```

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use glam::Vec3;
use lumisphere::capture::PartsError;
use lumisphere::evaluate::{Picture, Plan, Rendered, Truth, evaluate};
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::images::{Exposure, Image, ToneMap, encode_png, tone_mapped};
use lumisphere::progress::Unattended;
use lumisphere::raytrace::TraceSettings;
use lumisphere::render::Renderer;
use lumisphere::representations::offset_surface_light_field::{
    BAKED_FIRST, Blend, Component, ConstructSettings, Filter, OffsetSurfaceLightField, Parameters, Placement, Placing, ReplaceSettings,
    Settings, Spacing, Surrounding, build_sample_maps, construct, from_parts, replace,
};
use lumisphere::representations::{
    CachedPages, FrameRequest, Original, Outputs, Refine, RenderError, Representation, Settings as AnySettings, Uploads,
};
use lumisphere::scenes::{BuiltinOptions, Object, Relighting, Scene, builtin};
use lumisphere::textures::{Cache, CacheOptions, Codec, DatasetVersion, PixelFormat, Publication, Staging, Store, StoreOptions};

const POINTS: u32 = 160;
const FACE: u32 = 64;
const MAP: u32 = 128;
const PATHS: u32 = 4;
const BOUNCES: u32 = 2;
const RUNS: usize = 3;

struct Stored {
    version: Arc<DatasetVersion>,
    field: Arc<OffsetSurfaceLightField>,
    pages: CachedPages,
    seconds: f64,
}

fn main() {
    let pictures = std::env::args().nth(1).map(PathBuf::from);
    let folder = tempfile::tempdir().expect("a folder");
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).expect("a store");
    let scene = builtin("gazebo", &BuiltinOptions::full()).expect("the built-in scene loads");
    let (teapot, cup) = (scene.object("teapot").expect("a teapot"), scene.object("cup").expect("a cup"));

    let light = captured(&store, "light", &scene, "teapot");
    // As large as fits, where the teapot stood.
    let ((low, high), (cup_low, cup_high)) = (scene.objects[teapot].mesh.bounds(), scene.objects[cup].mesh.bounds());
    let foot = Vec3::new(0.5 * (low.x + high.x), low.y, 0.5 * (low.z + high.z));
    let placement = Placement { stand_at: Some(foot), turn_deg: 0.0, scale: 0.95 * ((high - low) / (cup_high - cup_low)).min_element() };
    println!("the cup {} times as large at {foot}", placement.scale);
    let put = |name: &str, order: [Surrounding; 3]| {
        let settings = ReplaceSettings {
            object: "cup".into(),
            placement,
            light: "light".into(),
            epsilon: None,
            spacing: Spacing::Count(POINTS),
            face_size_texels: FACE,
            sample_map_size_texels: MAP,
            pixel_format: PixelFormat::F16,
            codec: Codec::DEFAULT,
            rays_per_texel: 16,
            order,
            scene_bytes: u64::MAX,
        };
        stored(&store, name, &|staging| {
            let (parameters, shares) = replace((&light.field, &light.pages), &scene, &settings, staging, &Unattended).expect("a cup");
            println!("{name}: {shares:?}");
            parameters
        })
    };
    let mut made: Vec<Stored> = (0..RUNS).map(|run| put(&format!("replaced-{run}"), BAKED_FIRST)).collect();
    made.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    let replaced = made.swap_remove(RUNS / 2);
    use Surrounding::{Background, Baseline, CubeMaps};
    let orders = [[Baseline, CubeMaps, Background], [CubeMaps, Baseline, Background]];
    let others: Vec<Stored> =
        orders.iter().map(|order| put(&format!("order-{}", order.map(|s| format!("{s:?}")).join("-").to_lowercase()), *order)).collect();

    let truth = with_object_in(&scene, teapot, cup, &replaced.field);
    let captured = captured(&store, "captured", &truth, "teapot");
    let mut naive = (*light.field).clone();
    naive.surface = replaced.field.surface.clone();
    naive.sample_maps = build_sample_maps(&naive.surface, &naive.sample_points, MAP as usize, &|_, _| true);
    let naive: Arc<dyn Representation> = Arc::new(naive);
    for (name, stored) in [("light", &light), ("captured", &captured), ("replaced", &replaced)] {
        let bytes = stored.version.manifest().stored_bytes();
        println!("{name}: {:.1} s, {} sample points, {:.1} MB", stored.seconds, stored.field.sample_points.len(), bytes as f64 / 1e6);
    }
    println!("replaced / captured: {:.3} of the seconds", replaced.seconds / captured.seconds);

    let of = |stored: &Stored| (stored.field.clone() as Arc<dyn Representation>, stored.pages.clone());
    let mut fields =
        vec![("captured".to_string(), of(&captured)), ("replaced".into(), of(&replaced)), ("naive".into(), (naive, light.pages.clone()))];
    fields.extend(orders.iter().zip(&others).map(|(order, stored)| (format!("{order:?}"), of(stored))));
    for (component, blend) in [
        (Component::Reconstruction, Blend::Corrected),
        (Component::Mirror, Blend::Corrected),
        (Component::Mirror, Blend::Normal { exponent: 4.0 }),
        (Component::Mirror, Blend::EnvironmentMap),
        (Component::Full, Blend::Corrected),
    ] {
        compare(&truth, &fields, shown(component, blend), pictures.as_deref());
    }
}

fn captured(store: &Store, name: &str, scene: &Scene, object: &str) -> Stored {
    let settings = ConstructSettings {
        object: object.into(),
        epsilon: None,
        spacing: Spacing::Count(POINTS),
        placing: Placing::Uniform,
        face_size_texels: FACE,
        sample_map_size_texels: MAP,
        pixel_format: PixelFormat::F16,
        codec: Codec::DEFAULT,
        samples_per_texel: PATHS,
        max_bounces: BOUNCES,
        seed: 1,
        original: Original::Diffuse,
    };
    stored(store, name, &|staging| construct(scene, &settings, staging, &Unattended).expect("a capture"))
}

fn stored(store: &Store, name: &str, fill: &dyn Fn(&Staging) -> Parameters) -> Stored {
    store.create_dataset(name).expect("a new name");
    let staging = store.stage(name, "example").expect("a staging area");
    let begin = Instant::now();
    let parameters = fill(&staging);
    let publication = Publication {
        kind: "offset_surface_light_field".into(),
        parameters: serde_json::to_value(&parameters).expect("numbers"),
        inputs: Default::default(),
        code_version: "example".into(),
        created_unix_millis: 0,
    };
    let version = staging.publish(publication).expect("a version");
    let seconds = begin.elapsed().as_secs_f64();
    let field = from_parts::<PartsError>(parameters, &|part| Ok(version.blob(part).expect("a part"))).expect("a light field");
    let pages = CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(1 << 30))), version: version.clone() };
    Stored { version, field: Arc::new(field), pages, seconds }
}

/// The scene with the new object in place of the old one.
fn with_object_in(scene: &Scene, old: usize, new: usize, placed: &OffsetSurfaceLightField) -> Scene {
    let mut truth = scene.clone();
    let from = &scene.objects[new];
    truth.objects[old] = Object {
        name: "teapot".into(),
        mesh: placed.surface.mesh.clone(),
        surface: from.surface.clone(),
        material: from.material,
        emission: None,
    };
    truth
}

fn shown(component: Component, blend: Blend) -> AnySettings {
    AnySettings::OffsetSurfaceLightField(Settings {
        component,
        blend,
        specular_reflectance: Vec3::ONE,
        filter: Filter::Footprint,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    })
}

type Named = (String, (Arc<dyn Representation>, CachedPages));

fn compare(truth: &Scene, fields: &[Named], settings: AnySettings, pictures: Option<&Path>) {
    let (low, high) = truth.objects[truth.object("teapot").expect("an object")].mesh.bounds();
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    let camera = |toward: Vec3| {
        let pose = Pose::look_at(center + 4.0 * radius * toward.normalize(), center, Vec3::Y).expect("a pose");
        Camera::new(Intrinsics::from_vfov(30.0, 160, 120).expect("an angle"), pose).expect("a camera")
    };
    let plan = Plan {
        object: "teapot".into(),
        original: Original::Diffuse,
        cameras: vec![camera(Vec3::new(0.5, 0.5, 1.0)), camera(Vec3::new(-1.0, 0.4, -0.3))],
        settings: vec![settings; fields.len()],
        mirror_truths: vec![Truth::OneReflection],
        trace: TraceSettings { samples_per_pixel: 128, max_bounces: BOUNCES, seed: 9 },
        timed_frames: 1,
        tables: Default::default(),
        normal_maps: Default::default(),
    };
    let renderer = Renderer::cpu_only();
    let mut render = |camera: &Camera, setting: usize| -> Result<Rendered, RenderError> {
        let outputs = Outputs { depth: false, provenance: false };
        let request = FrameRequest { camera, settings: &settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let (field, pages) = &fields[setting].1;
        let frame = renderer.render(field, pages, &request, None)?;
        let mut color = Image::zeros(frame.width_px as usize, frame.height_px as usize, 3);
        frame.pixels.color.as_chunks().0.iter().enumerate().for_each(|(i, rgb)| color.set_rgb(i, *rgb));
        Ok(Rendered { color, millis: frame.stats.total_millis, backend: frame.stats.backend, device_bytes: None })
    };
    let mut number = 0;
    let mut keep = |picture: Picture<'_>| {
        if let Some(folder) = pictures {
            std::fs::create_dir_all(folder).expect("a folder");
            let shown = tone_mapped(picture.image, TONE_MAP).expect("a picture");
            let file = folder.join(format!("{}-{number:03}.png", picture.name));
            std::fs::write(file, encode_png(&shown).expect("a picture")).expect("a file");
            number += 1;
        }
        Ok(())
    };
    let rows = evaluate(truth, &plan, &mut render, &mut keep, &Unattended).expect("errors");
    println!("{settings:?}");
    for (row, (name, _)) in rows.iter().zip(fields) {
        let e = &row.error;
        println!(
            "  {name}: L* {:.4}, delta E {:.2} (95 % {:.2}), {} pixels",
            e.rmse_lab[0], e.delta_e_2000_mean, e.delta_e_2000_p95, e.pixels
        );
    }
}

const TONE_MAP: ToneMap = ToneMap::Exponential(Exposure::ONE);
