//! BRDFs as materials, and as what a camera ray sees once over the diffuse scene.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::*;
use crate::radiometry::brdf::{
    AshikhminShirley, Brdf, BrdfModel, CookTorrance, Lafortune, LafortuneLobe, MEASURED_SHAPE, Measured, Phong, Ward, directional_albedo,
};
use crate::raytrace::{Appearance, Mirrors};

// z-tests at 4.5 standard deviations: one false alarm in 150 000 seeds, and the seeds are fixed.
const Z: f64 = 4.5;

/// One of each model, rough and smooth, isotropic and not.
fn models() -> Vec<(&'static str, BrdfModel)> {
    let grey = Vec3::splat(0.5);
    let lobe = LafortuneLobe { reflectance: grey, direction: Vec3::new(-1.0, -0.8, 0.7), exponent: 12.0 };
    let table = Measured::new(vec![Vec3::splat(0.3 / PI); MEASURED_SHAPE.iter().product()]).unwrap();
    vec![
        ("phong", Phong::new(Vec3::splat(0.25), grey, 50.0).unwrap().into()),
        ("ashikhmin-shirley", AshikhminShirley::new(grey, Vec3::splat(0.25), Vec2::new(1000.0, 10.0)).unwrap().into()),
        ("cook-torrance", CookTorrance::new(Vec2::new(0.05, 0.5), grey, Vec3::ONE).unwrap().into()),
        ("ward", Ward::new(Vec3::splat(0.25), grey, Vec2::new(0.4, 0.1)).unwrap().into()),
        ("lafortune", Lafortune::new(Vec3::splat(0.25), &[lobe]).unwrap().into()),
        ("measured", table.into()),
    ]
}

/// A floor of one material, seen along a ray so narrow that every pixel shows the same.
fn floor_under(environment: Environment, material: Material) -> Scene {
    let mut scene = scene(vec![(floor(1.0, 0.0), material, None)], Vec3::ZERO);
    scene.environment = environment;
    scene
}

pub(super) fn narrow_view(wo: Vec3) -> Camera {
    camera(2.0 * wo, Vec3::ZERO, 1e-3, 16)
}

/// The floor's tangent frame: `quad` lets u grow along +X, and the normal is +Y.
fn local(world: Vec3) -> Vec3 {
    Vec3::new(world.x, -world.z, world.y)
}

#[test]
fn every_model_keeps_its_albedo_under_a_white_sky() {
    for (name, brdf) in models() {
        for wo in [Vec3::Y, Vec3::new(0.6, 0.8, 0.0), Vec3::new(0.3, 0.3, 0.9).normalize()] {
            let expected = f64::from(directional_albedo(&brdf, local(wo), 65536).x);
            // A constant sky is found by reflections alone, a map by both strategies.
            for sky in [Environment::Constant(Vec3::ONE), sky_map(16, 0.3, |_, _| Vec3::ONE)] {
                let tracer = Tracer::new(&floor_under(sky, Material::Brdf(brdf.clone()))).unwrap();
                let (mean, deviation) = mean_and_deviation(&render(&tracer, &narrow_view(wo), &settings(64, 3)));
                // The lattice behind `expected` is off by 10⁻³.
                assert!((mean - expected).abs() < Z * deviation + 1e-3, "{name} toward {wo}: {mean} ± {deviation}, {expected} expected");
                assert!(deviation < 0.01, "{name}: too noisy to tell, {deviation}");
            }
        }
    }
}

/// A sky that differs everywhere, with a bright corner.
pub(super) fn uneven_sky() -> Environment {
    sky_map(16, 0.4, |column, row| Vec3::splat(0.1 + 0.05 * column as f32 + if (column, row) == (3, 2) { 20.0 } else { 0.0 }))
}

/// ∫ f L cos over the upper half space: midpoint rule in longitude and height.
pub(super) fn integrated(brdf: &BrdfModel, wo: Vec3, radiance: impl Fn(Vec3) -> f32) -> f64 {
    const ROWS: usize = 800;
    const COLUMNS: usize = 1600;
    let mut sum = 0.0;
    for row in 0..ROWS {
        let y = (row as f32 + 0.5) / ROWS as f32;
        for column in 0..COLUMNS {
            let across = Vec2::from_angle(TAU * (column as f32 + 0.5) / COLUMNS as f32) * (1.0 - y * y).sqrt();
            let wi = Vec3::new(across.x, y, across.y);
            sum += f64::from(brdf.eval(local(wo), local(wi)).x * y * radiance(wi));
        }
    }
    sum * f64::from(TAU) / (ROWS * COLUMNS) as f64
}

