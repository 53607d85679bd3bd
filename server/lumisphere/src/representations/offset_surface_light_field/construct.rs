//! From a scene to a stored offset surface light field: place, trace, map, bake.

use glam::Vec3;
use thiserror::Error;

use super::density::{Density, curvature};
use super::pilot::{PilotSettings, pilot_errors};
use super::sample_points::{Placed, PlacementError, Spacing, build_sample_maps, place_by_density, spacing_of};
use super::{NO_SAMPLE, OffsetSurfaceLightField, Parameters, Placing, SampleMaps, SamplePoint, to_parts};
use crate::capture::{CaptureError, PartsError, SurfaceMesh, Viewpoint, bake_background, coarser_levels, trace_cube_maps};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{Appearance, TraceError, TraceSettings, Tracer};
use crate::representations::Original;
use crate::scenes::Scene;
use crate::textures::{Codec, PixelFormat, Staging, StoreError};

/// What to capture and how. Lengths are in the scene's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstructSettings {
    /// Name of the object.
    pub object: String,
    /// Distance of the sample points from the surface; None: half the distance between neighbouring sample points.
    pub epsilon: Option<f32>,
    /// How densely sample points lie.
    pub spacing: Spacing,
    /// Where denser.
    pub placing: Placing,
    /// Texels along a cube-map face.
    pub face_size_texels: u32,
    /// Texels along a sample map.
    pub sample_map_size_texels: u32,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
    /// Paths per texel.
    pub samples_per_texel: u32,
    /// 1 = direct light only.
    pub max_bounces: u32,
    /// Of the random numbers.
    pub seed: u64,
    /// What the object looks like to the cube maps.
    pub original: Original,
}

