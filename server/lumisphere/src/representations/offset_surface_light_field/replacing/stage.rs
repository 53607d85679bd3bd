//! The new object among what was around the old one, as proxies with baked light, in a tree of triangles; and the light that falls on it.
//!
//! The new object is one more diffuse proxy: its irradiance is baked at the vertices of a finer mesh, on both sides,
//! `E = E_direct + E_near`: E_direct of the sky and of area lights by `Tracer::irradiance`, which samples a sun as a sun; E_near of what surroundings
//! and the object itself reflect, by rays spread with the cosine (Malley). The object's own light is gathered once for each further reflection.

use std::f32::consts::PI;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::Vec3;
use rayon::prelude::*;

use super::changed_light::ChangedLight;
use super::surroundings::{LightReader, Surroundings};
use crate::capture::{Background, BackgroundSurface};
use crate::geometry::{Ray, TriangleMesh, subdivide};
use crate::progress::{Cancelled, Progress};
use crate::radiometry::brdf::cosine_hemisphere;
use crate::raytrace::{Bvh, SampleSequence, Stack, TraceSettings, Tracer};
use crate::representations::RenderError;
use crate::representations::g_buffer::{ProxyGeometry, ProxySeen};
use crate::scenes::{Albedo, Texture};

use super::ReplaceError;

/// Edges of the mesh that light is baked on, in radii of the object's bounding sphere, and its triangles.
const MOST_EDGE: f32 = 0.03;
const MOST_TRIANGLES: usize = 200_000;
/// Paths to emitters, and rays to everything else, of a side of a vertex.
const DIRECT_SAMPLES: u32 = 64;
const NEAR_RAYS: u32 = 128;
/// Reflections between the object's own sides, at most: of more there is little left.
const MOST_REFLECTIONS: u32 = 3;
/// Vertices between two reports.
const BATCH: usize = 1024;

/// Proxies in a tree.
pub(super) struct Stage {
    geometry: ProxyGeometry,
    bvh: Bvh,
    /// Number of the object's proxy; it is the last.
    object: Option<u32>,
    /// Vertices whose light is not that of the old object's time; none where there are fewer.
    is_changed: Vec<bool>,
}

/// What a ray meets.
#[derive(Debug, Clone, Copy)]
pub(super) struct Met {
    pub distance: f32,
    pub position: Vec3,
    /// Number of the proxy.
    pub proxy: u32,
    /// The object.
    pub is_object: bool,
    /// False where a proxy is not diffuse.
    pub is_known: bool,
    /// Cube maps show another light than falls there now.
    pub is_changed: bool,
    /// Toward the ray's origin.
    pub emission: Vec3,
    /// All of it.
    pub radiance: Vec3,
}

/// The object's finer mesh, without light.
pub(super) fn unlit(mesh: &TriangleMesh, albedo: Albedo, radius: f32) -> BackgroundSurface {
    let mesh = subdivide(mesh, &|_| MOST_EDGE * radius, MOST_TRIANGLES);
    let irradiance = vec![[Vec3::ZERO; 2]; mesh.positions.len()];
    BackgroundSurface { mesh, irradiance, albedo: Some(albedo), emission: Vec3::ZERO }
}

