//! A job's dataset version. Killed at any moment, the job goes on from the pages it has stored, or finds that it had finished.

use lumisphere::progress::Progress;
use lumisphere::textures::{Publication, Staging, StoreError};

use super::Work;
use crate::errors::{ApiError, Reason};
use crate::jobs::{Attempt, Outcome};

impl Work {
    /// Stages a version of `dataset`, lets `fill` fill it, and publishes it; its number. What another attempt has published is not filled again.
    pub(super) fn publish_once(
        &self,
        dataset: &str,
        kind: &str,
        attempt: &Attempt,
        fill: impl FnOnce(&Staging) -> Result<Publication, ApiError>,
    ) -> Result<u64, ApiError> {
        let staging = match self.stage(dataset, kind, attempt)? {
            Ok(staging) => staging,
            // Killed between publishing and recording that.
            Err(version) => return Ok(version),
        };
        match fill(&staging) {
            Ok(publication) => {
                attempt.report("publishing", 0, 1);
                Ok(staging.publish(publication)?.manifest().version)
            }
            Err(error) => {
                // A job that the server's end interrupts goes on from there; any other will not run again.
                let goes_on = error.reason() == Reason::JobCancelled && !attempt.is_cancel_asked();
                if !goes_on && let Err(error) = staging.abandon() {
                    tracing::warn!(%error, dataset, "cannot throw away what an ended job has staged");
                }
                Err(error)
            }
        }
    }

    /// The dataset's write lock and what an earlier attempt stored; or the version that it had published.
    fn stage(&self, dataset: &str, kind: &str, attempt: &Attempt) -> Result<Result<Staging, u64>, ApiError> {
        let store = self.catalog.store();
        match store.create_dataset(dataset) {
            Ok(()) | Err(StoreError::AlreadyExists { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        if let Ok(manifest) = store.manifest(dataset, None)
            && manifest.kind != kind
        {
            let message = format!("dataset {dataset} holds {:?}, this job makes {kind:?}", manifest.kind);
            return Err(ApiError::new(Reason::DatasetKindMismatch, message));
        }
        match store.stage(dataset, &attempt.token()) {
            Err(StoreError::AlreadyPublished { version, .. }) => Ok(Err(version)),
            staging => Ok(Ok(staging?)),
        }
    }

    /// What the job tells of it.
    pub(super) fn published(&self, dataset: &str, version: u64) -> Result<Outcome, ApiError> {
        let manifest = self.catalog.manifest(dataset, version)?;
        let summary = serde_json::json!({
            "dataset": dataset,
            "version": version,
            "pages": manifest.pages.count,
            "stored_bytes": manifest.stored_bytes(),
            "parameters": manifest.parameters,
        });
        Ok(Outcome { published: Some((dataset.into(), version)), blobs: Vec::new(), summary_json: summary.to_string() })
    }
}
