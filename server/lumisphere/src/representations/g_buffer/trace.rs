//! The G-buffer by casting rays: the readable twin of `g_buffer.wgsl`.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::{BackgroundVertex, GBufferPixel, ObjectVertex, ProxyGeometry, Seen, SurfaceDifferential, pixel_angle};
use crate::geometry::{Camera, Ray, side_of_v, tangent_along_u};
use crate::raytrace::{Bvh, Stack};

/// Casts rays at the object and its background. Built once per dataset.
#[derive(Debug)]
pub(crate) struct GBufferTracer {
    geometry: Arc<ProxyGeometry>,
    bvh: Bvh,
}

impl GBufferTracer {
    pub fn new(geometry: Arc<ProxyGeometry>) -> Self {
        let object = geometry.object_triangles.iter().map(|t| t.map(|v| Vec3::from(geometry.object_vertices[v as usize].position)));
        let around = geometry.background_triangles.iter().map(|t| t.map(|v| Vec3::from(geometry.background_vertices[v as usize].position)));
        let triangles: Vec<[Vec3; 3]> = object.chain(around).collect();
        Self { bvh: Bvh::build(&triangles), geometry }
    }

    /// What pixel (i, j) sees.
    pub fn pixel(&self, camera: &Camera, i: u32, j: u32, stack: &mut Stack) -> GBufferPixel {
        let ray = camera.pixel_ray(i, j);
        let depth_per_distance = -camera.pose().rotation().z_axis.dot(ray.direction);
        let start = self.geometry.near / depth_per_distance;
        let origin = ray.at(start);
        // A focal length that overflows leaves no direction: such a pixel sees nothing.
        if !(origin.is_finite() && ray.direction.is_finite()) {
            return self.nothing(ray);
        }
        let Some(hit) = self.bvh.nearest(origin, ray.direction, f32::INFINITY, stack) else { return self.nothing(ray) };
        let distance = start + hit.distance;
        let weights = Vec3::new(1.0 - hit.u - hit.v, hit.u, hit.v);
        let object = self.geometry.object_triangles.len();
        match (hit.triangle as usize).checked_sub(object) {
            None => self.object(ray, distance, hit.triangle as usize, weights, camera.ray_derivatives(ray.direction)),
            Some(t) => self.background(ray, distance, t, weights, pixel_angle(camera)),
        }
    }

    fn nothing(&self, ray: Ray) -> GBufferPixel {
        let radiance = self.geometry.environment.radiance(ray.direction);
        GBufferPixel {
            a: [0.0, 0.0, Seen::Nothing.code(), f32::INFINITY],
            b: radiance.extend(0.0).into(),
            differentials: Default::default(),
            tangent: [0.0; 4],
        }
    }

    fn object(&self, ray: Ray, distance: f32, t: usize, weights: Vec3, derivatives: [Vec3; 2]) -> GBufferPixel {
        let corners = self.geometry.object_triangles[t].map(|v| self.geometry.object_vertices[v as usize]);
        let uv: Vec2 = (0..3).map(|k| weights[k] * Vec2::from(corners[k].uv)).sum();
        let normal: Vec3 = (0..3).map(|k| weights[k] * Vec3::from(corners[k].normal)).sum();
        let part = corners[0].part;
        let seen = if faces(corners.map(|c| c.position), ray) { Seen::Object { part } } else { Seen::ObjectBack { part } };
        let differentials = derivatives.map(|by| differential(corners, normal, ray.direction, distance, by));
        let normal = normal.normalize_or(-ray.direction);
        let uvs = corners.map(|c| c.uv.into());
        let tangent = tangent_along_u(corners.map(|c| c.position.into()), uvs);
        GBufferPixel {
            a: [uv.x, uv.y, seen.code(), distance],
            b: normal.extend(0.0).into(),
            differentials,
            tangent: tangent.extend(side_of_v(uvs)).into(),
        }
    }

    fn background(&self, ray: Ray, distance: f32, t: usize, weights: Vec3, pixel_angle: f32) -> GBufferPixel {
        let ProxySeen { uv, material, radiance, .. } = self.geometry.proxy(ray, distance, t, weights, pixel_angle);
        let material = &self.geometry.materials[material as usize];
        let seen = if material.unknown == 1 { Seen::Unknown } else { Seen::Background };
        GBufferPixel {
            a: [uv.x, uv.y, seen.code(), distance],
            b: radiance.extend(0.0).into(),
            differentials: Default::default(),
            tangent: [0.0; 4],
        }
    }
}

