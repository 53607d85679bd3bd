//! Which directions to sample next, from what is known and what is not: greedy, by expected gain of information.
//!
//! Two parts, both in nats. First, how much a sample in direction d would tell of the parameters of the models at hand: ½ ln(1 + gᵀ C g/σ²),
//! where g is the model's derivative by its parameters and C their covariance after the samples there are (Chaloner and Verdinelli 1995,
//! "Bayesian experimental design", D-optimality), the mean over texels. Second, how much it would tell of lobes that nobody has seen: the same
//! of a Gaussian process over directions, as wide and high as the lobes that were found. The sum has diminishing returns, so that greedy choice
//! is within 1 − 1/e of the best set (Nemhauser et al. 1978).
//!
//! Candidates are directions of one space that all texels share; each texel has a frame of its own, and learns nothing from below its horizon.
//!
//! Where it fails: harmonics count in the second part only; what no sample hints at is only ever sought by spreading; what stands between a texel
//! and a candidate is not known here. Who calls it: `representations::parameter_map`, for a map that was fitted.

use glam::{DVec3, Mat3, Vec3};

use super::cholesky::Cholesky;
use super::{LEAST_COSINE, Lobe, Model, spread};

/// A texel as it is known.
#[derive(Debug, Clone)]
pub struct KnownTexel<'a> {
    /// Its model.
    pub model: &'a Model,
    /// Unit directions that it was sampled in, in its own frame.
    pub directions: &'a [[f32; 3]],
    /// From the space of the candidates into its own frame: a rotation.
    pub local_from_shared: Mat3,
    /// Standard deviation of a sample, in the samples' unit: what the model leaves; above 0.
    pub noise: f32,
}

/// A direction to sample next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Suggestion {
    /// One of the candidates.
    pub direction: [f32; 3],
    /// Information that it is expected to add to those before it: nats a texel.
    pub gain: f64,
}

/// ln m of a lobe that nobody has seen, where no other was: the fit's own prior.
const LOG_EXPONENT: f64 = 3.0;
/// Standard deviation of ln m before anything is seen: the fit's own prior.
const LOG_EXPONENT_DEVIATION: f64 = 1.2;
/// Height of a lobe that nobody has seen, as a part of the constants, where no other was.
const UNSEEN_HEIGHT: f64 = 0.1;
/// Standard deviation of a cosine power's exponent before anything is seen.
const COSINE_EXPONENT_DEVIATION: f64 = 1.0;
/// No sample is better than this part of what the model has: beyond it f64 tells nothing apart.
const LEAST_NOISE: f64 = 1e-4;
/// Samples that a process over directions looks at: more lie closer than lobes are wide.
const MOST_SAMPLES: usize = 512;
/// Texels that have a process: others are much like their neighbours.
const MOST_PROCESSES: usize = 8;