#[test]
fn a_glossy_floor_reflects_an_uneven_sky_as_the_integral_says() {
    let sky = uneven_sky();
    for (name, brdf) in models() {
        // Off both tangents: a frame that is turned or mirrored shows.
        let wo = Vec3::new(0.5, 0.6, 0.3).normalize();
        let expected = integrated(&brdf, wo, |wi| sky.radiance(wi).x);
        let tracer = Tracer::new(&floor_under(sky.clone(), Material::Brdf(brdf))).unwrap();
        let (mean, deviation) = mean_and_deviation(&render(&tracer, &narrow_view(wo), &settings(256, 1)));
        // The midpoint rule over the narrowest of them, 0.05 wide over 0.004-wide cells: 10⁻³.
        assert!((mean - expected).abs() < Z * deviation + 2e-3 * expected, "{name}: {mean} ± {deviation}, {expected} expected");
        assert!(deviation < 0.01 * expected, "{name}: too noisy to tell, {deviation} of {expected}");
    }
}

#[test]
fn a_sun_in_the_sky_leaves_no_fireflies() {
    // One texel of 64 × 32, 10⁵ times as bright as the rest.
    let sky = sky_map(64, 0.0, |column, row| Vec3::splat(if (column, row) == (40, 8) { 1e5 } else { 1.0 }));
    for (name, brdf) in models() {
        for wo in [Vec3::new(0.3, 0.7, 0.2).normalize(), Vec3::new(0.9, 0.1, -0.4).normalize()] {
            let diffuse = Tracer::new(&floor_under(sky.clone(), diffuse(0.5))).unwrap();
            let once = diffuse.with_appearance(0, Appearance::OneGlossy { brdf: brdf.clone() });
            let physical = diffuse.with_appearance(0, Appearance::PhysicalGlossy { brdf: brdf.clone() });
            let image = render(&once, &narrow_view(wo), &settings(64, 1));
            let plane = &image.radiance.planes[0];
            let mean = plane.iter().sum::<f32>() / plane.len() as f32;
            let largest = plane.iter().copied().fold(0.0, f32::max);
            assert!(plane.iter().all(|v| v.is_finite() && *v > 0.0), "{name}");
            assert!(largest < 2.0 * mean, "{name} toward {wo}: a pixel of {largest} among {mean}");
            // Alone under the sky, once is all there is.
            let (expected, deviation) = mean_and_deviation(&render(&physical, &narrow_view(wo), &settings(64, 1)));
            let allowed = Z * (deviation + mean_and_deviation(&image).1);
            assert!((f64::from(mean) - expected).abs() < allowed, "{name}: {mean}, {expected} expected");
        }
    }
}

/// Floor and back wall as one object, under the uneven sky.
fn corner() -> Scene {
    let floor = floor(2.0, 0.0);
    let wall = quad([Vec3::new(-2.0, 0.0, -1.0), Vec3::new(2.0, 0.0, -1.0), Vec3::new(2.0, 4.0, -1.0), Vec3::new(-2.0, 4.0, -1.0)]);
    let triangles = floor.triangles.iter().copied().chain(wall.triangles.iter().map(|t| t.map(|i| i + 4))).collect();
    let [positions, normals] = [[floor.positions, wall.positions].concat(), [floor.normals, wall.normals].concat()];
    let mesh = TriangleMesh::new(positions, normals, [floor.uvs, wall.uvs].concat(), triangles).unwrap();
    let mut scene = scene(vec![(mesh, diffuse(0.7), None)], Vec3::ZERO);
    scene.environment = uneven_sky();
    scene
}

