//! Long work: submitted, queued, run on threads of its own, watched, cancelled, remembered over a restart.
//!
//! Nothing here knows what a job does: a [`JobBody`] does it. All functions block (they write files): call them off the tokio workers.

mod attempt;
pub mod record;

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use tokio::sync::watch;

pub use attempt::{Attempt, FitSoFar, Stage};
pub use record::{Outcome, Record, ResultBlob, State};

use self::record::{Failure, RecordFolder, job_number, now_millis};
use crate::errors::{ApiError, Reason, code_of};
use crate::render_queue::panic_message;
use crate::wire::reason_name;

/// Of all jobs that have not ended.
const SPECS_WAITING_BYTES: usize = 32 << 20;
/// Of all jobs that are remembered.
const SPECS_KEPT_BYTES: usize = 64 << 20;

/// What jobs do.
pub trait JobBody: Send + Sync + 'static {
    /// Does the work of `spec` (protobuf, checked when it was submitted). Asks `attempt` between pieces whether to go on and returns
    /// the reason `JobCancelled` when not; then whatever is stored must let a later call resume.
    fn run(&self, spec: &[u8], attempt: &Attempt) -> Result<Outcome, ApiError>;
    /// No remembered job names these results any more.
    fn forget(&self, results: &[ResultBlob]);
}

/// Limits of the job table.
#[derive(Debug, Clone, Copy)]
pub struct JobLimits {
    /// Jobs that run at once.
    pub concurrent: usize,
    /// Jobs that wait.
    pub queued: usize,
    /// Ended jobs that are remembered.
    pub kept: usize,
    /// Threads that the jobs share; 0 for one a core.
    pub threads: usize,
}

/// What is submitted.
#[derive(Debug, Clone)]
pub struct Submission {
    /// "capture", "evaluate", "path_render" or "thin".
    pub kind: &'static str,
    /// The dataset that it adds a version to.
    pub writes: Option<String>,
    /// The client's, or empty.
    pub request_id: String,
    /// BLAKE3 of the specification as it came.
    pub asked: String,
    /// What to do: protobuf.
    pub spec: Vec<u8>,
}

/// A job at some moment.
#[derive(Debug, Clone)]
pub struct JobView {
    /// Increases with every change, within one run of the server.
    pub sequence: u64,
    /// When.
    pub at_millis: u64,
    /// The durable part.
    pub record: Record,
    /// How far it is.
    pub stage: Stage,
}

