//! Depth-corrected reads: toward the point that is reflected, not along the reflected direction. `corrected.wgsl` has the same functions by
//! the same names.
//!
//! What x mirrors lies on the ray x + t·r. A sample point p sees the ray's points in the directions `(1 − s)·e + s·r`, e the unit vector
//! from p to x, `t = |x − p|·s / (1 − s)`: s = 0 is x, s = 1 infinitely far. Where the ray enters a surface follows from p's stored distances
//! (distance impostors: Szirmay-Kalos and others 2005), compared as inverse distances, which are finite toward the sky and linear over
//! a plane. What the ray meets first, as any sample point sees it, x sees; sample points that see something else there are left
//! out, the others weighted by agreement, nearness and height. Where none is left (a ray into a crevice that no sample point looks
//! into), the reads are uncorrected, by the blend `normal` with N = 4, and the answer says so.

use glam::Vec3;

use super::shade::{BlendWeights, NOTHING, ReadCube, Shaded, Sight, blend_weights, blended, normalized, toward, toward_samples};
use super::{Blend, NO_SAMPLE, OffsetSurfaceLightField};
use crate::capture::inverse_distance;
use crate::directions::DirectionDifferential;
use crate::representations::RenderError;
use crate::representations::provenance::Answer;

/// Steps along a ray, the last one infinitely far.
const MARCH_STEPS: u32 = 12;
/// Reads that narrow down where the ray enters a surface.
const REFINEMENTS: u32 = 5;
/// Relative difference of distances from which on a sample point is taken to see something else.
pub(super) const MOST_DISAGREEMENT: f32 = 0.1;
/// Texels side by side that differ more show an edge: between them nothing is known.
pub(super) const MOST_STEEPNESS: f32 = 0.3;
const FALLBACK: Blend = Blend::Normal { exponent: 4.0 };

/// Stored distances around a direction, inverted; 0 where nothing is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InverseDistances {
    /// Bilinear, of the four texels.
    pub mean: f32,
    /// Of the farthest.
    pub least: f32,
    /// Of the nearest.
    pub most: f32,
}

impl InverseDistances {
    /// Of (distance, weight) of four texels.
    pub fn of(texels: [(f32, f32); 4]) -> Self {
        let inverse = texels.map(|(distance, weight)| (inverse_distance(distance), weight));
        Self {
            mean: inverse.iter().map(|(i, weight)| i * weight).sum(),
            least: inverse.iter().fold(f32::INFINITY, |least, (i, _)| least.min(*i)),
            most: inverse.iter().fold(0.0, |most, (i, _)| most.max(*i)),
        }
    }
}

/// Relative difference of two distances, given inverted; 0 where both are infinite.
pub(super) fn disagreement(a: f32, b: f32) -> f32 {
    let larger = a.max(b);
    if larger > 0.0 { (a - b).abs() / larger } else { 0.0 }
}

/// Whether p sees the surface's point x and nothing before or behind it.
pub(super) fn sees(cube: u32, p: Vec3, x: Vec3, cubes: &mut dyn ReadCube) -> Result<bool, RenderError> {
    let offset = x - p;
    Ok(disagreement(1.0 / offset.length(), cubes.inverse_distances(cube, offset)?.mean) < MOST_DISAGREEMENT)
}

/// Inverse distance from x, in direction r, of the surface that the ray enters as p sees it; negative where p cannot tell.
pub(super) fn first_surface(cube: u32, p: Vec3, x: Vec3, r: Vec3, cubes: &mut dyn ReadCube) -> Result<f32, RenderError> {
    let distance = (x - p).length();
    if !(distance > 0.0) {
        return Ok(cubes.inverse_distances(cube, r)?.mean);
    }
    let e = (x - p) / distance;
    // The ray's last point known to lie in front of what p sees, the first one behind it, and how far: differences of inverse distances.
    let (mut front, mut behind, mut gap_front, mut gap_behind) = (0.0, 0.0, 0.0, 0.0);
    let (mut is_in_front, mut step, mut refinements) = (false, 0, 0);
    for _ in 0..MARCH_STEPS + 2 * REFINEMENTS {
        let s = if refinements > 0 {
            front + (behind - front) * (gap_front / (gap_front - gap_behind))
        } else {
            step += 1;
            step as f32 / MARCH_STEPS as f32
        };
        let direction = (1.0 - s) * e + s * r;
        let seen = cubes.inverse_distances(cube, direction)?;
        // Where the ray passes p itself there is no direction, and nothing is nearer.
        let length = direction.length();
        let gap = if length > 0.0 { (1.0 - s) / (distance * length) - seen.mean } else { 1.0 / distance };
        if refinements > 0 {
            refinements -= 1;
            if refinements == 0 {
                if disagreement(seen.least, seen.most) < MOST_STEEPNESS {
                    return Ok((1.0 - s) / (distance * s));
                }
                is_in_front = false;
            }
            // The Illinois rule: the end that stays counts half, so that both come nearer.
            if gap > 0.0 {
                (front, gap_front, gap_behind) = (s, gap, 0.5 * gap_behind);
            } else {
                (behind, gap_behind, gap_front) = (s, gap, 0.5 * gap_front);
            }
        } else if gap > 0.0 {
            (is_in_front, front, gap_front) = (true, s, gap);
        } else if is_in_front {
            (refinements, behind, gap_behind) = (REFINEMENTS, s, gap);
        }
        if refinements == 0 && step == MARCH_STEPS {
            break;
        }
    }
    Ok(-1.0)
}

