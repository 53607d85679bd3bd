//! Observation map to parameter map.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use lumisphere::fitting::LobeKernel;
use lumisphere::gpu::{Gpu, GpuError};
use lumisphere::progress::Progress;
use lumisphere::render::Backend;
use lumisphere::representations::Kind;
use lumisphere::representations::parameter_map::{FitError, FitSource, FitSummary, FollowFit, Parameters, PartialMap, Solver, construct};
use lumisphere::textures::{Manifest, Publication, Staging, StoreError};

use super::Work;
use crate::config::BackendChoice;
use crate::errors::{ApiError, Reason};
use crate::jobs::record::now_millis;
use crate::jobs::{Attempt, FitSoFar, Outcome};
use crate::wire::datasets::ORIGIN;
use crate::wire::jobs::FitSpec;

const KIND: Kind = Kind::ParameterMap;
/// What came of the fits: a part of the version.
const REPORT: &str = "fit.json";
/// All models are packed anew for each partial map: between two of them passes at least so many times what the last one took, so that all of them
/// together take at most a tenth of the fit's time however many there are.
const PAUSE: u32 = 9;
/// A report takes no more: thirty counts and a dozen numbers.
const REPORT_BYTES: u64 = 2048;

impl Work {
    pub(super) fn fit(&self, spec: &FitSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let fill = |staging: &Staging| self.fill_fitted(spec, staging, attempt);
        let published = self.publish_once(&spec.dataset, KIND.name(), attempt, fill);
        // A fit that the server's end interrupts goes on: what was shown of it stays.
        let goes_on = attempt.is_cancelled() && !attempt.is_cancel_asked() && published.is_err();
        if let Some((_, dataset)) = spec.partial.as_ref().filter(|_| !goes_on) {
            self.remove_partial(dataset, attempt);
        }
        let version = published?;
        let outcome = self.published(&spec.dataset, version)?;
        let mut summary: serde_json::Value = serde_json::from_str(&outcome.summary_json).map_err(ApiError::internal)?;
        let report = self.catalog.store().open_version(&spec.dataset, Some(version))?.blob(REPORT)?;
        summary["fit"] = serde_json::from_slice(&report).map_err(ApiError::internal)?;
        Ok(Outcome { summary_json: summary.to_string(), ..outcome })
    }

    fn fill_fitted(&self, spec: &FitSpec, staging: &Staging, attempt: &Attempt) -> Result<Publication, ApiError> {
        let (map, pages) = self.catalog.open_observations(&spec.observations, spec.version)?;
        let manifest = pages.manifest();
        let name = version_name(&manifest.dataset, manifest.version);
        let origin = manifest.blobs.contains_key(ORIGIN).then(|| pages.blob(ORIGIN)).transpose()?;
        if let Some((_, dataset)) = &spec.partial {
            self.check_partial(dataset, attempt)?;
        }
        let read = |page| pages.read_page(page).map(Arc::new);
        let beside_bytes = REPORT_BYTES + origin.as_ref().map_or(0, |origin| origin.len() as u64);
        let source = FitSource { map: &map, read: &read, name: &name, beside_bytes, solver: self.solver(spec.backend)? };
        let follower = Follower {
            work: self,
            spec,
            attempt,
            observed: manifest,
            origin: origin.as_deref(),
            shown: Mutex::new((Instant::now(), Duration::ZERO)),
        };
        let (parameters, report) = construct(&source, &spec.settings, staging, &follower)?;
        if let Some(origin) = &origin {
            staging.put_blob(ORIGIN, origin)?;
        }
        let report = serde_json::to_vec(&report).map_err(ApiError::internal)?;
        if report.len() as u64 > REPORT_BYTES {
            return Err(ApiError::internal(format!("a report of {} bytes, {REPORT_BYTES} were counted for it", report.len())));
        }
        staging.put_blob(REPORT, &report)?;
        publication(&parameters, manifest)
    }

    // On the adapter that the renderer would take, but a device of the job's own: neither waits for the other, and one's failure is not the other's.
    fn solver(&self, backend: Backend) -> Result<Solver, ApiError> {
        match (backend, self.backend) {
            (Backend::Cpu, _) => return Ok(Solver::Processor),
            // As the job was submitted there was one.
            (Backend::Gpu, BackendChoice::Cpu) => return Err(no_adapter_to_fit_on()),
            (Backend::Gpu, BackendChoice::Auto | BackendChoice::Gpu) => {}
        }
        let kernel = Gpu::new().and_then(|gpu| LobeKernel::new(Arc::new(gpu)));
        kernel.map(|kernel| Solver::Device(Arc::new(kernel))).map_err(|error| match error {
            GpuError::NoAdapter { .. } => no_adapter_to_fit_on(),
            error => FitError::Device(error).into(),
        })
    }

