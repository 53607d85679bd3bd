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
