//! What hits write: counters and the order of uses, in pieces of which every thread has its own, so that hits never meet.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::chunk::Ticket;
use super::stats::CacheStats;

/// Threads beyond this many share pieces.
const STRIPES: u32 = 32;
/// Uses noted before someone tries to tell the policy.
const TOUCHES: usize = 256;
/// Uses noted at most while the policy is busy; more are forgotten, which costs only order.
const MOST_TOUCHES: usize = 4 * TOUCHES;

static NEXT_THREAD: AtomicU32 = AtomicU32::new(0);

thread_local! {
    static STRIPE: Cell<u32> = Cell::new(NEXT_THREAD.fetch_add(1, Ordering::Relaxed) % STRIPES);
}

/// Every thread's piece.
#[derive(Debug)]
pub(super) struct Stripes {
    stripes: Vec<Stripe>,
}

// Two cache lines apart, so that one thread's writes do not slow another's.
#[derive(Debug)]
#[repr(align(128))]
struct Stripe {
    has_touches: AtomicBool,
    notes: Mutex<Notes>,
}

#[derive(Debug)]
pub(super) struct Notes {
    /// By version slot.
    counters: Vec<CacheStats>,
    touches: Vec<Ticket>,
}

impl Notes {
    pub fn counters(&mut self, version: u32) -> &mut CacheStats {
        let at = version as usize;
        if self.counters.len() <= at {
            self.counters.resize(at + 1, CacheStats::default());
        }
        &mut self.counters[at]
    }
}

impl Stripes {
    pub fn new() -> Self {
        let stripe = |_| Stripe { has_touches: AtomicBool::new(false), notes: Mutex::new(Notes { counters: vec![], touches: vec![] }) };
        Self { stripes: (0..STRIPES).map(stripe).collect() }
    }

    fn own(&self) -> &Stripe {
        &self.stripes[STRIPE.get() as usize]
    }

    /// Counts something; both sides of an equation in one call.
    pub fn count(&self, version: u32, count: impl FnOnce(&mut CacheStats)) {
        count(lock(&self.own().notes).counters(version));
    }

    /// Counts, and notes uses in their order; true if the policy should be told soon.
    pub fn count_uses(&self, version: u32, uses: &[Ticket], count: impl FnOnce(&mut CacheStats)) -> bool {
        let stripe = self.own();
        let mut notes = lock(&stripe.notes);
        count(notes.counters(version));
        let room = MOST_TOUCHES.saturating_sub(notes.touches.len());
        notes.touches.extend_from_slice(&uses[uses.len().saturating_sub(room)..]);
        stripe.has_touches.store(true, Ordering::Release);
        notes.touches.len() >= TOUCHES
    }

    /// Hands every noted use to `touch`, each thread's in its order. Called under the policy's lock, so that each is told once, and
    /// before every arrival: what happens between two arrivals keeps its place between them.
    pub fn drain(&self, mut touch: impl FnMut(Ticket)) {
        for stripe in &self.stripes {
            if stripe.has_touches.swap(false, Ordering::Acquire) {
                for ticket in lock(&stripe.notes).touches.drain(..) {
                    touch(ticket);
                }
            }
        }
    }

    /// Sums over threads, by version slot. Each thread's counters are of one moment.
    pub fn sum(&self) -> Vec<CacheStats> {
        let mut sums: Vec<CacheStats> = Vec::new();
        for stripe in &self.stripes {
            let notes = lock(&stripe.notes);
            sums.resize(sums.len().max(notes.counters.len()), CacheStats::default());
            for (sum, counters) in sums.iter_mut().zip(&notes.counters) {
                sum.add_events(counters);
            }
        }
        sums
    }
}

fn lock(notes: &Mutex<Notes>) -> MutexGuard<'_, Notes> {
    notes.lock().unwrap_or_else(PoisonError::into_inner)
}
