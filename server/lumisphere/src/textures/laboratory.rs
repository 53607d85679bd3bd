//! The cache laboratory: a recorded trace through any strategy × policy × size, beside the fewest misses possible.
//!
//! [`simulate`] counts without decoding, with the very policies that the cache has, and with L. Belady's optimum (1966), which knows
//! the future. [`replay`] sends the trace through a real cache over real data: bytes and time.

use std::collections::{BinaryHeap, HashMap};
use std::sync::Arc;
use std::time::Instant;

use super::cache::{Cache, CacheOptions, CacheSnapshot};
use super::codec::{BLOCK_ROWS, Codec};
use super::error::StoreError;
use super::page::{PageId, PageShape};
use super::policy::{PageKey, Policy, PolicyKind};
use super::read_strategy::ReadStrategy;
use super::trace::{Trace, TraceEvent};
use super::version::DatasetVersion;

/// Who decides what leaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Order {
    /// One of the cache's own.
    Policy(PolicyKind),
    /// What is needed last leaves: no order has fewer misses, if all pages are of one size.
    Belady,
}

impl Order {
    /// "lru", …, "belady".
    pub fn name(self) -> &'static str {
        match self {
            Self::Policy(kind) => kind.name(),
            Self::Belady => "belady",
        }
    }
}

/// One experiment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setting {
    /// How a miss is read.
    pub strategy: ReadStrategy,
    /// Of the pages; it says how many rows are unpacked together.
    pub codec: Codec,
    /// Who leaves.
    pub order: Order,
    /// Most bytes of decoded pages.
    pub capacity_bytes: u64,
}

/// What came of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// The experiment.
    pub setting: Setting,
    /// Texels fetched; whole pages count none.
    pub texel_fetches: u64,
    /// Fetches, and requests for whole pages, that had to read.
    pub misses: u64,
    /// Visits to pages, or to blocks under [`ReadStrategy::Block`].
    pub visits: u64,
    /// Visits that found nothing of the page or block: what Belady's order has fewest of.
    pub loads: u64,
    /// Unpacked.
    pub rows_decoded: u64,
    /// Of those rows.
    pub bytes_decoded: u64,
    /// (loads − Belady's) / (LRU's − Belady's): 0 is perfect, 1 is LRU. None where both are equal, and outside of [`compare`].
    pub excess: Option<f64>,
}

/// Every strategy × order × size, LRU and Belady among the orders whether named or not (for [`Outcome::excess`]).
pub fn compare(trace: &Trace, codec: Codec, strategies: &[ReadStrategy], orders: &[Order], sizes: &[u64]) -> Vec<Outcome> {
    let mut outcomes = Vec::new();
    for &strategy in strategies {
        for &capacity_bytes in sizes {
            let run = |order| simulate(trace, Setting { strategy, codec, order, capacity_bytes });
            let (lru, best) = (run(Order::Policy(PolicyKind::Lru)), run(Order::Belady));
            let gap = lru.loads as f64 - best.loads as f64;
            for &order in orders {
                let outcome = match order {
                    Order::Policy(PolicyKind::Lru) => lru,
                    Order::Belady => best,
                    order => run(order),
                };
                let excess = (gap != 0.0).then(|| (outcome.loads as f64 - best.loads as f64) / gap);
                outcomes.push(Outcome { excess, ..outcome });
            }
        }
    }
    outcomes
}

/// Counts what a cache would do with the trace, one thread's order of requests assumed.
pub fn simulate(trace: &Trace, setting: Setting) -> Outcome {
    let policy: Box<dyn Policy> = match setting.order {
        Order::Policy(kind) => kind.make(setting.capacity_bytes),
        Order::Belady => Box::new(Belady::new(next_visits(trace, setting.strategy))),
    };
    let mut pool = Pool::new(setting, policy);
    for event in &trace.events {
        match *event {
            TraceEvent::Frame => {
                pool.last = None;
                pool.policy.begin_frame();
            }
            TraceEvent::Row { version, page, row, fetches } => {
                let shape = trace.versions[version as usize].shape;
                let missed = pool.visit(unit_of(setting.strategy, version, page, Some(row)), shape, Some(row));
                pool.outcome.texel_fetches += u64::from(fetches);
                // A page that is not kept is missed by every fetch.
                pool.outcome.misses += if pool.keeps(shape) { u64::from(missed) } else { u64::from(fetches) };
            }
            TraceEvent::Page { version, page } => {
                let shape = trace.versions[version as usize].shape;
                pool.outcome.misses += u64::from(pool.visit(unit_of(setting.strategy, version, page, None), shape, None));
            }
        }
    }
    pool.outcome
}

