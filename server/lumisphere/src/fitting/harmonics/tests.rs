//! The fits on the two-light texel of the thesis' section 12.5.1 (289 directions), judged on directions that were not sampled; and where fits go wrong.

use half::f16;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::directions::{MOST_FUNCTIONS, Scheme};

fn directions(scheme: &str) -> Vec<Vec3> {
    scheme.parse::<Scheme>().unwrap().directions()
}

/// The centre texel: lights of strength 1.25 and .5 mirrored at ±(1500, 1500) by 2000, colour (200, 15, 15)/255, a lobe of .4 and exponent 20.
fn two_lights(d: &Vec3) -> [f32; 3] {
    let lobe = |x: f32, strength: f32| {
        let light = Vec3::new(x, x, 2000.0).normalize();
        let mirrored = Vec3::new(-light.x, -light.y, light.z);
        let highlight = 0.4 * strength * mirrored.dot(*d).max(0.0).powi(20);
        [200.0f32, 15.0, 15.0].map(|albedo| albedo / 255.0 * strength * light.z + highlight)
    };
    let (strong, weak) = (lobe(1500.0, 1.25), lobe(-1500.0, 0.5));
    std::array::from_fn(|channel| strong[channel] + weak[channel])
}

/// `floor` and a lobe of `height` at `zenith` radians.
fn one_lobe(floor: f32, height: f32, exponent: i32, zenith: f32) -> impl Fn(&Vec3) -> [f32; 3] {
    let axis = Vec3::new(zenith.sin(), 0.0, zenith.cos());
    move |d| [floor, 0.3 * floor, 0.0].map(|floor| floor + height * axis.dot(*d).max(0.0).powi(exponent))
}

/// Root mean square over the channels.
fn error(basis: Basis, coefficients: &[[f32; 3]], truth: impl Fn(&Vec3) -> [f32; 3], toward: &[Vec3]) -> f64 {
    let harmonics = Harmonics::new(basis, coefficients.len()).unwrap();
    let square = |d: &Vec3| {
        let (fit, truth) = (harmonics.reconstruct(coefficients, *d), truth(d));
        (0..3).map(|c| f64::from(fit[c] - truth[c]).powi(2)).sum::<f64>() / 3.0
    };
    (toward.iter().map(square).sum::<f64>() / toward.len() as f64).sqrt()
}

fn dense_error(basis: Basis, coefficients: &[[f32; 3]]) -> f64 {
    error(basis, coefficients, two_lights, &directions("icosahedron:1249"))
}

fn fit(functions: usize, scheme: &str, truth: impl Fn(&Vec3) -> [f32; 3], penalty: Penalty, sign: Sign) -> HarmonicsFit {
    let directions = directions(scheme);
    let values: Vec<_> = directions.iter().map(truth).collect();
    let operator = HarmonicsOperator::new(Basis::Hemispherical, functions, &directions, &vec![1.0; values.len()]).unwrap();
    operator.fit(&values, penalty, sign).unwrap()
}

type Method = fn(usize, &[Vec3], &[[f32; 3]]) -> Result<Vec<[f32; 3]>, HarmonicsFitError>;

fn thesis(functions: usize, method: Method) -> f64 {
    let directions = directions("icosahedron:289");
    let values: Vec<_> = directions.iter().map(two_lights).collect();
    dense_error(Basis::Spherical, &method(functions, &directions, &values).unwrap())
}

/// Least value over 40 000 directions by the mean, per channel.
fn least_by_mean(coefficients: &[[f32; 3]]) -> f32 {
    let harmonics = Harmonics::new(Basis::Hemispherical, coefficients.len()).unwrap();
    let values: Vec<_> = directions("spiral:40000:150").iter().map(|d| harmonics.reconstruct(coefficients, *d)).collect();
    let by_mean = |channel: usize| {
        let mean = values.iter().map(|v| v[channel]).sum::<f32>() / values.len() as f32;
        values.iter().map(|v| v[channel]).fold(f32::INFINITY, f32::min) / mean
    };
    (0..3).map(by_mean).fold(f32::INFINITY, f32::min)
}

