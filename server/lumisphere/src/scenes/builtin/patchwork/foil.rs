//! Crumpled foil: flat facets between sharp creases, as folding leaves them.
//!
//! A sheet folded in pleats in several directions, one after the other, and pressed flat again: a sum of triangle waves, piecewise plane.

use std::f32::consts::PI;

use glam::Vec2;

use super::super::super::noise;
use super::super::patterns::fract;

/// How a foil was crumpled.
pub(super) struct Creases {
    pub seed: u32,
    /// Narrowest and widest distance between a fold's creases, in widths of the patch.
    pub widths: [f32; 2],
}

const FOLDS: i32 = 5;
/// Of each fold's facets, in units of height over widths of the patch.
const SLOPE: f32 = 0.09 * super::PATCH;
/// Half of the heights' range.
const HALF_RANGE: f32 = 0.005;

impl Creases {
    /// In the scene's unit, 0 to 0.01.
    pub fn height(&self, at: Vec2) -> f32 {
        // Hands do not fold straight.
        let bent = |k: u32| 0.10 * noise::value(self.seed.wrapping_add(k), 3.0 * at.x, 3.0 * at.y, 64);
        let at = at + Vec2::new(bent(100), bent(200));
        let fold = |k: i32| {
            let random = |what: i32| noise::unit(self.seed, k, what);
            let width = self.widths[0] + (self.widths[1] - self.widths[0]) * random(0);
            // Spread over the half circle, or facets become long strips.
            let along = at.dot(Vec2::from_angle(PI * (k as f32 + 0.7 * random(1)) / FOLDS as f32));
            // From −1 to 1 within half a width and back.
            let wave = 4.0 * (fract(along / width + random(2)) - 0.5).abs() - 1.0;
            0.25 * SLOPE * width * wave
        };
        let sum: f32 = (0..FOLDS).map(fold).sum();
        HALF_RANGE + sum.clamp(-HALF_RANGE, HALF_RANGE)
    }
}
