//! Tests of the tracer as a whole; those of one sampler or table stand beside it.

mod appearances;
mod box_room;
mod closed_forms;
mod geometry;
mod glossy;
mod light_alone;
mod packets;
mod robustness;
mod samplers;
mod textured;

use glam::{Vec2, Vec3};

use super::{TraceSettings, TracedImage, Tracer};
use crate::geometry::{Camera, Intrinsics, Pose, TriangleMesh};
use crate::images::Image;
use crate::progress::Unattended;
use crate::scenes::{Albedo, Environment, EnvironmentMap, Material, Object, Scene, Surface};

/// A scene of objects, each with its own material, under a constant sky.
fn scene(parts: Vec<(TriangleMesh, Material, Option<Vec3>)>, sky: Vec3) -> Scene {
    let materials = parts.iter().map(|(_, material, _)| material.clone()).collect();
    let object = |(index, (mesh, _, emission)): (usize, (TriangleMesh, Material, Option<Vec3>))| Object {
        name: format!("object{index}"),
        mesh,
        surface: Surface::Mesh,
        material: index,
        emission,
    };
    Scene {
        name: "test".into(),
        objects: parts.into_iter().enumerate().map(object).collect(),
        materials,
        textures: Vec::new(),
        point_lights: Vec::new(),
        environment: Environment::Constant(sky),
        cameras: Vec::new(),
        notes: Vec::new(),
    }
}

fn diffuse(albedo: f32) -> Material {
    Material::Diffuse { albedo: Albedo::Constant(Vec3::splat(albedo)) }
}

/// A sky map of `width` × `width / 2` texels from a function of column and row.
fn sky_map(width: usize, rotation: f32, radiance: impl Fn(usize, usize) -> Vec3) -> Environment {
    let mut image = Image::zeros(width, width / 2, 3);
    for i in 0..width * width / 2 {
        image.set_rgb(i, radiance(i % width, i / width).to_array());
    }
    Environment::Map(EnvironmentMap { image, rotation })
}

/// Two triangles with one normal; corners counter-clockwise.
fn quad(corners: [Vec3; 4]) -> TriangleMesh {
    let normal = (corners[1] - corners[0]).cross(corners[3] - corners[0]).normalize();
    let uvs = vec![Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    TriangleMesh::new(corners.to_vec(), vec![normal; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).unwrap()
}

/// A horizontal square of half edge `half` at height `y`, facing up.
fn floor(half: f32, y: f32) -> TriangleMesh {
    quad([Vec3::new(-half, y, half), Vec3::new(half, y, half), Vec3::new(half, y, -half), Vec3::new(-half, y, -half)])
}

/// The cube [−1, 1]³ with normals inward.
fn room() -> TriangleMesh {
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let normal = -side * Vec3::AXES[axis];
            let (s, t) = (Vec3::AXES[(axis + 1) % 3] * -side, Vec3::AXES[(axis + 2) % 3]);
            let base = positions.len() as u32;
            positions.extend([-s - t, s - t, s + t, t - s].map(|corner| corner - normal));
            normals.extend([normal; 4]);
            triangles.extend([[base, base + 1, base + 2], [base, base + 2, base + 3]]);
        }
    }
    let uvs = vec![Vec2::ZERO; positions.len()];
    TriangleMesh::new(positions, normals, uvs, triangles).unwrap()
}

/// A sphere of `2·rings²`-odd triangles with smooth outward normals.
fn sphere(center: Vec3, radius: f32, rings: usize) -> TriangleMesh {
    let columns = 2 * rings;
    let at = |i: usize, j: usize| {
        let (theta, phi) = (std::f32::consts::PI * j as f32 / rings as f32, std::f32::consts::TAU * (i % columns) as f32 / columns as f32);
        Vec3::new(theta.sin() * phi.sin(), theta.cos(), theta.sin() * phi.cos())
    };
    let normals: Vec<Vec3> = (0..=rings).flat_map(|j| (0..columns).map(move |i| (i, j))).map(|(i, j)| at(i, j)).collect();
    let index = |i: usize, j: usize| (j * columns + i % columns) as u32;
    let triangles = (0..rings)
        .flat_map(|j| (0..columns).map(move |i| (i, j)))
        .flat_map(|(i, j)| [[index(i, j), index(i, j + 1), index(i + 1, j + 1)], [index(i, j), index(i + 1, j + 1), index(i + 1, j)]])
        .collect();
    let positions = normals.iter().map(|n| center + radius * *n).collect();
    TriangleMesh::new(positions, normals.clone(), vec![Vec2::ZERO; normals.len()], triangles).unwrap()
}

fn camera(origin: Vec3, target: Vec3, vfov_deg: f32, size: u32) -> Camera {
    let up = if (target - origin).normalize().y.abs() > 0.9 { Vec3::Z } else { Vec3::Y };
    Camera::new(Intrinsics::from_vfov(vfov_deg, size, size).unwrap(), Pose::look_at(origin, target, up).unwrap()).unwrap()
}

fn settings(samples_per_pixel: u32, max_bounces: u32) -> TraceSettings {
    TraceSettings { samples_per_pixel, max_bounces, seed: 1 }
}

fn render(tracer: &Tracer, camera: &Camera, settings: &TraceSettings) -> TracedImage {
    tracer.render(camera, settings, &Unattended).unwrap()
}

/// Mean of the first channel and the standard deviation of that mean.
fn mean_and_deviation(image: &TracedImage) -> (f64, f64) {
    let count = image.object.len() as f64;
    let sum = |plane: &[f32]| plane.iter().map(|v| f64::from(*v)).sum::<f64>();
    (sum(&image.radiance.planes[0]) / count, sum(&image.variance.planes[0]).sqrt() / count)
}
