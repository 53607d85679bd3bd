//! How far rendered frames are from path-traced truth, at poses that the capture did not use; what that says over many datasets and settings
//! (`sweep`), drawn (`chart`, `report`), and which setting follows from it (`choose`).

#[cfg(test)]
mod bumps_tests;
#[cfg(test)]
mod capture_to_truth_tests;
mod chart;
mod choose;
mod csv;
pub mod fits;
mod metric;
pub mod pareto;
#[cfg(test)]
mod relighting_tests;
#[cfg(test)]
mod replacing_tests;
mod report;
mod row;
#[cfg(test)]
mod stability_tests;
mod sweep;
mod thin;
mod truth;
mod truth_passes;

use std::collections::BTreeMap;
use std::sync::Arc;

use thiserror::Error;

use crate::geometry::{Camera, NormalMap};
use crate::images::{CompareError, CompareOptions, Image, absolute_error_image, compare};
use crate::progress::{Cancelled, Progress};
use crate::radiometry::brdf::{BrdfModel, Measured};
use crate::radiometry::dielectric::Dielectric;
use crate::raytrace::{Mirrors, TraceError, TraceSettings};
use crate::render::Backend;
use crate::representations::offset_surface_light_field::{Bumps, GlossBrdf};
use crate::representations::{Original, Settings};
use crate::scenes::{Relighting, Scene};
use crate::textures::ContentHash;
use row::Total;

pub use chart::{chart, on_front};
pub use choose::{Bounds, ChooseError, choose};
pub use csv::csv;
pub use metric::Metric;
pub use report::{picture_path, report};
pub use row::{PictureNames, Row};
pub use sweep::{Conditions, Group, SWEEP_FORMAT, Sweep, SweepError, SweepRow, bytes_text};
pub use thin::{ThinError, ThinMetric, ThinPlan, ThinReport, thin};
pub use truth::{Truth, TruthRenderer, ViewTruth};
pub use truth_passes::{MOST_PATHS_PER_PASS, MOST_PATHS_PER_PIXEL, MOST_TRUTH_PASSES, TruthError, TruthPass, TruthPasses};

/// What to measure.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Name of the object whose pixels count.
    pub object: String,
    /// What it looked like while it was captured.
    pub original: Original,
    /// Held-out poses.
    pub cameras: Vec<Camera>,
    /// Settings to render with.
    pub settings: Vec<Settings>,
    /// What settings that show reflections are compared with, one row each.
    pub mirror_truths: Vec<Truth>,
    /// Paths per pixel, bounces and seed of the truth.
    pub trace: TraceSettings,
    /// Frames of each setting at each camera whose time counts; at least 1.
    pub timed_frames: u32,
    /// Of the settings' measured BRDFs.
    pub tables: BTreeMap<ContentHash, Arc<Measured>>,
    /// Of the settings' bumps.
    pub normal_maps: BTreeMap<ContentHash, Arc<NormalMap>>,
}

impl Plan {
    fn model<E: std::error::Error>(&self, brdf: GlossBrdf) -> Result<BrdfModel, EvaluateError<E>> {
        let table = brdf.table().and_then(|hash| self.tables.get(&hash));
        brdf.model(table).ok_or_else(|| EvaluateError::Plan(format!("{brdf:?} without its table")))
    }

    fn normal_map<E: std::error::Error>(&self, bumps: &Bumps) -> Result<Arc<NormalMap>, EvaluateError<E>> {
        let missing = || EvaluateError::Plan(format!("normal map {} expected, which is not there", bumps.map));
        self.normal_maps.get(&bumps.map).cloned().ok_or_else(missing)
    }
}

/// A rendered frame, as far as the evaluation needs it.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// Three channels, linear.
    pub color: Image,
    /// Time inside the renderer.
    pub millis: f64,
    /// What computed it.
    pub backend: Backend,
    /// Held on the device for the dataset; None on the CPU.
    pub device_bytes: Option<u64>,
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

