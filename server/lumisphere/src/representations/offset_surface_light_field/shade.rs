//! The CPU reference: a surface point's radiance from the sample points around it. `kernel.wgsl` has the same functions by the same
//! names; numbered equations are in the module's documentation.
//!
//! Powers are computed by our own series (Cephes' `logf` and `expf`, S. L. Moshier), because WGSL leaves the accuracy of `pow` to the
//! device. Invalid indices weigh nothing. What no rule answers is filled and flagged, never passed off as a hit.

use std::sync::Arc;

use glam::Vec3;

use super::bumps::reflecting_at;
use super::corrected::{InverseDistances, corrected, sees};
use super::gloss::glossy;
use super::object_tree::ObjectTree;
use super::reflections::reflections;
use super::refraction::refraction;
use super::relight::{Lit, relit};
use super::{Blend, Component, Filter, NO_SAMPLE, OWN_EXPONENT, OffsetSurfaceLightField, RUNTIME_HORIZON_DEG, Settings};
use crate::directions::{DirectionDifferential, PyramidLevel};
use crate::geometry::{Camera, NormalMap};
use crate::radiometry::brdf::Measured;
use crate::representations::g_buffer::{GBufferPixel, Seen};
use crate::representations::provenance::{Answer, Provenance};
use crate::representations::{Original, RenderError};

/// Reads cube maps.
pub(super) trait ReadCube {
    /// Toward a direction, of one level: bilinear and seamless.
    fn read_level(&mut self, cube: u32, direction: Vec3, level: u32) -> Result<Vec3, RenderError>;

    /// The stored distances of level 0 around a direction.
    fn inverse_distances(&mut self, cube: u32, direction: Vec3) -> Result<InverseDistances, RenderError>;

    /// How the frame is lit; None as it was captured. Reads know of a turned environment, the rest is shading's.
    fn lit(&self) -> Option<Arc<Lit>> {
        None
    }

    /// The object's triangles, where rays meet it once more.
    fn tree(&self) -> Option<Arc<ObjectTree>> {
        None
    }

    /// The measured BRDF of glossy frames.
    fn table(&self) -> Option<Arc<Measured>> {
        None
    }

    /// What turns the surface's normals.
    fn normal_map(&self) -> Option<Arc<NormalMap>> {
        None
    }

    /// The light field whose they are.
    fn field(&self) -> &OffsetSurfaceLightField;

    /// Over what one pixel sees: side by side where that is long, each between two levels.
    fn read_cube(&mut self, cube: u32, toward: &DirectionDifferential) -> Result<Vec3, RenderError> {
        // A single direction is read as it is stored.
        if toward.across == Vec3::ZERO && toward.down == Vec3::ZERO {
            return self.read_level(cube, toward.direction, 0);
        }
        let (taps, PyramidLevel { fine, fraction }) = self.field().reads_over(toward);
        let mut radiance = Vec3::ZERO;
        for tap in 0..taps.count {
            let direction = taps.direction(toward.direction, tap);
            for (level, weight) in [(fine, 1.0 - fraction), (fine + 1, fraction)] {
                if weight > 0.0 {
                    radiance += weight * self.read_level(cube, direction, level)?;
                }
            }
        }
        Ok(radiance / taps.count as f32)
    }
}

/// A surface point, its unit normal, and the direction in which the camera sees it; or the derivatives of all three by the pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sight {
    pub position: Vec3,
    pub normal: Vec3,
    pub direction: Vec3,
}

pub(super) const SINGLE: Sight = Sight { position: Vec3::ZERO, normal: Vec3::ZERO, direction: Vec3::ZERO };

/// Radiance and where it comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shaded {
    pub radiance: Vec3,
    pub provenance: Provenance,
}

/// Weights of the texel's four candidates (sum 1, or all 0 without candidates), and whether a fallback chose them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BlendWeights {
    pub weights: [f32; 4],
    pub answer: Answer,
}

