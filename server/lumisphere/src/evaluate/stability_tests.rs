//! Where a captured surface is no ball in the open: inside a bowl, which sees itself; at its foot, which touches the table; on its rim. A sweep over the
//! offset ε, an error bound for what is shown as known, and a bound on what is flagged. The control, of mirrors and not at the foot, is the same without
//! asking what is between.

use glam::Vec3;

use super::relighting_tests::{Stored, captured};
use super::*;
use crate::progress::Unattended;
use crate::radiometry::color::Lab;
use crate::raytrace::Mirrors;
use crate::render::Renderer;
use crate::representations::offset_surface_light_field as oslf;
use crate::representations::{Answer, FrameRequest, Outputs, Refine, Uploads};
use crate::scenes::{LoadOptions, SceneBundle, load};
use oslf::{Blend, Component, Filter};

/// A bowl on a table, under a lamp.
pub(super) fn scene() -> Scene {
    let json = br#"{"format": "neutral-scene/1",
        "materials": {"clay": {"type": "diffuse", "albedo": [0.7, 0.5, 0.35]}, "grey": {"type": "diffuse", "albedo": [0.4, 0.4, 0.45]}},
        "objects": [
            {"name": "table", "shape": {"type": "rect", "corner": [-4, 0, 4], "edge_u": [8, 0, 0], "edge_v": [0, 0, -8]}, "material": "grey"},
            {"name": "bowl", "shape": {"type": "lathe", "segments": 48,
                "profile": [[0.6, 0], [1.0, 0.8], [0.85, 0.8], [0.5, 0.15], [0, 0.15]]}, "material": "clay"}],
        "lights": [{"type": "disc", "center": [2, 3, 1], "normal": [-2, -3, -1], "radius": 0.9, "radiance": [7, 6.5, 6]}],
        "environment": {"radiance": [0.4, 0.5, 0.7]},
        "cameras": [{"name": "into", "origin": [0.4, 2.6, 2.4], "target": [0, 0.3, 0], "vfov_deg": 36, "width": 80, "height": 60},
            {"name": "beside", "origin": [-3.2, 0.9, 1.2], "target": [0, 0.4, 0], "vfov_deg": 34, "width": 80, "height": 60}]}"#;
    let mut files = SceneBundle::default();
    files.insert("scene.json", json.to_vec()).unwrap();
    load(&files, "scene.json", &LoadOptions::as_written()).unwrap()
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Region {
    Hollow,
    Foot,
    Rim,
    Flank,
}

const REGIONS: [Region; 4] = [Region::Hollow, Region::Foot, Region::Rim, Region::Flank];

fn region(x: Vec3) -> Region {
    let radius = x.x.hypot(x.z);
    let (outside, inside) = (0.6 + 0.5 * x.y, 0.5 + (x.y - 0.15) * 0.35 / 0.65);
    match () {
        () if x.y > 0.76 => Region::Rim,
        () if radius < 0.5 * (outside + inside) => Region::Hollow,
        () if x.y < 0.16 => Region::Foot,
        () => Region::Flank,
    }
}

/// Of a region's pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Found {
    pixels: usize,
    flagged: usize,
    squares: f64,
    known: usize,
}

impl Found {
    /// RMSE of L* (0 to 1) of the pixels that are shown as known.
    fn error(&self) -> f64 {
        (self.squares / self.known.max(1) as f64).sqrt()
    }

    fn flagged(&self) -> f64 {
        self.flagged as f64 / self.pixels as f64
    }
}

fn lightness(rgb: [f32; 3]) -> f64 {
    Lab::from_linear(rgb).l / Lab::UNIT_SCALE
}

fn shown(component: Component, blend: Blend, reflections: u32) -> Settings {
    let (light, specular_reflectance) = (Relighting::NONE, Vec3::ONE);
    Settings::OffsetSurfaceLightField(oslf::Settings {
        component,
        blend,
        specular_reflectance,
        filter: Filter::Footprint,
        light,
        reflections,
        bumps: None,
    })
}