/// The job table and its threads.
pub struct Jobs {
    shared: Arc<Shared>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

struct Shared {
    table: Mutex<Table>,
    changed: Condvar,
    folder: RecordFolder,
    limits: JobLimits,
    body: Box<dyn JobBody>,
    pool: rayon::ThreadPool,
}

struct Table {
    jobs: BTreeMap<u64, Job>,
    queue: VecDeque<u64>,
    next_number: u64,
    stopping: bool,
}

struct Job {
    view: watch::Sender<JobView>,
    attempt: Arc<Attempt>,
}

impl Jobs {
    /// Reads the records under `folder`, queues what had not ended, and starts the threads.
    pub fn start(folder: &Path, limits: JobLimits, body: impl JobBody) -> io::Result<Self> {
        let folder = RecordFolder::open(folder.into())?;
        let mut table = Table { jobs: BTreeMap::new(), queue: VecDeque::new(), next_number: 1, stopping: false };
        for record in folder.read_all()? {
            table.next_number = record.number + 1;
            if !record.state.is_ended() {
                tracing::info!(job = record.name(), kind = record.kind, "unfinished job goes on");
                table.queue.push_back(record.number);
            }
            table.jobs.insert(record.number, Job::new(record));
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(limits.threads).thread_name(|i| format!("job-pool-{i}"));
        let pool = pool.build().map_err(io::Error::other)?;
        let shared = Arc::new(Shared { table: Mutex::new(table), changed: Condvar::new(), folder, limits, body: Box::new(body), pool });
        let spawn = |i| {
            let shared = shared.clone();
            thread::Builder::new().name(format!("job-{i}")).spawn(move || while shared.run_next() {})
        };
        let threads = (0..limits.concurrent).map(spawn).collect::<io::Result<_>>()?;
        Ok(Self { shared, threads: Mutex::new(threads) })
    }

    /// Queues a job, durably; or finds the one that this request made before.
    pub fn submit(&self, submission: Submission) -> Result<JobView, ApiError> {
        let mut table = self.shared.lock();
        if let Some(view) = table.repeated(&submission)? {
            return Ok(view);
        }
        table.admit(&submission, &self.shared.limits)?;
        let record = Record::new(table.next_number, submission);
        self.shared.folder.write(&record)?;
        table.next_number += 1;
        table.queue.push_back(record.number);
        let number = record.number;
        let job = table.jobs.entry(number).or_insert(Job::new(record));
        let view = job.view.borrow().clone();
        self.shared.changed.notify_one();
        Ok(view)
    }

    /// One job.
    pub fn get(&self, name: &str) -> Result<JobView, ApiError> {
        Ok(self.watch(name)?.borrow().clone())
    }

    /// One job and its changes.
    pub fn watch(&self, name: &str) -> Result<watch::Receiver<JobView>, ApiError> {
        let table = self.shared.lock();
        Ok(table.job(name)?.view.subscribe())
    }

    /// Newest first, at most `count`, those numbered below `before`; true if there are more.
    pub fn list(&self, count: usize, before: u64) -> (Vec<JobView>, bool) {
        let table = self.shared.lock();
        let mut older = table.jobs.range(..before).rev().map(|(_, job)| job.view.borrow().clone());
        let page: Vec<_> = older.by_ref().take(count).collect();
        (page, older.next().is_some())
    }

    /// Waiting and running.
    pub fn counts(&self) -> (usize, usize) {
        let table = self.shared.lock();
        let running = table.unended().filter(|r| r.state != State::Pending).count();
        (table.unended().count() - running, running)
    }

    /// True while a job that has not ended writes this dataset.
    pub fn is_writing(&self, dataset: &str) -> bool {
        self.shared.lock().unended().any(|r| r.writes.as_deref().is_some_and(|written| are_one(written, dataset)))
    }

    /// Asks a job to stop. One that waits is cancelled at once.
    pub fn cancel(&self, name: &str) -> Result<JobView, ApiError> {
        let mut table = self.shared.lock();
        let job = table.job(name)?;
        let mut record = job.view.borrow().record.clone();
        match record.state {
            State::Succeeded | State::Failed | State::Cancelled => {
                return Err(ApiError::new(Reason::JobEnded, format!("job {name} has ended already")));
            }
            State::Pending => record.end(Err(&cancelled())),
            State::Running | State::Cancelling => record.state = State::Cancelling,
        }
        self.shared.folder.write(&record)?;
        job.attempt.cancel();
        let number = record.number;
        job.show(record);
        let view = job.view.borrow().clone();
        table.queue.retain(|n| *n != number || !view.record.state.is_ended());
        Ok(view)
    }

    /// Stops every running job between two pieces, to go on after the next start, and waits for the threads.
    pub fn stop(&self) {
        {
            let mut table = self.shared.lock();
            table.stopping = true;
            table.jobs.values().for_each(|job| job.attempt.stop());
        }
        self.shared.changed.notify_all();
        for thread in self.threads.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            let _ = thread.join();
        }
    }
}

impl Shared {
    /// A panic elsewhere cannot leave the table half-changed: every change is one insertion or one `show`.
    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a job and runs it; false once stopping.
    fn run_next(&self) -> bool {
        let Some((mut record, attempt)) = self.take_next() else { return false };
        let spec = record.spec.clone();
        let work = || self.pool.install(|| self.body.run(&spec.0, &attempt));
        let result = catch_unwind(AssertUnwindSafe(work))
            .unwrap_or_else(|panic| Err(ApiError::internal(format!("job panicked: {}", panic_message(panic.as_ref())))));
        if attempt.is_stopped() && !attempt.is_cancel_asked() && result.as_ref().is_err_and(|e| e.reason() == Reason::JobCancelled) {
            // Interrupted by the server's end, not by anyone's wish: the record stays RUNNING and the next start goes on.
            return true;
        }
        record.end(result.as_ref());
        let outcome = if record.state == State::Succeeded { "succeeded" } else { "did not succeed" };
        tracing::info!(job = record.name(), outcome, failure = record.failure.as_ref().map(|f| &f.message), "job ended");
        let mut table = self.lock();
        if let Err(error) = self.folder.write(&record) {
            tracing::error!(%error, job = record.name(), "the end of a job could not be recorded; it will run again after a restart");
        }
        if let Some(job) = table.jobs.get(&record.number) {
            job.show(record);
        }
        self.forget_old(&mut table);
        true
    }

