//! Rays against triangles: the tree finds what a loop over all triangles finds.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::geometry::Ray;
use crate::raytrace::{bvh::Bvh, traverse::Stack};

fn random_vec(random: &mut Pcg32) -> Vec3 {
    Vec3::new(random.random::<f32>(), random.random::<f32>(), random.random::<f32>()) * 2.0 - 1.0
}

/// Möller–Trumbore in f64, one triangle.
fn reference(origin: Vec3, direction: Vec3, [a, b, c]: [Vec3; 3]) -> Option<f64> {
    let (o, d, a, b, c) = (origin.as_dvec3(), direction.as_dvec3(), a.as_dvec3(), b.as_dvec3(), c.as_dvec3());
    let (e1, e2, s) = (b - a, c - a, o - a);
    let p = d.cross(e2);
    let inverse = 1.0 / e1.dot(p);
    let (u, v) = (s.dot(p) * inverse, d.dot(s.cross(e1)) * inverse);
    let t = e2.dot(s.cross(e1)) * inverse;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}

#[test]
fn the_tree_finds_what_a_loop_over_all_triangles_finds() {
    let mut random = Pcg32::seed_from_u64(3);
    for (count, size) in [(1usize, 1.0), (3, 0.5), (5, 2.0), (400, 0.2), (3000, 0.05)] {
        let mut triangles: Vec<[Vec3; 3]> = (0..count)
            .map(|_| {
                let at = random_vec(&mut random);
                [0, 1, 2].map(|_| at + size * random_vec(&mut random))
            })
            .collect();
        // Long and thin ones, which the builder splits.
        triangles.extend((0..count / 10).map(|_| {
            let (at, along) = (random_vec(&mut random), 3.0 * random_vec(&mut random));
            [at, at + along, at + along + 0.02 * random_vec(&mut random)]
        }));
        let bvh = Bvh::build(&triangles);
        let mut stack = Stack::new();
        let mut hits = 0;
        for k in 0..1500 {
            let origin = 2.0 * random_vec(&mut random);
            let mut direction = random_vec(&mut random).normalize();
            if k % 5 == 0 {
                direction = Vec3::AXES[k / 5 % 3] * if k % 2 == 0 { 1.0 } else { -1.0 };
            }
            let expected = triangles.iter().filter_map(|t| reference(origin, direction, *t)).fold(f64::INFINITY, f64::min);
            let found = bvh.nearest(origin, direction, f32::INFINITY, &mut stack).map_or(f64::INFINITY, |h| f64::from(h.distance));
            // Rays are drawn at random: none grazes an edge within f32 rounding, so both agree whether there is a hit.
            assert!(expected == found || (found - expected).abs() < 1e-4 * expected.max(1.0), "{found}, {expected} expected");
            assert_eq!(bvh.any(origin, direction, f32::INFINITY, &mut stack), expected.is_finite());
            let all: Vec<u32> =
                (0..triangles.len() as u32).filter(|t| reference(origin, direction, triangles[*t as usize]).is_some()).collect();
            assert_eq!(bvh.every(origin, direction, &mut stack), all);
            if expected.is_finite() {
                hits += 1;
                assert!(!bvh.any(origin, direction, 0.999 * expected as f32, &mut stack));
                assert!(bvh.nearest(origin, direction, 0.999 * expected as f32, &mut stack).is_none());
            }
        }
        assert!(hits > 10, "{hits} rays hit: too few to tell");
    }
}

#[test]
fn a_hit_tells_where_and_what() {
    let parts = vec![(floor(1.0, 0.0), diffuse(0.5), None), (floor(1.0, 2.0), diffuse(0.5), None)];
    let tracer = Tracer::new(&scene(parts, Vec3::ZERO)).unwrap();
    let ray = Ray { origin: Vec3::new(0.5, 5.0, -0.25), direction: Vec3::NEG_Y };
    let hit = tracer.intersect(&ray, f32::INFINITY).unwrap();
    assert_eq!((hit.object, hit.distance, hit.position), (1, 3.0, Vec3::new(0.5, 2.0, -0.25)));
    assert_eq!((hit.geometric_normal, hit.shading_normal), (Vec3::Y, Vec3::Y));
    assert!((hit.uv - Vec2::new(0.75, 0.625)).length() < 1e-6);
    // From below, the normals stay as stored.
    let up = Ray { origin: Vec3::new(0.5, -5.0, 0.25), direction: Vec3::Y };
    let below = tracer.intersect(&up, f32::INFINITY).unwrap();
    assert_eq!((below.object, below.geometric_normal), (0, Vec3::Y));
    assert!(tracer.intersect(&up, 5.0).is_none() && tracer.intersect(&up, 5.001).is_some());
    assert!(tracer.occluded(ray.origin, up.origin) && !tracer.occluded(ray.origin, Vec3::new(0.5, 2.1, 0.0)));
}

#[test]
fn a_point_is_inside_closed_surfaces_only() {
    let body = sphere(Vec3::ZERO, 1.0, 16);
    // The pot: the same with its lowest ring of triangles missing.
    let mut pot = sphere(Vec3::new(5.0, 0.0, 0.0), 1.0, 16);
    pot.triangles.retain(|t| t.iter().all(|i| pot.positions[*i as usize].y > -0.9));
    // A handle that pierces the first body.
    let handle = sphere(Vec3::new(1.0, 0.0, 0.0), 0.3, 8);
    let parts = [body, pot, handle, floor(20.0, -3.0)].map(|mesh| (mesh, diffuse(0.5), None)).to_vec();
    let tracer = Tracer::new(&scene(parts, Vec3::ZERO)).unwrap();
    for inside in [Vec3::ZERO, Vec3::new(0.9, 0.1, 0.0), Vec3::new(0.68, 0.0, 0.0), Vec3::new(5.0, 0.2, 0.3)] {
        assert!(tracer.is_inside_geometry(inside), "{inside}");
    }
    for outside in [
        Vec3::new(0.0, 1.01, 0.0),
        Vec3::new(1.35, 0.0, 0.0),
        Vec3::new(0.0, -2.99, 2.0),
        Vec3::new(0.0, -3.01, 2.0),
        Vec3::new(3.0, 0.0, 0.0),
    ] {
        assert!(!tracer.is_inside_geometry(outside), "{outside}");
    }
}

#[test]
fn texel_grids_read_as_textures_do() {
    let mut image = Image::zeros(5, 3, 3);
    (0..15).for_each(|i| image.set_rgb(i, [i as f32, (i * i % 7) as f32, 1.0]));
    let texture = crate::scenes::Texture { image };
    let grid = crate::raytrace::surfaces::TexelGrid::new(&texture);
    for (u, v) in [(0.0, 0.0), (0.3, 0.7), (-1.2, 5.1), (0.999, 0.001), (1.0, 1.0), (0.05, -0.05)] {
        // Both round u·width in f32: 15 · 2⁻²³ of the range, with room.
        assert!((grid.sample(Vec2::new(u, v)) - texture.sample(u, v)).length() < 1e-4, "({u}, {v})");
    }
}
