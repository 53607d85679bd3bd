//! Dataset version to that of another object in the same light.

use lumisphere::representations::offset_surface_light_field::{BAKED_FIRST, Parameters, ReplaceSettings, Shares, replace};
use lumisphere::representations::{Kind, PageSource};
use lumisphere::textures::{PageId, Publication, Staging};

use super::Work;
use super::fit::version_name;
use super::thin::light_field;
use crate::catalog::OpenedVersion;
use crate::errors::ApiError;
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::scenes::{inputs, load_scene};
use crate::wire::datasets::{ORIGIN, Origin};
use crate::wire::jobs::ReplaceSpec;

const KIND: Kind = Kind::OffsetSurfaceLightField;
/// Where the light came from: a part of the version.
const REPORT: &str = "replacing.json";

impl Work {
    pub(super) fn replace(&self, spec: &ReplaceSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let fill = |staging: &Staging| self.fill_replaced(spec, &*self.open(&spec.dataset, spec.version)?, staging, attempt);
        let replaced = self.publish_once(&spec.into, KIND.name(), attempt, fill)?;
        let outcome = self.published(&spec.into, replaced)?;
        let mut summary: serde_json::Value = serde_json::from_str(&outcome.summary_json).map_err(ApiError::internal)?;
        let report = self.catalog.store().open_version(&spec.into, Some(replaced))?.blob(REPORT)?;
        summary["replacing"] = serde_json::from_slice(&report).map_err(ApiError::internal)?;
        Ok(Outcome { summary_json: summary.to_string(), ..outcome })
    }

    fn fill_replaced(
        &self,
        spec: &ReplaceSpec,
        version: &OpenedVersion,
        staging: &Staging,
        attempt: &Attempt,
    ) -> Result<Publication, ApiError> {
        let field = light_field(version)?;
        let scene = load_scene(&spec.scene, self.catalog.store(), self.scene_bytes)?;
        let Parameters { spacing, face_size_texels, sample_map_size_texels, .. } = field.parameters;
        let settings = ReplaceSettings {
            object: spec.object.clone(),
            placement: spec.placement,
            light: version_name(&version.dataset, version.version),
            epsilon: spec.epsilon,
            spacing: spec.spacing.unwrap_or(spacing),
            face_size_texels: spec.face_size_texels.unwrap_or(face_size_texels),
            sample_map_size_texels: spec.sample_map_size_texels.unwrap_or(sample_map_size_texels),
            pixel_format: match spec.pixel_format {
                Some(format) => format,
                None => version.pages.page(PageId(0))?.page.shape().pixel,
            },
            codec: spec.codec,
            rays_per_texel: spec.rays_per_texel,
            order: BAKED_FIRST,
            scene_bytes: self.scene_bytes,
        };
        let (parameters, shares) = replace((field, &version.pages), &scene, &settings, staging, attempt)?;
        staging.put_blob(REPORT, told(version, &shares).to_string().as_bytes())?;
        let Some(object) = scene.object(&spec.object) else { return Err(ApiError::internal("an object that was replaced is gone")) };
        // No scene has this object in this light: nothing is its truth.
        let origin = Origin::new(None, spec.placement.bounds(&scene.objects[object].mesh));
        staging.put_blob(ORIGIN, &origin.to_bytes())?;
        Ok(Publication {
            kind: KIND.name().into(),
            parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
            inputs: inputs(&spec.scene),
            code_version: env!("CARGO_PKG_VERSION").into(),
            created_unix_millis: now_millis(),
        })
    }
}

fn told(version: &OpenedVersion, shares: &Shares) -> serde_json::Value {
    serde_json::json!({"dataset": version.dataset, "version": version.version, "shares": shares})
}
