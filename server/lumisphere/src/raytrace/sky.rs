//! Environment light: radiance from any direction, and directions drawn in proportion to it.
//!
//! A map is sampled by texel, with probability ∝ mean luminance · ∫ sin θ (Pharr, Jakob & Humphreys, "PBR" 4e, §12.5.3) times what
//! `sky_cells` makes of the cosine, then uniformly in longitude and polar angle. The mean is that of the *bilinear* read, so no texel
//! that shines has probability zero.

use std::f32::consts::{PI, TAU};
use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::sky_cells::{NormalBin, SkyCells};
use crate::scenes::{Environment, EnvironmentMap};

/// Light from infinity, ready to evaluate and sample.
#[derive(Debug, Clone)]
pub(super) enum Sky {
    /// Not sampled by direction: sampling the reflection is perfect for it.
    Constant(Vec3),
    Map(SkyMap),
}

/// A latitude–longitude map (`EnvironmentMap`'s conventions) with its sampling tables.
#[derive(Debug, Clone)]
pub(super) struct SkyMap {
    width: usize,
    height: usize,
    texels: Vec<Vec3>,
    /// cos and sin of the map's rotation about +Y.
    turn: (f32, f32),
    /// None when the map is black.
    sampling: Option<Arc<SkyCells>>,
    /// ∫ luminance dω, for choosing between kinds of light.
    pub power: f32,
}

/// A direction toward the light, the radiance from there, and the density per steradian with which it was drawn.
#[derive(Debug, Clone, Copy)]
pub(super) struct SkySample {
    pub direction: Vec3,
    pub radiance: Vec3,
    pub pdf: f32,
}

/// Luminance of linear Rec. 709.
pub(super) fn luminance(rgb: Vec3) -> f32 {
    rgb.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

impl Sky {
    pub fn new(environment: &Environment) -> Self {
        match environment {
            Environment::Constant(radiance) => Self::Constant(*radiance),
            Environment::Map(map) => Self::Map(SkyMap::new(map)),
        }
    }

    /// Radiance arriving from `direction` (unit, world) and the density with which `sample` draws it for a normal in `bin`.
    pub fn eval(&self, direction: Vec3, bin: NormalBin) -> (Vec3, f32) {
        match self {
            Self::Constant(radiance) => (*radiance, 0.0),
            Self::Map(map) => map.eval(direction, bin),
        }
    }
}

impl SkyMap {
    fn new(map: &EnvironmentMap) -> Self {
        let (width, height) = (map.image.width, map.image.height);
        let texels: Vec<Vec3> = (0..width * height).map(|i| Vec3::from(map.image.rgb(i))).collect();
        let (sin, cos) = map.rotation.sin_cos();
        let mut sky = Self { width, height, texels, turn: (cos, sin), sampling: None, power: 0.0 };
        let weights: Vec<f64> = (0..height).flat_map(|row| sky.row_weights(row)).collect();
        sky.power = weights.iter().sum::<f64>() as f32;
        sky.sampling = SkyCells::new(width, height, &weights, |at| sky.direction(at).0).map(Arc::new);
        sky
    }

    /// ∫ luminance dω over each texel of a row, of the bilinear read.
    fn row_weights(&self, row: usize) -> Vec<f64> {
        let (w, h) = (self.width, self.height);
        let mean = |column: usize| {
            // A bilinear read averages to ⅛, ¾, ⅛ of the texel and its neighbours, in each direction.
            [(row.saturating_sub(1), 0.125), (row, 0.75), ((row + 1).min(h - 1), 0.125)]
                .iter()
                .flat_map(|(r, a)| {
                    [((column + w - 1) % w, 0.125), (column, 0.75), ((column + 1) % w, 0.125)].map(|(c, b)| (r * w + c, a * b))
                })
                .map(|(i, weight)| weight * luminance(self.texels[i]).max(0.0) as f64)
                .sum::<f64>()
        };
        let edge = |r: usize| (std::f64::consts::PI * r as f64 / h as f64).cos();
        let solid_angle = (edge(row) - edge(row + 1)) * std::f64::consts::TAU / w as f64;
        (0..w).map(|column| mean(column) * solid_angle).collect()
    }

    /// Whether there is any light to draw directions by.
    pub fn can_be_sampled(&self) -> bool {
        self.sampling.is_some()
    }

    /// Radiance from `direction` and the density of `sample` there.
    pub fn eval(&self, direction: Vec3, bin: NormalBin) -> (Vec3, f32) {
        let (cos, sin) = self.turn;
        // The map's own direction: the world's, turned back about +Y.
        let (x, z) = (cos * direction.x - sin * direction.z, sin * direction.x + cos * direction.z);
        let longitude = (x.atan2(-z) * (1.0 / TAU)).rem_euclid(1.0);
        // Not √(1 − y²) and acos y, which lose all digits near the poles, where the density is 1/sin θ.
        let sine = (direction.x * direction.x + direction.z * direction.z).sqrt();
        let at = Vec2::new(longitude * self.width as f32, sine.atan2(direction.y) * (self.height as f32 / PI));
        (self.bilinear(at), self.density(at, sine, bin))
    }

    /// A direction in proportion to luminance × cosine to the normals in `bin`. None when the map is black.
    pub fn sample(&self, u: Vec2, bin: NormalBin) -> Option<SkySample> {
        let (at, density) = self.sampling.as_ref()?.sample(bin, u);
        let (direction, sine) = self.direction(at);
        // A position on the map holds 2π² sin θ steradian.
        (sine > 0.0).then(|| SkySample { direction, radiance: self.bilinear(at), pdf: density / (TAU * PI * sine) })
    }

    /// Where the map's place `at` (columns and rows) lies, and the sine of its polar angle.
    fn direction(&self, at: Vec2) -> (Vec3, f32) {
        let (sine, y) = (at.y * (PI / self.height as f32)).sin_cos();
        let (x, z) = (at.x * (TAU / self.width as f32)).sin_cos();
        let (x, z) = (sine * x, -sine * z);
        let (cos, sin) = self.turn;
        (Vec3::new(cos * x + sin * z, y, -sin * x + cos * z), sine)
    }

    /// Radiance at `at`: columns and rows, centres at half integers.
    #[inline]
    fn bilinear(&self, at: Vec2) -> Vec3 {
        let (x, y) = (at.x - 0.5, (at.y - 0.5).clamp(0.0, (self.height - 1) as f32));
        let (x0, y0) = (x.floor(), y.floor());
        let (top, bottom) = (y0 as usize, (y0 as usize + 1).min(self.height - 1));
        let left = if x0 < 0.0 { self.width - 1 } else { (x0 as usize).min(self.width - 1) };
        let right = if left + 1 == self.width { 0 } else { left + 1 };
        let row = |r: usize| self.texels[r * self.width + left].lerp(self.texels[r * self.width + right], x - x0);
        row(top).lerp(row(bottom), y - y0)
    }

    #[inline]
    fn density(&self, at: Vec2, sine: f32, bin: NormalBin) -> f32 {
        match &self.sampling {
            Some(cells) if sine > 0.0 => cells.density(bin, at) / (TAU * PI * sine),
            _ => 0.0,
        }
    }
}
