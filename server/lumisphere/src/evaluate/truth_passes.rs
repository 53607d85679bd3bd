//! Ground truth a few paths a pixel at a time: what frames with some settings should look like, for those who watch. The mean of passes that follow
//! each other is the picture that one pass of all their paths would be; `ViewTruth::reference` is what it converges to wherever pixels count.
//! Called by the service's `ground_truth`.
//!
//! Unlike a rendered frame, which sees one point a pixel, a truth is the mean over the pixel's square, at silhouettes too.

use glam::Vec3;
use thiserror::Error;

use crate::geometry::Camera;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{Appearance, Seen, TraceError, TraceSettings, Tracer, Under};
use crate::representations::{Original, Outputs, Pixels, Provenance, Settings, Uploads};
use crate::scenes::{Environment, Relighting, Scene};

/// Paths of one pass, of all its pixels together: tens of seconds of two cores.
pub const MOST_PATHS_PER_PASS: u64 = 1 << 24;
/// Passes that are counted.
pub const MOST_TRUTH_PASSES: u32 = 4096;
/// Paths of a pixel in a pass: what is more belongs into another pass.
pub const MOST_PATHS_PER_PIXEL: u32 = 64;

/// The same passes for all who ask.
const SEED: u64 = 0x6772_6f75_6e64;

/// A scene of which truths are traced, any object's.
pub struct TruthPasses {
    tracer: Tracer,
    environment: Environment,
    objects: Vec<String>,
    /// In the other light that was asked for last.
    relit: Option<(Relighting, Tracer)>,
}

/// Which pass of what.
#[derive(Debug, Clone, Copy)]
pub struct TruthPass<'a> {
    /// The captured object's name.
    pub object: &'a str,
    /// Of the capture's paths.
    pub max_bounces: u32,
    /// What the object looked like to it.
    pub original: Original,
    /// Whose truth: component, reflectance, BRDF, clear body and light count, how texels are blended and filtered does not.
    pub settings: &'a Settings,
    /// From 0.
    pub pass: u32,
    /// Of every pass alike, 1 to [`MOST_PATHS_PER_PIXEL`].
    pub paths_per_pixel: u32,
    /// What comes beside colour.
    pub outputs: Outputs,
    /// What the settings name.
    pub uploads: Uploads<'a>,
}

/// Why there is no truth.
#[derive(Debug, Error)]
pub enum TruthError {
    /// The scene has no such object.
    #[error("the scene has no object {name:?}")]
    NoObject {
        /// The captured one's.
        name: String,
    },
    /// More work than a pass may be.
    #[error("{pixels} pixels of {paths} paths each, at most {MOST_PATHS_PER_PASS} paths a pass expected: fewer of either")]
    TooManyPaths {
        /// Of the frame.
        pixels: u64,
        /// Of each pixel.
        paths: u32,
    },
    /// Settings that name a measured BRDF, without it.
    #[error("the measured BRDF did not come with the settings")]
    NoTable,
    /// Settings that name a normal map, without it.
    #[error("the normal map did not come with the settings")]
    NoNormalMap,
    /// Nobody waits for it any more.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Of what a truth is put together.
enum Parts {
    /// The whole picture, the object looking so.
    Whole(Appearance),
    /// The diffuse scene, the object looking so.
    Object(Appearance),
    /// The diffuse scene, and on the object what is added to it.
    Added(Appearance),
}

impl TruthPasses {
    /// Makes the scene ready; it is not needed afterwards.
    pub fn new(scene: &Scene) -> Result<Self, TraceError> {
        let objects = scene.objects.iter().map(|o| o.name.clone()).collect();
        Ok(Self { tracer: Tracer::new(scene)?, environment: scene.environment.clone(), objects, relit: None })
    }

    fn in_light(&mut self, light: Relighting) -> &Tracer {
        if !light.changes_light() {
            return &self.tracer;
        }
        if self.relit.as_ref().is_none_or(|(known, _)| *known != light) {
            self.relit = None;
            self.relit = Some((light, self.tracer.relit(&self.environment, &light)));
        }
        self.relit.as_ref().map_or(&self.tracer, |(_, tracer)| tracer)
    }

