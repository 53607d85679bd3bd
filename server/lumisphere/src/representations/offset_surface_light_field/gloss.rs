//! Any BRDF by Monte Carlo on the cube maps: directions drawn from it, for each the sample points' light blended, as for a mirror. `gloss.wgsl`
//! has the same functions by the same names.
//!
//! `L(x, v) ≈ 1/M Σₛ f_r(v, lₛ) (n·lₛ) / p(lₛ) · Σⱼ βⱼ Lᵢ(pⱼ; lₛ)`, the paper's second order of integration (blend, then integrate). The
//! directions are the same for every pixel (a Fibonacci lattice), so that there is no noise from one to the next. In its first order,
//! `Σⱼ βⱼ · 1/M Σₛ f_r(v, lⱼₛ) (n·lⱼₛ) / p(lⱼₛ) · Lᵢ(pⱼ; lⱼₛ)`, every sample point has directions of its own and βⱼ is that of the mirror direction. With
//! `Filter::Footprint` each reads the mean over its share of the lobe, `1/(M·p)` (filtered importance sampling: Křivánek & Colbert 2008),
//! and of what the pixel covers of a mirror's image: a few tens of directions do then. With `Filter::Bilinear` it reads four
//! texels, as in the paper, and M directions show as M images of what is bright. A narrow highlight may be one look instead (`prefiltered.rs`).
//!
//! A still is the mean of passes: pass k draws the directions kM … (k+1)M − 1 of the one sequence, each with a share of all (k+1)M so far. The
//! first pass is a frame as it is shown in motion. What a share takes in beside its direction is an error that grows with its solid angle: of
//! pass k it is 1/(k+1) of the first's, of P passes' mean (1 + 1/2 + … + 1/P)/P of it, about (ln P + 0.58)/P. The integral itself, as far as what
//! is stored tells it, is the limit; `covered` stays, being what the pixel shows.

use glam::{Vec2, Vec3};

use super::bumps::Reflecting;
use super::prefiltered::over_highlight;
use super::relight::light_visibility;
use super::shade::{NOTHING, ReadCube, Shaded, Sight, blend_weights, radiance_toward, toward_samples};
use super::{Blend, Filter, Gloss, GlossBrdf, NO_SAMPLE, OffsetSurfaceLightField, Settings};
use crate::directions::DirectionDifferential;
use crate::geometry::TangentFrame;
use crate::radiometry::brdf::Brdf;
use crate::representations::RenderError;
use crate::representations::provenance::{Answer, Provenance};

/// A direction reads so many times its share of the lobe: side by side, shares would show (Křivánek & Colbert's K).
const OVERLAP: f32 = 4.0;

/// Radiance reflected by `gloss.brdf`, whose +Z is the normal by which the surface reflects and whose +X lies along `tangent`; that of point
/// lights, too.
#[expect(clippy::too_many_arguments, reason = "what a pixel sees, from which each look begins")]
pub(super) fn glossy(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    gloss: &Gloss,
    at: &Sight,
    by: &[Sight; 2],
    (reflecting, tangent): (&Reflecting, Vec3),
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let nearest = candidates.into_iter().find(|j| *j != NO_SAMPLE).map(u32::from);
    let baseline = (settings.blend == Blend::EnvironmentMap).then_some(field.sample_points.len() as u32);
    let Some(sample) = baseline.or(nearest) else { return Ok(NOTHING) };
    let table = cubes.table();
    let brdf: &dyn Brdf = match (&gloss.brdf, &table) {
        (GlossBrdf::Analytic(brdf), _) => brdf,
        (GlossBrdf::Measured(_), Some(table)) => table.as_ref(),
        (GlossBrdf::Measured(hash), None) => return Err(RenderError::NoTable { table: *hash }),
    };
    let white = Settings { specular_reflectance: Vec3::ONE, ..*settings };
    let frame = TangentFrame::along(reflecting.normal, tangent);
    let lobe = Lobe { brdf, frame, wo: frame.local_from_world(-at.direction), reflecting };
    let (mut radiance, answer) = match gloss.highlight_about(lobe.wo) {
        Some(highlight) => {
            let look = over_highlight(&lobe.frame, highlight, at.normal, &reflecting.mirrored);
            let found = radiance_toward(field, &white, at, by, &look, candidates, cubes)?;
            let (wi, _) = highlight;
            let weight = if reflecting.enters(look.direction, at) { Vec3::ZERO } else { lobe.weight(wi, brdf.pdf(lobe.wo, wi)) };
            (weight * found.radiance, found.provenance.answer())
        }
        None => lobe.drawn(field, &white, gloss, at, by, candidates, cubes)?,
    };
    for light in settings.light.point_lights() {
        let to_light = light.position - at.position;
        let toward = to_light.normalize_or_zero();
        let wi = frame.local_from_world(toward);
        if wi.z > 0.0 && !reflecting.enters(toward, at) {
            let seen = light_visibility(field, at, candidates, light.position, cubes)?;
            radiance += brdf.eval(lobe.wo, wi) * light.intensity * (seen * wi.z / to_light.length_squared());
        }
    }
    let answer = if answer == Answer::Hit { Answer::Hit } else { Answer::Filled };
    Ok(Shaded { radiance, provenance: Provenance::new(answer, sample) })
}

