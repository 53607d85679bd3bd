//! Photographs of a scene's object by the path tracer, straight into an observation map.
//!
//! Cameras stand on a sphere around the object in the directions of a scheme. Where a camera sees a texel's centre and stands above its
//! horizon, the entry is the mean radiance of paths toward points spread over the texel.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use thiserror::Error;

use super::{MOST_OBSERVATIONS, MOST_TEXELS_PER_EDGE, Observation, ObservationMap, ObservationParameters, ObservedTexel, Observer, State};
use super::{MOST_TEXELS, TEXELS_PER_PAGE, tiled_order, to_parts};
use crate::capture::{PartsError, SurfaceMesh, SurfaceTexel, bake_background, surface_texels};
use crate::directions::Scheme;
use crate::geometry::{Ray, TangentFrame};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{TraceError, TraceSettings, Tracer};
use crate::scenes::{Object, Scene};
use crate::textures::{Codec, PageId, PixelFormat, Staging, StoreError, encode_as};

/// What to photograph and how. Lengths are in the scene's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ObserveSettings {
    /// Name of the object.
    pub object: String,
    /// Texels along the edge of each part.
    pub size_texels: u32,
    /// Where cameras stand, about `axis`.
    pub directions: Scheme,
    /// Which side of the object they stand on.
    pub coverage: Coverage,
    /// What the scheme's zenith is; None: the surface's mean normal, or +Y where there is none.
    pub axis: Option<Vec3>,
    /// From the object's centre, in radii of its bounding sphere; above 1.
    pub distance_radii: f32,
    /// Paths per observation.
    pub samples_per_observation: u32,
    /// 1 = direct light only.
    pub max_bounces: u32,
    /// Of the random numbers.
    pub seed: u64,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
}

/// Which directions cameras stand in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coverage {
    /// Those of the scheme, which are above its horizon.
    Hemisphere,
    /// Those, and their opposites.
    Sphere,
}

impl Coverage {
    /// How many directions stand for one of the scheme.
    pub fn sides(self) -> usize {
        match self {
            Self::Hemisphere => 1,
            Self::Sphere => 2,
        }
    }
}

/// Why nothing was observed.
#[derive(Debug, Error)]
pub enum ObserveError {
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
        expected: String,
    },
    /// The object's texture coordinates cover no texel's centre.
    #[error("object {object:?} covers no texel of {size}x{size}: texture coordinates within [0, 1] expected, or more texels")]
    NoTexels {
        /// Which.
        object: String,
        /// Texels along an edge.
        size: u32,
    },
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

const STAGE: &str = "taking photographs";
// Pages traced side by side: enough to keep the threads busy while one is encoded, few enough to lose little when killed.
const BATCH: usize = 16;
// Paths a side of a background vertex.
const BACKGROUND_SAMPLES: u32 = 64;
// A camera lower above a texel's plane than this (89°) sees it as a line.
const LEAST_COSINE: f32 = 0.017_45;
// A surface hides its own points within rounding: what is looked at lies so many radii of the object above it.
const LIFT_PER_RADIUS: f32 = 1e-4;

