//! A measured isotropic surface: Matusik, Pfister, Brand & McMillan 2003 ("A Data-Driven Reflectance Model"), the tables of MERL.
//!
//! Values over Rusinkiewicz' half and difference angles (1998): 90 cells of θ_h with edges at 90° (i/90)², so that highlights are
//! resolved; 90 of θ_d and 180 of φ_d, a degree each. φ_d and φ_d + 180° share a cell, which makes the table reciprocal. A read takes
//! the cell it falls into, as the authors' own reader does; nothing is interpolated.
//!
//! Directions are drawn half from the cosine, half by a table of half vectors, in the proportion of the light that either reflects.
//! Measurements are noisy near the horizon: what a table reflects there may exceed what arrives.

use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

use glam::{Vec2, Vec3};

use super::lobes::{cosine_pdf, reflected, sample_highlight};
use super::{Brdf, BrdfError, BrdfUniform, above_horizon, half_vector, wrong};

/// Cells of θ_h, θ_d and φ_d.
pub const MEASURED_SHAPE: [usize; 3] = [90, 90, 180];

const HALVES: usize = MEASURED_SHAPE[0];
const TILTS: usize = MEASURED_SHAPE[1];
const TURNS: usize = MEASURED_SHAPE[2];

/// A table with what sampling it needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// `[(θ_h · 90 + θ_d) · 180 + φ_d]`, sr⁻¹.
    values: Vec<Vec3>,
    /// Probability that a half vector lies in the cells of θ_h up to this one; the last is 1.
    cumulative: Vec<f32>,
    /// 1 − cos of the cells' edges, one more than cells.
    edges: Vec<f32>,
    /// Probability that a direction is drawn by its half vector.
    highlight_share: f32,
}

/// More than any surface measured has, and sums of it stay finite.
const LARGEST_VALUE: f32 = 1e6;

impl Measured {
    /// `values`: sr⁻¹, 0 to 10⁶, φ_d fastest, then θ_d, then θ_h: [`MEASURED_SHAPE`].
    pub fn new(values: Vec<Vec3>) -> Result<Self, BrdfError> {
        if values.len() != HALVES * TILTS * TURNS {
            return Err(wrong("values", format!("a list of {}", values.len()), "90 × 90 × 180 values"));
        }
        if let Some(value) = values.iter().find(|v| !(v.is_finite() && v.min_element() >= 0.0 && v.max_element() <= LARGEST_VALUE)) {
            return Err(wrong("values", value, "numbers from 0 to 1e6"));
        }
        let edges: Vec<f64> = (0..=HALVES).map(|i| 2.0 * (0.5 * edge(i)).sin().powi(2)).collect();
        let means = mean_values(&values);
        // What the darkest part of the table has everywhere is left to the cosine.
        let base = means[..BASE_CELLS].iter().copied().fold(f64::INFINITY, f64::min);
        // A sample by half vector has density p(h) / (4 cos θ_d), and the light it carries f cos θ.
        let weight = |i: usize| (means[i] - base).max(LEAST_WEIGHT * means[i]) * (edges[i + 1] - edges[i]) * (1.0 - edges[i]);
        let weights: Vec<f64> = (0..HALVES).map(weight).collect();
        let total: f64 = weights.iter().sum();
        let mut sum = 0.0;
        let cumulative = weights.iter().map(|w| {
            sum += w;
            if total > 0.0 { (sum / total) as f32 } else { 1.0 }
        });
        // ∫ f cos of either part, roughly: π · base, and 4 · 2π · Σ weight.
        let (highlight, diffuse) = (8.0 * std::f64::consts::PI * total, std::f64::consts::PI * base);
        let share = if highlight > 0.0 { (highlight / (highlight + diffuse)).clamp(LEAST_SHARE, 1.0 - LEAST_SHARE) } else { 0.0 };
        Ok(Self {
            cumulative: cumulative.collect(),
            values,
            edges: edges.into_iter().map(|e| e as f32).collect(),
            highlight_share: share as f32,
        })
    }

    /// What the override `BRDF_MODEL` of `brdf.wgsl` is for tables.
    pub const NUMBER: u32 = 6;

    /// Its numbers for a pipeline whose `BRDF_MODEL` is [`Self::NUMBER`]; the table itself are its texels.
    pub fn uniform(&self) -> BrdfUniform {
        BrdfUniform { model: Self::NUMBER, specular_share: self.highlight_share, ..bytemuck::Zeroable::zeroed() }
    }

