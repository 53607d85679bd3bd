//! How far rendered frames are from path-traced truth, at poses that the capture did not use.

mod truth;

use serde::Serialize;
use thiserror::Error;

use crate::geometry::Camera;
use crate::images::{CompareError, CompareOptions, Comparison, Image, absolute_error_image, compare};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{TraceError, TraceSettings};
use crate::representations::{SettingName, Settings};
use crate::scenes::Scene;

pub use truth::{Truth, TruthRenderer, ViewTruth};

/// What to measure.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Name of the object whose pixels count.
    pub object: String,
    /// Held-out poses.
    pub cameras: Vec<Camera>,
    /// Settings to render with.
    pub settings: Vec<Settings>,
    /// What settings that show reflections are compared with, one row each.
    pub mirror_truths: Vec<Truth>,
    /// Paths per pixel, bounces and seed of the truth.
    pub trace: TraceSettings,
}

/// One setting against one truth, over all views.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// What was shown and how: component, blend, exponent.
    #[serde(flatten)]
    pub setting: SettingName,
    /// What it was compared with.
    pub truth: Truth,
    /// How many views.
    pub views: usize,
    /// Over the object's pixels of all views; FLIP, SSIM, PSNR and percentiles are means of the views' own, weighted by pixels.
    #[serde(flatten)]
    pub error: Comparison,
    /// Median time of a frame.
    pub millis_per_frame: f64,
}

/// A rendered frame, as far as the evaluation needs it.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// Three channels, linear.
    pub color: Image,
    /// Time inside the renderer.
    pub millis: f64,
}

/// An image worth keeping.
#[derive(Debug)]
pub struct Picture<'a> {
    /// `view-00-mirror-reflection-4-one_reflection-error` and the like; unique within an evaluation.
    pub name: String,
    /// Three channels; linear radiance, or (for errors) absolute difference.
    pub image: &'a Image,
}

/// Why nothing was measured; `E` is the renderer's own error.
#[derive(Debug, Error)]
pub enum EvaluateError<E: std::error::Error> {
    /// The scene has no such object, no camera or no setting was given.
    #[error("{0}")]
    Plan(String),
    /// The scene cannot be traced.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// Asked to stop.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// A frame cannot be compared.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A frame or picture could not be made or kept.
    #[error(transparent)]
    Other(E),
}

