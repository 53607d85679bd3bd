//! The texture cache: decoded pages in memory, compressed blocks below them, each under a byte budget and a policy of its own.
//!
//! Whole pages come through [`Cache::page`] (for the GPU), texels through a [`Reader`] (one a thread, for the CPU). What a miss decodes
//! is the [`ReadStrategy`]'s choice. A page's place is found by two array look-ups; hits take no lock that all threads share: the
//! page's own for a moment, and the thread's own note pad, from which the policy learns of uses before every arrival. One
//! thread alone therefore gets exactly the policy's hits and misses. Concurrent misses of one page cause one read; a slow read
//! delays only those who want that page.
//!
//! `residency` has the budget, `slot` the state machine, `table` the array, `read` what a miss does, `stripes` the note pads.

mod chunk;
mod compressed;
mod read;
mod reader;
mod residency;
mod slot;
#[cfg(test)]
mod slot_model;
mod stats;
mod stripes;
mod table;
/// The locks of `slot`.
mod sync {
    pub use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
}

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

#[doc(hidden)]
pub use self::reader::Uncounted;
pub use self::reader::{Counted, Reader, Tally};
pub use self::stats::{CacheSnapshot, CacheStats, CompressedStats, VersionStats};

use self::chunk::Chunk;
use self::compressed::CompressedTier;
use self::read::{Miss, Want};
use self::residency::Residency;
use self::slot::{Flight, Found, Outcome};
use self::stripes::Stripes;
use self::table::{ChunkSlot, Part, Table, VersionTable};
use super::error::StoreError;
use super::page::{Page, PageId};
use super::policy::PolicyKind;
use super::read_strategy::ReadStrategy;
use super::trace::{Recorder, Trace, TraceEvent};
use super::version::DatasetVersion;

/// What a cache begins with; all of it can be changed while it serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CacheOptions {
    /// Most bytes of decoded pages ([`Page::resident_bytes`]).
    pub decoded_bytes: u64,
    /// Most bytes of compressed blocks; 0 turns the tier off.
    pub compressed_bytes: u64,
    /// Order of eviction of decoded pages.
    pub decoded_policy: PolicyKind,
    /// Order of eviction of compressed blocks.
    pub compressed_policy: PolicyKind,
    /// For datasets that have none of their own.
    pub strategy: ReadStrategy,
}

impl CacheOptions {
    /// Decoded pages only, under the default policy, in blocks where single texels are asked for.
    pub fn decoded(decoded_bytes: u64) -> Self {
        Self {
            decoded_bytes,
            compressed_bytes: 0,
            decoded_policy: PolicyKind::DEFAULT,
            compressed_policy: PolicyKind::Lru,
            strategy: ReadStrategy::Block,
        }
    }
}

/// A shared cache of pages of any number of versions. What callers still hold of evicted pages is not counted.
#[derive(Debug)]
pub struct Cache {
    table: Table,
    stripes: Stripes,
    residency: Mutex<Residency>,
    compressed: CompressedTier,
    strategies: Mutex<Strategies>,
    is_recording: AtomicBool,
    recorder: Mutex<Option<Recorder>>,
}

#[derive(Debug)]
struct Strategies {
    default: ReadStrategy,
    of_dataset: BTreeMap<String, ReadStrategy>,
}

impl Strategies {
    fn of(&self, dataset: &str) -> ReadStrategy {
        self.of_dataset.get(dataset).copied().unwrap_or(self.default)
    }
}

/// Rows from the cache.
struct Obtained {
    chunk: Arc<Chunk>,
    /// No one had to read.
    was_resident: bool,
}

impl Cache {
    /// Empty.
    pub fn new(options: CacheOptions) -> Self {
        Self {
            table: Table::new(),
            stripes: Stripes::new(),
            residency: Mutex::new(Residency::new(options.decoded_bytes, options.decoded_policy)),
            compressed: CompressedTier::new(options.compressed_bytes, options.compressed_policy),
            strategies: Mutex::new(Strategies { default: options.strategy, of_dataset: BTreeMap::new() }),
            is_recording: AtomicBool::new(false),
            recorder: Mutex::new(None),
        }
    }

    /// The page, from memory or disk. While one caller reads a page, others who want it wait for that read, its error included.
    pub fn page(&self, version: &Arc<DatasetVersion>, page: PageId) -> Result<Arc<Page>, StoreError> {
        self.page_with_cost(version, page).map(|(page, _)| page)
    }

