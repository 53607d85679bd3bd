//! Follows a job to its end; a broken connection is taken up again, Ctrl-C leaves the job running.

use std::time::{Duration, Instant};

use lumisphere_proto::v1alpha1 as wire;
use wire::JobState;

use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::progress::{Meter, Progress};
use crate::views;

/// How long a server may be away (a restart) before the watcher gives up.
const PATIENCE: Duration = Duration::from_secs(60);
/// Between attempts to reach it.
const PAUSE: Duration = Duration::from_millis(500);

/// What to do with each event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Events {
    /// Progress on standard error only.
    Show,
    /// Also an object a line on standard output, where results are JSON.
    Print,
}

/// Waits for the job's end. An ended job that did not succeed is a `Failure::Job`.
pub async fn watch(context: &Context, server: &Server, name: &str, events: Events) -> anyhow::Result<wire::Job> {
    context.on_interrupt(Some(format!("{name} goes on; to see it again: lumisphere job watch {name}")));
    let follow = follow(context, server, name, events);
    let job = match context.timeout() {
        None => follow.await?,
        Some(timeout) => tokio::time::timeout(timeout, follow)
            .await
            .map_err(|_| Failure::Unavailable(format!("{name} has not ended within {} s; it goes on", timeout.as_secs_f64())))??,
    };
    context.on_interrupt(None);
    match job.state() {
        JobState::Succeeded => Ok(job),
        state => Err(failure(&job, state).into()),
    }
}

fn failure(job: &wire::Job, state: JobState) -> Failure {
    let error = job.error.clone().unwrap_or_default();
    let state = if state == JobState::Cancelled { "was cancelled" } else { "failed" };
    Failure::Job { name: job.name.clone(), state, reason: error.reason, message: error.message }
}

async fn follow(context: &Context, server: &Server, name: &str, events: Events) -> anyhow::Result<wire::Job> {
    let mut meter = Meter::new(context.output);
    let mut after_sequence = 0;
    let mut lost_at: Option<Instant> = None;
    loop {
        let before = after_sequence;
        match follow_once(context, server, name, events, &mut after_sequence, &mut meter).await {
            Ok(Some(job)) => {
                meter.finish();
                return Ok(job);
            }
            // The stream ended, or the connection broke, before the job did.
            Ok(None) => {}
            Err(error) if crate::exit::is_broken_connection(&error) => {}
            Err(error) => return Err(error),
        }
        let lost_since = *lost_at.filter(|_| after_sequence == before).get_or_insert_with(Instant::now);
        lost_at = Some(lost_since);
        if lost_since.elapsed() > PATIENCE {
            return Err(
                Failure::Unavailable(format!("the server is away for {} s; {name} goes on when it is back", PATIENCE.as_secs())).into()
            );
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// The job once it has ended; None where the stream ends before.
async fn follow_once(
    context: &Context,
    server: &Server,
    name: &str,
    events: Events,
    after_sequence: &mut u64,
    meter: &mut Meter,
) -> anyhow::Result<Option<wire::Job>> {
    let request = wire::WatchJobRequest { name: name.into(), after_sequence: *after_sequence };
    let mut stream = server.jobs().watch_job(context.patient_request(request)).await?.into_inner();
    while let Some(event) = stream.message().await? {
        *after_sequence = event.sequence;
        let Some(job) = event.job.clone() else { continue };
        if events == Events::Print && context.output.is_json() {
            context.output.line(&views::JobEvent::from(event), String::new)?;
        }
        let progress = job.progress.clone().unwrap_or_default();
        match job.state() {
            JobState::Succeeded | JobState::Failed | JobState::Cancelled => return Ok(Some(job)),
            JobState::Pending => meter.update(Progress { stage: "waiting", done: 0, total: 0, seconds_left: None, detail: "" }),
            _ => meter.update(Progress {
                stage: if progress.stage.is_empty() { "starting" } else { &progress.stage },
                done: progress.done,
                total: progress.total,
                seconds_left: progress.seconds_left,
                detail: &progress.fit.clone().map(|fit| views::FitProgress::from(fit).text()).unwrap_or_default(),
            }),
        }
    }
    Ok(None)
}
