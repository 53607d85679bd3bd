//! Frames in other light: the environment turned, point lights added. `relight.wgsl` has the functions of shading by the same names; tables
//! are made here for both twins.
//!
//! Stored distances tell what is environment (infinitely far) and what is near. Reads of mirror and glossy frames keep what is near as it is
//! stored, and in place of what came from infinity take the environment that the dataset was made in, turned: a texel shows
//! `L − w·E(d) + w·E(R⁻¹ d)`, w the share of it through which light comes from infinity (0 or 1 in the finest level).
//!
//! The reconstruction was lit by the old light. A diffuse surface shows `L = ρ/π · E`, E its irradiance, so what it shows in other light is
//! `L + ρ/π · (E' − E)`, `ρ/π = L / E`, at most 1/π. E and E' are had from the cube maps of the four sample points: each one's irradiance on a
//! plane of normal n is taken for `n · D`, D the vector irradiance `∫ L l dl` above its own horizon, exact for its own normal.
//!
//! A point light adds `f_r · cos · I / d²` where it is seen: the ray toward it is followed through each sample point's stored distances, as
//! reflected rays are (`corrected.rs`); sample points that know nothing of that ray look at the light themselves.
//!
//! Where it fails: what is near, and the object where it is seen in itself, keeps the old light (lamps and sunlit patches in a mirror, light
//! from the floor); shadows that the old light cast on the object fade with the distance between sample points; a point light is not
//! seen in mirrors; a texel at the rim of what is near may keep a share of an old sun.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::corrected::first_surface;
use super::reference::{Asides, PagedCubes, PagesTouched};
use super::shade::{ReadCube, Shaded, Sight, toward};
use super::{Component, NO_SAMPLE, OffsetSurfaceLightField, Settings};
use crate::capture::sky_share;
use crate::directions::{FACES, Footprint, Texel, bilinear_footprint, direction_from_face, texel_direction, texel_solid_angle};
use crate::representations::RenderError;
use crate::representations::page_source::CountingSource;
use crate::scenes::{Environment, Relighting};
use crate::textures::PageId;

/// The finest face of an environment's cube map; datasets with larger ones begin with their next level.
const MOST_TEXELS: u32 = 256;
/// Directions of an irradiance: so many a face along its edge. A clamped cosine is smooth.
const GRID: usize = 8;
/// Of a point light's distance: what is met so little before it does not hide it.
const TOLERANCE: f32 = 0.05;

/// The environment as a cube map whose levels are those of the dataset's.
#[derive(Debug)]
pub(super) struct EnvironmentCube {
    /// The dataset's level that its first has the size of.
    pub base: u32,
    /// Of the first level, an edge.
    pub size: u32,
    /// `[(first_row(level) + face · size + row) · width + column]`, width the first level's: one picture, levels below each other.
    pub texels: Vec<Vec3>,
}