    /// One pass seen from `camera`, on the threads of the caller's pool; `progress` can end it between two tiles.
    pub fn trace(&mut self, pass: &TruthPass<'_>, camera: &Camera, progress: &dyn Progress) -> Result<Pixels, TruthError> {
        let object = self.objects.iter().position(|name| name == pass.object);
        let object = object.ok_or_else(|| TruthError::NoObject { name: pass.object.into() })?;
        let pixels = u64::from(camera.intrinsics().width_px) * u64::from(camera.intrinsics().height_px);
        let paths = pass.paths_per_pixel.clamp(1, MOST_PATHS_PER_PIXEL);
        if pixels.saturating_mul(paths.into()) > MOST_PATHS_PER_PASS {
            return Err(TruthError::TooManyPaths { pixels, paths });
        }
        let settings = TraceSettings { samples_per_pixel: paths, max_bounces: pass.max_bounces, seed: SEED };
        let first = pass.pass.min(MOST_TRUTH_PASSES) * paths;
        let lit = self.in_light(pass.settings.light());
        let bumped = match (pass.settings.bumps(), pass.uploads.normal_map) {
            (Some(bumps), Some(map)) => Some(lit.with_normal_map(object, map.clone(), bumps.mapping)),
            (Some(_), None) => return Err(TruthError::NoNormalMap),
            (None, _) => None,
        };
        let tracer = bumped.as_ref().unwrap_or(lit);
        let seen = |appearance, wanted: &(dyn Fn(usize, usize) -> bool + Sync)| {
            tracer.with_appearance(object, appearance).seen(first, wanted, camera, &settings, progress)
        };
        let everywhere = |_, _| true;
        let (over, join): (_, fn(&mut Seen, &Seen)) = match parts(pass)? {
            Parts::Whole(appearance) => return Ok(self::pixels(&seen(appearance, &everywhere)?, pass.outputs)),
            Parts::Object(appearance) => (appearance, |below, over| below.radiance = over.radiance),
            Parts::Added(appearance) => (appearance, |below, over| below.radiance += over.radiance),
        };
        let mut below = seen(Appearance::Diffuse, &everywhere)?;
        let width = camera.intrinsics().width_px as usize;
        let shows_object: Vec<bool> = below.iter().map(|s| s.object == object as u32).collect();
        let over = seen(over, &|column, row| shows_object[row * width + column])?;
        below.iter_mut().zip(&over).zip(&shows_object).filter(|(_, shown)| **shown).for_each(|((below, over), _)| join(below, over));
        Ok(self::pixels(&below, pass.outputs))
    }
}

/// As `ViewTruth::reference` puts it together, mirrors being those of as many reflections as the settings say.
fn parts(pass: &TruthPass<'_>) -> Result<Parts, TruthError> {
    let settings = pass.settings;
    if let Some(dielectric) = settings.dielectric() {
        return Ok(Parts::Whole(Appearance::OneRefraction { dielectric }));
    }
    Ok(match (settings.brdf(), settings.mirrors()) {
        (Some(brdf), _) => Parts::Whole(Appearance::OneGlossy { brdf: brdf.model(pass.uploads.table).ok_or(TruthError::NoTable)? }),
        (None, None) if pass.original == Original::AsAuthored => Parts::Object(Appearance::AsAuthored),
        (None, None) => Parts::Whole(Appearance::Diffuse),
        (None, Some(mirrors)) => match mirrors.under {
            Under::Nothing => Parts::Whole(Appearance::Mirrors(mirrors)),
            Under::Diffuse => Parts::Added(Appearance::Mirrors(mirrors)),
        },
    })
}

/// Nothing of it is read from samples: every pixel is as the background of a light field.
fn pixels(seen: &[Seen], outputs: Outputs) -> Pixels {
    Pixels {
        color: seen.iter().flat_map(|s| finite(s.radiance).to_array()).collect(),
        depth: outputs.depth.then(|| seen.iter().map(|s| s.distance).collect()),
        provenance: outputs.provenance.then(|| vec![Provenance::BACKGROUND; seen.len()]),
        pages_needed: 0,
        is_final: true,
    }
}

/// A path beyond f32 would stay in every mean.
fn finite(radiance: Vec3) -> Vec3 {
    if radiance.is_finite() { radiance } else { Vec3::ZERO }
}

#[cfg(test)]
mod tests {
    use super::super::truth::tests::ball;
    use super::super::{Truth, TruthRenderer};
    use super::*;
    use crate::progress::Unattended;
    use crate::radiometry::brdf::{AnalyticBrdf, CookTorrance};
    use crate::radiometry::dielectric::{Body, Dielectric};
    use crate::render::Accumulator;
    use crate::representations::{offset_surface_light_field as oslf, parameter_map};
    use crate::scenes::PointLight;

