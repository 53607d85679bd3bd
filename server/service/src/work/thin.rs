//! Dataset version to a smaller one.

use lumisphere::evaluate::{ThinPlan, thin};
use lumisphere::raytrace::TraceSettings;
use lumisphere::representations::offset_surface_light_field::{OffsetSurfaceLightField, copy_pages, to_parts};
use lumisphere::representations::{Kind, Settings};
use lumisphere::textures::{Publication, Staging};

use super::Work;
use crate::catalog::OpenedVersion;
use crate::errors::{ApiError, Reason};
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::scenes::inputs;
use crate::wire::datasets::ORIGIN;
use crate::wire::jobs::ThinSpec;

const KIND: Kind = Kind::OffsetSurfaceLightField;
/// What was thinned, and what that did to the error: a part of the version.
const REPORT: &str = "thinning.json";
/// Which cube maps are left: a part, too.
const KEPT: &str = "kept.json";

/// What a version must hold.
pub(super) fn light_field(version: &OpenedVersion) -> Result<&OffsetSurfaceLightField, ApiError> {
    version.representation.as_any().downcast_ref().ok_or_else(|| {
        let (found, expected) = (version.representation.kind().name(), KIND.name());
        ApiError::new(Reason::DatasetKindMismatch, format!("dataset {} holds {found:?}, {expected:?} expected", version.dataset))
    })
}

impl Work {
    pub(super) fn thin(&self, spec: &ThinSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let fill = |staging: &Staging| self.fill_thinned(spec, &*self.open(&spec.dataset, spec.version)?, staging, attempt);
        let thinned = self.publish_once(&spec.into, KIND.name(), attempt, fill)?;
        let outcome = self.published(&spec.into, thinned)?;
        let mut summary: serde_json::Value = serde_json::from_str(&outcome.summary_json).map_err(ApiError::internal)?;
        let report = self.catalog.store().open_version(&spec.into, Some(thinned))?.blob(REPORT)?;
        summary["thinning"] = serde_json::from_slice(&report).map_err(ApiError::internal)?;
        Ok(Outcome { summary_json: summary.to_string(), ..outcome })
    }

    fn fill_thinned(
        &self,
        spec: &ThinSpec,
        version: &OpenedVersion,
        staging: &Staging,
        attempt: &Attempt,
    ) -> Result<Publication, ApiError> {
        let field = light_field(version)?;
        let (source, scene) = self.captured_scene(version)?;
        let Settings::OffsetSurfaceLightField(settings) = spec.settings.settings else {
            return Err(ApiError::internal("settings were checked against the dataset's kind"));
        };
        let plan = ThinPlan {
            settings,
            metric: spec.metric,
            max_error: spec.max_error,
            windows: spec.windows,
            trace: TraceSettings {
                samples_per_pixel: spec.truth_samples_per_pixel,
                max_bounces: field.parameters.max_bounces,
                seed: spec.seed,
            },
        };
        let (thinned, kept, report) = thin(&scene, (field, &version.pages), &plan, attempt)?;
        let stored = &version.pages.version;
        // A page's number means nothing without this: what another attempt staged is of use only for the same.
        let plan_of_pages = serde_json::to_vec(&kept).map_err(ApiError::internal)?;
        match staging.blob(KEPT)? {
            None if staging.pages_present().is_empty() => drop(staging.put_blob(KEPT, &plan_of_pages)?),
            Some(earlier) if earlier == plan_of_pages => {}
            _ => return Err(ApiError::internal("an earlier attempt kept other sample points; submit the job anew")),
        }
        copy_pages((field, stored), (&thinned, &kept), spec.codec, staging, attempt)?;
        for (name, bytes) in to_parts(&thinned).map_err(ApiError::internal)? {
            staging.put_blob(name, &bytes)?;
        }
        staging.put_blob(ORIGIN, &stored.blob(ORIGIN)?)?;
        let told = serde_json::json!({
            "dataset": version.dataset,
            "version": version.version,
            "stored_bytes_before": stored.manifest().stored_bytes(),
            "setting": spec.settings.settings.name(),
            "metric": spec.metric,
            "max_error": spec.max_error,
            "windows": spec.windows,
            "truth_samples_per_pixel": spec.truth_samples_per_pixel,
            "seed": spec.seed,
            "report": report,
        });
        staging.put_blob(REPORT, told.to_string().as_bytes())?;
        Ok(Publication {
            kind: KIND.name().into(),
            parameters: serde_json::to_value(&thinned.parameters).map_err(ApiError::internal)?,
            inputs: inputs(&source),
            code_version: env!("CARGO_PKG_VERSION").into(),
            created_unix_millis: now_millis(),
        })
    }
}
