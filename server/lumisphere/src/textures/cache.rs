//! Decoded pages in memory: exact least-recently-used order under a byte budget, one read for any number of waiting readers.
//!
//! A page's place is found by two array look-ups (version slot, page number); nothing is hashed. The lock is held to find, order
//! and evict, never while reading or decoding, so a slow read delays only those who want the same page. Other policies, read
//! strategies (parts of pages) and tiers have their place beside `policy::lru`; the counters already keep apart what they need.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use super::error::StoreError;
use super::page::{Page, PageId};
use super::policy::{Lru, PageKey, Policy};
use super::version::{DatasetVersion, ReadCost};

/// What the cache did since it was made. `look_ups = hits + misses`, and `misses − coalesced_waits` pages were read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheStats {
    /// Pages asked for.
    pub look_ups: u64,
    /// Found in memory.
    pub hits: u64,
    /// Not in memory, whoever read them then.
    pub misses: u64,
    /// Misses that another reader's read answered.
    pub coalesced_waits: u64,
    /// Reads that failed.
    pub failed_reads: u64,
    /// Pages given up for others, or for a smaller budget.
    pub evictions: u64,
    /// Pages larger than the whole budget: read, handed out, not kept.
    pub uncached: u64,
    /// From disk.
    pub bytes_read: u64,
    /// Of decoded texels.
    pub bytes_decoded: u64,
    /// Spent waiting for the disk, summed over readers.
    pub read_nanos: u64,
    /// Spent checking and unpacking, summed over readers.
    pub decode_nanos: u64,
    /// Pages held now.
    pub resident_pages: u64,
    /// Bytes held now; never above the budget.
    pub resident_bytes: u64,
    /// Most bytes ever held at once.
    pub peak_bytes: u64,
    /// Bytes that may be held.
    pub budget_bytes: u64,
}

/// A shared cache of decoded pages of any number of versions. What callers still hold of evicted pages is not counted.
#[derive(Debug)]
pub struct Cache {
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    stats: CacheStats,
    /// `[version slot][page]`; as long as the pages that were asked for.
    table: Vec<Vec<Place>>,
    frames: Vec<Option<Frame>>,
    free: Vec<u32>,
    order: Lru,
}

/// Where a page is.
#[derive(Debug, Clone, Default)]
enum Place {
    #[default]
    Absent,
    Loading(Arc<Flight>),
    Frame(u32),
}

/// A resident page.
#[derive(Debug)]
struct Frame {
    key: Key,
    page: Arc<Page>,
}

#[derive(Debug, Clone, Copy)]
struct Key {
    slot: u32,
    page: PageId,
}

/// One read that others wait on.
#[derive(Debug, Default)]
struct Flight {
    outcome: Mutex<Option<Outcome>>,
    landed: Condvar,
}

#[derive(Debug, Clone)]
enum Outcome {
    Landed(Result<Arc<Page>, StoreError>),
    /// The reader panicked: whoever waits tries again.
    Lost,
}

impl Flight {
    fn land(&self, outcome: Outcome) {
        *self.outcome.lock().unwrap_or_else(PoisonError::into_inner) = Some(outcome);
        self.landed.notify_all();
    }