#[test]
fn the_thesis_fits_fall_short_by_as_much_as_was_measured_elsewhere() {
    // Another program's figures for the same texel, three digits; theirs for LSOP differ by 1 % since its Gram matrix was sampled.
    for (functions, zero, optimal) in [(16, 0.114, 0.125), (36, 0.101, 0.115), (64, 0.093, 0.148), (100, 0.091, 0.169)] {
        assert!((thesis(functions, project) / zero - 1.0).abs() < 0.015, "ZH {functions}: {}", thesis(functions, project));
        assert!((thesis(functions, optimal_projection) / optimal - 1.0).abs() < 0.015, "LSOP {functions}");
    }
}

#[test]
fn the_regularised_fit_is_many_times_closer_than_the_thesis_optimal_projection() {
    // The targets are 0.25, 0.10 and 0.05; reached are 0.151, 0.035 and 0.007.
    for (functions, share) in [(36, 0.17), (64, 0.04), (100, 0.01)] {
        let fit = fit(functions, "icosahedron:289", two_lights, Penalty::CrossValidated, Sign::NotNegative);
        let ratio = dense_error(Basis::Hemispherical, &fit.coefficients) / thesis(functions, optimal_projection);
        assert!(ratio <= share, "{functions}: {ratio}");
    }
}

#[test]
fn sixty_four_coefficients_hold_two_lights_up_to_the_horizon_and_in_half_floats() {
    let fit = fit(64, "icosahedron:289", two_lights, Penalty::CrossValidated, Sign::NotNegative);
    let grazing: Vec<Vec3> = directions("icosahedron:1249").into_iter().filter(|d| d.z < 75f32.to_radians().cos()).collect();
    let dense = dense_error(Basis::Hemispherical, &fit.coefficients);
    assert!(dense <= 0.008, "{dense}");
    assert!(error(Basis::Hemispherical, &fit.coefficients, two_lights, &grazing) <= 0.015);
    assert!(least_by_mean(&fit.coefficients) >= 0.0);
    assert!(fit.coefficients.iter().flatten().all(|c| c.abs() <= 10.0));
    let halves: Vec<_> = fit.coefficients.iter().map(|rgb| rgb.map(|c| f16::from_f32(c).to_f32())).collect();
    assert!(dense_error(Basis::Hemispherical, &halves) <= 1.01 * dense);
}

