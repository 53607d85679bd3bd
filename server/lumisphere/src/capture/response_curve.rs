//! Response of a camera, from photographs of one view with different exposures: which exposure a code stands for (Debevec and Malik 1997,
//! "Recovering high dynamic range radiance maps from photographs").
//!
//! With E a pixel's irradiance, t an exposure and z the code: g(z) = ln E + ln t + noise. As in the paper, g's 256 values are solved for by least
//! squares with a smoothness term. What differs, since each biases the chain of exposure ratios or the ends of the curve
//! (against OpenCV's CalibrateDebevec, with its command: `docs/rivals/exposures.py`):
//!
//! - **Weights** are the inverse of the variance that residuals show around a code, not a hat, and outliers count less (Huber).
//! - **Clipped** samples are not dropped: beyond the end one counts as its expectation there (Tobin 1958; by expectation maximisation). Otherwise
//!   only samples whose noise points inward would be left near the ends.
//! - **Smoothness** is that of g over ln(z / (256 − z)), on which power laws are straight at the dark end and shoulders at the bright one: codes that no
//!   pixel has are extrapolated so.
//! - **Monotone**: neighbours in the wrong order are pooled.
//!
//! Exposures determine g up to a constant (g(128) = 0 here) and up to ripples whose period is the exposure ratio; smoothness decides those.

use super::photograph::{CODES, ExposureStack};
use crate::fitting::cholesky::Cholesky;

/// ln exposure of each code, per channel, not decreasing, 0 at code 128.
#[derive(Debug, Clone, PartialEq)]
pub struct ResponseCurve {
    /// `ln_exposure[channel][code]`.
    pub ln_exposure: [[f32; CODES]; 3],
    /// Standard deviation of a sample's ln exposure around its pixel's, per channel and code: what merging weighs by.
    pub deviation: [[f32; CODES]; 3],
}

/// Why a stack says nothing about the response.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ResponseError {
    /// All exposures are alike.
    #[error("{photographs} photographs with the exposure {exposure}: expected at least two different ones")]
    OneExposure {
        /// How many there are.
        photographs: usize,
        /// That of all.
        exposure: f64,
    },
    /// Too few pixels of a channel are neither clipped nor dark in two exposures.
    #[error("channel {channel}: {usable} pixels are neither clipped nor dark in two exposures, expected at least {expected}")]
    TooFew {
        /// 0 red, 1 green, 2 blue.
        channel: usize,
        /// How many are.
        usable: usize,
        /// How many are needed.
        expected: usize,
    },
}

/// Fewer pixels than that leave gaps which the smoothness term alone would fill.
const FEWEST_PIXELS: usize = 32;
/// More pixels than that add nothing that can be seen.
const MOST_PIXELS: usize = 8_000;
/// Where g is 0.
const MIDDLE: usize = 128;
/// Rounds of weights, expectations and solutions.
const ROUNDS: usize = 4;
/// Weight of ∫ (d²g/du²)² du, u = [`logit`]. Ten times less or more is worse on each of the five curves that it was chosen on (straight, sRGB, power
/// 2.2, logarithm, filmic); likelihoods choose less, since rounding to codes is no noise, and let ripples through.
const SMOOTHNESS: f64 = 1e4;
/// Residuals beyond so many deviations count less.
const HUBER: f64 = 3.0;
/// Codes to each side over which deviations are averaged.
const SMOOTHED: usize = 6;
/// Smallest step of g between codes that a monotone curve keeps.
const LEAST_STEP: f64 = 1e-5;

/// One channel while it is solved.
struct Channel<'a> {
    ln_times: &'a [f64],
    /// `codes[photographs · pixel ..]`.
    codes: Vec<u8>,
    g: [f64; CODES],
    deviation: [f64; CODES],
    /// Inverse variance, and more: rounding to codes of several photographs goes together, so that a code's ln exposure is off by the order of its
    /// rounding variance however many samples there are. (Of a straight curve code 3 seems to be √2, not 3/2, times code 2's exposure.)
    weights: [f64; CODES],
    /// ln E of each pixel.
    pixels: Vec<f64>,
}

