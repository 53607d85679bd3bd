//! What is around the objects in the new one's shadow instead of the old one's.
//!
//! Baked light holds the shadow of the old object. The part of it that comes straight from the sky and from area lights is known twice over: with
//! the old object there, and with the new one. `E' = E + E_direct(new) − E_direct(old)` at every vertex, however far (a low sun's shadow is long), both by the same random numbers, so that
//! the difference is 0 where neither object is in the way. What either reflects onto its surroundings, and shadows of point lights, stay the old one's.

use glam::Vec3;
use rayon::prelude::*;

use super::ReplaceError;
use crate::capture::Background;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{TraceSettings, Tracer};

/// Paths of a side of a vertex.
const SAMPLES: u32 = 64;
/// Part of a vertex's light from which on it counts as changed.
const LEAST_CHANGE: f32 = 0.03;
/// Vertices between two reports.
const BATCH: usize = 1024;

/// A background with its light changed, and of each surface's vertices, whether it is so to the eye.
pub(super) struct ChangedLight {
    pub background: Background,
    /// In the order of surfaces and their vertices.
    pub is_changed: Vec<bool>,
}

impl ChangedLight {
    /// `old` and `new` are tracers of black surroundings with either object in them.
    pub fn new(background: &Background, (old, new): (&Tracer, &Tracer), seed: u64, progress: &dyn Progress) -> Result<Self, ReplaceError> {
        let mut changed = Self { background: background.clone(), is_changed: Vec::new() };
        let settings = TraceSettings { samples_per_pixel: SAMPLES, max_bounces: 0, seed };
        let total: usize = background.surfaces.iter().map(|s| s.mesh.positions.len()).sum();
        for surface in &mut changed.background.surfaces {
            for start in (0..surface.mesh.positions.len()).step_by(BATCH) {
                progress.report("changing shadows", changed.is_changed.len() as u64, total as u64);
                if progress.is_cancelled() {
                    return Err(Cancelled.into());
                }
                let mesh = &surface.mesh;
                let end = (start + BATCH).min(mesh.positions.len());
                let places = mesh.positions[start..end].par_iter().zip(&mesh.normals[start..end]);
                let batch: Vec<bool> = places
                    .zip(&mut surface.irradiance[start..end])
                    .map(|((position, normal), sides)| {
                        let mut is_changed = false;
                        for (side, n) in sides.iter_mut().zip([*normal, -*normal]) {
                            let direct = |tracer: &Tracer| tracer.irradiance(*position, n, SAMPLES, &settings);
                            let lit = (*side + direct(new) - direct(old)).max(Vec3::ZERO);
                            is_changed |= (lit - *side).abs().max_element() > LEAST_CHANGE * side.max(lit).max_element();
                            *side = lit;
                        }
                        is_changed
                    })
                    .collect();
                changed.is_changed.extend(batch);
            }
        }
        progress.report("changing shadows", total as u64, total as u64);
        Ok(changed)
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::super::dark_scene;
    use super::*;
    use crate::capture::BackgroundSurface;
    use crate::geometry::TriangleMesh;
    use crate::progress::Unattended;
    use crate::scenes::{Albedo, Environment};

    // A square across the X axis.
    fn square(center: Vec3, half: f32, normal: Vec3) -> TriangleMesh {
        let corners = [Vec3::new(0.0, -1.0, -1.0), Vec3::new(0.0, 1.0, -1.0), Vec3::new(0.0, 1.0, 1.0), Vec3::new(0.0, -1.0, 1.0)];
        let triangles = if normal.x > 0.0 { vec![[0, 1, 2], [0, 2, 3]] } else { vec![[0, 2, 1], [0, 3, 2]] };
        TriangleMesh::new(corners.map(|c| center + half * c).to_vec(), vec![normal; 4], vec![Vec2::ZERO; 4], triangles).unwrap()
    }

    #[test]
    fn a_shadow_is_exchanged_however_far_it_falls() {
        let surface = |mesh: TriangleMesh, emission: Vec3, irradiance: Vec3| BackgroundSurface {
            irradiance: vec![[irradiance, Vec3::ZERO]; mesh.positions.len()],
            albedo: Some(Albedo::Constant(Vec3::splat(0.5))),
            emission,
            mesh,
        };
        // A lamp of area 1, and a small wall 60 away; the post, of radius 1.4, hides all of one from the other.
        let expected = Vec3::splat(100.0 / 3600.0);
        let around = |on_wall: Vec3| Background {
            surfaces: vec![
                surface(square(Vec3::new(-30.0, 0.0, 0.0), 0.5, Vec3::X), Vec3::splat(100.0), Vec3::ZERO),
                surface(square(Vec3::new(30.0, 0.0, 0.0), 0.2, Vec3::NEG_X), Vec3::ZERO, on_wall),
            ],
            textures: Vec::new(),
            environment: Environment::Constant(Vec3::ZERO),
        };
        let (post, aside) = (square(Vec3::ZERO, 1.0, Vec3::X), square(Vec3::new(0.0, 0.0, 5.0), 1.0, Vec3::X));
        for (old, new, before, after) in [(&post, &aside, Vec3::ZERO, expected), (&aside, &post, expected, Vec3::ZERO)] {
            let background = around(before);
            let tracer = |mesh: &TriangleMesh| Tracer::new(&dark_scene(&background, "object", mesh)).unwrap();
            let changed = ChangedLight::new(&background, (&tracer(old), &tracer(new)), 3, &Unattended).unwrap();
            assert_eq!(changed.is_changed, [[false; 4], [true; 4]].concat());
            for [front, back] in &changed.background.surfaces[1].irradiance {
                assert!((*front - after).abs().max_element() < 0.03 * expected.x && *back == Vec3::ZERO, "{front}, {after} expected");
            }
        }
    }
}
