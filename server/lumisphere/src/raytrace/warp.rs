//! From the unit square to directions and surfaces, with the densities.

use glam::{Vec2, Vec3};

pub(super) use crate::radiometry::brdf::cosine_hemisphere;

/// Barycentric weights (second, third corner) of a point uniform in a triangle's area (Heitz 2019, "A Low-Distortion Map").
#[inline]
pub(super) fn triangle(u: Vec2) -> Vec2 {
    if u.y > u.x { Vec2::new(0.5 * u.x, u.y - 0.5 * u.x) } else { Vec2::new(u.x - 0.5 * u.y, 0.5 * u.y) }
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
