//! Fits of texels that share their directions and weights: everything but the samples is prepared once.
//!
//! With B the functions at the samples, W the weights, G = Bᵀ W B and D the penalty: S = G + τD = L Lᵀ for some τ, and L⁻¹ G L⁻ᵀ has eigenvalues μ
//! in [0, 1] and eigenvectors u. In the coordinates t = L⁻ᵀ u both G and D are diagonal, μ and (1 − μ)/τ, so that a λ costs as many operations as
//! there are functions: solution, residual, and the hat matrix' trace, which generalised cross-validation needs.

use std::f64::consts::TAU;

use glam::Vec3;
use pulp::Arch;

use super::eigen::eigen;
use super::nonnegative::{self, Checked};
use super::projection::interleaved;
use super::{Basis, HarmonicsFit, HarmonicsFitError, Penalty, Sign};
use super::{check_directions, check_length, check_numbers, check_penalty, check_weights, cross_validation, roughness};
use crate::directions::Harmonics;
use crate::fitting::cholesky::{Cholesky, dot};

/// Least squares with a penalty for one set of directions. Preparing it takes milliseconds (functions³), a texel microseconds.
#[derive(Debug, Clone)]
pub struct HarmonicsOperator {
    functions: usize,
    /// μ of each coordinate.
    spectrum: Vec<f64>,
    /// τ.
    shift: f64,
    /// `coordinates[functions · k ..]`: the coefficients that coordinate k stands for, t.
    coordinates: Vec<f64>,
    /// `projector[block · samples + sample][lane]` = weight · t · y(direction) of coordinate k = LANES · block + lane, zero past the last.
    projector: Vec<[f64; LANES]>,
    /// Weights scaled to a sum of 2π, so that λ means the same for any number of samples.
    weights: Vec<f64>,
    scale: f64,
    /// Samples with a weight above 0.
    samples: usize,
    checked: Checked,
}

/// A texel in the operator's coordinates.
struct Projected {
    /// Per channel.
    coordinates: [Vec<f64>; 3],
    /// Squares of the above, summed over channels.
    power: Vec<f64>,
    /// Σ weight · sample².
    energy: f64,
}

/// Least λ: rounding says as much about what the samples leave open, whose part must come from the penalty.
const LEAST_LAMBDA: f64 = 1e-12;
/// Coordinates projected at a time: with three channels their sums stay in registers.
const LANES: usize = 16;

impl HarmonicsOperator {
    /// `functions`: 1, 4, … 100; `directions`: unit, z ≥ 0 (1 part in 10³); `weights`: one per direction, ≥ 0, some above 0.
    pub fn new(basis: Basis, functions: usize, directions: &[Vec3], weights: &[f32]) -> Result<Self, HarmonicsFitError> {
        let harmonics = Harmonics::new(basis, functions)?;
        check_length("weights", weights.len(), directions.len())?;
        check_directions(directions)?;
        check_weights(weights)?;
        let scale = TAU / weights.iter().map(|&w| f64::from(w)).sum::<f64>();
        let weights: Vec<f64> = weights.iter().map(|&w| scale * f64::from(w)).collect();
        let rows = rows(harmonics, directions);
        let gram = gram(functions, &rows, &weights);
        let roughness = roughness(functions);
        let shift =
            if functions > 1 { (0..functions).map(|i| gram[functions * i + i]).sum::<f64>() / roughness.iter().sum::<f64>() } else { 1.0 };
        let (spectrum, coordinates) = diagonalise(functions, &gram, &roughness, shift).ok_or(HarmonicsFitError::NoSamples)?;
        let mut projector = vec![[0.0; LANES]; functions.div_ceil(LANES) * directions.len()];
        for (k, t) in coordinates.chunks_exact(functions).enumerate() {
            let block = projector[k / LANES * directions.len()..].iter_mut();
            for ((lanes, row), weight) in block.zip(rows.chunks_exact(functions)).zip(&weights) {
                lanes[k % LANES] = weight * dot(t, row);
            }
        }
        let samples = weights.iter().filter(|&&w| w > 0.0).count();
        let checked = Checked::new(harmonics);
        Ok(Self { functions, spectrum, shift, coordinates, projector, weights, scale, samples, checked })
    }