/// The trace through a real cache, with texels of column 0; the cache's counters and the nanoseconds that it took, on this thread alone.
/// `versions` are the trace's, in its order. None once someone `is_unwanted`, which is asked now and then.
pub fn replay(
    trace: &Trace,
    versions: &[Arc<DatasetVersion>],
    options: CacheOptions,
    is_unwanted: &dyn Fn() -> bool,
) -> Result<Option<(CacheSnapshot, u64)>, StoreError> {
    let cache = Cache::new(options);
    let started = Instant::now();
    let mut readers: Vec<_> = versions.iter().map(|version| cache.reader(version)).collect();
    let missing = |version: u32| StoreError::NotFound { what: format!("version {version} of the trace") };
    let mut requests = 0u64;
    let mut is_over = || {
        requests += 1;
        requests % REQUESTS_BETWEEN_LOOKS == 1 && is_unwanted()
    };
    for event in &trace.events {
        match *event {
            TraceEvent::Frame => {
                readers = versions.iter().map(|version| cache.reader(version)).collect();
                cache.begin_frame();
            }
            TraceEvent::Row { version, page, row, fetches } => {
                let reader = readers.get_mut(version as usize).ok_or_else(|| missing(version))?;
                for _ in 0..fetches {
                    if is_over() {
                        return Ok(None);
                    }
                    reader.texel(page, 0, row)?;
                }
            }
            TraceEvent::Page { version, page } => {
                if is_over() {
                    return Ok(None);
                }
                let version = versions.get(version as usize).ok_or_else(|| missing(version))?;
                cache.page(version, page)?;
            }
        }
    }
    drop(readers);
    let nanos = started.elapsed().as_nanos() as u64;
    Ok(Some((cache.snapshot(), nanos)))
}

// Some milliseconds, if every one decodes a page.
const REQUESTS_BETWEEN_LOOKS: u64 = 64;

/// What is cached as one: a page, or a block of one. Version, page, block + 1.
type Unit = (u32, u32, u32);

fn unit_of(strategy: ReadStrategy, version: u32, page: PageId, row: Option<u32>) -> Unit {
    let block = row.filter(|_| strategy == ReadStrategy::Block).map_or(0, |row| row / BLOCK_ROWS + 1);
    (version, page.0, block)
}

/// Resident units and the rows that each has.
struct Pool {
    setting: Setting,
    policy: Box<dyn Policy>,
    frame_of: HashMap<Unit, u32>,
    frames: Vec<(Unit, u64, u32)>,
    free: Vec<u32>,
    bytes: u64,
    last: Option<Unit>,
    outcome: Outcome,
}

impl Pool {
    fn new(setting: Setting, policy: Box<dyn Policy>) -> Self {
        let outcome =
            Outcome { setting, texel_fetches: 0, misses: 0, visits: 0, loads: 0, rows_decoded: 0, bytes_decoded: 0, excess: None };
        Self { setting, policy, frame_of: HashMap::new(), frames: vec![], free: vec![], bytes: 0, last: None, outcome }
    }

    fn keeps(&self, shape: PageShape) -> bool {
        self.charge(shape, self.setting.strategy == ReadStrategy::Block) <= self.setting.capacity_bytes
    }

    fn charge(&self, shape: PageShape, is_block: bool) -> u64 {
        let height = if is_block { shape.height.min(BLOCK_ROWS) } else { shape.height };
        PageShape { height, ..shape }.resident_bytes() as u64
    }

    /// Whether something had to be read; `row` is None for the whole page.
    fn visit(&mut self, unit: Unit, shape: PageShape, row: Option<u32>) -> bool {
        let is_new_visit = self.last.replace(unit) != Some(unit);
        self.outcome.visits += u64::from(is_new_visit);
        let wanted = match row {
            Some(row) => self.setting.strategy.rows_wanted(self.setting.codec, &shape, row),
            None => 0..shape.height,
        };
        if let Some(&frame) = self.frame_of.get(&unit) {
            if is_new_visit {
                self.policy.touch(frame);
            }
            let rows = &mut self.frames[frame as usize].2;
            let had = *rows;
            if row.is_some_and(|row| row < had) || had >= wanted.end {
                return false;
            }
            *rows = wanted.end;
            let resumes = self.setting.strategy.resumes(self.setting.codec, &shape, had);
            self.count_decoded(shape, if resumes { wanted.end - had } else { self.setting.codec.unpacked_rows(&shape, &(0..wanted.end)) });
            return true;
        }
        self.outcome.loads += u64::from(is_new_visit);
        self.count_decoded(shape, self.setting.codec.unpacked_rows(&shape, &wanted));
        self.insert(unit, self.charge(shape, unit.2 > 0), wanted.end);
        true
    }