    /// The same, and what the cache counted for it: None when the page was in memory.
    pub fn page_with_cost(&self, version: &Arc<DatasetVersion>, page: PageId) -> Result<(Arc<Page>, Option<CacheStats>), StoreError> {
        let table = self.table(version);
        let Some(slots) = table.page(page) else {
            // The version says it best.
            return version.read_page(page).map(|page| (Arc::new(page), Some(CacheStats::default())));
        };
        self.record(version, TraceEvent::Page { version: 0, page });
        if let Some(chunk) = slots.whole.get().filter(|chunk| chunk.is_whole()) {
            self.count_page_hit(table, &chunk);
            return Ok((chunk.page.clone(), None));
        }
        let count_miss = |c: &mut CacheStats| {
            c.look_ups += 1;
            c.misses += 1;
            c.page_visits += 1;
            c.visit_misses += 1;
        };
        let mut on_miss = || {
            // A page that is there in part is used all the same.
            let partial = slots.whole.get().map(|chunk| chunk.ticket);
            self.stripes.count_uses(table.slot, partial.as_slice(), count_miss);
        };
        let miss = Miss { version, slots, part: Part::Whole, want: Want::WholePage, strategy: table.strategy() };
        let mut cost = CacheStats::default();
        let Obtained { chunk, was_resident } = self.obtain(&miss, &mut on_miss, &mut cost)?;
        if was_resident {
            // It came between the two looks.
            self.count_page_hit(table, &chunk);
            return Ok((chunk.page.clone(), None));
        }
        count_miss(&mut cost);
        Ok((chunk.page.clone(), Some(cost)))
    }

    fn count_page_hit(&self, table: &VersionTable, chunk: &Chunk) {
        let is_full = self.stripes.count_uses(table.slot, &[chunk.ticket], |c| {
            c.look_ups += 1;
            c.hits += 1;
            c.page_visits += 1;
        });
        if is_full {
            self.try_tell_policy();
        }
    }

    /// Texels of a version, for one thread.
    pub fn reader<'a>(&'a self, version: &'a Arc<DatasetVersion>) -> Reader<'a> {
        Reader::new(self, version, self.table(version).clone())
    }

    /// A reader that leaves out the counting, for the bench that measures what counting costs; all else is as in [`Self::reader`].
    #[doc(hidden)]
    pub fn uncounted_reader<'a>(&'a self, version: &'a Arc<DatasetVersion>) -> Reader<'a, Uncounted> {
        Reader::new(self, version, self.table(version).clone())
    }

    /// Brings a page that will be wanted soon, whole, and says whether it had to be read. Counted as a prefetch, not as a look-up; who
    /// asks for the page meanwhile waits for this read.
    pub fn prefetch(&self, version: &Arc<DatasetVersion>, page: PageId) -> Result<(Arc<Page>, bool), StoreError> {
        let table = self.table(version);
        let Some(slots) = table.page(page) else { return version.read_page(page).map(|page| (Arc::new(page), true)) };
        let miss = Miss { version, slots, part: Part::Whole, want: Want::WholePage, strategy: table.strategy() };
        let Obtained { chunk, was_resident } = self.obtain(&miss, &mut || {}, &mut CacheStats::default())?;
        if !was_resident {
            self.stripes.count(table.slot, |c| c.prefetches += 1);
        }
        Ok((chunk.page.clone(), !was_resident))
    }

    /// A rendered frame begins: some policies work by frames, and recordings mark them.
    pub fn begin_frame(&self) {
        self.told_residency().begin_frame();
        self.compressed.begin_frame();
        if self.is_recording.load(Ordering::Relaxed)
            && let Some(recorder) = &mut *self.recorder()
        {
            recorder.push(TraceEvent::Frame);
        }
    }

