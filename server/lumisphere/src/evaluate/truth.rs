//! Path-traced images to compare with: of four kinds, of any BRDF, clear body, and mirror that sees itself.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::Vec3;
use serde::Serialize;

use crate::geometry::{Camera, Mapping, NormalMap};
use crate::images::Image;
use crate::progress::{Cancelled, Progress};
use crate::radiometry::brdf::BrdfModel;
use crate::radiometry::dielectric::Dielectric;
use crate::raytrace::{Appearance, Mirrors, TraceError, TraceSettings, Tracer, Under};
use crate::representations::Settings;
use crate::representations::offset_surface_light_field::GlossBrdf;
use crate::scenes::{Relighting, Scene};

/// What is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Truth {
    /// The object as a diffuse surface.
    Diffuse,
    /// The object with its own material.
    AsAuthored,
    /// One mirror reflection on the object over the diffuse scene: what an offset surface light field should converge to.
    OneReflection,
    /// The object as a mirror that sees itself as a mirror.
    PhysicalMirror,
    /// As many mirror reflections one after the other as are shown, over the diffuse scene.
    SeveralReflections,
    /// One reflection by the BRDF that is shown, over the diffuse scene.
    OneGlossyReflection,
    /// One way through the clear body that is shown, and one reflection outside, over the diffuse scene.
    OneRefraction,
}

impl Truth {
    /// As serialised.
    pub fn name(self) -> &'static str {
        match self {
            Self::Diffuse => "diffuse",
            Self::AsAuthored => "as_authored",
            Self::OneReflection => "one_reflection",
            Self::PhysicalMirror => "physical_mirror",
            Self::SeveralReflections => "several_reflections",
            Self::OneGlossyReflection => "one_glossy_reflection",
            Self::OneRefraction => "one_refraction",
        }
    }

    // None where it depends on more than this.
    fn appearance(self) -> Option<Appearance> {
        match self {
            Self::Diffuse => Some(Appearance::Diffuse),
            Self::AsAuthored => Some(Appearance::AsAuthored),
            Self::OneReflection => Some(Appearance::Mirrors(Mirrors::one(Vec3::ONE))),
            Self::PhysicalMirror => Some(Appearance::PhysicalMirror { reflectance: Vec3::ONE }),
            Self::SeveralReflections | Self::OneGlossyReflection | Self::OneRefraction => None,
        }
    }
}

/// Paths of the object's pixels for each of the others.
const PATHS_PER_PATH_AROUND: u32 = 16;

/// Traces truths of one object in one scene.
pub struct TruthRenderer {
    tracer: Tracer,
    object: usize,
}

/// The truths of one view.
pub struct ViewTruth {
    images: BTreeMap<Truth, Image>,
    glossy: Vec<(GlossBrdf, Image)>,
    clear: Vec<(Dielectric, Image)>,
    mirrors: Vec<(Mirrors, Image)>,
    /// Pixels that count: one fold of the object's front fills them and their eight neighbours.
    pub mask: Vec<bool>,
    object: Vec<bool>,
}

impl TruthRenderer {
    /// `object` indexes `scene.objects`.
    pub fn new(scene: &Scene, object: usize) -> Result<Self, TraceError> {
        Ok(Self { tracer: Tracer::new(scene)?, object })
    }

    /// The same in other light.
    pub fn relit(&self, scene: &Scene, light: &Relighting) -> Self {
        Self { tracer: self.tracer.relit(&scene.environment, light), object: self.object }
    }

    /// The same with a map that turns the normals by which the object reflects.
    pub fn with_normal_map(&self, map: Arc<NormalMap>, mapping: Mapping) -> Self {
        Self { tracer: self.tracer.with_normal_map(self.object, map, mapping), object: self.object }
    }

