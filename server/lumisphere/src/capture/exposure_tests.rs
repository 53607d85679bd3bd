//! Response curves and merged radiance from generated stacks, whose truth is known, and from a photographed one.

use std::f64::consts::TAU;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::merge::{MergeError, Validity, merge, merge_linear};
use super::photograph::{ExposureStack, StackError};
use super::read_stack::{Exposures, read_stack};
use super::response_curve::{ResponseCurve, ResponseError};
use crate::images::{Image, Rgb8};
use crate::testdata::shared;

const WIDTH: usize = 160;
const HEIGHT: usize = 120;

/// Code in [0, 1] of an exposure in [0, 1].
type Curve = fn(f64) -> f64;

fn straight(x: f64) -> f64 {
    x
}

fn srgb(x: f64) -> f64 {
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }
}

fn power(x: f64) -> f64 {
    x.powf(1.0 / 2.2)
}

fn logarithm(x: f64) -> f64 {
    (1.0 + 60.0 * x).ln() / 61f64.ln()
}

fn filmic(x: f64) -> f64 {
    let film = |x: f64| x * (6.2 * x + 0.5) / (x * (6.2 * x + 1.7) + 0.06);
    film(4.0 * x) / film(4.0)
}

fn reinhard(x: f64) -> f64 {
    1.2 * x / (x + 0.2)
}

fn power_of_television(x: f64) -> f64 {
    if x < 0.018 { 4.5 * x } else { 1.099 * x.powf(0.45) - 0.099 }
}

/// ln exposure of a code, by bisection.
fn ln_exposure(curve: Curve, code: usize) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if curve(middle) < code as f64 / 255.0 { low = middle } else { high = middle }
    }
    high.ln()
}

/// A smooth scene whose radiances span a factor of 1000 up to 1.
fn scene() -> Vec<[f64; 3]> {
    let at = |x: f64, y: f64| {
        let smooth = 0.5 + 0.45 * (3.0 * x * TAU + 1.0).sin() * (2.0 * y * TAU + 0.5).cos() + 0.03 * ((40.0 * x).sin() + (31.0 * y).cos());
        [-0.05, 0.0, 0.05].map(|tint| 1000f64.powf((smooth + tint * (5.0 * x).sin()).clamp(0.0, 1.0) - 1.0))
    };
    (0..WIDTH * HEIGHT).map(|pixel| at((pixel % WIDTH) as f64 / WIDTH as f64, (pixel / WIDTH) as f64 / HEIGHT as f64)).collect()
}

/// Eight exposures from .9, each twice the one before, with relative noise before the curve.
fn photographed(curve: Curve, noise: f64) -> ExposureStack {
    let mut random = Pcg32::seed_from_u64(1);
    let exposures: Vec<f64> = (0..8).map(|k| 0.9 * f64::from(1 << k)).collect();
    let scene = scene();
    let mut shot = |exposure: f64| {
        let code =
            |radiance: f64, normal: f64| (255.0 * curve((radiance * exposure * (1.0 + noise * normal)).clamp(0.0, 1.0))).round() as u8;
        let bytes = scene.as_flattened().iter().map(|&radiance| code(radiance, normal(&mut random))).collect();
        Rgb8::from_bytes(WIDTH, HEIGHT, bytes).unwrap()
    };
    let photographs = exposures.iter().map(|&exposure| shot(exposure)).collect();
    ExposureStack::new(photographs, exposures).unwrap()
}

