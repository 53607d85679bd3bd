//! Directions that are suggested: where they lie, and what sampling them is worth.

use super::cases::*;
use crate::fitting::suggest::{KnownTexel, suggest};
use crate::fitting::*;

fn settings() -> Settings {
    Settings::new(Choice::Auto { lobes_at_most: 3 }, Noise { floor: 0.005, relative: 0.0 })
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|c| a[c] * b[c]).sum()
}

fn known<'a>(fits: &'a [Fit], directions: &'a [[f32; 3]]) -> Vec<KnownTexel<'a>> {
    fits.iter().map(|fit| KnownTexel { model: &fit.model, directions, noise: 0.005 }).collect()
}

#[test]
fn a_lobe_that_is_hardly_seen_is_looked_at() {
    let seen = icosahedron(17);
    let case = Case::new(one_light(0.4, 80.0), &seen).noise(0.005);
    let fits = case.fit(&Settings { choice: Choice::Exactly(Rung::Lobes(1)), ..settings() }).fits;
    let Model::Lobes { lobes, .. } = &fits[8 * 16 + 8].model else { panic!("a lobe") };
    let suggested = suggest(&known(&fits, &seen), &icosahedron(305), 8);
    let near = suggested.iter().filter(|s| dot(s.direction, lobes[0].axis) > 25_f32.to_radians().cos()).count();
    // 25° about an axis are a tenth of the hemisphere.
    assert!(near >= 4, "{suggested:?}");
    assert!(suggested.is_sorted_by(|a, b| a.gain >= b.gain), "returns diminish: {suggested:?}");
}

#[test]
fn a_hole_among_the_samples_is_looked_into() {
    let seen: Vec<[f32; 3]> = icosahedron(305).into_iter().filter(|d| d[0] < 0.3).collect();
    let fits = Case::new(one_light(0.0, 20.0), &seen).noise(0.005).fit(&settings()).fits;
    let suggested = suggest(&known(&fits, &seen), &icosahedron(305), 6);
    assert!(suggested.iter().all(|s| s.direction[0] >= 0.3), "{suggested:?}");
    // Not all in one place.
    let apart = suggested.iter().enumerate().all(|(i, a)| suggested[..i].iter().all(|b| dot(a.direction, b.direction) < 0.98));
    assert!(apart, "{suggested:?}");
}

#[test]
fn what_is_suggested_is_worth_more_than_as_many_directions_at_random() {
    let (seen, all) = (icosahedron(17), icosahedron(305));
    let truth = one_light(0.4, 60.0);
    let error = |more: &[[f32; 3]]| {
        let directions = [seen.as_slice(), more].concat();
        Case::new(truth.clone(), &directions).noise(0.005).fit(&settings()).dense()
    };
    let fits = Case::new(truth.clone(), &seen).noise(0.005).fit(&settings()).fits;
    let suggested: Vec<[f32; 3]> = suggest(&known(&fits, &seen), &all, 8).iter().map(|s| s.direction).collect();
    // Every 37th: eight directions all over the hemisphere, nine such sets.
    let mut others: Vec<f64> = (0..9).map(|k| error(&(0..8).map(|i| all[(k * 4 + i * 37) % 305]).collect::<Vec<_>>())).collect();
    others.sort_by(f64::total_cmp);
    assert!(error(&suggested) < 0.7 * others[4], "{} against {others:?}", error(&suggested));
}

#[test]
fn samples_without_noise_are_believed_and_do_not_hide_a_texel() {
    // Two views on the lobe, nothing left by the fit.
    let axis = normalized([0.3, 0.0, 1.0]);
    let model = Model::Lobes { constant: [0.2; 3], lobes: vec![Lobe { axis, exponent: 100.0, amplitude: [1.0; 3] }] };
    let seen = [axis, normalized([0.35, 0.05, 1.0])];
    let texel = KnownTexel { model: &model, directions: &seen, noise: 0.0 };
    let suggested = suggest(&[texel], &icosahedron(1249), 2);
    assert!(suggested.iter().all(|s| dot(s.direction, axis) > 20_f32.to_radians().cos() && s.gain > 1.0), "{suggested:?}");
}

#[test]
fn nothing_known_and_nothing_to_choose_from_are_no_trouble() {
    assert!(suggest(&[], &[], 5).is_empty());
    let spread = suggest(&[], &icosahedron(17), 20);
    assert_eq!(spread.len(), 17);
    assert!(spread.iter().all(|s| s.gain.is_finite() && s.gain > 0.0), "{spread:?}");
    let harmonics = Model::Harmonics { basis: Basis::Hemispherical, coefficients: vec![[0.5; 3]; 4] };
    let texel = KnownTexel { model: &harmonics, directions: &icosahedron(17), noise: 0.0 };
    assert!(suggest(&[texel], &icosahedron(73), 3).iter().all(|s| s.gain.is_finite()));
}
