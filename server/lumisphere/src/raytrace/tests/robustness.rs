//! What must hold for every scene: same bytes, scale invariance, no NaN, clear errors, cancellation.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{Vec2, Vec3};

use super::*;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::TraceError;

/// A lit room with a ball: area light, sky through nothing, two materials.
fn still_life(scale: f32) -> (Tracer, Camera) {
    let light = floor(0.4, 0.95);
    let light = TriangleMesh { normals: vec![Vec3::NEG_Y; 4], ..light };
    let ggx = Material::Ggx { alpha: 0.3, reflectance: Vec3::new(0.9, 0.7, 0.5) };
    let parts = vec![
        (room(), diffuse(0.6), None),
        (light, diffuse(0.0), Some(Vec3::splat(6.0))),
        (sphere(Vec3::new(0.1, -0.5, -0.2), 0.4, 16), ggx, None),
    ];
    let scaled = parts.into_iter().map(|(mut mesh, material, emission)| {
        mesh.positions.iter_mut().for_each(|p| *p *= scale);
        (mesh, material, emission)
    });
    let tracer = Tracer::new(&scene(scaled.collect(), Vec3::ONE)).unwrap();
    (tracer, camera(scale * Vec3::new(0.0, 0.2, 0.9), scale * Vec3::new(0.0, -0.3, 0.0), 70.0, 40))
}

#[test]
fn one_thread_and_two_make_the_same_bytes_and_another_seed_others() {
    let (tracer, camera) = still_life(1.0);
    let with_threads = |threads, seed| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let settings = TraceSettings { seed, ..settings(3, 4) };
        pool.install(|| {
            let cube = tracer.cube_map(Vec3::new(0.3, 0.1, 0.2), 9, &settings, &Unattended).unwrap();
            (render(&tracer, &camera, &settings), cube)
        })
    };
    let (one, two) = (with_threads(1, 5), with_threads(2, 5));
    assert_eq!(one, two);
    let other = with_threads(2, 6);
    assert_ne!(one.0.radiance, other.0.radiance);
    assert_ne!(one.1, other.1);
    assert_eq!(one.0.distance, other.0.distance);
}

#[test]
fn wanted_pixels_are_those_of_the_whole_picture_and_the_others_see_nothing() {
    let (tracer, camera) = still_life(1.0);
    let whole = render(&tracer, &camera, &settings(3, 4));
    let width = whole.radiance.width;
    let wanted = |column: usize, row: usize| column > 20 && (row + column).is_multiple_of(3);
    let some = tracer.render_where(&wanted, &camera, &settings(3, 4), &Unattended).unwrap();
    for at in 0..whole.object.len() {
        let pixel = |image: &TracedImage| (image.radiance.rgb(at), image.distance.planes[0][at], image.object[at]);
        let expected = if wanted(at % width, at / width) { pixel(&whole) } else { ([0.0; 3], f32::INFINITY, u32::MAX) };
        assert_eq!(pixel(&some), expected);
    }
}

#[test]
fn a_scene_a_thousand_times_larger_or_smaller_looks_the_same() {
    let (tracer, view) = still_life(1.0);
    let expected = render(&tracer, &view, &settings(4, 6));
    for scale in [1.0 / 1024.0, 1024.0] {
        let (tracer, view) = still_life(scale);
        let mut image = render(&tracer, &view, &settings(4, 6));
        image.distance.planes[0].iter_mut().for_each(|d| *d /= scale);
        // A power of two scales without rounding: nothing absolute may remain anywhere.
        assert_eq!(image.radiance, expected.radiance, "scale {scale}");
        assert_eq!((image.distance, image.object), (expected.distance.clone(), expected.object.clone()));
    }
}

#[test]
fn no_light_leaks_into_a_closed_room() {
    // Sky outside, nothing emits inside. Cracks between triangles and rays that start behind a wall would let it in.
    for scale in [1e-3, 0.7, 1e3] {
        let mut mesh = room();
        mesh.positions.iter_mut().for_each(|p| *p = scale * (*p + Vec3::new(0.3, 0.1, 0.2)));
        let tracer = Tracer::new(&scene(vec![(mesh, diffuse(0.9), None)], Vec3::splat(1000.0))).unwrap();
        let center = scale * Vec3::new(0.3, 0.1, 0.2);
        let cube = tracer.cube_map(center, 32, &settings(16, 4), &Unattended).unwrap();
        let leaks = cube.texels.iter().filter(|t| t[0] > 0.0).count();
        // 98 304 paths of 5 segments. A test of single edges is not watertight: one ray in 10⁵ may slip through an edge.
        assert!(leaks <= 5, "{leaks} texels leak at scale {scale}");
    }
}

