//! Fits whose single lobes a graphics device fits, beside those of the processor: the same models, the same doubts, the same numbers but
//! for rounding.

use super::cases::*;
use crate::fitting::candidate::Start;
use crate::fitting::ladder::{Task, climb};
use crate::fitting::lobes::question::Stop;
use crate::fitting::one_lobe::{OneLobe, Processor};
use crate::fitting::tile::Tile;
use crate::fitting::*;
use crate::gpu::{GpuError, test_gpu};

/// RMSE between the radiances of two fits of a texel, over 1249 directions, as a part of white.
const SAME_RADIANCE: f64 = 2e-4;
/// Of two costs, relative: where the views leave a lobe open, many models are as good.
const SAME_COST: f32 = 2e-3;
/// Relative difference of two exponents, and difference of two unit axes, where a lobe is resolved.
const SAME_EXPONENT: f32 = 2e-3;
const SAME_AXIS: f32 = 5e-4;
/// Texels that may fall the other way: between two models, two minima, or to the other side of an outlier's or a doubt's threshold.
const OTHERS: f64 = 0.015;

fn auto() -> Settings {
    Settings::new(Choice::Auto { lobes_at_most: 3 }, Noise { floor: 3e-4, relative: 0.0 })
}

fn one() -> Settings {
    Settings { choice: Choice::Exactly(Rung::Lobes(1)), ..auto() }
}

fn kernel() -> Option<LobeKernel> {
    test_gpu().map(|gpu| LobeKernel::new(gpu).unwrap())
}

fn on(kernel: &LobeKernel, case: &Case, settings: &Settings) -> Vec<Outcome> {
    fit_on(kernel, &case.batch(), settings, None).unwrap()
}

/// How two fits of a case differ.
#[derive(Debug, Default)]
struct Differences {
    texels: usize,
    /// With another kind of model, or other flags, or another minimum.
    others: usize,
    /// Largest of all the rest, where lobes are resolved.
    radiance: f64,
    exponent: f32,
    axis: f32,
}

fn rms_between(a: &Model, b: &Model, directions: &[[f32; 3]]) -> f64 {
    let squares = directions.iter().map(|&d| {
        let (a, b) = (a.eval(d), b.eval(d));
        (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum::<f64>()
    });
    (squares.sum::<f64>() / (3 * directions.len()) as f64).sqrt()
}

fn differences(found: &[Outcome], expected: &[Outcome]) -> Differences {
    let dense = icosahedron(1249);
    let mut told = Differences { texels: found.len(), ..Differences::default() };
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        let (Some(a), Some(b)) = (found.fit(), expected.fit()) else {
            assert_eq!(found, expected);
            continue;
        };
        let radiance = rms_between(&a.model, &b.model, &dense);
        let is_open = a.flags.contains(Flags::UNRESOLVED);
        let is_as_good = (a.final_cost / b.final_cost - 1.0).abs() <= SAME_COST;
        let is_same_kind = std::mem::discriminant(&a.model) == std::mem::discriminant(&b.model) && lobes(&a.model) == lobes(&b.model);
        if !is_same_kind || a.flags != b.flags || !(radiance <= SAME_RADIANCE || is_open && is_as_good) {
            told.others += 1;
        } else if !is_open {
            told.radiance = told.radiance.max(radiance);
            if let (Model::Lobes { lobes: a, .. }, Model::Lobes { lobes: b, .. }) = (&a.model, &b.model) {
                for (a, b) in a.iter().zip(b) {
                    told.exponent = told.exponent.max((a.exponent / b.exponent - 1.0).abs());
                    told.axis = (0..3).map(|c| (a.axis[c] - b.axis[c]).abs()).fold(told.axis, f32::max);
                }
            }
        }
    }
    told
}