    /// The truths in `wanted`, and the diffuse one, seen from `camera`; glossy ones are for `add_glossy`. Around the object, which enters only the windows of FLIP and SSIM at
    /// its silhouette, with a 16th of the paths.
    pub fn view(&self, camera: &Camera, wanted: &[Truth], trace: &TraceSettings, progress: &dyn Progress) -> Result<ViewTruth, Cancelled> {
        let around = TraceSettings { samples_per_pixel: trace.samples_per_pixel.div_ceil(PATHS_PER_PATH_AROUND), ..*trace };
        let all = self.tracer.with_appearance(self.object, Appearance::Diffuse).render(camera, &around, progress)?;
        let object: Vec<bool> = all.object.iter().map(|o| *o == self.object as u32).collect();
        let points = |at: usize| {
            let (i, j) = (at % all.radiance.width, at / all.radiance.width);
            let ray = camera.pixel_ray(i as u32, j as u32);
            (ray.at(all.distance.planes[0][at]), Vec3::from(all.normal.rgb(at)))
        };
        let fronts = |a: usize, b: usize| all.shows_front[a] && all.shows_front[b];
        let mask = inside_silhouettes(&object, all.radiance.width, &|a, b| fronts(a, b) && smoothly_joined(points(a), points(b)));
        let mut images = BTreeMap::new();
        for truth in [Truth::Diffuse].iter().chain(wanted) {
            if let Some(appearance) = truth.appearance().filter(|_| !images.contains_key(truth)) {
                let tracer = self.tracer.with_appearance(self.object, appearance);
                images.insert(*truth, trace_object(&tracer, &object, &all.radiance, camera, trace, progress)?);
            }
        }
        Ok(ViewTruth { images, glossy: Vec::new(), clear: Vec::new(), mirrors: Vec::new(), mask, object })
    }

    /// Adds to `view`, which `camera` sees, the truth of every BRDF in `brdfs` that it does not hold: one reflection by the BRDF, its diffuse
    /// part included, over the diffuse scene.
    pub fn add_glossy(
        &self,
        view: &mut ViewTruth,
        camera: &Camera,
        brdfs: &[(GlossBrdf, BrdfModel)],
        trace: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        for (named, brdf) in brdfs {
            if view.glossy(*named).is_none() {
                let tracer = self.tracer.with_appearance(self.object, Appearance::OneGlossy { brdf: brdf.clone() });
                let image = trace_object(&tracer, &view.object, &view.images[&Truth::Diffuse], camera, trace, progress)?;
                view.glossy.push((*named, image));
            }
        }
        Ok(())
    }
}

impl TruthRenderer {
    /// Adds to `view`, which `camera` sees, the truth of every clear body in `bodies` that it does not hold.
    pub fn add_clear(
        &self,
        view: &mut ViewTruth,
        camera: &Camera,
        bodies: &[Dielectric],
        trace: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        for dielectric in bodies {
            if view.clear(dielectric).is_none() {
                let tracer = self.tracer.with_appearance(self.object, Appearance::OneRefraction { dielectric: *dielectric });
                let image = trace_object(&tracer, &view.object, &view.images[&Truth::Diffuse], camera, trace, progress)?;
                view.clear.push((*dielectric, image));
            }
        }
        Ok(())
    }

    /// Adds to `view`, which `camera` sees, the truth of every mirror in `mirrors` that sees itself and that it does not hold.
    pub fn add_mirrors(
        &self,
        view: &mut ViewTruth,
        camera: &Camera,
        mirrors: &[Mirrors],
        trace: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        for mirrors in mirrors.iter().filter(|mirrors| mirrors.reflections > 1) {
            if view.several(mirrors).is_none() {
                let tracer = self.tracer.with_appearance(self.object, Appearance::Mirrors(*mirrors));
                let image = trace_object(&tracer, &view.object, &view.images[&Truth::Diffuse], camera, trace, progress)?;
                view.mirrors.push((*mirrors, image));
            }
        }
        Ok(())
    }
}

/// `around` with the pixels of the object traced.
fn trace_object(
    tracer: &Tracer,
    object: &[bool],
    around: &Image,
    camera: &Camera,
    trace: &TraceSettings,
    progress: &dyn Progress,
) -> Result<Image, Cancelled> {
    let shows_object = |column, row| object[row * around.width + column];
    let traced = tracer.render_where(&shows_object, camera, trace, progress)?;
    let mut image = around.clone();
    (0..object.len()).filter(|i| object[*i]).for_each(|i| image.set_rgb(i, traced.radiance.rgb(i)));
    Ok(image)
}

impl ViewTruth {
    /// What a frame should look like whose object reflects by `brdf`; around the object always the diffuse scene. None unless it was added.
    pub fn glossy(&self, brdf: GlossBrdf) -> Option<&Image> {
        self.glossy.iter().find(|(known, _)| *known == brdf).map(|(_, image)| image)
    }

    /// What a frame should look like whose object is a clear body. None unless it was added.
    pub fn clear(&self, dielectric: &Dielectric) -> Option<&Image> {
        self.clear.iter().find(|(known, _)| known == dielectric).map(|(_, image)| image)
    }