    // A dataset of that name may only be what an earlier attempt has shown.
    fn check_partial(&self, dataset: &str, attempt: &Attempt) -> Result<(), ApiError> {
        match self.catalog.store().manifest(dataset, None) {
            Err(StoreError::NotFound { .. }) => Ok(()),
            Ok(manifest) if is_shown_by(&manifest, attempt) => Ok(()),
            Ok(_) | Err(_) => {
                let message = format!("dataset {dataset} holds something else: delete it, or fit into a dataset of another name");
                Err(ApiError::new(Reason::DatasetKindMismatch, message))
            }
        }
    }

    fn remove_partial(&self, dataset: &str, attempt: &Attempt) {
        // An empty one is left: whose it is does not show, and a fit takes it.
        let is_ours = self.catalog.store().manifest(dataset, None).is_ok_and(|manifest| is_shown_by(&manifest, attempt));
        if is_ours && let Err(error) = self.catalog.delete(dataset) {
            tracing::warn!(%error, dataset, "cannot delete the partial map of a fit that has ended");
        }
    }
}

/// A fit on the GPU where there is none.
pub fn no_adapter_to_fit_on() -> ApiError {
    ApiError::field("spec.fit.backend", "GPU, CPU expected: this server uses no graphics adapter")
}

const VERSION: &str = " version ";

/// As a parameter map remembers what it was fitted to.
pub(super) fn version_name(dataset: &str, version: u64) -> String {
    format!("{dataset}{VERSION}{version}")
}

/// Dataset and version of such a name.
pub(super) fn named_version(name: &str) -> Option<(&str, u64)> {
    let (dataset, version) = name.rsplit_once(VERSION)?;
    Some((dataset, version.parse().ok()?))
}

fn is_shown_by(manifest: &Manifest, attempt: &Attempt) -> bool {
    manifest.token.starts_with(&partial_token(attempt))
}

// Of all partial maps of a job; a number follows.
fn partial_token(attempt: &Attempt) -> String {
    format!("{}-partial-", attempt.token())
}

fn publication(parameters: &Parameters, observed: &Manifest) -> Result<Publication, ApiError> {
    Ok(Publication {
        kind: KIND.name().into(),
        parameters: serde_json::to_value(parameters).map_err(ApiError::internal)?,
        inputs: observed.inputs.clone(),
        code_version: env!("CARGO_PKG_VERSION").into(),
        created_unix_millis: now_millis(),
    })
}

/// Tells the job's watchers of its fit, and publishes what there is of it now and then.
struct Follower<'a> {
    work: &'a Work,
    spec: &'a FitSpec,
    attempt: &'a Attempt,
    observed: &'a Manifest,
    origin: Option<&'a [u8]>,
    /// When something was published last, and how long that took.
    shown: Mutex<(Instant, Duration)>,
}

impl Progress for Follower<'_> {
    fn report(&self, what: &str, done: u64, total: u64) {
        self.attempt.report(what, done, total);
    }

    fn is_cancelled(&self) -> bool {
        self.attempt.is_cancelled()
    }
}

impl FollowFit for Follower<'_> {
    fn fitted(&self, so_far: &FitSummary) {
        let is_shown = |dataset: &&String| self.work.catalog.store().manifest(dataset, None).is_ok();
        let partial_dataset = self.spec.partial.as_ref().map(|(_, dataset)| dataset).filter(is_shown).cloned();
        self.attempt.tell_fit(FitSoFar { summary: so_far.clone(), partial_dataset });
    }

    fn offer(&self, partial: &PartialMap<'_>) -> Result<(), FitError> {
        let Some((every, dataset)) = &self.spec.partial else { return Ok(()) };
        let mut shown = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        let (last, took) = *shown;
        if last.elapsed() < (took * PAUSE).max(*every) {
            return Ok(());
        }
        let begun = Instant::now();
        // The fit does not depend on it.
        if let Err(error) = self.publish(dataset, partial) {
            tracing::warn!(%error, dataset, "cannot publish what is fitted so far");
        }
        *shown = (Instant::now(), begun.elapsed());
        Ok(())
    }
}

impl Follower<'_> {
    fn publish(&self, dataset: &str, partial: &PartialMap<'_>) -> Result<(), ApiError> {
        let store = self.work.catalog.store();
        self.work.check_partial(dataset, self.attempt)?;
        match store.create_dataset(dataset) {
            Ok(()) | Err(StoreError::AlreadyExists { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        let number = store.versions(dataset)?.last().map_or(1, |newest| newest + 1);
        let token = format!("{}{number}", partial_token(self.attempt));
        // What a killed server left of the same number is older.
        store.stage(dataset, &token)?.abandon()?;
        let staging = store.stage(dataset, &token)?;
        let parameters = partial.store(&staging)?;
        if let Some(origin) = self.origin {
            staging.put_blob(ORIGIN, origin)?;
        }
        staging.publish(publication(&parameters, self.observed)?)?;
        Ok(store.delete_older_versions(dataset)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_map_was_fitted_to_is_found_again_by_its_name() {
        assert_eq!(named_version(&version_name("seen", 12)), Some(("seen", 12)));
        assert_eq!((named_version("seen"), named_version("seen version x")), (None, None));
    }
}