impl ResponseCurve {
    /// From a stack of at least two different exposures.
    pub fn recover(stack: &ExposureStack) -> Result<Self, ResponseError> {
        let exposures = stack.exposures();
        if exposures.iter().all(|&exposure| exposure == exposures[0]) {
            return Err(ResponseError::OneExposure { photographs: exposures.len(), exposure: exposures[0] });
        }
        let ln_times: Vec<f64> = exposures.iter().map(|exposure| exposure.ln()).collect();
        let mut curve = Self { ln_exposure: [[0.0; CODES]; 3], deviation: [[0.0; CODES]; 3] };
        for channel in 0..3 {
            let mut fit = Channel::new(&ln_times, stack, channel)?;
            for _ in 0..ROUNDS {
                fit.improve();
            }
            curve.ln_exposure[channel] = fit.g.map(|g| g as f32);
            curve.deviation[channel] = fit.deviation.map(|deviation| deviation as f32);
        }
        Ok(curve)
    }
}

/// What a sample says about ln E + ln t.
enum Said {
    /// g(code), with this weight.
    Code(f64),
    /// A value, with a weight.
    Value(f64, f64),
    Nothing,
}

impl<'a> Channel<'a> {
    /// Pixels with two usable samples, evenly spread over the image.
    fn new(ln_times: &'a [f64], stack: &ExposureStack, channel: usize) -> Result<Self, ResponseError> {
        let (width, height) = stack.size();
        let is_usable = |pixel: &usize| {
            let codes = stack.photographs().iter().map(|photograph| photograph.bytes[3 * pixel + channel]);
            codes.filter(|&code| is_inside(code)).count() >= 2
        };
        let usable: Vec<usize> = (0..width * height).filter(is_usable).collect();
        if usable.len() < FEWEST_PIXELS {
            return Err(ResponseError::TooFew { channel, usable: usable.len(), expected: FEWEST_PIXELS });
        }
        let chosen = usable.iter().step_by(usable.len().div_ceil(MOST_PIXELS));
        let codes: Vec<u8> =
            chosen.flat_map(|pixel| stack.photographs().iter().map(move |photograph| photograph.bytes[3 * pixel + channel])).collect();
        let g: [f64; CODES] = std::array::from_fn(|code| logit(code) - logit(MIDDLE));
        let mut fit = Self { ln_times, codes, g, deviation: [0.0; CODES], weights: [0.0; CODES], pixels: Vec::new() };
        // In the first round what is far from both ends counts most, as the paper's hat does it.
        fit.deviation = std::array::from_fn(|code| 2.0 / (1 + code.min(CODES - 1 - code)) as f64);
        fit.weights = fit.deviation.map(|deviation| 1.0 / (deviation * deviation));
        fit.pixels = vec![f64::NAN; fit.codes.len() / ln_times.len()];
        Ok(fit)
    }

    /// One round: solve with the present weights and expectations, then find the residuals' deviations.
    fn improve(&mut self) {
        let mut equations = Equations::new();
        for pixel in 0..self.pixels.len() {
            let samples: Vec<(u8, Said, f64)> = self.samples(pixel).collect();
            equations.add_pixel(&samples);
        }
        let Some(g) = equations.solve() else { return };
        self.g = monotone(g, &equations.counts);
        self.place_pixels();
        self.deviation = self.deviations();
        self.weights = std::array::from_fn(|z| {
            let variance = self.deviation[z].powi(2);
            let rounding = 2.0 * self.slope(z).powi(2) / 12.0;
            1.0 / (variance + equations.counts[z] * rounding * rounding)
        });
    }

    /// dg/dz.
    fn slope(&self, z: usize) -> f64 {
        0.5 * (self.g[(z + 1).min(CODES - 1)] - self.g[z.saturating_sub(1)]).max(2.0 * LEAST_STEP)
    }

    /// Code, what it says, and ln t, of a pixel's samples.
    fn samples(&self, pixel: usize) -> impl Iterator<Item = (u8, Said, f64)> {
        let codes = &self.codes[self.ln_times.len() * pixel..];
        codes.iter().zip(self.ln_times).map(move |(&code, &ln_time)| (code, self.said(code, self.pixels[pixel] + ln_time), ln_time))
    }

