use std::sync::atomic::{AtomicU32, Ordering};

use crossbeam_channel::{Receiver, Sender, bounded};
use lumisphere::progress::Progress;

use super::*;

const LIMITS: JobLimits = JobLimits { concurrent: 1, queued: 2, kept: 3, threads: 1 };

/// Reports that it began, then goes on until told to end or asked to stop.
struct Held {
    begun: Sender<String>,
    release: Receiver<Result<Outcome, ApiError>>,
    forgotten: Arc<AtomicU32>,
}

impl JobBody for Held {
    fn run(&self, spec: &[u8], attempt: &Attempt) -> Result<Outcome, ApiError> {
        self.begun.send(String::from_utf8_lossy(spec).into_owned()).unwrap();
        attempt.report("waiting", 1, 4);
        loop {
            if attempt.is_cancelled() {
                return Err(cancelled());
            }
            // Asked again a thousand times a second; the wait ends early when released.
            if let Ok(result) = self.release.recv_timeout(std::time::Duration::from_millis(1)) {
                return result;
            }
        }
    }

    fn forget(&self, results: &[ResultBlob]) {
        self.forgotten.fetch_add(results.len() as u32, Ordering::SeqCst);
    }
}

struct Fixture {
    jobs: Jobs,
    begun: Receiver<String>,
    release: Sender<Result<Outcome, ApiError>>,
    forgotten: Arc<AtomicU32>,
}

fn start(folder: &Path) -> Fixture {
    let (begun_in, begun) = bounded(16);
    let (release, release_out) = bounded(16);
    let forgotten = Arc::new(AtomicU32::new(0));
    let body = Held { begun: begun_in, release: release_out, forgotten: forgotten.clone() };
    Fixture { jobs: Jobs::start(folder, LIMITS, body).unwrap(), begun, release, forgotten }
}

fn capture(dataset: &str, spec: &str) -> Submission {
    Submission { kind: "capture", writes: Some(dataset.into()), request_id: String::new(), asked: spec.into(), spec: spec.into() }
}

fn wait_for_end(jobs: &Jobs, name: &str) -> JobView {
    let mut changes = jobs.watch(name).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    runtime.block_on(async { changes.wait_for(|v| v.record.state.is_ended()).await.unwrap().clone() })
}

#[test]
fn a_job_runs_to_its_end_and_its_result_survives_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    let submitted = f.jobs.submit(capture("teapot", "a")).unwrap();
    assert_eq!((submitted.state, submitted.name().as_str()), (State::Pending, "job-000001"));
    assert_eq!(f.begun.recv().unwrap(), "a");
    assert_eq!(f.jobs.counts(), (0, 1));
    let outcome = Outcome { published: Some(("teapot".into(), 1)), ..Outcome::default() };
    f.release.send(Ok(outcome.clone())).unwrap();
    let ended = wait_for_end(&f.jobs, "job-000001");
    assert_eq!((ended.state, ended.outcome.as_ref(), ended.attempt), (State::Succeeded, Some(&outcome), 1));
    f.jobs.stop();
    let again = start(folder.path());
    assert_eq!(again.jobs.get("job-000001").unwrap().record, ended.record);
    assert_eq!(again.jobs.submit(capture("teapot", "b")).unwrap().name(), "job-000002");
    again.jobs.stop();
}

#[test]
fn a_job_that_the_server_interrupted_goes_on_after_the_next_start() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    f.jobs.submit(capture("teapot", "a")).unwrap();
    f.jobs.submit(capture("cup", "b")).unwrap();
    f.begun.recv().unwrap();
    f.jobs.stop();
    assert_eq!(f.jobs.get("job-000001").unwrap().state, State::Running);
    assert_eq!(f.jobs.submit(capture("spoon", "c")).unwrap_err().reason(), Reason::ShuttingDown);
    let again = start(folder.path());
    assert_eq!(again.begun.recv().unwrap(), "a");
    again.release.send(Ok(Outcome::default())).unwrap();
    assert_eq!(wait_for_end(&again.jobs, "job-000001").attempt, 2);
    assert_eq!(again.begun.recv().unwrap(), "b");
    again.jobs.stop();
}

#[test]
fn two_jobs_cannot_write_one_dataset_and_the_queue_is_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    f.jobs.submit(capture("teapot", "a")).unwrap();
    f.begun.recv().unwrap();
    let busy = f.jobs.submit(capture("teapot", "a")).unwrap_err();
    assert_eq!((busy.reason(), busy.message()), (Reason::DatasetBusy, "dataset teapot is being written by job-000001"));
    assert!(f.jobs.is_writing("teapot") && !f.jobs.is_writing("cup"));
    // What a fit into "teapot" would show of itself.
    assert!(f.jobs.is_writing("teapot-partial") && !f.jobs.is_writing("teapot-part"));
    f.jobs.submit(capture("b", "")).unwrap();
    f.jobs.submit(capture("c", "")).unwrap();
    assert_eq!(f.jobs.submit(capture("d", "")).unwrap_err().reason(), Reason::JobQueueFull);
    f.jobs.stop();
}