#[test]
fn one_glossy_reflection_integrates_the_diffuse_scene_with_the_object_in_it() {
    let tracer = Tracer::new(&corner()).unwrap();
    let wo = Vec3::new(0.3, 0.6, 0.5).normalize();
    // What arrives at the floor's origin, from every direction: 1.5° of a cube map's texel, all light of two reflections.
    const SIZE: usize = 96;
    let cube = tracer.cube_map(Vec3::new(0.0, 1e-4, 0.0), SIZE, &settings(64, 2), &Unattended).unwrap();
    for (name, brdf) in models() {
        let mut expected = 0.0;
        for (at, texel) in cube.texels.iter().enumerate() {
            let (face, row, column) = (at / SIZE / SIZE, at / SIZE % SIZE, at % SIZE);
            // The narrowest BRDF turns within a texel: 6 × 6 values of it each.
            const FINE: usize = 6;
            for k in 0..FINE * FINE {
                let within = |i: usize| (i as f32 + 0.5) / FINE as f32;
                let (x, y) = (column as f32 + within(k % FINE), row as f32 + within(k / FINE));
                let wi = crate::directions::texel_direction(face, SIZE, x, y);
                if wi.y > 0.0 {
                    // A texel at (s, t) ∈ [−1, 1]² holds ds dt / (1 + s² + t²)^(3/2) steradian.
                    let largest = wi.abs().max_element();
                    let steradian = 4.0 / ((SIZE * FINE) as f32).powi(2) * largest.powi(3);
                    expected += f64::from(brdf.eval(local(wo), local(wi)).x * wi.y * texel[0] * steradian);
                }
            }
        }
        let once = tracer.with_appearance(0, Appearance::OneGlossy { brdf });
        let image = render(&once, &narrow_view(wo), &settings(512, 2));
        let (mean, deviation) = mean_and_deviation(&image);
        // The cube map's own noise and texels: 0.5 %.
        assert!((mean - expected).abs() < Z * deviation + 5e-3 * expected, "{name}: {mean} ± {deviation}, {expected} expected");
        assert!(deviation < 0.01 * expected, "{name}: too noisy to tell, {deviation} of {expected}");
    }
}

#[test]
fn the_smoothest_brdf_is_the_mirror() {
    let tracer = Tracer::new(&corner()).unwrap();
    let reflectance = Vec3::splat(0.9);
    let smooth = CookTorrance::new(Vec2::ZERO, reflectance, reflectance).unwrap();
    for wo in [Vec3::new(0.3, 0.6, 0.5), Vec3::new(-0.7, 0.2, 0.3)] {
        let seen = |appearance| {
            mean_and_deviation(&render(&tracer.with_appearance(0, appearance), &narrow_view(wo.normalize()), &settings(64, 2)))
        };
        let (mirror, deviation) = seen(Appearance::Mirrors(Mirrors::one(reflectance)));
        let (glossy, other_deviation) = seen(Appearance::OneGlossy { brdf: smooth.into() });
        // A lobe of 10⁻⁴ moves what is seen by as much of a sky that doubles within a radian.
        let allowed = Z * deviation.hypot(other_deviation) + 1e-3 * mirror;
        assert!((mirror - glossy).abs() < allowed, "{glossy} ± {other_deviation}, {mirror} ± {deviation} expected");
    }
}

#[test]
fn cube_maps_and_irradiance_never_see_the_one_glossy_reflection() {
    let diffuse = Tracer::new(&corner()).unwrap();
    let glossy = diffuse.with_appearance(0, Appearance::OneGlossy { brdf: models()[0].1.clone() });
    let at = Vec3::new(0.2, 0.5, 0.1);
    let cube = |t: &Tracer| t.cube_map(at, 8, &settings(4, 2), &Unattended).unwrap();
    assert_eq!(cube(&diffuse), cube(&glossy));
    assert_eq!(diffuse.irradiance(at, Vec3::Y, 16, &settings(1, 2)), glossy.irradiance(at, Vec3::Y, 16, &settings(1, 2)));
    assert_eq!(render(&glossy, &narrow_view(Vec3::Y), &settings(3, 2)), {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        pool.install(|| render(&glossy, &narrow_view(Vec3::Y), &settings(3, 2)))
    });
}

#[test]
fn a_glossy_object_made_diffuse_keeps_what_it_reflects_of_light_along_the_normal() {
    for (name, brdf) in models() {
        let expected = directional_albedo(&brdf, Vec3::Z, 16384).x;
        let tracer = Tracer::new(&floor_under(Environment::Constant(Vec3::ONE), Material::Brdf(brdf))).unwrap();
        let image = render(&tracer.with_appearance(0, Appearance::Diffuse), &narrow_view(Vec3::Y), &settings(4, 1));
        assert!(image.radiance.planes[0].iter().all(|v| (v / expected - 1.0).abs() < 5e-3), "{name}: {expected}");
    }
}
