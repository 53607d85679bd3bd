//! Another object in stored light against the same object captured in the scene itself: a vase where a ball stood, on a floor beside a box. The
//! controls are what could be done without a new light field: the ball's cube maps read where the vase is, and one environment map.

use std::sync::{Arc, OnceLock};

use glam::Vec3;
use serde_json::{Value, json};

use super::relighting_tests::{Stored, captured, sky, stored};
use super::*;
use crate::render::Renderer;
use crate::representations::offset_surface_light_field as oslf;
use crate::representations::{FrameRequest, Outputs, Refine, RenderError, Uploads};
use crate::scenes::{Environment, EnvironmentMap, LoadOptions, SceneBundle, load};
use crate::textures::{Codec, PixelFormat};
use oslf::{Blend, Component, Filter, OffsetSurfaceLightField, Placement, ReplaceSettings, Shares, Spacing, build_sample_maps, replace};

fn ball() -> Value {
    json!({"name": "ball", "shape": {"type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 40}, "material": "red"})
}

// Waisted, so that it sees itself; beside the ball's middle.
fn vase() -> Value {
    let profile = [[0.0, -0.9], [0.6, -0.85], [0.62, -0.6], [0.25, 0.0], [0.5, 0.6], [0.5, 0.7], [0.0, 0.72]];
    let place = json!({"translate": [0.15, -0.05, 0.1]});
    json!({"name": "vase", "shape": {"type": "lathe", "profile": profile, "segments": 40}, "material": "orange", "transform": place})
}

fn scene(object: Option<Value>) -> Scene {
    let floor = json!({"name": "floor", "shape": {"type": "rect", "corner": [-5, -1.1, 5], "edge_u": [10, 0, 0], "edge_v": [0, 0, -10]}, "material": "grey"});
    let beside = json!({"name": "box", "shape": {"type": "box", "min": [1.4, -1.1, -0.6], "max": [2.2, 1.2, 0.6]}, "material": "red"});
    let objects: Vec<Value> = [floor, beside].into_iter().chain(object).collect();
    let diffuse = |albedo: [f32; 3]| json!({"type": "diffuse", "albedo": albedo});
    let camera = |name: &str, origin: [f32; 3]| json!({"name": name, "origin": origin, "target": [0.1, -0.1, 0.1], "vfov_deg": 27, "width": 64, "height": 48});
    let text = json!({
        "format": "neutral-scene/1",
        "materials": {"orange": diffuse([0.8, 0.55, 0.3]), "grey": diffuse([0.4, 0.4, 0.4]), "red": diffuse([0.6, 0.1, 0.1])},
        "objects": objects,
        "environment": null,
        "cameras": [camera("a", [0.6, 1.4, 4.0]), camera("b", [-3.6, 0.8, -1.4])],
    });
    let mut files = SceneBundle::default();
    files.insert("scene.json", serde_json::to_vec(&text).unwrap()).unwrap();
    let mut scene = load(&files, "scene.json", &LoadOptions::as_written()).unwrap();
    scene.environment = Environment::Map(EnvironmentMap { image: sky(), rotation: 0.4 });
    scene
}

const POINTS: u32 = 200;

fn field(stored: &Stored) -> &OffsetSurfaceLightField {
    stored.field.as_any().downcast_ref().unwrap()
}

/// The vase, out of a scene of its own, in the ball's light.
fn replaced(light: &Stored) -> (Stored, Shares) {
    let mut shares = Shares::default();
    let made = stored(|staging| {
        let settings = ReplaceSettings {
            object: "vase".into(),
            placement: Placement::NONE,
            light: "ball version 1".into(),
            epsilon: None,
            spacing: Spacing::Count(POINTS),
            face_size_texels: 32,
            sample_map_size_texels: 64,
            pixel_format: PixelFormat::F16,
            codec: Codec::DEFAULT,
            rays_per_texel: 16,
            order: oslf::BAKED_FIRST,
            scene_bytes: u64::MAX,
        };
        let (parameters, told) =
            replace((field(light), &light.pages), &scene(Some(vase())), &settings, staging, &crate::progress::Unattended).unwrap();
        shares = told;
        parameters
    });
    (made, shares)
}

struct Fixture {
    truth: Scene,
    light: Stored,
    captured: Stored,
    replaced: Stored,
    /// The ball's cube maps, read where the vase is.
    naive: Stored,
}

fn fixture() -> &'static Fixture {
    static FIXTURE: OnceLock<Fixture> = OnceLock::new();
    FIXTURE.get_or_init(|| {
        let truth = scene(Some(vase()));
        let light = captured(&scene(Some(ball())), "ball", POINTS, None);
        let captured = captured(&truth, "vase", POINTS, None);
        let (replaced, shares) = replaced(&light);
        println!("{shares:?}");
        let sum = shares.object + shares.environment + shares.cube_maps + shares.baseline + shares.background + shares.unknown;
        assert!(
            (sum - 1.0).abs() < 1e-9 && shares.object > 0.3 && shares.cube_maps + shares.background > 0.1 && shares.unknown == 0.0,
            "{shares:?}"
        );
        let mut naive = field(&light).clone();
        naive.surface = field(&captured).surface.clone();
        naive.sample_maps = build_sample_maps(&naive.surface, &naive.sample_points, 64, &|_, _| true);
        let naive = Stored { field: Arc::new(naive), pages: light.pages.clone() };
        Fixture { truth, light, captured, replaced, naive }
    })
}

fn shown(component: Component, blend: Blend) -> Settings {
    Settings::OffsetSurfaceLightField(oslf::Settings {
        component,
        blend,
        specular_reflectance: Vec3::ONE,
        filter: Filter::Footprint,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    })
}

/// RMSE of L* / 100, and mean ΔE2000, against the vase in the scene itself, over both views.
fn errors(frames: &[(&Stored, Settings)]) -> Vec<[f64; 2]> {
    let Fixture { truth, .. } = fixture();
    let renderer = Renderer::cpu_only();
    let plan = Plan {
        object: "vase".into(),
        original: Original::Diffuse,
        cameras: truth.cameras.iter().map(|c| c.camera).collect(),
        settings: frames.iter().map(|(_, settings)| *settings).collect(),
        mirror_truths: vec![Truth::OneReflection],
        trace: TraceSettings { samples_per_pixel: 256, max_bounces: 3, seed: 9 },
        timed_frames: 1,
        tables: Default::default(),
        normal_maps: Default::default(),
    };
    let mut render = |camera: &Camera, setting: usize| -> Result<Rendered, RenderError> {
        let outputs = Outputs { depth: false, provenance: false };
        let (stored, settings) = &frames[setting];
        let request = FrameRequest { camera, settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let frame = renderer.render(&stored.field, &stored.pages, &request, None)?;
        let mut color = Image::zeros(frame.width_px as usize, frame.height_px as usize, 3);
        frame.pixels.color.as_chunks().0.iter().enumerate().for_each(|(i, rgb)| color.set_rgb(i, *rgb));
        Ok(Rendered { color, millis: frame.stats.total_millis, backend: frame.stats.backend, device_bytes: None })
    };
    let rows = evaluate(truth, &plan, &mut render, &mut |_| Ok(()), &crate::progress::Unattended).unwrap();
    assert!(rows[0].error.pixels > 500, "{} pixels are too few to tell", rows[0].error.pixels);
    rows.iter().map(|row| [row.error.rmse_lab[0], row.error.delta_e_2000_mean]).collect()
}

/// 1.15 times the captured one's is measured (1.12 and .98), half of what the ball's cube maps show there.
#[test]
fn a_mirror_in_replaced_light_is_near_the_truth() {
    let Fixture { light, captured, replaced, naive, .. } = fixture();
    let mirror = |blend| shown(Component::Mirror, blend);
    let frames = [replaced, captured, naive].map(|stored| (stored, mirror(Blend::Corrected)));
    let found =
        errors(&[&frames[..], &[(light, mirror(Blend::EnvironmentMap)), (naive, mirror(Blend::Normal { exponent: 4.0 }))]].concat());
    println!("mirror replaced, captured, naive, one environment map, naive uncorrected: {found:?}");
    assert!(found[0][1] < 1.3 * found[1][1], "{found:?}");
    assert!(found[2..].iter().all(|naive| found[0][1] < 0.6 * naive[1]), "{found:?}");
}

/// 1.01 times is measured (.609 and .603), a 50th of the control.
#[test]
fn a_diffuse_object_in_replaced_light_is_near_the_truth() {
    let Fixture { captured, replaced, naive, .. } = fixture();
    let found = errors(&[replaced, captured, naive].map(|stored| (stored, shown(Component::Reconstruction, Blend::Corrected))));
    println!("diffuse replaced, captured, naive: {found:?}");
    assert!(found[0][1] < 1.15 * found[1][1] && found[0][1] < 0.1 * found[2][1], "{found:?}");
}