    fn several(&self, mirrors: &Mirrors) -> Option<&Image> {
        self.mirrors.iter().find(|(known, _)| known == mirrors).map(|(_, image)| image)
    }

    /// What a frame with `settings` should look like: as the BRDF says where there is one (that was added), else the diffuse part, the reflected part (which is added for several reflections) times C_s, or their sum on the object;
    /// around the object always the diffuse scene. `truth` was among those wanted.
    pub fn reference(&self, settings: &Settings, truth: Truth) -> Image {
        if let Some(glossy) = settings.brdf().and_then(|brdf| self.glossy(brdf)) {
            return glossy.clone();
        }
        if let Some(clear) = settings.dielectric().and_then(|dielectric| self.clear(&dielectric)) {
            return clear.clone();
        }
        if truth == Truth::AsAuthored {
            return self.images[&truth].clone();
        }
        let mut image = self.images[&Truth::Diffuse].clone();
        let Some(mirrors) = settings.mirrors() else { return image };
        let (mirror, reflectance) = match self.several(&mirrors).filter(|_| truth == Truth::SeveralReflections) {
            Some(several) => (several, Vec3::ONE),
            None => (&self.images[&truth], mirrors.reflectance),
        };
        for i in (0..self.object.len()).filter(|i| self.object[*i]) {
            let diffuse = if mirrors.under == Under::Diffuse { Vec3::from(image.rgb(i)) } else { Vec3::ZERO };
            image.set_rgb(i, (diffuse + reflectance * Vec3::from(mirror.rgb(i))).to_array());
        }
        image
    }
}

// True where the pixel and its eight neighbours show the object, and no other fold of it begins between them.
fn inside_silhouettes(object: &[bool], width: usize, joined: &dyn Fn(usize, usize) -> bool) -> Vec<bool> {
    let height = object.len() / width;
    let inside = |i: usize| {
        let (row, column) = (i / width, i % width);
        if !object[i] || row == 0 || column == 0 || row + 1 == height || column + 1 == width {
            return false;
        }
        (row - 1..=row + 1).flat_map(|r| (column - 1..=column + 1).map(move |c| r * width + c)).all(|at| object[at] && joined(i, at))
    };
    (0..object.len()).map(inside).collect()
}

/// Largest cosine between the chord of two neighbouring points and the mean of their normals: on a smooth surface the chord lies across it,
/// from one fold to another it runs along the ray.
const MOST_ALONG: f32 = 0.5;
/// Least cosine between their normals.
const LEAST_AGREEMENT: f32 = 0.5;

fn smoothly_joined((x, n): (Vec3, Vec3), (y, m): (Vec3, Vec3)) -> bool {
    let (chord, mean) = (y - x, n + m);
    n.dot(m) >= LEAST_AGREEMENT && chord.dot(mean).abs() <= MOST_ALONG * chord.length() * mean.length()
}

#[cfg(test)]
pub(super) mod tests {
    use glam::Vec2;

    use super::*;
    use crate::progress::Unattended;
    use crate::radiometry::brdf::{AnalyticBrdf, CookTorrance, Lambert};
    use crate::scenes::{LoadOptions, SceneBundle, load};

