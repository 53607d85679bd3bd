//! Where a sky is the only light, the last vertex of a path asks the light alone: no bias against the two strategies together.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::raytrace::sky::Sky;
use crate::raytrace::sky_cells::NormalBin;
use crate::raytrace::warp;

/// A dim gradient with a sun of two texels low above the horizon: 64 × 32 texels.
fn sunny() -> Environment {
    sky_map(64, 0.6, |column, row| {
        let sun = if row == 13 && (20..22).contains(&column) { 400.0 } else { 0.0 };
        Vec3::new(0.3 + 0.01 * row as f32 + sun, 0.5 + 0.8 * sun, 0.2 + 0.02 * (column % 8) as f32 + 0.5 * sun)
    })
}

/// A ball and a wall on a floor.
fn yard() -> Scene {
    let wall = quad([Vec3::new(-1.0, 0.0, -0.8), Vec3::new(1.0, 0.0, -0.8), Vec3::new(1.0, 1.5, -0.8), Vec3::new(-1.0, 1.5, -0.8)]);
    let parts = vec![
        (floor(2.0, 0.0), diffuse(0.6), None),
        (sphere(Vec3::new(0.3, 0.4, 0.1), 0.4, 16), diffuse(0.8), None),
        (wall, diffuse(0.4), None),
    ];
    let mut scene = scene(parts, Vec3::ZERO);
    scene.environment = sunny();
    scene
}

/// Irradiance by uniform directions and the brute force of one ray each: mean and standard deviation of the mean.
fn brute_force(tracer: &Tracer, environment: &Environment, at: Vec3, normal: Vec3, count: usize) -> (f64, f64) {
    let mut random = Pcg32::seed_from_u64(31);
    let (mut sum, mut squares) = (0.0, 0.0);
    for _ in 0..count {
        let y = 2.0 * random.random::<f32>() - 1.0;
        let around = Vec2::from_angle(std::f32::consts::TAU * random.random::<f32>()) * (1.0 - y * y).sqrt();
        let direction = Vec3::new(around.x, y, around.y);
        let cosine = direction.dot(normal);
        let ray = crate::geometry::Ray { origin: at + 1e-4 * normal, direction };
        let seen = cosine > 0.0 && tracer.intersect(&ray, f32::INFINITY).is_none();
        let value = if seen { f64::from(environment.radiance(direction).x * cosine) * 4.0 * std::f64::consts::PI } else { 0.0 };
        sum += value;
        squares += value * value;
    }
    let mean = sum / count as f64;
    (mean, ((squares / count as f64 - mean * mean) / count as f64).sqrt())
}

#[test]
fn light_sampled_alone_agrees_with_brute_force() {
    let scene = yard();
    let tracer = Tracer::new(&scene).unwrap();
    // In the open, in the wall's corner, on the wall, under the ball; a tilted element; one that looks down.
    let places = [
        (Vec3::new(-0.9, 0.0, 0.9), Vec3::Y),
        (Vec3::new(0.0, 0.0, -0.75), Vec3::Y),
        (Vec3::new(0.5, 0.7, -0.8), Vec3::Z),
        (Vec3::new(0.5, 0.0, 0.2), Vec3::Y),
        (Vec3::new(-0.5, 0.3, 0.5), Vec3::new(-0.6, 0.0, 0.8)),
        (Vec3::new(-0.5, 0.3, 0.5), Vec3::NEG_Y),
    ];
    for (at, normal) in places {
        let (expected, deviation) = brute_force(&tracer, &scene.environment, at, normal, 1 << 18);
        // 2¹⁴ stratified samples are far quieter than brute force: their own deviation is taken from four seeds.
        let runs: Vec<f64> =
            (1..=4).map(|seed| f64::from(tracer.irradiance(at, normal, 1 << 14, &TraceSettings { seed, ..settings(1, 0) }).x)).collect();
        let measured = runs.iter().sum::<f64>() / 4.0;
        let own = (runs.iter().map(|r| (r - measured).powi(2)).sum::<f64>() / 12.0).sqrt();
        let bound = 4.5 * deviation.hypot(own);
        assert!((measured - expected).abs() <= bound, "{at} {normal}: {measured} ± {own}, {expected} ± {deviation} expected");
        assert!(bound < 0.15 * expected + 1e-3, "{at} {normal}: ± {bound} of {expected} is too noisy to tell");
    }
}