impl EnvironmentCube {
    fn new(environment: &Environment, field: &OffsetSurfaceLightField) -> Self {
        let (face_size, coarser) = (field.parameters.face_size_texels, field.parameters.coarser_levels);
        let base = u32::from(face_size > MOST_TEXELS);
        let size = field.level_size(base);
        let mut cube = Self { base, size, texels: Vec::new() };
        let levels = (coarser + 1).saturating_sub(base).max(1);
        let width = size as usize;
        cube.texels = vec![Vec3::ZERO; width * cube.first_row(levels) as usize];
        let texel = |at: usize| {
            environment_over(environment, width, Texel { face: at / width / width, row: at / width % width, column: at % width })
        };
        let finest: Vec<Vec3> = (0..FACES * width * width).into_par_iter().map(texel).collect();
        cube.texels[..finest.len()].copy_from_slice(&finest);
        for level in 1..levels {
            let (rows, columns) = (FACES as u32 * (size >> level), size >> level);
            for (row, column) in (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c))) {
                let finer = |y: u32, x: u32| cube.texels[cube.index(level - 1, 2 * row + y, 2 * column + x)];
                let mean = 0.25 * (finer(0, 0) + finer(0, 1) + (finer(1, 0) + finer(1, 1)));
                let at = cube.index(level, row, column);
                cube.texels[at] = mean;
            }
        }
        cube
    }

    /// Texels that such a field's has.
    #[cfg(feature = "gpu")]
    fn texel_count(field: &OffsetSurfaceLightField) -> usize {
        let base = u32::from(field.parameters.face_size_texels > MOST_TEXELS);
        let size = field.level_size(base);
        let levels = (field.parameters.coarser_levels + 1).saturating_sub(base).max(1);
        2 * FACES * (size - (size >> levels)) as usize * size as usize
    }

    /// Rows before a level: sizes halve exactly.
    fn first_row(&self, level: u32) -> u32 {
        2 * FACES as u32 * (self.size - (self.size >> level))
    }

    fn index(&self, level: u32, row: u32, column: u32) -> usize {
        ((self.first_row(level) + row) * self.size + column) as usize
    }

    /// Its level of the size of the dataset's.
    fn level(&self, level: u32) -> u32 {
        level.max(self.base) - self.base
    }

    fn texel(&self, level: u32, face: usize, row: usize, column: usize) -> Vec3 {
        let level = self.level(level);
        self.texels[self.index(level, face as u32 * (self.size >> level) + row as u32, column as u32)]
    }

    /// Radiance from a direction at the dataset's level `level`: bilinear and seamless.
    pub fn environment_toward(&self, direction: Vec3, level: u32) -> Vec3 {
        let size = (self.size >> self.level(level)) as usize;
        bilinear_footprint(direction, size).into_iter().map(|(t, weight)| weight * self.texel(level, t.face, t.row, t.column)).sum()
    }

    /// What of a texel's radiance is not from infinity. In the finest level shares are 0 or 1.
    fn near_light(&self, radiance: Vec3, share: f32, level: u32, (face, row, column): (usize, usize, usize)) -> Vec3 {
        match share {
            s if s >= 1.0 => Vec3::ZERO,
            s if s > 0.0 => (radiance - s * self.texel(level, face, row, column)).max(Vec3::ZERO),
            _ => radiance,
        }
    }

    /// A read of four texels as it is after the turn.
    pub fn after(&self, turned: &Relighting, texels: &[[f32; 4]; 4], footprint: &Footprint, direction: Vec3, level: u32) -> Vec3 {
        let (mut near, mut sky) = (Vec3::ZERO, 0.0);
        for (texel, (at, weight)) in texels.iter().zip(footprint) {
            let share = sky_share(texel[3], level);
            near += *weight * self.near_light(Vec3::from_slice(texel), share, level, (at.face, at.row, at.column));
            sky += *weight * share;
        }
        near + sky * self.environment_toward(turned.before(direction), level)
    }
}

/// The environment's mean over a texel of faces with `size` texels an edge, looked at as close as the map's own texels lie: a sun of one of them
/// is not missed.
pub(super) fn environment_over(environment: &Environment, size: usize, texel: Texel) -> Vec3 {
    let map_width = match environment {
        Environment::Constant(radiance) => return *radiance,
        Environment::Map(map) => map.image.width,
    };
    let steps = map_width.div_ceil(4 * size).clamp(1, MOST_STEPS);
    let place = |k: usize| Vec2::new((k % steps) as f32 + 0.5, (k / steps) as f32 + 0.5) / steps as f32;
    let toward = |k: usize| texel_direction(texel.face, size, texel.column as f32 + place(k).x, texel.row as f32 + place(k).y);
    (0..steps * steps).map(|k| environment.radiance(toward(k))).sum::<Vec3>() / (steps * steps) as f32
}

// Along each edge of a texel.
const MOST_STEPS: usize = 8;

/// Per channel the vector irradiance at a sample point from above its horizon.
pub(super) type VectorIrradiance = [Vec3; 3];

/// What of irradiance can be known before the light is chosen.
#[derive(Debug)]
struct Irradiance {
    stored: Vec<VectorIrradiance>,
    near: Vec<VectorIrradiance>,
    /// By sample point and direction of the grid, in 255ths.
    shares: Vec<u8>,
}

