//! Every sampler draws from the density that it states: chi-squared tests, and value = density where both are asked.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::radiometry::brdf::{AshikhminShirley, CookTorrance};
use crate::raytrace::distribution::Discrete;
use crate::raytrace::lights::Lights;
use crate::raytrace::scattering::{Lobe, Scatterer};
use crate::raytrace::sky::Sky;
use crate::raytrace::sky_cells::NormalBin;
use crate::raytrace::{surfaces, warp};
use crate::scenes::PointLight;
use crate::testdata::chi_squared::{DRAWS, assert_density_on_sphere, assert_distributed, pair};

#[test]
fn the_sky_is_drawn_by_its_light() {
    let mut random = Pcg32::seed_from_u64(5);
    // 16 × 8 texels, a third of them black, a sun among them, turned.
    let texels: Vec<f32> =
        (0..128).map(|i| if i % 3 == 0 { 0.0 } else { random.random::<f32>() + if i == 37 { 20.0 } else { 0.0 } }).collect();
    let environment = sky_map(16, 0.7, |column, row| Vec3::splat(texels[row * 16 + column]));
    let Sky::Map(map) = Sky::new(&environment) else { panic!("a map") };
    for bin in [NormalBin::ANY, NormalBin::of(Vec3::Y), NormalBin::of(Vec3::new(0.48, -0.6, 0.64))] {
        assert_density_on_sphere(&format!("sky, {bin:?}"), |u| map.sample(u, bin).map(|s| (s.direction, s.pdf)), |d| map.eval(d, bin).1);
    }
    for _ in 0..1000 {
        let sample = map.sample(pair(&mut random), NormalBin::ANY).unwrap();
        let expected = environment.radiance(sample.direction);
        // Sampled and looked-up positions differ by rounding: 1e-5 texels of a map that rises by 20 a texel.
        assert!((sample.radiance - expected).length() < 1e-3 && (map.eval(sample.direction, NormalBin::ANY).0 - expected).length() < 1e-3);
        assert!(sample.radiance.x / sample.pdf < 8.0 * map.power, "a bright place with a small density");
    }
}

#[test]
fn a_black_sky_is_never_drawn() {
    let Sky::Map(map) = Sky::new(&sky_map(8, 0.0, |_, _| Vec3::ZERO)) else { panic!("a map") };
    assert!(map.sample(Vec2::splat(0.5), NormalBin::ANY).is_none());
    assert_eq!(map.eval(Vec3::Y, NormalBin::ANY), (Vec3::ZERO, 0.0));
}

#[test]
fn the_hemisphere_is_drawn_by_the_cosine() {
    let density = |d: Vec3| d.z.max(0.0) / std::f32::consts::PI;
    let sample = |u| {
        let d = warp::cosine_hemisphere(u);
        (d.z > 1e-3).then(|| (d, density(d)))
    };
    // The rim below 0.001 is left to the cell of the absorbed: it holds 1e-6 of the draws.
    assert_density_on_sphere("cosine", sample, density);
}

#[test]
fn reflected_directions_are_drawn_by_their_stated_density() {
    for (alpha, tilt) in [(0.1f32, 0.3f32), (0.5, 1.2), (1.0, 0.0), (0.6, 1.5)] {
        let normal = Vec3::new(0.36, 0.48, 0.8);
        let side = Vec3::new(0.8, -0.6, 0.0);
        let wo = tilt.cos() * normal + tilt.sin() * side;
        let brdf = CookTorrance::new(Vec2::new(alpha, 0.5), Vec3::ONE, Vec3::ONE).unwrap().into();
        let textured = AshikhminShirley::from_texels(Vec3::splat(0.5), Vec3::splat(0.3), Vec2::new(0.5, alpha.max(0.3)));
        let glossy = Lobe::Glossy { brdf: &brdf, tangent: Vec3::X };
        for lobe in [glossy, Lobe::Textured { brdf: textured, tangent: Vec3::X }, Lobe::Lambert(Vec3::splat(0.5))] {
            let scatterer = Scatterer { geometric_normal: normal, shading_normal: normal, wo, lobe };
            let sample = |u| scatterer.sample(u).map(|s| (s.wi, s.pdf.unwrap()));
            assert_density_on_sphere(&format!("{lobe:?} at {tilt} rad"), sample, |d| scatterer.eval(d).1);
        }
    }
}

#[test]
fn a_triangle_is_drawn_evenly() {
    let mut random = Pcg32::seed_from_u64(9);
    const EDGE: usize = 8;
    let mut counts = vec![0; EDGE * EDGE];
    for _ in 0..DRAWS {
        let w = warp::triangle(pair(&mut random));
        assert!(w.x >= 0.0 && w.y >= 0.0 && w.x + w.y <= 1.0 + 1e-6);
        // EDGE² small triangles: in each square of the lattice a lower and an upper one; row r has 2(EDGE − r) − 1 of them.
        let (x, y) = (w.x * EDGE as f32, w.y * EDGE as f32);
        let (column, row) = ((x as usize).min(EDGE - 1), (y as usize).min(EDGE - 1));
        let upper = x.fract() + y.fract() > 1.0 && column + row < EDGE - 1;
        let first: usize = (0..row).map(|r| 2 * (EDGE - r) - 1).sum();
        counts[(first + 2 * column + usize::from(upper)).min(EDGE * EDGE - 1)] += 1;
    }
    assert_distributed(&counts, &vec![DRAWS as f64 / (EDGE * EDGE) as f64; EDGE * EDGE], "triangle");
}