/// Fills `staging` with pages and parts of the object's observation map; the caller publishes. Can be called again on a staging area that an
/// earlier, identical call left unfinished: pages already there are kept.
pub fn observe(
    scene: &Scene,
    settings: &ObserveSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<ObservationParameters, ObserveError> {
    let shoot = Shoot::new(scene, settings, &|_| true, progress)?;
    shoot.fill(settings, staging, progress)?;
    for (name, bytes) in to_parts(&shoot.map)? {
        staging.put_blob(name, &bytes)?;
    }
    Ok(shoot.map.parameters)
}

/// Entries of pages, each row by row.
pub type Entries = Vec<Vec<[f32; 4]>>;

/// The same of the texels that are `wanted`, a few thousand, into memory: the map, and its pages' entries, not rounded to
/// `settings.pixel_format`.
pub fn observed(
    scene: &Scene,
    settings: &ObserveSettings,
    wanted: &dyn Fn(&ObservedTexel) -> bool,
    progress: &dyn Progress,
) -> Result<(ObservationMap, Entries), ObserveError> {
    let shoot = Shoot::new(scene, settings, wanted, progress)?;
    let total = shoot.map.page_count() as u64;
    let done = AtomicU64::new(0);
    let pages = (0..shoot.map.page_count()).into_par_iter().map(|page| {
        if progress.is_cancelled() {
            return Err(ObserveError::Cancelled(Cancelled));
        }
        let entries = shoot.page(page);
        progress.report(STAGE, done.fetch_add(1, Ordering::Relaxed) + 1, total);
        Ok(entries)
    });
    let pages = pages.collect::<Result<Vec<_>, _>>()?;
    Ok((shoot.map, pages))
}

fn check(settings: &ObserveSettings) -> Result<(), ObserveError> {
    let within = |setting, value: u32, low: u32, high: u32| match (low..=high).contains(&value) {
        true => Ok(()),
        false => Err(ObserveError::Setting { setting, value: value.to_string(), expected: format!("{low} to {high}") }),
    };
    within("texels along an edge", settings.size_texels, 1, MOST_TEXELS_PER_EDGE)?;
    within("samples per observation", settings.samples_per_observation, 1, 65_536)?;
    within("max bounces", settings.max_bounces, 1, 64)?;
    let observations = (settings.directions.count() * settings.coverage.sides()) as u32;
    within("number of observations", observations, 1, MOST_OBSERVATIONS)?;
    if !(settings.distance_radii > 1.0 && settings.distance_radii.is_finite()) {
        let value = settings.distance_radii.to_string();
        return Err(ObserveError::Setting { setting: "distance in radii", value, expected: "a finite number above 1".into() });
    }
    match settings.axis {
        Some(axis) if !axis.is_normalized() => {
            Err(ObserveError::Setting { setting: "axis", value: axis.to_string(), expected: "a unit vector".into() })
        }
        Some(_) | None => Ok(()),
    }
}

/// Unit, world space, weighted by area; +Y where the surface faces all ways alike.
pub fn mean_normal(surface: &SurfaceMesh) -> Vec3 {
    let mesh = &surface.mesh;
    let turned = |t: usize| {
        let (area, [i, j, k]) = (mesh.area_vector(t), mesh.triangles[t].map(|v| mesh.normals[v as usize]));
        if area.dot(i + j + k) < 0.0 { -area } else { area }
    };
    let (sum, area) =
        (0..mesh.triangles.len()).map(turned).fold((Vec3::ZERO, 0.0), |(sum, area), vector| (sum + vector, area + vector.length()));
    // A closed surface's sum vanishes but for rounding and for what is open at its bottom.
    if sum.length() > 0.5 * area { sum.normalize() } else { Vec3::Y }
}

fn cameras(settings: &ObserveSettings, axis: Vec3, center: Vec3, radius: f32) -> Vec<Observer> {
    let distance = settings.distance_radii * radius;
    let directions = directions_about(&settings.directions, settings.coverage, axis);
    directions.into_iter().map(|d| Observer::At(center + distance * d)).collect()
}

/// A scheme's directions, and behind them their opposites where they are covered: unit, world space. `axis`: unit, the scheme's zenith.
pub fn directions_about(scheme: &Scheme, coverage: Coverage, axis: Vec3) -> Vec<Vec3> {
    let frame = TangentFrame::around(axis);
    let above = scheme.directions();
    let opposite = above.iter().map(|d| -*d);
    let all: Vec<Vec3> = match coverage {
        Coverage::Hemisphere => above.clone(),
        Coverage::Sphere => above.iter().copied().chain(opposite).collect(),
    };
    all.into_iter().map(|d| frame.world_from_local(d)).collect()
}

/// Of a scene's objects, for those who asked for another.
pub(super) fn names(scene: &Scene) -> Vec<String> {
    scene.objects.iter().map(|object| object.name.clone()).collect()
}

/// Centre and radius.
pub(super) fn sphere_around(object: &Object) -> (Vec3, f32) {
    let (low, high) = object.mesh.bounds();
    (0.5 * (low + high), 0.5 * (high - low).length())
}

/// In the map's order.
pub(super) fn texels_of(surface: &SurfaceMesh, size: usize) -> Vec<(ObservedTexel, SurfaceTexel)> {
    let of_part = |part: u32| {
        let texels = surface_texels(surface, part, size);
        let observed = move |at: usize| {
            let texel = texels[at]?;
            let index = part * (size * size) as u32 + at as u32;
            Some((ObservedTexel { index, position: texel.position, normal: texel.normal, tangent: texel.steps[0] }, texel))
        };
        tiled_order(size).filter_map(observed).collect::<Vec<_>>()
    };
    (0..surface.parts).into_par_iter().flat_map_iter(of_part).collect()
}

/// What hides a surface's points from cameras.
pub(super) struct Visibility {
    tracer: Tracer,
    lift: f32,
}

impl Visibility {
    /// `radius`: of the object in the scene, for lengths that mean nothing.
    pub fn new(scene: &Scene, radius: f32) -> Result<Self, TraceError> {
        Ok(Self { tracer: Tracer::new(scene)?, lift: LIFT_PER_RADIUS * radius })
    }

    /// Whether a camera stands above the texel's horizon, and nothing stands between them.
    pub fn is_seen(&self, texel: &ObservedTexel, camera: Vec3) -> bool {
        let above = (camera - texel.position).normalize_or_zero().dot(texel.normal) > LEAST_COSINE;
        above && !self.tracer.occluded(texel.position + self.lift * texel.normal, camera)
    }
}

/// Everything that stands before the first photograph.
struct Shoot {
    visibility: Visibility,
    map: ObservationMap,
    seen: Vec<SurfaceTexel>,
    trace: TraceSettings,
}

impl Shoot {
    fn new(
        scene: &Scene,
        settings: &ObserveSettings,
        wanted: &dyn Fn(&ObservedTexel) -> bool,
        progress: &dyn Progress,
    ) -> Result<Self, ObserveError> {
        let index = scene
            .object(&settings.object)
            .ok_or_else(|| ObserveError::UnknownObject { object: settings.object.clone(), known: names(scene) })?;
        check(settings)?;
        let object = &scene.objects[index];
        let (center, radius) = sphere_around(object);
        let visibility = Visibility::new(scene, radius)?;
        let surface = SurfaceMesh::of(object);
        let all = u64::from(surface.parts) * u64::from(settings.size_texels).pow(2);
        if all > MOST_TEXELS {
            let (value, expected) = (settings.size_texels.to_string(), format!("at most {MOST_TEXELS} in its {} parts", surface.parts));
            return Err(ObserveError::Setting { setting: "texels along an edge", value, expected });
        }
        let axis = settings.axis.unwrap_or_else(|| mean_normal(&surface));
        let observers = cameras(settings, axis, center, radius);
        let trace =
            TraceSettings { samples_per_pixel: settings.samples_per_observation, max_bounces: settings.max_bounces, seed: settings.seed };
        let bake = TraceSettings { samples_per_pixel: BACKGROUND_SAMPLES, ..trace };
        let background = bake_background(scene, index, (center, radius), &visibility.tracer, &bake, progress)?;
        let (texels, seen): (Vec<ObservedTexel>, Vec<SurfaceTexel>) =
            texels_of(&surface, settings.size_texels as usize).into_iter().filter(|(texel, _)| wanted(texel)).unzip();
        if texels.is_empty() {
            return Err(ObserveError::NoTexels { object: settings.object.clone(), size: settings.size_texels });
        }
        let parameters = ObservationParameters {
            object: settings.object.clone(),
            size_texels: settings.size_texels,
            directions: settings.directions.to_string(),
            samples_per_observation: settings.samples_per_observation,
            max_bounces: settings.max_bounces,
            seed: settings.seed,
        };
        let map = ObservationMap { parameters, surface, background, observers, texels };
        Ok(Self { visibility, map, seen, trace })
    }

    fn fill(&self, settings: &ObserveSettings, staging: &Staging, progress: &dyn Progress) -> Result<(), ObserveError> {
        let shape = self.map.page_shape(settings.pixel_format);
        let present = staging.pages_present();
        let missing: Vec<usize> = (0..self.map.page_count()).filter(|k| !present.contains(&PageId(*k as u32))).collect();
        let done = AtomicU64::new((self.map.page_count() - missing.len()) as u64);
        let total = self.map.page_count() as u64;
        progress.report(STAGE, done.load(Ordering::Relaxed), total);
        for batch in missing.chunks(BATCH) {
            let encoded = batch.par_iter().map(|page| {
                if progress.is_cancelled() {
                    return Err(ObserveError::Cancelled(Cancelled));
                }
                let encoded = encode_as(settings.codec, &shape, self.page(*page).as_flattened())?;
                progress.report(STAGE, done.fetch_add(1, Ordering::Relaxed) + 1, total);
                Ok(encoded)
            });
            for (page, encoded) in batch.iter().zip(encoded.collect::<Result<Vec<_>, _>>()?) {
                staging.append_encoded(PageId(*page as u32), &encoded)?;
            }
        }
        Ok(())
    }

    fn page(&self, page: usize) -> Vec<[f32; 4]> {
        let columns = self.map.texels_of_page(page).len();
        let first = page * TEXELS_PER_PAGE;
        let mut entries = vec![Observation::MISSING.to_texel(); TEXELS_PER_PAGE * self.map.observers.len()];
        let visible: Vec<(usize, usize, Vec3)> = (0..self.map.observers.len())
            .flat_map(|row| (0..columns).map(move |column| (row, column)))
            .filter_map(|(row, column)| Some((row, column, self.camera_that_sees(first + column, row)?)))
            .collect();
        let ray = |at: usize, random: Vec2| {
            let (_, column, camera) = visible[at];
            let texel = &self.seen[first + column];
            let target = texel.position + (random.x - 0.5) * texel.steps[0] + (random.y - 0.5) * texel.steps[1];
            Ray { origin: camera, direction: (target - camera).normalize() }
        };
        let first_entry = (first * self.map.observers.len()) as u64;
        let radiance = self.visibility.tracer.radiance_along(visible.len(), first_entry, &ray, &self.trace);
        for ((row, column, _), radiance) in visible.iter().zip(radiance) {
            let seen = Observation { radiance: radiance.to_array(), state: State::Seen { clipped: 0 } };
            entries[row * TEXELS_PER_PAGE + column] = seen.to_texel();
        }
        entries
    }

    fn camera_that_sees(&self, texel: usize, observer: usize) -> Option<Vec3> {
        let (texel, Observer::At(camera)) = (&self.map.texels[texel], self.map.observers[observer]) else { return None };
        self.visibility.is_seen(texel, camera).then_some(camera)
    }
}
