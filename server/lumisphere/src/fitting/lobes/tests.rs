//! The kernel against slower arithmetic: derivatives against differences, the bounded linear part against brute force.

use pulp::Scalar;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::dense::non_negative;
use super::normal::Shape;
use super::point::{Point, evaluate};
use super::question::{LobePrior, Lobes, MAX_LOBES, Question, Stop};
use super::{Numbers, fit};
use crate::fitting::lanes::{F64, GROUP, Lanes};
use crate::fitting::sample::{Sample, Weights};

type Number = F64<Scalar>;

fn number(value: f64) -> Number {
    Number::splat(Scalar, value)
}

fn plain(value: Number) -> f64 {
    // Through f32 would lose the digits that differences need: two rows hold the head and the tail.
    let (mut head, mut tail) = ([0.0; GROUP], [0.0; GROUP]);
    value.store(&mut head, 0);
    (value - number(f64::from(head[0]))).store(&mut tail, 0);
    f64::from(head[0]) + f64::from(tail[0])
}

/// 60 samples of two lobes in every lane, plus `off` times a pattern that no lobe follows; weights differ between channels.
fn samples(off: f32) -> Vec<Sample> {
    let sample = |i: usize| {
        let z = (i as f32 + 0.5) / 60.0;
        let (radius, turn) = ((1.0 - z * z).sqrt(), 2.4 * i as f32);
        let d = [radius * turn.cos(), radius * turn.sin(), z];
        let lobe = |axis: [f64; 3], m: f64| (0..3).map(|c| axis[c] * f64::from(d[c])).sum::<f64>().max(0.0).powf(m);
        let (a, b) = (lobe([0.48, 0.36, 0.8], 12.0), lobe([-0.6, 0.0, 0.8], 30.0));
        let pattern = f64::from(off * turn.sin());
        let value = [0.4 + 0.5 * a + 0.1 * b + pattern, 0.2 + 0.3 * a + 0.3 * b, 0.1 + 0.2 * a + 0.4 * b].map(|v| v as f32);
        Sample {
            direction: d.map(|x| [x; GROUP]),
            value: value.map(|x| [x; GROUP]),
            root_weight: [[1.0; GROUP], [0.7; GROUP], [if i.is_multiple_of(7) { 0.0 } else { 1.0 }; GROUP]],
        }
    };
    (0..60).map(sample).collect()
}

fn shape(steps: &[f64; 6], at: &Shape<Number, 2>) -> Shape<Number, 2> {
    let frames = at.frames(Scalar);
    let mut moved = *at;
    for j in 0..2 {
        let mut axis = at.axis[j];
        for c in 0..3 {
            axis[c] = axis[c] + number(steps[3 * j]) * frames.0[j][0][c] + number(steps[3 * j + 1]) * frames.0[j][1][c];
        }
        let length = axis.iter().map(|&x| plain(x).powi(2)).sum::<f64>().sqrt();
        moved.axis[j] = axis.map(|x| x * number(1.0 / length));
        moved.log_exponent[j] = at.log_exponent[j] + number(steps[3 * j + 2]);
    }
    moved
}

fn point(samples: &[Sample], shape: Shape<Number, 2>) -> Point<Number, 2, 3, 6> {
    let zero = [[number(0.0); 3]; 3];
    // Twice: the second time the residuals are small.
    let rough = evaluate::<Number, 2, 3, 6, 3>(Scalar, samples, 0, shape, &zero, number(0.0));
    evaluate::<Number, 2, 3, 6, 3>(Scalar, samples, 0, shape, &rough.linear, number(0.0))
}

fn start() -> Shape<Number, 2> {
    let axis = |v: [f64; 3]| v.map(|x| number(x / v.iter().map(|x| x * x).sum::<f64>().sqrt()));
    Shape { axis: [axis([0.4, 0.4, 0.8]), axis([-0.5, 0.1, 0.8])], log_exponent: [number(2.2), number(3.1)] }
}

#[test]
fn the_slope_is_that_of_the_cost_with_the_best_linear_unknowns() {
    let (samples, at, h) = (samples(0.05), start(), 1e-5);
    let here = point(&samples, at);
    for k in 0..6 {
        let cost = |step: f64| {
            let mut steps = [0.0; 6];
            steps[k] = step;
            plain(point(&samples, shape(&steps, &at)).cost)
        };
        let difference = (cost(h) - cost(-h)) / (2.0 * h);
        let slope = -2.0 * plain(here.slope[k]);
        // Central differences err by h² of the third derivative, and by rounding 1e-16/h.
        assert!((difference - slope).abs() < 1e-6 * (1.0 + slope.abs()), "unknown {k}: {difference} by differences, {slope}");
    }
}

