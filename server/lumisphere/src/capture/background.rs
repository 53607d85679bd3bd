//! The scene around a captured object, as proxy geometry with baked light.
//!
//! Per vertex two irradiances, one a side: enough for diffuse surroundings, and no more. Meshes are subdivided where light can
//! change, finely near the object and coarsely far from it.

use std::f32::consts::PI;

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::geometry::{TriangleMesh, subdivide};
use crate::images::Image;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{TraceSettings, Tracer};
use crate::scenes::{Albedo, Environment, Material, Scene, Texture};

/// The scene around the object as proxy geometry with baked light, shown behind and before the object. Not part of the light field.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Background {
    /// Proxies.
    pub surfaces: Vec<BackgroundSurface>,
    /// Named by `BackgroundSurface::albedo`.
    pub textures: Vec<Texture>,
    /// Where nothing is hit.
    pub environment: Environment,
}

/// One proxy: exitant radiance = emission (front only) + albedo / π · irradiance of the side that is seen.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct BackgroundSurface {
    /// World space, subdivided for the baked light.
    pub mesh: TriangleMesh,
    /// Per vertex, irradiance on the side of the normal and on the other.
    pub irradiance: Vec<[Vec3; 2]>,
    /// Reflectance; None for surfaces that are not diffuse: black, their pixels flagged unknown.
    pub albedo: Option<Albedo>,
    /// Radiance on the side of the normal.
    pub emission: Vec3,
}

// An edge may be this long at the object's centre, in radii of the object's bounding sphere …
const EDGE_AT_CENTER: f32 = 0.06;
// … and grows with the distance from it: about what subtends this many radians there.
const EDGE_PER_DISTANCE: f32 = 0.06;
// A proxy never grows beyond this.
const MAX_TRIANGLES: usize = 200_000;
// Vertices between two reports.
const BATCH: usize = 1024;

/// Bakes everything but `object`: direct and indirect light of the scene with the object in it.
///
/// `center` and `radius` bound the object; `settings.samples_per_pixel` paths start at each side of each vertex.
pub fn bake_background(
    scene: &Scene,
    object: usize,
    (center, radius): (Vec3, f32),
    tracer: &Tracer,
    settings: &TraceSettings,
    progress: &dyn Progress,
) -> Result<Background, Cancelled> {
    let max_edge = |at: Vec3| radius * EDGE_AT_CENTER + EDGE_PER_DISTANCE * at.distance(center);
    let mut surfaces: Vec<BackgroundSurface> = Vec::new();
    for (_, other) in scene.objects.iter().enumerate().filter(|(i, _)| *i != object) {
        let mesh = subdivide(&other.mesh, &max_edge, MAX_TRIANGLES);
        let albedo = match &scene.materials[other.material] {
            Material::Diffuse { albedo } => Some(*albedo),
            Material::Mirror { .. } | Material::Ggx { .. } | Material::Glossy { .. } | Material::Brdf(_) => None,
        };
        surfaces.push(BackgroundSurface { mesh, irradiance: Vec::new(), albedo, emission: other.emission.unwrap_or(Vec3::ZERO) });
    }
    let total: usize = surfaces.iter().map(|s| s.mesh.positions.len()).sum();
    let mut done = 0;
    for surface in &mut surfaces {
        let mesh = &surface.mesh;
        let mut irradiance = Vec::with_capacity(mesh.positions.len());
        for start in (0..mesh.positions.len()).step_by(BATCH) {
            if progress.is_cancelled() {
                return Err(Cancelled);
            }
            let end = (start + BATCH).min(mesh.positions.len());
            let bake = |v: usize| {
                // A seed a vertex, so that the result does not depend on how vertices are shared out to threads.
                let seeded = TraceSettings { seed: settings.seed ^ ((done + v) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15), ..*settings };
                let sides = [mesh.normals[v], -mesh.normals[v]];
                sides.map(|n| tracer.irradiance(mesh.positions[v], n, settings.samples_per_pixel, &seeded))
            };
            irradiance.par_extend((start..end).into_par_iter().map(bake));
            progress.report("baking the background", (done + end) as u64, total as u64);
        }
        done += mesh.positions.len();
        surface.irradiance = irradiance;
    }
    Ok(Background { surfaces, textures: scene.textures.clone(), environment: scene.environment.clone() })
}

impl Background {
    /// What does not agree, if anything: for backgrounds that come from a file.
    pub fn check(&self) -> Result<(), String> {
        let check_image = |what: &str, image: &Image| {
            let pixels = image.width.checked_mul(image.height).unwrap_or(0);
            let sound =
                pixels > 0 && image.planes.len() == 3 && image.planes.iter().all(|p| p.len() == pixels && p.iter().all(|v| v.is_finite()));
            if sound { Ok(()) } else { Err(format!("{what} is not a finite three-channel image of its stated size")) }
        };
        for (i, texture) in self.textures.iter().enumerate() {
            check_image(&format!("texture {i}"), &texture.image)?;
        }
        match &self.environment {
            Environment::Constant(radiance) if !radiance.is_finite() => return Err("environment is not finite".into()),
            Environment::Map(map) => check_image("environment", &map.image)?,
            Environment::Constant(_) => {}
        }
        for (i, surface) in self.surfaces.iter().enumerate() {
            if surface.irradiance.len() != surface.mesh.positions.len() {
                return Err(format!(
                    "surface {i} has {} irradiances for {} vertices",
                    surface.irradiance.len(),
                    surface.mesh.positions.len()
                ));
            }
            if !(surface.emission.is_finite() && surface.irradiance.iter().flatten().all(|e| e.is_finite())) {
                return Err(format!("surface {i} has light that is not finite"));
            }
            if let Some(Albedo::Texture(t)) = surface.albedo
                && t >= self.textures.len()
            {
                return Err(format!("surface {i} names texture {t}, below {} expected", self.textures.len()));
            }
        }
        Ok(())
    }
}

impl BackgroundSurface {
    /// Exitant radiance per unit albedo at a point with irradiance `front` and `back`, seen from the side of the normal or not.
    pub fn radiance(&self, irradiance: [Vec3; 2], albedo: Vec3, from_front: bool) -> Vec3 {
        let side = if from_front { irradiance[0] } else { irradiance[1] };
        let emission = if from_front { self.emission } else { Vec3::ZERO };
        emission + albedo * side / PI
    }
}
