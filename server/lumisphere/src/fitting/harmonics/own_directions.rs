//! Fits of texels that each have directions and weights of their own: functions and normal equations in one go, in single precision.
//!
//! The rows √w · (y₁ … yₙ, r, g, b) of a texel make one matrix, whose products with itself are all that the fit needs: Gram matrix, right-hand sides
//! and energy. They are summed in tiles that stay in vector registers; what follows, functions³, is in double precision.

use std::f64::consts::TAU;

use pulp::{Arch, Simd, WithSimd};

use super::nonnegative::Checked;
use super::projection::interleaved;
use super::{
    Basis, HarmonicsFit, HarmonicsFitError, Penalty, Sign, check_length, check_numbers, check_penalty, check_weights, cross_validation,
    roughness,
};
use crate::directions::{Harmonics, MOST_FUNCTIONS};
use crate::fitting::cholesky::{Cholesky, dot};

/// One texel's samples, coordinate by coordinate; all lists are equally long.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a> {
    /// Coordinates x, y, z of the directions: unit, z ≥ 0.
    pub directions: [&'a [f32]; 3],
    /// The three channels; finite where the weight is above 0, elsewhere not read.
    pub values: [&'a [f32]; 3],
    /// ≥ 0; 0 masks a sample.
    pub weights: &'a [f32],
}

/// Least squares with a penalty for texels of one basis and number of functions.
#[derive(Debug, Clone)]
pub struct OwnDirectionsFit {
    harmonics: Harmonics,
    roughness: Vec<f64>,
    checked: Checked,
}

/// What a texel's samples say, in double precision; values less their mean.
struct NormalEquations {
    gram: Vec<f64>,
    right: [Vec<f64>; 3],
    energy: f64,
    mean: [f64; 3],
    scale: f64,
    samples: usize,
}

/// One λ's solution.
struct Solution {
    factor: Cholesky,
    channels: [Vec<f64>; 3],
    /// With weights of sum 2π.
    error: f64,
    trace: f64,
    lambda: f64,
}

/// Samples whose functions are evaluated at a time, and columns of a tile.
const LANES: usize = 16;
/// Rows of a tile.
const ROWS: usize = 8;
/// Least λ: what the penalty says of degree 1, 4 λ, must stand out of the Gram matrix' rounding, some 10⁻⁷ of 2π.
const LEAST_LAMBDA: f64 = 1e-6;

impl OwnDirectionsFit {
    /// `functions`: 1, 4, … 100.
    pub fn new(basis: Basis, functions: usize) -> Result<Self, HarmonicsFitError> {
        let harmonics = Harmonics::new(basis, functions)?;
        Ok(Self { harmonics, roughness: roughness(functions), checked: Checked::new(harmonics) })
    }

    /// One texel. λ below 10⁻⁶ counts as that; where the samples leave functions open it is raised until the equations can be solved.
    pub fn fit(&self, samples: Samples, penalty: Penalty, sign: Sign) -> Result<HarmonicsFit, HarmonicsFitError> {
        check(samples)?;
        check_penalty(penalty)?;
        let equations = self.normal_equations(samples);
        let solution = match penalty {
            Penalty::Given(lambda) => self.solve(&equations, lambda),
            Penalty::CrossValidated => self.cross_validated(&equations),
        };
        let solution = solution.ok_or(HarmonicsFitError::NoSamples)?;
        let mut channels = solution.channels;
        let constant = self.constant();
        channels.iter_mut().zip(equations.mean).for_each(|(channel, mean)| channel[0] += mean / constant);
        if sign == Sign::NotNegative {
            self.checked.lift(&mut channels, |x| solution.factor.solve(x));
        }
        Ok(HarmonicsFit {
            coefficients: interleaved(self.harmonics.functions(), &channels),
            squared_error: solution.error / equations.scale,
            parameters: 3.0 * solution.trace,
            lambda: solution.lambda,
        })
    }

    /// The first function.
    fn constant(&self) -> f64 {
        let mut value = [0.0];
        self.harmonics.evaluate([0.0, 0.0, 1.0], &mut value);
        value[0]
    }

    fn normal_equations(&self, samples: Samples) -> NormalEquations {
        let functions = self.harmonics.functions();
        let columns = functions + 3;
        let total: f64 = samples.weights.iter().map(|&w| f64::from(w)).sum();
        let weighted = |values: &[f32]| {
            values.iter().zip(samples.weights).filter(|(_, w)| **w > 0.0).map(|(v, w)| f64::from(*v) * f64::from(*w)).sum()
        };
        let mean = samples.values.map(|values| {
            let sum: f64 = weighted(values);
            sum / total
        });
        let scale = TAU / total;
        let stride = columns.next_multiple_of(LANES);
        let mut rows = vec![0f32; stride * samples.weights.len()];
        let mut products = vec![0f32; stride * stride];
        Arch::new().dispatch(Products {
            harmonics: self.harmonics,
            samples,
            mean: mean.map(|mean| mean as f32),
            scale: scale as f32,
            stride,
            rows: &mut rows,
            products: &mut products,
        });
        let product = |i: usize, k: usize| f64::from(products[stride * i.max(k) + i.min(k)]);
        NormalEquations {
            gram: (0..functions * functions).map(|at| product(at / functions, at % functions)).collect(),
            right: [0, 1, 2].map(|channel| (0..functions).map(|k| product(functions + channel, k)).collect()),
            energy: (functions..columns).map(|channel| product(channel, channel)).sum(),
            mean,
            scale,
            samples: samples.weights.iter().filter(|&&w| w > 0.0).count(),
        }
    }

    fn solve(&self, equations: &NormalEquations, lambda: f64) -> Option<Solution> {
        let n = self.roughness.len();
        let mut lambda = lambda.max(LEAST_LAMBDA);
        let factor = loop {
            let mut matrix = equations.gram.clone();
            (0..n).for_each(|i| matrix[n * i + i] += lambda * self.roughness[i]);
            match Cholesky::new(&matrix, n) {
                Some(factor) => break factor,
                None if lambda < 1e3 => lambda *= 10.0,
                None => return None,
            }
        };
        let channels = equations.right.each_ref().map(|right| {
            let mut channel = right.clone();
            factor.solve(&mut channel);
            channel
        });
        let rough = |c: &[f64]| c.iter().zip(&self.roughness).map(|(c, d)| d * c * c).sum::<f64>();
        let explained: f64 = channels.iter().zip(&equations.right).map(|(c, b)| dot(c, b) + lambda * rough(c)).sum();
        let held: f64 = factor.inverse_diagonal().iter().zip(&self.roughness).map(|(inverse, d)| inverse * d).sum();
        // Single precision knows the energy to a few parts in 10⁷.
        let error = (equations.energy - explained).max(1e-7 * equations.energy);
        // Rounding in the Gram matrix looks like samples, of which there are no more than there are.
        let trace = (n as f64 - lambda * held).min(equations.samples as f64);
        Some(Solution { factor, channels, error, trace, lambda })
    }

    /// λ by decades from the smoothest down, then at the vertex of the parabola through the best and its neighbours.
    fn cross_validated(&self, equations: &NormalEquations) -> Option<Solution> {
        let criterion = |s: &Solution| cross_validation(s.error, s.trace, equations.samples).ln();
        let solutions = (0..=6).filter_map(|k| self.solve(equations, 10f64.powi(-k)));
        let tried: Vec<(f64, Solution)> = solutions.map(|s| (criterion(&s), s)).collect();
        let best = (0..tried.len()).fold(0, |best, at| if tried[at].0 < tried[best].0 { at } else { best });
        let neighbours = best.checked_sub(1).and_then(|before| Some((tried.get(before)?.0, tried.get(best)?.0, tried.get(best + 1)?.0)));
        let vertex = neighbours.map(|(before, middle, after)| 0.5 * (before - after) / (before - 2.0 * middle + after));
        let (value, at_best) = tried.into_iter().nth(best)?;
        let Some(shift) = vertex.filter(|shift| shift.abs() <= 1.0) else { return Some(at_best) };
        let between = self.solve(equations, at_best.lambda * 10f64.powf(-shift))?;
        Some(if criterion(&between) < value { between } else { at_best })
    }
}

fn check(samples: Samples) -> Result<(), HarmonicsFitError> {
    let [x, y, z] = samples.directions;
    for (what, list) in
        [("x coordinates", x), ("y coordinates", y), ("z coordinates", z)].into_iter().chain(samples.values.map(|v| ("values", v)))
    {
        check_length(what, list.len(), samples.weights.len())?;
    }
    let lengths = x.iter().zip(y).zip(z).map(|((x, y), z)| x * x + y * y + z * z);
    check_numbers("squared length of direction", "1", lengths, |square| (square - 1.0).abs() < 2e-3)?;
    check_numbers("height of direction", "at least 0", z.iter().copied(), |z| z >= 0.0)?;
    check_weights(samples.weights)?;
    for values in samples.values {
        let read = values.iter().zip(samples.weights).map(|(v, w)| if *w > 0.0 { *v } else { 0.0 });
        check_numbers("value", "a finite number", read, f32::is_finite)?;
    }
    Ok(())
}

/// A matrix of rows, one a sample, and the lower half of its transpose times itself. (A type, because only its method is inlined into the code
/// for the widest registers that the processor has; a closure is not.)
struct Products<'a> {
    harmonics: Harmonics,
    samples: Samples<'a>,
    mean: [f32; 3],
    scale: f32,
    stride: usize,
    rows: &'a mut [f32],
    products: &'a mut [f32],
}