    /// `expected`: present ln E + ln t, NaN in the first round.
    fn said(&self, code: u8, expected: f64) -> Said {
        let z = usize::from(code);
        if is_inside(code) {
            let residual = ((expected - self.g[z]) / self.deviation[z]).abs();
            let weight = self.weights[z];
            return Said::Code(if residual > HUBER { weight * HUBER / residual } else { weight });
        }
        if code == 0 || expected.is_nan() {
            return Said::Nothing;
        }
        // The end lies half a code below the last.
        let (end, deviation) = (0.5 * (self.g[CODES - 2] + self.g[CODES - 1]), self.deviation[CODES - 2]);
        let above = (end - expected) / deviation;
        // Far above it says nothing, far below it is wrong.
        if !(above.abs() < 4.0) {
            return Said::Nothing;
        }
        Said::Value(expected + deviation * mean_above(above), 1.0 / (deviation * deviation))
    }

    /// ln E of every pixel: the weighted mean of what its samples say.
    fn place_pixels(&mut self) {
        let place = |pixel: usize| {
            let (mut sum, mut weights) = (0.0, 0.0);
            for (code, said, ln_time) in self.samples(pixel) {
                let (value, weight) = match said {
                    Said::Code(weight) => (self.g[usize::from(code)], weight),
                    Said::Value(value, weight) => (value, weight),
                    Said::Nothing => continue,
                };
                sum += weight * (value - ln_time);
                weights += weight;
            }
            sum / weights
        };
        self.pixels = (0..self.pixels.len()).map(place).collect();
    }

    /// Root mean square residual around each code, smoothed over neighbours, not below what rounding to codes leaves.
    fn deviations(&self) -> [f64; CODES] {
        let (mut squares, mut counts) = ([0.0; CODES], [0.0; CODES]);
        for (pixel, place) in self.pixels.iter().enumerate() {
            let samples = || self.samples(pixel);
            let inside = samples().filter(|(code, ..)| is_inside(*code)).count() as f64;
            for (code, _, ln_time) in samples().filter(|(code, ..)| is_inside(*code)) {
                let z = usize::from(code);
                // Clipped so that outliers do not widen it, and less its share in the pixel's own place.
                let residual =
                    (place + ln_time - self.g[z]).abs().min(if self.deviation[z] > 0.0 { HUBER * self.deviation[z] } else { f64::MAX });
                squares[z] += residual * residual * inside / (inside - 1.0);
                counts[z] += 1.0;
            }
        }
        std::array::from_fn(|z| {
            let near = z.saturating_sub(SMOOTHED)..(z + SMOOTHED + 1).min(CODES);
            // In codes: a slope of g that changes over the neighbours must not matter.
            let (sum, count) = near.fold((0.0, 0.0), |(sum, count), k| (sum + squares[k] / self.slope(k).powi(2), count + counts[k]));
            let variance = if count > 0.0 { (sum / count).max(1.0 / 12.0) } else { 1.0 };
            self.slope(z) * variance.sqrt()
        })
    }
}

/// Neither clipped nor dark.
pub(super) fn is_inside(code: u8) -> bool {
    (1..=254).contains(&code)
}

/// The scale on which curves are smooth: a power law is straight at the dark end, a shoulder at the bright one.
fn logit(code: usize) -> f64 {
    let z = (code as f64).max(0.5);
    (z / (256.0 - z)).ln()
}

/// E[x | x > a] of a standard normal x: density over tail, by the tail's continued fraction (Abramowitz and Stegun 26.2.14) where it is
/// small and by its rational approximation (26.2.17, error below 10⁻⁷) elsewhere.
fn mean_above(a: f64) -> f64 {
    let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
    let tail = |x: f64| {
        let t = 1.0 / (1.0 + 0.231_641_9 * x);
        let polynomial = [1.330_274_429, -1.821_255_978, 1.781_477_937, -0.356_563_782, 0.319_381_530];
        density(x) * polynomial.iter().fold(0.0, |sum, factor| (sum + factor) * t)
    };
    if a > 3.0 {
        return a + 1.0 / (a + 2.0 / (a + 3.0 / (a + 4.0 / a)));
    }
    density(a) / if a < 0.0 { 1.0 - tail(-a) } else { tail(a) }
}

