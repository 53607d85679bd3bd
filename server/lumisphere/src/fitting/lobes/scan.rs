//! Starts: where the residuals of a fit peak, and how much one more lobe there would explain, over a grid of exponents.
//!
//! The exponents are powers of two, so that a cosine's powers cost a multiplication each. A candidate is scored together with the
//! constant and the lobes there are: what they can explain of it counts for nothing.

use super::dense::Cholesky;
use super::normal::{dot, load};
use super::question::{Lobes, MAX_LOBES};
use super::solve::unit;
use crate::fitting::lanes::{GROUP, Lanes, Row};
use crate::fitting::sample::Sample;

/// Exponents tried at each peak.
pub const EXPONENTS: [f32; 5] = [2.0, 8.0, 32.0, 128.0, 512.0];
/// Most places looked at: peaks, and the centroid of the first.
pub const MAX_PLACES: usize = 4;
/// Cosine of the least angle between two peaks, 20°.
const APART: f64 = 0.94;

/// What the first pass leaves for the others.
#[derive(Clone, Copy)]
pub struct Scratch {
    /// Weighted residuals.
    residual: [Row; 3],
    /// Their sum over the channels, each in units of its noise: what stands out.
    height: Row,
    /// Mean weight of the channels.
    weight: Row,
    /// The lobes there are.
    lobes: [Row; MAX_LOBES],
}

/// Candidates of 16 lanes.
#[derive(Clone, Copy)]
pub struct Candidates {
    /// Unit directions.
    pub place: [[Row; 3]; MAX_PLACES],
    /// By how much the sum of squares would fall, per place and exponent.
    pub gain: [[Row; EXPONENTS.len()]; MAX_PLACES],
}

/// Candidates of one texel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Unit directions.
    pub place: [[f32; 3]; MAX_PLACES],
    /// By how much the sum of squares would fall, per place and exponent.
    pub gain: [[f32; EXPONENTS.len()]; MAX_PLACES],
}

impl Look {
    /// None yet.
    pub const NONE: Self = Self { place: [[0.0; 3]; MAX_PLACES], gain: [[0.0; EXPONENTS.len()]; MAX_PLACES] };
}

impl Candidates {
    /// Those of one lane.
    pub fn of_lane(&self, lane: usize) -> Look {
        Look { place: self.place.map(|rows| rows.map(|row| row[lane])), gain: self.gain.map(|rows| rows.map(|row| row[lane])) }
    }

    /// None yet.
    pub const NONE: Self = Self { place: [[[0.0; GROUP]; 3]; MAX_PLACES], gain: [[[0.0; GROUP]; EXPONENTS.len()]; MAX_PLACES] };
}

/// Scores `peaks` peaks, and the centroid of the first after them, of what `lobes` (J of them, Q = J + 1) leave.
#[inline(always)]
pub fn scan<V: Lanes, const J: usize, const Q: usize>(
    token: V::Token,
    samples: &[Sample],
    part: usize,
    lobes: &Lobes,
    peaks: usize,
    scratch: &mut Vec<Scratch>,
    out: &mut Candidates,
) {
    let (gram, slope) = prepare::<V, J, Q>(token, samples, part, lobes, scratch);
    let factor = Cholesky::new(token, &gram);
    let zero = V::splat(token, 0.0);
    let mut found = [[zero; 3]; MAX_PLACES];
    let peaks = peaks.min(MAX_PLACES - 1);
    for p in 0..=peaks {
        let place =
            if p < peaks { highest(token, samples, part, scratch, &found[..p]) } else { centroid(token, samples, part, scratch, found[0]) };
        found[p] = place;
        let gain = score::<V, J, Q>(token, samples, part, scratch, place, &factor, &slope);
        for c in 0..3 {
            place[c].store(&mut out.place[p][c], part);
        }
        for (gain, row) in gain.iter().zip(&mut out.gain[p]) {
            gain.store(row, part);
        }
    }
}

/// The middle of the residuals around a peak, which for a narrow lobe lies between views.
#[inline(always)]
fn centroid<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, scratch: &[Scratch], peak: [V; 3]) -> [V; 3] {
    let zero = V::splat(token, 0.0);
    let mut sum = peak.map(|x| x * V::splat(token, 1e-6));
    for (sample, kept) in samples.iter().zip(scratch) {
        let d = load::<V>(token, &sample.direction, part);
        let near = V::splat(token, APART).below(dot(peak, d));
        let height = V::load(token, &kept.height, part).max(zero).or(near, zero);
        // Squared, so that the peak outweighs the many samples of its foot.
        let pull = height * height;
        for c in 0..3 {
            sum[c] = pull.mul_add(d[c], sum[c]);
        }
    }
    unit(token, sum)
}

