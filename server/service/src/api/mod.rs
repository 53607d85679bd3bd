//! The adapters: one short method an rpc, wire types to library calls and back. What takes longer than a look-up runs elsewhere.

mod cache;
mod datasets;
mod jobs;
mod rendering;
mod system;

use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use tokio::sync::Semaphore;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::catalog::Catalog;
use crate::config::{Config, Entry};
use crate::errors::{ApiError, Reason};
use crate::frames::Frames;
use crate::jobs::Jobs;
use crate::render_queue::panic_message;
use crate::sessions::Sessions;
use crate::telemetry::Metrics;
use crate::wire::cache::{GpuTier, cache_stats};
use crate::wire::jobs::SpecLimits;
use crate::wire::proto;

/// All that the adapters share.
pub struct App {
    /// In effect.
    pub config: Config,
    /// The same, for people.
    pub entries: Vec<Entry>,
    /// Datasets and blobs.
    pub catalog: Arc<Catalog>,
    /// Renders.
    pub frames: Frames,
    /// Long work.
    pub jobs: Arc<Jobs>,
    /// Viewers.
    pub sessions: Sessions,
    /// Instruments.
    pub metrics: Arc<Metrics>,
    /// The graphics adapter, if there is one.
    pub adapter: Option<Adapter>,
    /// Counters of the adapter's tier at the last reset.
    pub gpu_baseline: Mutex<Option<GpuTier>>,
    /// Cancelled once the server stops.
    pub stopping: CancellationToken,
    /// A place for the one replay under way.
    pub replays: Arc<Semaphore>,
    /// When the server started.
    pub started: Instant,
    /// Frames of `RenderFrame`.
    pub frame_ids: AtomicU64,
}

/// A graphics adapter, for people.
#[derive(Debug, Clone)]
pub struct Adapter {
    /// "llvmpipe (LLVM 15.0.6, 256 bits)".
    pub name: String,
    /// Its driver's description.
    pub driver: String,
}

impl App {
    /// What specifications of jobs are held to.
    pub fn spec_limits(&self) -> SpecLimits {
        SpecLimits { max_pixels: self.config.max_pixels_per_frame, max_cameras: self.config.max_cameras_per_job }
    }

    /// Refuses new work once the server stops.
    pub fn accepting(&self) -> Result<(), ApiError> {
        match self.stopping.is_cancelled() {
            true => Err(ApiError::new(Reason::ShuttingDown, "the server is stopping")),
            false => Ok(()),
        }
    }

    /// Every tier of the texture cache, counted since start or the last reset.
    pub fn cache_stats(&self) -> proto::CacheStats {
        let (now, baseline) = self.catalog.cache_stats();
        let gpu_baseline = self.gpu_baseline.lock().unwrap_or_else(PoisonError::into_inner);
        cache_stats(&now, &baseline, self.frames.gpu_tier().as_ref(), gpu_baseline.as_ref())
    }

    /// Counters count from here.
    pub fn reset_cache_counters(&self) {
        self.catalog.reset_cache_counters();
        *self.gpu_baseline.lock().unwrap_or_else(PoisonError::into_inner) = self.frames.gpu_tier();
    }

    fn next_frame_id(&self) -> u64 {
        self.frame_ids.fetch_add(1, Ordering::Relaxed) + 1
    }
}

/// One service's adapter; they differ only in the trait they implement.
#[derive(Clone)]
pub struct Api(pub Arc<App>);

/// A server stream.
type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Runs what blocks on a thread for that.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T, ApiError> + Send + 'static) -> Result<T, ApiError> {
    begin_blocking(work).await
}

/// The same, begun before anyone waits for it.
pub fn begin_blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
) -> impl Future<Output = Result<T, ApiError>> + Send + 'static {
    let begun = tokio::task::spawn_blocking(work);
    async {
        begun.await.unwrap_or_else(|error| {
            let what = error.try_into_panic().map_or("cancelled".into(), |panic| panic_message(panic.as_ref()));
            Err(ApiError::internal(format!("blocking work ended early: {what}")))
        })
    }
}
