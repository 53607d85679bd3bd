//! Fits of one to four lobes to 16 texels at once, and the choice of the machine's instructions.

#![expect(clippy::needless_range_loop, reason = "rows and columns of several matrices go by one index")]

mod dense;
pub mod flat;
mod normal;
mod point;
pub mod question;
pub mod scan;
mod solve;
pub mod support;

use pulp::{Arch, Scalar, Simd, WithSimd};

use self::flat::{Flat, Rungs};
use self::question::{Lobes, Question, Report};
use self::scan::{Candidates, Scratch};
use self::solve::solve;
use self::support::Support;
use super::lanes::{F32, F64, GROUP, Lanes};
use super::sample::{Sample, Weights};

/// The numbers that the kernel calculates with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Numbers {
    /// f32.
    Single,
    /// f64, one lane after the other: a third of the kernels' compile time for steps that few ask for is not worth their registers.
    Double,
}

/// Fits `count` lobes (one to four) to every lane of a group, from `lobes`, into `lobes`.
pub fn fit(count: usize, numbers: Numbers, weights: Weights, question: &Question, lobes: &mut Lobes) -> Report {
    let mut report = Report::NONE;
    match count {
        1 => dispatch::<1, 2, 3>(numbers, weights, question, lobes, &mut report),
        2 => dispatch::<2, 3, 6>(numbers, weights, question, lobes, &mut report),
        3 => dispatch::<3, 4, 9>(numbers, weights, question, lobes, &mut report),
        _ => dispatch::<4, 5, 12>(numbers, weights, question, lobes, &mut report),
    }
    report
}

fn dispatch<const J: usize, const Q: usize, const P: usize>(
    numbers: Numbers,
    weights: Weights,
    question: &Question,
    lobes: &mut Lobes,
    report: &mut Report,
) {
    let arch = Arch::new();
    match (numbers, weights) {
        (Numbers::Single, Weights::Shared) => arch.dispatch(Single::<J, Q, P, 1> { question, lobes, report }),
        (Numbers::Single, Weights::PerChannel) => arch.dispatch(Single::<J, Q, P, 3> { question, lobes, report }),
        // Two passes, asked for by few: one kernel serves both weights and all machines.
        (Numbers::Double, _) => {
            for lane in 0..GROUP {
                solve::<F64<Scalar>, J, Q, P, 3>(Scalar, question, lane, lobes, report);
            }
        }
    }
}

struct Single<'a, const J: usize, const Q: usize, const P: usize, const C: usize> {
    question: &'a Question<'a>,
    lobes: &'a mut Lobes,
    report: &'a mut Report,
}

impl<const J: usize, const Q: usize, const P: usize, const C: usize> WithSimd for Single<'_, J, Q, P, C> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for part in 0..GROUP / F32::<S>::COUNT {
            solve::<F32<S>, J, Q, P, C>(simd, self.question, part, self.lobes, self.report);
        }
    }
}

/// Candidates for one more lobe beside the first `count` of `lobes`.
pub fn candidates(count: usize, samples: &[Sample], lobes: &Lobes, peaks: usize, scratch: &mut Vec<Scratch>) -> Candidates {
    let arch = Arch::new();
    match count {
        0 => arch.dispatch(Scan::<0, 1> { samples, lobes, peaks, scratch }),
        1 => arch.dispatch(Scan::<1, 2> { samples, lobes, peaks, scratch }),
        2 => arch.dispatch(Scan::<2, 3> { samples, lobes, peaks, scratch }),
        3 => arch.dispatch(Scan::<3, 4> { samples, lobes, peaks, scratch }),
        _ => arch.dispatch(Scan::<4, 5> { samples, lobes, peaks, scratch }),
    }
}

struct Scan<'a, const J: usize, const Q: usize> {
    samples: &'a [Sample],
    lobes: &'a Lobes,
    peaks: usize,
    scratch: &'a mut Vec<Scratch>,
}

impl<const J: usize, const Q: usize> WithSimd for Scan<'_, J, Q> {
    type Output = Candidates;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Candidates {
        let mut out = Candidates::NONE;
        for part in 0..GROUP / F32::<S>::COUNT {
            scan::scan::<F32<S>, J, Q>(simd, self.samples, part, self.lobes, self.peaks, self.scratch, &mut out);
        }
        out
    }
}

/// The constant and the cosine power.
pub fn flat_rungs(samples: &[Sample], rungs: Rungs) -> Flat {
    Arch::new().dispatch(FlatRungs { samples, rungs })
}

struct FlatRungs<'a> {
    samples: &'a [Sample],
    rungs: Rungs,
}

impl WithSimd for FlatRungs<'_> {
    type Output = Flat;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Flat {
        let mut out = Flat::NONE;
        for part in 0..GROUP / F32::<S>::COUNT {
            flat::flat::<F32<S>>(simd, self.samples, part, self.rungs, &mut out);
        }
        out
    }
}

/// How the views cover the first `count` lobes.
pub fn support(count: usize, samples: &[Sample], lobes: &Lobes) -> Support {
    Arch::new().dispatch(Supported { count, samples, lobes })
}

struct Supported<'a> {
    count: usize,
    samples: &'a [Sample],
    lobes: &'a Lobes,
}

impl WithSimd for Supported<'_> {
    type Output = Support;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Support {
        let mut out = Support::NONE;
        for part in 0..GROUP / F32::<S>::COUNT {
            support::support::<F32<S>>(simd, self.samples, part, self.count, self.lobes, &mut out);
        }
        out
    }
}

#[cfg(test)]
mod tests;
