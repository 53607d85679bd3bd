//! Frames in other light and of clear bodies against the path-traced scene of the same: a captured ball on a floor, beside a box that hides some of the sky and casts
//! shadows. The control is the same frame without the feature: in the light that was captured, or lit without asking what is between.

use std::sync::{Arc, OnceLock};

use glam::{Vec2, Vec3};

use super::*;
use crate::capture::PartsError;
use crate::directions::direction_from_lat_long;
use crate::progress::Unattended;
use crate::radiometry::brdf::{AnalyticBrdf, AshikhminShirley};
use crate::radiometry::dielectric::{Body, Dielectric};
use crate::render::Renderer;
use crate::representations::offset_surface_light_field as oslf;
use crate::representations::{FrameRequest, Outputs, Refine, RenderError, Representation, Uploads};
use crate::scenes::{Environment, EnvironmentMap, LoadOptions, PointLight, SceneBundle, load};
use crate::textures::{Codec, Page, PageId, PixelFormat, Publication, Staging, Store, StoreOptions};
use oslf::tests::fixture::MemoryPages;
use oslf::{
    Blend, Component, ConstructSettings, Filter, Gloss, OffsetSurfaceLightField, Parameters, Placing, Spacing, construct, from_parts,
};

fn scene() -> Scene {
    let json = br#"{"format": "neutral-scene/1",
        "materials": {"orange": {"type": "diffuse", "albedo": [0.8, 0.55, 0.3]}, "grey": {"type": "diffuse", "albedo": [0.4, 0.4, 0.4]},
            "red": {"type": "diffuse", "albedo": [0.6, 0.1, 0.1]}},
        "objects": [
            {"name": "floor", "shape": {"type": "rect", "corner": [-5, -1.1, 5], "edge_u": [10, 0, 0], "edge_v": [0, 0, -10]}, "material": "grey"},
            {"name": "box", "shape": {"type": "box", "min": [1.4, -1.1, -0.6], "max": [2.2, 1.2, 0.6]}, "material": "red"},
            {"name": "ball", "shape": {"type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 40}, "material": "orange"}],
        "environment": null,
        "cameras": [{"name": "a", "origin": [0.6, 1.4, 4], "target": [0, 0, 0], "vfov_deg": 33, "width": 64, "height": 48},
            {"name": "b", "origin": [-3.6, 0.8, -1.4], "target": [0, 0, 0], "vfov_deg": 33, "width": 64, "height": 48}]}"#;
    let mut files = SceneBundle::default();
    files.insert("scene.json", json.to_vec()).unwrap();
    let mut scene = load(&files, "scene.json", &LoadOptions::as_written()).unwrap();
    scene.environment = Environment::Map(EnvironmentMap { image: sky(), rotation: 0.4 });
    scene
}

// Blue above, dim below, a warm window 50° wide toward −Z and a small cold one toward +X.
pub(super) fn sky() -> Image {
    let mut image = Image::zeros(128, 64, 3);
    for at in 0..128 * 64 {
        let d = direction_from_lat_long(Vec2::new((at % 128) as f32 + 0.5, 2.0 * (at / 128) as f32 + 1.0) / 128.0);
        let window = |toward: Vec3, degrees: f32| if d.dot(toward.normalize()) > degrees.to_radians().cos() { 1.0 } else { 0.0 };
        let warm = 5.0 * window(Vec3::new(0.0, 0.5, -1.0), 25.0) * Vec3::new(1.0, 0.8, 0.5);
        let cold = 8.0 * window(Vec3::new(1.0, 0.9, 0.2), 10.0) * Vec3::new(0.4, 0.7, 1.0);
        image.set_rgb(at, ((0.25 + 0.2 * d.y) * Vec3::new(0.6, 0.8, 1.2) + warm + cold).to_array());
    }
    image
}

#[derive(Clone)]
pub(super) struct Stored {
    pub field: Arc<dyn Representation>,
    pub pages: MemoryPages,
}

fn fixture() -> &'static (Scene, Stored) {
    static FIXTURE: OnceLock<(Scene, Stored)> = OnceLock::new();
    FIXTURE.get_or_init(|| {
        let scene = scene();
        let stored = captured(&scene, "ball", 200, None);
        (scene, stored)
    })
}

/// Of 32² faces, in memory.
pub(super) fn captured(scene: &Scene, object: &str, points: u32, epsilon: Option<f32>) -> Stored {
    let settings = ConstructSettings {
        object: object.into(),
        epsilon,
        spacing: Spacing::Count(points),
        placing: Placing::Uniform,
        face_size_texels: 32,
        sample_map_size_texels: 64,
        pixel_format: PixelFormat::F16,
        codec: Codec::DEFAULT,
        samples_per_texel: 16,
        max_bounces: 3,
        seed: 5,
        original: Original::Diffuse,
    };
    stored(|staging| construct(scene, &settings, staging, &Unattended).unwrap())
}

/// What `fill` fills, in memory.
pub(super) fn stored(fill: impl FnOnce(&Staging) -> Parameters) -> Stored {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(root.path(), StoreOptions::local()).unwrap();
    store.create_dataset("ball").unwrap();
    let staging = store.stage("ball", "test").unwrap();
    let parameters = fill(&staging);
    let publication = Publication {
        kind: "offset_surface_light_field".into(),
        parameters: serde_json::to_value(&parameters).unwrap(),
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    let version = staging.publish(publication).unwrap();
    let field: OffsetSurfaceLightField = from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap();
    let pages = (0..version.page_count()).map(|page| Arc::new(version.read_page(PageId(page)).unwrap())).collect::<Vec<Arc<Page>>>();
    Stored { field: Arc::new(field), pages: MemoryPages(pages) }
}

fn shown(component: Component, blend: Blend, light: Relighting) -> oslf::Settings {
    oslf::Settings { component, blend, specular_reflectance: Vec3::ONE, filter: Filter::Footprint, light, reflections: 1, bumps: None }
}

/// RMSE of L* / 100 of frames with each of `frames` against the truth of `of`, over both views.
fn errors(of: oslf::Settings, frames: &[oslf::Settings]) -> Vec<f64> {
    let (scene, stored) = fixture();
    let renderer = Renderer::cpu_only();
    let plan = Plan {
        object: "ball".into(),
        original: Original::Diffuse,
        cameras: scene.cameras.iter().map(|c| c.camera).collect(),
        settings: vec![Settings::OffsetSurfaceLightField(of); frames.len()],
        mirror_truths: vec![Truth::OneReflection],
        trace: TraceSettings { samples_per_pixel: 256, max_bounces: 3, seed: 9 },
        timed_frames: 1,
        tables: Default::default(),
        normal_maps: Default::default(),
    };
    let mut render = |camera: &Camera, setting: usize| -> Result<Rendered, RenderError> {
        let outputs = Outputs { depth: false, provenance: false };
        let settings = Settings::OffsetSurfaceLightField(frames[setting]);
        let request = FrameRequest { camera, settings: &settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let frame = renderer.render(&stored.field, &stored.pages, &request, None)?;
        let mut color = Image::zeros(frame.width_px as usize, frame.height_px as usize, 3);
        frame.pixels.color.as_chunks().0.iter().enumerate().for_each(|(i, rgb)| color.set_rgb(i, *rgb));
        Ok(Rendered { color, millis: frame.stats.total_millis, backend: frame.stats.backend, device_bytes: None })
    };
    let rows = evaluate(scene, &plan, &mut render, &mut |_| Ok(()), &Unattended).unwrap();
    assert!(rows[0].error.pixels > 1000, "{} pixels are too few to tell", rows[0].error.pixels);
    rows.iter().map(|row| row.error.rmse_lab[0]).collect()
}

const CORRECTED: Blend = Blend::Corrected;

fn turned() -> Relighting {
    Relighting::new(2.0, &[]).unwrap()
}

/// In front of the first camera's left; the box is in its way to the ball's side.
fn lamps() -> Relighting {
    let lamp = |position, intensity| PointLight { position, intensity };
    let beside = lamp(Vec3::new(4.0, 0.6, 0.4), Vec3::new(80.0, 72.0, 56.0));
    Relighting::new(0.0, &[beside, lamp(Vec3::new(-1.5, 2.0, 2.5), Vec3::new(8.0, 16.0, 24.0))]).unwrap()
}

fn gloss() -> Component {
    let brdf = AshikhminShirley::new(Vec3::new(0.3, 0.2, 0.1), Vec3::splat(0.4), Vec2::splat(30.0)).unwrap();
    Component::Glossy(Gloss::of(AnalyticBrdf::AshikhminShirley(brdf), 128))
}

/// `[with the feature, as captured]`.
fn beside_as_captured(component: Component, light: Relighting) -> [f64; 2] {
    let of = |light| shown(component, CORRECTED, light);
    let found = errors(of(light), &[of(light), of(Relighting::NONE)]);
    println!("{} {}: {found:?}", component.name(), light.name().unwrap());
    [found[0], found[1]]
}

#[test]
fn a_mirror_in_the_turned_environment_is_near_the_truth() {
    let of = |blend, light| shown(Component::Mirror, blend, light);
    let frames = [of(CORRECTED, turned()), of(Blend::EnvironmentMap, turned()), of(CORRECTED, Relighting::NONE)];
    let (found, unturned) = (errors(frames[0], &frames), errors(frames[2], &frames[2..]));
    println!("mirror turned, by one environment map, as captured: {found:?}; unturned {unturned:?}");
    assert!(found[0] < 0.055 && found[0] < 0.2 * found[2], "{found:?}");
}

/// `[corrected, by one environment map, corrected as the other body]`.
fn of_clear_bodies(body: Body, other: Body) -> Vec<f64> {
    let of = |body, blend| shown(Component::Refraction(Dielectric::new(1.5, body).unwrap()), blend, Relighting::NONE);
    let frames = [of(body, CORRECTED), of(body, Blend::EnvironmentMap), of(other, CORRECTED)];
    let found = errors(frames[0], &frames);
    println!("{body:?}: {found:?}");
    found
}

#[test]
fn a_glass_ball_is_near_the_truth_and_nearer_than_by_one_environment_map() {
    let found = of_clear_bodies(Body::Solid, Body::Thin);
    assert!(found[0] < 0.09 && found[0] < 0.65 * found[1] && found[0] < 0.4 * found[2], "{found:?}");
}

#[test]
fn a_bubble_is_near_the_truth_and_nearer_than_by_one_environment_map() {
    let found = of_clear_bodies(Body::Thin, Body::Solid);
    assert!(found[0] < 0.037 && found[0] < 0.65 * found[1] && found[0] < 0.2 * found[2], "{found:?}");
}

#[test]
fn a_diffuse_object_in_the_turned_environment_is_near_the_truth() {
    let [found, as_captured] = beside_as_captured(Component::Reconstruction, turned());
    assert!(found < 0.02 && found < 0.1 * as_captured, "{found}, as captured {as_captured}");
}

#[test]
fn a_glossy_object_in_the_turned_environment_is_near_the_truth() {
    let [found, as_captured] = beside_as_captured(gloss(), turned());
    assert!(found < 0.03 && found < 0.15 * as_captured, "{found}, as captured {as_captured}");
}

/// What the lamps light around the object, and it sends back, is left out.
#[test]
fn point_lights_on_a_diffuse_object_and_a_glossy_one_are_near_the_truth() {
    for (component, most) in [(Component::Reconstruction, 0.052), (gloss(), 0.08)] {
        let [found, as_captured] = beside_as_captured(component, lamps());
        assert!(found < most && found < 0.45 * as_captured, "{found}, as captured {as_captured}");
    }
}
