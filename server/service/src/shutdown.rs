//! Stopping: one signal asks everything to end, within a grace period; the second ends the process at once.

use std::process;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Exit code after a second signal, as a shell gives it for SIGINT.
const INTERRUPTED: i32 = 130;

/// SIGTERM and SIGINT, both meaning "stop".
pub struct StopSignals {
    terminate: Signal,
    interrupt: Signal,
}

impl StopSignals {
    /// Takes both over from their default action, which is to kill.
    pub fn install() -> std::io::Result<Self> {
        Ok(Self { terminate: signal(SignalKind::terminate())?, interrupt: signal(SignalKind::interrupt())? })
    }

    async fn next(&mut self) -> &'static str {
        tokio::select! {
            _ = self.terminate.recv() => "SIGTERM",
            _ = self.interrupt.recv() => "SIGINT",
        }
    }

    /// Cancels `stopping` at the first signal and ends the process at the second. Runs as long as the server does.
    pub async fn watch(mut self, stopping: CancellationToken) {
        let first = self.next().await;
        tracing::info!(signal = first, "stopping; a second signal ends at once");
        stopping.cancel();
        let second = self.next().await;
        tracing::warn!(signal = second, "ending at once");
        process::exit(INTERRUPTED);
    }
}

/// How draining ended.
#[derive(Debug, PartialEq, Eq)]
pub enum Drained {
    /// Everything ended by itself.
    Whole,
    /// The grace period passed; what was left is cut with the process.
    Cut,
}

/// Waits for `work`, but once `stopping` is cancelled no longer than `grace`: neither a stream that its client keeps open nor a peer
/// that never answers can hold the process.
pub async fn until_drained<T>(work: impl Future<Output = T>, stopping: &CancellationToken, grace: Duration) -> (Option<T>, Drained) {
    let deadline = async {
        stopping.cancelled().await;
        tokio::time::sleep(grace).await;
    };
    tokio::select! {
        biased;
        value = work => (Some(value), Drained::Whole),
        () = deadline => (None, Drained::Cut),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn work_without_end_is_cut_after_the_grace_period() {
        let stopping = CancellationToken::new();
        stopping.cancel();
        let begun = tokio::time::Instant::now();
        let (value, drained) = until_drained(std::future::pending::<()>(), &stopping, Duration::from_secs(20)).await;
        assert_eq!((value, drained), (None, Drained::Cut));
        assert_eq!(begun.elapsed().as_secs(), 20);
    }

    #[tokio::test(start_paused = true)]
    async fn work_goes_on_for_as_long_as_nobody_asks_to_stop() {
        let work = async {
            tokio::time::sleep(Duration::from_secs(3600)).await;
            7
        };
        let (value, drained) = until_drained(work, &CancellationToken::new(), Duration::ZERO).await;
        assert_eq!((value, drained), (Some(7), Drained::Whole));
    }
}