/// Renders every setting at every camera through `render`, compares with the truth, and hands pictures to `keep`.
///
/// Only pixels count that show the object and whose eight neighbours show the same fold of it: at silhouettes, inner ones too, a box-filtered
/// truth and a frame that sees one point a pixel differ by definition.
pub fn evaluate<E: std::error::Error>(
    scene: &Scene,
    plan: &Plan,
    render: &mut dyn FnMut(&Camera, &Settings) -> Result<Rendered, E>,
    keep: &mut dyn FnMut(Picture<'_>) -> Result<(), E>,
    progress: &dyn Progress,
) -> Result<Vec<Row>, EvaluateError<E>> {
    if plan.cameras.is_empty() || plan.settings.is_empty() {
        return Err(EvaluateError::Plan("at least one camera and one setting expected".into()));
    }
    let object = scene.object(&plan.object).ok_or_else(|| EvaluateError::Plan(format!("scene has no object {:?}", plan.object)))?;
    let truths = TruthRenderer::new(scene, object)?;
    let pairs = pairs(plan);
    let mut totals: Vec<Total> = pairs.iter().map(|_| Total::default()).collect();
    let steps = (plan.cameras.len() * (pairs.len() + 1)) as u64;
    let mut done = 0;
    for (v, camera) in plan.cameras.iter().enumerate() {
        progress.report("tracing the truth", done, steps);
        let wanted: Vec<Truth> = pairs.iter().map(|(_, t)| *t).collect();
        let view = truths.view(camera, &wanted, &plan.trace, progress)?;
        if !view.mask.contains(&true) {
            return Err(EvaluateError::Plan(format!("camera {v} shows no pixel of object {:?} with all its neighbours", plan.object)));
        }
        done += 1;
        let mut kept: Vec<String> = Vec::new();
        for ((settings, truth), total) in pairs.iter().zip(&mut totals) {
            progress.report("rendering and comparing", done, steps);
            if progress.is_cancelled() {
                return Err(Cancelled.into());
            }
            let reference = view.reference(settings, *truth);
            let rendered = render(camera, settings).map_err(EvaluateError::Other)?;
            let comparison = compare(&reference, &rendered.color, Some(&view.mask), CompareOptions::STANDARD)?;
            total.add(comparison, rendered.millis);
            let error = absolute_error_image(&reference, &rendered.color)?;
            let setting = settings.name();
            let (component, truth) = (setting.component, truth.name());
            for (name, image) in [
                (format!("view-{v:02}-{component}-{truth}-truth"), &reference),
                (format!("view-{v:02}-{}-frame", setting.slug()), &rendered.color),
                (format!("view-{v:02}-{}-{truth}-error", setting.slug()), &error),
            ] {
                if !kept.contains(&name) {
                    keep(Picture { name: name.clone(), image }).map_err(EvaluateError::Other)?;
                    kept.push(name);
                }
            }
            done += 1;
        }
    }
    progress.report("rendering and comparing", steps, steps);
    Ok(pairs.iter().zip(totals).map(|((settings, truth), total)| total.row(settings.name(), *truth)).collect())
}

// Which setting is compared with which truth: what shows no reflection has one truth only.
fn pairs(plan: &Plan) -> Vec<(Settings, Truth)> {
    let mut pairs = Vec::new();
    for settings in &plan.settings {
        if settings.name().blend.is_none() {
            pairs.push((*settings, Truth::Diffuse));
        } else {
            pairs.extend(plan.mirror_truths.iter().map(|t| (*settings, *t)));
        }
    }
    pairs
}

// What was measured, view by view.
#[derive(Default)]
struct Total {
    views: Vec<Comparison>,
    millis: Vec<f64>,
}

impl Total {
    fn add(&mut self, comparison: Comparison, millis: f64) {
        self.views.push(comparison);
        self.millis.push(millis);
    }

    fn row(mut self, setting: SettingName, truth: Truth) -> Row {
        self.millis.sort_by(f64::total_cmp);
        Row {
            setting,
            truth,
            views: self.views.len(),
            error: over_views(&self.views),
            millis_per_frame: self.millis[self.millis.len() / 2],
        }
    }
}

// One comparison for several, each weighted by its pixels. Root mean squares are exact; the others are means of the views' own.
fn over_views(views: &[Comparison]) -> Comparison {
    let pixels: usize = views.iter().map(|c| c.pixels).sum();
    let mean = |value: &dyn Fn(&Comparison) -> f64| views.iter().map(|c| value(c) * c.pixels as f64).sum::<f64>() / pixels as f64;
    let root_mean_square = |value: &dyn Fn(&Comparison) -> f64| mean(&|c| value(c).powi(2)).sqrt();
    let optional_mean = |value: &dyn Fn(&Comparison) -> Option<f64>| {
        views.iter().all(|c| value(c).is_some()).then(|| mean(&|c| value(c).unwrap_or_default()))
    };
    Comparison {
        pixels,
        rmse_rgb: [0, 1, 2].map(|k| root_mean_square(&|c| c.rmse_rgb[k])),
        rmse_lab: [0, 1, 2].map(|k| root_mean_square(&|c| c.rmse_lab[k])),
        max_abs_error: views.iter().map(|c| c.max_abs_error).fold(0.0, f64::max),
        psnr_db: optional_mean(&|c| c.psnr_db),
        ssim: optional_mean(&|c| c.ssim),
        flip_mean: mean(&|c| c.flip_mean),
        delta_e_2000_mean: mean(&|c| c.delta_e_2000_mean),
        delta_e_2000_p95: mean(&|c| c.delta_e_2000_p95),
    }
}
