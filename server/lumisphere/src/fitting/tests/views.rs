//! Few views, and views that leave a part of the hemisphere out.

use super::cases::*;
use crate::fitting::*;

fn auto() -> Settings {
    Settings::new(Choice::Auto { lobes_at_most: 3 }, Noise { floor: 3e-4, relative: 0.0 })
}

fn is_unresolved(fit: &Fit) -> bool {
    fit.flags.contains(Flags::UNRESOLVED)
}

/// Share of texels that are wrong without saying so.
fn bad_and_silent(judged: &Judged) -> f64 {
    let pairs = judged.fits.iter().zip(&judged.errors);
    pairs.filter(|(fit, error)| **error > 0.05 && !is_unresolved(fit)).count() as f64 / judged.fits.len() as f64
}

/// Where the views of a texel lie.
#[derive(Clone, Copy, PartialEq)]
enum Views {
    /// Half of them within 20° of the highlight.
    AroundTheLobe,
    Anywhere,
}

fn few(truth: Vec<Model>, count: usize, views: Views) -> Case {
    let mut case = Case::new(truth, &[]);
    for t in 0..case.truth.len() {
        let Model::Lobes { lobes, .. } = &case.truth[t] else { panic!("a lobe") };
        let axis = lobes[0].axis;
        let mut directions: Vec<[f32; 3]> = Vec::new();
        while directions.len() < count {
            let inside = [2.0 * case.uniform() - 1.0, 2.0 * case.uniform() - 1.0, case.uniform()];
            if inside.iter().map(|x| x * x).sum::<f32>() > 1.0 {
                continue;
            }
            let mut d = normalized(inside);
            if views == Views::AroundTheLobe && directions.len() < count / 2 {
                d = normalized(std::array::from_fn(|c| axis[c] + 0.35 * d[c]));
            }
            if d[2] > 0.05 {
                directions.push(d);
            }
        }
        case.values[t] = directions.iter().map(|&d| case.truth[t].eval(d)).collect();
        case.states[t] = vec![State::VALID; count];
        case.directions[t] = directions;
    }
    case.noise(0.005)
}

#[test]
fn twelve_and_eight_views_around_the_highlight_give_it_or_say_that_they_do_not() {
    for count in [12, 8] {
        let judged = few(one_light(0.4, 20.0), count, Views::AroundTheLobe).fit(&auto());
        assert!(judged.share(|fit| lobes(&fit.model) <= 1) >= 0.98, "{count} views");
        assert!(bad_and_silent(&judged) <= 0.03, "{count} views: {}", bad_and_silent(&judged));
        assert!(judged.bad() <= 0.02, "{count} views: {}", judged.bad());
    }
}

#[test]
fn views_that_do_not_determine_a_lobe_say_so() {
    for (count, views) in [(4, Views::AroundTheLobe), (4, Views::Anywhere), (8, Views::Anywhere), (12, Views::Anywhere)] {
        let truth = if views == Views::Anywhere { random_lobes(256, &[1], [2.0, 200.0]) } else { one_light(0.4, 20.0) };
        let judged = few(truth, count, views).fit(&auto());
        let pairs = judged.fits.iter().zip(&judged.errors);
        let told = pairs.filter(|(fit, error)| is_unresolved(fit) || **error <= 0.03).count() as f64 / 256.0;
        assert!(told >= 0.99, "{count} views: {told}");
        assert!(bad_and_silent(&judged) <= 0.005, "{count} views: {}", bad_and_silent(&judged));
        // Amplitudes between the views do not run away: no error of more than the samples themselves.
        let worst = judged.errors.iter().fold(0.0, |a: f64, &b| a.max(b));
        assert!(worst < 1.0, "{count} views: {worst}");
    }
}

#[test]
fn seventeen_views_serve() {
    for (sigma, bad) in [(0.005, 0.01), (0.02, 0.04)] {
        let case = Case::new(one_light(0.4, 20.0), &icosahedron(17)).noise(sigma);
        let judged = case.fit(&auto());
        assert!(judged.bad() <= bad, "noise {sigma}: {}", judged.bad());
        for (fit, values) in judged.fits.iter().zip(&case.values) {
            let Model::Lobes { lobes, .. } = &fit.model else { continue };
            let most = values.iter().flatten().fold(0.0, |a: f32, &b| a.max(b));
            assert!(lobes[0].amplitude.iter().all(|&a| a <= 1.2 * most), "noise {sigma}: {lobes:?}, largest sample {most}");
        }
    }
}

#[test]
fn missing_low_views_do_no_harm_to_a_lobe_inside() {
    for limit in [60_f32, 75.0] {
        let directions: Vec<[f32; 3]> = icosahedron(289).into_iter().filter(|d| d[2] > limit.to_radians().cos()).collect();
        let judged = Case::new(one_light(0.4, 20.0), &directions).noise(0.005).fit(&auto());
        assert!(judged.dense() <= 8e-4, "up to {limit}°: {:.1e}", judged.dense());
    }
}
