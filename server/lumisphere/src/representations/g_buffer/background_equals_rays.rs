//! The background as the device finishes it against the ray caster: every kind of surface, and tables of more than a row.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::rasterize::Rasterizer;
use super::{GBufferPixel, GBufferTracer, ProxyGeometry, Seen};
use crate::capture::{Background, BackgroundSurface};
use crate::geometry::{Camera, Intrinsics, Pose, TriangleMesh};
use crate::gpu::{ReadBack, test_gpu};
use crate::images::{Image, Tolerance, count_beyond};
use crate::raytrace::Stack;
use crate::representations::Provenance;
use crate::scenes::{Albedo, Environment, Texture};

const WIDTH: u32 = 96;
const HEIGHT: u32 = 72;
// Quads along a wall's edge: five walls of 41² vertices of four texels are nine rows of their table, 16,000 triangles four.
const QUADS: usize = 40;

// Quads in the plane through `corner`, spanned by `s` and `t`; the normal is s × t. Irradiance differs from vertex to vertex and side to side.
fn wall(corner: Vec3, s: Vec3, t: Vec3, albedo: Option<Albedo>, emission: Vec3) -> BackgroundSurface {
    let row = QUADS as u32 + 1;
    let at: Vec<Vec2> = (0..row * row).map(|i| Vec2::new((i % row) as f32, (i / row) as f32) / QUADS as f32).collect();
    let positions: Vec<Vec3> = at.iter().map(|at| corner + at.x * s + at.y * t).collect();
    let wave = |p: Vec3, phase: f32| Vec3::new(2.0 + (1.3 * p.x + phase).sin(), 2.0 + (0.9 * p.y + phase).sin(), 2.0 + (1.1 * p.z).cos());
    let irradiance = positions.iter().map(|p| [wave(*p, 0.0), wave(*p, 2.0)]).collect();
    let normals = vec![s.cross(t).normalize(); at.len()];
    let corners = (0..QUADS as u32).flat_map(|j| (0..QUADS as u32).map(move |i| j * row + i));
    let triangles = corners.flat_map(|a| [[a, a + 1, a + row + 1], [a, a + row + 1, a + row]]).collect();
    let mesh = TriangleMesh::new(positions, normals, at.iter().map(|at| 3.0 * *at).collect(), triangles).unwrap();
    BackgroundSurface { mesh, irradiance, albedo, emission }
}

// A room with an open side around a small object. Two walls show their backs.
fn room() -> ProxyGeometry {
    let (x, y, z) = (4.0 * Vec3::X, 4.0 * Vec3::Y, 4.0 * Vec3::Z);
    let low = Vec3::splat(-2.0);
    let glow = Vec3::new(0.3, 0.2, 0.1);
    let mut image = Image::zeros(50, 37, 3);
    for i in 0..50 * 37 {
        image.set_rgb(i, [(i % 50) as f32 / 64.0, (i / 50) as f32 / 64.0, 0.5]);
    }
    let surfaces = vec![
        wall(low, z, x, Some(Albedo::Texture(0)), glow),
        wall(low + y, z, x, Some(Albedo::Constant(Vec3::new(0.7, 0.4, 0.2))), glow),
        wall(low, x, y, Some(Albedo::Constant(Vec3::new(0.2, 0.5, 0.8))), glow),
        wall(low, y, z, None, Vec3::ZERO),
        wall(low + x, y, z, None, glow),
    ];
    let background =
        Background { surfaces, textures: vec![Texture { image }], environment: Environment::Constant(Vec3::new(0.1, 0.2, 0.3)) };
    let corners = vec![Vec3::new(0.0, 0.0, 0.2), Vec3::new(0.2, 0.0, 0.0), Vec3::new(0.0, 0.2, 0.0)];
    let object = TriangleMesh::new(corners, vec![Vec3::ONE.normalize(); 3], vec![Vec2::ZERO; 3], vec![[0, 1, 2]]).unwrap();
    ProxyGeometry::new(&object, &[0], &background)
}

// What the device leaves of a whole image: per pixel colour and distance, and whether it is marked as unknown.
fn finished(camera: &Camera, geometry: &ProxyGeometry) -> Option<Vec<([f32; 4], bool)>> {
    let gpu = test_gpu()?;
    let rasterizer = Rasterizer::new(&gpu, geometry).unwrap();
    let band = rasterizer.band(&gpu, WIDTH, HEIGHT);
    let read_back = ReadBack::new(&gpu, "output", band.output().size());
    let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    rasterizer.draw(&gpu, &mut encoder, (camera, 0.0), 0, &band).unwrap();
    encoder.copy_buffer_to_buffer(band.output(), 0, read_back.buffer(), 0, band.output().size());
    gpu.queue().submit([encoder.finish()]);
    let read = |bytes: &[u8]| bytes.chunks_exact(4).map(bytemuck::pod_read_unaligned).collect::<Vec<u32>>();
    let words = read_back.request(0..read_back.bytes()).finish(&gpu, read).unwrap();
    let pixels = band.pixels() as usize;
    let value = |at: usize| f32::from_bits(words[at]);
    let unknown = |i: usize| words[4 * pixels + i] == Provenance::UNKNOWN.bits();
    let pixel = |i: usize| ([value(3 * i), value(3 * i + 1), value(3 * i + 2), value(3 * pixels + i)], unknown(i));
    Some((0..pixels).map(pixel).collect())
}

// Pixels that differ between the twins, of those that see the background according to the ray; and how many show each kind.
fn compare(finished: &[([f32; 4], bool)], traced: &[GBufferPixel]) -> (usize, [usize; 3]) {
    let (mut other, mut kinds) = (0, [0; 3]);
    for ((ours, unknown), theirs) in finished.iter().zip(traced) {
        let kind = match Seen::from_code(theirs.a[2]) {
            Seen::Background => 0,
            Seen::Unknown => 1,
            Seen::Nothing => 2,
            Seen::Object { .. } | Seen::ObjectBack { .. } => continue,
        };
        kinds[kind] += 1;
        let theirs = [theirs.b[0], theirs.b[1], theirs.b[2], theirs.a[3]];
        let differs = count_beyond(&theirs, ours, &Tolerance::F32_LOOKUP).unwrap().beyond > 0 || *unknown != (kind == 1);
        other += usize::from(differs);
    }
    (other, kinds)
}

#[test]
fn finished_background_pixels_are_what_rays_find() {
    let geometry = Arc::new(room());
    let tracer = GBufferTracer::new(geometry.clone());
    let mut stack = Stack::new();
    for (origin, target) in [(Vec3::new(0.3, 0.4, 1.5), Vec3::new(0.0, -0.3, -1.0)), (Vec3::new(-3.0, 3.5, 4.0), Vec3::ZERO)] {
        let pose = Pose::look_at(origin, target, Vec3::Y).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(75.0, WIDTH, HEIGHT).unwrap(), pose).unwrap();
        let Some(finished) = finished(&camera, &geometry) else { return };
        let traced: Vec<_> =
            (0..HEIGHT).flat_map(|j| (0..WIDTH).map(move |i| (i, j))).map(|(i, j)| tracer.pixel(&camera, i, j, &mut stack)).collect();
        let (other, kinds) = compare(&finished, &traced);
        assert!(kinds[0] > 1000 && kinds[1] > 100, "{kinds:?} from {origin}");
        // 1/256 of a pixel along the walls' outlines, some hundred pixels.
        assert!(other <= 10, "{other} pixels differ from {origin}");
    }
}