/// Radiance of the object's pixel (i, j).
pub(super) fn shade_object(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    camera: &Camera,
    (i, j): (u32, u32),
    pixel: &GBufferPixel,
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let [u, v, code, _] = pixel.a;
    let (part, back) = match Seen::from_code(code) {
        Seen::Object { part } => (part, false),
        Seen::ObjectBack { part } => (part, true),
        Seen::Background | Seen::Nothing | Seen::Unknown => unreachable!("only the object's pixels are shaded here"),
    };
    let mut shaded = shade_from(field, settings, camera, (i, j), pixel, field.sample_maps.at(part, u, v), cubes)?;
    if back {
        shaded.provenance = Provenance::UNKNOWN;
    }
    Ok(shaded)
}

/// The same from any candidates.
pub(super) fn shade_from(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    camera: &Camera,
    (i, j): (u32, u32),
    pixel: &GBufferPixel,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (at, by) = sight(settings.filter, camera, (i, j), pixel);
    let reflecting = reflecting_at(settings, &at, &by, pixel, cubes)?;
    Ok(match settings.component {
        Component::Reconstruction => reconstruct(field, settings, &at, &by, candidates, cubes)?,
        Component::Mirror => mirror(field, settings, &at, &by, &reflecting.mirrored, candidates, cubes)?,
        Component::Full => {
            let own = reconstruct(field, settings, &at, &by, candidates, cubes)?;
            let reflected = mirror(field, settings, &at, &by, &reflecting.mirrored, candidates, cubes)?;
            Shaded { radiance: own.radiance + reflected.radiance, provenance: worse(own.provenance, reflected.provenance) }
        }
        Component::Refraction(dielectric) => refraction(field, settings, &dielectric, &at, &by, candidates, cubes)?,
        Component::Glossy(gloss) => {
            let tangent = Vec3::from_slice(&pixel.tangent);
            glossy(field, settings, &gloss, &at, &by, (&reflecting, tangent), candidates, cubes)?
        }
    })
}

/// What the camera sees at an object's pixel, and its derivatives by the pixel's column and row: none where reads are not filtered.
pub(super) fn sight(filter: Filter, camera: &Camera, (i, j): (u32, u32), pixel: &GBufferPixel) -> (Sight, [Sight; 2]) {
    let ray = camera.pixel_ray(i, j);
    let at = Sight { position: ray.at(pixel.a[3]), normal: Vec3::from_slice(&pixel.b), direction: ray.direction };
    if filter == Filter::Bilinear {
        return (at, [SINGLE; 2]);
    }
    let derivatives = camera.ray_derivatives(ray.direction);
    let by = std::array::from_fn(|k| {
        let surface = &pixel.differentials[k];
        let (position, normal) = (Vec3::from_slice(&surface.position), Vec3::from_slice(&surface.normal));
        Sight { position, normal, direction: derivatives[k] }
    });
    (at, by)
}

/// The reconstruction's provenance, unless the mirror's answer is the less certain one.
pub(super) fn worse(own: Provenance, reflected: Provenance) -> Provenance {
    if (reflected.answer() as u32) > own.answer() as u32 { reflected } else { own }
}

/// The object's own appearance: `Σⱼ βⱼ Lᵢ(pⱼ; normalize(x − pⱼ))`, βⱼ the [`own_weights`]; in other light [`relit`].
pub(super) fn reconstruct(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    by: &[Sight; 2],
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (x, n) = (at.position, at.normal);
    let weights = own_weights(field, settings, at, candidates, cubes)?;
    if weights.answer == Answer::Unknown {
        return Ok(NOTHING);
    }
    let toward_x = |j: u16| {
        let p = field.sample_points[usize::from(j)].position;
        let distance = (p - x).length();
        let per_length = if distance > 0.0 { 1.0 / distance } else { 0.0 };
        let up = toward(x, p, n);
        let [across, down] = [0, 1].map(|k| short_of_the_horizon(within_the_surface(&by[k]) * per_length, n.dot(up)));
        DirectionDifferential { direction: -up, across, down }
    };
    let own = blended(candidates, &weights, toward_x, cubes)?;
    match cubes.lit() {
        Some(lit) => relit(field, &lit, at, candidates, own, cubes),
        None => Ok(own),
    }
}

