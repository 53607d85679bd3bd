//! A running job's link to the table: progress out, the wish to stop in.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use lumisphere::progress::Progress;
use lumisphere::representations::parameter_map::FitSummary;
use tokio::sync::watch;

use super::JobView;
use super::record::now_millis;

/// Progress is shown at most this often: watchers are people.
const SHOW_EVERY: Duration = Duration::from_millis(100);

/// How far a job is.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Stage {
    /// What it does now.
    pub name: String,
    /// Finished pieces.
    pub done: u64,
    /// Pieces; 0 when not known.
    pub total: u64,
    /// Estimated from the rate since the stage began in this run.
    pub seconds_left: Option<f64>,
    /// Of a fit: what has come of it so far.
    pub fit: Option<Arc<FitSoFar>>,
}

/// A fit under way.
#[derive(Debug, Clone, PartialEq)]
pub struct FitSoFar {
    /// Of all texels so far.
    pub summary: FitSummary,
    /// Where they can be seen.
    pub partial_dataset: Option<String>,
}

/// One run of a job, seen from inside.
pub struct Attempt {
    view: watch::Sender<JobView>,
    cancel_asked: AtomicBool,
    stopped: AtomicBool,
    clock: Mutex<Option<StageClock>>,
}

/// Since when the present stage runs, and from which piece on.
struct StageClock {
    name: String,
    begun: Instant,
    first_done: u64,
    shown: Instant,
}

impl Attempt {
    pub(super) fn new(view: watch::Sender<JobView>) -> Self {
        Self { view, cancel_asked: AtomicBool::new(false), stopped: AtomicBool::new(false), clock: Mutex::new(None) }
    }

    pub(super) fn cancel(&self) {
        self.cancel_asked.store(true, Ordering::SeqCst);
    }

    pub(super) fn stop(&self) {
        self.stopped.store(true, Ordering::SeqCst);
    }

    /// True if someone wants the job gone, not only the server's end: then what it left unfinished is of no use.
    pub fn is_cancel_asked(&self) -> bool {
        self.cancel_asked.load(Ordering::SeqCst)
    }

    pub(super) fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::SeqCst)
    }

    /// What has come of a fit so far; shown with the next progress.
    pub fn tell_fit(&self, fit: FitSoFar) {
        self.view.send_if_modified(|view| {
            view.stage.fit = Some(Arc::new(fit));
            false
        });
    }

    /// Under which unfinished work is kept: the job's name and birth, so that it stays unique when job records are deleted by hand.
    pub fn token(&self) -> String {
        let view = self.view.borrow();
        format!("{}-{:x}", view.record.name(), view.record.created_millis)
    }
}

impl Progress for Attempt {
    fn report(&self, what: &str, done: u64, total: u64) {
        let now = Instant::now();
        let mut clock = self.clock.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = || StageClock { name: what.into(), begun: now, first_done: done, shown: now };
        let is_new = clock.as_ref().is_none_or(|c| c.name != what);
        let clock = match &mut *clock {
            Some(clock) if !is_new => clock,
            other => other.insert(fresh()),
        };
        if !is_new && done < total && now - clock.shown < SHOW_EVERY {
            return;
        }
        clock.shown = now;
        let seconds_left = clock.seconds_left(now, done, total);
        self.view.send_modify(|view| {
            view.sequence += 1;
            view.at_millis = now_millis();
            view.stage = Stage { name: what.into(), done, total, seconds_left, fit: view.stage.fit.take() };
        });
    }

    fn is_cancelled(&self) -> bool {
        self.is_cancel_asked() || self.is_stopped()
    }
}

impl StageClock {
    fn seconds_left(&self, now: Instant, done: u64, total: u64) -> Option<f64> {
        let finished = done.checked_sub(self.first_done).filter(|n| *n > 0)?;
        let left = total.checked_sub(done)?;
        Some((now - self.begun).as_secs_f64() / finished as f64 * left as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_counts_only_what_this_run_did() {
        let begun = Instant::now();
        // Resumed at 60 of 100: ten more took five seconds, so thirty take fifteen.
        let clock = StageClock { name: "tracing".into(), begun, first_done: 60, shown: begun };
        assert_eq!(clock.seconds_left(begun + Duration::from_secs(5), 70, 100), Some(15.0));
        assert_eq!(clock.seconds_left(begun, 60, 100), None);
        assert_eq!(clock.seconds_left(begun, 101, 100), None);
    }
}