/// The same of the first surface that any candidate knows of.
fn first_met(
    field: &OffsetSurfaceLightField,
    candidates: [u16; 4],
    x: Vec3,
    r: Vec3,
    cubes: &mut dyn ReadCube,
) -> Result<f32, RenderError> {
    let mut inverse = -1f32;
    for j in candidates.into_iter().filter(|j| *j != NO_SAMPLE) {
        inverse = inverse.max(first_surface(u32::from(j), field.sample_points[usize::from(j)].position, x, r, cubes)?);
    }
    Ok(inverse)
}

/// Weights of the candidates that see the ray's point at this inverse distance; not normalised, all 0 where none does.
fn agreeing_weights(
    field: &OffsetSurfaceLightField,
    candidates: [u16; 4],
    (x, n, r): (Vec3, Vec3, Vec3),
    inverse: f32,
    cubes: &mut dyn ReadCube,
) -> Result<[f32; 4], RenderError> {
    let mut weights = [0.0; 4];
    for (weight, j) in weights.iter_mut().zip(candidates).filter(|(_, j)| *j != NO_SAMPLE) {
        let p = field.sample_points[usize::from(j)].position;
        let look = inverse * (x - p) + r;
        let seen = cubes.inverse_distances(u32::from(j), look)?;
        let agreement = 1.0 - disagreement(inverse / look.length(), seen.mean) / MOST_DISAGREEMENT;
        let cosine = n.dot(toward(x, p, n)).max(0.0);
        *weight = agreement.max(0.0) * (cosine * cosine) * (cosine * cosine) / (x - p).length_squared().max(LEAST_SQUARE);
    }
    Ok(weights)
}

// Of the distance to a sample point: one that lies in the surface has no infinite weight.
const LEAST_SQUARE: f32 = 1e-12;

/// `Σⱼ βⱼ Lᵢ(pⱼ; x + t·r − pⱼ)`, where the ray from x along `r` meets its first surface at t.
pub(super) fn corrected(
    field: &OffsetSurfaceLightField,
    at: &Sight,
    by: &[Sight; 2],
    r: &DirectionDifferential,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (x, n) = (at.position, at.normal);
    let position = |j: u16| field.sample_points[usize::from(j)].position;
    let mut inverse = first_met(field, candidates, x, r.direction, cubes)?;
    let mut blend = BlendWeights { weights: [0.0; 4], answer: Answer::Hit };
    if inverse >= 0.0 {
        blend.weights = normalized(agreeing_weights(field, candidates, (x, n, r.direction), inverse, cubes)?);
    }
    if blend.weights == [0.0; 4] {
        inverse = 0.0;
        blend = blend_weights(FALLBACK, candidates, toward_samples(field, candidates, x, n), n, r.direction);
        if blend.answer == Answer::Unknown {
            return Ok(NOTHING);
        }
        blend.answer = Answer::Filled;
    }
    blended(candidates, &blend, |j| looking(inverse, x - position(j), r, by), cubes)
}

/// How a sample point sees the ray's point, `offset` from it to x: by the inverse distance shorter than `x + t·r − p`, so that it is finite.
fn looking(inverse: f32, offset: Vec3, r: &DirectionDifferential, by: &[Sight; 2]) -> DirectionDifferential {
    let [across, down] = [(by[0], r.across), (by[1], r.down)].map(|(by, turn)| inverse * by.position + turn);
    DirectionDifferential { direction: inverse * offset + r.direction, across, down }
}