    fn count_decoded(&mut self, shape: PageShape, rows: u32) {
        self.outcome.rows_decoded += u64::from(rows);
        self.outcome.bytes_decoded += u64::from(rows) * (shape.row_values() * shape.pixel.bytes()) as u64;
    }

    fn insert(&mut self, unit: Unit, bytes: u64, rows: u32) {
        if bytes > self.setting.capacity_bytes {
            return;
        }
        let key = PageKey((u64::from(unit.0) << 52) ^ (u64::from(unit.1) << 20) ^ u64::from(unit.2));
        self.policy.expect(key, bytes);
        while self.bytes + bytes > self.setting.capacity_bytes {
            let frame = self.policy.evict().expect("bytes belong to frames in the policy's order");
            let (unit, bytes, _) = self.frames[frame as usize];
            self.frame_of.remove(&unit);
            self.free.push(frame);
            self.bytes -= bytes;
        }
        let frame = self.free.pop().unwrap_or_else(|| {
            self.frames.push((unit, bytes, rows));
            self.frames.len() as u32 - 1
        });
        self.frames[frame as usize] = (unit, bytes, rows);
        self.frame_of.insert(unit, frame);
        self.bytes += bytes;
        self.policy.insert(frame, key, bytes);
    }
}

/// For each visit of a unit, the number of its next visit; `u64::MAX` if there is none.
fn next_visits(trace: &Trace, strategy: ReadStrategy) -> Vec<u64> {
    let visit = |event: &TraceEvent| match *event {
        TraceEvent::Frame => None,
        TraceEvent::Row { version, page, row, .. } => Some(unit_of(strategy, version, page, Some(row))),
        TraceEvent::Page { version, page } => Some(unit_of(strategy, version, page, None)),
    };
    // A frame's beginning ends a visit.
    let mut visits: Vec<Option<Unit>> = trace.events.iter().map(visit).collect();
    visits.dedup();
    let visits: Vec<Unit> = visits.into_iter().flatten().collect();
    let mut next_of: HashMap<Unit, u64> = HashMap::new();
    let mut next = vec![u64::MAX; visits.len()];
    for (at, unit) in visits.iter().enumerate().rev() {
        next[at] = next_of.insert(*unit, at as u64).unwrap_or(u64::MAX);
    }
    next
}

/// Gives up what is visited again last. It is told of every visit once, by `insert` or `touch`, and so knows where in the trace it is.
#[derive(Debug)]
struct Belady {
    next_visits: Vec<u64>,
    now: usize,
    /// Next visit of each slot's occupant; None: free.
    next_of_slot: Vec<Option<u64>>,
    /// Latest first; entries that `next_of_slot` contradicts are out of date.
    queue: BinaryHeap<(u64, u32)>,
}

impl Belady {
    fn new(next_visits: Vec<u64>) -> Self {
        Self { next_visits, now: 0, next_of_slot: Vec::new(), queue: BinaryHeap::new() }
    }

    fn visit(&mut self, slot: u32) {
        let next = self.next_visits.get(self.now).copied().unwrap_or(u64::MAX);
        self.now += 1;
        if self.next_of_slot.len() <= slot as usize {
            self.next_of_slot.resize(slot as usize + 1, None);
        }
        self.next_of_slot[slot as usize] = Some(next);
        self.queue.push((next, slot));
    }
}

impl Policy for Belady {
    fn insert(&mut self, slot: u32, _: PageKey, _: u64) {
        self.visit(slot);
    }
    fn touch(&mut self, slot: u32) {
        self.visit(slot);
    }
    fn remove(&mut self, slot: u32) {
        self.next_of_slot[slot as usize] = None;
    }
    fn evict(&mut self) -> Option<u32> {
        loop {
            let (next, slot) = self.queue.pop()?;
            if self.next_of_slot[slot as usize] == Some(next) {
                self.next_of_slot[slot as usize] = None;
                return Some(slot);
            }
        }
    }
}
