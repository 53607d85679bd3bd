//! Stills: the mean of several passes over one view, each rendered in a turn of its own, so that nobody waits for more than one of them.
//!
//! `frames` renders the passes; here is what is kept between them. Their pixels are held for as long as that takes, which is bounded: at most
//! [`CALLS`] unary calls and [`VIEWERS`] sessions are between their first pass and their last, others wait. (Jobs are as many as the
//! configuration allows.) Dropped, a still gives everything back.

use std::sync::Arc;
use std::time::Duration;

use lumisphere::render::{Accumulator, Backend};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout_at};

use crate::errors::{ApiError, Reason};
use crate::frames::{Caller, FrameOrder, Pass};
use crate::render_queue::{Priority, Slot};
use crate::telemetry::Metrics;
use crate::wire::frames::add_cache_use;
use crate::wire::proto;

/// Unary calls.
const CALLS: usize = 4;
/// Of those who wait to be among them; more are refused.
const WAITING_CALLS: usize = 64;
/// Sessions.
const VIEWERS: usize = 8;
/// Of a colour, and of a distance or a provenance.
const COLOR_BYTES: u64 = 12;
const WORD_BYTES: u64 = 4;

/// Where stills may be kept; cheap to clone.
#[derive(Clone)]
pub struct Rooms {
    calls: Arc<Semaphore>,
    waiting_calls: Arc<Semaphore>,
    viewers: Arc<Semaphore>,
    metrics: Arc<Metrics>,
}

/// A still's place, counted while it is held.
pub struct Room {
    metrics: Arc<Metrics>,
    bytes: i64,
    _place: Option<OwnedSemaphorePermit>,
}

/// What goes back with the still.
#[derive(Default)]
pub struct Held {
    /// In the render queue, from the first pass to the last.
    pub admitted: Option<OwnedSemaphorePermit>,
    /// Of a frame of one pass, until it is encoded.
    _slot: Option<Slot>,
    /// Of a frame of several.
    pub room: Option<Room>,
}

/// The passes so far.
pub struct Still {
    /// Of pass 0.
    pub order: FrameOrder,
    /// What computed pass 0.
    pub backend: Backend,
    /// Its adapter's name; None on the CPU.
    pub adapter: Option<String>,
    /// Held on the device by the dataset; None on the CPU.
    pub device_bytes: Option<u64>,
    /// Rendering, of all passes.
    pub millis: f64,
    /// What it holds of the server.
    pub held: Held,
    mean: Accumulator,
    /// Of the passes that no frame has told of yet.
    timings: proto::FrameTimings,
    cache: proto::FrameCacheUse,
}

impl Rooms {
    /// All empty.
    pub fn new(metrics: Arc<Metrics>) -> Self {
        let places = |count: usize| Arc::new(Semaphore::new(count));
        Self { calls: places(CALLS), waiting_calls: places(WAITING_CALLS), viewers: places(VIEWERS), metrics }
    }

    /// For the still of a call or a job; a call waits until there is room.
    pub async fn of_call(&self, order: &FrameOrder, caller: Caller) -> Result<Room, ApiError> {
        if caller.who == Priority::Batch {
            return Ok(self.room(order, None));
        }
        let full = || ApiError::new(Reason::RenderQueueFull, format!("{WAITING_CALLS} stills wait already"));
        let _waiting = self.waiting_calls.try_acquire().map_err(|_| full())?;
        let late = || ApiError::new(Reason::DeadlineExceeded, "the deadline passed before the still was begun");
        let place = self.calls.clone().acquire_owned();
        let deadline = caller.deadline.unwrap_or_else(|| Instant::now() + Duration::from_secs(86_400));
        let place = timeout_at(deadline, place).await.map_err(|_| late())?;
        Ok(self.room(order, place.ok()))
    }

    /// For the still of a viewer at rest, as soon as there is room.
    pub async fn of_viewer(&self, order: &FrameOrder) -> Room {
        let place = self.viewers.clone().acquire_owned().await;
        self.room(order, place.ok())
    }