/// Why no light field came of it.
#[derive(Debug, Error)]
pub enum ConstructError {
    /// The scene has no object of that name.
    #[error("scene has no object {object:?}; it has {}", known.join(", "))]
    UnknownObject {
        /// As given.
        object: String,
        /// What there is.
        known: Vec<String>,
    },
    /// A setting out of range.
    #[error("{setting} is {value}, {expected} expected")]
    Setting {
        /// Which.
        setting: &'static str,
        /// As given.
        value: String,
        /// What would do.
        expected: &'static str,
    },
    /// No points could be placed.
    #[error(transparent)]
    Placement(#[from] PlacementError),
    /// All points lie inside geometry.
    #[error("all {0} sample points lie inside other geometry; a smaller epsilon or another object may help")]
    AllInside(usize),
    /// The scene cannot be traced.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// Asked to stop; can be resumed.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// The store refused.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A part cannot be encoded.
    #[error(transparent)]
    Parts(#[from] PartsError),
}

impl From<CaptureError> for ConstructError {
    fn from(error: CaptureError) -> Self {
        match error {
            CaptureError::Cancelled(c) => Self::Cancelled(c),
            CaptureError::Store(s) => Self::Store(s),
        }
    }
}

// ε where none is given. A texel up to one spacing d from its nearest sample point must see it within the runtime horizon of 65°:
// ε ≥ d / tan 65° = 0.47 d. The source's 0.1 and 0.25 with 1156 points on the teapot (d = 0.17) lie on both sides of this.
const DEFAULT_EPSILON_PER_SPACING: f32 = 0.5;
// Paths a side of a background vertex.
const BACKGROUND_SAMPLES: u32 = 64;

/// Fills `staging` with pages and parts of the object's light field; the caller publishes. Can be called again on a staging area
/// that an earlier, identical call left unfinished: cube maps already there are kept.
pub fn construct(
    scene: &Scene,
    settings: &ConstructSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<Parameters, ConstructError> {
    let index = scene.object(&settings.object).ok_or_else(|| ConstructError::UnknownObject {
        object: settings.object.clone(),
        known: scene.objects.iter().map(|o| o.name.clone()).collect(),
    })?;
    let object = &scene.objects[index];
    let (low, high) = object.mesh.bounds();
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    check(settings)?;

    let surface = SurfaceMesh::of(object);
    let appearance = match settings.original {
        Original::Diffuse => Appearance::Diffuse,
        Original::AsAuthored => Appearance::AsAuthored,
    };
    let tracer = Tracer::new(scene)?.with_appearance(index, appearance);
    let trace = TraceSettings { samples_per_pixel: settings.samples_per_texel, max_bounces: settings.max_bounces, seed: settings.seed };
    let (sample_points, epsilon) = {
        let density = match settings.placing {
            Placing::Uniform => Density::uniform(),
            Placing::Curvature => Density::by(&surface, curvature(&surface)),
            Placing::Error => {
                let pilot = PilotSettings { spacing: settings.spacing, face_size_texels: settings.face_size_texels, trace };
                Density::by(&surface, pilot_errors(&surface, &pilot, &tracer, progress)?)
            }
        };
        progress.report("placing sample points", 0, 1);
        points_off(&surface, (settings.spacing, &density), settings.epsilon, &tracer)?
    };
    progress.report("placing sample points", 1, 1);

    let without_object = tracer.without_object(index);
    let mut viewpoints: Vec<Viewpoint<'_>> = sample_points.iter().map(|p| Viewpoint { tracer: &tracer, position: p.position }).collect();
    viewpoints.push(Viewpoint { tracer: &without_object, position: center });
    let format = (settings.codec, settings.pixel_format);
    trace_cube_maps(&viewpoints, settings.face_size_texels, format, &trace, staging, progress)?;

    let sample_maps = sample_maps_of(&surface, &sample_points, (epsilon, settings.sample_map_size_texels), &tracer, progress);
    let bake = TraceSettings { samples_per_pixel: BACKGROUND_SAMPLES, ..trace };
    let background = bake_background(scene, index, (center, radius), &tracer, &bake, progress)?;

    let parameters = Parameters {
        object: settings.object.clone(),
        epsilon,
        face_size_texels: settings.face_size_texels,
        coarser_levels: coarser_levels(settings.face_size_texels),
        sample_map_size_texels: settings.sample_map_size_texels,
        spacing: settings.spacing,
        placing: settings.placing,
        object_center: center.to_array(),
        samples_per_texel: settings.samples_per_texel,
        max_bounces: settings.max_bounces,
        seed: settings.seed,
        original: settings.original,
        thinned_from: None,
        replaced: None,
    };
    let field = OffsetSurfaceLightField { parameters, surface, sample_points, sample_maps, background };
    for (name, bytes) in to_parts(&field)? {
        staging.put_blob(name, &bytes)?;
    }
    Ok(field.parameters)
}

/// Refuses what is not in low..=high.
pub(super) fn within(setting: &'static str, value: u32, low: u32, high: u32, expected: &'static str) -> Result<(), ConstructError> {
    if (low..=high).contains(&value) { Ok(()) } else { Err(ConstructError::Setting { setting, value: value.to_string(), expected }) }
}

/// Refuses an ε that is none.
pub(super) fn check_epsilon(epsilon: Option<f32>) -> Result<(), ConstructError> {
    match epsilon {
        Some(e) if !(e > 0.0 && e.is_finite()) => {
            Err(ConstructError::Setting { setting: "epsilon", value: e.to_string(), expected: "a finite distance above zero" })
        }
        _ => Ok(()),
    }
}

fn check(settings: &ConstructSettings) -> Result<(), ConstructError> {
    within("face size", settings.face_size_texels, 4, 1024, "4 to 1024 texels")?;
    within("sample map size", settings.sample_map_size_texels, 1, 1024, "1 to 1024 texels")?;
    within("samples per texel", settings.samples_per_texel, 1, 65_536, "1 to 65536")?;
    within("max bounces", settings.max_bounces, 1, 64, "1 to 64")?;
    check_epsilon(settings.epsilon)
}

/// The sample points of a surface in `tracer`'s scene, and their ε. At least one.
pub(super) fn points_off(
    surface: &SurfaceMesh,
    (spacing, density): (Spacing, &Density<'_>),
    epsilon: Option<f32>,
    tracer: &Tracer,
) -> Result<(Vec<SamplePoint>, f32), ConstructError> {
    let placed = place_by_density(surface, spacing, density)?;
    let mean = DEFAULT_EPSILON_PER_SPACING * spacing_of(surface, placed.len());
    // Where none is given, it is a part of the spacing around each.
    let of_point = |placed: &Placed| epsilon.unwrap_or(mean / placed.density.sqrt());
    let sample_points = offset_points(&placed, of_point, tracer);
    if sample_points.is_empty() { Err(ConstructError::AllInside(placed.len())) } else { Ok((sample_points, epsilon.unwrap_or(mean))) }
}

/// The sample maps of a surface in `tracer`'s scene.
pub(super) fn sample_maps_of(
    surface: &SurfaceMesh,
    sample_points: &[SamplePoint],
    (epsilon, size_texels): (f32, u32),
    tracer: &Tracer,
    progress: &dyn Progress,
) -> SampleMaps {
    progress.report("building sample maps", 0, 1);
    let sample_maps = build_sample_maps(surface, sample_points, size_texels as usize, &visibility(epsilon, tracer));
    progress.report("building sample maps", 1, 1);
    sample_maps
}

/// Whether the surface point sees the sample point.
pub(super) fn visibility(epsilon: f32, tracer: &Tracer) -> impl Fn(SamplePoint, Vec3) -> bool + Sync {
    let lift = 0.1 * epsilon;
    move |texel, sample| !tracer.occluded(texel.position + lift * texel.normal, sample)
}

// Points lifted by their ε; those inside other geometry, or cut off from their surface by it, are dropped.
fn offset_points(placed: &[Placed], epsilon: impl Fn(&Placed) -> f32, tracer: &Tracer) -> Vec<SamplePoint> {
    let lifted = |placed: &Placed, by: f32| SamplePoint { position: placed.point.position + by * placed.point.normal, ..placed.point };
    placed
        .iter()
        .map(|p| (lifted(p, 0.1 * epsilon(p)), lifted(p, epsilon(p))))
        .filter(|(low, p)| !tracer.occluded(low.position, p.position) && !tracer.is_inside_geometry(p.position))
        .map(|(_, p)| p)
        .take(usize::from(NO_SAMPLE) - 1)
        .collect()
}

#[cfg(test)]
#[path = "construct_tests.rs"]
mod tests;