/// Of frames with `settings`, beside the truth of `of`.
fn found(scene: &Scene, stored: &Stored, truths: &[ViewTruth], settings: &Settings, of: (&Settings, Truth)) -> [Found; 4] {
    let renderer = Renderer::cpu_only();
    let mut all = [Found::default(); 4];
    for (camera, truth) in scene.cameras.iter().map(|c| &c.camera).zip(truths) {
        let outputs = Outputs { depth: true, provenance: true };
        let request = FrameRequest { camera, settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let pixels = renderer.render(&stored.field, &stored.pages, &request, None).unwrap().pixels;
        let reference = truth.reference(of.0, of.1);
        let (depth, provenance) = (pixels.depth.unwrap(), pixels.provenance.unwrap());
        let width = camera.intrinsics().width_px;
        for at in (0..depth.len()).filter(|at| truth.mask[*at]) {
            let x = camera.pixel_ray(at as u32 % width, at as u32 / width).at(depth[at]);
            let of = &mut all[REGIONS.iter().position(|r| *r == region(x)).expect("one of them")];
            of.pixels += 1;
            if provenance[at].answer() != Answer::Hit {
                of.flagged += 1;
                continue;
            }
            let shown = [0, 1, 2].map(|c| pixels.color[3 * at + c]);
            of.known += 1;
            of.squares += (lightness(shown) - lightness(reference.rgb(at))).powi(2);
        }
    }
    all
}

#[test]
fn a_bowl_that_sees_itself_and_touches_the_table() {
    let scene = scene();
    let object = scene.object("bowl").unwrap();
    let renderer = TruthRenderer::new(&scene, object).unwrap();
    let trace = TraceSettings { samples_per_pixel: 128, max_bounces: 3, seed: 9 };
    let truths: Vec<ViewTruth> =
        scene.cameras.iter().map(|c| renderer.view(&c.camera, &[Truth::OneReflection], &trace, &Unattended).unwrap()).collect();
    let mut flagged_before = [1.0; 4];
    for (at, epsilon) in [0.02, 0.06, 0.2].into_iter().enumerate() {
        let stored = captured(&scene, "bowl", 260, Some(epsilon));
        for component in [Component::Reconstruction, Component::Mirror] {
            let truth = if component == Component::Mirror { Truth::OneReflection } else { Truth::Diffuse };
            let [corrected, plain] = [Blend::Corrected, Blend::Normal { exponent: 4.0 }].map(|blend| {
                let settings = shown(component, blend, 1);
                found(&scene, &stored, &truths, &settings, (&settings, truth))
            });
            for (k, region) in REGIONS.into_iter().enumerate() {
                let (a, b) = (corrected[k], plain[k]);
                println!(
                    "| {epsilon} | {} | {region:?} | {} | {:.4} | {:.3} | {:.4} | {:.3} |",
                    component.name(),
                    a.pixels,
                    a.error(),
                    a.flagged(),
                    b.error(),
                    b.flagged()
                );
                let what = format!("ε = {epsilon}, {} of {region:?}: {a:?}, uncorrected {b:?}", component.name());
                assert!(a.pixels > 60, "{what}");
                match component {
                    // Sample points that nearly touch the surface see little of it, which is flagged; what is not is right.
                    Component::Reconstruction => {
                        let most_flagged = [0.9, 0.25, 0.02][at];
                        assert!(a.error() < 0.012 && a.flagged() < most_flagged && a.flagged() <= flagged_before[k], "{what}");
                        flagged_before[k] = a.flagged();
                    }
                    // Close to the table sample points are few, and each sees another part of it.
                    _ => {
                        let bound = if region == Region::Foot { [0.035, 0.02, 0.03][at] } else { 0.025 };
                        assert!(a.error() < bound && a.flagged() < 0.02, "{what}");
                        assert!(a.error() < 0.75 * b.error() || region == Region::Foot, "{what}");
                    }
                }
            }
        }
    }
}

/// In its hollow a bowl mirrors itself, as a mirror and, where it has a diffuse ground, as both.
#[test]
fn a_bowl_that_mirrors_itself_more_than_once() {
    let scene = scene();
    let renderer = TruthRenderer::new(&scene, scene.object("bowl").unwrap()).unwrap();
    let trace = TraceSettings { samples_per_pixel: 256, max_bounces: 3, seed: 9 };
    let kinds = [1, 2, 4].map(|n| [Component::Mirror, Component::Full].map(|component| shown(component, Blend::Corrected, n)));
    let mirrors: Vec<Mirrors> = kinds.iter().flatten().filter_map(|settings| settings.mirrors()).collect();
    let truths: Vec<ViewTruth> = scene
        .cameras
        .iter()
        .map(|c| {
            let mut view = renderer.view(&c.camera, &[Truth::OneReflection], &trace, &Unattended).unwrap();
            renderer.add_mirrors(&mut view, &c.camera, &mirrors, &trace, &Unattended).unwrap();
            view
        })
        .collect();
    let stored = captured(&scene, "bowl", 260, Some(0.06));
    for (k, component) in [Component::Mirror, Component::Full].into_iter().enumerate() {
        let once = kinds[0][k];
        let one = found(&scene, &stored, &truths, &once, (&once, Truth::OneReflection))[0].error();
        for settings in [kinds[1][k], kinds[2][k]] {
            let truth = (&settings, Truth::SeveralReflections);
            let several = found(&scene, &stored, &truths, &settings, truth)[0];
            let instead = found(&scene, &stored, &truths, &once, truth)[0];
            let reflections = settings.mirrors().unwrap().reflections;
            println!("| {} | {reflections} | {:.4} | {:.4} | {one:.4} |", component.name(), several.error(), instead.error());
            let what = format!("{} {reflections}: {several:?}, one instead {instead:?}, one of one {one}", component.name());
            assert!(several.pixels > 300 && several.flagged() < 0.05, "{what}");
            assert!(several.error() < 0.1 && several.error() < 0.5 * instead.error(), "{what}");
        }
    }
}
