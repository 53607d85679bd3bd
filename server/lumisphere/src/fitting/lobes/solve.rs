//! Variable projection with Levenberg–Marquardt steps: axes and exponents of J lobes, every lane its own problem.
//!
//! The linear unknowns (constant and amplitudes, not negative) are exact at every step; the Jacobian of what remains is Kaufman's
//! (1975), projected onto the columns that their bounds leave free, channel by channel. A prior on ln m, as heavy as the noise that the
//! residuals show, keeps exponents that the data do not determine from running away. A lane that is done stands still: its result
//! depends on no neighbour.

use super::dense::Cholesky;
use super::normal::Shape;
use super::point::{Point, chosen, evaluate};
use super::question::{LobePrior, Lobes, Question, Report};
use crate::fitting::lanes::Lanes;

/// Largest exponent; the smallest is 1.
pub const MAX_EXPONENT: f64 = 1000.0;
/// Longest step of an axis, radians, and of ln m: beyond them the linearisation is worthless.
const LONGEST_STEPS: (f64, f64) = (0.35, 1.5);
/// Damping, relative to the diagonal: at the start, after a step that failed or served, least and most.
const DAMPING: (f64, f64, f64, f64, f64) = (1e-3, 6.0, 0.2, 1e-7, 1e7);

/// Fits J lobes to the lanes of one register, from `lobes`, into `lobes` and `report`.
#[inline(always)]
pub fn solve<V: Lanes, const J: usize, const Q: usize, const P: usize, const C: usize>(
    token: V::Token,
    question: &Question,
    part: usize,
    lobes: &mut Lobes,
    report: &mut Report,
) {
    let number = |value: f64| V::splat(token, value);
    let (zero, one) = (number(0.0), number(1.0));
    let observed = V::load(token, question.observed, part);
    let mut active = zero.below(observed);
    if !zero.any(active) {
        return;
    }
    let freedom = (observed - number((3 * Q + P) as f64)).max(one);
    // Rounding of f32 samples: residuals below it are none.
    let rounding = observed * number((1.7 * V::EPSILON).powi(2));
    let floor = V::load(token, question.floor, part);
    let mut guess = [[zero; 3]; Q];
    for (guess, rows) in guess.iter_mut().zip(&lobes.linear) {
        *guess = super::normal::load(token, rows, part);
    }
    let first = Pull::new(token, question.prior, floor);
    let mut at = evaluate::<V, J, Q, P, C>(token, question.samples, part, start(token, part, lobes), &guess, first.ridge);
    at.cost.store(&mut report.initial_cost, part);
    let mut damping = number(DAMPING.0);
    let (mut iterations, mut converged) = (zero, zero);
    for _ in 0..question.stop.iterations {
        let prior = Pull::new(token, question.prior, (at.cost / freedom).max(floor));
        let objective = prior.objective(&at);
        let (step, predicted) = step(token, &at, &prior, damping);
        let settled = active & (!(objective * number(question.stop.tolerance)).below(predicted) | at.cost.below(rounding));
        converged = one.or(settled, converged);
        active = active & !settled;
        if !zero.any(active) {
            break;
        }
        let shape = moved(token, &at, &step);
        let trial = evaluate::<V, J, Q, P, C>(token, question.samples, part, shape, &at.linear, prior.ridge);
        let reached = prior.objective(&trial);
        let better = active & reached.below(objective);
        iterations = iterations + one.or(active, zero);
        let gained = objective - reached;
        at = chosen(better, &trial, &at);
        damping = (damping * number(DAMPING.2)).or(better, damping * number(DAMPING.1)).max(number(DAMPING.3));
        // Rounding decides once the objective moves by no more than a few of its last digits.
        let still = gained.abs().below(objective * number(question.stop.tolerance));
        let settled = active & (still | number(DAMPING.4).below(damping));
        converged = one.or(settled, converged);
        active = active & !settled;
    }
    iterations.store(&mut report.iterations, part);
    converged.store(&mut report.converged, part);
    at.cost.store(&mut report.cost, part);
    store(token, part, &at, lobes, report);
}

#[inline(always)]
fn start<V: Lanes, const J: usize>(token: V::Token, part: usize, lobes: &Lobes) -> Shape<V, J> {
    let zero = V::splat(token, 0.0);
    let mut shape = Shape { axis: [[zero; 3]; J], log_exponent: [zero; J] };
    for j in 0..J {
        shape.axis[j] = unit(token, super::normal::load(token, &lobes.axis[j], part));
        shape.log_exponent[j] = V::load(token, &lobes.log_exponent[j], part);
    }
    shape
}

/// Made unit; +Z where there is nothing to make it of.
#[inline(always)]
pub(super) fn unit<V: Lanes>(token: V::Token, [x, y, z]: [V; 3]) -> [V; 3] {
    let square = x.mul_add(x, y.mul_add(y, z * z));
    let sound = V::splat(token, 1e-12).below(square);
    let one = V::splat(token, 1.0);
    let inverse = one / square.or(sound, one).sqrt();
    [x * inverse, y * inverse, (z * inverse).or(sound, one)]
}

/// The prior as more residuals: their weight is the variance of the others.
struct Pull<V> {
    mean: V,
    weight: V,
    ridge: V,
}

impl<V: Lanes> Pull<V> {
    #[inline(always)]
    fn new(token: V::Token, prior: Option<LobePrior>, variance: V) -> Self {
        let of = |pull: fn(LobePrior) -> f32| V::splat(token, prior.map_or(0.0, |prior| f64::from(pull(prior))));
        let weight = variance * of(|prior| prior.deviation.powi(-2));
        Self { mean: of(|prior| prior.log_exponent), weight, ridge: variance * of(|prior| prior.amplitude.powi(-2)) }
    }

