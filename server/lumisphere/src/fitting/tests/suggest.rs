//! Directions that are suggested: where they lie, and what sampling them is worth.

use glam::{Mat3, Vec3};

use super::cases::*;
use crate::fitting::suggest::{KnownTexel, suggest};
use crate::fitting::*;

fn settings() -> Settings {
    Settings::new(Choice::Auto { lobes_at_most: 3 }, Noise { floor: 0.005, relative: 0.0 })
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|c| a[c] * b[c]).sum()
}

/// Its frame is that of the candidates.
fn flat<'a>(model: &'a Model, directions: &'a [[f32; 3]], noise: f32) -> KnownTexel<'a> {
    KnownTexel { model, directions, local_from_shared: Mat3::IDENTITY, noise }
}

fn known<'a>(fits: &'a [Fit], directions: &'a [[f32; 3]]) -> Vec<KnownTexel<'a>> {
    fits.iter().map(|fit| flat(&fit.model, directions, 0.005)).collect()
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
    println!("dense error {} with eight suggested, {others:?} with eight others", error(&suggested));
    assert!(error(&suggested) < 0.7 * others[4], "{} against {others:?}", error(&suggested));
}

#[test]
fn samples_without_noise_are_believed_and_do_not_hide_a_texel() {
    // Two views on the lobe, nothing left by the fit.
    let axis = normalized([0.3, 0.0, 1.0]);
    let model = Model::Lobes { constant: [0.2; 3], lobes: vec![Lobe { axis, exponent: 100.0, amplitude: [1.0; 3] }] };
    let seen = [axis, normalized([0.35, 0.05, 1.0])];
    let texel = flat(&model, &seen, 0.0);
    let suggested = suggest(&[texel], &icosahedron(1249), 2);
    assert!(suggested.iter().all(|s| dot(s.direction, axis) > 20_f32.to_radians().cos() && s.gain > 1.0), "{suggested:?}");
}

#[test]
fn a_texel_that_faces_elsewhere_asks_for_directions_that_it_sees() {
    // Its normal is the candidates' +X: it sees those with x above 0, and has a lobe along (.8, 0, .6) there, which two samples have seen.
    let local_from_shared = Mat3::from_cols(Vec3::Z, Vec3::Y, -Vec3::X);
    let toward = |shared: [f32; 3]| (local_from_shared * Vec3::from(normalized(shared))).to_array();
    let axis = toward([0.8, 0.0, 0.6]);
    let model = Model::Lobes { constant: [0.2; 3], lobes: vec![Lobe { axis, exponent: 100.0, amplitude: [1.0; 3] }] };
    let seen = [axis, toward([0.8, 0.05, 0.6])];
    let texel = KnownTexel { model: &model, directions: &seen, local_from_shared, noise: 0.005 };
    let all = icosahedron(1249);
    let suggested = suggest(std::slice::from_ref(&texel), &all, 2);
    assert!(suggested.iter().all(|s| dot(s.direction, [0.8, 0.0, 0.6]) > 20_f32.to_radians().cos()), "{suggested:?}");
    // All that it sees, and no more.
    let every = suggest(&[texel], &all[..200], 2000);
    assert!(every.iter().all(|s| s.direction[0] > 0.0 && s.gain > 0.0));
    assert_eq!(every.len(), all[..200].iter().filter(|d| d[0] > 0.0).count());
}

#[test]
fn nothing_known_and_nothing_to_choose_from_are_no_trouble() {
    assert!(suggest(&[], &[], 5).is_empty());
    let spread = suggest(&[], &icosahedron(17), 20);
    assert_eq!(spread.len(), 17);
    assert!(spread.iter().all(|s| s.gain.is_finite() && s.gain > 0.0), "{spread:?}");
    let harmonics = Model::Harmonics { basis: Basis::Hemispherical, coefficients: vec![[0.5; 3]; 4] };
    let seen = icosahedron(17);
    let texel = flat(&harmonics, &seen, 0.0);
    assert!(suggest(&[texel], &icosahedron(73), 3).iter().all(|s| s.gain.is_finite()));
}

#[test]
fn what_one_texel_alone_sees_may_be_suggested() {
    let model = Model::Constant { value: [0.5; 3] };
    let candidates = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
    // One of 64 faces the other way, wherever it stands.
    for other in 0..64 {
        let mut texels: Vec<KnownTexel<'_>> = (0..64).map(|_| flat(&model, &[], 0.01)).collect();
        texels[other].local_from_shared = Mat3::from_rotation_x(std::f32::consts::PI);
        assert_eq!(suggest(&texels, &candidates, 2).len(), 2, "texel {other}");
        assert_eq!(suggest(&texels[..other], &candidates, 2).len(), if other == 0 { 2 } else { 1 });
    }
}
