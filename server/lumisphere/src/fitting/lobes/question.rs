//! What the lobes' solver is asked and answers, 16 lanes at a time.

use crate::fitting::lanes::{GROUP, Row};
use crate::fitting::sample::Sample;

/// Most lobes of a model.
pub const MAX_LOBES: usize = 4;

/// What is expected of a lobe before the data speak: as heavy as one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LobePrior {
    /// Mean of ln m.
    pub log_exponent: f32,
    /// Its standard deviation.
    pub deviation: f32,
    /// Standard deviation of an amplitude, as a multiple of the largest sample: holds a lobe that lies between the views.
    pub amplitude: f32,
}

/// When the iteration ends.
#[derive(Debug, Clone, Copy)]
pub struct Stop {
    /// Once a step is expected to lower the objective by no more than this share.
    pub tolerance: f64,
    /// Passes over the samples after the first.
    pub iterations: usize,
}

/// Starts of 16 lanes, and what is known of them.
#[derive(Clone, Copy)]
pub struct Lobes {
    /// Unit axes.
    pub axis: [[Row; 3]; MAX_LOBES],
    /// ln m.
    pub log_exponent: [Row; MAX_LOBES],
    /// Constant and amplitudes: a guess at first, zero will do.
    pub linear: [[Row; 3]; MAX_LOBES + 1],
}

/// What `solve` says of 16 lanes beside the lobes.
#[derive(Clone, Copy)]
pub struct Report {
    /// Weighted sum of squared residuals at the end.
    pub cost: Row,
    /// The same at the start, linear unknowns solved for.
    pub initial_cost: Row,
    /// Passes after the first.
    pub iterations: Row,
    /// 1 where it converged, 0 where it ran out of iterations.
    pub converged: Row,
    /// Variance of ln m for residuals of variance one; infinite where the data do not determine it.
    pub log_exponent_variance: [Row; MAX_LOBES],
    /// Sum of the squares of each lobe over the samples: how many of them carry it.
    pub carried: [Row; MAX_LOBES],
}

impl Lobes {
    /// All zero.
    pub const NONE: Self =
        Self { axis: [[[0.0; GROUP]; 3]; MAX_LOBES], log_exponent: [[0.0; GROUP]; MAX_LOBES], linear: [[[0.0; GROUP]; 3]; MAX_LOBES + 1] };

    /// Writes the constant and the amplitudes of one lane.
    pub fn put_linear(&mut self, linear: &[[f32; 3]; MAX_LOBES + 1], lane: usize) {
        for (rows, values) in self.linear.iter_mut().zip(linear) {
            for c in 0..3 {
                rows[c][lane] = values[c];
            }
        }
    }
}

impl Report {
    /// All zero.
    pub const NONE: Self = Self {
        cost: [0.0; GROUP],
        initial_cost: [0.0; GROUP],
        iterations: [0.0; GROUP],
        converged: [0.0; GROUP],
        log_exponent_variance: [[0.0; GROUP]; MAX_LOBES],
        carried: [[0.0; GROUP]; MAX_LOBES],
    };
}

/// What the solver is asked.
#[derive(Clone, Copy)]
pub struct Question<'a> {
    /// The samples.
    pub samples: &'a [Sample],
    /// Numbers observed per lane (three for a sample that is seen in every channel); 0 for a lane without a texel.
    pub observed: &'a Row,
    /// Least variance of a number, per lane.
    pub floor: &'a Row,
    /// On the lobes, or none.
    pub prior: Option<LobePrior>,
    /// When to stop.
    pub stop: Stop,
}