#[test]
fn without_residuals_the_curvature_is_that_of_the_cost() {
    // At the truth Kaufman's approximation is exact: the terms that it leaves out carry a residual.
    let samples = samples(0.0);
    let axis = |v: [f64; 3]| v.map(number);
    let at = Shape { axis: [axis([0.48, 0.36, 0.8]), axis([-0.6, 0.0, 0.8])], log_exponent: [number(12_f64.ln()), number(30_f64.ln())] };
    let (here, h) = (point(&samples, at), 1e-4);
    for k in 0..6 {
        let slope = |step: f64, l: usize| {
            let mut steps = [0.0; 6];
            steps[k] = step;
            plain(point(&samples, shape(&steps, &at)).slope[l])
        };
        // The frames turn with the axis, but at the minimum there is no slope for them to turn.
        for l in k..6 {
            let difference = -(slope(h, l) - slope(-h, l)) / (2.0 * h);
            let curvature = plain(here.curvature[l][k]);
            // The samples are rounded to f32: residuals of 3e-8 remain, times second derivatives of up to some hundred.
            assert!((difference - curvature).abs() < 1e-4 * (1.0 + curvature.abs()), "{k}, {l}: {difference} by differences, {curvature}");
        }
    }
}

/// Least squares over c ≥ 0 by many sweeps of coordinate descent.
fn brute_force<const Q: usize>(gram: &[[f64; Q]; Q], product: &[f64; Q]) -> [f64; Q] {
    let mut c = [0.0; Q];
    for _ in 0..20_000 {
        for i in 0..Q {
            let others: f64 = (0..Q).filter(|&j| j != i).map(|j| gram[i][j] * c[j]).sum();
            c[i] = ((product[i] - others) / gram[i][i]).max(0.0);
        }
    }
    c
}

fn check_against_brute_force<const Q: usize>(random: &mut Pcg32) {
    let rows: Vec<[f64; Q]> = (0..12).map(|_| std::array::from_fn(|i| if i == 0 { 1.0 } else { random.random::<f64>() })).collect();
    let y: Vec<f64> = rows.iter().map(|_| 2.0 * random.random::<f64>() - 1.0).collect();
    let gram = std::array::from_fn(|i| std::array::from_fn(|j| rows.iter().map(|r| r[i] * r[j]).sum()));
    let product: [f64; Q] = std::array::from_fn(|i| rows.iter().zip(&y).map(|(r, y)| r[i] * y).sum());
    let expected = brute_force(&gram, &product);
    // From a point that is not the answer.
    let old: [f64; Q] = std::array::from_fn(|_| random.random());
    let slope: [f64; Q] = std::array::from_fn(|i| product[i] - (0..Q).map(|j| gram[i][j] * old[j]).sum::<f64>());
    let found = non_negative(Scalar, &gram.map(|row: [f64; Q]| row.map(number)), &slope.map(number), &old.map(number));
    for i in 0..Q {
        let c = old[i] + plain(found.change[i]);
        assert!((c - expected[i]).abs() < 1e-8, "{Q} unknowns, number {i}: {c}, by brute force {}", expected[i]);
    }
}

#[test]
fn the_linear_part_is_the_best_without_negative_numbers() {
    let mut random = Pcg32::seed_from_u64(3);
    for _ in 0..50 {
        check_against_brute_force::<2>(&mut random);
        check_against_brute_force::<3>(&mut random);
        check_against_brute_force::<5>(&mut random);
    }
}

/// Fits two lobes from rough starts that differ from lane to lane.
fn fitted(numbers: Numbers, weights: Weights, samples: &[Sample]) -> Lobes {
    let mut lobes = Lobes::NONE;
    for lane in 0..GROUP {
        let off = 0.01 * lane as f32;
        let starts = [([0.4 + off, 0.3, 0.85], 2.0), ([-0.5, off, 0.9], 3.0)];
        for (j, (axis, log_exponent)) in starts.into_iter().enumerate() {
            (0..3).for_each(|c| lobes.axis[j][c][lane] = axis[c]);
            lobes.log_exponent[j][lane] = log_exponent;
        }
    }
    let prior = Some(LobePrior { log_exponent: 3.0, deviation: 1.2, amplitude: 1.0 });
    let stop = Stop { tolerance: 1e-9, iterations: 60 };
    let question = Question { samples, observed: &[171.0; GROUP], floor: &[1e-9; GROUP], prior, stop };
    fit(2, numbers, weights, &question, &mut lobes);
    lobes
}

#[test]
fn both_precisions_and_both_kernels_find_the_same_lobes() {
    let mut samples = samples(0.02);
    samples.iter_mut().for_each(|sample| sample.root_weight = [[1.0; GROUP]; 3]);
    let expected = fitted(Numbers::Double, Weights::PerChannel, &samples);
    for weights in [Weights::Shared, Weights::PerChannel] {
        let found = fitted(Numbers::Single, weights, &samples);
        for lane in 0..GROUP {
            for j in 0..2 {
                let m = (found.log_exponent[j][lane].exp(), expected.log_exponent[j][lane].exp());
                // f32 sums of 60 samples: the cost is flat to 1e-6, so that an unknown is sharp to 1e-3.
                assert!((m.0 / m.1 - 1.0).abs() < 1e-3, "{weights:?}, lane {lane}, lobe {j}: m {} instead of {}", m.0, m.1);
            }
        }
    }
    assert_eq!(expected.axis[2..MAX_LOBES], Lobes::NONE.axis[2..MAX_LOBES], "lobes that were not asked for stay");
}