/// Irradiance on both sides of a vertex, given by its number.
type OfVertex<'a> = &'a (dyn Fn(&Stage, usize, &mut LightReader<'_>) -> Result<[Vec3; 2], RenderError> + Sync);

impl Stage {
    /// Without any object: it is one triangle of nothing's.
    pub fn empty(background: &Background, mesh: &TriangleMesh) -> Self {
        // No part of it is drawn.
        let geometry = ProxyGeometry::new(mesh, &[], background);
        let corners = |t: &[u32; 3]| t.map(|v| Vec3::from(geometry.background_vertices[v as usize].position));
        let triangles: Vec<[Vec3; 3]> = geometry.background_triangles.iter().map(corners).collect();
        Self { bvh: Bvh::build(&triangles), geometry, object: None, is_changed: Vec::new() }
    }

    /// With an object, which is dark; `texture` is the one that its albedo names. No other: all share one pyramid, and many make it coarse.
    pub fn with_object(light: ChangedLight, object: BackgroundSurface, texture: Option<&Texture>) -> Self {
        let ChangedLight { background, is_changed } = light;
        let albedo = texture.map_or(object.albedo, |_| Some(Albedo::Texture(background.textures.len())));
        let mesh = object.mesh.clone();
        let number = background.surfaces.len() as u32;
        let mut all = background;
        all.surfaces.push(BackgroundSurface { albedo, ..object });
        all.textures.extend(texture.cloned());
        Self { object: Some(number), is_changed, ..Self::empty(&all, &mesh) }
    }

    /// Shorter lengths are none.
    pub fn near(&self) -> f32 {
        self.geometry.near
    }

    /// The nearest surface along a ray, seen over `angle` radians.
    pub fn look(&self, ray: Ray, angle: f32, stack: &mut Stack) -> Option<Met> {
        let hit = self.bvh.nearest(ray.origin, ray.direction, f32::INFINITY, stack)?;
        let weights = Vec3::new(1.0 - hit.u - hit.v, hit.u, hit.v);
        let ProxySeen { material, emission, radiance, .. } = self.geometry.proxy(ray, hit.distance, hit.triangle as usize, weights, angle);
        let corners = self.geometry.background_triangles[hit.triangle as usize];
        Some(Met {
            distance: hit.distance,
            position: ray.at(hit.distance),
            proxy: material,
            is_object: self.object == Some(material),
            is_known: self.geometry.materials[material as usize].unknown == 0,
            is_changed: corners.iter().any(|v| self.is_changed.get(*v as usize) == Some(&true)),
            emission,
            radiance,
        })
    }

    /// Bakes the light that falls on the object. `tracer` has the same geometry and reflects nothing.
    pub fn light_object(
        &mut self,
        mesh: &TriangleMesh,
        tracer: &Tracer,
        surroundings: &Surroundings<'_>,
        (max_bounces, seed): (u32, u64),
        progress: &dyn Progress,
    ) -> Result<(), ReplaceError> {
        let sees_itself = AtomicBool::new(false);
        let direct = TraceSettings { samples_per_pixel: DIRECT_SAMPLES, max_bounces: 0, seed };
        let lit = |stage: &Self, number: usize, light: &mut LightReader<'_>| {
            let numbers = seed ^ (number as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let (position, normal) = (mesh.positions[number], mesh.normals[number]);
            let mut sides = [Vec3::ZERO; 2];
            for (side, n) in sides.iter_mut().zip([normal, -normal]) {
                let settings = TraceSettings { seed: numbers, ..direct };
                let near = stage.near_light(position, n, numbers, surroundings, light)?;
                if near.own_rays > 0 {
                    sees_itself.store(true, Ordering::Relaxed);
                }
                *side = tracer.irradiance(position, n, DIRECT_SAMPLES, &settings) + near.others;
            }
            Ok(sides)
        };
        let fixed = self.bake(mesh, surroundings, &lit, "lighting the object", progress)?;
        self.set_irradiance(&fixed);
        let reflections = max_bounces.saturating_sub(1).min(MOST_REFLECTIONS);
        for _ in 0..if sees_itself.load(Ordering::Relaxed) { reflections } else { 0 } {
            let reflected = |stage: &Self, number: usize, light: &mut LightReader<'_>| {
                let numbers = seed ^ (number as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                let normal = mesh.normals[number];
                let mut sides = fixed[number];
                for (side, n) in sides.iter_mut().zip([normal, -normal]) {
                    *side += stage.near_light(mesh.positions[number], n, numbers, surroundings, light)?.own;
                }
                Ok(sides)
            };
            let all = self.bake(mesh, surroundings, &reflected, "lighting the object by itself", progress)?;
            self.set_irradiance(&all);
        }
        Ok(())
    }

    fn bake(
        &self,
        mesh: &TriangleMesh,
        surroundings: &Surroundings<'_>,
        of_vertex: OfVertex<'_>,
        stage: &str,
        progress: &dyn Progress,
    ) -> Result<Vec<[Vec3; 2]>, ReplaceError> {
        let count = mesh.positions.len();
        let mut irradiance = Vec::with_capacity(count);
        for start in (0..count).step_by(BATCH) {
            progress.report(stage, start as u64, count as u64);
            if progress.is_cancelled() {
                return Err(Cancelled.into());
            }
            let vertices = (start..(start + BATCH).min(count)).into_par_iter();
            let lit: Result<Vec<_>, RenderError> =
                vertices.map_init(|| surroundings.reader(), |light, number| of_vertex(self, number, light)).collect();
            irradiance.extend(lit?);
        }
        progress.report(stage, count as u64, count as u64);
        Ok(irradiance)
    }

    fn set_irradiance(&mut self, irradiance: &[[Vec3; 2]]) {
        let first = self.geometry.background_vertices.len() - irradiance.len();
        for (vertex, [front, back]) in self.geometry.background_vertices[first..].iter_mut().zip(irradiance) {
            (vertex.irradiance_front, vertex.irradiance_back) = (front.to_array(), back.to_array());
        }
    }

    /// Irradiance of what reflects light, on the side of `normal`.
    fn near_light(
        &self,
        position: Vec3,
        normal: Vec3,
        seed: u64,
        surroundings: &Surroundings<'_>,
        light: &mut LightReader<'_>,
    ) -> Result<NearLight, RenderError> {
        let origin = position + self.near() * normal;
        let (s, t) = normal.any_orthonormal_pair();
        let angle = (2.0 * PI / NEAR_RAYS as f32).sqrt();
        let mut near = NearLight { others: Vec3::ZERO, own: Vec3::ZERO, own_rays: 0 };
        for ray in 0..NEAR_RAYS {
            let local = cosine_hemisphere(SampleSequence::new(seed, 0, ray).pair());
            let direction = (local.x * s + local.y * t + local.z * normal).normalize_or(normal);
            let Some(met) = self.look(Ray { origin, direction }, angle, light.stack()) else { continue };
            if met.is_object {
                near.own += met.radiance;
                near.own_rays += 1;
            } else {
                near.others += surroundings.reflected(&met, light)?;
            }
        }
        let per_ray = PI / NEAR_RAYS as f32;
        Ok(NearLight { others: per_ray * near.others, own: per_ray * near.own, ..near })
    }
}

struct NearLight {
    others: Vec3,
    own: Vec3,
    /// Rays that met the object.
    own_rays: u32,
}
