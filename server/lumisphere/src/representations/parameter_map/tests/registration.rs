//! Photographs that lie beside the others are named by a fit's report, and nothing else is.

use std::f32::consts::TAU;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::construct::{SIZE, observed_as, settings, source};
use crate::capture::observation_map::ObservedTexel;
use crate::directions::Scheme;
use crate::fitting::{Lobe, Model, Outliers};
use crate::progress::Unattended;
use crate::representations::parameter_map::{ConstructSettings, FitSummary, Registration, Shifted, construct};
use crate::textures::{Page, PageId, Store, StoreError, StoreOptions};

/// What the sheet looks like, and how its photographs come out.
#[derive(Clone, Copy)]
struct Case {
    views: &'static str,
    models: &'static str,
    /// Of the photographs that are shifted, texels.
    shift: f32,
    /// One of so many is.
    one_of: usize,
    /// Standard deviation of an observation.
    noise: f32,
    /// Of the texture, texels; 0: none.
    wavelength: f32,
    /// Height, exponent and number of highlights.
    highlight: (f32, f32, usize),
    /// Share of observations that are anything.
    outliers: f32,
    seed: u64,
}

const CASE: Case = Case {
    views: "icosahedron:73",
    models: "auto",
    shift: 0.0,
    one_of: 1,
    noise: 0.005,
    wavelength: 8.0,
    highlight: (0.3, 20.0, 1),
    outliers: 0.0,
    seed: 1,
};

/// Six waves in directions all around, between 0.1 and 0.7, about `wavelength` texels long.
fn texture(wavelength: f32, seed: u64) -> impl Fn(Vec2) -> f32 {
    let mut random = Pcg32::seed_from_u64(seed);
    let waves: Vec<(Vec2, f32)> = (0..6)
        .map(|k| {
            let length = wavelength * (0.7 + 0.9 * random.random::<f32>());
            (Vec2::from_angle(TAU / 12.0 * (k as f32 + random.random::<f32>())) / length, random.random::<f32>())
        })
        .collect();
    move |at| match wavelength > 0.0 {
        true => 0.4 + 0.05 * waves.iter().map(|(wave, phase)| (TAU * (wave.dot(at) + phase)).sin()).sum::<f32>(),
        false => 0.4,
    }
}

