//! Environment light: radiance from any direction, and directions drawn in proportion to it.
//!
//! A map is sampled by texel, with probability ∝ mean luminance · ∫ sin θ (Pharr, Jakob & Humphreys, "PBR" 4e, §12.5.3), then
//! uniformly in longitude and polar angle. The mean is that of the *bilinear* read, so no texel that shines has probability zero.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::distribution::Discrete;
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
    /// Choice of a row; choice of a column within each row that has light. None when the map is black.
    sampling: Option<(Discrete, Vec<Option<Discrete>>)>,
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

    /// Radiance arriving from `direction` (unit, world) and the density with which `sample` draws it.
    pub fn eval(&self, direction: Vec3) -> (Vec3, f32) {
        match self {
            Self::Constant(radiance) => (*radiance, 0.0),
            Self::Map(map) => map.eval(direction),
        }
    }
}

impl SkyMap {
    fn new(map: &EnvironmentMap) -> Self {
        let (width, height) = (map.image.width, map.image.height);
        let texels: Vec<Vec3> = (0..width * height).map(|i| Vec3::from(map.image.rgb(i))).collect();
        let (sin, cos) = map.rotation.sin_cos();
        let mut sky = Self { width, height, texels, turn: (cos, sin), sampling: None, power: 0.0 };
        let weights: Vec<Vec<f64>> = (0..height).map(|row| sky.row_weights(row)).collect();
        let rows: Vec<f64> = weights.iter().map(|w| w.iter().sum()).collect();
        sky.power = rows.iter().sum::<f64>() as f32;
        sky.sampling = Discrete::new(&rows).map(|rows| (rows, weights.iter().map(|w| Discrete::new(w)).collect()));
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

    /// Radiance from `direction` and the density of `sample` there.
    pub fn eval(&self, direction: Vec3) -> (Vec3, f32) {
        let (cos, sin) = self.turn;
        // The map's own direction: the world's, turned back about +Y.
        let (x, z) = (cos * direction.x - sin * direction.z, sin * direction.x + cos * direction.z);
        let longitude = (x.atan2(-z) * (1.0 / TAU)).rem_euclid(1.0);
        // Not √(1 − y²) and acos y, which lose all digits near the poles, where the density is 1/sin θ.
        let sine = (direction.x * direction.x + direction.z * direction.z).sqrt();
        let at = Vec2::new(longitude * self.width as f32, sine.atan2(direction.y) * (self.height as f32 / PI));
        (self.bilinear(at), self.density(at, sine))
    }

    /// A direction in proportion to luminance. None when the map is black.
    pub fn sample(&self, u: Vec2) -> Option<SkySample> {
        let (rows, columns) = self.sampling.as_ref()?;
        let (row, row_probability, v) = rows.choose(u.y);
        let (column, column_probability, h) = columns[row].as_ref()?.choose(u.x);
        let at = Vec2::new(column as f32 + h, row as f32 + v);
        let (sine, y) = (at.y * (PI / self.height as f32)).sin_cos();
        let (x, z) = (at.x * (TAU / self.width as f32)).sin_cos();
        let (x, z) = (sine * x, -sine * z);
        let (cos, sin) = self.turn;
        if !(sine > 0.0) {
            return None;
        }
        Some(SkySample {
            direction: Vec3::new(cos * x + sin * z, y, -sin * x + cos * z),
            radiance: self.bilinear(at),
            pdf: row_probability * column_probability * self.per_steradian(sine),
        })
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
    fn density(&self, at: Vec2, sine: f32) -> f32 {
        let Some((rows, columns)) = &self.sampling else { return 0.0 };
        let (column, row) = ((at.x as usize).min(self.width - 1), (at.y as usize).min(self.height - 1));
        match &columns[row] {
            Some(columns) if sine > 0.0 => rows.probability(row) * columns.probability(column) * self.per_steradian(sine),
            _ => 0.0,
        }
    }

    // 1 / solid angle of a texel at polar angle θ: dω = sin θ dθ dφ.
    #[inline]
    fn per_steradian(&self, sine: f32) -> f32 {
        (self.width * self.height) as f32 / (TAU * PI * sine)
    }
}
