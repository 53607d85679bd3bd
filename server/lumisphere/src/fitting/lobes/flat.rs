//! The rungs below the lobes: a constant, and `value · z^a` (what a texel looks like whose highlight nobody saw, darkening towards the
//! horizon).

use super::normal::load;
use crate::fitting::lanes::{GROUP, Lanes, Row};
use crate::fitting::model::LEAST_COSINE;
use crate::fitting::sample::Sample;

/// Range of the exponent `a`.
const EXPONENTS: (f64, f64) = (-1.0, 8.0);
/// Gauss–Newton steps in `a`, one unknown and a smooth one: it is found to three digits.
const STEPS: usize = 5;

/// Both rungs of 16 lanes.
#[derive(Clone, Copy)]
pub struct Flat {
    /// The constant.
    pub constant: [Row; 3],
    /// Its weighted sum of squared residuals.
    pub constant_cost: Row,
    /// Towards the normal.
    pub value: [Row; 3],
    /// `a`.
    pub exponent: Row,
    /// Sum of squared residuals of the power.
    pub cost: Row,
}

impl Flat {
    /// All zero.
    pub const NONE: Self = Self {
        constant: [[0.0; GROUP]; 3],
        constant_cost: [0.0; GROUP],
        value: [[0.0; GROUP]; 3],
        exponent: [0.0; GROUP],
        cost: [0.0; GROUP],
    };
}

/// `value` at one exponent, and the slope and curvature of the cost there.
#[derive(Clone, Copy)]
struct At<V> {
    value: [V; 3],
    cost: V,
    step: V,
}

/// The best value at exponent `a`, residuals under the guess `old`.
#[inline(always)]
fn at<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, a: V, old: [V; 3]) -> At<V> {
    let zero = V::splat(token, 0.0);
    let [mut own, mut residual, mut across, mut slope, mut inner] = [[zero; 3]; 5];
    let mut cost = zero;
    for sample in samples {
        let log = V::load(token, &sample.direction[2], part).max(V::splat(token, f64::from(LEAST_COSINE))).ln();
        let (values, roots) = (load::<V>(token, &sample.value, part), load::<V>(token, &sample.root_weight, part));
        let f = (a * log).exp();
        let by_a = f * log;
        for c in 0..3 {
            let w = roots[c] * roots[c];
            let r = (-old[c]).mul_add(f, values[c]);
            let (wf, wd) = (w * f, w * by_a);
            own[c] = wf.mul_add(f, own[c]);
            residual[c] = wf.mul_add(r, residual[c]);
            across[c] = wf.mul_add(by_a, across[c]);
            slope[c] = wd.mul_add(r, slope[c]);
            inner[c] = wd.mul_add(by_a, inner[c]);
            cost = (w * r).mul_add(r, cost);
        }
    }
    let (mut value, mut g, mut h) = (old, zero, V::splat(token, 1e-20));
    for c in 0..3 {
        let inverse = V::splat(token, 1.0) / own[c].max(V::splat(token, 1e-20));
        let change = (residual[c] * inverse).max(-old[c]);
        value[c] = old[c] + change;
        cost = cost - change * (residual[c] + residual[c] - change * own[c]);
        g = value[c].mul_add(slope[c] - across[c] * change, g);
        h = (value[c] * value[c]).mul_add(inner[c] - across[c] * across[c] * inverse, h);
    }
    At { value, cost: cost.max(zero), step: g / h }
}

/// The best constant and its cost, residuals under the guess `old`: the second pass, whose residuals are small, keeps their digits.
#[inline(always)]
fn constant<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, old: [V; 3]) -> ([V; 3], V) {
    let zero = V::splat(token, 0.0);
    let [mut own, mut residual] = [[zero; 3]; 2];
    let mut cost = zero;
    for sample in samples {
        let (values, roots) = (load::<V>(token, &sample.value, part), load::<V>(token, &sample.root_weight, part));
        for c in 0..3 {
            let w = roots[c] * roots[c];
            let r = values[c] - old[c];
            let wr = w * r;
            own[c] = own[c] + w;
            residual[c] = residual[c] + wr;
            cost = wr.mul_add(r, cost);
        }
    }
    let mut value = old;
    for c in 0..3 {
        let change = (residual[c] / own[c].max(V::splat(token, 1e-20))).max(-old[c]);
        value[c] = old[c] + change;
        cost = cost - change * (residual[c] + residual[c] - change * own[c]);
    }
    (value, cost.max(zero))
}

/// Which of the two rungs are wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rungs {
    /// The constant alone.
    Constant,
    /// The constant and the power.
    Both,
}

/// Fits both rungs to the lanes of one register.
#[inline(always)]
pub fn flat<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, rungs: Rungs, out: &mut Flat) {
    let zero = V::splat(token, 0.0);
    let (rough, _) = constant(token, samples, part, [zero; 3]);
    let (value, cost) = constant(token, samples, part, rough);
    let mut best = At { value, cost, step: zero };
    let mut exponent = zero;
    best.cost.store(&mut out.constant_cost, part);
    for c in 0..3 {
        best.value[c].store(&mut out.constant[c], part);
    }
    if rungs == Rungs::Both {
        best.step = at(token, samples, part, zero, value).step;
        let mut share = V::splat(token, 1.0);
        for _ in 0..STEPS {
            let step = (best.step * share).max(V::splat(token, -1.0)).min(V::splat(token, 1.0));
            let a = (exponent + step).max(V::splat(token, EXPONENTS.0)).min(V::splat(token, EXPONENTS.1));
            let tried = at(token, samples, part, a, best.value);
            let better = tried.cost.below(best.cost);
            exponent = a.or(better, exponent);
            best.cost = tried.cost.or(better, best.cost);
            best.step = tried.step.or(better, best.step);
            for c in 0..3 {
                best.value[c] = tried.value[c].or(better, best.value[c]);
            }
            share = V::splat(token, 1.0).or(better, share * V::splat(token, 0.3));
        }
    }
    exponent.store(&mut out.exponent, part);
    best.cost.store(&mut out.cost, part);
    for c in 0..3 {
        best.value[c].store(&mut out.value[c], part);
    }
}
