//! The looks that ground truths are made of.

use std::f32::consts::PI;
use std::sync::Arc;

use glam::Vec3;

use super::*;
use crate::geometry::{Mapping, NormalMap};
use crate::radiometry::brdf::CookTorrance;
use crate::radiometry::dielectric::{Body, Dielectric};
use crate::raytrace::{Appearance, Mirrors, Under};
use crate::scenes::{Environment, PointLight};

/// Floor and back wall as one object, a point light, no sky: with one bounce every radiance is exact.
fn corner() -> (Tracer, Camera) {
    let floor = floor(2.0, 0.0);
    let wall = quad([Vec3::new(-2.0, 0.0, -1.0), Vec3::new(2.0, 0.0, -1.0), Vec3::new(2.0, 4.0, -1.0), Vec3::new(-2.0, 4.0, -1.0)]);
    let join = |a: &[Vec3], b: &[Vec3]| [a, b].concat();
    let mut triangles = floor.triangles.clone();
    triangles.extend(wall.triangles.iter().map(|t| t.map(|i| i + 4)));
    let uvs = [floor.uvs, wall.uvs].concat();
    let mesh = TriangleMesh::new(join(&floor.positions, &wall.positions), join(&floor.normals, &wall.normals), uvs, triangles).unwrap();
    let mut scene = scene(vec![(mesh, diffuse(0.4), None)], Vec3::ZERO);
    scene.point_lights.push(PointLight { position: LIGHT, intensity: Vec3::splat(5.0) });
    // Looks steeply at the floor's origin, from where the mirrored ray meets the wall at (0, 1, −1).
    (Tracer::new(&scene).unwrap(), camera(Vec3::new(0.0, 1.0, 1.0), Vec3::ZERO, 0.01, 1))
}

const LIGHT: Vec3 = Vec3::new(0.0, 2.0, 1.0);

/// Radiance of a surface of albedo 0.4 with this normal under the light.
fn lit(at: Vec3, normal: Vec3) -> f32 {
    let to_light = LIGHT - at;
    0.4 / PI * 5.0 * to_light.normalize().dot(normal) / to_light.length_squared()
}

#[test]
fn one_mirror_sees_the_object_itself_diffuse() {
    let (tracer, camera) = corner();
    let seen = |appearance| render(&tracer.with_appearance(0, appearance), &camera, &settings(4, 1)).radiance.planes[0][0];
    let close = |measured: f32, expected: f32| assert!((measured / expected - 1.0).abs() < 1e-3, "{measured}, {expected} expected");
    let reflectance = Vec3::splat(0.9);
    close(seen(Appearance::Diffuse), lit(Vec3::ZERO, Vec3::Y));
    close(seen(Appearance::Mirrors(Mirrors::one(reflectance))), 0.9 * lit(Vec3::new(0.0, 1.0, -1.0), Vec3::Z));
    // A physical mirror shows a mirror, and there nothing but the black sky.
    assert_eq!(seen(Appearance::PhysicalMirror { reflectance }), 0.0);
    close(seen(Appearance::AsAuthored), lit(Vec3::ZERO, Vec3::Y));
}

#[test]
fn further_mirrors_see_the_object_as_a_mirror_with_or_without_what_is_under_it() {
    let (tracer, camera) = corner();
    let reflectance = Vec3::splat(0.9);
    let seen = |reflections, under| {
        let mirrors = Mirrors { reflectance, reflections, under };
        render(&tracer.with_appearance(0, Appearance::Mirrors(mirrors)), &camera, &settings(4096, 1)).radiance.planes[0][0]
    };
    let once = 0.9 * lit(Vec3::new(0.0, 1.0, -1.0), Vec3::Z);
    for under in [Under::Nothing, Under::Diffuse] {
        assert!((seen(1, under) / once - 1.0).abs() < 1e-3);
    }
    // From the wall on there is nothing but the black sky. Whether a path sees what is under it is drawn: 1/64 of noise.
    assert_eq!(seen(2, Under::Nothing), 0.0);
    assert!((seen(2, Under::Diffuse) / once - 1.0).abs() < 0.05);
    // A plane does not see itself.
    let mut scene = scene(vec![(floor(2.0, 0.0), diffuse(0.0), None)], Vec3::ZERO);
    scene.environment = Environment::Constant(Vec3::ONE);
    let many = Appearance::Mirrors(Mirrors { reflectance, reflections: 4, under: Under::Diffuse });
    let open = render(&Tracer::new(&scene).unwrap().with_appearance(0, many), &camera, &settings(4, 1)).radiance.planes[0][0];
    assert!((open - 0.9).abs() < 1e-6, "{open}");
}

