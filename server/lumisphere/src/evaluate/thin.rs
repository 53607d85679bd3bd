//! A light field no larger than an error bound needs: sample points and face size, by validation views of their own.
//!
//! Held-out poses stay held out: the views are small windows of a camera that looks at places all over the object's surface from where
//! they can be seen, each place as likely as its part of all pictures of the object. One set of windows says what goes first, another, from
//! other directions, how much may go: what is chosen by a set's errors looks better by that set than it is.

use std::collections::HashSet;

use glam::{Vec2, Vec3};
use serde::Serialize;
use thiserror::Error;

use super::truth::{Truth, TruthRenderer};
use crate::geometry::{Camera, Intrinsics, Pose};
use crate::progress::{Cancelled, Progress, Silent};
use crate::radiometry::brdf::cosine_hemisphere;
use crate::radiometry::color::Lab;
use crate::radiometry::delta_e_2000;
use crate::raytrace::{SampleSequence, TraceError, TraceSettings, Tracer};
use crate::representations::offset_surface_light_field::{
    Component, Kept, OffsetSurfaceLightField, PlacementError, SamplePoint, Settings, Spacing, Thinning, ThinningError, ValidationPixel,
    ValidationView, place_sample_points,
};
use crate::representations::{Original, PageSource, Settings as AnySettings};
use crate::scenes::Scene;

/// A window's edge: its rim tells only whether the pixels within count. Many small ones tell more than few large ones.
const WINDOW_PX: u32 = 5;
/// Height of the whole picture, of which a window is a part, and its field of view.
const PICTURE_PX: f32 = 480.0;
const FIELD_OF_VIEW_DEG: f32 = 40.0;
/// Of the cameras from the object's centre, in radii of its bounding sphere.
const DISTANCE_RADII: f32 = 3.5;
/// Sample maps name the sample points nearest to a texel's centre, not to the pixel: where the bound is missed by that, so many fewer leave.
const STEP_BACK: f64 = 0.97;
const MOST_STEPS_BACK: u32 = 16;

/// A measure of error that is a mean over pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ThinMetric {
    /// Mean CIEDE2000 difference.
    DeltaE,
    /// RMSE of L*, divided by 100.
    #[serde(rename = "rmse-l")]
    RmseLightness,
}

/// What to thin for.
#[derive(Debug, Clone)]
pub struct ThinPlan {
    /// What is shown; its error is bounded.
    pub settings: Settings,
    /// Of which kind.
    pub metric: ThinMetric,
    /// The bound.
    pub max_error: f64,
    /// How many windows of either set.
    pub windows: u32,
    /// Of the windows' truth.
    pub trace: TraceSettings,
}

/// What thinning did, by the validation windows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThinReport {
    /// Pixels that the errors are means of.
    pub pixels: usize,
    /// Of the light field as it was.
    pub error_before: f64,
    /// As it is.
    pub error: f64,
    /// As it was.
    pub sample_points_before: usize,
    /// As it is.
    pub sample_points: usize,
    /// As it was.
    pub face_size_texels_before: u32,
    /// As it is.
    pub face_size_texels: u32,
}

