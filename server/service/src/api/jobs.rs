//! Long work.

use lumisphere::capture::observation_map::OBSERVATION_MAP;
use lumisphere::render::{Backend, Settings};
use lumisphere::representations::{Kind, Original};
use lumisphere::textures::ContentHash;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

use super::{Answers, Api, App, blocking};
use crate::errors::{ApiError, Reason};
use crate::jobs::{JobView, Submission};
use crate::wire::jobs::{JobSpec, digest, job, job_event, job_spec, listed_job, remembered, request_id};
use crate::wire::proto::{self, jobs_server::Jobs};
use crate::wire::settings::check_kind;
use crate::wire::{self};
use crate::work::no_adapter_to_fit_on;

#[tonic::async_trait]
impl Jobs for Api {
    async fn submit_job(&self, request: Request<proto::SubmitJobRequest>) -> Result<Response<proto::Job>, Status> {
        self.0.accepting()?;
        let app = self.0.clone();
        let proto::SubmitJobRequest { spec, request_id } = request.into_inner();
        let submitted = blocking(move || job(&submit(&app, spec, request_id)?)).await?;
        Ok(Response::new(submitted))
    }

    async fn get_job(&self, request: Request<proto::GetJobRequest>) -> Result<Response<proto::Job>, Status> {
        let jobs = self.0.jobs.clone();
        let found = blocking(move || job(&jobs.get(&request.into_inner().name)?)).await?;
        Ok(Response::new(found))
    }

    async fn list_jobs(&self, request: Request<proto::ListJobsRequest>) -> Result<Response<proto::ListJobsResponse>, Status> {
        let proto::ListJobsRequest { page_size, page_token } = request.into_inner();
        let (count, before) = (wire::page_size(page_size, "page_size")?, wire::job_page_token(&page_token, "page_token")?);
        let jobs = self.0.jobs.clone();
        let (page, more) = blocking(move || Ok(jobs.list(count, before))).await?;
        let next_page_token = page.last().filter(|_| more).map(|view| view.number.to_string()).unwrap_or_default();
        let jobs = page.iter().map(listed_job).collect::<Result<_, _>>()?;
        Ok(Response::new(proto::ListJobsResponse { jobs, next_page_token }))
    }

    async fn cancel_job(&self, request: Request<proto::CancelJobRequest>) -> Result<Response<proto::Job>, Status> {
        let jobs = self.0.jobs.clone();
        let cancelled = blocking(move || job(&jobs.cancel(&request.into_inner().name)?)).await?;
        Ok(Response::new(cancelled))
    }

    type WatchJobStream = Answers<proto::JobEvent>;

    async fn watch_job(&self, request: Request<proto::WatchJobRequest>) -> Result<Response<Self::WatchJobStream>, Status> {
        let proto::WatchJobRequest { name, after_sequence } = request.into_inner();
        let jobs = self.0.jobs.clone();
        let changes = blocking(move || jobs.watch(&name)).await?;
        let (events, answers) = mpsc::channel(1);
        tokio::spawn(send_events(changes, after_sequence, events, self.0.stopping.clone()));
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }
}

/// Checks what can be checked before the job runs, and queues it.
fn submit(app: &App, message: Option<proto::JobSpec>, id: String) -> Result<JobView, ApiError> {
    let message = wire::required(message, "spec")?;
    let spec = job_spec(Some(message.clone()), &app.spec_limits())?;
    let request_id = request_id(id)?;
    let mut version = None;
    if let Some((dataset, wanted)) = spec.reads() {
        let manifest = app.catalog.manifest(dataset, wanted)?;
        spec.settings().iter().try_for_each(|s| check_kind(&s.settings, &manifest.kind))?;
        spec.settings().iter().try_for_each(|s| check_original(&s.settings, &manifest.parameters))?;
        spec.settings().iter().try_for_each(|s| app.catalog.looks().check(&s.settings))?;
        let expected = match spec {
            JobSpec::Fit(_) => Some(OBSERVATION_MAP),
            JobSpec::Suggest(_) => Some(Kind::ParameterMap.name()),
            JobSpec::Replace(_) => Some(Kind::OffsetSurfaceLightField.name()),
            _ => None,
        };
        if let Some(expected) = expected.filter(|kind| *kind != manifest.kind) {
            let message = format!("dataset {dataset} holds {:?}, {expected:?} expected", manifest.kind);
            return Err(ApiError::new(Reason::DatasetKindMismatch, message));
        }
        version = Some(manifest.version);
    }
    let writes = match &spec {
        JobSpec::Capture(capture) => {
            check_blobs(app, capture.scene.blobs(), "the scene")?;
            Some(capture.dataset.clone())
        }
        JobSpec::Observe(observe) => {
            check_blobs(app, observe.source.blobs(), "what is observed")?;
            Some(observe.dataset.clone())
        }
        JobSpec::Fit(fit) if fit.backend == Backend::Gpu && app.adapter.is_none() => return Err(no_adapter_to_fit_on()),
        JobSpec::Fit(fit) => Some(fit.dataset.clone()),
        JobSpec::Thin(thin) => Some(thin.into.clone()),
        JobSpec::Replace(replace) => {
            check_blobs(app, replace.scene.blobs(), "the scene")?;
            Some(replace.into.clone())
        }
        JobSpec::Evaluate(_) | JobSpec::PathRender(_) | JobSpec::Suggest(_) => None,
    };
    let asked = digest(&message);
    app.jobs.submit(Submission { kind: spec.kind(), writes, request_id, asked, spec: remembered(message, version) })
}

/// What cannot be shown of the object as it was captured; parameters that do not say are those of a diffuse one.
fn check_original(settings: &Settings, parameters: &serde_json::Value) -> Result<(), ApiError> {
    let Settings::OffsetSurfaceLightField(settings) = settings else { return Ok(()) };
    let original =
        parameters.get("original").and_then(|original| serde_json::from_value::<Original>(original.clone()).ok()).unwrap_or_default();
    Ok(settings.check_original(original)?)
}

fn check_blobs(app: &App, blobs: impl IntoIterator<Item = ContentHash>, of: &str) -> Result<(), ApiError> {
    match blobs.into_iter().find(|hash| !app.catalog.store().has_blob(hash)) {
        Some(hash) => Err(ApiError::new(Reason::BlobNotFound, format!("blob {hash} of {of} is not here: upload it first"))),
        None => Ok(()),
    }
}

/// The job now if it is newer than asked, then every change until it ends.
async fn send_events(
    mut changes: watch::Receiver<JobView>,
    after_sequence: u64,
    events: mpsc::Sender<Result<proto::JobEvent, Status>>,
    stopping: CancellationToken,
) {
    let newest = changes.borrow_and_update().clone();
    // Numbers of an earlier run of the server mean nothing now.
    let after = if after_sequence > newest.sequence { 0 } else { after_sequence };
    let mut next = Some(newest).filter(|view| view.sequence > after || view.state.is_ended());
    loop {
        if let Some(view) = next.take() {
            let ended = view.state.is_ended();
            if events.send(job_event(&view).map_err(Status::from)).await.is_err() || ended {
                return;
            }
        }
        tokio::select! {
            changed = changes.changed() => if changed.is_err() { return },
            () = events.closed() => return,
            () = stopping.cancelled() => {
                let error = ApiError::new(Reason::ShuttingDown, "the server is stopping; the job goes on after its next start");
                let _ = events.send(Err(error.into())).await;
                return;
            }
        }
        next = Some(changes.borrow_and_update().clone());
    }
}