/// Of each sample point, as stored and in the light that is shown.
#[derive(Debug, Clone, Copy)]
pub(super) struct StoredAndShown {
    pub stored: VectorIrradiance,
    pub shown: VectorIrradiance,
}

impl Irradiance {
    fn new(field: &OffsetSurfaceLightField, environment: &EnvironmentCube, pages: &CountingSource<'_>) -> Result<Self, RenderError> {
        // The coarsest level that is fine enough for the grid.
        let level = (0..=field.parameters.coarser_levels).rev().find(|l| field.level_size(*l) >= GRID as u32).unwrap_or(0);
        let touched = PagesTouched::new(field.page_count());
        let start = || PagedCubes::new(field, pages, &touched, Asides::default());
        let point = |cubes: &mut PagedCubes<'_>, cube: usize| {
            let (mut stored, mut near) = ([Vec3::ZERO; 3], [Vec3::ZERO; 3]);
            let mut shares = Vec::with_capacity(DIRECTIONS);
            for (direction, solid_angle) in grid() {
                let (texels, footprint) = cubes.texels_around(cube as u32, direction, level)?;
                let (mut light, mut near_light, mut share) = (Vec3::ZERO, Vec3::ZERO, 0.0);
                for (texel, (at, weight)) in texels.iter().zip(&footprint) {
                    let radiance = Vec3::from_slice(texel);
                    let sky = sky_share(texel[3], level);
                    light += *weight * radiance;
                    near_light += *weight * environment.near_light(radiance, sky, level, (at.face, at.row, at.column));
                    share += *weight * sky;
                }
                shares.push((255.0 * share + 0.5) as u8);
                if direction.dot(field.sample_points[cube].normal) > 0.0 {
                    add(&mut stored, light, solid_angle * direction);
                    add(&mut near, near_light, solid_angle * direction);
                }
            }
            Ok((stored, near, shares))
        };
        let points = 0..field.sample_points.len();
        let points: Vec<_> = points.into_par_iter().map_init(start, point).collect::<Result<_, RenderError>>()?;
        let mut irradiance = Self { stored: Vec::new(), near: Vec::new(), shares: Vec::new() };
        for (stored, near, shares) in points {
            irradiance.stored.push(stored);
            irradiance.near.push(near);
            irradiance.shares.extend(shares);
        }
        Ok(irradiance)
    }

    fn in_light(&self, light: &Relighting, field: &OffsetSurfaceLightField, environment: &EnvironmentCube) -> Vec<StoredAndShown> {
        if !light.turns() {
            return self.stored.iter().map(|stored| StoredAndShown { stored: *stored, shown: *stored }).collect();
        }
        // The level whose texels are those of the grid, or the nearest.
        let level = (0..=field.parameters.coarser_levels).rev().find(|l| field.level_size(*l) >= GRID as u32).unwrap_or(0);
        let sky: Vec<(Vec3, f32, Vec3)> =
            grid().map(|(d, solid_angle)| (d, solid_angle, environment.environment_toward(light.before(d), level))).collect();
        let shown = |cube: usize| {
            let mut shown = self.near[cube];
            for ((direction, solid_angle, radiance), share) in sky.iter().zip(&self.shares[DIRECTIONS * cube..]) {
                if *share > 0 && direction.dot(field.sample_points[cube].normal) > 0.0 {
                    add(&mut shown, f32::from(*share) / 255.0 * *radiance, *solid_angle * *direction);
                }
            }
            StoredAndShown { stored: self.stored[cube], shown }
        };
        (0..self.stored.len()).into_par_iter().map(shown).collect()
    }
}

const DIRECTIONS: usize = FACES * GRID * GRID;

/// Directions and their solid angles, the sphere in all.
fn grid() -> impl Iterator<Item = (Vec3, f32)> {
    (0..DIRECTIONS).map(|at| {
        let (face, row, column) = (at / GRID / GRID, at / GRID % GRID, at % GRID);
        let place = |c: usize| (2 * c + 1) as f32 / GRID as f32 - 1.0;
        (direction_from_face(face, place(column), place(row)).normalize(), texel_solid_angle(GRID, column, row))
    })
}