/// A diffuse object looks alike from everywhere: all of the weight on the [`own_sample`]. One that was captured as authored does not: the
/// blend's rule with the direction to the viewer in place of the mirrored one, over the candidates within 65° of n; depth-corrected `max(v·ŝ, 0)ᴺ`
/// with N = [`OWN_EXPONENT`] over those that see x, too. Where there are none the own sample alone (filled).
fn own_weights(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<BlendWeights, RenderError> {
    if field.parameters.original == Original::AsAuthored {
        let (x, n) = (at.position, at.normal);
        let up = toward_samples(field, candidates, x, n);
        let mut admitted = [NO_SAMPLE; 4];
        for (k, j) in candidates.into_iter().enumerate().filter(|(k, j)| *j != NO_SAMPLE && n.dot(up[*k]) > cos_horizon()) {
            let is_seen = settings.blend != Blend::Corrected || sees(u32::from(j), field.sample_points[usize::from(j)].position, x, cubes)?;
            if is_seen {
                admitted[k] = j;
            }
        }
        let blend = if settings.blend == Blend::Corrected { Blend::Reflection { exponent: OWN_EXPONENT } } else { settings.blend };
        let weights = blend_weights(blend, admitted, up, n, -at.direction);
        if weights.answer != Answer::Unknown {
            return Ok(weights);
        }
    }
    Ok(match own_sample(field, settings, at, candidates, cubes)? {
        Some((k, answer)) => BlendWeights { weights: only(k), answer },
        None => BlendWeights { weights: [0.0; 4], answer: Answer::Unknown },
    })
}

/// Which candidate shows x: the nearest within 65° of n, else (filled) the nearest. Depth-corrected, it must see x, too: the nearest that
/// does within 65°, else (filled) the highest of all that do, else as without.
pub(super) fn own_sample(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Option<(usize, Answer)>, RenderError> {
    let (x, n) = (at.position, at.normal);
    let valid = candidates.map(|j| j != NO_SAMPLE);
    let Some(nearest) = valid.iter().position(|v| *v) else { return Ok(None) };
    let cosines = toward_samples(field, candidates, x, n).map(|s| n.dot(s));
    let cos_horizon = cos_horizon();
    let within = std::array::from_fn::<_, 4, _>(|k| valid[k] && cosines[k] > cos_horizon).iter().position(|w| *w);
    if settings.blend != Blend::Corrected {
        return Ok(Some(within.map_or((nearest, Answer::Filled), |k| (k, Answer::Hit))));
    }
    let mut seeing = [false; 4];
    for k in (0..4).filter(|k| valid[*k]) {
        let j = candidates[k];
        seeing[k] = sees(u32::from(j), field.sample_points[usize::from(j)].position, x, cubes)?;
        if seeing[k] && cosines[k] > cos_horizon {
            return Ok(Some((k, Answer::Hit)));
        }
    }
    let unseen = within.unwrap_or(nearest);
    let first = seeing.iter().position(|s| *s);
    Ok(Some((first.map_or(unseen, |first| largest(cosines, seeing, first)), Answer::Filled)))
}

fn cos_horizon() -> f32 {
    RUNTIME_HORIZON_DEG.to_radians().cos()
}

// The derivative of the surface's point, no longer than the surface is like its tangent plane: beyond it, p sees past the object.
fn within_the_surface(by: &Sight) -> Vec3 {
    by.position * (MOST_TURN / by.normal.length().max(MOST_TURN))
}

/// Radians by which a surface may turn within a pixel and still be taken for its tangent plane.
const MOST_TURN: f32 = 0.15;

/// A derivative of the direction from p to x, no longer than half the way to the horizon, where p sees past the object, too.
pub(super) fn short_of_the_horizon(derivative: Vec3, cosine: f32) -> Vec3 {
    let (most, length) = (0.5 * cosine.max(0.0), derivative.length());
    if length > most { derivative * (most / length) } else { derivative }
}

/// What the camera sees one pixel on, in the tangent plane.
pub(super) fn neighbour(at: &Sight, by: &Sight) -> Sight {
    let normal = (at.normal + by.normal).normalize_or(at.normal);
    Sight { position: at.position + by.position, normal, direction: (at.direction + by.direction).normalize_or(at.direction) }
}

pub(super) const NOTHING: Shaded = Shaded { radiance: Vec3::ZERO, provenance: Provenance::UNKNOWN };

/// What the mirror shows, one reflection, toward `r`, or several of them: `C_s Σⱼ βⱼ Lᵢ(pⱼ; r)` is one.
pub(super) fn mirror(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    by: &[Sight; 2],
    r: &DirectionDifferential,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    if settings.sees_itself() {
        return reflections(field, settings, at, by, candidates, cubes);
    }
    radiance_toward(field, settings, at, by, r, candidates, cubes)
}

/// `C_s Σⱼ βⱼ Lᵢ(pⱼ; r)` for any direction `r` (unit).
pub(super) fn radiance_toward(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    by: &[Sight; 2],
    r: &DirectionDifferential,
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (x, n) = (at.position, at.normal);
    if settings.blend == Blend::Corrected {
        let shaded = corrected(field, at, by, r, candidates, cubes)?;
        return Ok(Shaded { radiance: settings.specular_reflectance * shaded.radiance, ..shaded });
    }
    if settings.blend == Blend::EnvironmentMap {
        let baseline = field.sample_points.len() as u32;
        let radiance = settings.specular_reflectance * cubes.read_cube(baseline, r)?;
        return Ok(Shaded { radiance, provenance: Provenance::new(Answer::Hit, baseline) });
    }
    let blend = blend_weights(settings.blend, candidates, toward_samples(field, candidates, x, n), n, r.direction);
    if blend.answer == Answer::Unknown {
        return Ok(NOTHING);
    }
    let shaded = blended(candidates, &blend, |_| *r, cubes)?;
    Ok(Shaded { radiance: settings.specular_reflectance * shaded.radiance, ..shaded })
}

/// `Σⱼ βⱼ Lᵢ(pⱼ; look(j))`, and the candidate that weighs most.
pub(super) fn blended(
    candidates: [u16; 4],
    blend: &BlendWeights,
    look: impl Fn(u16) -> DirectionDifferential,
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let (mut radiance, mut heaviest) = (Vec3::ZERO, 0);
    for (k, j) in candidates.into_iter().enumerate() {
        if blend.weights[k] > 0.0 {
            radiance += blend.weights[k] * cubes.read_cube(u32::from(j), &look(j))?;
        }
        if blend.weights[k] > blend.weights[heaviest] {
            heaviest = k;
        }
    }
    Ok(Shaded { radiance, provenance: Provenance::new(blend.answer, u32::from(candidates[heaviest])) })
}

/// `r = 2 n (n·v) − v` with v = −d.
pub(super) fn mirror_direction(n: Vec3, d: Vec3) -> Vec3 {
    d - 2.0 * n.dot(d) * n
}

/// The mirror direction and its derivatives: `δr = δd − 2 ((n·δd + δn·d) n + (n·d) δn)`.
pub(super) fn mirrored(at: &Sight, by: &[Sight; 2]) -> DirectionDifferential {
    let (n, d) = (at.normal, at.direction);
    let [across, down] = by.map(|by| by.direction - 2.0 * ((n.dot(by.direction) + by.normal.dot(d)) * n + n.dot(d) * by.normal));
    DirectionDifferential { direction: mirror_direction(n, d), across, down }
}

/// Unit vector from x to p; n where they coincide.
pub(super) fn toward(x: Vec3, p: Vec3, n: Vec3) -> Vec3 {
    let offset = p - x;
    let length = offset.length();
    if length > 0.0 { offset / length } else { n }
}

/// The same to each candidate's sample point; n for none.
pub(super) fn toward_samples(field: &OffsetSurfaceLightField, candidates: [u16; 4], x: Vec3, n: Vec3) -> [Vec3; 4] {
    candidates.map(|j| if j == NO_SAMPLE { n } else { toward(x, field.sample_points[usize::from(j)].position, n) })
}

/// βⱼ by the blend's rule; where every weight vanishes, all of it on the nearest candidate (filled).
pub(super) fn blend_weights(blend: Blend, candidates: [u16; 4], toward_samples: [Vec3; 4], n: Vec3, r: Vec3) -> BlendWeights {
    let valid = candidates.map(|j| j != NO_SAMPLE);
    let Some(nearest) = valid.iter().position(|v| *v) else { return BlendWeights { weights: [0.0; 4], answer: Answer::Unknown } };
    let weights = match blend {
        Blend::Distance | Blend::EnvironmentMap | Blend::Corrected => only(nearest),
        Blend::Angle => only(largest(toward_samples.map(|s| s.dot(r)), valid, nearest)),
        Blend::Average => normalized(valid.map(|v| if v { 1.0 } else { 0.0 })),
        Blend::Reflection { exponent } => normalized(sharpened(toward_samples.map(|s| s.dot(r)), valid, exponent)),
        Blend::Normal { exponent } => normalized(sharpened(toward_samples.map(|s| s.dot(n)), valid, exponent)),
    };
    if weights == [0.0; 4] {
        return BlendWeights { weights: only(nearest), answer: Answer::Filled };
    }
    BlendWeights { weights, answer: Answer::Hit }
}

fn only(k: usize) -> [f32; 4] {
    let mut weights = [0.0; 4];
    weights[k] = 1.0;
    weights
}

// Index of the largest valid value; the first of equals.
fn largest(values: [f32; 4], valid: [bool; 4], nearest: usize) -> usize {
    (nearest..4).filter(|k| valid[*k]).fold(nearest, |best, k| if values[k] > values[best] { k } else { best })
}

// cᴺ of the valid, positive cosines, divided by the largest so that no exponent makes them all vanish.
fn sharpened(cosines: [f32; 4], valid: [bool; 4], exponent: f32) -> [f32; 4] {
    let clamped: [f32; 4] = std::array::from_fn(|k| if valid[k] { cosines[k].max(0.0) } else { 0.0 });
    let highest = clamped.into_iter().fold(0f32, f32::max);
    if !(highest > 0.0) {
        return valid.map(|v| if v && exponent == 0.0 { 1.0 } else { 0.0 });
    }
    std::array::from_fn(|k| if valid[k] { power(clamped[k] / highest, exponent) } else { 0.0 })
}

/// Divided by their sum; all 0 where that is.
pub(super) fn normalized(weights: [f32; 4]) -> [f32; 4] {
    let sum = weights[0] + weights[1] + weights[2] + weights[3];
    if sum > 0.0 { weights.map(|w| w / sum) } else { [0.0; 4] }
}

/// `base` to the power `exponent` for base in [0, 1] and exponent ≥ 0; 0⁰ = 1.
pub(super) fn power(base: f32, exponent: f32) -> f32 {
    if exponent == 0.0 {
        return 1.0;
    }
    if !(base > 0.0) {
        return 0.0;
    }
    exponential(exponent * logarithm(base))
}

/// Natural logarithm of x in (0, 1]: relative error below 10⁻⁶, also near 1. Subnormal x count as 2⁻¹²⁶.
pub(super) fn logarithm(x: f32) -> f32 {
    let bits = x.max(f32::MIN_POSITIVE).to_bits();
    let mut exponent = (bits >> 23) as f32 - 126.0;
    // Mantissa in [½, 1), moved to [√½, √2) around 1.
    let mut m = f32::from_bits(bits & 0x007f_ffff | 0x3f00_0000);
    if m < std::f32::consts::FRAC_1_SQRT_2 {
        exponent -= 1.0;
        m += m;
    }
    let f = m - 1.0;
    let z = f * f;
    let mut y = 7.037_683_6e-2;
    for c in
        [-1.151_461e-1, 1.167_699_8e-1, -1.242_014_1e-1, 1.424_932_3e-1, -1.666_805_7e-1, 2.000_071_5e-1, -2.499_999_4e-1, 3.333_333e-1]
    {
        y = y * f + c;
    }
    y = y * f * z + exponent * LN_2_LOW - 0.5 * z;
    f + y + exponent * LN_2_HIGH
}

// ln 2 in two pieces: the first has so few bits that its product with a small integer is exact.
const LN_2_HIGH: f32 = 0.693_359_4;
const LN_2_LOW: f32 = -2.121_944_4e-4;

/// eˣ for x ≤ 0: relative error below 10⁻⁶; 0 below −87.
pub(super) fn exponential(x: f32) -> f32 {
    if !(x > -87.0) {
        return 0.0;
    }
    let n = (x * std::f32::consts::LOG2_E + 0.5).floor();
    let f = x - n * LN_2_HIGH - n * LN_2_LOW;
    let mut y = 1.987_569_1e-4;
    for c in [1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 5e-1] {
        y = y * f + c;
    }
    (y * f * f + f + 1.0) * f32::from_bits(((n as i32 + 127) as u32) << 23)
}
