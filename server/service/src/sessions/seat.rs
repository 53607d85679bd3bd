//! A place among the few viewers that are sent H.264, and the stream of whoever has it.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::errors::{ApiError, Reason};
use crate::frames::VideoStream;
use crate::video::{NONE_SENT, Video};

/// Of one viewer.
#[derive(Clone, Default)]
pub struct Seat(Arc<Mutex<Option<Taken>>>);

struct Taken {
    stream: VideoStream,
    /// Number of the frame that was sent last.
    sent: Arc<AtomicU64>,
    _place: OwnedSemaphorePermit,
}

impl Seat {
    /// Takes a place, if the viewer has none. Error when there is none left.
    pub fn take(&self, places: &Arc<Semaphore>) -> Result<(), ApiError> {
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
