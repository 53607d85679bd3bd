//! Closed forms for each measure, and the changes each must notice.

use super::*;
use crate::images::negative_controls::{controls, textured};
use crate::images::{Exposure, Rgb8};

const STANDARD: CompareOptions = CompareOptions::STANDARD;

fn constant(width: usize, height: usize, rgb: [f32; 3]) -> Image {
    Image { width, height, planes: rgb.map(|sample| vec![sample; width * height]).to_vec() }
}

#[test]
fn equal_images_are_at_no_distance() {
    let comparison = compare(&textured(), &textured(), None, STANDARD).unwrap();
    let expected = Comparison {
        pixels: 64 * 64,
        rmse_rgb: [0.0; 3],
        rmse_lab: [0.0; 3],
        max_abs_error: 0.0,
        psnr_db: None,
        ssim: Some(1.0),
        flip_mean: 0.0,
        delta_e_2000_mean: 0.0,
        delta_e_2000_p95: 0.0,
    };
    // SSIM divides sums that are equal only up to rounding.
    assert!((comparison.ssim.unwrap() - 1.0).abs() < 1e-12);
    assert_eq!(Comparison { ssim: Some(1.0), ..comparison }, expected);
}

#[test]
fn constant_images_have_closed_forms() {
    let (dark, light) = (0.214_041_14f32, 0.522_521f32);
    let comparison = compare(&constant(16, 16, [dark; 3]), &constant(16, 16, [light; 3]), None, STANDARD).unwrap();
    // The two are shown as 0.5 and 0.75.
    let (shown_dark, shown_light) = (0.5f64, 0.75f64);
    let psnr = 20.0 * (1.0 / (shown_light - shown_dark)).log10();
    assert!((comparison.psnr_db.unwrap() - psnr).abs() < 1e-4, "{comparison:?}");
    let c1 = 1e-4;
    let ssim = (2.0 * shown_dark * shown_light + c1) / (shown_dark.powi(2) + shown_light.powi(2) + c1);
    assert!((comparison.ssim.unwrap() - ssim).abs() < 1e-5, "{comparison:?}");
    // Greys differ in L* alone: 116 ∛Y − 16.
    let lightness = 1.16 * (f64::from(light).cbrt() - f64::from(dark).cbrt());
    assert!((comparison.rmse_lab[0] - lightness).abs() < 1e-6 && comparison.rmse_lab[1] < 1e-9 && comparison.rmse_lab[2] < 1e-9);
    assert!(comparison.rmse_rgb.iter().all(|rmse| (rmse - f64::from(light - dark)).abs() < 1e-6));
    assert!((comparison.max_abs_error - f64::from(light - dark)).abs() < 1e-6);
    assert!(comparison.delta_e_2000_mean > 15.0 && (comparison.delta_e_2000_mean - comparison.delta_e_2000_p95).abs() < 1e-9);
}

#[test]
fn rmse_keeps_channels_apart_and_averages_squares() {
    let reference = constant(10, 10, [0.5; 3]);
    let mut test = reference.clone();
    test.planes[2][..25].fill(0.5 + 0.2);
    let comparison = compare(&reference, &test, None, STANDARD).unwrap();
    // A quarter of the pixels is off by 0.2: √(0.25 · 0.04) = 0.1.
    assert_eq!(comparison.rmse_rgb[..2], [0.0; 2]);
    assert!((comparison.rmse_rgb[2] - 0.1).abs() < 1e-7);
    assert!(comparison.ssim.is_none(), "no 11 × 11 window fits into 10 × 10");
}

#[test]
fn the_95th_percentile_counts_pixels() {
    assert_eq!(percentile_95((1..=100).map(f64::from).rev().collect()), 95.0);
    assert_eq!(percentile_95((1..=20).map(f64::from).collect()), 19.0);
    assert_eq!(percentile_95(vec![7.0]), 7.0);
}

