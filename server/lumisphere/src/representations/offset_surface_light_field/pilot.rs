//! What few sample points with small faces tell of where more are needed.
//!
//! Each pilot sample point is left out in turn: what its neighbours show, depth-corrected, at the surface point under it is compared with what it
//! shows itself. Faces of the same size are on both sides, so that the difference is that of the places alone.

use glam::Vec3;
use rayon::prelude::*;

use super::construct::{ConstructError, points_off, visibility};
use super::corrected::{InverseDistances, corrected};
use super::density::{Density, Need};
use super::sample_points::{Spacing, nearest_visible, spacing_of};
use super::shade::{ReadCube, SINGLE, Sight};
use super::{NO_SAMPLE, OffsetSurfaceLightField, Parameters, Placing, SampleMaps, SamplePoint};
use crate::capture::{Background, SurfaceMesh};
use crate::directions::{CubeMap, DirectionDifferential, FACES, Texel, bilinear_footprint, texel_direction, texel_solid_angle};
use crate::progress::{Cancelled, Progress, Silent};
use crate::radiometry::color::Lab;
use crate::raytrace::{TraceSettings, Tracer};
use crate::representations::provenance::Answer;
use crate::representations::{Original, RenderError};
use crate::scenes::Environment;

/// Of the sample points that are asked for: a pilot has a quarter, in these bounds. (More than the most would tell little more, and take memory.)
const PART: f32 = 0.25;
const FEWEST: f32 = 64.0;
const MOST: f32 = 1024.0;
/// Texels along a face.
const FACE_SIZE_TEXELS: u32 = 16;
/// Paths per texel: noise is everywhere, and would make all places alike.
const PATHS: u32 = 16;
/// Pilot sample points around a surface point whose errors are blended.
const NEAREST: usize = 4;

/// Of what a pilot runs ahead.
pub(super) struct PilotSettings {
    pub spacing: Spacing,
    pub face_size_texels: u32,
    pub trace: TraceSettings,
}

/// By the mean errors of L* that the neighbours of pilot sample points make in their place, weighted by the projected area in which each direction is mirrored.
pub(super) fn pilot_errors<'a>(
    surface: &SurfaceMesh,
    settings: &PilotSettings,
    tracer: &Tracer,
    progress: &dyn Progress,
) -> Result<Need<'a>, ConstructError> {
    let asked = match settings.spacing {
        Spacing::Count(count) => count as f32,
        Spacing::Distance(distance) => (spacing_of(surface, 1) / distance).powi(2),
    };
    let count = Spacing::Count((PART * asked).clamp(FEWEST, MOST) as u32);
    let (sample_points, epsilon) = points_off(surface, (count, &Density::uniform()), None, tracer)?;
    let cubes = cube_maps(&sample_points, settings, tracer, progress)?;
    let pilot = Pilot { field: field_of(surface, sample_points, epsilon, cubes[0].size as u32), cubes };
    let visible = visibility(epsilon, tracer);
    let of_point = |j: usize| {
        if progress.is_cancelled() { Err(Cancelled.into()) } else { Ok(pilot.error_without(j, &visible)) }
    };
    let errors: Vec<f32> = (0..pilot.cubes.len()).into_par_iter().map(of_point).collect::<Result<_, ConstructError>>()?;
    let known: Vec<(SamplePoint, f32)> = pilot.field.sample_points.into_iter().zip(errors).collect();
    Ok(Box::new(move |point| blended(&known, &point.at)))
}

fn cube_maps(
    points: &[SamplePoint],
    settings: &PilotSettings,
    tracer: &Tracer,
    progress: &dyn Progress,
) -> Result<Vec<CubeMap>, Cancelled> {
    let size = settings.face_size_texels.min(FACE_SIZE_TEXELS) as usize;
    let mut cubes = Vec::with_capacity(points.len());
    for point in points {
        progress.report("tracing the pilot's cube maps", cubes.len() as u64, points.len() as u64);
        let seed = settings.trace.seed.wrapping_add(cubes.len() as u64);
        let trace = TraceSettings { samples_per_pixel: PATHS, seed, ..settings.trace };
        cubes.push(tracer.cube_map(point.position, size, &trace, &Silent(progress))?);
    }
    progress.report("tracing the pilot's cube maps", points.len() as u64, points.len() as u64);
    Ok(cubes)
}