fn clear_ball(sky: Environment) -> Tracer {
    let mut scene = scene(vec![(sphere(Vec3::ZERO, 1.0, 96), diffuse(0.5), None)], Vec3::ZERO);
    scene.environment = sky;
    let dielectric = Dielectric::new(1.5, Body::Solid).unwrap();
    Tracer::new(&scene).unwrap().with_appearance(0, Appearance::OneRefraction { dielectric })
}

/// Seen along the normal: R = 4 % is reflected, and what passes both surfaces is (1 − R)².
#[test]
fn a_clear_ball_in_a_white_furnace_loses_what_is_reflected_inside() {
    let tracer = clear_ball(Environment::Constant(Vec3::ONE));
    let image = render(&tracer, &camera(Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, 2.0, 4), &settings(256, 1));
    let mean = image.radiance.planes[0].iter().sum::<f32>() / 16.0;
    // 4096 paths of which 4 % are reflected: a thousandth of what is.
    assert!((mean - (0.04 + 0.96 * 0.96)).abs() < 3e-3, "{mean}");
    assert_eq!(tracer.cube_map(Vec3::splat(2.0), 4, &settings(1, 1), &Unattended).unwrap(), {
        let diffuse = tracer.with_appearance(0, Appearance::Diffuse);
        diffuse.cube_map(Vec3::splat(2.0), 4, &settings(1, 1), &Unattended).unwrap()
    });
}

/// The sky is white above and black below; at a sine of 0.4 a ball of glass bends by 2 (asin 0.4 − asin 0.267) = 16.2° …
#[test]
fn a_clear_ball_shows_the_world_upside_down() {
    let tracer = clear_ball(sky_map(64, 0.0, |_, row| if row < 16 { Vec3::ONE } else { Vec3::ZERO }));
    let seen = |y: f32| {
        let from = Vec3::new(0.0, y, 40.0);
        render(&tracer, &camera(from, Vec3::new(0.0, y, 0.0), 0.05, 1), &settings(1024, 1)).radiance.planes[0][0]
    };
    // … so that a ray through the lower half sees the upper sky; through the upper half the mirror alone sees it: 4.2 %.
    assert!((seen(-0.4) - 0.958 * 0.958).abs() < 0.01, "{}", seen(-0.4));
    assert!(seen(0.4) > 0.0 && seen(0.4) < 0.15, "{}", seen(0.4));
}

#[test]
fn a_mirror_turned_diffuse_keeps_its_reflectance_as_albedo() {
    let mirror = Material::Mirror { reflectance: Vec3::splat(0.3) };
    let tracer = Tracer::new(&scene(vec![(floor(1.0, 0.0), mirror, None)], Vec3::ONE)).unwrap();
    let image = render(&tracer.with_appearance(0, Appearance::Diffuse), &camera(Vec3::Y, Vec3::ZERO, 10.0, 4), &settings(4, 1));
    assert!(image.radiance.planes[0].iter().all(|v| (v - 0.3).abs() < 1e-5));
}

#[test]
fn a_mirror_reflects_the_sky_of_the_mirrored_direction() {
    let mut scene = scene(vec![(floor(50.0, 0.0), Material::Mirror { reflectance: Vec3::splat(0.5) }, None)], Vec3::ZERO);
    scene.environment = sky_map(64, 0.4, |column, row| Vec3::new(column as f32, row as f32, 1.0));
    let view = camera(Vec3::new(0.0, 1.0, 0.0), Vec3::new(1.0, 0.0, 0.5), 1.0, 1);
    let image = render(&Tracer::new(&scene).unwrap(), &view, &settings(1, 1));
    let d = view.pixel_ray(0, 0).direction;
    let expected = 0.5 * scene.environment.radiance(Vec3::new(d.x, -d.y, d.z));
    // The sample lies up to half a degree off the pixel's centre: under a tenth of a texel of a map that rises by 1 a texel.
    assert!((Vec3::from(image.radiance.rgb(0)) - expected).abs().max_element() < 0.1);
}

