//! Light whose amount is known exactly.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use super::*;
use crate::scenes::PointLight;

// z-tests at 4.5 standard deviations: one false alarm in 150 000 seeds, and the seeds are fixed.
const Z: f64 = 4.5;

#[test]
fn a_closed_furnace_shows_the_geometric_series_at_every_bounce_limit() {
    let (emission, albedo) = (0.7, 0.6f32);
    let tracer = Tracer::new(&scene(vec![(room(), diffuse(albedo), Some(Vec3::splat(emission)))], Vec3::ZERO)).unwrap();
    for bounces in [0, 1, 2, 5, 60] {
        let image = render(&tracer, &camera(Vec3::new(0.1, -0.2, 0.3), Vec3::new(1.0, 0.4, -0.3), 70.0, 24), &settings(64, bounces));
        let expected = emission * (1.0 - albedo.powi(bounces as i32 + 1)) / (1.0 - albedo);
        let (mean, deviation) = mean_and_deviation(&image);
        // The variance is an upper estimate; rounding of the sum adds 1e-5.
        assert!((mean - f64::from(expected)).abs() < Z * deviation + 1e-5, "{bounces} bounces: {mean} ± {deviation}, {expected} expected");
        assert!(deviation < 0.004 * f64::from(expected) + 1e-6, "too noisy to tell: {deviation}");
    }
}

