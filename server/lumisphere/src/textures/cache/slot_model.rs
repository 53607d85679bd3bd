//! The slot's text compiled again over loom's locks: every interleaving of these few threads is tried.

mod sync {
    pub use std::sync::PoisonError;

    pub use loom::sync::{Arc, Condvar, Mutex, MutexGuard};
}
// Twice is the point: once over std's locks, once over loom's.
#[allow(clippy::duplicate_mod)]
#[path = "slot.rs"]
mod slot;

use self::slot::{Found, Outcome, Slot};
use self::sync::{Arc, Mutex};

/// A cache of one slot: the order of eviction is whether the slot is in it.
struct OnePage {
    slot: Slot<u32, ()>,
    /// What is resident, as the budget sees it; taken before the slot's lock.
    resident: Mutex<Option<u32>>,
    reads: Mutex<u32>,
}

impl OnePage {
    fn new() -> Arc<Self> {
        Arc::new(Self { slot: Slot::new(), resident: Mutex::new(None), reads: Mutex::new(0) })
    }

    /// As the cache does it: a value of at least `wanted` rows.
    fn ask(&self, wanted: u32) -> u32 {
        loop {
            match self.slot.look(|rows| *rows >= wanted) {
                Found::Value(rows) => return rows,
                Found::Theirs(flight) => match flight.wait() {
                    Outcome::Landed(Ok(rows)) if rows >= wanted => return rows,
                    _ => {}
                },
                Found::Mine(flight, _) => {
                    *self.reads.lock().unwrap() += 1;
                    {
                        let mut resident = self.resident.lock().unwrap();
                        *resident = Some(wanted);
                        self.slot.install(wanted);
                    }
                    self.slot.finish(&flight, Outcome::Landed(Ok(wanted)));
                    return wanted;
                }
            }
        }
    }

    fn evict(&self) {
        let mut resident = self.resident.lock().unwrap();
        assert_eq!(self.slot.vacate(), resident.take(), "the slot holds what the budget was charged for");
    }

    fn check(&self) {
        assert_eq!(self.slot.get(), *self.resident.lock().unwrap());
    }
}

fn model(
    threads: impl Fn(&Arc<OnePage>) -> Vec<loom::thread::JoinHandle<()>> + Sync + Send + 'static,
    reads: std::ops::RangeInclusive<u32>,
) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(3);
    builder.check(move || {
        let page = OnePage::new();
        for thread in threads(&page) {
            thread.join().unwrap();
        }
        page.check();
        let count = *page.reads.lock().unwrap();
        assert!(reads.contains(&count), "{count} reads");
    });
}

fn spawn(page: &Arc<OnePage>, work: impl FnOnce(&OnePage) + 'static) -> loom::thread::JoinHandle<()> {
    let page = page.clone();
    loom::thread::spawn(move || work(&page))
}

#[test]
fn concurrent_requests_for_one_page_read_it_once() {
    model(|page| (0..3).map(|_| spawn(page, |page| assert_eq!(page.ask(1), 1))).collect(), 1..=1);
}

#[test]
fn an_eviction_between_any_two_steps_costs_at_most_one_more_read_and_never_the_account() {
    model(
        |page| vec![spawn(page, |p| assert_eq!(p.ask(1), 1)), spawn(page, |p| assert_eq!(p.ask(1), 1)), spawn(page, OnePage::evict)],
        1..=2,
    );
}

#[test]
fn who_needs_more_rows_than_the_read_under_way_brings_reads_again_and_gets_them() {
    model(|page| vec![spawn(page, |p| assert!(p.ask(1) >= 1)), spawn(page, |p| assert_eq!(p.ask(2), 2))], 1..=2);
}

#[test]
fn a_lost_read_leaves_the_page_to_those_who_wait() {
    let lose = |page: &OnePage| match page.slot.look(|_| true) {
        Found::Mine(flight, _) => page.slot.finish(&flight, Outcome::Lost),
        Found::Value(_) | Found::Theirs(_) => {}
    };
    model(move |page| vec![spawn(page, lose), spawn(page, |p| assert_eq!(p.ask(1), 1))], 1..=1);
}