/// Of an even slope s along u the normal is (s t + n) / √(1 + s²), which turns what is mirrored by twice atan s; where that would be below the floor,
/// the floor mirrors as without a map.
#[test]
fn a_floor_of_an_even_slope_mirrors_by_the_turned_normal_unless_that_is_into_the_floor() {
    let mesh = floor(50.0, 0.0);
    let along_u = crate::geometry::tangent_along_u(mesh.corners(0), mesh.triangles[0].map(|i| mesh.uvs[i as usize])).normalize();
    let mut scene = scene(vec![(mesh, diffuse(0.5), None)], Vec3::ZERO);
    scene.environment = sky_map(64, 0.4, |column, row| Vec3::new(column as f32, row as f32, 1.0));
    let view = camera(Vec3::new(0.0, 1.0, 0.0), 2.0 * along_u + Vec3::new(0.3, 0.0, 0.2), 1.0, 1);
    let d = view.pixel_ray(0, 0).direction;
    let tracer = Tracer::new(&scene).unwrap();
    let narrow = CookTorrance::new(Vec2::splat(1e-3), Vec3::ONE, Vec3::ONE).unwrap();
    for (slope, enters) in [(0.1f32, false), (-0.3, false), (0.9, true)] {
        let map = Arc::new(NormalMap::new(1, 1, [Vec2::new(slope, 0.0)]).unwrap());
        let seen = |appearance| {
            let tracer = tracer.with_appearance(0, appearance).with_normal_map(0, map.clone(), Mapping { strength: 1.0, repeat: 1.0 });
            Vec3::from(render(&tracer, &view, &settings(16, 1)).radiance.rgb(0))
        };
        let mirrored = |n: Vec3| d - 2.0 * n.dot(d) * n;
        let turned = mirrored((slope * along_u + Vec3::Y).normalize());
        assert_eq!(turned.y < 0.0, enters);
        let r = if enters { mirrored(Vec3::Y) } else { turned };
        // As without a map, and near the zenith, where columns are narrow.
        for appearance in [Appearance::Mirrors(Mirrors::one(Vec3::ONE)), Appearance::PhysicalMirror { reflectance: Vec3::ONE }] {
            let (mirrored, expected) = (seen(appearance), scene.environment.radiance(r));
            assert!((mirrored - expected).abs().max_element() < 0.3, "{slope}: {mirrored}, {expected} expected");
        }
        let (highlight, expected) = (seen(Appearance::OneGlossy { brdf: narrow.into() }), scene.environment.radiance(r));
        let expected = if enters { Vec3::ZERO } else { expected };
        assert!((highlight - expected).abs().max_element() < 0.5, "{slope}: {highlight} of a highlight, {expected} expected");
        // What is diffuse stays so.
        assert_eq!(seen(Appearance::Diffuse), Vec3::from(render(&tracer, &view, &settings(16, 1)).radiance.rgb(0)));
    }
}

#[test]
fn cube_maps_and_irradiance_never_see_the_one_mirror() {
    let (tracer, _) = corner();
    let diffuse = tracer.with_appearance(0, Appearance::Diffuse);
    let mirror = tracer.with_appearance(0, Appearance::Mirrors(Mirrors::one(Vec3::ONE)));
    let at = Vec3::new(0.2, 0.5, 0.1);
    let cube = |t: &Tracer| t.cube_map(at, 8, &settings(4, 2), &Unattended).unwrap();
    assert_eq!(cube(&diffuse), cube(&mirror));
    assert_eq!(diffuse.irradiance(at, Vec3::Y, 16, &settings(1, 2)), mirror.irradiance(at, Vec3::Y, 16, &settings(1, 2)));
}

#[test]
fn a_removed_object_neither_hides_nor_shines() {
    let parts = vec![(floor(1.0, 1.0), diffuse(0.5), Some(Vec3::ONE)), (floor(1.0, 0.0), diffuse(0.5), None)];
    let tracer = Tracer::new(&scene(parts, Vec3::splat(0.25))).unwrap();
    let without = tracer.without_object(0);
    assert!(tracer.occluded(Vec3::new(0.1, 0.5, 0.1), Vec3::new(0.1, 2.0, 0.1)));
    assert!(!without.occluded(Vec3::new(0.1, 0.5, 0.1), Vec3::new(0.1, 2.0, 0.1)));
    let up = crate::geometry::Ray { origin: Vec3::new(0.1, -1.0, 0.2), direction: Vec3::Y };
    assert_eq!(without.intersect(&up, f32::INFINITY).map(|h| h.object), Some(1));
    let lit = without.irradiance(Vec3::new(0.0, 0.1, 0.0), Vec3::Y, 16, &settings(1, 3)).x;
    assert!((lit - 0.25 * PI).abs() < 1e-4);
    // Nothing left: empty space.
    assert_eq!(without.without_object(1).intersect(&up, f32::INFINITY), None);
}