/// The `count` best of `candidates` (unit), best first; fewer if there are fewer that any texel sees. `texels` should be a few hundred of a map.
pub fn suggest(texels: &[KnownTexel<'_>], candidates: &[[f32; 3]], count: usize) -> Vec<Suggestion> {
    let mut known: Vec<Parameters> = texels.iter().filter_map(|texel| Parameters::new(texel, candidates)).collect();
    let mut unseen = unseen(texels, candidates);
    let is_seen = |at: &usize| texels.is_empty() || texels.iter().any(|texel| local(texel, &candidates[*at]).is_some());
    let mut free: Vec<usize> = (0..candidates.len()).filter(is_seen).collect();
    let mut suggestions = Vec::new();
    while suggestions.len() < count {
        let gain = |&at: &usize| {
            let parameters: f64 = known.iter().map(|texel| texel.gain(at)).sum();
            let processes: f64 = unseen.iter().map(|process| process.gain(at)).sum();
            parameters / texels.len().max(1) as f64 + processes / unseen.len().max(1) as f64
        };
        let best = free.iter().enumerate().map(|(place, at)| (place, *at, gain(at))).max_by(|a, b| a.2.total_cmp(&b.2));
        let Some((place, at, gain)) = best else { break };
        free.remove(place);
        known.iter_mut().for_each(|texel| texel.sample(at));
        unseen.iter_mut().for_each(|process| process.sample(at));
        suggestions.push(Suggestion { direction: candidates[at], gain });
    }
    suggestions
}

// None below the texel's horizon.
fn local(texel: &KnownTexel<'_>, candidate: &[f32; 3]) -> Option<[f32; 3]> {
    let direction = texel.local_from_shared * Vec3::from(*candidate);
    (direction.z > 0.0).then(|| direction.to_array())
}

fn information(signal: f64, noise: f64) -> f64 {
    0.5 * (1.0 + signal.max(0.0) / noise).ln()
}

/// Covariance of one texel's parameters, and the model's derivatives toward every candidate.
struct Parameters {
    covariance: Vec<f64>,
    /// Candidate by candidate.
    gradients: Vec<f64>,
    variance: f64,
}

impl Parameters {
    /// None for harmonics.
    fn new(texel: &KnownTexel<'_>, candidates: &[[f32; 3]]) -> Option<Self> {
        let deviations = deviations(texel.model)?;
        let size = deviations.len();
        let mut covariance = vec![0.0; size * size];
        deviations.iter().enumerate().for_each(|(i, deviation)| covariance[i * size + i] = deviation * deviation);
        let noise = f64::from(texel.noise).max(LEAST_NOISE * deviations[0]).max(f64::MIN_POSITIVE.sqrt());
        let toward = |d: &[f32; 3]| local(texel, d).map_or(vec![0.0; size], |d| gradient(texel.model, d));
        let gradients = candidates.iter().flat_map(toward).collect();
        let mut known = Self { covariance, gradients, variance: noise * noise };
        texel.directions.iter().for_each(|direction| known.learn(&gradient(texel.model, *direction)));
        Some(known)
    }

    fn toward(&self, at: usize) -> &[f64] {
        let size = self.covariance.len().isqrt();
        &self.gradients[at * size..(at + 1) * size]
    }

    fn spread(&self, g: &[f64]) -> Vec<f64> {
        self.covariance.chunks_exact(g.len()).map(|row| dot(row, g)).collect()
    }

    fn gain(&self, at: usize) -> f64 {
        let g = self.toward(at);
        information(dot(&self.spread(g), g), self.variance)
    }

    fn sample(&mut self, at: usize) {
        let g = self.toward(at).to_vec();
        self.learn(&g);
    }

    /// As if a sample with this derivative had been taken (Sherman and Morrison 1950).
    fn learn(&mut self, g: &[f64]) {
        let spread = self.spread(g);
        let total = self.variance + dot(&spread, g).max(0.0);
        for (row, a) in self.covariance.chunks_exact_mut(g.len()).zip(&spread) {
            row.iter_mut().zip(&spread).for_each(|(c, b)| *c -= a * b / total);
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Of the parameters before any sample: values about as large as the model, axes anywhere, exponents as usual. None for harmonics.
fn deviations(model: &Model) -> Option<Vec<f64>> {
    match model {
        Model::Constant { value } => Some(vec![f64::from(mean(*value))]),
        Model::CosinePower { value, .. } => Some(vec![f64::from(mean(*value)), COSINE_EXPONENT_DEVIATION]),
        Model::Lobes { constant, lobes } => {
            let scale = f64::from(mean(*constant)) + lobes.iter().map(|lobe| f64::from(mean(lobe.amplitude))).sum::<f64>();
            let of_lobe = |_: &Lobe| [scale, 1.0, 1.0, LOG_EXPONENT_DEVIATION];
            Some(std::iter::once(scale).chain(lobes.iter().flat_map(of_lobe)).collect())
        }
        Model::Harmonics { .. } => None,
    }
}

fn mean(channels: [f32; 3]) -> f32 {
    channels.iter().sum::<f32>() / 3.0
}

/// Derivatives of the channels' mean, in the order of `deviations`: by the constant or value; by a cosine's exponent; of each lobe by amplitude,
/// two turns of the axis, ln m.
fn gradient(model: &Model, direction: [f32; 3]) -> Vec<f64> {
    let d = DVec3::from(direction.map(f64::from));
    match model {
        Model::Constant { .. } | Model::Harmonics { .. } => vec![1.0],
        Model::CosinePower { value, exponent } => {
            let z = d.z.max(LEAST_COSINE.into());
            let height = z.powf(f64::from(*exponent));
            vec![height, f64::from(mean(*value)) * height * z.ln()]
        }
        Model::Lobes { lobes, .. } => std::iter::once(1.0).chain(lobes.iter().flat_map(|lobe| lobe_gradient(lobe, d))).collect(),
    }
}

fn lobe_gradient(lobe: &Lobe, d: DVec3) -> [f64; 4] {
    let axis = DVec3::from(lobe.axis.map(f64::from)).normalize_or(DVec3::Z);
    let (exponent, amplitude, cosine) = (f64::from(lobe.exponent), f64::from(mean(lobe.amplitude)), axis.dot(d));
    if cosine <= 0.0 {
        return [0.0; 4];
    }
    let height = cosine.powf(exponent);
    let (u, v) = axis.any_orthonormal_pair();
    let slope = amplitude * exponent * height / cosine;
    [height, slope * u.dot(d), slope * v.dot(d), amplitude * exponent * height * cosine.ln()]
}

// One process for each of a few texels, spread over `texels`; without any texel one that has seen nothing.
fn unseen(texels: &[KnownTexel<'_>], candidates: &[[f32; 3]]) -> Vec<Unseen> {
    let scale = scale(texels);
    if texels.is_empty() {
        return vec![Unseen::new(&[], candidates.iter().map(|d| Some(*d)).collect(), scale)];
    }
    let of = |texel: &KnownTexel<'_>| Unseen::new(texel.directions, candidates.iter().map(|d| local(texel, d)).collect(), scale);
    spread(texels.len().min(MOST_PROCESSES), texels.len()).map(|at| of(&texels[at])).collect()
}

/// Lobes that nobody has seen at a texel: a Gaussian process with kernel exp(−m (1 − d·d′)), about a lobe of exponent m, of variance 1. Memory and
/// time grow with candidates · samples.
struct Unseen {
    /// In the texel's frame; what it does not see is anywhere.
    candidates: Vec<[f32; 3]>,
    sees: Vec<bool>,
    exponent: f64,
    /// Of a sample, where the process has 1.
    noise: f64,
    /// Of each candidate.
    variance: Vec<f64>,
    /// For each candidate what the samples explain: the covariance of two is their kernel less the products of these.
    explained: Vec<Vec<f64>>,
}

impl Unseen {
    fn new(samples: &[[f32; 3]], candidates: Vec<Option<[f32; 3]>>, (exponent, noise): (f64, f64)) -> Self {
        let step = samples.len().div_ceil(MOST_SAMPLES).max(1);
        let samples: Vec<[f32; 3]> = samples.iter().step_by(step).copied().collect();
        let m = samples.len();
        let mut gram: Vec<f64> = samples.iter().flat_map(|a| samples.iter().map(move |b| kernel(exponent, a, b))).collect();
        (0..m).for_each(|i| gram[i * m + i] += noise);
        let factor = Cholesky::new(&gram, m);
        let explained = |candidate: &[f32; 3]| {
            let mut column: Vec<f64> = samples.iter().map(|sample| kernel(exponent, candidate, sample)).collect();
            match &factor {
                Some(factor) => factor.solve_lower(&mut column),
                // Samples that are not finite: as if there were none.
                None => column.clear(),
            }
            column
        };
        let sees = candidates.iter().map(Option::is_some).collect();
        let candidates: Vec<[f32; 3]> = candidates.into_iter().map(Option::unwrap_or_default).collect();
        let explained: Vec<Vec<f64>> = candidates.iter().map(explained).collect();
        let variance = explained.iter().map(|column| 1.0 - dot(column, column)).collect();
        Self { candidates, sees, exponent, noise, variance, explained }
    }

    fn gain(&self, at: usize) -> f64 {
        if self.sees[at] { information(self.variance[at], self.noise) } else { 0.0 }
    }

    fn sample(&mut self, at: usize) {
        if !self.sees[at] {
            return;
        }
        let (chosen, known) = (self.candidates[at], self.explained[at].clone());
        let root = (self.variance[at].max(0.0) + self.noise).sqrt();
        for ((candidate, column), variance) in self.candidates.iter().zip(&mut self.explained).zip(&mut self.variance) {
            let part = (kernel(self.exponent, candidate, &chosen) - dot(column, &known)) / root;
            column.push(part);
            *variance -= part * part;
        }
    }
}

fn kernel(exponent: f64, a: &[f32; 3], b: &[f32; 3]) -> f64 {
    let cosine: f64 = (0..3).map(|c| f64::from(a[c]) * f64::from(b[c])).sum();
    (exponent * (cosine - 1.0)).exp()
}

/// Exponent of a lobe as they are found, and the variance of a sample over that of a lobe's height.
fn scale(texels: &[KnownTexel<'_>]) -> (f64, f64) {
    let lobes = || {
        texels.iter().flat_map(|texel| match texel.model {
            Model::Lobes { lobes, .. } => lobes.as_slice(),
            _ => &[],
        })
    };
    let count = texels.len().max(1) as f64;
    let constants = texels.iter().map(|texel| match texel.model {
        Model::Constant { value } | Model::CosinePower { value, .. } | Model::Lobes { constant: value, .. } => f64::from(mean(*value)),
        Model::Harmonics { .. } => f64::from(mean(texel.model.eval([0.0, 0.0, 1.0]))),
    });
    let constant = constants.sum::<f64>() / count;
    let squares: f64 = lobes().map(|lobe| f64::from(mean(lobe.amplitude)).powi(2)).sum::<f64>() / count;
    let mut exponents: Vec<f64> = lobes().map(|lobe| f64::from(lobe.exponent)).collect();
    exponents.sort_by(f64::total_cmp);
    let exponent = exponents.get(exponents.len() / 2).copied().unwrap_or(LOG_EXPONENT.exp());
    let height = if squares > 0.0 { squares } else { (UNSEEN_HEIGHT * constant).powi(2) };
    let variance = texels.iter().map(|texel| f64::from(texel.noise).powi(2)).sum::<f64>() / count;
    // Never below what f64 tells apart.
    (exponent, (variance / height.max(f64::MIN_POSITIVE)).clamp(1e-6, 1e6))
}