/// Normal equations of g, the pixels' own unknowns eliminated.
struct Equations {
    matrix: Vec<f64>,
    right: Vec<f64>,
    /// Samples of each code.
    counts: [f64; CODES],
}

impl Equations {
    fn new() -> Self {
        Self { matrix: vec![0.0; CODES * CODES], right: vec![0.0; CODES], counts: [0.0; CODES] }
    }

    /// Σ w (ln E + ln t − v)² at the best ln E, v being g or a known value.
    fn add_pixel(&mut self, samples: &[(u8, Said, f64)]) {
        let weight = |said: &Said| match said {
            Said::Code(weight) | Said::Value(_, weight) => *weight,
            Said::Nothing => 0.0,
        };
        let total: f64 = samples.iter().map(|(_, said, _)| weight(said)).sum();
        let ln_time = samples.iter().map(|(_, said, ln_time)| weight(said) * ln_time).sum::<f64>() / total;
        let known =
            samples.iter().map(|(_, said, _)| if let Said::Value(value, weight) = said { weight * value } else { 0.0 }).sum::<f64>();
        let inside = || {
            samples.iter().filter_map(|(code, said, t)| if let Said::Code(w) = said { Some((usize::from(*code), *w, *t)) } else { None })
        };
        for (z, w, t) in inside() {
            self.matrix[CODES * z + z] += w;
            self.right[z] += w * (t - ln_time + known / total);
            self.counts[z] += 1.0;
            let row = &mut self.matrix[CODES * z..CODES * (z + 1)];
            for (other, weight, _) in inside() {
                row[other] -= w * weight / total;
            }
        }
    }

    /// None where there is nothing to solve, in which case the present curve stands.
    fn solve(&self) -> Option<[f64; CODES]> {
        let mut matrix = self.matrix.clone();
        for z in 1..CODES - 1 {
            let (below, above) = (logit(z) - logit(z - 1), logit(z + 1) - logit(z));
            let (left, right) = (2.0 / (below * (below + above)), 2.0 / (above * (below + above)));
            let stencil = [(z - 1, left), (z, -left - right), (z + 1, right)];
            let weight = SMOOTHNESS * 0.5 * (below + above);
            for ((i, a), (k, b)) in stencil.iter().flat_map(|a| stencil.iter().map(move |b| (*a, *b))) {
                matrix[CODES * i + k] += weight * a * b;
            }
        }
        // Exposures do not say where g lies.
        matrix[CODES * MIDDLE + MIDDLE] += 1e6;
        let mut g: [f64; CODES] = self.right.as_slice().try_into().ok()?;
        Cholesky::new(&matrix, CODES)?.solve(&mut g);
        Some(g)
    }
}

/// The nearest curve that rises: neighbours in the wrong order are pooled to their weighted mean (Ayer and others 1955), then kept a little apart.
fn monotone(g: [f64; CODES], counts: &[f64; CODES]) -> [f64; CODES] {
    // (mean, weight, codes)
    let mut pools: Vec<(f64, f64, usize)> = Vec::with_capacity(CODES);
    for (value, count) in g.into_iter().zip(counts) {
        // Where no sample is the smoothness term decides, with little say against any sample.
        let mut pool = (value, count + 1e-3, 1);
        while let Some(&(mean, weight, codes)) = pools.last().filter(|last| last.0 > pool.0) {
            pools.pop();
            let sum = weight + pool.1;
            pool = ((mean * weight + pool.0 * pool.1) / sum, sum, codes + pool.2);
        }
        pools.push(pool);
    }
    let mut rising: [f64; CODES] = [0.0; CODES];
    let pooled = pools.iter().flat_map(|&(mean, _, codes)| std::iter::repeat_n(mean, codes));
    rising.iter_mut().zip(pooled).for_each(|(rising, value)| *rising = value);
    for z in 1..CODES {
        rising[z] = rising[z].max(rising[z - 1] + LEAST_STEP);
    }
    rising.map(|value| value - rising[MIDDLE])
}
