//! From the unit square to directions and surfaces, with the densities.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

pub(super) use crate::radiometry::brdf::cosine_hemisphere;

/// Barycentric weights (second, third corner) of a point uniform in a triangle's area (Heitz 2019, "A Low-Distortion Map").
#[inline]
pub(super) fn triangle(u: Vec2) -> Vec2 {
    if u.y > u.x { Vec2::new(0.5 * u.x, u.y - 0.5 * u.x) } else { Vec2::new(u.x - 0.5 * u.y, 0.5 * u.y) }
}

/// Microfacet normal seen from `wo` (unit, z > 0, tangent space), density D_v(m) = G₁(wo) max(0, wo·m) D(m) / wo.z
/// (Heitz 2018, "Sampling the GGX Distribution of Visible Normals").
#[inline]
pub(super) fn ggx_visible_normal(wo: Vec3, alpha: f32, u: Vec2) -> Vec3 {
    let stretched = Vec3::new(alpha * wo.x, alpha * wo.y, wo.z).normalize();
    let length_squared = stretched.x * stretched.x + stretched.y * stretched.y;
    let t1 = if length_squared > 0.0 { Vec3::new(-stretched.y, stretched.x, 0.0) / length_squared.sqrt() } else { Vec3::X };
    let t2 = stretched.cross(t1);
    let (radius, angle) = (u.x.sqrt(), TAU * u.y);
    let (sin, cos) = angle.sin_cos();
    let p1 = radius * cos;
    let s = 0.5 * (1.0 + stretched.z);
    let p2 = (1.0 - s) * (1.0 - p1 * p1).max(0.0).sqrt() + s * radius * sin;
    let m = p1 * t1 + p2 * t2 + (1.0 - p1 * p1 - p2 * p2).max(0.0).sqrt() * stretched;
    Vec3::new(alpha * m.x, alpha * m.y, m.z.max(0.0)).normalize_or(Vec3::Z)
}

/// GGX distribution D of microfacet normals (Trowbridge & Reitz 1975; Walter et al. 2007, eq. 33), sr⁻¹, for `m.z ≥ 0`.
#[inline]
pub(super) fn ggx_distribution(m: Vec3, alpha: f32) -> f32 {
    let a2 = alpha * alpha;
    // sin²θ + α² cos²θ, without the cancellation of (α²−1) cos²θ + 1 near the normal.
    let d = m.x * m.x + m.y * m.y + a2 * m.z * m.z;
    a2 / (PI * d * d)
}

/// Smith's Λ of GGX (Heitz 2014, eq. 72): G₁(w) = 1/(1+Λ(w)), G₂(wo, wi) = 1/(1+Λ(wo)+Λ(wi)).
#[inline]
pub(super) fn ggx_lambda(w: Vec3, alpha: f32) -> f32 {
    let tan2 = (w.x * w.x + w.y * w.y) / (w.z * w.z);
    0.5 * ((1.0 + alpha * alpha * tan2).sqrt() - 1.0)
}

/// Veach's power heuristic (exponent 2) for one sample of each of two densities.
#[inline]
pub(super) fn power_heuristic(taken: f32, other: f32) -> f32 {
    // As a ratio, so that huge densities do not overflow when squared.
    let ratio = other / taken;
    1.0 / (1.0 + ratio * ratio)
}

/// Fibonacci directions: `count` unit vectors spread evenly over the sphere.
pub(super) fn even_directions(count: u32) -> impl Iterator<Item = Vec3> {
    // 2π(1 − 1/φ): the golden angle.
    const GOLDEN_ANGLE: f32 = 2.399_963_2;
    (0..count).map(move |i| {
        let y = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
        let at = Vec2::from_angle(GOLDEN_ANGLE * i as f32) * (1.0 - y * y).sqrt();
        Vec3::new(at.x, y, at.y)
    })
}