    /// How many [`Self::texels`] there are.
    pub const TEXELS: usize = HALVES * TILTS * TURNS + HALVES;

    /// What `measured_texel` of `brdf.wgsl` reads: the values, then, for every cell of θ_h, the probability of the cells before it, of those up to it, and 1 − cos
    /// of its edges.
    pub fn texels(&self) -> impl Iterator<Item = [f32; 4]> {
        let below = std::iter::once(0.0).chain(self.cumulative.iter().copied());
        let cells = self.cumulative.iter().zip(below).zip(self.edges.windows(2));
        self.values.iter().map(|v| v.extend(0.0).into()).chain(cells.map(|((up_to, below), edges)| [below, *up_to, edges[0], edges[1]]))
    }

    /// Density of half vectors per steradian.
    fn half_pdf(&self, h: Vec3) -> f32 {
        let cell = half_cell(h);
        let below = if cell == 0 { 0.0 } else { self.cumulative[cell - 1] };
        (self.cumulative[cell] - below) / (TAU * (self.edges[cell + 1] - self.edges[cell]))
    }

    fn sample_half(&self, u: Vec2) -> Vec3 {
        let cell = self.cumulative.partition_point(|c| *c <= u.x).min(HALVES - 1);
        let below = if cell == 0 { 0.0 } else { self.cumulative[cell - 1] };
        let within = ((u.x - below) / (self.cumulative[cell] - below)).clamp(0.0, 1.0);
        let off = self.edges[cell] + within * (self.edges[cell + 1] - self.edges[cell]);
        let radius = (off * (2.0 - off)).max(0.0).sqrt();
        let (sin, cos) = (TAU * u.y).sin_cos();
        Vec3::new(radius * cos, radius * sin, 1.0 - off).normalize()
    }
}

// Cells of θ_h up to 60°, beyond which measurements fail.
const BASE_CELLS: usize = 73;

// Cells that the base explains keep a share of their own: no half vector that reflects has density zero.
const LEAST_WEIGHT: f64 = 0.02;

// Neither way of sampling is given up: a table's diffuse part is a guess.
const LEAST_SHARE: f64 = 0.1;

/// Lower edge of a cell of θ_h, radians.
fn edge(cell: usize) -> f64 {
    std::f64::consts::FRAC_PI_2 * (cell as f64 / HALVES as f64).powi(2)
}

/// Mean of the channels over θ_d up to 70° and all φ_d, for every θ_h.
fn mean_values(values: &[Vec3]) -> Vec<f64> {
    const TILTS_USED: usize = 70;
    let mean = |i: usize| {
        let cells = &values[i * TILTS * TURNS..][..TILTS_USED * TURNS];
        cells.iter().map(|v| f64::from(v.element_sum())).sum::<f64>() / (3 * cells.len()) as f64
    };
    (0..HALVES).map(mean).collect()
}

/// The cell of θ_h that a half vector falls into.
#[inline]
fn half_cell(h: Vec3) -> usize {
    // Not acos, which has no digits left near the normal, where the cells are smallest.
    let theta = angle((h.x * h.x + h.y * h.y).sqrt(), h.z);
    (((theta / FRAC_PI_2).sqrt() * HALVES as f32) as usize).min(HALVES - 1)
}

/// Of (x, y) from +X, 0 to π, for y ≥ 0. By our own series (Cephes' `atanf`, S. L. Moshier), because WGSL leaves the accuracy of `atan2` to the device, and
/// cells are found by it.
#[inline]
fn angle(y: f32, x: f32) -> f32 {
    let (low, high) = (y.min(x.abs()), y.max(x.abs()));
    let ratio = if high > 0.0 { low / high } else { 0.0 };
    let is_steep = ratio > TAN_OF_AN_EIGHTH;
    let t = if is_steep { (ratio - 1.0) / (ratio + 1.0) } else { ratio };
    let z = t * t;
    let series = (((8.053_745e-2 * z - 1.387_768_6e-1) * z + 1.997_771_1e-1) * z - 3.333_295e-1) * z * t + t;
    let within = if is_steep { FRAC_PI_4 + series } else { series };
    let quadrant = if y > x.abs() { FRAC_PI_2 - within } else { within };
    if x < 0.0 { PI - quadrant } else { quadrant }
}

// tan(π/8)
const TAN_OF_AN_EIGHTH: f32 = 0.414_213_57;