impl WithSimd for Products<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        self.fill_rows();
        self.multiply(simd);
    }
}

impl Products<'_> {
    /// `rows[stride · sample ..]` = √(scale · weight) · (functions, values − mean), zero where the weight is and past the last column.
    #[inline(always)]
    fn fill_rows(&mut self) {
        let functions = self.harmonics.functions();
        let weights = self.samples.weights;
        let mut lanes = [[0f32; LANES]; MOST_FUNCTIONS];
        for (at, block) in self.rows.chunks_mut(self.stride * LANES).enumerate() {
            let first = at * LANES;
            let count = block.len() / self.stride;
            let load = |list: &[f32]| -> [f32; LANES] { std::array::from_fn(|lane| if lane < count { list[first + lane] } else { 0.0 }) };
            let [x, y, z] = self.samples.directions.map(load);
            self.harmonics.evaluate_lanes(&x, &y, &z, &mut lanes);
            for (lane, row) in block.chunks_exact_mut(self.stride).enumerate().filter(|(lane, _)| weights[first + lane] > 0.0) {
                let root = (self.scale * weights[first + lane]).sqrt();
                for (value, lanes) in row.iter_mut().zip(&lanes[..functions]) {
                    *value = root * lanes[lane];
                }
                for channel in 0..3 {
                    row[functions + channel] = root * (self.samples.values[channel][first + lane] - self.mean[channel]);
                }
            }
        }
    }

    /// Tile by tile, each from all samples: a register wide and [`ROWS`] high.
    #[inline(always)]
    fn multiply<S: Simd>(&mut self, simd: S) {
        let (stride, columns) = (self.stride, self.harmonics.functions() + 3);
        for column in (0..columns).step_by(S::F32_LANES) {
            for row in (column..columns).step_by(ROWS) {
                let mut sums = [simd.splat_f32s(0.0); ROWS];
                for sample in self.rows.chunks_exact(stride) {
                    let right = simd.partial_load_f32s(&sample[column..column + S::F32_LANES]);
                    let Some(left) = sample[row..].first_chunk::<ROWS>() else { continue };
                    for at in 0..ROWS {
                        sums[at] = simd.mul_add_f32s(simd.splat_f32s(left[at]), right, sums[at]);
                    }
                }
                for (sum, out) in sums.into_iter().zip(self.products[stride * row..].chunks_exact_mut(stride)) {
                    simd.partial_store_f32s(&mut out[column..column + S::F32_LANES], sum);
                }
            }
        }
    }
}
