use glam::Vec3;

use super::methods::Samples;
use super::plane::{Gloss, LIGHT, PointLight, lit, texels};
use super::plane_tests::{cone, residual_percent};
use super::*;
use crate::capture::observation_map::{Observation, State};
use crate::directions::Scheme;
use crate::fitting::{Model, Noise};
use crate::progress::Unattended;
use crate::representations::parameter_map::AllowedModels;
use crate::scenes::{BuiltinOptions, builtin};

fn rows(section: &str) -> Vec<PlaneRow> {
    let tests = plane_tests();
    let test = tests.iter().find(|test| test.section == section).unwrap();
    plane_test(test).unwrap().0
}

fn row<'a>(rows: &'a [PlaneRow], case: &str, method: &str) -> &'a PlaneRow {
    rows.iter().find(|row| row.case == case && row.method == method).unwrap_or_else(|| panic!("no row {case}, {method}"))
}

#[test]
fn the_planes_light_is_where_the_thesis_has_it() {
    // The texel nearest to the middle: half a texel off in x and y.
    let middle = texels().nth(7 * 16 + 7).unwrap();
    assert_eq!(middle.to_array(), [-31.25, -31.25]);
    let light = PointLight { place: LIGHT, strength: 1.0 };
    let Model::Lobes { constant, lobes } = lit(middle, &[light], Gloss::USUAL) else { panic!("lobes") };
    let to_light = (LIGHT - middle.extend(0.0)).normalize();
    assert!((constant[0] - to_light.z * 200.0 / 255.0).abs() < 1e-6);
    // The mirror direction: the light's, turned by half a turn about the normal.
    assert!(Vec3::from(lobes[0].axis).distance(Vec3::new(-to_light.x, -to_light.y, to_light.z)) < 1e-6);
}

#[test]
fn one_lobe_fits_a_point_light_to_the_rounding_of_its_pictures_and_an_area_light_worse() {
    let rows = rows("11.3.1");
    let point = row(&rows, "point light", "plain phong");
    // Half a step of 8 bits.
    assert!(point.rmse < 0.5 / 255.0, "{point:?}");
    assert!((point.exponent.unwrap() - 20.0).abs() < 0.1, "{point:?}");
    let area = row(&rows, "area light", "plain phong");
    // As the thesis says: an exponent lower than the material's.
    assert!(area.rmse > 1.5 * point.rmse && area.exponent.unwrap() < 19.0, "{area:?}");
    assert!(row(&rows, "area light", "auto").rmse < area.rmse);
}

#[test]
fn one_lobe_for_two_lights_is_worse_the_farther_they_are_apart() {
    let rows = rows("11.3.2");
    let errors = [450.0, -450.0, -1500.0].map(|at| row(&rows, &format!("second light at {at}"), "plain phong").residual_percent[1]);
    assert!(errors.is_sorted() && errors[0] > 1.0, "{errors:?}");
    // Red is white everywhere, as in the thesis' pictures.
    assert!(rows.iter().all(|row| row.residual_percent[0] < 0.1), "{rows:?}");
    let chosen: Vec<&PlaneRow> = rows.iter().filter(|row| row.method == "auto").collect();
    assert!(chosen.iter().all(|row| (row.floats - 15.0).abs() < 0.5 && row.rmse < 0.5 / 255.0), "two lobes are 15 numbers: {chosen:?}");
}

#[test]
fn the_thesis_harmonics_do_as_the_thesis_says() {
    let rows = rows("12.5.1");
    let of = |method: &str, count: usize| row(&rows, "strong and weak light", &format!("{method}{count}"));
    for count in [16, 25, 49, 64] {
        let (zero, optimal, ours) = (of("thesis zh:", count), of("thesis lsop:", count), of("sh:", count));
        // Zeros below the horizon pull the fit down above it; the highlight, too.
        assert!(optimal.peak > zero.peak && zero.peak < 0.9, "{count}: {zero:?} {optimal:?}");
        assert!(zero.rmse_low > 1.2 * zero.rmse && zero.rmse_low > ours.rmse_low && zero.rmse > ours.rmse, "{count}: {zero:?} {ours:?}");
    }
    // LSOP rings near the horizon as bands are added.
    assert!([25, 49, 64, 81].is_sorted_by(|&a, &b| of("thesis lsop:", a).rmse_low < of("thesis lsop:", b).rmse_low));
    assert!(of("sh:", 100).rmse < of("thesis lsop:", 100).rmse && of("sh:", 100).rmse < of("thesis zh:", 100).rmse);
}

#[test]
fn harmonics_lose_lobes_that_a_lobe_keeps() {
    let rows = rows("13.1");
    for exponent in [2, 5, 10, 15, 25] {
        let lobe = row(&rows, &format!("m = {exponent}"), "plain phong");
        assert!((lobe.peak - 1.0).abs() < 0.01, "{lobe:?}");
    }
    let peaks = [15, 50, 300].map(|m| row(&rows, &format!("m = {m}"), "thesis lsop:36").peak);
    assert!(peaks[0] > 0.8 && peaks.is_sorted_by(|a, b| a > b) && peaks[2] < 0.4, "{peaks:?}");
}