    /// The part that was asked for, read if need be. `on_miss` is called once, before anything takes time. What is counted here is added to
    /// `cost`, too.
    fn obtain(&self, miss: &Miss<'_>, on_miss: &mut dyn FnMut(), cost: &mut CacheStats) -> Result<Obtained, StoreError> {
        let slot = miss
            .slots
            .slot(miss.part)
            .ok_or_else(|| StoreError::NotFound { what: format!("rows so far down page {}", miss.slots.page) })?;
        let mut is_miss = false;
        loop {
            let found = slot.look(|chunk| miss.want.is_met_by(chunk));
            if !matches!(found, Found::Value(_)) && !is_miss {
                is_miss = true;
                on_miss();
            }
            match found {
                Found::Value(chunk) if !is_miss => return Ok(Obtained { chunk, was_resident: true }),
                Found::Value(chunk) => return self.answered_by_another(miss, Ok(chunk), cost),
                Found::Theirs(flight) => {
                    let started = Instant::now();
                    let outcome = flight.wait();
                    let nanos = started.elapsed().as_nanos() as u64;
                    self.count(miss, cost, |c| c.wait_nanos += nanos);
                    match outcome {
                        Outcome::Landed(Ok(chunk)) if !miss.want.is_met_by(&chunk) => {}
                        Outcome::Landed(result) => return self.answered_by_another(miss, result, cost),
                        Outcome::Lost => {}
                    }
                }
                Found::Mine(flight, resident) => {
                    let reading = Reading { slot, flight, outcome: Outcome::Lost };
                    return reading.finish(self.read_and_keep(miss, resident.as_deref(), cost));
                }
            }
        }
    }

    fn answered_by_another(
        &self,
        miss: &Miss<'_>,
        result: Result<Arc<Chunk>, StoreError>,
        cost: &mut CacheStats,
    ) -> Result<Obtained, StoreError> {
        self.count(miss, cost, |c| c.coalesced_waits += 1);
        result.map(|chunk| Obtained { chunk, was_resident: false })
    }

    fn read_and_keep(&self, miss: &Miss<'_>, resident: Option<&Chunk>, cost: &mut CacheStats) -> Result<Obtained, StoreError> {
        let (arriving, read) = match miss.read(&self.compressed, resident) {
            Ok(read) => read,
            Err(error) => {
                self.count(miss, cost, |c| c.failed_reads += 1);
                return Err(error);
            }
        };
        let kept = self.told_residency().keep(miss.slots, miss.part, &arriving);
        self.count(miss, cost, |c| {
            c.count(&read);
            c.uncached += u64::from(kept.is_none());
        });
        Ok(Obtained { chunk: kept.unwrap_or_else(|| arriving.unkept()), was_resident: false })
    }

    /// Among all that is counted, and for the one who asked.
    fn count(&self, miss: &Miss<'_>, cost: &mut CacheStats, count: impl Fn(&mut CacheStats)) {
        self.stripes.count(miss.slots.version, &count);
        count(cost);
    }

    /// The counters and sizes of decoded pages of all versions. Each thread's counters are of one moment, so
    /// `look_ups = hits + misses` holds at any time.
    pub fn stats(&self) -> CacheStats {
        let sums = self.stripes.sum();
        let residency = self.residency();
        let mut total = CacheStats::default();
        sums.iter().for_each(|sum| total.add_events(sum));
        with_sizes(total, &residency, residency.total())
    }

    /// Every counter of every tier and version.
    pub fn snapshot(&self) -> CacheSnapshot {
        let sums = self.stripes.sum();
        let (compressed, compressed_policy, compressed_shares) = self.compressed.stats();
        let residency = self.residency();
        let versions = self.table.versions().map(|table| VersionStats {
            slot: table.slot,
            dataset: table.dataset.clone(),
            version: table.version,
            strategy: table.strategy(),
            decoded: with_sizes(sums.get(table.slot as usize).copied().unwrap_or_default(), &residency, residency.share(table.slot)),
            compressed: compressed_shares
                .get(table.slot as usize)
                .copied()
                .unwrap_or(CompressedStats { budget_bytes: compressed.budget_bytes, ..CompressedStats::default() }),
        });
        let versions = versions.collect();
        let mut total = CacheStats::default();
        sums.iter().for_each(|sum| total.add_events(sum));
        let decoded = with_sizes(total, &residency, residency.total());
        CacheSnapshot {
            decoded,
            decoded_policy: residency.kind(),
            compressed,
            compressed_policy,
            strategy: self.strategies().default,
            versions,
        }
    }

    /// Forgets every page and block; who holds one keeps it. Counted as evictions.
    pub fn clear(&self) {
        self.told_residency().clear();
        self.compressed.clear();
    }

    /// Peaks begin anew with what is held now.
    pub fn forget_peaks(&self) {
        self.residency().forget_peaks();
        self.compressed.forget_peaks();
    }

    /// Changes the budget of decoded pages; those that no longer fit leave at once.
    pub fn set_budget(&self, budget_bytes: u64) {
        self.told_residency().set_budget(budget_bytes);
    }

