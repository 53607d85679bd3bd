//! The device that frames are rendered on: opened anew when it was lost (a driver's restart, an adapter taken away). What it held is gone.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::gpu::{Gpu, GpuError};

/// Between two attempts to open a device after one failed: the first, and the longest of those that follow, each twice the one before.
const PATIENCE: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));

/// Opens devices.
type Open = dyn Fn() -> Result<Gpu, GpuError> + Send + Sync;

/// The device that is open, or was.
pub(super) struct OpenDevice {
    state: Mutex<State>,
    open: Box<Open>,
}

struct State {
    gpu: Arc<Gpu>,
    /// Those before it.
    replaced: u64,
    /// After one, until a frame was computed.
    next_attempt: Option<Instant>,
    patience: Duration,
}

/// The device of a frame.
pub(super) struct Device {
    pub gpu: Arc<Gpu>,
    /// Nothing of what was on the one before is on it.
    pub is_new: bool,
}

impl OpenDevice {
    /// The most capable adapter's.
    pub fn new() -> Result<Self, GpuError> {
        Self::by(Gpu::new)
    }

    fn by(open: impl Fn() -> Result<Gpu, GpuError> + Send + Sync + 'static) -> Result<Self, GpuError> {
        let state = State { gpu: Arc::new(open()?), replaced: 0, next_attempt: None, patience: PATIENCE.0 };
        Ok(Self { state: Mutex::new(state), open: Box::new(open) })
    }

    /// As it is, lost or not.
    pub fn latest(&self) -> Arc<Gpu> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).gpu.clone()
    }

    /// How many came before it.
    pub fn replaced(&self) -> u64 {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).replaced
    }

    /// One that works, as far as is known; an error while none can be opened.
    pub fn working(&self) -> Result<Device, GpuError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if !state.gpu.is_lost() {
            return Ok(Device { gpu: state.gpu.clone(), is_new: false });
        }
        let now = Instant::now();
        if state.next_attempt.is_some_and(|at| now < at) {
            return Err(GpuError::Failed { reason: "the device was lost and could not be opened again yet".into() });
        }
        // One that opens and is lost again with the first frame is not tried all the time either.
        state.next_attempt = Some(now + state.patience);
        state.patience = (2 * state.patience).min(PATIENCE.1);
        state.gpu = Arc::new((self.open)()?);
        state.replaced += 1;
        Ok(Device { gpu: state.gpu.clone(), is_new: true })
    }

    /// A frame was computed on it.
    pub fn has_worked(&self) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        (state.next_attempt, state.patience) = (None, PATIENCE.0);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    #[test]
    fn a_lost_device_is_opened_anew_once_and_not_tried_all_the_time() {
        if crate::gpu::test_gpu().is_none() {
            return;
        }
        let attempts = Arc::new(AtomicUsize::new(0));
        let counted = attempts.clone();
        let device = OpenDevice::by(move || match counted.fetch_add(1, Ordering::SeqCst) {
            2 => Err(GpuError::NoAdapter { reason: "taken away".into() }),
            _ => Gpu::new(),
        });
        let device = device.unwrap();
        let first = device.working().unwrap();
        assert!(!first.is_new && Arc::ptr_eq(&first.gpu, &device.latest()));
        first.gpu.lose();
        let second = device.working().unwrap();
        assert!(second.is_new && !second.gpu.is_lost() && !Arc::ptr_eq(&first.gpu, &second.gpu));
        assert!(!device.working().unwrap().is_new);
        // Lost before it computed anything: not at once again.
        second.gpu.lose();
        assert!(matches!(device.working(), Err(GpuError::Failed { .. })));
        assert_eq!(attempts.load(Ordering::SeqCst), 2);
        device.has_worked();
        // The third attempt fails; the fourth has to wait.
        assert_eq!(device.working().err(), Some(GpuError::NoAdapter { reason: "taken away".into() }));
        assert!(matches!(device.working(), Err(GpuError::Failed { .. })));
        assert_eq!(attempts.load(Ordering::SeqCst), 3);
        device.state.lock().unwrap().next_attempt = Some(Instant::now());
        assert!(device.working().unwrap().is_new);
        assert_eq!((attempts.load(Ordering::SeqCst), device.replaced()), (4, 2));
    }
}