/// Each photograph that is shifted is so by `shift` texels in a random direction of its own.
fn fit(case: Case) -> FitSummary {
    let directions = case.views.parse::<Scheme>().unwrap().directions();
    let mut random = Pcg32::seed_from_u64(100 + case.seed);
    let mut shift = |row: usize| {
        let length = if row.is_multiple_of(case.one_of) { case.shift } else { 0.0 };
        length * Vec2::from_angle(TAU * random.random::<f32>())
    };
    let shifts: Vec<Vec2> = (0..directions.len()).map(&mut shift).collect();
    let texture = texture(case.wavelength, case.seed);
    let (height, exponent, lobes) = case.highlight;
    let radiance = |texel: &ObservedTexel, row: usize, direction: Vec3| {
        let within = texel.index as usize % (SIZE * SIZE);
        let at = Vec2::new((within % SIZE) as f32, (within / SIZE) as f32) + shifts[row];
        let shade = texture(at);
        let lobe = |k: usize| {
            let axis = Vec3::new(0.3 - 0.35 * k as f32, -0.2 + 0.3 * k as f32, 0.9).normalize().to_array();
            Lobe { axis, exponent, amplitude: [height * (0.5 + shade); 3] }
        };
        let truth = match lobes {
            0 => Model::Constant { value: [shade, 0.5 * shade, 0.2] },
            lobes => Model::Lobes { constant: [shade, 0.5 * shade, 0.2], lobes: (0..lobes).map(lobe).collect() },
        };
        // Its own numbers, whatever the order.
        let mut random = Pcg32::new(u64::from(texel.index) << 20 | row as u64, case.seed);
        if random.random::<f32>() < case.outliers {
            return [0.0; 3].map(|_| 3.0 * random.random::<f32>());
        }
        // Sum of twelve uniform numbers: standard deviation 1.
        truth.eval(direction.to_array()).map(|value| {
            let normal = (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0;
            (value + case.noise * normal).max(0.0)
        })
    };
    let (map, pages): (_, Vec<Arc<Page>>) = observed_as(&directions, &radiance);
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
    store.create_dataset("map").unwrap();
    let staging = store.stage("map", "token").unwrap();
    let read = |page: PageId| Ok::<_, StoreError>(pages[page.0 as usize].clone());
    let outliers = if case.outliers > 0.0 { Outliers::Reject } else { Outliers::Keep };
    let settings =
        ConstructSettings { models: case.models.parse().unwrap(), noise_floor: Some(case.noise.max(1e-3)), outliers, ..settings() };
    construct(&source(&map, &read), &settings, &staging, &Unattended).unwrap().1
}

fn registration(case: Case) -> Registration {
    let found = fit(case).registration.unwrap();
    println!(
        "{} {} shift {} of one in {} noise {} wave {} highlight {:?} outliers {}: {} of {}, {:?}",
        case.views,
        case.models,
        case.shift,
        case.one_of,
        case.noise,
        case.wavelength,
        case.highlight,
        case.outliers,
        found.shifted.len(),
        found.compared,
        found.shifted.iter().take(4).collect::<Vec<_>>()
    );
    found
}

#[test]
fn photographs_beside_each_other_are_named() {
    // With the share that must be found. Photographs that are all shifted by a quarter of the texture's wave blur it: where they are, half is enough.
    let all = [
        (Case { shift: 1.0, ..CASE }, 0.8),
        (Case { shift: 2.0, wavelength: 14.0, ..CASE }, 0.8),
        (Case { shift: 3.0, wavelength: 20.0, ..CASE }, 0.8),
        (Case { shift: 2.0, ..CASE }, 0.5),
        // A texel's step in the texture is but twice the noise.
        (Case { shift: 1.0, noise: 0.02, wavelength: 16.0, ..CASE }, 0.5),
        (Case { shift: 1.0, models: "sh:16", ..CASE }, 0.8),
        (Case { shift: 1.0, views: "icosahedron:17", highlight: (0.0, 1.0, 0), ..CASE }, 0.8),
    ];
    let tenth = [1.0, 2.0, 3.0].map(|shift| (Case { shift, one_of: 10, ..CASE }, 0.7));
    let mut missed = Vec::new();
    for (case, least) in all.into_iter().chain(tenth) {
        let found = registration(case);
        let moved = found.compared.div_ceil(case.one_of as u64);
        let is_found = found.shifted.len() as f32 >= least * moved as f32 && found.compared >= 16;
        let length = |one: &Shifted| Vec2::new(one.texels[0] as f32, one.texels[1] as f32).length();
        let is_right = found.shifted.iter().take(4).all(|one| (length(one) - case.shift).abs() < 1.3);
        // None but those that are.
        let is_moved = found.shifted.iter().all(|one| (one.observation as usize).is_multiple_of(case.one_of));
        let told = serde_json::to_value(&found).unwrap();
        let is_told = told["shifted"] == found.shifted.len() && told["worst"].as_array().unwrap().len() == found.shifted.len().min(4);
        if !(is_found && is_right && is_moved && is_told) {
            missed.push(found);
        }
    }
    assert!(missed.is_empty(), "{missed:#?}");
}

#[test]
fn noise_highlights_glints_and_wrong_models_are_not_taken_for_shifts() {
    let cases = [
        CASE,
        Case { noise: 0.02, ..CASE },
        Case { noise: 0.1, ..CASE },
        Case { noise: 0.0, ..CASE },
        Case { wavelength: 0.0, ..CASE },
        Case { wavelength: 2.5, ..CASE },
        Case { wavelength: 30.0, ..CASE },
        // A highlight of 50 times the rest, narrower than the views are apart.
        Case { highlight: (20.0, 200.0, 1), ..CASE },
        // Two, where one is allowed; one, where none is; and harmonics of what they cannot say.
        Case { models: "phong:1", highlight: (0.5, 30.0, 2), ..CASE },
        Case { models: "constant", ..CASE },
        Case { models: "sh:9", highlight: (1.0, 100.0, 1), ..CASE },
        Case { outliers: 0.01, ..CASE },
        Case { views: "icosahedron:17", ..CASE },
        Case { views: "icosahedron:17", noise: 0.05, wavelength: 0.0, ..CASE },
        // A tenth of a texel is no fault.
        Case { shift: 0.1, ..CASE },
    ];
    let (mut shifted, mut compared) = (0, 0);
    for case in cases {
        let found = registration(Case { seed: 2, ..case });
        (shifted, compared) = (shifted + found.shifted.len(), compared + found.compared);
    }
    println!("{shifted} of {compared} photographs falsely");
    assert_eq!(shifted, 0, "of {compared}");
    assert!(compared > 900);
}