    /// Changes the budget of compressed blocks; 0 turns the tier off.
    pub fn set_compressed_budget(&self, budget_bytes: u64) {
        self.compressed.set_budget(budget_bytes);
    }

    /// Changes the order of eviction of decoded pages; nothing leaves for that.
    pub fn set_policy(&self, kind: PolicyKind) {
        self.told_residency().set_policy(kind);
    }

    /// Changes the order of eviction of compressed blocks.
    pub fn set_compressed_policy(&self, kind: PolicyKind) {
        self.compressed.set_policy(kind);
    }

    /// Changes how misses are read for a dataset's versions, or, with None, for all that have no strategy of their own.
    pub fn set_strategy(&self, dataset: Option<&str>, strategy: ReadStrategy) {
        let mut strategies = self.strategies();
        match dataset {
            Some(dataset) => {
                strategies.of_dataset.insert(dataset.into(), strategy);
            }
            None => strategies.default = strategy,
        }
        for table in self.table.versions() {
            table.set_strategy(strategies.of(&table.dataset));
        }
    }

    /// How a dataset's misses are read.
    pub fn strategy(&self, dataset: &str) -> ReadStrategy {
        self.strategies().of(dataset)
    }

    /// Records requests from now on, in at most so much memory; a recording under way is thrown away. Readers made before do not take
    /// part.
    pub fn start_recording(&self, limit_bytes: usize) {
        *self.recorder() = Some(Recorder::new(limit_bytes));
        self.is_recording.store(true, Ordering::Relaxed);
    }

    /// What was recorded; None if nothing was started. Requests that readers still hold back are lost: drop them first.
    pub fn stop_recording(&self) -> Option<Trace> {
        self.is_recording.store(false, Ordering::Relaxed);
        self.recorder().take().map(Recorder::finish)
    }

    fn record(&self, version: &DatasetVersion, event: TraceEvent) {
        if self.is_recording.load(Ordering::Relaxed) {
            self.record_all(version, [event]);
        }
    }

    /// Events whose version's number is filled in here.
    fn record_all(&self, version: &DatasetVersion, events: impl IntoIterator<Item = TraceEvent>) {
        let Some(recorder) = &mut *self.recorder() else { return };
        let index = recorder.index_of(version);
        for event in events {
            recorder.push(match event {
                TraceEvent::Frame => event,
                TraceEvent::Row { page, row, fetches, .. } => TraceEvent::Row { version: index, page, row, fetches },
                TraceEvent::Page { page, .. } => TraceEvent::Page { version: index, page },
            });
        }
    }

    fn table(&self, version: &DatasetVersion) -> &Arc<VersionTable> {
        self.table.version(version, || self.strategies().of(&version.manifest().dataset))
    }

    fn residency(&self) -> MutexGuard<'_, Residency> {
        self.residency.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The policy's lock, with every use noted so far told.
    fn told_residency(&self) -> MutexGuard<'_, Residency> {
        let mut residency = self.residency();
        self.stripes.drain(|ticket| residency.touch(ticket));
        residency
    }

    /// Without waiting: a hit never does.
    fn try_tell_policy(&self) {
        if let Ok(mut residency) = self.residency.try_lock() {
            self.stripes.drain(|ticket| residency.touch(ticket));
        }
    }

    fn strategies(&self) -> MutexGuard<'_, Strategies> {
        self.strategies.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn recorder(&self) -> MutexGuard<'_, Option<Recorder>> {
        self.recorder.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn with_sizes(events: CacheStats, residency: &Residency, share: residency::Share) -> CacheStats {
    CacheStats {
        evictions: share.evictions,
        resident_pages: share.pages,
        resident_bytes: share.bytes,
        peak_bytes: share.peak_bytes,
        budget_bytes: residency.budget,
        ..events
    }
}

/// The one read of a missing part; lets the waiters go however it ends.
struct Reading<'a> {
    slot: &'a ChunkSlot,
    flight: Arc<Flight<Arc<Chunk>, StoreError>>,
    outcome: Outcome<Arc<Chunk>, StoreError>,
}

impl Reading<'_> {
    fn finish(mut self, result: Result<Obtained, StoreError>) -> Result<Obtained, StoreError> {
        self.outcome = Outcome::Landed(result.as_ref().map(|obtained| obtained.chunk.clone()).map_err(Clone::clone));
        result
    }
}

impl Drop for Reading<'_> {
    fn drop(&mut self) {
        self.slot.finish(&self.flight, self.outcome.clone());
    }
}

#[cfg(test)]
mod tests;