#[test]
fn cancelling_stops_a_running_job_and_drops_a_waiting_one() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    f.jobs.submit(capture("teapot", "a")).unwrap();
    f.jobs.submit(capture("cup", "b")).unwrap();
    f.begun.recv().unwrap();
    assert_eq!(f.jobs.cancel("job-000002").unwrap().state, State::Cancelled);
    f.jobs.cancel("job-000001").unwrap();
    let ended = wait_for_end(&f.jobs, "job-000001");
    assert_eq!((ended.state, ended.failure.as_ref().unwrap().reason.as_str()), (State::Cancelled, "JOB_CANCELLED"));
    assert_eq!(f.jobs.cancel("job-000001").unwrap_err().reason(), Reason::JobEnded);
    assert_eq!(f.jobs.cancel("job-000009").unwrap_err().reason(), Reason::JobNotFound);
    // The waiting one never ran: the next to begin is the third.
    f.jobs.submit(capture("spoon", "c")).unwrap();
    assert_eq!(f.begun.recv().unwrap(), "c");
    f.jobs.stop();
}

#[test]
fn a_repeated_request_finds_its_job_and_another_specification_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    let request = |spec: &str| Submission { request_id: "mine".into(), ..capture("teapot", spec) };
    let first = f.jobs.submit(request("a")).unwrap();
    assert_eq!(f.jobs.submit(request("a")).unwrap().name(), first.name());
    assert_eq!(f.jobs.submit(request("b")).unwrap_err().reason(), Reason::RequestIdReused);
    f.jobs.stop();
}

#[test]
fn a_panic_or_an_error_fails_the_job_and_not_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    f.jobs.submit(capture("teapot", "a")).unwrap();
    f.release.send(Err(ApiError::new(Reason::DiskFull, "disk full: x"))).unwrap();
    let failed = wait_for_end(&f.jobs, "job-000001");
    let failure = failed.failure.as_ref().unwrap();
    assert_eq!((failed.state, failure.code, failure.reason.as_str()), (State::Failed, 8, "DISK_FULL"));
    // With nobody to receive its beginning, the body panics.
    drop(f.begun);
    f.jobs.submit(capture("teapot", "b")).unwrap();
    assert_eq!(wait_for_end(&f.jobs, "job-000002").failure.as_ref().unwrap().reason, "INTERNAL");
    f.jobs.stop();
}

#[test]
fn the_oldest_ended_jobs_are_forgotten_and_lists_are_newest_first() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    // Five jobs, each with a result of its own and one that all share.
    let result = |blake3: String| ResultBlob { name: blake3.clone(), media_type: "text/plain".into(), blake3, size_bytes: 1 };
    for number in 1..=5 {
        f.jobs.submit(capture("teapot", "a")).unwrap();
        let blobs = vec![result(number.to_string()), result("shared".into())];
        f.release.send(Ok(Outcome { blobs, ..Outcome::default() })).unwrap();
        wait_for_end(&f.jobs, &record::job_name(number));
    }
    f.jobs.stop();
    assert_eq!(f.forgotten.load(Ordering::SeqCst), 2, "the own results of the two oldest");
    assert_eq!(f.jobs.get("job-000002").unwrap_err().reason(), Reason::JobNotFound);
    let numbers = |(page, more): (Vec<JobView>, bool)| (page.iter().map(|v| v.number).collect::<Vec<_>>(), more);
    assert_eq!(numbers(f.jobs.list(2, u64::MAX)), (vec![5, 4], true));
    assert_eq!(numbers(f.jobs.list(2, 4)), (vec![3], false));
}

#[test]
fn watchers_see_progress_with_rising_sequence() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    f.jobs.submit(capture("teapot", "a")).unwrap();
    let mut changes = f.jobs.watch("job-000001").unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let seen = runtime.block_on(async { changes.wait_for(|v| v.stage.done == 1).await.unwrap().clone() });
    assert_eq!((seen.stage.name.as_str(), seen.stage.total, seen.state), ("waiting", 4, State::Running));
    f.release.send(Ok(Outcome::default())).unwrap();
    assert!(wait_for_end(&f.jobs, "job-000001").sequence > seen.sequence);
    f.jobs.stop();
}

#[test]
fn waiting_specifications_are_bounded_in_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let f = start(folder.path());
    let large = |dataset: &str| Submission { spec: vec![0; SPECS_WAITING_BYTES / 2], ..capture(dataset, "") };
    f.jobs.submit(large("a")).unwrap();
    f.jobs.submit(large("b")).unwrap();
    assert_eq!(f.jobs.submit(large("c")).unwrap_err().reason(), Reason::JobQueueFull);
    f.jobs.stop();
}