#[test]
fn ssim_matches_a_direct_sum_over_one_window() {
    let (mut a, mut b) = (Image::zeros(11, 11, 3), Image::zeros(11, 11, 3));
    for index in 0..121 {
        let (x, y) = ((index % 11) as f32, (index / 11) as f32);
        a.set_rgb(index, [0.05 * x; 3]);
        b.set_rgb(index, [0.04 * x + 0.01 * y; 3]);
    }
    // Weights, means and (co)variances about the means, straight from the paper's equations 14–16.
    let shown = |image: &Image, index: usize| f64::from(ToneMap::PLAIN.encoded(image.planes[0][index]));
    let weight = |index: usize| {
        let (x, y) = ((index % 11) as f64 - 5.0, (index / 11) as f64 - 5.0);
        (-(x * x + y * y) / 4.5).exp()
    };
    let total: f64 = (0..121).map(weight).sum();
    let average = |value: &dyn Fn(usize) -> f64| (0..121).map(|index| weight(index) * value(index)).sum::<f64>() / total;
    let (mean_a, mean_b) = (average(&|index| shown(&a, index)), average(&|index| shown(&b, index)));
    let spread = |u: &Image, mean_u: f64, v: &Image, mean_v: f64| average(&|index| (shown(u, index) - mean_u) * (shown(v, index) - mean_v));
    let (var_a, var_b, covariance) = (spread(&a, mean_a, &a, mean_a), spread(&b, mean_b, &b, mean_b), spread(&a, mean_a, &b, mean_b));
    let expected =
        (2.0 * mean_a * mean_b + 1e-4) * (2.0 * covariance + 9e-4) / ((mean_a * mean_a + mean_b * mean_b + 1e-4) * (var_a + var_b + 9e-4));
    let got = compare(&a, &b, None, STANDARD).unwrap().ssim.unwrap();
    // The luma weights sum to 1 in f32 only.
    assert!((got - expected).abs() < 1e-5, "{got}, directly {expected}");
    assert!(expected < 0.99);
}

#[test]
fn every_negative_control_is_an_error_or_raises_every_measure() {
    let image = textured();
    for (what, changed) in controls(&image) {
        let comparison = match compare(&image, &changed, None, STANDARD) {
            Ok(comparison) => comparison,
            Err(CompareError::Shape { .. } | CompareError::NotFinite { .. }) => continue,
            Err(other) => panic!("{what}: {other}"),
        };
        assert!(["one changed pixel", "one-texel shift", "swapped channels"].contains(&what), "{what} got a number");
        // One pixel of 4096 changes by 0.05: small, but no measure may call the images equal.
        assert!(comparison.rmse_rgb.iter().sum::<f64>() > 7e-4, "{what}: {comparison:?}");
        assert!(comparison.rmse_lab.iter().all(|&rmse| rmse > 1e-4), "{what}: {comparison:?}");
        assert!(comparison.max_abs_error > 0.04, "{what}: {comparison:?}");
        assert!(comparison.psnr_db.unwrap() < 75.0, "{what}: {comparison:?}");
        assert!(comparison.ssim.unwrap() < 1.0 - 1e-5, "{what}: {comparison:?}");
        assert!(comparison.flip_mean > 1e-5, "{what}: {comparison:?}");
        assert!(comparison.delta_e_2000_mean > 5e-4, "{what}: {comparison:?}");
    }
}

#[test]
fn nan_and_infinity_are_named_wherever_they_are() {
    let image = textured();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut broken = image.clone();
        broken.planes[1][3 * 64 + 5] = bad;
        let mask = vec![true; 1].into_iter().chain(vec![false; 64 * 64 - 1]).collect::<Vec<_>>();
        let expected = |image| CompareError::NotFinite { image, column: 5, row: 3 };
        assert_eq!(compare(&image, &broken, Some(&mask), STANDARD), Err(expected("test")));
        assert_eq!(compare(&broken, &image, None, STANDARD), Err(expected("reference")));
        assert_eq!(absolute_error_image(&image, &broken), Err(expected("test")));
        assert_eq!(flip_error_image(&broken, &image, STANDARD), Err(expected("reference")));
    }
}

#[test]
fn a_mask_leaves_out_what_it_hides() {
    let reference = textured();
    let mut test = reference.clone();
    for row in 0..64 {
        test.planes[0][row * 64 + 40..(row + 1) * 64].iter_mut().for_each(|sample| *sample += 0.3);
    }
    // FLIP's filters are up to 10 pixels wide at 67 pixels a degree, SSIM's window 5: the mask ends 15 pixels before the change.
    let mask: Vec<bool> = (0..64 * 64).map(|index| index % 64 < 25).collect();
    let hidden = compare(&reference, &test, Some(&mask), STANDARD).unwrap();
    assert_eq!((hidden.pixels, hidden.max_abs_error, hidden.psnr_db, hidden.delta_e_2000_p95), (64 * 25, 0.0, None, 0.0));
    assert!(hidden.flip_mean < 1e-6 && hidden.ssim.unwrap() > 1.0 - 1e-12, "{hidden:?}");

    let opposite: Vec<bool> = mask.iter().map(|flag| !flag).collect();
    let seen = compare(&reference, &test, Some(&opposite), STANDARD).unwrap();
    let whole = compare(&reference, &test, None, STANDARD).unwrap();
    // Squared errors add up over the two parts.
    let squares = seen.rmse_rgb[0].powi(2) * seen.pixels as f64;
    assert!((squares - whole.rmse_rgb[0].powi(2) * whole.pixels as f64).abs() < 1e-9 * squares);
}

