//! Work of the processor's for while the device is at work itself.

use std::fmt;
use std::sync::{Mutex, PoisonError};

type Work = Box<dyn FnOnce() + Send>;

/// What is to be done the next time that the device is waited for. Dropped, it is done.
#[derive(Default)]
pub(super) struct Meanwhile(Mutex<Vec<Work>>);

impl Meanwhile {
    pub fn add(&self, work: impl FnOnce() + Send + 'static) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(Box::new(work));
    }

    /// In the order of its coming. Another thread's call returns when all is done, too.
    pub fn run(&self) {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        waiting.drain(..).for_each(|work| work());
    }
}

impl Drop for Meanwhile {
    fn drop(&mut self) {
        self.run();
    }
}

impl fmt::Debug for Meanwhile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Meanwhile")
    }
}
