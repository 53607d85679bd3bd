//! Observation map to parameter map.

use std::collections::BTreeMap;

use lumisphere::representations::Kind;
use lumisphere::representations::parameter_map::construct;
use lumisphere::textures::{ContentHash, Publication, Staging};

use super::Work;
use crate::errors::ApiError;
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, Outcome};
use crate::wire::datasets::ORIGIN;
use crate::wire::jobs::FitSpec;

const KIND: Kind = Kind::ParameterMap;
/// What came of the fits: a part of the version.
const REPORT: &str = "fit.json";

impl Work {
    pub(super) fn fit(&self, spec: &FitSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let fill = |staging: &Staging| self.fill_fitted(spec, staging, attempt);
        let version = self.publish_once(&spec.dataset, KIND.name(), attempt, fill)?;
        let outcome = self.published(&spec.dataset, version)?;
        let mut summary: serde_json::Value = serde_json::from_str(&outcome.summary_json).map_err(ApiError::internal)?;
        let report = self.catalog.store().open_version(&spec.dataset, Some(version))?.blob(REPORT)?;
        summary["fit"] = serde_json::from_slice(&report).map_err(ApiError::internal)?;
        Ok(Outcome { summary_json: summary.to_string(), ..outcome })
    }

    fn fill_fitted(&self, spec: &FitSpec, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let (map, pages) = self.catalog.open_observations(&spec.observations, spec.version)?;
        let manifest = pages.manifest();
        let name = format!("{} version {}", manifest.dataset, manifest.version);
        let read = |page| pages.read_page(page).map(std::sync::Arc::new);
        let (parameters, report) = construct(&map, &read, &name, &spec.settings, staging, attempt)?;
        if let Some(origin) = manifest.blobs.contains_key(ORIGIN).then(|| pages.blob(ORIGIN)).transpose()? {
            staging.put_blob(ORIGIN, &origin)?;
        }
        staging.put_blob(REPORT, &serde_json::to_vec(&report).map_err(ApiError::internal)?)?;
        let inputs: BTreeMap<String, ContentHash> = manifest.inputs.clone();
        Ok(Publication {
            kind: KIND.name().into(),
            parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
            inputs,
            code_version: env!("CARGO_PKG_VERSION").into(),
            created_unix_millis: now_millis(),
        })
    }
}
