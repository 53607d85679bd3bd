//! Parameter map to directions worth a photograph.

use std::sync::Arc;

use lumisphere::representations::Kind;
use lumisphere::representations::parameter_map::{Paged, ParameterMap, suggest_directions};

use super::Work;
use super::fit::named_version;
use crate::errors::{ApiError, Reason};
use crate::jobs::{Attempt, Outcome};
use crate::wire::jobs::SuggestSpec;

impl Work {
    pub(super) fn suggest(&self, spec: &SuggestSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let version = self.open(&spec.dataset, spec.version)?;
        let fitted: &ParameterMap = version.representation.as_any().downcast_ref().ok_or_else(|| {
            let (found, expected) = (version.representation.kind().name(), Kind::ParameterMap.name());
            ApiError::new(Reason::DatasetKindMismatch, format!("dataset {} holds {found:?}, {expected:?} expected", version.dataset))
        })?;
        let (observations, number) = named_version(&fitted.parameters.observations)
            .ok_or_else(|| ApiError::internal(format!("{:?} names no observations", fitted.parameters.observations)))?;
        let (observed, pages) = self.catalog.open_observations(observations, number)?;
        let models = |page| version.pages.version.read_page(page).map(Arc::new);
        let observations = |page| pages.read_page(page).map(Arc::new);
        let (fitted, observed) = (Paged { map: fitted, read: &models }, Paged { map: &observed, read: &observations });
        let suggested = suggest_directions(&fitted, &observed, &spec.settings, attempt)?;
        let summary = serde_json::json!({"dataset": version.dataset, "version": version.version, "suggested": suggested});
        Ok(Outcome { published: None, blobs: Vec::new(), summary_json: summary.to_string() })
    }
}
