//! What is around the new object, read from a light field that was captured around another.
//!
//! A point of the surroundings whose light is another now (`changed_light.rs`) has its proxy's. Any other is looked up, in an order that can be chosen, in the cube maps of sample points that see it, in the baseline's, which
//! was taken without the old object, or in the proxies' baked light. A cube map sees a point where its stored distances agree with how far the
//! point is, and shows nothing of the old object around it (`old_object.rs`). Of sample points those come first that see it most as the new one
//! does (Buehler et al. 2001, "Unstructured lumigraph rendering": angle, and loss of resolution).

use std::cmp::Ordering;

use glam::Vec3;

use super::super::OffsetSurfaceLightField;
use super::super::corrected::{InverseDistances, MOST_DISAGREEMENT, MOST_STEEPNESS, disagreement};
use super::super::reference::{Asides, PagedCubes, PagesTouched};
use super::old_object::OldObject;
use super::stage::Met;
use crate::directions::bilinear_footprint;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::Stack;
use crate::representations::{CountingSource, RenderError};

/// Sample points asked for a point of the surroundings, one after the other.
const ASKED: usize = 8;
/// The nearest of them to a new sample point, of which those are chosen.
const POOL: usize = 1024;

/// Where light of the surroundings is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Surrounding {
    /// In the cube maps of sample points.
    CubeMaps,
    /// In the one taken without the old object.
    Baseline,
    /// In the baked light of what is around the object.
    Background,
}

/// From which a texel's light came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Source {
    Object,
    Infinity,
    Light(Surrounding),
    /// A surface that is not diffuse, which no cube map sees: black.
    Unknown,
}

/// A light field's light without its object.
pub(super) struct Surroundings<'a> {
    field: &'a OffsetSurfaceLightField,
    pages: &'a CountingSource<'a>,
    touched: PagesTouched,
    old: OldObject,
}

/// What a thread reads it with.
pub(super) struct LightReader<'a> {
    cubes: PagedCubes<'a>,
    stack: Stack,
}

impl LightReader<'_> {
    pub fn stack(&mut self) -> &mut Stack {
        &mut self.stack
    }
}

impl<'a> Surroundings<'a> {
    /// Finds out which texels show the old object.
    pub fn new(field: &'a OffsetSurfaceLightField, pages: &'a CountingSource<'a>, progress: &dyn Progress) -> Result<Self, Cancelled> {
        let old = OldObject::new(field, progress)?;
        Ok(Self { field, pages, touched: PagesTouched::new(field.page_count()), old })
    }

    pub fn reader(&self) -> LightReader<'_> {
        LightReader { cubes: PagedCubes::new(self.field, self.pages, &self.touched, Asides::default()), stack: Stack::new() }
    }

    /// Sample points that may see what a new one at `position` sees.
    pub fn pool(&self, position: Vec3) -> Vec<u16> {
        let distance = |j: &u16| self.field.sample_points[usize::from(*j)].position.distance_squared(position);
        let mut nearest: Vec<u16> = (0..self.field.sample_points.len() as u16).collect();
        if nearest.len() > POOL {
            nearest.select_nth_unstable_by(POOL - 1, |a, b| by_value(&(distance(a), *a), &(distance(b), *b)));
            nearest.truncate(POOL);
        }
        nearest
    }

    /// Those of the pool that see `point` best as it is seen from `from`, best first; fewer than [`ASKED`] where fewer do not show the old object there.
    pub fn ranked(&self, pool: &[u16], from: Vec3, point: Vec3) -> Vec<u16> {
        let (to_from, distance) = (from - point).normalize_and_length();
        let mut ranked: Vec<(f32, u16)> = Vec::with_capacity(pool.len());
        for &j in pool {
            let offset = point - self.field.sample_points[usize::from(j)].position;
            if self.shows_the_old_object(u32::from(j), offset) {
                continue;
            }
            let length = offset.length();
            let angle = (to_from + offset / length).length();
            ranked.push((angle + (length / distance - 1.0).max(0.0), j));
        }
        if ranked.len() > ASKED {
            ranked.select_nth_unstable_by(ASKED - 1, by_value);
            ranked.truncate(ASKED);
        }
        ranked.sort_unstable_by(by_value);
        ranked.into_iter().map(|(_, j)| j).collect()
    }

    /// Radiance of what was met, and where it was read; `candidates` are asked in their order.
    pub fn seen(
        &self,
        met: &Met,
        order: [Surrounding; 3],
        candidates: &[u16],
        light: &mut LightReader<'_>,
    ) -> Result<(Vec3, Source), RenderError> {
        if met.is_changed && met.is_known {
            return Ok((met.radiance, Source::Light(Surrounding::Background)));
        }
        for surrounding in order {
            let found = match surrounding {
                Surrounding::CubeMaps => self.first_that_sees(met.position, candidates, light)?,
                Surrounding::Baseline => self.baseline(met.position, light)?,
                Surrounding::Background => met.is_known.then_some(met.radiance),
            };
            if let Some(radiance) = found {
                return Ok((radiance, Source::Light(surrounding)));
            }
        }
        Ok((Vec3::ZERO, Source::Unknown))
    }

    /// What a surface sends on, without what it emits: as baked, which is smooth enough for irradiance; of surfaces that are not diffuse as the
    /// baseline sees it.
    pub fn reflected(&self, met: &Met, light: &mut LightReader<'_>) -> Result<Vec3, RenderError> {
        if met.is_known {
            return Ok(met.radiance - met.emission);
        }
        Ok(self.baseline(met.position, light)?.unwrap_or(Vec3::ZERO))
    }

    fn first_that_sees(&self, point: Vec3, candidates: &[u16], light: &mut LightReader<'_>) -> Result<Option<Vec3>, RenderError> {
        for &j in candidates {
            let offset = point - self.field.sample_points[usize::from(j)].position;
            if !self.shows_the_old_object(u32::from(j), offset)
                && let Some(radiance) = radiance_of(u32::from(j), offset, &mut light.cubes)?
            {
                return Ok(Some(radiance));
            }
        }
        Ok(None)
    }

    fn baseline(&self, point: Vec3, light: &mut LightReader<'_>) -> Result<Option<Vec3>, RenderError> {
        let offset = point - Vec3::from(self.field.parameters.object_center);
        radiance_of(self.field.sample_points.len() as u32, offset, &mut light.cubes)
    }

    fn shows_the_old_object(&self, cube: u32, direction: Vec3) -> bool {
        let footprint = bilinear_footprint(direction, self.field.parameters.face_size_texels as usize);
        footprint.into_iter().any(|(texel, weight)| weight > 0.0 && self.old.is_in(cube, texel))
    }
}

/// What a cube map shows of the point at `offset` from it; None where it shows something else.
fn radiance_of(cube: u32, offset: Vec3, cubes: &mut PagedCubes<'_>) -> Result<Option<Vec3>, RenderError> {
    let (texels, footprint) = cubes.texels_around(cube, offset, 0)?;
    let seen = InverseDistances::of(std::array::from_fn(|k| (texels[k][3], footprint[k].1)));
    // Phrased so that NaN sees nothing.
    let sees = disagreement(1.0 / offset.length(), seen.mean) < MOST_DISAGREEMENT && disagreement(seen.least, seen.most) < MOST_STEEPNESS;
    let radiance: Vec3 = texels.iter().zip(&footprint).map(|(texel, (_, weight))| *weight * Vec3::from_slice(texel)).sum();
    Ok((sees && radiance.is_finite()).then_some(radiance))
}

fn by_value(a: &(f32, u16), b: &(f32, u16)) -> Ordering {
    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
}