#[test]
fn the_last_vertex_asked_alone_shows_what_both_strategies_show() {
    // A point light of no strength to speak of: the sky is then not the only light, and every vertex uses both strategies.
    let alone = Tracer::new(&yard()).unwrap();
    let mut with_point = yard();
    with_point.point_lights.push(crate::scenes::PointLight { position: Vec3::new(0.0, 50.0, 0.0), intensity: Vec3::splat(1e-6) });
    let both = Tracer::new(&with_point).unwrap();
    let mut darker = yard();
    darker.materials.iter_mut().for_each(|m| *m = diffuse(0.55));
    let darker = Tracer::new(&darker).unwrap();
    let view = camera(Vec3::new(0.2, 1.2, 2.5), Vec3::new(0.0, 0.3, 0.0), 50.0, 48);
    for bounces in [1, 2, 3] {
        let picture = |tracer: &Tracer, seed| render(tracer, &view, &TraceSettings { seed, ..settings(32, bounces) });
        let (a, b, c) =
            (mean_and_deviation(&picture(&alone, 1)), mean_and_deviation(&picture(&both, 2)), mean_and_deviation(&picture(&darker, 1)));
        let z = |p: (f64, f64)| (p.0 - b.0).abs() / p.1.hypot(b.1);
        assert!(z(a) < 4.5, "{bounces} bounces: {a:?}, {b:?}");
        // The control: albedos that are off show.
        assert!(z(c) > 9.0, "{bounces} bounces: {c:?}, {b:?}");
    }
}

#[test]
fn a_sky_and_an_area_light_together_show_the_sum_of_each_alone() {
    // A lamp above the ball that reflects nothing, so that the three scenes differ in light only.
    let lit = |sky: Environment, emission: Option<Vec3>| {
        let mut scene = yard();
        let lamp = quad([Vec3::new(0.0, 1.8, -0.3), Vec3::new(0.6, 1.8, -0.3), Vec3::new(0.6, 1.8, 0.3), Vec3::new(0.0, 1.8, 0.3)]);
        scene.materials.push(diffuse(0.0));
        let lamp = Object { name: "lamp".into(), mesh: lamp, surface: Surface::Mesh, material: scene.materials.len() - 1, emission };
        scene.objects.push(lamp);
        scene.environment = sky;
        Tracer::new(&scene).unwrap()
    };
    let radiance = Some(Vec3::splat(12.0));
    let [both, sky, lamp] = [lit(sunny(), radiance), lit(sunny(), None), lit(Environment::Constant(Vec3::ZERO), radiance)];
    let view = camera(Vec3::new(0.2, 1.2, 2.5), Vec3::new(0.0, 0.3, 0.0), 50.0, 48);
    for bounces in [1, 2] {
        let picture = |tracer: &Tracer, seed| mean_and_deviation(&render(tracer, &view, &TraceSettings { seed, ..settings(32, bounces) }));
        let (both, sky, lamp) = (picture(&both, 1), picture(&sky, 2), picture(&lamp, 3));
        let z = |expected: f64| (both.0 - expected).abs() / both.1.hypot(sky.1).hypot(lamp.1);
        assert!(z(sky.0 + lamp.0) < 4.5, "{bounces} bounces: {both:?}, {sky:?} and {lamp:?}");
        // The control: neither is so weak that its loss would not show.
        assert!(z(sky.0) > 9.0 && z(lamp.0) > 9.0, "{bounces} bounces: {both:?}, {sky:?} and {lamp:?}");
    }
}

#[test]
fn directions_are_drawn_nearly_as_light_times_cosine() {
    let environment = sunny();
    let Sky::Map(map) = Sky::new(&environment) else { panic!("a map") };
    let luminance = |rgb: Vec3| rgb.dot(Vec3::new(0.2126, 0.7152, 0.0722));
    for normal in warp::even_directions(40) {
        let mut random = Pcg32::seed_from_u64(33);
        let mut spread = |bin: NormalBin| {
            let values: Vec<f64> = (0..4000)
                .map(|_| {
                    let sample = map.sample(Vec2::new(random.random(), random.random()), bin).unwrap();
                    f64::from(luminance(sample.radiance) * sample.direction.dot(normal).max(0.0) / sample.pdf)
                })
                .collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt() / mean)
        };
        let (mean, with_cosine) = spread(NormalBin::of(normal));
        let (expected, without) = spread(NormalBin::ANY);
        // The two agree within their own noise. What is left to the first is mostly that the sun is not even inside its texels.
        assert!((mean / expected - 1.0).abs() < 4.5 * with_cosine.hypot(without) / 4000f64.sqrt(), "{normal}: {mean}, {expected} expected");
        assert!(with_cosine < 0.8 * without, "{normal}: {with_cosine}, {without} without the cosine");
    }
}

#[test]
fn no_direction_that_brings_light_has_density_zero() {
    let environment = sunny();
    let Sky::Map(map) = Sky::new(&environment) else { panic!("a map") };
    let mut random = Pcg32::seed_from_u64(34);
    for normal in warp::even_directions(300) {
        for _ in 0..300 {
            let direction = warp::cosine_hemisphere(Vec2::new(random.random(), random.random()));
            // Half of them just above the horizon, where the table's cosines say nothing.
            let low = Vec3::new(direction.x, direction.y, 0.02 * direction.z * random.random::<f32>()).normalize();
            for local in [direction, low] {
                let world = crate::geometry::TangentFrame::around(normal).world_from_local(local);
                let (radiance, pdf) = map.eval(world, NormalBin::of(normal));
                assert!(pdf > 0.0 && (radiance.y * local.z / pdf).is_finite(), "{normal}, {world}: {radiance}, {pdf}");
            }
        }
    }
}