fn normal(random: &mut Pcg32) -> f64 {
    (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt() * (TAU * random.random::<f64>()).cos()
}

/// Root mean square of ln(curve / truth) over codes 5 to 250 at the best scale, worst channel.
fn curve_error(recovered: &ResponseCurve, curve: Curve) -> f64 {
    let of = |g: &[f32; 256]| {
        let apart: Vec<f64> = (5..=250).map(|code| f64::from(g[code]) - ln_exposure(curve, code)).collect();
        let mean = apart.iter().sum::<f64>() / apart.len() as f64;
        (apart.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / apart.len() as f64).sqrt()
    };
    recovered.ln_exposure.iter().map(of).fold(0.0, f64::max)
}

/// Root mean square of radiance / truth − 1 at the median scale, worst channel.
fn merged_error(radiance: &Image, validity: &[Validity]) -> f64 {
    let scene = scene();
    let of = |channel: usize| {
        let measured = (0..scene.len()).filter(|&pixel| validity[pixel] == Validity::Measured);
        let mut ratios: Vec<f64> = measured.map(|pixel| f64::from(radiance.planes[channel][pixel]) / scene[pixel][channel]).collect();
        ratios.sort_by(f64::total_cmp);
        let median = ratios[ratios.len() / 2];
        (ratios.iter().map(|ratio| (ratio / median - 1.0).powi(2)).sum::<f64>() / ratios.len() as f64).sqrt()
    };
    (0..3).map(of).fold(0.0, f64::max)
}

#[test]
fn curves_and_radiances_are_closer_than_opencvs_on_the_same_stacks() {
    // Curve, noise, OpenCV 5.0.0: CalibrateDebevec's ln RMS and MergeDebevec's relative RMS (docs/rivals/exposures.py on the same formulas).
    let cases: [(Curve, f64, f64, f64); 10] = [
        (straight, 0.0, 0.0034, 0.0144),
        (straight, 0.01, 0.0067, 0.0159),
        (srgb, 0.0, 0.0121, 0.0070),
        (srgb, 0.01, 0.0124, 0.0091),
        (power, 0.0, 0.1240, 0.0073),
        (power, 0.01, 0.1236, 0.0090),
        (logarithm, 0.0, 0.0176, 0.0062),
        (logarithm, 0.01, 0.0178, 0.0086),
        (filmic, 0.0, 0.0586, 0.0078),
        (filmic, 0.01, 0.0626, 0.0099),
    ];
    let (mut curves, mut radiances) = (0.0, 0.0);
    for (curve, noise, rival_curve, rival_radiance) in cases {
        let stack = photographed(curve, noise);
        let recovered = ResponseCurve::recover(&stack).unwrap();
        assert!(recovered.ln_exposure.iter().all(|g| g.is_sorted_by(|a, b| a < b) && g[128] == 0.0), "rises, and is 0 in the middle");
        let merged = merge(&stack, &recovered).unwrap();
        let (of_curve, of_radiance) = (curve_error(&recovered, curve), merged_error(&merged.radiance, &merged.validity));
        // None is worse, and the geometric means are far below.
        assert!(of_curve < rival_curve && of_radiance < rival_radiance, "{of_curve} {rival_curve} {of_radiance} {rival_radiance}");
        curves += (of_curve / rival_curve).ln() / 10.0;
        radiances += (of_radiance / rival_radiance).ln() / 10.0;
    }
    // Wanted are .6 and .9; reached are .09 and .48.
    assert!(f64::exp(curves) < 0.12 && f64::exp(radiances) < 0.55, "{} {}", f64::exp(curves), f64::exp(radiances));
}

#[test]
fn curves_that_the_smoothness_was_not_chosen_on_are_recovered_as_well() {
    for curve in [reinhard as Curve, power_of_television] {
        let error = curve_error(&ResponseCurve::recover(&photographed(curve, 0.01)).unwrap(), curve);
        // As much as rounding to codes in one sample at code 50.
        assert!(error < 0.006, "{error}");
    }
}

#[test]
fn the_same_stack_gives_the_same_curve_in_any_order() {
    let stack = photographed(filmic, 0.01);
    let photographs = stack.photographs().iter().rev().cloned().collect();
    let reversed = ExposureStack::new(photographs, stack.exposures().iter().rev().copied().collect()).unwrap();
    let (one, other) = (ResponseCurve::recover(&stack).unwrap(), ResponseCurve::recover(&reversed).unwrap());
    let apart = one.ln_exposure.as_flattened().iter().zip(other.ln_exposure.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // Sums in another order, and a threshold of outliers that such differences can cross.
    assert!(apart < 1e-3, "{apart}");
}

#[test]
fn outlying_pixels_hardly_move_the_curve() {
    let clean = photographed(srgb, 0.01);
    let mut random = Pcg32::seed_from_u64(8);
    let mut photographs = clean.photographs().to_vec();
    // A hundredth of all samples are something else: what moved between the exposures.
    for photograph in &mut photographs {
        photograph.bytes.iter_mut().filter(|_| random.random::<f32>() < 0.01).for_each(|code| *code = 200);
    }
    let stack = ExposureStack::new(photographs, clean.exposures().to_vec()).unwrap();
    let error = curve_error(&ResponseCurve::recover(&stack).unwrap(), srgb);
    assert!(error < 0.03, "{error}");
}

#[test]
fn stacks_that_say_nothing_of_the_response_are_refused() {
    let stack = |codes: [u8; 2], exposures: [f64; 2]| {
        ExposureStack::new(codes.map(|code| Rgb8::filled(8, 8, [code; 3])).to_vec(), exposures.to_vec()).unwrap()
    };
    for codes in [[255, 255], [0, 0], [0, 255]] {
        let refused = ResponseCurve::recover(&stack(codes, [1.0, 2.0]));
        assert_eq!(refused, Err(ResponseError::TooFew { channel: 0, usable: 0, expected: 32 }));
    }
    assert_eq!(ResponseCurve::recover(&stack([50, 80], [2.0, 2.0])), Err(ResponseError::OneExposure { photographs: 2, exposure: 2.0 }));
    // Of one grey little can be said, but that without a NaN.
    let flat = ResponseCurve::recover(&stack([50, 80], [1.0, 2.0])).unwrap();
    assert!(flat.ln_exposure.as_flattened().iter().chain(flat.deviation.as_flattened()).all(|v| v.is_finite()));
}

/// g(z) = ln z, with deviations of one code.
fn straight_curve() -> ResponseCurve {
    let channel = |of: fn(f32) -> f32| [std::array::from_fn(|code| of((code as f32).max(0.5))); 3];
    ResponseCurve { ln_exposure: channel(|z| (z / 128.0).ln()), deviation: channel(|z| 1.0 / z) }
}

#[test]
fn what_no_exposure_shows_is_masked_by_what_it_is() {
    let photograph = |codes: [[u8; 3]; 5]| Rgb8::from_bytes(5, 1, codes.concat()).unwrap();
    let short = photograph([[100; 3], [255, 90, 90], [0; 3], [0, 60, 60], [254; 3]]);
    let long = photograph([[200; 3], [255, 180, 180], [0, 7, 7], [255, 120, 120], [255; 3]]);
    let merged = merge(&ExposureStack::new(vec![short, long], vec![1.0, 2.0]).unwrap(), &straight_curve()).unwrap();
    let expected = [Validity::Measured, Validity::Clipped, Validity::Dark, Validity::Between, Validity::Measured];
    assert_eq!(merged.validity, expected);
    let red = &merged.radiance.planes[0];
    // In units of the middle code's exposure, to single precision.
    assert!((red[0] - 100.0 / 128.0).abs() < 1e-6 && (red[4] - 254.0 / 128.0).abs() < 1e-5, "{red:?}");
    assert!(merged.radiance.planes.iter().all(|plane| plane[1..4].iter().all(|&value| value == 0.0)), "masked pixels are never averaged");
}

#[test]
fn a_sample_that_noise_kept_from_clipping_does_not_count_beside_others() {
    // 150 at half the exposure says 300, which 250 denies only because of noise.
    let photographs = [[150u8; 3], [250; 3]].map(|code| Rgb8::filled(1, 1, code)).to_vec();
    let mut curve = straight_curve();
    curve.deviation = [[0.1; 256]; 3];
    let merged = merge(&ExposureStack::new(photographs, vec![1.0, 2.0]).unwrap(), &curve).unwrap();
    assert!((merged.radiance.planes[0][0] - 150.0 / 128.0).abs() < 1e-6, "{:?}", merged.radiance.planes[0]);
}

#[test]
fn a_stack_without_one_measured_pixel_is_an_error_that_counts_them() {
    let stack = ExposureStack::new(vec![Rgb8::filled(2, 2, [255; 3]), Rgb8::filled(2, 2, [255; 3])], vec![1.0, 2.0]).unwrap();
    let all_clipped = MergeError::NothingMeasured { pixels: 4, clipped: 4, dark: 0, between: 0 };
    assert_eq!(merge(&stack, &straight_curve()), Err(all_clipped));
    let black = vec![Image::zeros(3, 1, 3); 2];
    let all_dark = MergeError::NothingMeasured { pixels: 3, clipped: 0, dark: 3, between: 0 };
    assert_eq!(merge_linear(&black, &[1.0, 2.0], 0.0, 1.0), Err(all_dark));
}

#[test]
fn linear_photographs_are_merged_without_a_curve() {
    let photograph = |values: [f32; 3]| Image { width: 3, height: 1, planes: vec![values.to_vec(); 3] };
    let merged = merge_linear(&[photograph([0.2, 1.0, 0.0]), photograph([0.4, 1.0, f32::NAN])], &[1.0, 2.0], 0.0, 1.0).unwrap();
    assert_eq!(merged.validity, [Validity::Measured, Validity::Clipped, Validity::Dark]);
    assert!((merged.radiance.planes[1][0] - 0.2).abs() < 1e-7);
    let other_size = merge_linear(&[photograph([0.5; 3]), Image::zeros(2, 1, 3)], &[1.0, 2.0], 0.0, 1.0);
    assert!(matches!(other_size, Err(MergeError::Stack(StackError::Size { index: 1, .. }))));
    assert_eq!(merge_linear(&[Image::zeros(1, 1, 1)], &[1.0], 0.0, 1.0), Err(MergeError::Channels { index: 0, channels: 1 }));
}

#[test]
fn the_photographed_church_has_the_curve_that_debevec_and_malik_find() {
    let Some(folder) = shared("exposures/memorial") else { return };
    // Of eight photographs, 32 s to 1/4 s.
    let files: Vec<_> = (61..=68).map(|number| folder.join(format!("memorial00{number}.png"))).collect();
    let stack =
        read_stack(&files, &|path| std::fs::read(path), &Exposures::Listed((0..8).map(|k| 32.0 / f64::from(1 << k)).collect())).unwrap();
    let curve = ResponseCurve::recover(&stack).unwrap();
    let reference = std::fs::read_to_string(folder.join("reference_g.csv")).unwrap();
    let rows = reference
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split(',').map(|v| v.parse::<f32>().unwrap()).collect::<Vec<_>>());
    let rows: Vec<Vec<f32>> = rows.collect();
    assert_eq!(rows.len(), 256);
    // Codes that many pixels have; red and green, since blended borders, which are blue, spoil that channel's bright end in either fit.
    let apart = (30..=235).flat_map(|code| [0, 1].map(|channel| (curve.ln_exposure[channel][code] - rows[code][channel]).abs()));
    // Theirs is another smoothness and 300 pixels of a film scan: a sixth of a stop, ln 2 / 6.
    let worst = apart.fold(0.0, f32::max);
    assert!(worst < 0.1155, "{worst}");
    let merged = merge(&stack, &curve).unwrap();
    let measured = merged.validity.iter().filter(|&&validity| validity == Validity::Measured).count();
    // The windows are clipped in all of these eight, the registered borders blue.
    assert!(measured > 300_000 && merged.validity.contains(&Validity::Clipped), "{measured}");
    assert!(merged.radiance.planes.iter().flatten().all(|value| value.is_finite() && *value >= 0.0));
}
