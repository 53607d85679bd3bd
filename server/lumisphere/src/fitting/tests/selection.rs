//! Which model a texel gets.

use super::cases::*;
use crate::directions::Scheme;
use crate::fitting::*;

fn auto() -> Settings {
    Settings::new(Choice::Auto { lobes_at_most: 3 }, Noise { floor: 3e-4, relative: 0.0 })
}

fn mixed() -> Vec<Model> {
    random_lobes(256, &[0, 1, 2, 3], [5.0, 80.0])
}

#[test]
fn a_mixed_map_gets_the_lobes_that_it_has() {
    for (count, sigma, exact) in [(289, 0.0, 1.0), (289, 0.005, 1.0), (289, 0.02, 1.0), (73, 0.005, 0.99), (73, 0.02, 0.99)] {
        let judged = Case::new(mixed(), &icosahedron(count)).noise(sigma).fit(&auto());
        let found = judged.exact();
        assert!(found.0 >= exact && found.1 <= 0.01, "{count} views, noise {sigma}: exact, over {found:?}");
    }
}

#[test]
fn the_choice_is_smaller_and_nearer_than_three_lobes_for_all() {
    let case = Case::new(mixed(), &icosahedron(289)).noise(0.005);
    let (chosen, three) = (case.fit(&auto()), case.fit(&Settings { choice: Choice::Exactly(Rung::Lobes(3)), ..auto() }));
    // The truth has 12 on average.
    assert!(chosen.floats() <= 12.1, "{}", chosen.floats());
    assert!(chosen.dense() <= 6.5e-4, "{:.1e}", chosen.dense());
    assert!(chosen.dense() < 0.7 * three.dense(), "{:.1e}, three lobes {:.1e}", chosen.dense(), three.dense());
}

#[test]
fn a_diffuse_texel_gets_no_lobe() {
    for count in [289, 73] {
        for specular in [0.0, 0.0001, 0.001] {
            let judged = Case::new(one_light(specular, 20.0), &icosahedron(count)).noise(0.005).fit(&auto());
            assert_eq!(judged.share(|fit| lobes(&fit.model) == 0), 1.0, "{count} views, specular {specular}");
            assert!(judged.dense() <= 6.5e-4, "{count} views, specular {specular}: {:.1e}", judged.dense());
        }
        let faint = Case::new(one_light(0.01, 20.0), &icosahedron(count)).noise(0.005).fit(&auto());
        assert!(faint.dense() <= 1.7e-3, "{count} views: {:.1e}", faint.dense());
        let claimed = faint
            .share(|fit| matches!(&fit.model, Model::Lobes { lobes, .. } if lobes.iter().any(|l| l.amplitude.iter().any(|a| *a > 0.1))));
        assert_eq!(claimed, 0.0, "{count} views: a lobe of twice the noise is not a tenth");
    }
}

#[test]
fn darkening_towards_the_horizon_is_no_lobe() {
    let truth = |_| Model::CosinePower { value: [0.5, 0.3, 0.2], exponent: 0.4 };
    let above: Vec<[f32; 3]> = icosahedron(289).into_iter().filter(|d| d[2] > 0.15).collect();
    let judged = Case::new(texels().map(truth).collect(), &above).noise(0.005).fit(&auto());
    assert!(judged.share(|fit| matches!(fit.model, Model::CosinePower { .. })) >= 0.95);
    // Four parameters of 3 N numbers, and what lies below the lowest view.
    assert!(judged.dense() <= 5e-4, "{:.1e}", judged.dense());
}

#[test]
fn other_schemes_serve_as_well() {
    let latitude = Scheme::latitude_longitude(vec![1, 8, 8, 16, 16, 32, 32]).unwrap().directions();
    // The coarse icosahedron, and 81 more within 35° of the highlight, as in the thesis' test of uneven sampling.
    let mut uneven = icosahedron(73);
    let Model::Lobes { lobes, .. } = &one_light(0.4, 20.0)[136] else { panic!("a lobe") };
    let near = |d: &&[f32; 3]| (0..3).map(|c| d[c] * lobes[0].axis[c]).sum::<f32>() > 0.82;
    uneven.extend(icosahedron(1249).iter().filter(near).take(81));
    for (name, directions) in [("latitude", latitude.iter().map(|d| d.to_array()).collect()), ("uneven", uneven)] {
        let judged = Case::new(one_light(0.4, 20.0), &directions).fit(&auto());
        assert_eq!(judged.exact(), (1.0, 0.0), "{name}");
        assert!(judged.dense() <= 3e-7, "{name}: {:.1e}", judged.dense());
    }
}

struct Sloped;

impl FurtherRung for Sloped {
    /// `value (1 + x)`, fitted by hand: it is no lobe and no constant.
    fn fit(&self, samples: &Samples) -> Option<Further> {
        let (mut own, mut product) = ([0.0; 3], [0.0; 3]);
        for (d, value) in samples.directions.iter().zip(&samples.values) {
            for c in 0..3 {
                own[c] += f64::from((1.0 + d[0]).powi(2));
                product[c] += f64::from((1.0 + d[0]) * value[c]);
            }
        }
        let residual = |(d, value): (&[f32; 3], &[f32; 3])| {
            (0..3).map(|c| (f64::from(value[c]) - product[c] / own[c] * f64::from(1.0 + d[0])).powi(2)).sum::<f64>()
        };
        let cost = samples.directions.iter().zip(&samples.values).map(residual).sum();
        // Stands for any model; only its cost is looked at here.
        Some(Further { model: Model::Harmonics { basis: Basis::Spherical, coefficients: vec![[0.0; 3]; 4] }, cost, parameters: 12.0 })
    }
}

#[test]
fn a_further_rung_is_taken_only_where_it_wins() {
    let directions = icosahedron(289);
    // Values of thousands: the further rung's cost comes in the samples' unit.
    let mut sloped = Case::new(vec![Model::Constant { value: [0.0; 3] }; 16], &directions);
    sloped.values.iter_mut().for_each(|v| v.iter_mut().zip(&directions).for_each(|(v, d)| *v = [3000.0 * (1.0 + d[0]); 3]));
    let lobe = Case::new(vec![one_light(0.4, 20.0)[0].clone(); 16], &directions);
    for (case, floor, wins) in [(sloped.noise(20.0), 1.0, true), (lobe.noise(0.005), 3e-4, false)] {
        let settings = Settings { noise: Noise { floor, relative: 0.0 }, ..auto() };
        for outcome in fit_with(&case.batch(), &settings, Some(&Sloped)).unwrap() {
            let model = outcome.fit().map(|fit| &fit.model);
            assert_eq!(matches!(model, Some(Model::Harmonics { .. })), wins, "{model:?}");
        }
    }
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let with = |choice, floor, relative| fit(&Batch::new(), &Settings::new(choice, Noise { floor, relative }));
    let auto = |lobes_at_most| Choice::Auto { lobes_at_most };
    assert_eq!(with(auto(5), 1e-3, 0.0), Err(SettingsError::Lobes(5)));
    assert_eq!(with(Choice::Exactly(Rung::Lobes(0)), 1e-3, 0.0), Err(SettingsError::Lobes(0)));
    assert_eq!(with(auto(3), 0.0, 0.0), Err(SettingsError::NoiseFloor(0.0)));
    assert!(matches!(with(auto(3), f32::NAN, 0.0), Err(SettingsError::NoiseFloor(_))));
    assert_eq!(with(auto(3), 1e-3, -1.0), Err(SettingsError::RelativeNoise(-1.0)));
    assert_eq!(with(auto(0), 1e-3, 0.0), Ok(vec![]));
}
