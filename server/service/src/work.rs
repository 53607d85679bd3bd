//! What jobs do: capture, observe, fit, suggest, evaluate, render a path, thin, replace.

mod capture;
mod evaluate;
mod fit;
mod observe;
mod path_render;
mod publishing;
mod replace;
mod suggest;
mod thin;
mod views;

use std::collections::BTreeSet;
use std::sync::Arc;

use lumisphere::progress::Progress;
use lumisphere::scenes::Scene;
use lumisphere::textures::ContentHash;
use tokio::runtime::Handle;

use crate::catalog::{Catalog, OpenedVersion};
use crate::config::BackendChoice;
use crate::errors::ApiError;
use crate::frames::{Caller, FrameOrder, Frames};
use crate::jobs::{Attempt, JobBody, Outcome, ResultBlob, cancelled};
use crate::render_queue::Priority;
use crate::scenes::{load_scene, scene_of};
use crate::still::Still;
use crate::wire::frames::EncodedFrame;
use crate::wire::jobs::{JobSpec, SpecLimits, job_spec, recalled};
use crate::wire::scenes::SceneSource;

pub use self::fit::no_adapter_to_fit_on;

/// What jobs work with. Runs on the jobs' own threads, never on a tokio worker.
pub struct Work {
    /// Where datasets and results go.
    pub catalog: Arc<Catalog>,
    /// Renders one frame at a time, behind all viewers.
    pub frames: Frames,
    /// To wait for a frame.
    pub runtime: Handle,
    /// What specifications were held to when they were submitted; the configuration may have changed since.
    pub limits: SpecLimits,
    /// Memory that the scene of one job may take.
    pub scene_bytes: u64,
    /// Whether a graphics adapter may be used.
    pub backend: BackendChoice,
}

impl JobBody for Work {
    fn run(&self, spec: &[u8], attempt: &Attempt) -> Result<Outcome, ApiError> {
        match job_spec(Some(recalled(spec)?), &self.limits)? {
            JobSpec::Capture(spec) => self.capture(&spec, attempt),
            JobSpec::Evaluate(spec) => self.evaluate(&spec, attempt),
            JobSpec::PathRender(spec) => self.path_render(&spec, attempt),
            JobSpec::Thin(spec) => self.thin(&spec, attempt),
            JobSpec::Observe(spec) => self.observe(&spec, attempt),
            JobSpec::Fit(spec) => self.fit(&spec, attempt),
            JobSpec::Suggest(spec) => self.suggest(&spec, attempt),
            JobSpec::Replace(spec) => self.replace(&spec, attempt),
        }
    }

    fn forget(&self, results: &[ResultBlob]) {
        let store = self.catalog.store();
        // A result may have become an input since: a rendered environment that lights another capture.
        let manifests =
            store.datasets().into_iter().flat_map(|d| store.versions(&d).unwrap_or_default().into_iter().map(move |v| (d.clone(), v)));
        let inputs: BTreeSet<ContentHash> =
            manifests.filter_map(|(d, v)| store.manifest(&d, Some(v)).ok()).flat_map(|m| m.inputs.into_values()).collect();
        for hash in results.iter().filter_map(|blob| blob.blake3.parse().ok()).filter(|hash| !inputs.contains(hash)) {
            if let Err(error) = store.remove_upload(&hash) {
                tracing::warn!(%error, "cannot remove the result of an old job");
            }
        }
    }
}

impl Work {
    fn open(&self, dataset: &str, version: u64) -> Result<Arc<OpenedVersion>, ApiError> {
        self.catalog.open_version(dataset, version)
    }

    /// Where a version came from, and the scene that it was captured of.
    fn captured_scene(&self, version: &OpenedVersion) -> Result<(SceneSource, Scene), ApiError> {
        let source = scene_of(version)?;
        let scene = load_scene(&source, self.catalog.store(), self.scene_bytes)?;
        Ok((source, scene))
    }

    /// All passes of what is ordered, behind all viewers; a job that is to end does so between two of them.
    fn still(&self, order: FrameOrder, attempt: &Attempt) -> Result<Still, ApiError> {
        let caller = Caller { who: Priority::Batch, deadline: None };
        let mut still = self.runtime.block_on(self.frames.first_pass(order, caller))?;
        while !still.is_done() {
            if attempt.is_cancelled() {
                return Err(cancelled());
            }
            still = self.runtime.block_on(self.frames.next_pass(still, caller))?;
        }
        Ok(still)
    }

    /// As it goes into a file.
    fn encoded(&self, still: Still) -> Result<EncodedFrame, ApiError> {
        Ok(self.runtime.block_on(self.frames.encoded_still(still))?.0)
    }

    /// Keeps a result's bytes.
    fn keep(&self, name: String, media_type: &str, bytes: &[u8]) -> Result<ResultBlob, ApiError> {
        let hash: ContentHash = self.catalog.store().put_upload(bytes)?;
        Ok(ResultBlob { name, media_type: media_type.into(), blake3: hash.to_string(), size_bytes: bytes.len() as u64 })
    }
}