    /// The same if there is room now.
    pub fn of_viewer_now(&self, order: &FrameOrder) -> Option<Room> {
        let place = self.viewers.clone().try_acquire_owned().ok()?;
        Some(self.room(order, Some(place)))
    }

    fn room(&self, order: &FrameOrder, place: Option<OwnedSemaphorePermit>) -> Room {
        let intrinsics = order.camera.intrinsics();
        let words = u64::from(order.output.depth.is_some()) + u64::from(order.output.provenance);
        let bytes = u64::from(intrinsics.width_px) * u64::from(intrinsics.height_px) * (COLOR_BYTES + words * WORD_BYTES);
        let bytes = i64::try_from(bytes).unwrap_or(i64::MAX);
        self.metrics.stills_held.inc();
        self.metrics.still_bytes.inc_by(bytes);
        Room { metrics: self.metrics.clone(), bytes, _place: place }
    }
}

impl Held {
    /// By a still of one pass, until it is encoded, or by one of several, which has its room: slots are for those that go on at once.
    pub fn by_call(admitted: OwnedSemaphorePermit, slot: Slot, room: Option<Room>) -> Self {
        Self { admitted: Some(admitted), _slot: room.is_none().then_some(slot), room }
    }

    /// By a viewer's still, between passes.
    pub fn by_viewer(room: Option<Room>) -> Self {
        Self { room, ..Self::default() }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.metrics.stills_held.dec();
        self.metrics.still_bytes.dec_by(self.bytes);
    }
}

impl Still {
    /// After pass 0, whose work waited for `queued`.
    pub fn begin(order: FrameOrder, first: Pass, queued: Duration, held: Held) -> Self {
        let stats = &first.frame.stats;
        let (backend, device_bytes, millis) = (stats.backend, stats.device_bytes, stats.total_millis);
        let mut timings = timings(&first, queued);
        timings.pages_micros += order.opening_micros;
        let Pass { frame, adapter, cache } = first;
        Self { order, backend, adapter, device_bytes, millis, held, mean: Accumulator::new(frame.pixels), timings, cache }
    }

    /// Adds the next pass.
    pub fn add(&mut self, pass: &Pass, queued: Duration) {
        self.mean.add(&pass.frame.pixels);
        self.note(pass, queued);
        self.millis += pass.frame.stats.total_millis;
        self.device_bytes = pass.frame.stats.device_bytes;
        if let Some(room) = &self.held.room {
            room.metrics.passes.inc();
        }
    }

    /// Counts the work of a pass that is not added.
    pub fn note(&mut self, pass: &Pass, queued: Duration) {
        let more = timings(pass, queued);
        self.timings.queue_micros += more.queue_micros;
        self.timings.pages_micros += more.pages_micros;
        self.timings.render_micros += more.render_micros;
        add_cache_use(&mut self.cache, &pass.cache);
    }

    /// How many were added, at least 1.
    pub fn passes(&self) -> u32 {
        self.mean.passes()
    }

    /// Whether all that were ordered are.
    pub fn is_done(&self) -> bool {
        self.passes() >= self.order.passes
    }

    /// Their mean.
    pub fn pixels(&self) -> &lumisphere::render::Pixels {
        self.mean.pixels()
    }

    /// For the frame that tells of them: what was not told yet.
    pub fn take_account(&mut self) -> (proto::FrameTimings, proto::FrameCacheUse) {
        (std::mem::take(&mut self.timings), std::mem::take(&mut self.cache))
    }
}

fn timings(pass: &Pass, queued: Duration) -> proto::FrameTimings {
    let stats = &pass.frame.stats;
    let prepare_micros = (1e3 * stats.prepare_millis) as u64;
    proto::FrameTimings {
        queue_micros: queued.as_micros() as u64,
        pages_micros: prepare_micros,
        render_micros: ((1e3 * stats.total_millis) as u64).saturating_sub(prepare_micros),
        encode_micros: 0,
    }
}