fn add(irradiance: &mut VectorIrradiance, radiance: Vec3, along: Vec3) {
    irradiance.iter_mut().zip(radiance.to_array()).for_each(|(vector, radiance)| *vector += radiance * along);
}

/// What frames in other light are made from: read when the first is asked for, kept from then on.
#[derive(Debug, Default)]
pub(super) struct LightTables {
    environment: OnceLock<Arc<EnvironmentCube>>,
    irradiance: OnceLock<Irradiance>,
    // Of the light that was shown last.
    shown: Mutex<Option<(Relighting, Arc<Vec<StoredAndShown>>)>>,
}

/// What a sample point takes: irradiances as stored, of what is near, and as shown twice, while one turn replaces another; and its shares.
#[cfg(feature = "gpu")]
const BYTES_OF_A_POINT: usize = 2 * size_of::<VectorIrradiance>() + 2 * size_of::<StoredAndShown>() + DIRECTIONS;

/// Only what is diffuse is changed as a whole.
fn needs_irradiance(settings: &Settings) -> bool {
    match settings.component {
        Component::Reconstruction | Component::Full => true,
        Component::Mirror | Component::Glossy(_) | Component::Refraction(_) => false,
    }
}

/// How a frame is lit.
#[derive(Debug, Clone)]
pub(super) struct Lit {
    pub light: Relighting,
    pub environment: Arc<EnvironmentCube>,
    /// Of each sample point; empty where only reflections are shown.
    pub irradiance: Arc<Vec<StoredAndShown>>,
}

impl LightTables {
    /// Texels of the environment's cube map and sample points whose irradiance is needed, for a frame with these settings.
    #[cfg(feature = "gpu")]
    pub fn texels(field: &OffsetSurfaceLightField, settings: &Settings) -> (usize, usize) {
        let irradiances = if needs_irradiance(settings) { field.sample_points.len() } else { 0 };
        (EnvironmentCube::texel_count(field), irradiances)
    }

    /// At most, in memory, once such a frame was made ready.
    #[cfg(feature = "gpu")]
    pub fn bytes_for(field: &OffsetSurfaceLightField, settings: &Settings) -> u64 {
        let (environment, irradiances) = Self::texels(field, settings);
        (environment * size_of::<Vec3>() + irradiances * BYTES_OF_A_POINT) as u64
    }

    /// In memory.
    #[cfg(feature = "gpu")]
    pub fn bytes(&self) -> u64 {
        let environment = self.environment.get().map_or(0, |environment| environment.texels.len());
        let irradiances = self.irradiance.get().map_or(0, |irradiance| irradiance.stored.len());
        (environment * size_of::<Vec3>() + irradiances * BYTES_OF_A_POINT) as u64
    }

    /// For a frame with these settings; None where its light is as stored.
    pub fn lit(
        &self,
        field: &OffsetSurfaceLightField,
        settings: &Settings,
        pages: &CountingSource<'_>,
    ) -> Result<Option<Arc<Lit>>, RenderError> {
        let light = settings.light;
        if !light.changes_light() {
            return Ok(None);
        }
        if field.parameters.coarser_levels > 0 && pages.page(PageId(field.level_page(0, 1)))?.shape().channels < 4 {
            return Err(RenderError::NoSkyShares);
        }
        let environment = self.environment.get_or_init(|| Arc::new(EnvironmentCube::new(&field.background.environment, field))).clone();
        let irradiance = match needs_irradiance(settings) {
            true => self.irradiance(field, &light, &environment, pages)?,
            false => Arc::default(),
        };
        Ok(Some(Arc::new(Lit { light, environment, irradiance })))
    }

    fn irradiance(
        &self,
        field: &OffsetSurfaceLightField,
        light: &Relighting,
        environment: &EnvironmentCube,
        pages: &CountingSource<'_>,
    ) -> Result<Arc<Vec<StoredAndShown>>, RenderError> {
        let mut shown = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, irradiance)) = shown.as_ref().filter(|(of, _)| of.environment_turn() == light.environment_turn()) {
            return Ok(irradiance.clone());
        }
        // Under the lock: read once, whoever asks.
        let known = match self.irradiance.get() {
            Some(known) => known,
            None => {
                let new = Irradiance::new(field, environment, pages)?;
                self.irradiance.get_or_init(|| new)
            }
        };
        let irradiance = Arc::new(known.in_light(light, field, environment));
        *shown = Some((*light, irradiance.clone()));
        Ok(irradiance)
    }
}