/// Median over the texels of the RMSE against the truth.
fn median_error(outcomes: &[Outcome], truth: &[Model]) -> f64 {
    let dense = icosahedron(1249);
    let pairs = outcomes.iter().zip(truth).filter_map(|(outcome, truth)| Some((&outcome.fit()?.model, truth)));
    let mut errors: Vec<f64> = pairs.map(|(model, truth)| rms_between(model, truth, &dense)).collect();
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

fn assert_same(kernel: &LobeKernel, name: &str, case: &Case, settings: &Settings) {
    let (found, expected) = (on(kernel, case, settings), fit(&case.batch(), settings).unwrap());
    let told = differences(&found, &expected);
    let errors = (median_error(&found, &case.truth), median_error(&expected, &case.truth));
    println!("{name}: {told:?}, median dense errors {errors:?}");
    assert!(told.others as f64 <= OTHERS * told.texels as f64, "{name}: {told:?}");
    assert!(told.exponent <= SAME_EXPONENT && told.axis <= SAME_AXIS, "{name}: {told:?}");
    assert!((errors.0 / errors.1 - 1.0).abs() <= 0.02, "{name}: {errors:?} against the truth");
}

/// A third of the samples, and every seventh texel, are missing.
fn with_gaps(mut case: Case) -> Case {
    for t in 0..case.states.len() {
        for i in 0..case.states[t].len() {
            if t % 7 == 3 || case.uniform() < 1.0 / 3.0 {
                case.states[t][i] = State::MISSING;
            }
        }
    }
    case
}

#[test]
fn maps_of_all_kinds_get_the_processors_models_and_flags() {
    let Some(kernel) = kernel() else { return };
    let mixed = |views: usize| Case::new(random_lobes(256, &[0, 1, 2, 3], [5.0, 80.0]), &icosahedron(views)).noise(0.005);
    let rejecting = Settings { outliers: Outliers::Reject, ..auto() };
    assert_same(&kernel, "mixed, 289 views", &mixed(289), &auto());
    assert_same(&kernel, "mixed, 73 views", &mixed(73), &auto());
    // Not of texels that have none: a lobe of noise has many places.
    let glossy = Case::new(random_lobes(256, &[1, 2, 3], [5.0, 80.0]), &icosahedron(73)).noise(0.005);
    assert_same(&kernel, "one lobe asked, 73 views", &glossy, &one());
    assert_same(&kernel, "one lobe asked, 12 views", &Case::new(one_light(0.4, 20.0), &icosahedron(17)[..12]).noise(0.005), &one());
    assert_same(&kernel, "gaps", &with_gaps(mixed(73)), &auto());
    assert_same(&kernel, "outliers", &mixed(73).outliers().0, &rejecting);
    assert_same(&kernel, "clipped", &Case::new(one_light(3.0, 50.0), &icosahedron(289)).noise(0.005).clipped(1.0), &auto());
    assert_same(&kernel, "polished", &mixed(73), &Settings { precision: Precision::Polished, ..auto() });
    let grows = Settings { noise: Noise { floor: 0.005, relative: 0.01 }, ..one() };
    assert_same(&kernel, "noise that grows", &Case::new(one_light(0.8, 30.0), &icosahedron(289)).with(|v, n| v * (1.0 + 0.01 * n)), &grows);
    assert_same(&kernel, "no prior", &Case::new(one_light(0.4, 20.0), &icosahedron(73)).noise(0.005), &Settings { prior: None, ..one() });
}

/// Texels whose channels push against every bound: an amplitude below zero, a constant below zero, both.
fn bounded() -> Case {
    let mut case = Case::new(one_light(0.4, 20.0)[..40].to_vec(), &icosahedron(73)).noise(0.005);
    for values in &mut case.values {
        values.iter_mut().for_each(|[red, green, blue]| {
            let lobe = *red - 0.5;
            (*green, *blue) = (0.3 - 0.5 * lobe, 0.4 * lobe);
        });
    }
    case.values[30..].iter_mut().flatten().for_each(|value| value[0] = -value[0]);
    case
}

fn near(a: f32, b: f32, tolerance: f32) -> bool {
    (a - b).abs() <= tolerance * b.abs().max(1e-2)
}

#[test]
fn places_gains_and_the_first_steps_are_the_processors_number_by_number() {
    let Some(kernel) = kernel() else { return };
    let mixed = Case::new(random_lobes(40, &[0, 1, 2], [5.0, 80.0]), &icosahedron(73)).noise(0.005);
    let grows = Noise { floor: 3e-4, relative: 0.01 };
    for (name, case, noise) in
        [("mixed", with_gaps(mixed), auto().noise), ("bounded", bounded(), grows), ("clipped", bounded().clipped(0.6), grows)]
    {
        let (batch, settings) = (case.batch(), Settings { noise, ..one() });
        let tile = Tile::new(batch.groups(), batch.texels(), noise);
        let seen: Vec<usize> = (0..40).filter(|&texel| tile.texels()[texel].numbers > 0).collect();
        let flat = Settings { choice: Choice::Exactly(Rung::Constant), ..settings };
        let mut scratch = Vec::new();
        let Ok(climbs) = climb(&tile, &seen, &flat, &Processor, &mut scratch);
        let climbing: Vec<usize> = (0..climbs.len()).collect();
        let Ok(expected) = Processor.look(&tile, &climbs, &climbing, 3, &mut scratch);
        let found = kernel.look(&tile, &climbs, &climbing, 3, &mut scratch).unwrap();
        let mut tasks = Vec::new();
        for ((climb, found), expected) in climbs.iter().zip(&found).zip(&expected) {
            for (p, axis) in expected.place.iter().enumerate() {
                // A centroid of nothing: rounding decides between the peak and the normal.
                if p == 3 && axis[2] == 1.0 {
                    continue;
                }
                // Sums of 73 samples in another order.
                let is_same = axis.iter().zip(&found.place[p]).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(is_same, "{name}, texel {}, place {p}: {:?} instead of {axis:?}", climb.texel, found.place[p]);
                for (k, gain) in expected.gain[p].iter().enumerate() {
                    assert!(
                        near(found.gain[p][k], *gain, 1e-3),
                        "{name}, texel {}, place {p}, exponent {k}: {found:?}, {expected:?}",
                        climb.texel
                    );
                }
                let mut start = Start::NONE;
                (start.axis[0], start.log_exponent[0]) = (*axis, 3.0);
                tasks.push(Task { climb: climb.texel, texel: climb.texel, start, linear: climb.top.linear });
            }
        }
        // Later, rounding may decide whether a step serves.
        let stop = Stop { tolerance: 1e-6, iterations: 3 };
        let Ok(expected) = Processor.polish(&tile, &tasks, &settings, stop);
        for (i, (a, b)) in kernel.polish(&tile, &tasks, &settings, stop).unwrap().iter().zip(&expected).enumerate() {
            let numbers = |c: &candidate::Candidate| {
                let [[x, y, z], ..] = c.shape.axis;
                let [constant, amplitude, ..] = c.linear;
                let costs = [c.cost as f32, c.initial_cost as f32];
                [vec![x, y, z, c.shape.log_exponent[0], c.carried[0]], constant.to_vec(), amplitude.to_vec(), costs.to_vec()].concat()
            };
            let is_same = numbers(a).iter().zip(numbers(b)).all(|(a, b)| near(*a, b, 5e-3));
            assert!(is_same && a.iterations == b.iterations && a.termination == b.termination, "{name}, task {i}: {a:?} instead of {b:?}");
            let variance = (a.log_exponent_variance[0], b.log_exponent_variance[0]);
            assert!(near(variance.0, variance.1, 0.05), "{name}, task {i}: variance {variance:?}");
        }
    }
}

#[test]
fn exact_samples_give_their_parameters_back_from_the_device() {
    let Some(kernel) = kernel() else { return };
    let case = Case::new(one_light(0.4, 20.0), &icosahedron(289));
    for (outcome, truth) in on(&kernel, &case, &auto()).iter().zip(&case.truth) {
        let (Some(Fit { model: Model::Lobes { lobes: found, .. }, .. }), Model::Lobes { lobes: truth, .. }) = (outcome.fit(), truth) else {
            panic!("{outcome:?}")
        };
        // As the processor's.
        assert!(found.len() == 1 && (found[0].exponent / truth[0].exponent - 1.0).abs() <= 1e-3, "{found:?} instead of {truth:?}");
    }
}

#[test]
fn a_texel_alone_and_among_others_on_any_number_of_threads_is_the_same_from_the_device() {
    let Some(kernel) = kernel() else { return };
    let case = Case::new(random_lobes(100, &[0, 1, 2], [5.0, 200.0]), &icosahedron(73)).noise(0.005).outliers().0.clipped(0.9);
    let settings = Settings { outliers: Outliers::Reject, ..auto() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| on(&kernel, &case, &settings))
    };
    let expected = with(1);
    assert_eq!(with(3), expected);
    for (t, expected) in expected.iter().enumerate().step_by(9) {
        let mut alone = Batch::new();
        alone.push(&case.directions[t], &case.values[t], &case.states[t]).unwrap();
        assert_eq!(fit_on(&kernel, &alone, &settings, None).unwrap()[0], *expected, "texel {t}");
    }
}

