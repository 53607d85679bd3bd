//! Dataset version to a table of errors against path-traced truth.

use std::time::Instant;

use lumisphere::evaluate::{self, Picture, Plan, Rendered as RenderedView, Row};
use lumisphere::geometry::Camera;
use lumisphere::images::{ExrStorage, ToneMap, encode_exr_rgb, encode_png, tone_mapped};
use lumisphere::raytrace::TraceSettings;
use lumisphere::render::Refine;
use lumisphere::representations::Settings;

use super::Work;
use super::scene::load_scene;
use super::views::cameras;
use crate::errors::{ApiError, Reason};
use crate::frames::{FrameOrder, color_image};
use crate::jobs::{Attempt, Outcome, ResultBlob};
use crate::render_queue::Priority;
use crate::wire::jobs::{EvaluateSpec, Truth};
use crate::wire::scenes::scene_source;
use crate::wire::settings::{Encoding, Output};

/// Pictures of the first view are kept as EXR too; all are kept as PNG.
const EXR_PREFIX: &str = "view-00-";

/// What a capture records of itself that an evaluation needs.
#[derive(serde::Deserialize)]
struct Captured {
    object: String,
    max_bounces: u32,
}

impl Work {
    pub(super) fn evaluate(&self, spec: &EvaluateSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let version = self.open(&spec.dataset, spec.version)?;
        let source = version.origin.as_ref().and_then(|o| o.scene()).ok_or_else(|| {
            let message = format!("dataset {} version {} does not say from which scene it was captured", spec.dataset, version.version);
            ApiError::new(Reason::DatasetKindMismatch, message)
        })?;
        let scene = load_scene(&scene_source(Some(source.clone()), "scene")?, self.catalog.store())?;
        let manifest = version.pages.version.manifest();
        let captured: Captured = serde_json::from_value(manifest.parameters.clone()).map_err(ApiError::internal)?;
        let plan = Plan {
            object: captured.object,
            cameras: cameras(&spec.views, &version)?,
            settings: spec.settings.iter().map(|s| s.settings).collect(),
            mirror_truths: spec.truths.iter().map(|t| truth(*t)).collect(),
            trace: TraceSettings {
                samples_per_pixel: spec.truth_samples_per_pixel,
                max_bounces: spec.max_bounces.unwrap_or(captured.max_bounces),
                seed: spec.seed,
            },
        };
        let mut blobs = Vec::new();
        let mut render = |camera: &Camera, settings: &Settings| {
            // The setting as submitted: it says on which backend too.
            let settings = spec.settings.iter().find(|s| s.settings == *settings).copied();
            let settings = settings.ok_or_else(|| ApiError::internal("an evaluation asked for a setting that was not submitted"))?;
            let output = Output { encoding: Encoding::RawZstd, depth: false, provenance: false };
            let order =
                FrameOrder { version: version.clone(), camera: *camera, settings, output, opening_micros: 0, refine: Refine::Whole };
            let (rendered, _) = self.runtime.block_on(self.frames.render(order, Priority::Batch, None))?;
            let frame = &rendered.value;
            Ok(RenderedView { color: color_image(frame), millis: frame.stats.total_millis })
        };
        let mut keep = |picture: Picture<'_>| self.keep_picture(picture, &mut blobs);
        let begun = Instant::now();
        let rows = evaluate::evaluate(&scene, &plan, &mut render, &mut keep, attempt)?;
        let report = serde_json::json!({
            "dataset": version.dataset,
            "version": version.version,
            "parameters": manifest.parameters,
            "views": plan.cameras.len(),
            "truth_samples_per_pixel": plan.trace.samples_per_pixel,
            "max_bounces": plan.trace.max_bounces,
            "seconds": begun.elapsed().as_secs_f64(),
            "rows": rows,
        });
        let summary_json = report.to_string();
        blobs.push(self.keep("report.json".into(), "application/json", summary_json.as_bytes())?);
        blobs.push(self.keep("report.csv".into(), "text/csv", csv(&rows)?.as_bytes())?);
        blobs.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Outcome { published: None, blobs, summary_json })
    }

    fn keep_picture(&self, picture: Picture<'_>, blobs: &mut Vec<ResultBlob>) -> Result<(), ApiError> {
        let Picture { name, image } = picture;
        let png = tone_mapped(image, ToneMap::PLAIN).and_then(|codes| encode_png(&codes)).map_err(ApiError::internal)?;
        blobs.push(self.keep(format!("{name}.png"), "image/png", &png)?);
        if name.starts_with(EXR_PREFIX) {
            let exr = encode_exr_rgb(image, ExrStorage::Float).map_err(ApiError::internal)?;
            blobs.push(self.keep(format!("{name}.exr"), "image/x-exr", &exr)?);
        }
        Ok(())
    }
}

fn truth(truth: Truth) -> evaluate::Truth {
    match truth {
        Truth::OneReflection => evaluate::Truth::OneReflection,
        Truth::PhysicalMirror => evaluate::Truth::PhysicalMirror,
    }
}

/// The rows' members as columns, nested ones joined by a dot.
fn csv(rows: &[Row]) -> Result<String, ApiError> {
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        let mut cells = Vec::new();
        flatten("", &serde_json::to_value(row).map_err(ApiError::internal)?, &mut cells);
        let line = |cells: Vec<&str>| cells.join(",") + "\n";
        if i == 0 {
            text += &line(cells.iter().map(|(name, _)| name.as_str()).collect());
        }
        text += &line(cells.iter().map(|(_, value)| value.as_str()).collect());
    }
    Ok(text)
}

fn flatten(name: &str, value: &serde_json::Value, cells: &mut Vec<(String, String)>) {
    use serde_json::Value;
    let below = |key: &str| if name.is_empty() { key.to_string() } else { format!("{name}.{key}") };
    match value {
        Value::Object(members) => members.iter().for_each(|(key, v)| flatten(&below(key), v, cells)),
        Value::Array(items) => items.iter().enumerate().for_each(|(i, v)| flatten(&below(&i.to_string()), v, cells)),
        Value::Null => cells.push((name.into(), String::new())),
        // Names and numbers: no commas, no quotes.
        Value::String(text) => cells.push((name.into(), text.clone())),
        other => cells.push((name.into(), other.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nested_members_become_columns() {
        let mut cells = Vec::new();
        let row = serde_json::json!({ "component": "mirror", "exponent": null, "rmse": { "lab": [0.5, 1.0] } });
        flatten("", &row, &mut cells);
        let cells: Vec<(&str, &str)> = cells.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
        assert_eq!(cells, [("component", "mirror"), ("exponent", ""), ("rmse.lab.0", "0.5"), ("rmse.lab.1", "1.0")]);
    }
}