    #[inline(always)]
    fn objective<const J: usize, const Q: usize, const P: usize>(&self, at: &Point<V, J, Q, P>) -> V {
        let mut sum = at.cost;
        for j in 0..J {
            let off = at.shape.log_exponent[j] - self.mean;
            sum = (self.weight * off).mul_add(off, sum);
            for c in 0..3 {
                sum = (self.ridge * at.linear[1 + j][c]).mul_add(at.linear[1 + j][c], sum);
            }
        }
        sum
    }
}

/// A damped Gauss–Newton step within its caps, and by how much it is expected to lower the objective.
#[inline(always)]
fn step<V: Lanes, const J: usize, const Q: usize, const P: usize>(
    token: V::Token,
    at: &Point<V, J, Q, P>,
    prior: &Pull<V>,
    damping: V,
) -> ([V; P], V) {
    let number = |value: f64| V::splat(token, value);
    let (zero, one) = (number(0.0), number(1.0));
    let (mut h, mut g) = (at.curvature, at.slope);
    for j in 0..J {
        let (rise, sharpen) = (3 * j + 1, 3 * j + 2);
        let log_exponent = at.shape.log_exponent[j];
        g[sharpen] = prior.weight.mul_add(prior.mean - log_exponent, g[sharpen]);
        h[sharpen][sharpen] = h[sharpen][sharpen] + prior.weight;
        // A bound that the slope pushes against holds its unknown.
        let low = log_exponent.below(number(1e-6)) & g[sharpen].below(zero);
        let high = !log_exponent.below(number(MAX_EXPONENT.ln() - 1e-6)) & zero.below(g[sharpen]);
        hold(&mut h, &mut g, sharpen, low | high, zero, one);
        let horizon = at.shape.axis[j][2].below(number(1e-6)) & g[rise].below(zero);
        hold(&mut h, &mut g, rise, horizon, zero, one);
    }
    let mut damped = h;
    for k in 0..P {
        damped[k][k] = damping.mul_add(h[k][k], h[k][k]) + number(1e-20);
    }
    let mut step = Cholesky::new(token, &damped).solve(g);
    for j in 0..J {
        let length = step[3 * j].mul_add(step[3 * j], step[3 * j + 1] * step[3 * j + 1]).sqrt();
        let shrink = number(LONGEST_STEPS.0) / length.max(number(LONGEST_STEPS.0));
        step[3 * j] = step[3 * j] * shrink;
        step[3 * j + 1] = step[3 * j + 1] * shrink;
        step[3 * j + 2] = step[3 * j + 2].max(number(-LONGEST_STEPS.1)).min(number(LONGEST_STEPS.1));
    }
    let mut predicted = zero;
    for k in 0..P {
        let mut row = g[k] + g[k];
        for l in 0..P {
            row = (-h[k.max(l)][k.min(l)]).mul_add(step[l], row);
        }
        predicted = row.mul_add(step[k], predicted);
    }
    (step, predicted)
}

/// Takes unknown `k` out of the system where `mask`.
#[inline(always)]
fn hold<V: Lanes, const P: usize>(h: &mut [[V; P]; P], g: &mut [V; P], k: usize, mask: V::Mask, zero: V, one: V) {
    g[k] = zero.or(mask, g[k]);
    for l in 0..P {
        let (row, column) = (k.max(l), k.min(l));
        h[row][column] = (if l == k { one } else { zero }).or(mask, h[row][column]);
    }
}

#[inline(always)]
fn moved<V: Lanes, const J: usize, const Q: usize, const P: usize>(token: V::Token, at: &Point<V, J, Q, P>, step: &[V; P]) -> Shape<V, J> {
    let (zero, most) = (V::splat(token, 0.0), V::splat(token, MAX_EXPONENT.ln()));
    let mut shape = at.shape;
    for j in 0..J {
        let [along, up] = at.frames.0[j];
        let mut axis = shape.axis[j];
        for c in 0..3 {
            axis[c] = step[3 * j].mul_add(along[c], step[3 * j + 1].mul_add(up[c], axis[c]));
        }
        axis[2] = axis[2].max(zero);
        shape.axis[j] = unit(token, axis);
        shape.log_exponent[j] = (shape.log_exponent[j] + step[3 * j + 2]).max(zero).min(most);
    }
    shape
}

#[inline(always)]
fn store<V: Lanes, const J: usize, const Q: usize, const P: usize>(
    token: V::Token,
    part: usize,
    at: &Point<V, J, Q, P>,
    lobes: &mut Lobes,
    report: &mut Report,
) {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let factor = Cholesky::new(token, &at.curvature);
    for j in 0..J {
        for c in 0..3 {
            at.shape.axis[j][c].store(&mut lobes.axis[j][c], part);
        }
        at.shape.log_exponent[j].store(&mut lobes.log_exponent[j], part);
        at.carried[j].store(&mut report.carried[j], part);
        let mut wanted = [zero; P];
        wanted[3 * j + 2] = one;
        let variance = factor.solve(wanted)[3 * j + 2];
        let determined = zero.below(variance);
        variance.or(determined, V::splat(token, 1e30)).store(&mut report.log_exponent_variance[j], part);
    }
    for i in 0..Q {
        for c in 0..3 {
            at.linear[i][c].store(&mut lobes.linear[i][c], part);
        }
    }
}