/// What a ray sees of a proxy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ProxySeen {
    pub uv: Vec2,
    /// Index into `ProxyGeometry::materials`, which are those of the background's surfaces.
    pub material: u32,
    /// Toward the ray's origin.
    pub emission: Vec3,
    /// All of it.
    pub radiance: Vec3,
}

impl ProxyGeometry {
    /// Of the triangle `t` of the background, at `weights`, over `angle` radians.
    pub fn proxy(&self, ray: Ray, distance: f32, t: usize, weights: Vec3, angle: f32) -> ProxySeen {
        let corners = self.background_triangles[t].map(|v| self.background_vertices[v as usize]);
        let blend = |of: fn(&BackgroundVertex) -> [f32; 3]| (0..3).map(|k| weights[k] * Vec3::from(of(&corners[k]))).sum::<Vec3>();
        let uv: Vec2 = (0..3).map(|k| weights[k] * Vec2::from(corners[k].uv)).sum();
        let front = faces(corners.map(|c| c.position), ray);
        let irradiance = if front { blend(|v| v.irradiance_front) } else { blend(|v| v.irradiance_back) };
        let cosine = blend(|v| v.normal).normalize_or(-ray.direction).dot(ray.direction).abs();
        let material = &self.materials[corners[0].material as usize];
        let mut albedo = Vec3::from(material.albedo);
        if material.level_count > 0 {
            let footprint = material.texels_per_length * distance * angle / cosine.max(LEAST_COSINE).sqrt();
            albedo = self.pyramids.texture_color(material.first_level, material.level_count, uv, footprint);
        }
        let emission = if front { Vec3::from(material.emission) } else { Vec3::ZERO };
        let radiance = emission + albedo * irradiance * std::f32::consts::FRAC_1_PI;
        ProxySeen { uv, material: corners[0].material, emission, radiance }
    }
}

// Grazing views would otherwise ask for ever coarser levels.
const LEAST_COSINE: f32 = 0.05;

// Steeper views are taken for this one: at the horizon a pixel's image on the plane has no end.
const LEAST_SINE: f32 = 0.02;

// Igehy's transfer and interpolated normal: `normal` is the weighted sum of the corners' normals, `by` a derivative of the ray's direction.
fn differential(corners: [ObjectVertex; 3], normal: Vec3, direction: Vec3, distance: f32, by: Vec3) -> SurfaceDifferential {
    let [a, b, c] = corners.map(|c| Vec3::from(c.position));
    let (e1, e2) = (b - a, c - a);
    let area = e1.cross(e2);
    let squared = area.length_squared();
    if !(squared > 0.0 && normal.length_squared() > 0.0) {
        return SurfaceDifferential::default();
    }
    let plane = area / squared.sqrt();
    let sine = plane.dot(direction);
    let sine = sine.abs().max(LEAST_SINE).copysign(sine);
    let position = distance * (by - direction * (plane.dot(by) / sine));
    let (along_b, along_c) = (position.cross(e2).dot(area) / squared, e1.cross(position).dot(area) / squared);
    let [n_a, n_b, n_c] = corners.map(|c| Vec3::from(c.normal));
    let turned = along_b * (n_b - n_a) + along_c * (n_c - n_a);
    let length = normal.length();
    let n = normal / length;
    let normal = (turned - n * n.dot(turned)) / length;
    let [at_a, at_b, at_c] = corners.map(|c| Vec2::from(c.uv));
    let uv = along_b * (at_b - at_a) + along_c * (at_c - at_a);
    SurfaceDifferential { position: position.extend(uv.x).into(), normal: normal.extend(uv.y).into() }
}

// Whether the ray meets the side from which the corners run counter-clockwise.
fn faces(corners: [[f32; 3]; 3], ray: Ray) -> bool {
    let [a, b, c] = corners.map(Vec3::from);
    (b - a).cross(c - a).dot(ray.direction) < 0.0
}
