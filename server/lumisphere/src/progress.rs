//! How long work reports and stops: a sink for progress that is also asked, between pieces, whether to go on.
//!
//! The library never prints and never spawns a watcher; whoever runs a long computation passes a `Progress`.

/// Told of finished pieces and asked whether to go on. Called from any thread, between tiles, never inside one.
pub trait Progress: Sync {
    /// `done` of `total` pieces are finished; `what` names the stage ("tracing cube maps").
    fn report(&self, what: &str, done: u64, total: u64);
    /// True once the work should stop at the next piece; it then returns `Cancelled`.
    fn is_cancelled(&self) -> bool;
}

/// Reports nothing and never cancels.
#[derive(Debug, Clone, Copy)]
pub struct Unattended;

impl Progress for Unattended {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        false
    }
}

/// Passes cancellation on, and keeps the pieces of one piece to itself.
pub(crate) struct Silent<'a>(pub &'a dyn Progress);

impl Progress for Silent<'_> {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        self.0.is_cancelled()
    }
}

/// The work was asked to stop, and did, between two pieces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;