/// The diffuse radiance `own` of the surface's point as it is in the light that is shown.
pub(super) fn relit(
    field: &OffsetSurfaceLightField,
    lit: &Lit,
    at: &Sight,
    candidates: [u16; 4],
    own: Shaded,
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (x, n) = (at.position, at.normal);
    let (mut stored, mut shown, mut sum) = (Vec3::ZERO, Vec3::ZERO, 0.0);
    for j in candidates.into_iter().filter(|j| *j != NO_SAMPLE) {
        let weight = nearness(x, n, field.sample_points[usize::from(j)].position);
        let irradiance = &lit.irradiance[usize::from(j)];
        stored += weight * plane_irradiance(&irradiance.stored, n);
        shown += weight * plane_irradiance(&irradiance.shown, n);
        sum += weight;
    }
    if !(sum > 0.0) {
        return Ok(own);
    }
    // ρ/π over the weights' sum, which cancels; where no light was, nothing can be told.
    let reflectance = Vec3::select(stored.cmpgt(Vec3::ZERO), own.radiance / stored, Vec3::ZERO);
    let reflectance = reflectance.min(Vec3::splat(MOST_REFLECTANCE / sum));
    let mut added = shown - stored;
    for light in lit.light.point_lights() {
        let to_light = light.position - x;
        let squared = to_light.length_squared();
        let cosine = n.dot(to_light) / squared.sqrt();
        if cosine > 0.0 {
            let seen = light_visibility(field, at, candidates, light.position, cubes)?;
            added += sum * (seen * cosine / squared) * light.intensity;
        }
    }
    Ok(Shaded { radiance: (own.radiance + reflectance * added).max(Vec3::ZERO), ..own })
}

/// ρ/π of a surface that reflects everything.
const MOST_REFLECTANCE: f32 = std::f32::consts::FRAC_1_PI;

/// `n · D` of each channel.
fn plane_irradiance(vectors: &VectorIrradiance, n: Vec3) -> Vec3 {
    Vec3::new(vectors[0].dot(n), vectors[1].dot(n), vectors[2].dot(n)).max(Vec3::ZERO)
}

/// Weight of a sample point for a surface's point: as for depth-corrected reads.
fn nearness(x: Vec3, n: Vec3, p: Vec3) -> f32 {
    let cosine = n.dot(toward(x, p, n)).max(0.0);
    (cosine * cosine) * (cosine * cosine) / (x - p).length_squared().max(LEAST_SQUARE)
}

// Of the distance to a sample point: one that lies in the surface has no infinite weight.
const LEAST_SQUARE: f32 = 1e-12;

/// How much of a point light at y the surface's point sees, 0 to 1: the share of its sample points, by nearness, that know of nothing
/// between.
pub(super) fn light_visibility(
    field: &OffsetSurfaceLightField,
    at: &Sight,
    candidates: [u16; 4],
    y: Vec3,
    cubes: &mut dyn ReadCube,
) -> Result<f32, RenderError> {
    let (x, n) = (at.position, at.normal);
    let distance = (y - x).length();
    let r = (y - x) / distance;
    let (mut seen, mut sum) = (0.0, 0.0);
    for j in candidates.into_iter().filter(|j| *j != NO_SAMPLE) {
        let p = field.sample_points[usize::from(j)].position;
        let weight = nearness(x, n, p);
        let met = first_surface(u32::from(j), p, x, r, cubes)?;
        let hides = if met >= 0.0 {
            met * distance
        } else {
            // Nothing is known of the ray: whether the light is seen from p.
            cubes.inverse_distances(u32::from(j), y - p)?.mean * (y - p).length()
        };
        seen += if hides < 1.0 + TOLERANCE { weight } else { 0.0 };
        sum += weight;
    }
    Ok(if sum > 0.0 { seen / sum } else { 0.0 })
}