    fn take_next(&self) -> Option<(Record, Arc<Attempt>)> {
        let mut table = self.lock();
        loop {
            if table.stopping {
                return None;
            }
            if let Some(number) = table.queue.pop_front() {
                let job = &table.jobs[&number];
                let mut record = job.view.borrow().record.clone();
                // A job that was being cancelled when the server was killed runs once more, to find at its first question that it is.
                if record.state == State::Cancelling {
                    job.attempt.cancel();
                } else {
                    record.state = State::Running;
                }
                record.started_millis.get_or_insert(now_millis());
                record.attempt += 1;
                if let Err(error) = self.folder.write(&record) {
                    tracing::warn!(%error, job = record.name(), "the start of a job could not be recorded");
                }
                job.show(record.clone());
                return Some((record, job.attempt.clone()));
            }
            table = self.changed.wait(table).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn forget_old(&self, table: &mut Table) {
        let ended: Vec<u64> = table.jobs.values().filter_map(|j| j.ended_number()).collect();
        let mut excess = ended.len().saturating_sub(self.limits.kept);
        // Large specifications go earlier: what is remembered has a bound in bytes too.
        while excess < ended.len() && table.spec_bytes(&ended[..excess]) > SPECS_KEPT_BYTES {
            excess += 1;
        }
        for number in &ended[..excess] {
            self.folder.remove(*number);
            let Some(job) = table.jobs.remove(number) else { continue };
            let mut unnamed = job.results();
            unnamed.retain(|blob| !table.jobs.values().any(|j| j.results().iter().any(|b| b.blake3 == blob.blake3)));
            self.body.forget(&unnamed);
        }
    }
}

impl Table {
    fn job(&self, name: &str) -> Result<&Job, ApiError> {
        let job = job_number(name).and_then(|number| self.jobs.get(&number));
        job.ok_or_else(|| ApiError::new(Reason::JobNotFound, format!("no job {name:?}")))
    }

    /// Bytes of all specifications but those of these jobs.
    fn spec_bytes(&self, without: &[u64]) -> usize {
        let counted = self.jobs.iter().filter(|(number, _)| !without.contains(number));
        counted.map(|(_, job)| job.view.borrow().record.spec.0.len()).sum()
    }

    fn unended(&self) -> impl Iterator<Item = watch::Ref<'_, JobView>> + '_ {
        self.jobs.values().map(|j| j.view.borrow()).filter(|v| !v.record.state.is_ended())
    }

    /// The job that the same request made before.
    fn repeated(&self, submission: &Submission) -> Result<Option<JobView>, ApiError> {
        if submission.request_id.is_empty() {
            return Ok(None);
        }
        let same = self.jobs.values().map(|j| j.view.borrow()).find(|v| v.record.request_id == submission.request_id);
        match same {
            Some(view) if view.record.asked == submission.asked => Ok(Some(view.clone())),
            Some(view) => {
                let message = format!("request_id {:?} made {} from another specification", submission.request_id, view.record.name());
                Err(ApiError::new(Reason::RequestIdReused, message))
            }
            None => Ok(None),
        }
    }

    fn admit(&self, submission: &Submission, limits: &JobLimits) -> Result<(), ApiError> {
        if self.stopping {
            return Err(ApiError::new(Reason::ShuttingDown, "the server is stopping"));
        }
        if self.queue.len() >= limits.queued {
            return Err(ApiError::new(Reason::JobQueueFull, format!("{} jobs are waiting, no more are taken", limits.queued)));
        }
        let waiting: usize = self.unended().map(|v| v.record.spec.0.len()).sum();
        if waiting + submission.spec.len() > SPECS_WAITING_BYTES {
            let message = format!("the waiting jobs' specifications have {waiting} bytes, no more than {SPECS_WAITING_BYTES} are taken");
            return Err(ApiError::new(Reason::JobQueueFull, message));
        }
        let Some(dataset) = &submission.writes else { return Ok(()) };
        let other = self.unended().find(|v| v.record.writes.as_deref().is_some_and(|written| are_one(written, dataset)));
        let Some(other) = other else { return Ok(()) };
        let message = format!("dataset {dataset} is being written by {}", other.record.name());
        Err(ApiError::new(Reason::DatasetBusy, message).with("job", other.record.name()))
    }
}

/// What a fit shows of itself while it runs is a dataset beside its own, named with this behind.
pub const PARTIAL: &str = "-partial";

/// Whoever writes one of the two may write the other.
fn are_one(a: &str, b: &str) -> bool {
    a == b || a.strip_suffix(PARTIAL) == Some(b) || b.strip_suffix(PARTIAL) == Some(a)
}

impl std::ops::Deref for JobView {
    type Target = Record;

    fn deref(&self) -> &Record {
        &self.record
    }
}

impl Job {
    fn new(record: Record) -> Self {
        let view = watch::Sender::new(JobView { sequence: 1, at_millis: now_millis(), record, stage: Stage::default() });
        Self { attempt: Arc::new(Attempt::new(view.clone())), view }
    }

    fn show(&self, record: Record) {
        self.view.send_modify(|view| {
            view.sequence += 1;
            view.at_millis = now_millis();
            view.record = record;
        });
    }

    fn results(&self) -> Vec<ResultBlob> {
        self.view.borrow().record.outcome.as_ref().map(|o| o.blobs.clone()).unwrap_or_default()
    }

    fn ended_number(&self) -> Option<u64> {
        let view = self.view.borrow();
        view.record.state.is_ended().then_some(view.record.number)
    }
}

impl Record {
    fn end(&mut self, result: Result<&Outcome, &ApiError>) {
        self.ended_millis = Some(now_millis());
        match result {
            Ok(outcome) => {
                self.state = State::Succeeded;
                self.outcome = Some(outcome.clone());
            }
            Err(error) => {
                self.state = if error.reason() == Reason::JobCancelled { State::Cancelled } else { State::Failed };
                let (code, reason) = (code_of(error.reason()) as i32, reason_name(error.reason()).into());
                self.failure = Some(Failure { code, reason, message: error.message().into() });
            }
        }
    }
}

/// What a body returns when it was asked to stop.
pub fn cancelled() -> ApiError {
    ApiError::new(Reason::JobCancelled, "cancelled")
}

#[cfg(test)]
mod tests;
