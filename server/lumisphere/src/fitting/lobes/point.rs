//! A set of axes and exponents with everything that follows from it: the best linear unknowns, what they cost, and in which direction the
//! cost falls. The Jacobian is Kaufman's (1975): the lobes' derivatives, projected onto what the linear unknowns that are free cannot
//! make up for, channel by channel.

use super::dense::{Cholesky, non_negative};
use super::normal::{Frames, Shape, normal};
use crate::fitting::lanes::Lanes;
use crate::fitting::sample::Sample;

/// A shape with its linear unknowns, cost and normal equations.
#[derive(Clone, Copy)]
pub(super) struct Point<V, const J: usize, const Q: usize, const P: usize> {
    pub(super) shape: Shape<V, J>,
    pub(super) frames: Frames<V, J>,
    pub(super) linear: [[V; 3]; Q],
    /// Weighted sum of squared residuals, without what the prior adds.
    pub(super) cost: V,
    /// Σ b² of each lobe.
    pub(super) carried: [V; J],
    /// JᵀJ, the lower triangle.
    pub(super) curvature: [[V; P]; P],
    /// Jᵀ(y − model).
    pub(super) slope: [V; P],
}

/// `shape` with the best linear unknowns, of which `linear` is a guess; `ridge` times the square of each amplitude is added to what they
/// minimise.
#[inline(always)]
pub(super) fn evaluate<V: Lanes, const J: usize, const Q: usize, const P: usize, const C: usize>(
    token: V::Token,
    samples: &[Sample],
    part: usize,
    shape: Shape<V, J>,
    linear: &[[V; 3]; Q],
    ridge: V,
) -> Point<V, J, Q, P> {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let frames = shape.frames(token);
    let mut sums = normal::<V, J, Q, P, C>(token, samples, part, &shape, &frames, linear);
    let (carried, cost) = ([zero; J], sums.rr);
    let mut point = Point { shape, frames, linear: *linear, cost, carried, curvature: [[zero; P]; P], slope: [zero; P] };
    for j in 0..J {
        for gram in &mut sums.aa {
            point.carried[j] = point.carried[j].max(gram[1 + j][1 + j]);
            gram[1 + j][1 + j] = gram[1 + j][1 + j] + ridge;
        }
    }
    for c in 0..3 {
        let of = if C == 1 { 0 } else { c };
        let (gram, across, inner) = (&sums.aa[of], &sums.ad[of], &sums.dd[of]);
        let (mut slope, mut old) = ([zero; Q], [zero; Q]);
        for i in 0..Q {
            slope[i] = sums.ar[i][c];
            old[i] = linear[i][c];
            if i > 0 {
                slope[i] = (-ridge).mul_add(old[i], slope[i]);
            }
        }
        let solved = non_negative(token, gram, &slope, &old);
        point.cost = point.cost - solved.gain;
        for i in 1..Q {
            // The gain counts the prior's part: c² at the end less c² before.
            let change = solved.change[i];
            point.cost = (-(ridge * change)).mul_add(change + old[i] + old[i], point.cost);
        }
        let mut held = [[zero; Q]; Q];
        for i in 0..Q {
            point.linear[i][c] = (old[i] + solved.change[i]).max(zero);
            for j in 0..Q {
                let identity = if i == j { one } else { zero };
                held[i][j] = gram[i][j].or(solved.free[i] & solved.free[j], identity);
            }
        }
        let factor = Cholesky::new(token, &held);
        for k in 0..P {
            let amplitude = point.linear[1 + k / 3][c];
            let mut column = [zero; Q];
            let mut slope = sums.dr[k][c];
            for i in 0..Q {
                column[i] = across[i][k].or(solved.free[i], zero);
                slope = (-across[i][k]).mul_add(solved.change[i], slope);
            }
            point.slope[k] = amplitude.mul_add(slope, point.slope[k]);
            let projected = factor.solve(column);
            for l in k..P {
                let mut product = inner[l][k];
                for i in 0..Q {
                    product = (-across[i][l]).mul_add(projected[i].or(solved.free[i], zero), product);
                }
                point.curvature[l][k] = (amplitude * point.linear[1 + l / 3][c]).mul_add(product, point.curvature[l][k]);
            }
        }
    }
    point.cost = point.cost.max(zero);
    point
}

/// `a` where `mask`, else `b`.
#[inline(always)]
pub(super) fn chosen<V: Lanes, const J: usize, const Q: usize, const P: usize>(
    mask: V::Mask,
    a: &Point<V, J, Q, P>,
    b: &Point<V, J, Q, P>,
) -> Point<V, J, Q, P> {
    let mut out = *b;
    for j in 0..J {
        for c in 0..3 {
            out.shape.axis[j][c] = a.shape.axis[j][c].or(mask, b.shape.axis[j][c]);
            for t in 0..2 {
                out.frames.0[j][t][c] = a.frames.0[j][t][c].or(mask, b.frames.0[j][t][c]);
            }
        }
        out.shape.log_exponent[j] = a.shape.log_exponent[j].or(mask, b.shape.log_exponent[j]);
    }
    for i in 0..Q {
        for c in 0..3 {
            out.linear[i][c] = a.linear[i][c].or(mask, b.linear[i][c]);
        }
    }
    for k in 0..P {
        out.slope[k] = a.slope[k].or(mask, b.slope[k]);
        for l in 0..=k {
            out.curvature[k][l] = a.curvature[k][l].or(mask, b.curvature[k][l]);
        }
    }
    for j in 0..J {
        out.carried[j] = a.carried[j].or(mask, b.carried[j]);
    }
    out.cost = a.cost.or(mask, b.cost);
    out
}
