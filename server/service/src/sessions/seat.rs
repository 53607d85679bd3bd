//! A place among the few viewers that are sent H.264, and the stream of whoever has it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use lumisphere::geometry::Camera;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::errors::{ApiError, Reason};
use crate::frames::VideoStream;
use crate::video::{NONE_SENT, Video};
use crate::wire::settings::Output;

/// Of one viewer.
#[derive(Clone, Default)]
pub struct Seat(Arc<Mutex<Option<Taken>>>);

struct Taken {
    stream: VideoStream,
    /// Number of the frame that was sent last.
    sent: Arc<AtomicU64>,
    _place: OwnedSemaphorePermit,
}

/// Longer and shorter side of a frame: larger ones are beyond the encoder.
const MAX_SIDES_PX: (u32, u32) = (3840, 2160);

impl Seat {
    /// Takes a place for whoever wants H.264 and has none; refuses frames that are too large for it.
    pub fn admit(&self, output: &Output, camera: Option<&Camera>, places: &Arc<Semaphore>) -> Result<(), ApiError> {
        if !output.has_video() {
            return Ok(());
        }
        if let Some(intrinsics) = camera.map(Camera::intrinsics) {
            let (width, height) = (intrinsics.width_px, intrinsics.height_px);
            let (long, short) = MAX_SIDES_PX;
            if width.max(height) > long || width.min(height) > short {
                let problem = format!("{width} x {height} pixels, as H264 at most {long} x {short} (or on end) expected");
                return Err(ApiError::field("pose.camera.intrinsics", problem));
            }
        }
        self.take(places)
    }

    /// Error when there is none left.
    fn take(&self, places: &Arc<Semaphore>) -> Result<(), ApiError> {
        let mut seat = self.lock();
        if seat.is_some() {
            return Ok(());
        }
        let full = |_| ApiError::new(Reason::TooManyVideos, "no more viewers are sent H264; ask for another encoding");
        let _place = places.clone().try_acquire_owned().map_err(full)?;
        let sent = Arc::new(AtomicU64::new(NONE_SENT));
        *seat = Video::new(sent.clone()).map(|video| Taken { stream: Arc::new(Mutex::new(video)), sent, _place });
        Ok(())
    }

    /// Gives the place back.
    pub fn leave(&self) {
        *self.lock() = None;
    }

    /// None without a place.
    pub fn stream(&self) -> Option<VideoStream> {
        self.lock().as_ref().map(|taken| taken.stream.clone())
    }

    /// This frame of the stream is on its way.
    pub fn sent(&self, number: u64) {
        if let Some(taken) = &*self.lock() {
            taken.sent.store(number, Ordering::SeqCst);
        }
    }

    /// Whoever decodes from now on has seen nothing.
    pub fn begin_anew(&self) {
        self.sent(NONE_SENT);
    }

    fn lock(&self) -> MutexGuard<'_, Option<Taken>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
