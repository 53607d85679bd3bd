//! Where one cached thing is: absent, being read, present, or present while more of it is being read. The state machine alone, over
//! whatever locks `super::sync` names, so that `slot_model` can check the same text with loom's.
//!
//! The slot's lock is held for a few instructions, never while reading; who needs the lock of the order of eviction too takes that
//! one first.

use super::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// One place of the dense table.
#[derive(Debug)]
pub(super) struct Slot<T, E> {
    state: Mutex<State<T, E>>,
}

#[derive(Debug)]
struct State<T, E> {
    value: Option<T>,
    flight: Option<Arc<Flight<T, E>>>,
}

/// One read that others may wait on.
#[derive(Debug)]
pub(super) struct Flight<T, E> {
    outcome: Mutex<Option<Outcome<T, E>>>,
    landed: Condvar,
}

/// How a read ended.
#[derive(Debug, Clone)]
pub(super) enum Outcome<T, E> {
    Landed(Result<T, E>),
    /// The reader panicked: whoever waits tries again.
    Lost,
}

/// What a look at a slot gives.
#[derive(Debug)]
pub(super) enum Found<T, E> {
    /// It is there.
    Value(T),
    /// Another is reading: wait for that.
    Theirs(Arc<Flight<T, E>>),
    /// The caller reads, and must call [`Slot::finish`] however that ends. What there was is handed along.
    Mine(Arc<Flight<T, E>>, Option<T>),
}

impl<T: Clone, E: Clone> Slot<T, E> {
    pub fn new() -> Self {
        Self { state: Mutex::new(State { value: None, flight: None }) }
    }

    fn state(&self) -> MutexGuard<'_, State<T, E>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is present.
    #[inline]
    pub fn get(&self) -> Option<T> {
        self.state().value.clone()
    }

    /// The value if it suffices, the read under way, or a new read, which is the caller's.
    pub fn look(&self, suffices: impl Fn(&T) -> bool) -> Found<T, E> {
        let mut state = self.state();
        if let Some(value) = state.value.as_ref().filter(|value| suffices(value)) {
            return Found::Value(value.clone());
        }
        if let Some(flight) = &state.flight {
            return Found::Theirs(flight.clone());
        }
        let flight = Arc::new(Flight { outcome: Mutex::new(None), landed: Condvar::new() });
        state.flight = Some(flight.clone());
        Found::Mine(flight, state.value.clone())
    }

    /// Makes a value present, in place of what was.
    pub fn install(&self, value: T) {
        self.state().value = Some(value);
    }

    /// Takes the value away; a read under way is not disturbed.
    pub fn vacate(&self) -> Option<T> {
        self.state().value.take()
    }

    /// Ends the caller's read and lets the waiters go.
    pub fn finish(&self, flight: &Flight<T, E>, outcome: Outcome<T, E>) {
        self.state().flight = None;
        *flight.outcome.lock().unwrap_or_else(PoisonError::into_inner) = Some(outcome);
        flight.landed.notify_all();
    }
}

impl<T: Clone, E: Clone> Flight<T, E> {
    /// Until the read has ended.
    pub fn wait(&self) -> Outcome<T, E> {
        let mut outcome = self.outcome.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(outcome) = &*outcome {
                return outcome.clone();
            }
            outcome = self.landed.wait(outcome).unwrap_or_else(PoisonError::into_inner);
        }
    }
}