#[test]
fn one_of_many_is_drawn_by_weight() {
    let mut random = Pcg32::seed_from_u64(10);
    let weights: Vec<f64> = (0..60).map(|i| if i % 4 == 1 { 0.0 } else { random.random::<f64>().powi(4) }).collect();
    let choice = Discrete::new(&weights).unwrap();
    let mut counts = vec![0; weights.len()];
    (0..DRAWS).for_each(|_| counts[choice.choose(random.random()).index] += 1);
    let total: f64 = weights.iter().sum();
    assert_distributed(&counts, &weights.iter().map(|w| DRAWS as f64 * w / total).collect::<Vec<_>>(), "choice");
}

/// A sky, two area lights of different size and radiance, two point lights.
fn many_lights() -> Scene {
    let down = |half, y, x: f32| {
        let mut mesh = floor(half, y);
        mesh.normals.fill(Vec3::NEG_Y);
        mesh.positions.iter_mut().for_each(|p| p.x += x);
        mesh
    };
    let parts = vec![
        (down(0.5, 2.0, -1.0), diffuse(0.0), Some(Vec3::splat(3.0))),
        (down(0.2, 1.5, 1.0), diffuse(0.0), Some(Vec3::new(9.0, 5.0, 1.0))),
        (floor(3.0, 0.0), diffuse(0.5), None),
    ];
    let mut scene = scene(parts, Vec3::ZERO);
    scene.environment = sky_map(8, 0.0, |column, row| Vec3::splat((column + row) as f32 * 0.02));
    scene.point_lights = [1.0, 3.0].map(|i| PointLight { position: Vec3::new(i, 2.0, -i), intensity: Vec3::splat(i) }).to_vec();
    scene
}

#[test]
fn lights_are_drawn_with_the_density_that_a_ray_hitting_them_is_weighted_with() {
    let scene = many_lights();
    let tracer = Tracer::new(&scene).unwrap();
    let triangles = surfaces::flatten(&scene);
    let lights = Lights::new(&scene, &triangles, 3.0 * 2f32.sqrt());
    let (from, bin) = (Vec3::new(0.2, 0.1, 0.3), NormalBin::of(Vec3::Y));
    let mut random = Pcg32::seed_from_u64(11);
    let (mut sky, mut area, mut points) = (0, 0, 0);
    for _ in 0..4000 {
        let Some(light) = lights.sample(&triangles, from, bin, random.random(), pair(&mut random)) else { continue };
        let ray = crate::geometry::Ray { origin: from, direction: light.direction };
        let (radiance, pdf) = match (light.pdf, light.end) {
            (None, _) => {
                points += 1;
                continue;
            }
            (Some(_), None) => {
                sky += 1;
                lights.sky_radiance(light.direction, bin)
            }
            (Some(_), Some(end)) => {
                area += 1;
                // The ray may pass the other light first: look just before the end.
                let length = (end - from).length();
                let start = from + 0.9 * length * light.direction;
                let hit = tracer.intersect(&crate::geometry::Ray { origin: start, ..ray }, length).unwrap();
                let first = scene.objects[..hit.object].iter().map(|o| o.mesh.triangles.len()).sum::<usize>();
                lights.emitted(&triangles[first + hit.triangle], -light.direction, hit.distance + 0.9 * length)
            }
        };
        let drawn = light.pdf.unwrap();
        assert!((drawn / pdf - 1.0).abs() < 1e-2, "drawn with {drawn}, weighted with {pdf}");
        assert!((light.radiance_over_pdf * drawn - radiance).length() < 1e-2 * radiance.length() + 1e-3);
    }
    assert!(sky > 300 && area > 300 && points > 300, "{sky} sky, {area} area, {points} points");
}

#[test]
fn a_scene_of_many_lights_is_lit_by_the_sum_of_them() {
    // All kinds at once against each alone: the choice among kinds must cancel out.
    let all = many_lights();
    let at = |scene: &Scene| Tracer::new(scene).unwrap().irradiance(Vec3::new(0.2, 0.0, 0.3), Vec3::Y, 1 << 14, &settings(1, 0));
    let mut sky = all.clone();
    sky.point_lights.clear();
    sky.objects.iter_mut().for_each(|o| o.emission = None);
    let mut area = all.clone();
    area.point_lights.clear();
    area.environment = Environment::Constant(Vec3::ZERO);
    let mut points = all.clone();
    points.environment = Environment::Constant(Vec3::ZERO);
    points.objects.iter_mut().for_each(|o| o.emission = None);
    let (whole, sum) = (at(&all), at(&sky) + at(&area) + at(&points));
    // A sample of the whole spreads by no more than its mean / the smallest share 0.1, mostly far less: 2.5 % of it at 2¹⁴ samples.
    assert!((whole / sum - 1.0).abs().max_element() < 0.025, "{whole}, {sum} expected");
}