    fn wait(&self) -> Outcome {
        let mut outcome = self.outcome.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(outcome) = &*outcome {
                return outcome.clone();
            }
            outcome = self.landed.wait(outcome).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl Cache {
    /// Holds at most `budget_bytes` of pages ([`Page::resident_bytes`]).
    pub fn new(budget_bytes: u64) -> Self {
        let stats = CacheStats { budget_bytes, ..CacheStats::default() };
        let state = State { stats, table: Vec::new(), frames: Vec::new(), free: Vec::new(), order: Lru::new() };
        Self { state: Mutex::new(state) }
    }

    /// The page, from memory or disk. While one caller reads a page, others who want it wait for that read, its error included.
    pub fn page(&self, version: &Arc<DatasetVersion>, page: PageId) -> Result<Arc<Page>, StoreError> {
        self.page_with_cost(version, page).map(|(page, _)| page)
    }

    /// The same, and what it cost: None when the page was in memory, nothing read when another caller's read answered.
    pub fn page_with_cost(&self, version: &Arc<DatasetVersion>, page: PageId) -> Result<(Arc<Page>, Option<ReadCost>), StoreError> {
        if page.0 >= version.page_count() {
            // The version says it best; a page that cannot exist gets no place in the table.
            return version.read_page_with_cost(page).map(|(page, cost)| (Arc::new(page), Some(cost)));
        }
        let mut cost = None;
        let read = || {
            let (page, read_cost) = version.read_page_with_cost(page)?;
            cost = Some(read_cost);
            Ok((page, read_cost))
        };
        let (page, was_resident) = self.page_with(Key { slot: version.slot(), page }, read)?;
        Ok((page, if was_resident { None } else { Some(cost.unwrap_or_default()) }))
    }

    // The page, and whether it was in memory.
    fn page_with(&self, key: Key, read: impl FnOnce() -> Result<(Page, ReadCost), StoreError>) -> Result<(Arc<Page>, bool), StoreError> {
        let mut state = self.state();
        state.stats.look_ups += 1;
        if let Place::Frame(frame) = *state.place(key) {
            state.stats.hits += 1;
            state.order.touch(frame);
            let resident = state.frames[frame as usize].as_ref().expect("a page's frame is occupied");
            return Ok((resident.page.clone(), true));
        }
        state.stats.misses += 1;
        loop {
            match state.place(key).clone() {
                Place::Frame(frame) => {
                    // Another reader brought it while this one waited on a lost read.
                    state.stats.coalesced_waits += 1;
                    let resident = state.frames[frame as usize].as_ref().expect("a page's frame is occupied");
                    return Ok((resident.page.clone(), false));
                }
                Place::Loading(flight) => {
                    state.stats.coalesced_waits += 1;
                    drop(state);
                    match flight.wait() {
                        Outcome::Landed(result) => return result.map(|page| (page, false)),
                        Outcome::Lost => {
                            state = self.state();
                            state.stats.coalesced_waits -= 1;
                        }
                    }
                }
                Place::Absent => {
                    let flight = Arc::new(Flight::default());
                    *state.place(key) = Place::Loading(flight.clone());
                    drop(state);
                    let reading = Reading { cache: self, key, flight, outcome: Outcome::Lost };
                    return reading.finish(read()).map(|page| (page, false));
                }
            }
        }
    }

    /// The counters, all of the same moment.
    pub fn stats(&self) -> CacheStats {
        self.state().stats
    }

    /// Forgets every page; who holds one keeps it. Counted as evictions.
    pub fn clear(&self) {
        self.state().evict_down_to(0);
    }

    /// Changes the budget; pages that no longer fit leave at once.
    pub fn set_budget(&self, budget_bytes: u64) {
        let mut state = self.state();
        state.stats.budget_bytes = budget_bytes;
        state.evict_down_to(budget_bytes);
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The one read of a missing page; lets the waiters go however it ends.
struct Reading<'a> {
    cache: &'a Cache,
    key: Key,
    flight: Arc<Flight>,
    outcome: Outcome,
}

impl Reading<'_> {
    fn finish(mut self, read: Result<(Page, ReadCost), StoreError>) -> Result<Arc<Page>, StoreError> {
        let mut state = self.cache.state();
        let result = match read {
            Ok((page, cost)) => {
                let page = Arc::new(page);
                state.count(&cost);
                state.keep(self.key, &page);
                Ok(page)
            }
            Err(error) => {
                state.stats.failed_reads += 1;
                *state.place(self.key) = Place::Absent;
                Err(error)
            }
        };
        drop(state);
        self.outcome = Outcome::Landed(result.clone());
        result
    }
}

impl Drop for Reading<'_> {
    fn drop(&mut self) {
        if matches!(self.outcome, Outcome::Lost) {
            *self.cache.state().place(self.key) = Place::Absent;
        }
        self.flight.land(self.outcome.clone());
    }
}

impl State {
    fn place(&mut self, key: Key) -> &mut Place {
        let (slot, page) = (key.slot as usize, key.page.0 as usize);
        if self.table.len() <= slot {
            self.table.resize_with(slot + 1, Vec::new);
        }
        let pages = &mut self.table[slot];
        if pages.len() <= page {
            pages.resize(page + 1, Place::Absent);
        }
        &mut pages[page]
    }

    fn count(&mut self, cost: &ReadCost) {
        self.stats.bytes_read += cost.bytes_read;
        self.stats.bytes_decoded += cost.bytes_decoded;
        self.stats.read_nanos += cost.read_nanos;
        self.stats.decode_nanos += cost.decode_nanos;
    }

    /// Makes room, then takes the page in: the budget holds at every step.
    fn keep(&mut self, key: Key, page: &Arc<Page>) {
        let bytes = page.resident_bytes() as u64;
        if bytes > self.stats.budget_bytes {
            self.stats.uncached += 1;
            *self.place(key) = Place::Absent;
            return;
        }
        self.evict_down_to(self.stats.budget_bytes - bytes);
        let frame = Frame { key, page: page.clone() };
        let index = match self.free.pop() {
            Some(index) => {
                self.frames[index as usize] = Some(frame);
                index
            }
            None => {
                self.frames.push(Some(frame));
                self.frames.len() as u32 - 1
            }
        };
        self.order.insert(index, PageKey(0), bytes);
        *self.place(key) = Place::Frame(index);
        self.stats.resident_pages += 1;
        self.stats.resident_bytes += bytes;
        self.stats.peak_bytes = self.stats.peak_bytes.max(self.stats.resident_bytes);
    }

    fn evict_down_to(&mut self, bytes: u64) {
        while self.stats.resident_bytes > bytes {
            let victim = self.order.evict().expect("resident bytes belong to pages in the order");
            let frame = self.frames[victim as usize].take().expect("a page in the order has a frame");
            self.free.push(victim);
            *self.place(frame.key) = Place::Absent;
            self.stats.evictions += 1;
            self.stats.resident_pages -= 1;
            self.stats.resident_bytes -= frame.page.resident_bytes() as u64;
        }
    }
}

#[cfg(test)]
mod tests;