#[test]
fn masks_and_options_that_make_no_sense_are_typed_errors() {
    let image = textured();
    assert_eq!(compare(&image, &image, Some(&[true; 3]), STANDARD), Err(CompareError::MaskSize { mask: 3, pixels: 64 * 64 }));
    assert_eq!(compare(&image, &image, Some(&[false; 64 * 64]), STANDARD), Err(CompareError::Empty));
    let nothing = Image::zeros(0, 5, 3);
    assert_eq!(compare(&nothing, &nothing, None, STANDARD), Err(CompareError::Empty));
    for pixels_per_degree in [0.0, -5.0, f32::NAN, 1e9] {
        let result = compare(&image, &image, None, CompareOptions { pixels_per_degree, ..STANDARD });
        assert!(matches!(result, Err(CompareError::PixelsPerDegree(_))), "{pixels_per_degree}");
    }
}

#[test]
fn the_tone_map_decides_what_the_screen_measures_see() {
    let (reference, test) = (constant(16, 16, [2.0; 3]), constant(16, 16, [4.0; 3]));
    let clamped = compare(&reference, &test, None, STANDARD).unwrap();
    assert_eq!((clamped.psnr_db, clamped.flip_mean), (None, 0.0), "both are white");
    let darker = CompareOptions { display: ToneMap::Clamp(Exposure::new(0.25).unwrap()), ..STANDARD };
    let seen = compare(&reference, &test, None, darker).unwrap();
    assert!(seen.psnr_db.unwrap() < 12.0 && seen.flip_mean > 0.1, "{seen:?}");
    assert_eq!(seen.rmse_rgb, clamped.rmse_rgb);
}

#[test]
fn flip_of_black_and_white_is_its_maximum() {
    let comparison = compare(&constant(32, 32, [0.0; 3]), &constant(32, 32, [1.0; 3]), None, STANDARD).unwrap();
    // The paper maps the greatest colour difference in the display's gamut to 1; black to white is 0.968 of it.
    assert!(comparison.flip_mean > 0.9 && comparison.flip_mean <= 1.0, "{comparison:?}");
}

#[test]
fn one_pixel_images_are_compared() {
    let comparison = compare(&constant(1, 1, [0.2; 3]), &constant(1, 1, [0.4; 3]), None, STANDARD).unwrap();
    assert_eq!((comparison.pixels, comparison.ssim), (1, None));
    assert!(comparison.flip_mean > 0.0);
}

#[test]
fn numbers_do_not_depend_on_threads() {
    let (image, changed) = (textured(), controls(&textured()).swap_remove(1).1);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| compare(&image, &changed, None, STANDARD).unwrap())
    };
    assert_eq!(with(1), with(2));
}

#[test]
fn error_images_show_where_the_error_is() {
    let (reference, mut test) = (textured(), textured());
    test.planes[1][20 * 64 + 30] -= 0.25;
    let absolute = absolute_error_image(&reference, &test).unwrap();
    let wrong: Vec<usize> = (0..64 * 64).filter(|&index| absolute.rgb(index) != [0.0; 3]).collect();
    assert_eq!(wrong, [20 * 64 + 30]);
    assert!((absolute.planes[1][20 * 64 + 30] - 0.25).abs() < 1e-6);

    let flip = flip_error_image(&reference, &test, STANDARD).unwrap();
    let brightness = |picture: &Rgb8, column, row| picture.pixel(column, row).iter().map(|&code| u32::from(code)).sum::<u32>();
    assert!(brightness(&flip, 30, 20) > 100 && brightness(&flip, 5, 60) < 10);
}

#[test]
fn results_are_written_as_json() {
    let json = serde_json::to_value(compare(&textured(), &textured(), None, STANDARD).unwrap()).unwrap();
    assert!(json["psnr_db"].is_null() && json["rmse_lab"].as_array().is_some_and(|lab| lab.len() == 3));
}
