//! How well the views cover a lobe: what can be resolved between views depends on how densely they lie around its axis.

use super::normal::{dot, load};
use super::question::{Lobes, MAX_LOBES};
use crate::fitting::lanes::{GROUP, Lanes, Row};
use crate::fitting::sample::Sample;

/// Half-angles of the two caps in which views are counted, radians: the wider serves where the narrower holds too few.
pub const CAPS: [f64; 2] = [0.35, 0.7];

/// Counts around the axis of each lobe, in 16 lanes.
#[derive(Clone, Copy)]
pub struct Support {
    /// Views towards which the lobe is above half of its height.
    pub above_half: [Row; MAX_LOBES],
    /// Views within each of `CAPS`.
    pub within: [[Row; 2]; MAX_LOBES],
}

impl Support {
    /// All zero.
    pub const NONE: Self = Self { above_half: [[0.0; GROUP]; MAX_LOBES], within: [[[0.0; GROUP]; 2]; MAX_LOBES] };
}

/// Counts the views around the first `count` lobes.
#[inline(always)]
pub fn support<V: Lanes>(token: V::Token, samples: &[Sample], part: usize, count: usize, lobes: &Lobes, out: &mut Support) {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    for j in 0..count.min(MAX_LOBES) {
        let axis = load::<V>(token, &lobes.axis[j], part);
        let exponent = V::load(token, &lobes.log_exponent[j], part).exp();
        let half = (V::splat(token, -std::f64::consts::LN_2) / exponent).exp();
        let (mut above, mut near, mut around) = (zero, zero, zero);
        for sample in samples {
            let roots = load::<V>(token, &sample.root_weight, part);
            let seen = zero.below(roots[0] + roots[1] + roots[2]);
            let cosine = dot(axis, load::<V>(token, &sample.direction, part));
            above = above + one.or(seen & half.below(cosine), zero);
            near = near + one.or(seen & V::splat(token, CAPS[0].cos()).below(cosine), zero);
            around = around + one.or(seen & V::splat(token, CAPS[1].cos()).below(cosine), zero);
        }
        above.store(&mut out.above_half[j], part);
        near.store(&mut out.within[j][0], part);
        around.store(&mut out.within[j][1], part);
    }
}
