//! Path-traced images to compare with, of three kinds.

use std::collections::BTreeMap;

use glam::Vec3;
use serde::Serialize;

use crate::geometry::Camera;
use crate::images::Image;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{Appearance, TraceError, TraceSettings, Tracer};
use crate::representations::Settings;
use crate::scenes::Scene;

/// What is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Truth {
    /// The object as a diffuse surface.
    Diffuse,
    /// One mirror reflection on the object over the diffuse scene: what an offset surface light field should converge to.
    OneReflection,
    /// The object as a mirror that sees itself as a mirror.
    PhysicalMirror,
}

impl Truth {
    /// As serialised.
    pub fn name(self) -> &'static str {
        match self {
            Self::Diffuse => "diffuse",
            Self::OneReflection => "one_reflection",
            Self::PhysicalMirror => "physical_mirror",
        }
    }

    fn appearance(self) -> Appearance {
        match self {
            Self::Diffuse => Appearance::Diffuse,
            Self::OneReflection => Appearance::OneMirror { reflectance: Vec3::ONE },
            Self::PhysicalMirror => Appearance::PhysicalMirror { reflectance: Vec3::ONE },
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
    /// Pixels that count: the object fills them and their eight neighbours.
    pub mask: Vec<bool>,
    object: Vec<bool>,
}

impl TruthRenderer {
    /// `object` indexes `scene.objects`.
    pub fn new(scene: &Scene, object: usize) -> Result<Self, TraceError> {
        Ok(Self { tracer: Tracer::new(scene)?, object })
    }

    /// The truths in `wanted`, and the diffuse one, seen from `camera`. Around the object, where nothing is compared, with a 16th of the
    /// paths.
    pub fn view(&self, camera: &Camera, wanted: &[Truth], trace: &TraceSettings, progress: &dyn Progress) -> Result<ViewTruth, Cancelled> {
        let around = TraceSettings { samples_per_pixel: trace.samples_per_pixel.div_ceil(PATHS_PER_PATH_AROUND), ..*trace };
        let all = self.with(Truth::Diffuse).render(camera, &around, progress)?;
        let object: Vec<bool> = all.object.iter().map(|o| *o == self.object as u32).collect();
        let mask = eroded(&object, all.radiance.width);
        let mut images = BTreeMap::new();
        for truth in [Truth::Diffuse].iter().chain(wanted) {
            if !images.contains_key(truth) {
                let width = all.radiance.width;
                let shows_object = |column, row| object[row * width + column];
                let traced = self.with(*truth).render_where(&shows_object, camera, trace, progress)?;
                let mut image = all.radiance.clone();
                (0..object.len()).filter(|i| object[*i]).for_each(|i| image.set_rgb(i, traced.radiance.rgb(i)));
                images.insert(*truth, image);
            }
        }
        Ok(ViewTruth { images, mask, object })
    }

    fn with(&self, truth: Truth) -> Tracer {
        self.tracer.with_appearance(self.object, truth.appearance())
    }
}

impl ViewTruth {
    /// What a frame with `settings` should look like: the diffuse part, the reflected part times C_s, or their sum on the object;
    /// around the object always the diffuse scene. `truth` was among those wanted.
    pub fn reference(&self, settings: &Settings, truth: Truth) -> Image {
        let mut image = self.images[&Truth::Diffuse].clone();
        let Some((reflectance, keep_diffuse)) = settings.reflection() else { return image };
        let mirror = &self.images[&truth];
        for i in (0..self.object.len()).filter(|i| self.object[*i]) {
            let diffuse = if keep_diffuse { Vec3::from(image.rgb(i)) } else { Vec3::ZERO };
            image.set_rgb(i, (diffuse + reflectance * Vec3::from(mirror.rgb(i))).to_array());
        }
        image
    }
}

// True where the pixel and its eight neighbours are.
fn eroded(mask: &[bool], width: usize) -> Vec<bool> {
    let height = mask.len() / width;
    let inside = |i: usize| {
        let (row, column) = (i / width, i % width);
        if row == 0 || column == 0 || row + 1 == height || column + 1 == width {
            return false;
        }
        (row - 1..=row + 1).all(|r| mask[r * width + column - 1..=r * width + column + 1].iter().all(|m| *m))
    };
    (0..mask.len()).map(inside).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn erosion_keeps_only_pixels_with_eight_neighbours() {
        let full = vec![true; 25];
        assert_eq!(eroded(&full, 5).iter().filter(|m| **m).count(), 9);
        let mut holed = full;
        holed[12] = false;
        assert_eq!(eroded(&holed, 5).iter().filter(|m| **m).count(), 0);
    }
}
