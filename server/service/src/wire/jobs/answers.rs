//! Jobs as messages.

use super::recalled;
use crate::errors::ApiError;
use crate::jobs::{FitSoFar, JobView, Outcome, State};
use crate::wire::{proto, timestamp};

/// A job, whole.
pub fn job(view: &JobView) -> Result<proto::Job, ApiError> {
    let failure = view.failure.clone();
    Ok(proto::Job {
        name: view.name(),
        spec: Some(recalled(&view.spec.0)?),
        state: state_number(view.state),
        create_time: Some(timestamp(view.created_millis)),
        start_time: view.started_millis.map(timestamp),
        end_time: view.ended_millis.map(timestamp),
        progress: Some(progress(view)),
        error: failure.map(|f| proto::JobError { code: f.code, reason: f.reason, message: f.message }),
        result: view.outcome.as_ref().map(result),
        attempt: view.attempt,
    })
}

/// A job at some moment, for its watchers.
pub fn job_event(view: &JobView) -> Result<proto::JobEvent, ApiError> {
    Ok(proto::JobEvent { sequence: view.sequence, job: Some(listed_job(view)?), time: Some(timestamp(view.at_millis)) })
}

fn forget_files(scene: Option<&mut proto::SceneSource>) {
    if let Some(proto::scene_source::Source::Bundle(bundle)) = scene.and_then(|s| s.source.as_mut()) {
        bundle.files.clear();
    }
}

/// A job without what may be long in its specification: the cameras and files that were given one by one.
pub fn listed_job(view: &JobView) -> Result<proto::Job, ApiError> {
    use proto::{evaluate_spec, job_spec::Spec, observe_spec, path_render_spec};
    let mut job = job(view)?;
    match job.spec.as_mut().and_then(|s| s.spec.as_mut()) {
        Some(Spec::Capture(m)) => forget_files(m.scene.as_mut()),
        Some(Spec::Replace(m)) => forget_files(m.scene.as_mut()),
        Some(Spec::Observe(m)) => match &mut m.source {
            Some(observe_spec::Source::VirtualPhotographs(m)) => forget_files(m.scene.as_mut()),
            Some(observe_spec::Source::Photographs(m)) => {
                m.files.clear();
                forget_files(m.scene.as_mut());
            }
            None => {}
        },
        Some(Spec::Evaluate(m)) => {
            if let Some(evaluate_spec::Views::Cameras(list)) = &mut m.views {
                list.cameras.clear();
            }
        }
        Some(Spec::PathRender(m)) => {
            if let Some(path_render_spec::Views::Cameras(list)) = &mut m.views {
                list.cameras.clear();
            }
        }
        Some(Spec::Thin(_) | Spec::Fit(_) | Spec::Suggest(_)) | None => {}
    }
    Ok(job)
}

pub(super) fn progress(view: &JobView) -> proto::JobProgress {
    let stage = &view.stage;
    // A job's last stage may be one that it cannot count, or that ends before it is shown again.
    let fraction = match (view.state, stage.total) {
        (State::Succeeded, _) => 1.0,
        (_, 0) => 0.0,
        (_, total) => (stage.done as f64 / total as f64).min(1.0),
    };
    let seconds_left = stage.seconds_left.filter(|_| !view.state.is_ended());
    let fit = stage.fit.as_deref().map(fit_progress);
    proto::JobProgress { stage: stage.name.clone(), done: stage.done, total: stage.total, fraction, seconds_left, fit }
}

fn fit_progress(FitSoFar { summary, partial_dataset }: &FitSoFar) -> proto::FitProgress {
    proto::FitProgress {
        texels: summary.texels,
        texels_per_second: summary.texels_per_second,
        histogram: summary.histogram.clone(),
        flags: summary.flags.iter().map(|(name, count)| (name.to_string(), *count)).collect(),
        median_residual: summary.median_residual,
        partial_dataset: partial_dataset.clone().unwrap_or_default(),
    }
}

fn result(outcome: &Outcome) -> proto::JobResult {
    let (dataset, dataset_version) = outcome.published.clone().unwrap_or_default();
    let blob = |b: &crate::jobs::ResultBlob| proto::ResultBlob {
        name: b.name.clone(),
        media_type: b.media_type.clone(),
        blake3: b.blake3.clone(),
        size_bytes: b.size_bytes,
    };
    proto::JobResult {
        dataset,
        dataset_version,
        blobs: outcome.blobs.iter().map(blob).collect(),
        summary_json: outcome.summary_json.clone(),
    }
}

fn state_number(state: State) -> i32 {
    (match state {
        State::Pending => proto::JobState::Pending,
        State::Running => proto::JobState::Running,
        State::Cancelling => proto::JobState::Cancelling,
        State::Succeeded => proto::JobState::Succeeded,
        State::Failed => proto::JobState::Failed,
        State::Cancelled => proto::JobState::Cancelled,
    }) as i32
}