    /// One texel. `values`: one per direction, finite where the weight is above 0 (elsewhere they are not read).
    pub fn fit(&self, values: &[[f32; 3]], penalty: Penalty, sign: Sign) -> Result<HarmonicsFit, HarmonicsFitError> {
        check_length("values", values.len(), self.weights.len())?;
        check_penalty(penalty)?;
        let read = values.iter().zip(&self.weights).flat_map(|(value, &w)| value.map(|v| if w > 0.0 { v } else { 0.0 }));
        check_numbers("value", "a finite number", read, f32::is_finite)?;
        let projected = self.project(values);
        let lambda = match penalty {
            Penalty::Given(lambda) => lambda.max(LEAST_LAMBDA),
            Penalty::CrossValidated => least_lambda(|lambda| self.cross_validation(&projected, lambda)),
        };
        let shrinkage: Vec<f64> = self.spectrum.iter().map(|&mu| self.shrinkage(mu, lambda)).collect();
        let mut channels = projected.coordinates.each_ref().map(|channel| self.coefficients(channel, &shrinkage));
        if sign == Sign::NotNegative {
            let shrinkage: Vec<f64> = self.spectrum.iter().map(|&mu| self.shrinkage(mu, lambda.max(nonnegative::LEAST_LAMBDA))).collect();
            self.checked.lift(&mut channels, |x| self.solve(x, &shrinkage));
        }
        let (error, trace) = self.error_and_trace(&projected, lambda);
        Ok(HarmonicsFit {
            coefficients: interleaved(self.functions, &channels),
            squared_error: error / self.scale,
            parameters: 3.0 * trace,
            lambda,
        })
    }

    fn project(&self, values: &[[f32; 3]]) -> Projected {
        let read = |(value, &weight): (&[f32; 3], &f64)| if weight > 0.0 { value.map(f64::from) } else { [0.0; 3] };
        let values: Vec<[f64; 3]> = values.iter().zip(&self.weights).map(read).collect();
        let energy = values.iter().zip(&self.weights).map(|(value, weight)| weight * value.iter().map(|v| v * v).sum::<f64>()).sum();
        let mut coordinates = [0; 3].map(|_| Vec::with_capacity(self.functions + LANES));
        for block in self.projector.chunks_exact(values.len()) {
            let sums = Arch::new().dispatch(ProjectBlock { block, values: &values });
            coordinates.iter_mut().zip(sums).for_each(|(channel, sums)| channel.extend_from_slice(&sums));
        }
        let power = (0..self.functions).map(|k| coordinates.iter().map(|channel| channel[k] * channel[k]).sum()).collect();
        Projected { coordinates, power, energy }
    }

    /// Factor from a coordinate of b to one of the solution: 1 / (μ + λ(1 − μ)/τ).
    fn shrinkage(&self, mu: f64, lambda: f64) -> f64 {
        1.0 / (mu + lambda / self.shift * (1.0 - mu))
    }

    /// Squared error with weights of sum 2π, and the hat matrix' trace.
    fn error_and_trace(&self, projected: &Projected, lambda: f64) -> (f64, f64) {
        let (mut explained, mut trace) = (0.0, 0.0);
        for (&mu, power) in self.spectrum.iter().zip(&projected.power) {
            let s = self.shrinkage(mu, lambda);
            explained += power * s * (2.0 - mu * s);
            trace += mu * s;
        }
        // The difference is known to rounding errors of the whole: without the floor interpolation would look perfect.
        // Likewise rounding in μ would look like samples.
        ((projected.energy - explained).max(1e-13 * projected.energy), trace.min(self.samples as f64))
    }

    fn cross_validation(&self, projected: &Projected, lambda: f64) -> f64 {
        let (error, trace) = self.error_and_trace(projected, lambda);
        cross_validation(error, trace, self.samples)
    }

    fn coefficients(&self, projected: &[f64], shrinkage: &[f64]) -> Vec<f64> {
        let mut coefficients = vec![0.0; self.functions];
        for ((t, p), s) in self.coordinates.chunks_exact(self.functions).zip(projected).zip(shrinkage) {
            coefficients.iter_mut().zip(t).for_each(|(c, t)| *c += s * p * t);
        }
        coefficients
    }