#[test]
fn seventeen_directions_are_enough_for_a_lobe_and_too_few_for_harmonics() {
    let rows = rows("13.2");
    let few = row(&rows, "17 directions", "plain phong");
    let drift = few.drift.unwrap();
    // The thesis': 1, 1, 15 and 5 %.
    assert!(drift.diffuse_percent < 1.0 && drift.axis_percent < 1.0, "{drift:?}");
    assert!(drift.specular_percent < 15.0 && drift.exponent_percent < 5.0, "{drift:?}");
    assert!(row(&rows, "305 directions", "plain phong").drift.is_none());
    assert!(row(&rows, "17 directions", "thesis lsop:36").rmse > 2.0 * row(&rows, "305 directions", "thesis lsop:36").rmse);
}

#[test]
fn the_cone_of_directions_is_around_the_highlight() {
    let rows = rows("13.3");
    let (even, dense) = (&rows[0], row(&rows, "73 directions and 81 around the highlight", "plain phong"));
    assert_eq!((even.directions, dense.directions), (305, 154));
    let axis = Vec3::new(-0.6, 0.0, 0.8);
    let around = cone(axis, 25_f32.to_radians(), 81);
    let cosines: Vec<f32> = around.iter().map(|d| d.dot(axis)).collect();
    // Evenly in the cosine, from the axis down to 25°.
    let (least, mean) = (25_f32.to_radians().cos(), cosines.iter().sum::<f32>() / 81.0);
    assert!(cosines.iter().all(|c| (least - 1e-5..=1.0 + 1e-5).contains(c)) && (mean - 0.5 * (1.0 + least)).abs() < 1e-3);
    assert!(dense.drift.unwrap().specular_percent < 1.0, "{dense:?}");
}

#[test]
fn percentage_residuals_are_of_the_sample_and_leave_black_out() {
    let sample = |radiance| ([0.0, 0.0, 1.0], Observation { radiance, state: State::Seen { clipped: 0 } });
    let samples = vec![sample([0.5, 0.2, 0.0]), sample([0.4, 0.1, 0.0])];
    let percent = residual_percent(&Model::Constant { value: [0.6, 0.1, 0.3] }, &samples);
    // (20 + 50)/2, (50 + 0)/2, nothing to divide by.
    for (found, expected) in percent.into_iter().zip([35.0, 25.0, 0.0]) {
        assert!((found - expected).abs() < 1e-4, "{percent:?}");
    }
}

#[test]
fn a_texel_that_nobody_saw_has_no_model_whatever_the_method() {
    let directions = Scheme::icosahedron(73).unwrap().directions();
    let seen = |state| -> Samples { directions.iter().map(|d| (d.to_array(), Observation { radiance: [0.25; 3], state })).collect() };
    let texels = [seen(State::Missing), seen(State::Seen { clipped: 0 })];
    for method in surface_methods() {
        let models = method.fit(&texels, Noise { floor: 1e-3, relative: 0.0 }).unwrap();
        assert!(models[0].is_none() && models[1].is_some(), "{method}: {models:?}");
    }
}

#[test]
fn photographs_of_a_patchwork_are_met_best_where_the_fit_knew_them() {
    let mut options = BuiltinOptions::small();
    options.patchwork.relief_steps = 24;
    let scene = builtin("patchwork", &options).unwrap();
    let test = &surface_tests()[1];
    let surface = photographed(test, &scene, 24, 4, &Unattended).unwrap();
    let of = |method| {
        let (rows, pictures) = surface.compare(method).unwrap();
        assert_eq!(rows.len(), 4);
        // The sheet without its edge of a fiftieth.
        assert!(pictures.iter().flatten().all(|picture| (picture.width, picture.height) == (24, 24)));
        // The difference picture is the difference of the two others.
        let [photograph, fit, difference] = &pictures[0];
        let expected: Vec<u8> = photograph.bytes.iter().zip(&fit.bytes).map(|(a, b)| a.abs_diff(*b)).collect();
        assert_eq!(difference.bytes, expected);
        let mean = |held_out| rows.iter().find(|r| r.view == View::Glossy && r.held_out == held_out).unwrap().mean;
        (mean(false), mean(true))
    };
    let (constant, lobes) = (of(Method::Job(AllowedModels::Constant)), of(Method::Job(AllowedModels::Auto)));
    // Highlights are what a constant does not have.
    assert!(lobes.0 < 0.7 * constant.0 && lobes.1 < constant.1, "{constant:?} {lobes:?}");
    assert!(lobes.0 < lobes.1 && constant.0 < constant.1, "{lobes:?} {constant:?}");
}