#[test]
fn noise_is_smoothed_not_fitted() {
    let mut random = Pcg32::seed_from_u64(4);
    // The sum of twelve uniform numbers less six is nearly normal with deviation 1.
    let mut noise = || 0.02 * ((0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0);
    let directions = directions("icosahedron:289");
    let values: Vec<_> = directions.iter().map(|d| two_lights(d).map(|v| v + noise())).collect();
    let operator = HarmonicsOperator::new(Basis::Hemispherical, 100, &directions, &[1.0; 289]).unwrap();
    let error_with = |penalty| dense_error(Basis::Hemispherical, &operator.fit(&values, penalty, Sign::Free).unwrap().coefficients);
    // Measured by another program with other noise: .011 with, .139 without.
    let (with, without) = (error_with(Penalty::CrossValidated), error_with(Penalty::Given(0.0)));
    assert!(with < 0.0115 && without > 0.1, "{with} {without}");
}

#[test]
fn next_to_a_strong_highlight_nothing_is_negative() {
    // (floor, lobe, exponent, zenith, dip allowed): free fits dip to −0.3 … −4 times the mean. The search for minima starts from at most twelve places,
    // so that the strongest highlights keep dips of a hundredth of the mean, which readers clamp.
    for (floor, height, exponent, zenith, dip) in [
        (0.3, 0.4, 20, 0.8, 0.0),
        (0.05, 1.0, 50, 0.8, 0.003),
        (0.0, 1.0, 20, 1.5, 0.0),
        (1.0, 50.0, 50, 1.2, 0.01),
        (1.0, 50.0, 200, 0.3, 0.01),
    ] {
        let truth = one_lobe(floor, height, exponent, zenith);
        let fitted = |sign| fit(64, "icosahedron:289", &truth, Penalty::CrossValidated, sign).coefficients;
        let (free, lifted) = (fitted(Sign::Free), fitted(Sign::NotNegative));
        assert!(least_by_mean(&free) < -0.25, "{}", least_by_mean(&free));
        assert!(least_by_mean(&lifted) >= -dip, "{height} {exponent} {zenith}: {}", least_by_mean(&lifted));
        // What is lifted at one place is missing at another: at most a quarter more error.
        let dense = directions("icosahedron:1249");
        let (before, after) = [&free, &lifted].map(|c| error(Basis::Hemispherical, c, &truth, &dense)).into();
        assert!(after < 1.25 * before, "{height} {exponent} {zenith}: {before} {after}");
    }
}

#[test]
fn a_sum_of_functions_is_found_again_exactly() {
    let mut random = Pcg32::seed_from_u64(9);
    let coefficients: Vec<[f32; 3]> = (0..36).map(|_| std::array::from_fn(|_| random.random::<f32>() - 0.5)).collect();
    let harmonics = Harmonics::new(Basis::Hemispherical, 36).unwrap();
    let fit = fit(36, "icosahedron:289", |d| harmonics.reconstruct(&coefficients, *d), Penalty::Given(0.0), Sign::Free);
    let worst = fit.coefficients.iter().zip(&coefficients).flat_map(|(a, b)| (0..3).map(move |c| (a[c] - b[c]).abs())).fold(0.0, f32::max);
    // Samples are rounded to single precision, 36 terms near 1 each.
    assert!(worst < 2e-6, "{worst}");
    assert!((fit.parameters - 108.0).abs() < 1e-6 && fit.squared_error < 1e-9, "{} {}", fit.parameters, fit.squared_error);
}

#[test]
fn an_endless_penalty_leaves_the_mean_and_one_parameter() {
    let directions = directions("icosahedron:73");
    let fit = fit(64, "icosahedron:73", two_lights, Penalty::Given(1e12), Sign::Free);
    let mean = directions.iter().map(|d| two_lights(d)[0]).sum::<f32>() / 73.0;
    // Of the λ-th part of the rest nothing is left but 10⁻¹².
    assert!((fit.parameters - 3.0).abs() < 1e-6, "{}", fit.parameters);
    assert!((eval(Basis::Hemispherical, &fit.coefficients, [0.6, 0.0, 0.8])[0] - mean).abs() < 1e-6);
}

#[test]
fn directions_of_ones_own_give_the_same_fit_as_shared_ones() {
    let directions = directions("latitude-longitude:1,8,8,16,16,32,32");
    let list = |of: &dyn Fn(&Vec3) -> f32| directions.iter().map(of).collect::<Vec<f32>>();
    let (x, y, z) = (list(&|d| d.x), list(&|d| d.y), list(&|d| d.z));
    let [r, g, b] = [0, 1, 2].map(|channel| list(&|d| two_lights(d)[channel]));
    let weights: Vec<f32> = (0..directions.len()).map(|at| [0.0, 1.0, 2.5][at % 3]).collect();
    let values: Vec<_> = directions.iter().map(two_lights).collect();
    for functions in [1, 16, 64] {
        let shared = HarmonicsOperator::new(Basis::Hemispherical, functions, &directions, &weights).unwrap();
        let shared = shared.fit(&values, Penalty::Given(1e-4), Sign::NotNegative).unwrap();
        let own = OwnDirectionsFit::new(Basis::Hemispherical, functions).unwrap();
        let samples = Samples { directions: [&x, &y, &z], values: [&r, &g, &b], weights: &weights };
        let own = own.fit(samples, Penalty::Given(1e-4), Sign::NotNegative).unwrap();
        let apart = shared.coefficients.iter().zip(&own.coefficients).flat_map(|(a, b)| (0..3).map(move |c| (a[c] - b[c]).abs()));
        // Products of 75 samples summed in single precision, 10⁻⁶, times the equations' condition, up to 100.
        assert!(apart.fold(0.0, f32::max) < 1e-4, "{functions}");
        assert!((shared.parameters - own.parameters).abs() < 1e-3 * shared.parameters);
        assert!((shared.squared_error - own.squared_error).abs() < 1e-3 * shared.squared_error + 1e-5, "{functions}");
    }
}

#[test]
fn cross_validation_with_directions_of_ones_own_is_as_good() {
    let directions = directions("icosahedron:289");
    let list = |of: &dyn Fn(&Vec3) -> f32| directions.iter().map(of).collect::<Vec<f32>>();
    let (x, y, z) = (list(&|d| d.x), list(&|d| d.y), list(&|d| d.z));
    let [r, g, b] = [0, 1, 2].map(|channel| list(&|d| two_lights(d)[channel]));
    let samples = Samples { directions: [&x, &y, &z], values: [&r, &g, &b], weights: &[1.0; 289] };
    let own = OwnDirectionsFit::new(Basis::Hemispherical, 64).unwrap().fit(samples, Penalty::CrossValidated, Sign::Free).unwrap();
    let shared = fit(64, "icosahedron:289", two_lights, Penalty::CrossValidated, Sign::Free);
    // λ is sought by decades there and finely here; the error's minimum is flat.
    let (own, shared) = (dense_error(Basis::Hemispherical, &own.coefficients), dense_error(Basis::Hemispherical, &shared.coefficients));
    assert!(own < 1.1 * shared, "{own} {shared}");
}

#[test]
fn masked_samples_are_not_read() {
    let directions = directions("icosahedron:73");
    let mut values: Vec<_> = directions.iter().map(two_lights).collect();
    let mut weights = vec![1.0; 73];
    let fit = |values: &[[f32; 3]], weights: &[f32]| {
        let operator = HarmonicsOperator::new(Basis::Hemispherical, 16, &directions, weights).unwrap();
        operator.fit(values, Penalty::CrossValidated, Sign::Free)
    };
    weights[5] = 0.0;
    let without = fit(&values, &weights).unwrap();
    values[5] = [f32::NAN; 3];
    assert_eq!(fit(&values, &weights).unwrap(), without);
    weights[5] = 1.0;
    assert!(matches!(fit(&values, &weights), Err(HarmonicsFitError::Value { what: "value", .. })));
}

#[test]
fn too_few_or_coinciding_samples_give_what_they_say_and_no_more() {
    let cases = [vec![Vec3::Z], vec![Vec3::new(0.6, 0.0, 0.8); 5], directions("stratified:4:1"), directions("icosahedron:17")];
    for (basis, sampled) in
        [Basis::Spherical, Basis::Hemispherical].into_iter().flat_map(|basis| cases.iter().map(move |case| (basis, case)))
    {
        let weights = vec![1.0; sampled.len()];
        let list = |axis: usize| sampled.iter().map(|d| d[axis]).collect::<Vec<f32>>();
        let (x, y, z, grey) = (list(0), list(1), list(2), vec![0.25; sampled.len()]);
        for penalty in [Penalty::Given(0.0), Penalty::CrossValidated] {
            let operator = HarmonicsOperator::new(basis, 100, sampled, &weights).unwrap();
            let shared = operator.fit(&vec![[0.25; 3]; sampled.len()], penalty, Sign::NotNegative).unwrap();
            let samples = Samples { directions: [&x, &y, &z], values: [&grey, &grey, &grey], weights: &weights };
            let own = OwnDirectionsFit::new(basis, 100).unwrap().fit(samples, penalty, Sign::NotNegative).unwrap();
            for fit in [shared, own] {
                // Grey everywhere: the smoothest function through the samples. Rounding in what the penalty of 0 leaves open.
                let value = eval(basis, &fit.coefficients, [0.0, -0.6, 0.8]);
                assert!(value.iter().all(|v| (v - 0.25).abs() < 1e-3), "{basis:?} {} {penalty:?}: {value:?}", sampled.len());
                assert!(fit.parameters <= 3.0 * sampled.len() as f64 + 1e-6, "{}", fit.parameters);
            }
        }
    }
}

#[test]
fn black_stays_black_and_negative_data_become_black() {
    let directions = directions("icosahedron:73");
    let operator = HarmonicsOperator::new(Basis::Hemispherical, 36, &directions, &[1.0; 73]).unwrap();
    for value in [0.0, -1.0] {
        let fit = operator.fit(&[[value; 3]; 73], Penalty::CrossValidated, Sign::NotNegative).unwrap();
        assert!(fit.coefficients.iter().flatten().all(|&c| c == 0.0), "{value}");
    }
}

#[test]
fn a_turned_capture_gives_the_turned_function() {
    let turn = glam::Quat::from_rotation_z(0.7);
    let upright = directions("icosahedron:289");
    let turned: Vec<Vec3> = upright.iter().map(|d| turn * *d).collect();
    let values: Vec<_> = upright.iter().map(two_lights).collect();
    let fit = |directions: &[Vec3]| {
        let operator = HarmonicsOperator::new(Basis::Hemispherical, 36, directions, &[1.0; 289]).unwrap();
        operator.fit(&values, Penalty::CrossValidated, Sign::Free).unwrap().coefficients
    };
    let (before, after) = (fit(&upright), fit(&turned));
    let harmonics = Harmonics::new(Basis::Hemispherical, 36).unwrap();
    for d in directions("icosahedron:73") {
        let (before, after) = (harmonics.reconstruct(&before, d), harmonics.reconstruct(&after, turn * d));
        // Directions are rounded to 10⁻⁷, values near 1 with 36 terms.
        assert!((0..3).all(|c| (before[c] - after[c]).abs() < 1e-5), "{d}");
    }
}

#[test]
fn what_cannot_be_fitted_is_refused_by_name() {
    let new =
        |functions, directions: &[Vec3], weights: &[f32]| HarmonicsOperator::new(Basis::Spherical, functions, directions, weights).err();
    assert_eq!(new(17, &[Vec3::Z], &[1.0]), Some(HarmonicsFitError::Functions(HarmonicsError(17))));
    assert_eq!(new(4, &[Vec3::Z], &[]), Some(HarmonicsFitError::Lengths { what: "weights", got: 0, expected: 1 }));
    assert_eq!(new(4, &[Vec3::Z], &[0.0]), Some(HarmonicsFitError::NoSamples));
    for bad in [Vec3::NEG_Z, 2.0 * Vec3::Z, Vec3::NAN] {
        assert!(matches!(new(4, &[Vec3::Z, bad], &[1.0; 2]), Some(HarmonicsFitError::Value { index: 1, .. })), "{bad}");
    }
    assert!(matches!(new(4, &[Vec3::Z], &[-1.0]), Some(HarmonicsFitError::Value { what: "weight", .. })));
    let operator = HarmonicsOperator::new(Basis::Spherical, 4, &[Vec3::Z], &[1.0]).unwrap();
    for lambda in [-1.0, f64::NAN, f64::INFINITY] {
        let refused = operator.fit(&[[1.0; 3]], Penalty::Given(lambda), Sign::Free);
        assert!(matches!(refused, Err(HarmonicsFitError::Value { what: "penalty", .. })), "{lambda}");
    }
    assert!(operator.fit(&[], Penalty::CrossValidated, Sign::Free).is_err());
    // LSOP and ZH divide by the height.
    assert!(project(4, &[Vec3::X], &[[1.0; 3]]).is_err());
}

#[test]
fn a_model_clamps_at_zero_and_ignores_half_filled_bands() {
    assert_eq!(eval(Basis::Hemispherical, &[[-1.0; 3]], [0.0, 0.0, 1.0]), [0.0; 3]);
    assert_eq!(eval(Basis::Hemispherical, &[[1.0; 3]; 2], [0.0, 0.0, 1.0]), [0.0; 3]);
    assert!(eval(Basis::Hemispherical, &[[1.0; 3]; MOST_FUNCTIONS], [0.0, 0.0, 1.0])[0].is_finite());
}