/// Why nothing was thinned.
#[derive(Debug, Error)]
pub enum ThinError {
    /// The scene has no such object.
    #[error("scene has no object {0:?}")]
    NoObject(String),
    /// Even as it is, the light field is not good enough.
    #[error("the light field's own error is {error:.4}, more than {max_error} is expected as a bound")]
    Unmet {
        /// Of the light field as it is.
        error: f64,
        /// As given.
        max_error: f64,
    },
    /// Nothing of the object can be seen.
    #[error("no validation window shows the object")]
    Unseen,
    /// No windows can be placed.
    #[error(transparent)]
    Placement(#[from] PlacementError),
    /// The scene cannot be traced.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// Shading, reading or storing failed, or it was asked to stop.
    #[error(transparent)]
    Thinning(#[from] ThinningError),
}

impl From<Cancelled> for ThinError {
    fn from(cancelled: Cancelled) -> Self {
        Self::Thinning(cancelled.into())
    }
}

impl ThinMetric {
    fn of_pixel(self, shown: Vec3, reference: Vec3) -> f64 {
        let [shown, reference] = [shown, reference].map(|color| Lab::from_linear(color.to_array()));
        match self {
            Self::DeltaE => delta_e_2000(shown, reference),
            Self::RmseLightness => ((shown.l - reference.l) / Lab::UNIT_SCALE).powi(2),
        }
    }

    /// From the mean over the pixels, and back.
    fn of_mean(self, mean: f64) -> f64 {
        if self == Self::RmseLightness { mean.sqrt() } else { mean }
    }

    fn to_mean(self, error: f64) -> f64 {
        if self == Self::RmseLightness { error * error } else { error }
    }
}

/// Thins `field`, captured of `scene`, about as far as the plan's bound allows: of what was tried, the fewest texels. The pages are not copied
/// yet (`copy_pages`).
pub fn thin(
    scene: &Scene,
    (field, source): (&OffsetSurfaceLightField, &dyn PageSource),
    plan: &ThinPlan,
    progress: &dyn Progress,
) -> Result<(OffsetSurfaceLightField, Kept, ThinReport), ThinError> {
    plan.settings.check_original(field.parameters.original).map_err(ThinningError::from)?;
    let name = &field.parameters.object;
    let object = scene.object(name).ok_or_else(|| ThinError::NoObject(name.clone()))?;
    let first_views = validation_views(scene, object, field, plan, 0, progress)?;
    let views = validation_views(scene, object, field, plan, 1, progress)?;
    let tracer = Tracer::new(scene)?;
    let lift = 0.1 * field.parameters.epsilon;
    let visible = |texel: SamplePoint, sample: Vec3| !tracer.occluded(texel.position + lift * texel.normal, sample);
    let metric = plan.metric;
    let error = |shown: Vec3, reference: Vec3| metric.of_pixel(shown, reference);
    let first = Thinning::new(field, plan.settings, source, &first_views, (&error, &visible), progress)?;
    let thinning = Thinning::new(field, plan.settings, source, &views, (&error, &visible), progress)?;
    if first.pixel_count() == 0 || thinning.pixel_count() == 0 {
        return Err(ThinError::Unseen);
    }
    let (bound, before) = (metric.to_mean(plan.max_error), thinning.error_before()?);
    // Phrased so that NaN meets nothing.
    if !(before <= bound) {
        return Err(ThinError::Unmet { error: metric.of_mean(before), max_error: plan.max_error });
    }
    let order = first.order(bound)?;
    let count = field.sample_points.len();
    let texels = |gone: usize, levels: u32| (count - gone + 1) as u64 * (u64::from(field.parameters.face_size_texels) >> levels).pow(2);
    // How many sample points and levels could go, by what is nearest to each pixel.
    let mut choices = Vec::new();
    for levels in 0..=thinning.levels_to_spare() {
        progress.report("choosing the face size", levels.into(), (thinning.levels_to_spare() + 1).into());
        let meets = |gone: usize| Ok::<_, ThinError>(thinning.error_without(&order[..gone].iter().copied().collect(), levels)? <= bound);
        if !meets(0)? {
            break;
        }
        // The most that can go: about monotone.
        let (mut low, mut high) = (0, order.len() + 1);
        while high - low > 1 {
            let middle = (low + high) / 2;
            if meets(middle)? { low = middle } else { high = middle }
        }
        choices.push((low, levels));
    }
    choices.sort_by_key(|(gone, levels)| texels(*gone, *levels));
    let without = |gone: usize, levels: u32| {
        if progress.is_cancelled() {
            return Err(ThinError::from(Cancelled));
        }
        let lost: HashSet<u16> = order[..gone].iter().copied().collect();
        let kept = Kept { points: (0..count as u16).filter(|j| !lost.contains(j)).collect(), levels };
        let thinned = thinning.thinned(&kept);
        let error = thinning.error_of(&thinned, &kept)?;
        let report = ThinReport {
            pixels: thinning.pixel_count(),
            error_before: metric.of_mean(before),
            error: metric.of_mean(error),
            sample_points_before: count,
            sample_points: kept.points.len(),
            face_size_texels_before: field.parameters.face_size_texels,
            face_size_texels: thinned.parameters.face_size_texels,
        };
        Ok((error <= bound, (thinned, kept, report)))
    };
    for (most, levels) in choices {
        let mut gone = most;
        for step in 0..MOST_STEPS_BACK {
            progress.report("building sample maps", step.into(), MOST_STEPS_BACK.into());
            let (keeps_bound, result) = without(gone, levels)?;
            if keeps_bound {
                return Ok(result);
            }
            gone = (STEP_BACK * gone as f64) as usize;
        }
    }
    // All of it, by sample maps built anew: about the error that it had.
    Ok(without(0, 0)?.1)
}

/// The windows that show the object, and their truth.
fn validation_views(
    scene: &Scene,
    object: usize,
    field: &OffsetSurfaceLightField,
    plan: &ThinPlan,
    set: u64,
    progress: &dyn Progress,
) -> Result<Vec<ValidationView>, ThinError> {
    let truths = TruthRenderer::new(scene, object)?;
    let settings = AnySettings::OffsetSurfaceLightField(plan.settings);
    let kind = match (field.parameters.original, plan.settings.component) {
        (Original::AsAuthored, Component::Reconstruction) => Truth::AsAuthored,
        _ => Truth::OneReflection,
    };
    let (low, high) = scene.objects[object].mesh.bounds();
    let distance = DISTANCE_RADII * 0.5 * (high - low).length();
    let places = place_sample_points(&field.surface, Spacing::Count(plan.windows))?;
    let mut views = Vec::new();
    let count = places.len() as u64;
    for (number, place) in (set * count..).zip(&places) {
        progress.report("tracing validation windows", number, 2 * count);
        let Some(camera) = window(place, distance, SampleSequence::new(plan.trace.seed, number, 0).pair()) else { continue };
        let seeded = TraceSettings { seed: plan.trace.seed.wrapping_add(number), ..plan.trace };
        let truth = truths.view(&camera, &[kind], &seeded, &Silent(progress))?;
        let reference = truth.reference(&settings, kind);
        let counts = (0..truth.mask.len()).filter(|at| truth.mask[*at]);
        let pixel =
            |at: usize| ValidationPixel { at: (at as u32 % WINDOW_PX, at as u32 / WINDOW_PX), reference: Vec3::from(reference.rgb(at)) };
        let pixels: Vec<ValidationPixel> = counts.map(pixel).collect();
        if !pixels.is_empty() {
            views.push(ValidationView { camera, pixels });
        }
    }
    Ok(views)
}

/// Looks at a place of the surface from a direction as likely as the place's projected area. None where numbers are too coarse for that.
fn window(place: &SamplePoint, distance: f32, u: Vec2) -> Option<Camera> {
    let (s, t) = place.normal.any_orthonormal_pair();
    let local = cosine_hemisphere(u);
    let direction = local.x * s + local.y * t + local.z * place.normal;
    let up = if direction.y.abs() > 0.99 { Vec3::X } else { Vec3::Y };
    let pose = Pose::look_at(place.position + distance * direction, place.position, up).ok()?;
    let focal = 0.5 * PICTURE_PX / (0.5 * FIELD_OF_VIEW_DEG.to_radians()).tan();
    let center_px = Vec2::splat(0.5 * WINDOW_PX as f32);
    let intrinsics = Intrinsics { width_px: WINDOW_PX, height_px: WINDOW_PX, focal_px: Vec2::splat(focal), center_px };
    Camera::new(intrinsics, pose).ok()
}
