//! Dataset version to a table of errors against path-traced truth.

use std::collections::BTreeSet;
use std::time::Instant;

use lumisphere::evaluate::{self, Picture, Plan, Rendered as RenderedView};
use lumisphere::geometry::Camera;
use lumisphere::images::{ExrStorage, ToneMap, encode_exr_rgb, encode_png, tone_mapped};
use lumisphere::raytrace::TraceSettings;
use lumisphere::render::Refine;

use super::Work;
use super::views::cameras;
use crate::errors::ApiError;
use crate::frames::{FrameOrder, color_image};
use crate::jobs::{Attempt, Outcome, ResultBlob};
use crate::wire::jobs::{EvaluateSpec, Truth};
use crate::wire::settings::{Encoding, Output};

/// Pictures of the first view are kept as EXR too; all are kept as PNG.
const EXR_PREFIX: &str = "view-00-";

impl Work {
    pub(super) fn evaluate(&self, spec: &EvaluateSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let version = self.open(&spec.dataset, spec.version)?;
        let (_, scene) = self.captured_scene(&version)?;
        let manifest = version.pages.version.manifest();
        let captured = version.representation.captured();
        let tables: BTreeSet<_> = spec.settings.iter().filter_map(|s| s.settings.brdf()?.table()).collect();
        if tables.len() > evaluate::MOST_LOOKS {
            let problem = format!("{} measured BRDFs, at most {} expected", tables.len(), evaluate::MOST_LOOKS);
            return Err(ApiError::field("spec.evaluate.settings", problem));
        }
        let tables = tables.into_iter().map(|hash| Ok((hash, version.looks.tables.get(hash)?)));
        let normal_maps: BTreeSet<_> = spec.settings.iter().filter_map(|s| Some(s.settings.bumps()?.map)).collect();
        if normal_maps.len() > evaluate::MOST_STAGINGS {
            let problem = format!("{} normal maps, at most {} expected", normal_maps.len(), evaluate::MOST_STAGINGS);
            return Err(ApiError::field("spec.evaluate.settings", problem));
        }
        let normal_maps = normal_maps.into_iter().map(|hash| Ok((hash, version.looks.normal_maps.get(hash)?)));
        let plan = Plan {
            object: captured.object.into(),
            original: captured.original,
            cameras: cameras(&spec.views, &version)?,
            settings: spec.settings.iter().map(|s| s.settings).collect(),
            mirror_truths: spec.truths.iter().map(|t| truth(*t)).collect(),
            trace: TraceSettings {
                samples_per_pixel: spec.truth_samples_per_pixel,
                max_bounces: spec.max_bounces.unwrap_or(captured.max_bounces),
                seed: spec.seed,
            },
            timed_frames: spec.timed_frames_per_view,
            tables: tables.collect::<Result<_, ApiError>>()?,
            normal_maps: normal_maps.collect::<Result<_, ApiError>>()?,
        };
        let mut blobs = Vec::new();
        let mut render = |camera: &Camera, setting: usize| {
            let output = Output { encoding: Encoding::RawZstd, encoding_at_rest: None, depth: None, provenance: false };
            let (version, settings, refine) = (version.clone(), spec.settings[setting], Refine::Whole);
            let passes = settings.passes;
            let still = self.still(
                FrameOrder { version, camera: *camera, settings, output, opening_micros: 0, refine, passes, video: None },
                attempt,
            )?;
            let color = color_image(&still);
            Ok::<_, ApiError>(RenderedView { color, millis: still.millis, backend: still.backend, device_bytes: still.device_bytes })
        };
        let mut keep = |picture: Picture<'_>| self.keep_picture(picture, &mut blobs);
        let begun = Instant::now();
        let rows = evaluate::evaluate(&scene, &plan, &mut render, &mut keep, attempt)?;
        let report = serde_json::json!({
            "dataset": version.dataset,
            "version": version.version,
            "kind": manifest.kind,
            "parameters": manifest.parameters,
            "dataset_bytes": manifest.stored_bytes(),
            "views": plan.cameras.len(),
            "timed_frames_per_view": plan.timed_frames,
            "truth_samples_per_pixel": plan.trace.samples_per_pixel,
            "max_bounces": plan.trace.max_bounces,
            "seconds": begun.elapsed().as_secs_f64(),
            "rows": rows,
        });
        let summary_json = report.to_string();
        blobs.push(self.keep("report.json".into(), "application/json", summary_json.as_bytes())?);
        blobs.push(self.keep("report.csv".into(), "text/csv", evaluate::csv(&rows).map_err(ApiError::internal)?.as_bytes())?);
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