/// What a surface's point reflects, and how the pixel sees it.
struct Lobe<'a> {
    brdf: &'a dyn Brdf,
    /// +X along the surface's u.
    frame: TangentFrame,
    /// Tangent space.
    wo: Vec3,
    /// As a mirror would, too.
    reflecting: &'a Reflecting,
}

impl Lobe<'_> {
    /// Of light from `wi` that was drawn with that density.
    fn weight(&self, wi: Vec3, density: f32) -> Vec3 {
        if density > 0.0 { self.brdf.eval(self.wo, wi) * (wi.z / density) } else { Vec3::ZERO }
    }

    /// Monte Carlo's mean over directions.
    #[expect(clippy::too_many_arguments, reason = "what a pixel sees, from which each look begins")]
    fn drawn(
        &self,
        field: &OffsetSurfaceLightField,
        white: &Settings,
        gloss: &Gloss,
        at: &Sight,
        by: &[Sight; 2],
        candidates: [u16; 4],
        cubes: &mut dyn ReadCube,
    ) -> Result<(Vec3, Answer), RenderError> {
        let mirrored = &self.reflecting.mirrored;
        let covered = mirrored.across.cross(mirrored.down).length();
        let integrates_first = gloss.integrates_first(white.blend);
        let (weights, mut is_filled) = match integrates_first {
            false => ([1.0, 0.0, 0.0, 0.0], false),
            true => {
                let toward = toward_samples(field, candidates, at.position, at.normal);
                let blend = blend_weights(white.blend, candidates, toward, at.normal, mirrored.direction);
                (blend.weights, blend.answer != Answer::Hit)
            }
        };
        let mut radiance = Vec3::ZERO;
        let first = gloss.first_direction();
        let sharing = first + gloss.directions;
        for (k, share) in weights.into_iter().enumerate().filter(|(_, share)| *share > 0.0) {
            let own = if integrates_first { u32::from(candidates[k]) } else { 0 };
            let mut integral = Vec3::ZERO;
            for number in first..sharing {
                let Some((wi, density)) = self.brdf.sample(self.wo, place(number, gloss.directions, own)) else { continue };
                let toward = self.frame.world_from_local(wi);
                if self.reflecting.enters(toward, at) {
                    continue;
                }
                let weight = self.weight(wi, density);
                let solid_angle = OVERLAP / (sharing as f32 * density) + covered;
                let look = spread(toward, solid_angle, white.filter);
                if integrates_first {
                    integral += weight * cubes.read_cube(own, &look)?;
                } else {
                    let found = radiance_toward(field, white, at, by, &look, candidates, cubes)?;
                    integral += weight * found.radiance;
                    is_filled |= found.provenance.answer() != Answer::Hit;
                }
            }
            radiance += share * integral;
        }
        Ok((radiance / gloss.directions as f32, if is_filled { Answer::Filled } else { Answer::Hit }))
    }
}

/// Where in [0, 1)² a pass of `directions` draws number `number` of all passes: a lattice, its second coordinate, by which models turn about their axis, in
/// steps of the golden ratio (so that there are no arms), its first in as many strata, in each pass at another place of theirs. In whole numbers, so
/// that both twins have the same; shifted for each sample point (Cranley & Patterson 1976), so that those of a pixel see different directions.
fn place(number: u32, directions: u32, own: u32) -> Vec2 {
    let stratum = u32::MAX / directions;
    let part = (number / directions).wrapping_mul(GOLDEN).wrapping_add(1 << 31) >> 16;
    // The product's upper half, without 64 bits, which the twin has not.
    let within = (stratum >> 16) * part + (((stratum & 0xffff) * part) >> 16);
    let across = (number % directions).wrapping_mul(stratum).wrapping_add(within).wrapping_add(own.wrapping_mul(2_447_445_413));
    // Not at the square's rim, which models take to the horizon.
    let around = number.wrapping_mul(GOLDEN).wrapping_add(1 << 31).wrapping_add(own.wrapping_mul(3_367_900_313));
    let part = |place: u32| (place >> 8) as f32 / (1 << 24) as f32;
    Vec2::new(part(across), part(around))
}

/// 2³² by the golden ratio.
const GOLDEN: u32 = 2_654_435_769;

/// A square look of that solid angle, sr.
fn spread(direction: Vec3, solid_angle: f32, filter: Filter) -> DirectionDifferential {
    if filter == Filter::Bilinear {
        return DirectionDifferential::single(direction);
    }
    let (frame, side) = (TangentFrame::around(direction), solid_angle.sqrt());
    DirectionDifferential { direction, across: side * frame.tangent, down: side * frame.bitangent }
}
