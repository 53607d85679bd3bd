//! Linear algebra of a few unknowns, every lane its own system: Cholesky, and least squares over non-negative unknowns.

use crate::fitting::lanes::Lanes;

/// Smallest pivot, as a share of its diagonal element, in units of the number's precision: below it a column counts as a combination of
/// those before it and its unknown stays zero.
const LEAST_PIVOT: f64 = 30.0;

/// `L` of `L Lᵀ = H`, the diagonal held as its reciprocal; 0 there for a column that depends on those before it.
#[derive(Clone, Copy)]
pub struct Cholesky<V, const N: usize>([[V; N]; N]);

impl<V: Lanes, const N: usize> Cholesky<V, N> {
    /// Reads the lower triangle of `h`.
    #[inline(always)]
    pub fn new(token: V::Token, h: &[[V; N]; N]) -> Self {
        let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
        let mut l = [[zero; N]; N];
        for j in 0..N {
            let mut pivot = h[j][j];
            for k in 0..j {
                pivot = (-l[j][k]).mul_add(l[j][k], pivot);
            }
            let least = h[j][j].max(V::splat(token, f64::from(f32::MIN_POSITIVE))) * V::splat(token, LEAST_PIVOT * V::EPSILON);
            let sound = least.below(pivot);
            let inverse = (one / pivot.or(sound, one).sqrt()).or(sound, zero);
            l[j][j] = inverse;
            for i in j + 1..N {
                let mut sum = h[i][j];
                for k in 0..j {
                    sum = (-l[i][k]).mul_add(l[j][k], sum);
                }
                l[i][j] = sum * inverse;
            }
        }
        Self(l)
    }

    /// `x` of `H x = g`.
    #[inline(always)]
    pub fn solve(&self, mut x: [V; N]) -> [V; N] {
        let l = &self.0;
        for i in 0..N {
            for k in 0..i {
                x[i] = (-l[i][k]).mul_add(x[k], x[i]);
            }
            x[i] = x[i] * l[i][i];
        }
        for i in (0..N).rev() {
            for k in i + 1..N {
                x[i] = (-l[k][i]).mul_add(x[k], x[i]);
            }
            x[i] = x[i] * l[i][i];
        }
        x
    }
}

/// What `non_negative` found.
#[derive(Clone, Copy)]
pub struct Bounded<V, M, const Q: usize> {
    /// By how much the unknowns change.
    pub change: [V; Q],
    /// Which are not held at zero.
    pub free: [M; Q],
    /// By how much the sum of squares falls.
    pub gain: V,
}

/// Least squares over `c ≥ 0`, from `c = old`: with Gram matrix `gram = AᵀA` and `slope = Aᵀ(y − A old)`, the change of `c`.
///
/// Exact: the minimum of a convex quadratic over an orthant is the free minimum over some subset of the unknowns, and every other
/// subset whose minimum is feasible is no better. Where the free minimum is feasible in all lanes, no subset is tried.
#[inline(always)]
pub fn non_negative<V: Lanes, const Q: usize>(token: V::Token, gram: &[[V; Q]; Q], slope: &[V; Q], old: &[V; Q]) -> Bounded<V, V::Mask, Q> {
    let zero = V::splat(token, 0.0);
    let all = subset::<V, Q>(token, gram, slope, old, (1 << Q) - 1);
    let free_everywhere = [zero.below(V::splat(token, 1.0)); Q];
    let mut best = Bounded { change: all.change, free: free_everywhere, gain: all.gain };
    let infeasible = !all.feasible;
    if !zero.any(infeasible) {
        return best;
    }
    best.gain = best.gain.or(all.feasible, V::splat(token, -1e30));
    for members in 0..(1 << Q) - 1 {
        let tried = subset::<V, Q>(token, gram, slope, old, members);
        // A lane that needs no bound keeps its free minimum, whatever its neighbours need.
        let better = infeasible & tried.feasible & best.gain.below(tried.gain);
        best.gain = tried.gain.or(better, best.gain);
        for i in 0..Q {
            best.change[i] = tried.change[i].or(better, best.change[i]);
            let inside = if members >> i & 1 == 1 { free_everywhere[0] } else { !free_everywhere[0] };
            best.free[i] = (better & inside) | (!better & best.free[i]);
        }
    }
    best
}

struct Subset<V: Lanes, const Q: usize> {
    change: [V; Q],
    gain: V,
    feasible: V::Mask,
}

/// The minimum over the unknowns whose bit is set in `members`, the others zero.
#[inline(always)]
fn subset<V: Lanes, const Q: usize>(token: V::Token, gram: &[[V; Q]; Q], slope: &[V; Q], old: &[V; Q], members: usize) -> Subset<V, Q> {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let inside = |i: usize| members >> i & 1 == 1;
    let (mut h, mut g, mut change) = ([[zero; Q]; Q], [zero; Q], [zero; Q]);
    for i in 0..Q {
        if !inside(i) {
            h[i][i] = one;
            change[i] = -old[i];
            continue;
        }
        g[i] = slope[i];
        for j in 0..Q {
            if inside(j) {
                h[i][j] = gram[i][j];
            } else {
                g[i] = gram[i][j].mul_add(old[j], g[i]);
            }
        }
    }
    let x = Cholesky::new(token, &h).solve(g);
    let mut feasible = zero.below(one);
    for i in 0..Q {
        if inside(i) {
            change[i] = x[i];
            feasible = feasible & !(old[i] + x[i]).below(zero);
        }
    }
    // 2 δᵀh − δᵀGδ.
    let mut gain = zero;
    for i in 0..Q {
        let mut row = slope[i] + slope[i];
        for j in 0..Q {
            row = (-gram[i][j]).mul_add(change[j], row);
        }
        gain = row.mul_add(change[i], gain);
    }
    Subset { change, gain, feasible }
}