    /// A ball over a black floor, in uneven light.
    pub fn ball() -> (Scene, Camera) {
        let json = br#"{"format": "neutral-scene/1",
            "materials": {"grey": {"type": "diffuse", "albedo": [0.6, 0.4, 0.2]}, "black": {"type": "diffuse", "albedo": [0, 0, 0]}},
            "objects": [
                {"name": "floor", "shape": {"type": "rect", "corner": [-9, -1, 9], "edge_u": [18, 0, 0], "edge_v": [0, 0, -18]}, "material": "black"},
                {"name": "ball", "shape": {"type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 48}, "material": "grey"}],
            "lights": [{"type": "disc", "center": [2, 3, 2], "normal": [-1, -1, -1], "radius": 0.8, "radiance": [9, 9, 9]}],
            "environment": {"radiance": [0.5, 0.5, 0.5]},
            "cameras": [{"name": "a", "origin": [0, 1, 5], "target": [0, 0, 0], "vfov_deg": 25, "width": 24, "height": 24},
                {"name": "below", "origin": [0, -6, 5], "target": [0, 0, 0], "vfov_deg": 25, "width": 24, "height": 24}]}"#;
        let mut files = SceneBundle::default();
        files.insert("scene.json", json.to_vec()).unwrap();
        let scene = load(&files, "scene.json", &LoadOptions::as_written()).unwrap();
        let camera = scene.cameras[0].camera;
        (scene, camera)
    }

    fn mean(image: &Image, mask: &[bool]) -> Vec3 {
        let count = mask.iter().filter(|m| **m).count() as f32;
        (0..mask.len()).filter(|i| mask[*i]).map(|i| Vec3::from(image.rgb(i))).sum::<Vec3>() / count
    }

    #[test]
    fn a_glossy_truth_is_the_diffuse_one_for_lambert_and_the_mirrors_for_the_smoothest() {
        let (scene, camera) = ball();
        let renderer = TruthRenderer::new(&scene, scene.object("ball").unwrap()).unwrap();
        let trace = TraceSettings { samples_per_pixel: 64, max_bounces: 2, seed: 3 };
        let mut view = renderer.view(&camera, &[Truth::OneReflection], &trace, &Unattended).unwrap();
        let lambert: AnalyticBrdf = Lambert::new(Vec3::new(0.6, 0.4, 0.2)).unwrap().into();
        let smooth: AnalyticBrdf = CookTorrance::new(Vec2::splat(1e-4), Vec3::ONE, Vec3::ONE).unwrap().into();
        let brdfs = [lambert, smooth, lambert].map(|brdf| (brdf.into(), brdf.into()));
        renderer.add_glossy(&mut view, &camera, &brdfs, &trace, &Unattended).unwrap();
        assert_eq!(view.glossy.len(), 2);
        for (brdf, truth) in [(lambert, Truth::Diffuse), (smooth, Truth::OneReflection)] {
            let (glossy, expected) = (view.glossy(brdf.into()).unwrap(), &view.images[&truth]);
            // 200 pixels of 64 paths: 1 % of the mean in noise.
            let ratio = mean(glossy, &view.mask) / mean(expected, &view.mask);
            assert!((ratio - 1.0).abs().max_element() < 0.03, "{truth:?}: {ratio}");
            let around = (0..view.object.len()).filter(|i| !view.object[*i]);
            around.for_each(|i| assert_eq!(glossy.rgb(i), expected.rgb(i)));
        }
        assert!(view.glossy(AnalyticBrdf::from(Lambert::new(Vec3::ONE).unwrap()).into()).is_none());
    }

    #[test]
    fn only_pixels_with_eight_neighbours_on_the_same_fold_count() {
        let count =
            |object: &[bool], joined: &dyn Fn(usize, usize) -> bool| inside_silhouettes(object, 5, joined).iter().filter(|m| **m).count();
        let full = vec![true; 25];
        assert_eq!(count(&full, &|_, _| true), 9);
        let mut holed = full.clone();
        holed[12] = false;
        assert_eq!(count(&holed, &|_, _| true), 0);
        // A fold between the second and the third column: those beside it do not count.
        assert_eq!(count(&full, &|a, b| (a % 5 < 2) == (b % 5 < 2)), 3);
    }

    #[test]
    fn pixels_that_show_the_objects_back_do_not_count() {
        let (scene, above) = ball();
        let renderer = TruthRenderer::new(&scene, scene.object("floor").unwrap()).unwrap();
        let trace = TraceSettings { samples_per_pixel: 1, max_bounces: 1, seed: 3 };
        let counted = |camera| {
            let view = renderer.view(camera, &[], &trace, &Unattended).unwrap();
            (view.object.iter().filter(|o| **o).count() > 100, view.mask.iter().filter(|m| **m).count())
        };
        let (is_seen, count) = counted(&above);
        assert!(is_seen && count > 10, "{is_seen}, {count}");
        assert_eq!(counted(&scene.cameras[1].camera), (true, 0));
    }

    #[test]
    fn a_sphere_is_smooth_and_a_ledge_before_it_is_not() {
        let on_sphere = |angle: f32| (Vec3::new(angle.sin(), 0.0, angle.cos()), Vec3::new(angle.sin(), 0.0, angle.cos()));
        assert!(smoothly_joined(on_sphere(1.2), on_sphere(1.5)) && smoothly_joined(on_sphere(0.3), on_sphere(0.3)));
        // The same normal, further away along the ray.
        let ledge = (Vec3::new(0.01, 0.0, 0.5), Vec3::new(0.3, 0.0, 0.954));
        assert!(!smoothly_joined(on_sphere(0.0), ledge));
        assert!(!smoothly_joined(on_sphere(0.0), (Vec3::new(0.01, 0.0, 1.0), Vec3::X)));
    }
}