#[test]
fn nothing_to_fit_is_no_work_for_the_device() {
    let Some(kernel) = kernel() else { return };
    assert_eq!(fit_on(&kernel, &Batch::new(), &auto(), None), Ok(vec![]));
    let mut unseen = Batch::new();
    unseen.push(&[], &[], &[]).unwrap();
    assert_eq!(fit_on(&kernel, &unseen, &one(), None), Ok(vec![Outcome::Unobserved]));
    let wrong = Settings { choice: Choice::Exactly(Rung::Lobes(0)), ..auto() };
    assert_eq!(fit_on(&kernel, &unseen, &wrong, None), Err(DeviceFitError::Settings(SettingsError::Lobes(0))));
}

#[test]
fn a_device_that_is_lost_or_answers_with_no_numbers_fits_nothing() {
    let Some(gpu) = test_gpu() else { return };
    let case = Case::new(one_light(0.4, 20.0), &icosahedron(73)).noise(0.005);
    // As a driver does that drops its writes, and one that makes zeros.
    for (line, instead) in [
        ("        here.axis, here.log_exponent,", "        0.0 * here.axis, here.log_exponent,"),
        ("fits[which] =", "let lost ="),
        ("looks[which].places[p] =", "let lost ="),
    ] {
        assert!(device::SOURCE.contains(line), "{line}");
        let broken = LobeKernel::with_source(gpu.clone(), device::SOURCE.replace(line, instead).leak()).unwrap();
        let told = fit_on(&broken, &case.batch(), &one(), None).unwrap_err();
        assert!(
            matches!(&told, DeviceFitError::Device(GpuError::Failed { reason }) if reason.contains("what it calculated is no")),
            "{told}"
        );
    }
    let kernel = LobeKernel::new(gpu.clone()).unwrap();
    assert_eq!(on(&kernel, &case, &one()).len(), 256);
    gpu.lose();
    for _ in 0..2 {
        let told = fit_on(&kernel, &case.batch(), &one(), None).unwrap_err();
        assert!(matches!(told, DeviceFitError::Device(GpuError::Failed { .. })), "{told}");
    }
}