    const BOUNCES: u32 = 2;
    const COLOR_ALONE: Outputs = Outputs { depth: false, provenance: false };

    fn of_light_field(component: oslf::Component) -> Settings {
        let (blend, specular_reflectance, filter) = (oslf::Blend::Average, Vec3::new(0.5, 0.25, 1.0), oslf::Filter::Footprint);
        let light = Relighting::NONE;
        Settings::OffsetSurfaceLightField(oslf::Settings {
            component,
            blend,
            specular_reflectance,
            filter,
            light,
            reflections: 1,
            bumps: None,
        })
    }

    fn pass<'a>(settings: &'a Settings, pass: u32, paths_per_pixel: u32) -> TruthPass<'a> {
        let original = Original::Diffuse;
        TruthPass {
            object: "ball",
            max_bounces: BOUNCES,
            original,
            settings,
            pass,
            paths_per_pixel,
            outputs: COLOR_ALONE,
            uploads: Uploads::NONE,
        }
    }

    fn mean_of(passes: &mut TruthPasses, settings: &Settings, camera: &Camera, count: u32, paths: u32) -> Pixels {
        mean_of_original(passes, (Original::Diffuse, settings), camera, count, paths)
    }

    fn mean_of_original(
        passes: &mut TruthPasses,
        (original, settings): (Original, &Settings),
        camera: &Camera,
        count: u32,
        paths: u32,
    ) -> Pixels {
        let mut trace = |k| passes.trace(&TruthPass { original, ..pass(settings, k, paths) }, camera, &Unattended).unwrap();
        let mut mean = Accumulator::new(trace(0));
        (1..count).for_each(|k| mean.add(&trace(k)));
        mean.pixels().clone()
    }

    #[test]
    fn passes_go_on_where_the_one_before_ended() {
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let settings = of_light_field(oslf::Component::Full);
        let (in_eight, in_one) = (mean_of(&mut passes, &settings, &camera, 8, 2), mean_of(&mut passes, &settings, &camera, 1, 16));
        for (a, b) in in_eight.color.iter().zip(&in_one.color) {
            // The same sixteen paths, summed in another order: a few roundings of f32.
            assert!((a - b).abs() <= 1e-5 * b.abs().max(1.0), "{a} of eight passes, {b} of one");
        }
        let second = passes.trace(&pass(&settings, 1, 2), &camera, &Unattended).unwrap();
        assert_ne!(second.color, passes.trace(&pass(&settings, 0, 2), &camera, &Unattended).unwrap().color, "other paths");
    }

    #[test]
    fn the_mean_of_many_passes_is_the_reference_of_the_evaluation() {
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let brdf = AnalyticBrdf::from(CookTorrance::new(glam::Vec2::splat(0.3), Vec3::ONE, Vec3::ONE).unwrap());
        let glossy = oslf::Component::Glossy(oslf::Gloss::of(brdf, 1));
        let of_map = Settings::ParameterMap(parameter_map::Settings::default());
        let fields = [oslf::Component::Reconstruction, oslf::Component::Mirror, oslf::Component::Full, glossy].map(of_light_field);
        // Another seed than the passes': what is compared shares no path.
        let trace = TraceSettings { samples_per_pixel: 256, max_bounces: BOUNCES, seed: 3 };
        let renderer = TruthRenderer::new(&scene, scene.object("ball").unwrap()).unwrap();
        let mut view = renderer.view(&camera, &[Truth::OneReflection, Truth::AsAuthored], &trace, &Unattended).unwrap();
        renderer.add_glossy(&mut view, &camera, &[(brdf.into(), brdf.into())], &trace, &Unattended).unwrap();
        let mut means: Vec<Vec3> = Vec::new();
        let as_authored = [&fields[0], &of_map].map(|settings| (Original::AsAuthored, settings, Truth::AsAuthored));
        let fields = fields.iter().map(|settings| (Original::Diffuse, settings, Truth::OneReflection));
        for (original, settings, truth) in fields.chain(as_authored) {
            let reference = view.reference(settings, truth);
            let traced = mean_of_original(&mut passes, (original, settings), &camera, 64, 4);
            let counted: Vec<usize> = (0..view.mask.len()).filter(|i| view.mask[*i]).collect();
            let of = |at: usize| Vec3::from_slice(&traced.color[3 * at..3 * at + 3]);
            let pairs: Vec<(Vec3, Vec3)> = counted.iter().map(|i| (of(*i), Vec3::from(reference.rgb(*i)))).collect();
            let count = pairs.len() as f32;
            let (mean, expected) = pairs.iter().fold((Vec3::ZERO, Vec3::ZERO), |(a, b), (x, y)| (a + x / count, b + y / count));
            // 200 pixels of 256 paths in both: half a percent of the mean in noise.
            assert!(((mean - expected) / expected).abs().max_element() < 0.02, "{settings:?}: {mean}, {expected} expected");
            let apart = pairs.iter().map(|(x, y)| (x - y).length_squared()).sum::<f32>() / count;
            // A pixel's own noise: about a twentieth of it.
            assert!(apart.sqrt() < 0.1 * expected.length(), "{settings:?}: pixels {} apart of {}", apart.sqrt(), expected.length());
            assert!(means.iter().all(|other| other.distance(mean) > 0.05 * mean.length()) || truth == Truth::AsAuthored, "{settings:?}");
            means.push(mean);
        }
    }

    #[test]
    fn other_light_and_clear_bodies_are_those_of_the_evaluation() {
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let trace = TraceSettings { samples_per_pixel: 256, max_bounces: BOUNCES, seed: 3 };
        let renderer = TruthRenderer::new(&scene, scene.object("ball").unwrap()).unwrap();
        let dielectric = Dielectric::new(1.5, Body::Solid).unwrap();
        let lamp = PointLight { position: Vec3::new(-3.0, 2.0, 3.0), intensity: Vec3::new(20.0, 5.0, 1.0) };
        let light = Relighting::new(1.0, &[lamp]).unwrap();
        let in_light = |component, light| match of_light_field(component) {
            Settings::OffsetSurfaceLightField(settings) => Settings::OffsetSurfaceLightField(oslf::Settings { light, ..settings }),
            other => other,
        };
        let cases = [
            in_light(oslf::Component::Reconstruction, light),
            in_light(oslf::Component::Refraction(dielectric), Relighting::NONE),
            // What was relit last is not what is asked for now.
            in_light(oslf::Component::Reconstruction, Relighting::NONE),
        ];
        let mut means: Vec<Vec3> = Vec::new();
        for settings in &cases {
            let relit = renderer.relit(&scene, &settings.light());
            let mut view = relit.view(&camera, &[Truth::Diffuse], &trace, &Unattended).unwrap();
            relit.add_clear(&mut view, &camera, &[dielectric], &trace, &Unattended).unwrap();
            let reference = view.reference(settings, Truth::Diffuse);
            let traced = mean_of(&mut passes, settings, &camera, 64, 4);
            let counted: Vec<usize> = (0..view.mask.len()).filter(|i| view.mask[*i]).collect();
            let mean = |of: &dyn Fn(usize) -> Vec3| counted.iter().map(|i| of(*i)).sum::<Vec3>() / counted.len() as f32;
            let seen = mean(&|i| Vec3::from_slice(&traced.color[3 * i..3 * i + 3]));
            let expected = mean(&|i| Vec3::from(reference.rgb(i)));
            assert!(((seen - expected) / expected).abs().max_element() < 0.03, "{settings:?}: {seen}, {expected} expected");
            means.push(seen);
        }
        // What was compared are different pictures.
        let [relit, _, unlit] = means[..] else { unreachable!("three cases") };
        assert!(relit.distance(unlit) > 0.05 * unlit.length(), "{relit} {unlit}");
    }

    #[test]
    fn several_reflections_are_those_of_the_evaluation() {
        let scene = crate::evaluate::stability_tests::scene();
        let camera = scene.cameras[0].camera;
        let mut passes = TruthPasses::new(&scene).unwrap();
        let trace = TraceSettings { samples_per_pixel: 128, max_bounces: BOUNCES, seed: 3 };
        let renderer = TruthRenderer::new(&scene, scene.object("bowl").unwrap()).unwrap();
        let with = |component, reflections| match of_light_field(component) {
            Settings::OffsetSurfaceLightField(s) => Settings::OffsetSurfaceLightField(oslf::Settings { reflections, ..s }),
            other => other,
        };
        for component in [oslf::Component::Mirror, oslf::Component::Full] {
            let mut view = renderer.view(&camera, &[Truth::OneReflection], &trace, &Unattended).unwrap();
            let settings = with(component, 2);
            renderer.add_mirrors(&mut view, &camera, &[settings.mirrors().unwrap()], &trace, &Unattended).unwrap();
            let mut trace = |settings: &Settings| {
                let mut trace = |k| passes.trace(&TruthPass { object: "bowl", ..pass(settings, k, 4) }, &camera, &Unattended).unwrap();
                let mut mean = Accumulator::new(trace(0));
                (1..16).for_each(|k| mean.add(&trace(k)));
                mean.pixels().color.clone()
            };
            let counted: Vec<usize> = (0..view.mask.len()).filter(|i| view.mask[*i]).collect();
            let mean = |of: &dyn Fn(usize) -> Vec3| counted.iter().map(|i| of(*i)).sum::<Vec3>() / counted.len() as f32;
            let of_passes = |color: Vec<f32>| mean(&|i| Vec3::from_slice(&color[3 * i..3 * i + 3]));
            let (twice, once) = (of_passes(trace(&settings)), of_passes(trace(&with(component, 1))));
            let reference = view.reference(&settings, Truth::SeveralReflections);
            let expected = mean(&|i| Vec3::from(reference.rgb(i)));
            assert!(((twice - expected) / expected).abs().max_element() < 0.03, "{component:?}: {twice}, {expected} expected");
            assert!(((once - expected) / expected).abs().max_element() > 0.06, "{component:?}: {once} of one, {expected} of two");
        }
    }

    #[test]
    fn depth_is_along_the_rays_and_nothing_claims_a_sample() {
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let settings = of_light_field(oslf::Component::Mirror);
        let outputs = Outputs { depth: true, provenance: true };
        let seen = passes.trace(&TruthPass { outputs, ..pass(&settings, 0, 1) }, &camera, &Unattended).unwrap();
        let middle = 12 * 24 + 12;
        // The eye is √26 from the ball's centre, and a pixel's ray nearly points there.
        assert!((seen.depth.unwrap()[middle] - (26f32.sqrt() - 1.0)).abs() < 0.01);
        assert!(seen.provenance.unwrap().iter().all(|p| *p == Provenance::BACKGROUND));
        assert!(seen.is_final && seen.color.len() == 3 * 24 * 24);
    }

    #[test]
    fn what_cannot_be_traced_is_refused_by_name() {
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let settings = of_light_field(oslf::Component::Mirror);
        let error = passes.trace(&TruthPass { object: "cube", ..pass(&settings, 0, 1) }, &camera, &Unattended).unwrap_err();
        assert_eq!(error.to_string(), "the scene has no object \"cube\"");
        let large = Camera::new(crate::geometry::Intrinsics::from_vfov(40.0, 4096, 4097).unwrap(), *camera.pose()).unwrap();
        let error = passes.trace(&pass(&settings, 0, 1), &large, &Unattended).unwrap_err();
        assert!(error.to_string().starts_with("16781312 pixels of 1 paths each, at most 16777216 paths a pass expected"), "{error}");
    }

    #[test]
    fn a_pass_that_nobody_waits_for_ends() {
        struct Gone;
        impl Progress for Gone {
            fn report(&self, _: &str, _: u64, _: u64) {}
            fn is_cancelled(&self) -> bool {
                true
            }
        }
        let (scene, camera) = ball();
        let mut passes = TruthPasses::new(&scene).unwrap();
        let settings = of_light_field(oslf::Component::Full);
        assert!(matches!(passes.trace(&pass(&settings, 0, 1), &camera, &Gone), Err(TruthError::Cancelled(_))));
    }
}