#[test]
fn degenerate_triangles_yield_no_nan() {
    let spoiled = |mut mesh: TriangleMesh| {
        let base = mesh.positions.len() as u32;
        mesh.positions.extend([Vec3::ZERO, Vec3::X, 2.0 * Vec3::X, Vec3::new(1e-20, 0.0, 0.0)]);
        mesh.normals.extend([Vec3::ZERO; 4]);
        mesh.uvs.extend([Vec2::ZERO; 4]);
        mesh.triangles.extend([[base, base + 1, base + 2], [base, base, base], [base, base, base + 1], [base, base + 1, base + 3]]);
        mesh
    };
    let light = TriangleMesh { normals: vec![Vec3::NEG_Y; 4], ..floor(0.4, 0.9) };
    let parts = vec![(spoiled(room()), diffuse(0.8), None), (spoiled(light), diffuse(0.5), Some(Vec3::ONE))];
    let tracer = Tracer::new(&scene(parts, Vec3::ONE)).unwrap();
    let image = render(&tracer, &camera(Vec3::new(-0.5, 0.0, 0.5), Vec3::ZERO, 90.0, 32), &settings(16, 5));
    for plane in image.radiance.planes.iter().chain(&image.variance.planes).chain(&image.normal.planes) {
        assert!(plane.iter().all(|v| v.is_finite()));
    }
    assert!(mean_and_deviation(&image).0 > 0.05);
}

#[test]
fn what_cannot_be_traced_is_named() {
    let valid = scene(vec![(room(), diffuse(0.5), None)], Vec3::ZERO);
    let refused = |change: fn(&mut Scene)| {
        let mut scene = valid.clone();
        change(&mut scene);
        Tracer::new(&scene).map(|_| ()).unwrap_err()
    };
    let object = || "object0".to_string();
    assert_eq!(refused(|s| s.objects.clear()), TraceError::Empty);
    assert_eq!(refused(|s| s.objects[0].mesh.triangles.clear()), TraceError::Empty);
    assert_eq!(refused(|s| s.objects[0].material = 4), TraceError::UnknownMaterial { object: object() });
    let texture = |s: &mut Scene| s.materials[0] = Material::Diffuse { albedo: Albedo::Texture(0) };
    assert_eq!(refused(texture), TraceError::UnknownMaterial { object: object() });
    let glossy = |s: &mut Scene| {
        let map = Albedo::Constant(Vec3::splat(0.5));
        s.materials[0] = Material::Glossy { diffuse: map, specular: map, roughness: Albedo::Texture(0) };
    };
    assert_eq!(refused(glossy), TraceError::UnknownMaterial { object: object() });
    assert_eq!(refused(|s| s.objects[0].mesh.positions[3].y = f32::NAN), TraceError::BadMesh { object: object() });
    assert_eq!(refused(|s| s.objects[0].mesh.triangles[1][2] = 999), TraceError::BadMesh { object: object() });
}

/// Cancels once so many pieces are reported.
struct CancelAfter {
    limit: u64,
    reported: AtomicU64,
}

impl Progress for CancelAfter {
    fn report(&self, _what: &str, _done: u64, total: u64) {
        assert!(total > 20);
        self.reported.fetch_add(1, Ordering::Relaxed);
    }
    fn is_cancelled(&self) -> bool {
        self.reported.load(Ordering::Relaxed) >= self.limit
    }
}

#[test]
fn cancellation_returns_between_tiles() {
    let (tracer, _) = still_life(1.0);
    let view = camera(Vec3::new(0.0, 0.2, 0.9), Vec3::ZERO, 70.0, 80);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let progress = CancelAfter { limit: 3, reported: AtomicU64::new(0) };
    let outcome = pool.install(|| tracer.render(&view, &settings(1, 1), &progress));
    assert_eq!(outcome.unwrap_err(), Cancelled);
    // Each of the two threads may have had a tile in hand when the third was reported.
    assert!((3..=4).contains(&progress.reported.load(Ordering::Relaxed)));
    let unlimited = CancelAfter { limit: u64::MAX, reported: AtomicU64::new(0) };
    assert!(tracer.cube_map(Vec3::ZERO, 33, &settings(1, 1), &unlimited).is_ok());
    assert_eq!(unlimited.reported.load(Ordering::Relaxed), 3 * 13);
}
