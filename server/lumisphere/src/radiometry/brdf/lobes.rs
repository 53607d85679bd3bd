//! What several models share: the cosine hemisphere, alone and beside a highlight, powers of a cosine around an axis, and logarithms that keep their digits
//! where a lobe is narrow.

use std::f32::consts::{FRAC_1_PI, PI, TAU};

use glam::{Vec2, Vec3};

use super::{Brdf, HORIZON};
use crate::geometry::TangentFrame;

/// Point of the unit disc, uniform in area; keeps neighbours together (Shirley & Chiu 1997).
#[inline]
fn disc(u: Vec2) -> Vec2 {
    let p = 2.0 * u - 1.0;
    if p == Vec2::ZERO {
        return Vec2::ZERO;
    }
    let (radius, angle) = if p.x.abs() > p.y.abs() { (p.x, PI / 4.0 * (p.y / p.x)) } else { (p.y, PI / 2.0 - PI / 4.0 * (p.x / p.y)) };
    let (sin, cos) = angle.sin_cos();
    radius * Vec2::new(cos, sin)
}

/// Unit vector around +Z with density cos θ / π per steradian (Malley's method).
#[inline]
pub(crate) fn cosine_hemisphere(u: Vec2) -> Vec3 {
    let d = disc(u);
    d.extend((1.0 - d.length_squared()).max(0.0).sqrt())
}

/// Density of `cosine_hemisphere`.
#[inline]
pub(super) fn cosine_pdf(wi: Vec3) -> f32 {
    wi.z.max(0.0) * FRAC_1_PI
}

/// `wo` mirrored about the half vector `h`.
#[inline]
pub(super) fn reflected(wo: Vec3, h: Vec3) -> Vec3 {
    2.0 * wo.dot(h) * h - wo
}

/// A direction from `highlight`, with probability `share`, or from the cosine hemisphere, and the density of both together; as
/// [`Brdf::sample`]. What is left of `u` after the choice draws either.
#[inline]
pub(super) fn sample_highlight(
    brdf: &impl Brdf,
    wo: Vec3,
    u: Vec2,
    share: f32,
    highlight: impl FnOnce(Vec2) -> Vec3,
) -> Option<(Vec3, f32)> {
    if !(wo.z > HORIZON) {
        return None;
    }
    let wi =
        if u.x < share { highlight(Vec2::new(u.x / share, u.y)) } else { cosine_hemisphere(Vec2::new((u.x - share) / (1.0 - share), u.y)) };
    let pdf = brdf.pdf(wo, wi);
    (pdf > 0.0).then_some((wi, pdf))
}

/// Unit vector around `axis` with density `power_pdf`.
#[inline]
pub(super) fn power_lobe(axis: Vec3, exponent: f32, u: Vec2) -> Vec3 {
    // cos α = (1 − u)^(1/(n+1)), as 1 − cos α: a narrow lobe lies where the cosine has no digits left.
    let off = one_minus_exp(-(1.0 - u.x).ln() / (exponent + 1.0));
    let radius = (off * (2.0 - off)).max(0.0).sqrt();
    let (sin, cos) = (TAU * u.y).sin_cos();
    TangentFrame::around(axis).world_from_local(Vec3::new(radius * cos, radius * sin, 1.0 - off)).normalize()
}

/// (n+1)/2π · cosⁿ α, α being the angle to `axis`.
#[inline]
pub(super) fn power_pdf(axis: Vec3, exponent: f32, wi: Vec3) -> f32 {
    (exponent + 1.0) / TAU * cosine_power(one_minus_cosine(axis, wi), exponent)
}

/// 1 − cos of the angle between two unit vectors, exact for small angles.
#[inline]
pub(super) fn one_minus_cosine(a: Vec3, b: Vec3) -> f32 {
    0.5 * (a - b).length_squared()
}

/// (1 − x)ⁿ, zero for x ≥ 1.
#[inline]
pub(super) fn cosine_power(x: f32, exponent: f32) -> f32 {
    if x < 1.0 { (-exponent * x * log_ratio(x)).exp() } else { 0.0 }
}

/// −ln(1 − x) / x, for x ∈ [0, 1); 1 at 0.
#[inline]
pub(super) fn log_ratio(x: f32) -> f32 {
    // Its series to x⁵: the first term left out is 10⁻⁸ here.
    if x < SERIES { 1.0 + x * (0.5 + x * (1.0 / 3.0 + x * (0.25 + x * (0.2 + x * (1.0 / 6.0))))) } else { -(1.0 - x).ln() / x }
}

/// 1 − e⁻ᵗ for t ≥ 0.
#[inline]
pub(super) fn one_minus_exp(t: f32) -> f32 {
    if t < SERIES { t * (1.0 - t / 2.0 * (1.0 - t / 3.0 * (1.0 - t / 4.0 * (1.0 - t / 5.0)))) } else { 1.0 - (-t).exp() }
}

const SERIES: f32 = 1.0 / 16.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_keep_their_digits_down_to_zero() {
        for k in 0..200 {
            let x = 1e-9f64 * 10f64.powf(k as f64 * 0.045);
            let x = f64::from((x as f32).min(0.999));
            // A few f32 roundings; at the seam 1 − x has lost 4 bits of x.
            assert!((f64::from(log_ratio(x as f32)) / (-(-x).ln_1p() / x) - 1.0).abs() < 3e-6, "{x}");
            assert!((f64::from(one_minus_exp(x as f32)) / -(-x).exp_m1() - 1.0).abs() < 3e-6, "{x}");
        }
        assert_eq!((log_ratio(0.0), one_minus_exp(0.0), cosine_power(1.0, 3.0)), (1.0, 0.0, 0.0));
    }
}