/// Residuals and lobes of every sample; the Gram matrix of the linear columns and their products with the residuals.
#[inline(always)]
fn prepare<V: Lanes, const J: usize, const Q: usize>(
    token: V::Token,
    samples: &[Sample],
    part: usize,
    lobes: &Lobes,
    scratch: &mut Vec<Scratch>,
) -> ([[V; Q]; Q], [[V; Q]; 3]) {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let mut exponent = [zero; J];
    let mut axis = [[zero; 3]; J];
    for j in 0..J {
        exponent[j] = V::load(token, &lobes.log_exponent[j], part).exp();
        axis[j] = load::<V>(token, &lobes.axis[j], part);
    }
    let mut linear = [[zero; 3]; Q];
    for i in 0..Q {
        linear[i] = load::<V>(token, &lobes.linear[i], part);
    }
    let (mut gram, mut slope) = ([[zero; Q]; Q], [[zero; Q]; 3]);
    let empty = Scratch { residual: [[0.0; GROUP]; 3], height: [0.0; GROUP], weight: [0.0; GROUP], lobes: [[0.0; GROUP]; MAX_LOBES] };
    scratch.resize(samples.len(), empty);
    for (sample, kept) in samples.iter().zip(scratch.iter_mut()) {
        let d = load::<V>(token, &sample.direction, part);
        let root = load::<V>(token, &sample.root_weight, part);
        let mut r = load::<V>(token, &sample.value, part);
        let mut a = [one; Q];
        for j in 0..J {
            let cosine = dot(axis[j], d);
            let log = cosine.max(V::splat(token, 1e-6)).ln();
            a[1 + j] = (exponent[j] * log).exp().or(zero.below(cosine), zero);
            a[1 + j].store(&mut kept.lobes[j], part);
        }
        let (mut weight, mut height) = (zero, zero);
        for c in 0..3 {
            for i in 0..Q {
                r[c] = (-linear[i][c]).mul_add(a[i], r[c]);
            }
            let w = root[c] * root[c];
            weight = weight + w;
            height = root[c].mul_add(r[c], height);
            r[c] = r[c] * w;
            r[c].store(&mut kept.residual[c], part);
        }
        height.store(&mut kept.height, part);
        let weight = weight * V::splat(token, 1.0 / 3.0);
        weight.store(&mut kept.weight, part);
        for i in 0..Q {
            for c in 0..3 {
                slope[c][i] = a[i].mul_add(r[c], slope[c][i]);
            }
            let x = a[i] * weight;
            for j in 0..=i {
                gram[i][j] = x.mul_add(a[j], gram[i][j]);
            }
        }
    }
    (gram, slope)
}

/// The direction with the largest residual, away from those found.
#[inline(always)]
fn highest<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, scratch: &[Scratch], found: &[[V; 3]]) -> [V; 3] {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let (mut most, mut peak) = (V::splat(token, -1e30), [zero, zero, one]);
    for (sample, kept) in samples.iter().zip(scratch) {
        let d = load::<V>(token, &sample.direction, part);
        let height = V::load(token, &kept.height, part);
        let mut higher = most.below(height) & zero.below(V::load(token, &kept.weight, part));
        for &other in found {
            higher = higher & dot(other, d).below(V::splat(token, APART));
        }
        most = height.or(higher, most);
        for c in 0..3 {
            peak[c] = d[c].or(higher, peak[c]);
        }
    }
    peak
}

/// What a lobe towards `peak` would gain, for each exponent.
#[inline(always)]
fn score<V: Lanes, const J: usize, const Q: usize>(
    token: V::Token,
    samples: &[Sample],
    part: usize,
    scratch: &[Scratch],
    peak: [V; 3],
    factor: &Cholesky<V, Q>,
    slope: &[[V; Q]; 3],
) -> [V; EXPONENTS.len()] {
    let zero = V::splat(token, 0.0);
    let (mut own, mut across, mut product) = ([zero; 5], [[zero; Q]; 5], [[zero; 3]; 5]);
    for (sample, kept) in samples.iter().zip(scratch) {
        let d = load::<V>(token, &sample.direction, part);
        let r = load::<V>(token, &kept.residual, part);
        let weight = V::load(token, &kept.weight, part);
        let mut a = [weight; Q];
        for j in 0..J {
            a[1 + j] = V::load(token, &kept.lobes[j], part) * weight;
        }
        let cosine = dot(peak, d).max(zero);
        // c², c⁸, c³² …
        let mut power = cosine * cosine;
        for k in 0..EXPONENTS.len() {
            own[k] = (power * power).mul_add(weight, own[k]);
            for i in 0..Q {
                across[k][i] = power.mul_add(a[i], across[k][i]);
            }
            for c in 0..3 {
                product[k][c] = power.mul_add(r[c], product[k][c]);
            }
            let square = power * power;
            power = square * square;
            // Powers of small cosines leave the normal numbers.
            power = power.or(V::splat(token, 1e-16).below(power), zero);
        }
    }
    let mut gain = [zero; EXPONENTS.len()];
    for k in 0..EXPONENTS.len() {
        let known = factor.solve(across[k]);
        let mut left = own[k];
        for i in 0..Q {
            left = (-known[i]).mul_add(across[k][i], left);
        }
        let sound = (own[k] * V::splat(token, 1e-4)).below(left) & V::splat(token, 1e-20).below(left);
        let left = left.or(sound, V::splat(token, 1.0));
        for c in 0..3 {
            let mut height = product[k][c];
            for i in 0..Q {
                height = (-known[i]).mul_add(slope[c][i], height);
            }
            let height = height.max(zero).or(sound, zero);
            gain[k] = gain[k] + height * height / left;
        }
    }
    gain
}