/// With what depth-corrected reads ask for: no sample maps and no background.
fn field_of(surface: &SurfaceMesh, sample_points: Vec<SamplePoint>, epsilon: f32, face_size_texels: u32) -> OffsetSurfaceLightField {
    let parameters = Parameters {
        object: String::new(),
        epsilon,
        face_size_texels,
        coarser_levels: 0,
        sample_map_size_texels: 0,
        spacing: Spacing::Count(sample_points.len() as u32),
        placing: Placing::Uniform,
        object_center: [0.0; 3],
        samples_per_texel: PATHS,
        max_bounces: 0,
        seed: 0,
        original: Original::Diffuse,
        thinned_from: None,
        replaced: None,
    };
    OffsetSurfaceLightField {
        parameters,
        surface: surface.clone(),
        sample_points,
        sample_maps: SampleMaps { size: 0, indices: Vec::new() },
        background: Background { surfaces: Vec::new(), textures: Vec::new(), environment: Environment::Constant(Vec3::ZERO) },
    }
}

struct Pilot {
    field: OffsetSurfaceLightField,
    cubes: Vec<CubeMap>,
}

impl Pilot {
    /// Mean over the directions above the surface under sample point `j`.
    fn error_without(&self, j: usize, visible: &(dyn Fn(SamplePoint, Vec3) -> bool + Sync)) -> f32 {
        let SamplePoint { position, normal } = self.field.sample_points[j];
        let under = SamplePoint { position: position - self.field.parameters.epsilon * normal, normal };
        let mut others =
            nearest_visible(under, &self.field.sample_points, NEAREST + 1, visible).into_iter().filter(|k| usize::from(*k) != j);
        let others: [u16; 4] = std::array::from_fn(|_| others.next().unwrap_or(NO_SAMPLE));
        let own = [j as u16, NO_SAMPLE, NO_SAMPLE, NO_SAMPLE];
        let at = Sight { position: under.position, normal, direction: -normal };
        let size = self.cubes[j].size;
        let (mut sum, mut weights) = (0f64, 0f64);
        for texel in 0..FACES * size * size {
            let (face, row, column) = (texel / (size * size), texel / size % size, texel % size);
            let direction = texel_direction(face, size, column as f32 + 0.5, row as f32 + 0.5).normalize();
            let cosine = normal.dot(direction);
            if !(cosine > 0.0) {
                continue;
            }
            let toward = DirectionDifferential { direction, across: Vec3::ZERO, down: Vec3::ZERO };
            let shown = |candidates| corrected(&self.field, &at, &[SINGLE; 2], &toward, candidates, &mut Reads(self));
            let (Ok(own), Ok(others)) = (shown(own), shown(others)) else { continue };
            if own.provenance.answer() == Answer::Hit {
                let weight = f64::from(cosine * texel_solid_angle(size, column, row));
                sum += weight * (lightness(own.radiance) - lightness(others.radiance)).abs();
                weights += weight;
            }
        }
        if weights > 0.0 { (sum / weights) as f32 } else { 0.0 }
    }
}

/// Of what is not finite, that of black, as frames show it.
fn lightness(radiance: Vec3) -> f64 {
    let shown = if radiance.is_finite() { radiance } else { Vec3::ZERO };
    Lab::from_linear(shown.to_array()).l
}

struct Reads<'a>(&'a Pilot);

impl ReadCube for Reads<'_> {
    fn read_level(&mut self, cube: u32, direction: Vec3, _level: u32) -> Result<Vec3, RenderError> {
        let map = &self.0.cubes[cube as usize];
        Ok(bilinear_footprint(direction, map.size).iter().map(|(t, weight)| *weight * radiance(map, *t)).sum())
    }

    fn inverse_distances(&mut self, cube: u32, direction: Vec3) -> Result<InverseDistances, RenderError> {
        let map = &self.0.cubes[cube as usize];
        Ok(InverseDistances::of(bilinear_footprint(direction, map.size).map(|(t, weight)| (map.texels[map.index(t)][3], weight))))
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        &self.0.field
    }
}

fn radiance(map: &CubeMap, texel: Texel) -> Vec3 {
    Vec3::from_slice(&map.texels[map.index(texel)])
}

/// Of the nearest that face the same way, by the inverse square of their distances; of all where none does.
fn blended(known: &[(SamplePoint, f32)], at: &SamplePoint) -> f32 {
    let mut nearest = [(f32::INFINITY, 0.0); NEAREST];
    for (point, error) in known.iter().filter(|(point, _)| point.normal.dot(at.normal) > 0.0) {
        let square = point.position.distance_squared(at.position);
        if square < nearest[NEAREST - 1].0 {
            let place = nearest.partition_point(|(other, _)| *other <= square);
            nearest[place..].rotate_right(1);
            nearest[place] = (square, *error);
        }
    }
    let (sum, weights) = nearest.iter().fold((0.0, 0.0), |(sum, weights), (square, error)| {
        let weight = 1.0 / square.max(f32::MIN_POSITIVE);
        (sum + weight * error, weights + weight)
    });
    if weights > 0.0 { sum / weights } else { known.iter().map(|(_, error)| error).sum::<f32>() / known.len() as f32 }
}