/// Renders every setting at every camera through `render`, which gets the setting's place in the plan, compares with the truth, and hands
/// pictures to `keep`. Each setting's first frame at a camera, which compiles pipelines and brings pages, does not count as time.
///
/// Only pixels count that show the front of the object and whose eight neighbours show the same fold of it: at silhouettes, inner ones too, a
/// box-filtered truth and a frame that sees one point a pixel differ by definition, and of a surface's back nothing is captured.
pub fn evaluate<E: std::error::Error>(
    scene: &Scene,
    plan: &Plan,
    render: &mut dyn FnMut(&Camera, usize) -> Result<Rendered, E>,
    keep: &mut dyn FnMut(Picture<'_>) -> Result<(), E>,
    progress: &dyn Progress,
) -> Result<Vec<Row>, EvaluateError<E>> {
    if plan.cameras.is_empty() || plan.settings.is_empty() || plan.timed_frames == 0 {
        return Err(EvaluateError::Plan("at least one camera, one setting and one timed frame expected".into()));
    }
    let mut looks = Vec::new();
    for look in plan
        .settings
        .iter()
        .map(|s| (s.brdf(), s.dielectric(), several(s), s.light(), s.bumps()))
        .filter(|(brdf, body, mirrors, _, _)| brdf.is_some() || body.is_some() || mirrors.is_some())
    {
        if !looks.contains(&look) {
            looks.push(look);
        }
    }
    if looks.len() > MOST_LOOKS {
        let problem = format!(
            "{} BRDFs, clear bodies and mirrors that see themselves, each in its light, at most {MOST_LOOKS} expected",
            looks.len()
        );
        return Err(EvaluateError::Plan(problem));
    }
    for camera in &plan.cameras {
        plan.settings.iter().try_for_each(|s| s.check_frame(camera)).map_err(|e| EvaluateError::Plan(e.to_string()))?;
    }
    let object = scene.object(&plan.object).ok_or_else(|| EvaluateError::Plan(format!("scene has no object {:?}", plan.object)))?;
    let mut stagings: Vec<Staging> = Vec::new();
    for staging in plan.settings.iter().map(staging) {
        if !stagings.contains(&staging) {
            stagings.push(staging);
        }
    }
    if stagings.len() > MOST_STAGINGS {
        let problem = format!("settings in {} different lights, each with a normal map, at most {MOST_STAGINGS} expected", stagings.len());
        return Err(EvaluateError::Plan(problem));
    }
    let as_captured = TruthRenderer::new(scene, object)?;
    let slugs = slugs(&plan.settings);
    let mut totals: Vec<Total> = plan.settings.iter().map(|s| Total::new(truths_of(s, plan))).collect();
    let steps = (plan.cameras.len() * (plan.settings.len() + 1)) as u64;
    let mut done = 0;
    for (v, camera) in plan.cameras.iter().enumerate() {
        progress.report("tracing the truth", done, steps);
        let mut views = Vec::with_capacity(stagings.len());
        for (light, bumps) in &stagings {
            // Made anew for each camera: of the sky's tables there are never more than two.
            let mut truths = as_captured.relit(scene, light);
            if let Some(bumps) = bumps {
                truths = truths.with_normal_map(plan.normal_map(bumps)?, bumps.mapping);
            }
            let lit: Vec<&Settings> = plan.settings.iter().filter(|s| staging(s) == (*light, *bumps)).collect();
            let wanted: Vec<Truth> = lit.iter().flat_map(|s| truths_of(s, plan)).collect();
            let brdfs = lit.iter().filter_map(|s| s.brdf()).map(|brdf| Ok((brdf, plan.model(brdf)?)));
            let brdfs: Vec<(GlossBrdf, BrdfModel)> = brdfs.collect::<Result<_, EvaluateError<E>>>()?;
            let mut view = truths.view(camera, &wanted, &plan.trace, progress)?;
            truths.add_glossy(&mut view, camera, &brdfs, &plan.trace, progress)?;
            let bodies: Vec<Dielectric> = lit.iter().filter_map(|s| s.dielectric()).collect();
            truths.add_clear(&mut view, camera, &bodies, &plan.trace, progress)?;
            let mirrors: Vec<Mirrors> = lit.iter().filter_map(|s| several(s)).collect();
            truths.add_mirrors(&mut view, camera, &mirrors, &plan.trace, progress)?;
            views.push(view);
        }
        if !views[0].mask.contains(&true) {
            return Err(EvaluateError::Plan(format!("camera {v} shows no pixel of object {:?} with all its neighbours", plan.object)));
        }
        done += 1;
        let mut keep_new = keep_each_once(keep);
        for (s, total) in totals.iter_mut().enumerate() {
            progress.report("rendering and comparing", done, steps);
            let frame = timed(plan.timed_frames, total, progress, &mut || render(camera, s))?;
            let settings = &plan.settings[s];
            let of_setting = stagings.iter().position(|known| *known == staging(settings));
            let view = &views[of_setting.expect("gathered from the settings")];
            for truth in truths_of(settings, plan) {
                let reference = view.reference(settings, truth);
                total.add(truth, compare(&reference, &frame, Some(&view.mask), CompareOptions::STANDARD)?);
                let error = absolute_error_image(&reference, &frame)?;
                let names = PictureNames::new(v, &settings.name(), &slugs[s], truth);
                for (name, image) in [(names.truth, &reference), (names.frame, &frame), (names.error, &error)] {
                    keep_new(name, image).map_err(EvaluateError::Other)?;
                }
            }
            done += 1;
        }
    }
    progress.report("rendering and comparing", steps, steps);
    let of_setting = |(i, total): (usize, Total)| total.rows(i, plan.settings[i].name(), &slugs[i]);
    Ok(totals.into_iter().enumerate().flat_map(of_setting).collect())
}

/// In which light, and with which normals, a truth is traced.
type Staging = (Relighting, Option<Bumps>);

fn staging(settings: &Settings) -> Staging {
    (settings.light(), settings.bumps())
}

/// A view's truths are held together: one picture a BRDF, clear body or mirror that sees itself, light and normal map.
pub const MOST_LOOKS: usize = 8;
/// And up to three of each light and normal map.
pub const MOST_STAGINGS: usize = 4;

// What a setting is compared with: what is no mirror has one truth only.
fn truths_of(settings: &Settings, plan: &Plan) -> Vec<Truth> {
    if settings.dielectric().is_some() {
        return vec![Truth::OneRefraction];
    }
    let of_mirror = |truth: &Truth| match truth {
        Truth::OneReflection if several(settings).is_some() => Truth::SeveralReflections,
        other => *other,
    };
    match (settings.brdf(), settings.mirrors()) {
        (Some(_), _) => vec![Truth::OneGlossyReflection],
        (None, None) if plan.original == Original::AsAuthored => vec![Truth::AsAuthored],
        (None, None) => vec![Truth::Diffuse],
        (None, Some(_)) => plan.mirror_truths.iter().map(of_mirror).collect(),
    }
}

// Of a mirror that sees itself.
fn several(settings: &Settings) -> Option<Mirrors> {
    settings.mirrors().filter(|mirrors| mirrors.reflections > 1)
}

// Names for files, unique among the settings: those that differ in nothing that is named (reflectance, backend) are numbered.
fn slugs(settings: &[Settings]) -> Vec<String> {
    let mut slugs: Vec<String> = Vec::new();
    for setting in settings {
        let slug = setting.name().slug();
        let numbered = (2..).map(|n| format!("{slug}-{n}"));
        let free = std::iter::once(slug.clone()).chain(numbered).find(|name| !slugs.contains(name));
        slugs.extend(free);
    }
    slugs
}

// Several frames of one setting at one camera, their times added to `total`; returns the first frame's pixels, which does not count.
fn timed<E: std::error::Error>(
    count: u32,
    total: &mut Total,
    progress: &dyn Progress,
    render: &mut dyn FnMut() -> Result<Rendered, E>,
) -> Result<Image, EvaluateError<E>> {
    let first = render().map_err(EvaluateError::Other)?;
    for _ in 0..count {
        if progress.is_cancelled() {
            return Err(Cancelled.into());
        }
        total.add_frame(&render().map_err(EvaluateError::Other)?);
    }
    Ok(first.color)
}

// Settings of one view share a truth, truths share a frame.
fn keep_each_once<'a, E>(keep: &'a mut dyn FnMut(Picture<'_>) -> Result<(), E>) -> impl FnMut(String, &Image) -> Result<(), E> + 'a {
    let mut kept: Vec<String> = Vec::new();
    move |name, image| {
        if kept.contains(&name) {
            return Ok(());
        }
        kept.push(name.clone());
        keep(Picture { name, image })
    }
}