    /// H⁻¹ x, H = G + λD.
    fn solve(&self, x: &mut [f64], shrinkage: &[f64]) {
        let along: Vec<f64> = self.coordinates.chunks_exact(self.functions).map(|t| dot(t, x)).collect();
        x.copy_from_slice(&self.coefficients(&along, shrinkage));
    }
}

/// Σ sample × projector for as many coordinates as there are lanes, per channel.
struct ProjectBlock<'a> {
    block: &'a [[f64; LANES]],
    values: &'a [[f64; 3]],
}

impl pulp::NullaryFnOnce for ProjectBlock<'_> {
    type Output = [[f64; LANES]; 3];

    #[inline(always)]
    fn call(self) -> Self::Output {
        let mut sums = [[0.0; LANES]; 3];
        for (row, value) in self.block.iter().zip(self.values) {
            for (sums, value) in sums.iter_mut().zip(value) {
                for lane in 0..LANES {
                    sums[lane] += value * row[lane];
                }
            }
        }
        sums
    }
}

/// The functions at every direction, one row each.
fn rows(harmonics: Harmonics, directions: &[Vec3]) -> Vec<f64> {
    let mut rows = vec![0.0; harmonics.functions() * directions.len()];
    for (row, direction) in rows.chunks_exact_mut(harmonics.functions()).zip(directions) {
        harmonics.evaluate(direction.as_dvec3().to_array(), row);
    }
    rows
}

/// Bᵀ W B.
fn gram(functions: usize, rows: &[f64], weights: &[f64]) -> Vec<f64> {
    let mut gram = vec![0.0; functions * functions];
    for (row, weight) in rows.chunks_exact(functions).zip(weights) {
        for (products, y) in gram.chunks_exact_mut(functions).zip(row) {
            products.iter_mut().zip(row).for_each(|(sum, other)| *sum += weight * y * other);
        }
    }
    gram
}

/// Eigenvalues μ of L⁻¹ G L⁻ᵀ and t = L⁻ᵀ u.
fn diagonalise(n: usize, gram: &[f64], roughness: &[f64], shift: f64) -> Option<(Vec<f64>, Vec<f64>)> {
    let mut sum = gram.to_vec();
    (0..n).for_each(|i| sum[n * i + i] += shift * roughness[i]);
    let cholesky = Cholesky::new(&sum, n)?;
    let mut inner = gram.to_vec();
    for _ in 0..2 {
        inner.chunks_exact_mut(n).for_each(|row| cholesky.solve_lower(row));
        inner = (0..n * n).map(|at| inner[n * (at % n) + at / n]).collect();
    }
    let (mut spectrum, mut coordinates) = eigen(n, inner);
    spectrum.iter_mut().for_each(|mu| *mu = mu.clamp(0.0, 1.0));
    coordinates.chunks_exact_mut(n).for_each(|u| cholesky.solve_upper(u));
    Some((spectrum, coordinates))
}

/// λ are tried from 10⁻¹² to 10², two a decade, then between the best one's neighbours by golden sections.
fn least_lambda(criterion: impl Fn(f64) -> f64) -> f64 {
    let at = |exponent: f64| criterion(10f64.powf(exponent));
    let exponents = (0..=28).map(|k| -12.0 + 0.5 * f64::from(k));
    // From the smoothest down: where nothing distinguishes them (NaN included), the smoothest is taken.
    let best = exponents.rev().fold((f64::INFINITY, 2.0), |best, exponent| {
        let value = at(exponent);
        if value < best.0 { (value, exponent) } else { best }
    });
    let ratio = 0.5 * (5f64.sqrt() - 1.0);
    let (mut low, mut high) = (best.1 - 0.5, best.1 + 0.5);
    for _ in 0..6 {
        let (a, b) = (high - ratio * (high - low), low + ratio * (high - low));
        if at(a) < at(b) { high = b } else { low = a }
    }
    10f64.powf(0.5 * (low + high))
}