/// Index of the value for two directions above the horizon.
fn index(wo: Vec3, wi: Vec3) -> usize {
    let (h, along) = half_vector(wo, wi);
    // θ_d by its sine, |wi − wo| / 2.
    let theta_d = angle(0.5 * (wi - wo).length(), along);
    // φ_d: of wi, around h, from the plane of h and the normal. x along the meridian (growing θ), y across it.
    let radius = (h.x * h.x + h.y * h.y).sqrt();
    let azimuth = if radius > 0.0 { Vec2::new(h.x, h.y) / radius } else { Vec2::X };
    let x = (azimuth.x * wi.x + azimuth.y * wi.y) * h.z - wi.z * radius;
    let y = azimuth.x * wi.y - azimuth.y * wi.x;
    // wo lies opposite: half a turn on, in the same cell.
    let turn = if y < 0.0 { angle(-y, -x) } else { angle(y, x) };
    let cell = |angle: f32, range: f32, count: usize| ((angle / range * count as f32) as usize).min(count - 1);
    (half_cell(h) * TILTS + cell(theta_d, FRAC_PI_2, TILTS)) * TURNS + cell(turn, PI, TURNS)
}

impl Brdf for Measured {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if above_horizon(wo, wi) { self.values[index(wo, wi)] } else { Vec3::ZERO }
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        sample_highlight(self, wo, u, self.highlight_share, |u| reflected(wo, self.sample_half(u)))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if !above_horizon(wo, wi) {
            return 0.0;
        }
        let (h, along) = half_vector(wo, wi);
        (1.0 - self.highlight_share) * cosine_pdf(wi) + self.highlight_share * self.half_pdf(h) / (4.0 * along)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_is_found_by_its_own_angles() {
        for (i, j, k) in [(0, 0, 0), (3, 20, 100), (12, 45, 179), (40, 60, 1), (55, 10, 90), (7, 80, 44)] {
            // A direction in the middle of the cell: the half vector at azimuth 1, wi around it.
            let theta_h = 0.5 * (edge(i) + edge(i + 1)) as f32;
            let (theta_d, phi_d) = ((j as f32 + 0.5).to_radians(), (k as f32 + 0.5).to_radians());
            let azimuth = Vec3::new(1f32.cos(), 1f32.sin(), 0.0);
            let h = theta_h.sin() * azimuth + theta_h.cos() * Vec3::Z;
            let (x, y) = (theta_h.cos() * azimuth - theta_h.sin() * Vec3::Z, Vec3::Z.cross(azimuth));
            let wi = theta_d.cos() * h + theta_d.sin() * (phi_d.cos() * x + phi_d.sin() * y);
            let wo = 2.0 * wi.dot(h) * h - wi;
            assert_eq!(index(wo, wi), (i * TILTS + j) * TURNS + k, "{i} {j} {k}");
            assert_eq!(index(wi, wo), index(wo, wi), "{i} {j} {k}");
        }
    }

    #[test]
    fn angles_are_those_of_the_library() {
        for (y, x) in [(0.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (1e-30, -1e-30)] {
            assert!((angle(y, x) - y.atan2(x)).abs() < 3e-7, "{y}, {x}");
        }
        for k in 0..4000 {
            let expected = k as f32 / 4000.0 * PI;
            let (y, x) = expected.sin_cos();
            assert!((angle(7.0 * y, 7.0 * x) - expected).abs() < 4e-7, "{expected}");
        }
    }

    #[test]
    fn a_table_of_the_wrong_size_or_with_a_number_that_is_none_is_refused() {
        let size = HALVES * TILTS * TURNS;
        assert!(Measured::new(vec![Vec3::ONE; size - 1]).unwrap_err().to_string().contains("90 × 90 × 180"));
        for bad in [f32::NAN, f32::INFINITY, -1.0, 2e38] {
            let mut values = vec![Vec3::ONE; size];
            values[77].y = bad;
            assert!(Measured::new(values).unwrap_err().to_string().ends_with("numbers from 0 to 1e6 expected"));
        }
        // Black is a surface too: nothing is ever lit, and nothing divides by zero.
        let black = Measured::new(vec![Vec3::ZERO; size]).unwrap();
        assert!(black.sample(Vec3::Z, Vec2::splat(0.3)).is_some_and(|(wi, pdf)| pdf > 0.0 && black.eval(Vec3::Z, wi) == Vec3::ZERO));
    }
}