#[test]
fn a_white_convex_body_is_invisible_before_a_uniform_sky() {
    let flat = {
        let smooth = sphere(Vec3::ZERO, 1.0, 12);
        let corners: Vec<Vec3> = (0..smooth.triangles.len()).flat_map(|t| smooth.corners(t)).collect();
        let count = corners.len();
        let triangles = (0..count as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        TriangleMesh::new(corners, vec![Vec3::ZERO; count], vec![Vec2::ZERO; count], triangles).unwrap()
    };
    let tracer = Tracer::new(&scene(vec![(flat, diffuse(1.0), None)], Vec3::splat(0.8))).unwrap();
    let image = render(&tracer, &camera(Vec3::new(0.0, 1.0, 4.0), Vec3::ZERO, 40.0, 32), &settings(4, 8));
    assert!(image.object.contains(&0) && image.object.contains(&u32::MAX));
    // Every path leaves after one reflection with weight 1: exact to rounding.
    assert!(image.radiance.planes[0].iter().all(|v| (v - 0.8).abs() < 1e-5));
}

#[test]
fn a_white_smooth_sphere_is_invisible_before_a_uniform_sky_map() {
    let mut scene = scene(vec![(sphere(Vec3::ZERO, 1.0, 48), diffuse(1.0), None)], Vec3::ZERO);
    scene.environment = sky_map(16, 0.3, |_, _| Vec3::splat(0.8));
    let image = render(&Tracer::new(&scene).unwrap(), &camera(Vec3::new(0.0, 1.0, 3.0), Vec3::ZERO, 40.0, 32), &settings(64, 8));
    let (mean, deviation) = mean_and_deviation(&image);
    // Shading normals tilt by up to π/48 against the facets: the cosine lobe below the facet, at most tilt²/4 = 0.001, is absorbed.
    let lost = 0.8 * (std::f64::consts::PI / 48.0).powi(2) / 4.0;
    assert!((mean - 0.8).abs() < Z * deviation + lost, "{mean} ± {deviation}");
}

#[test]
fn irradiance_under_a_constant_sky_is_pi_and_a_sphere_takes_its_share() {
    let (radius, distance) = (1.0f32, 3.0f32);
    let blocker = sphere(Vec3::new(0.0, distance, 0.0), radius, 64);
    let constant = scene(vec![(blocker, diffuse(0.0), None)], Vec3::splat(2.0));
    let mut mapped = constant.clone();
    mapped.environment = sky_map(32, 1.0, |_, _| Vec3::splat(2.0));
    let samples = 1 << 14;
    // Configuration factor of a sphere straight above a plane element: (r/d)². The mesh lies inside the sphere by 1 − cos(π/64)/2.
    let expected = 2.0 * PI * (1.0 - (radius / distance).powi(2));
    for scene in [constant, mapped] {
        let tracer = Tracer::new(&scene).unwrap();
        let measured = tracer.irradiance(Vec3::ZERO, Vec3::Y, samples, &settings(1, 1)).x;
        // A sample is E·(0 or up to 2): deviation ≤ E/√n for independent ones; the mesh's own error is 2·(0.0012)·(r/d)² = 0.0003 E.
        let bound = 4.5 * expected / (samples as f32).sqrt();
        assert!((measured - expected).abs() < bound, "{measured}, {expected} expected");
        let free = tracer.irradiance(Vec3::ZERO, Vec3::NEG_Y, samples, &settings(1, 1)).x;
        assert!((free - 2.0 * PI).abs() < bound, "{free}, 2π expected");
    }
}

#[test]
fn irradiance_under_a_disc_light_is_its_configuration_factor() {
    let (radius, height, radiance) = (0.5f32, 1.25f32, 3.0f32);
    let disc = |facing: f32| {
        let rim = 256;
        let mut positions = vec![Vec3::new(0.0, height, 0.0)];
        positions.extend((0..rim).map(|i| {
            let (sin, cos) = (facing * std::f32::consts::TAU * i as f32 / rim as f32).sin_cos();
            Vec3::new(radius * cos, height, radius * sin)
        }));
        let triangles = (0..rim).map(|i| [0, 1 + i, 1 + (i + 1) % rim]).collect();
        let count = positions.len();
        TriangleMesh::new(positions, vec![Vec3::ZERO; count], vec![Vec2::ZERO; count], triangles).unwrap()
    };
    let lit = |facing| Tracer::new(&scene(vec![(disc(facing), diffuse(0.0), Some(Vec3::splat(radiance)))], Vec3::ZERO)).unwrap();
    let samples = 1 << 12;
    let measured = lit(1.0).irradiance(Vec3::ZERO, Vec3::Y, samples, &settings(1, 0)).x;
    let expected = PI * radiance * radius * radius / (radius * radius + height * height);
    // Light sampling varies by cos²/d² over the disc, ± 15 %, and takes nearly all the weight; half the samples' spread bounds it:
    // 4.5 · 0.5 / √4096 = 3.5 %. Measured 0.01 %.
    assert!((measured / expected - 1.0).abs() < 0.035, "{measured}, {expected} expected");
    // The back of a one-sided light is dark.
    assert_eq!(lit(-1.0).irradiance(Vec3::ZERO, Vec3::Y, samples, &settings(1, 0)), Vec3::ZERO);
}

#[test]
fn a_point_light_falls_off_with_the_square_of_distance_and_the_cosine() {
    let mut scene = scene(vec![(floor(5.0, 0.0), diffuse(0.5), None)], Vec3::ZERO);
    scene.point_lights.push(PointLight { position: Vec3::new(1.0, 2.0, 0.0), intensity: Vec3::splat(7.0) });
    let tracer = Tracer::new(&scene).unwrap();
    let measured = tracer.irradiance(Vec3::ZERO, Vec3::Y, 1, &settings(1, 0)).x;
    let expected = 7.0 * (2.0 / 5f32.sqrt()) / 5.0;
    assert!((measured / expected - 1.0).abs() < 1e-4, "{measured}, {expected} expected");
    let image = render(&tracer, &camera(Vec3::new(0.0, 3.0, 0.0), Vec3::ZERO, 0.01, 1), &settings(1, 1));
    let reflected = 0.5 / PI * expected;
    assert!((image.radiance.planes[0][0] / reflected - 1.0).abs() < 1e-4);
    // Under the floor it is night.
    assert_eq!(tracer.irradiance(Vec3::new(0.0, -0.01, 0.0), Vec3::NEG_Y, 16, &settings(1, 0)), Vec3::ZERO);
}
