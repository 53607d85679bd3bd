//! Texels through the cache, for one thread: the pages used last are found without any lock, and counted without any shared write.

use std::marker::PhantomData;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::chunk::{Chunk, Ticket, UNKEPT};
use super::read::{Miss, Want};
use super::stats::CacheStats;
use super::table::{Part, VersionTable};
use super::{Cache, Obtained};
use crate::textures::codec::BLOCK_ROWS;
use crate::textures::error::StoreError;
use crate::textures::page::{Page, PageId, PageShape, mixed};
use crate::textures::read_strategy::ReadStrategy;
use crate::textures::trace::TraceEvent;
use crate::textures::version::DatasetVersion;

/// Pages or blocks remembered; a power of two. A bucket of 16×16 pixels uses a few dozen.
const KEPT: usize = 64;
/// Uses noted before they are handed on.
const USES: usize = 256;
/// Look-ups counted before they are handed on, so that the counters never lag by much.
const UNTOLD_LOOK_UPS: u64 = 1 << 16;
/// Runs recorded before they are handed on.
const RUNS: usize = 4096;

/// Whether a reader counts what it does.
pub trait Tally: std::fmt::Debug {
    /// A constant, so that what is not counted takes no time.
    const COUNTS: bool;
}

/// Every reader that serves.
#[derive(Debug)]
pub struct Counted;

/// None that serves: the bench `texture_cache` measures what counting costs by leaving it out.
#[derive(Debug)]
pub struct Uncounted;

impl Tally for Counted {
    const COUNTS: bool = true;
}

impl Tally for Uncounted {
    const COUNTS: bool = false;
}

/// Reads texels of one dataset version. One a thread; dropping it hands on its counters.
///
/// A row that is missing is read as the dataset's [`ReadStrategy`] says, while the caller waits. Everything found in memory is a hit,
/// whether this reader remembers it or the cache does; what the cache has given up is never a hit.
#[derive(Debug)]
pub struct Reader<'a, T: Tally = Counted> {
    cache: &'a Cache,
    version: &'a Arc<DatasetVersion>,
    table: Arc<VersionTable>,
    kept: Box<[Option<Kept>; KEPT]>,
    is_by_block: bool,
    /// Uses since they were last handed on; the last one is not noted again.
    uses: Vec<Ticket>,
    last_use: Ticket,
    visited: PageId,
    visit_missed: bool,
    look_up_missed: bool,
    /// Look-ups of four fetches that one remembered page answered, not yet in `counters`.
    footprints: u64,
    counters: CacheStats,
    /// What was handed on before, and what the cache counted for its misses.
    handed_on: CacheStats,
    /// Runs of rows; None when nothing records.
    runs: Option<Vec<(PageId, u32, u32)>>,
    tally: PhantomData<T>,
}

/// A chunk, and what a hit needs of it one step nearer.
#[derive(Debug)]
struct Kept {
    page: PageId,
    first_row: u32,
    end_row: u32,
    ticket: Ticket,
    texels: Arc<Page>,
    chunk: Arc<Chunk>,
}

impl Kept {
    fn new(page: PageId, chunk: &Arc<Chunk>) -> Self {
        let (first_row, end_row) = (chunk.rows.start, chunk.rows.end);
        Self { page, first_row, end_row, ticket: chunk.ticket, texels: chunk.page.clone(), chunk: chunk.clone() }
    }
}

/// No page has this number: a version has fewer.
const NO_PAGE: PageId = PageId(u32::MAX);

impl<'a, T: Tally> Reader<'a, T> {
    pub(super) fn new(cache: &'a Cache, version: &'a Arc<DatasetVersion>, table: Arc<VersionTable>) -> Self {
        Self {
            cache,
            version,
            is_by_block: table.strategy() == ReadStrategy::Block,
            table,
            kept: Box::new([const { None }; KEPT]),
            uses: Vec::with_capacity(USES),
            last_use: UNKEPT,
            visited: NO_PAGE,
            visit_missed: false,
            look_up_missed: false,
            footprints: 0,
            counters: CacheStats::default(),
            handed_on: CacheStats::default(),
            runs: cache.is_recording.load(Ordering::Relaxed).then(Vec::new),
            tally: PhantomData,
        }
    }

    /// What this reader asked for so far, and what its misses cost: the part of the cache's counters that is its own.
    pub fn counted(&self) -> CacheStats {
        let mut all = self.handed_on;
        all.add_events(&self.counters);
        count_footprints(&mut all, self.footprints);
        all
    }

    /// A page's size and format, from its header; its texels are not read.
    pub fn shape(&self, page: PageId) -> Result<PageShape, StoreError> {
        let Some(slots) = self.table.page(page) else { return Err(self.no_page(page)) };
        if let Some(header) = slots.header.get() {
            return Ok(header.shape);
        }
        let (header, _) = self.version.page_header(page)?;
        Ok(slots.header.get_or_init(|| Arc::new(header)).shape)
    }

    fn no_page(&self, page: PageId) -> StoreError {
        StoreError::NotFound { what: format!("page {page} of {} version {}", self.table.dataset, self.table.version) }
    }

    /// One texel: a look-up of one fetch. A page or row that is not there is an error, a column beyond the page a caller's bug.
    #[inline]
    pub fn texel(&mut self, page: PageId, x: u32, y: u32) -> Result<[f32; 4], StoreError> {
        let texel = self.fetch(page, x, y);
        self.end_look_up();
        texel
    }

    /// Several texels, which may lie on several pages: one look-up. In the order given, which is the order in which they may miss.
    #[inline]
    pub fn texels<const N: usize>(&mut self, at: [(PageId, u32, u32); N]) -> Result<[[f32; 4]; N], StoreError> {
        let mut texels = [[0.0; 4]; N];
        let mut result = Ok(());
        for (texel, (page, x, y)) in texels.iter_mut().zip(at) {
            match self.fetch(page, x, y) {
                Ok(fetched) => *texel = fetched,
                Err(error) => {
                    result = Err(error);
                    break;
                }
            }
        }
        self.end_look_up();
        result.map(|()| texels)
    }

    /// [`Page::bilinear`] through the cache: one look-up of four fetches.
    #[inline]
    pub fn bilinear(&mut self, page: PageId, (x, y): (u32, u32), weights: (f32, f32)) -> Result<[f32; 4], StoreError> {
        if self.runs.is_none()
            && let Some(kept) = self.kept(page, y)
            && y + 1 < kept.end_row
        {
            let (ticket, texel) = (kept.ticket, kept.texels.bilinear((x, y - kept.first_row), weights));
            self.footprints += u64::from(T::COUNTS);
            self.note_use(page, ticket);
            return Ok(texel);
        }
        let corners = self.texels([(page, x, y), (page, x + 1, y), (page, x, y + 1), (page, x + 1, y + 1)])?;
        Ok(mixed(&corners, weights))
    }

    #[inline]
    fn place(&self, page: PageId, y: u32) -> usize {
        let part = if self.is_by_block { y / BLOCK_ROWS } else { 0 };
        // Blocks of one page lie side by side; a page's six neighbours, too.
        (page.0.wrapping_mul(9).wrapping_add(part)) as usize % KEPT
    }

    /// Remembered, and still the cache's.
    #[inline]
    fn kept(&self, page: PageId, y: u32) -> Option<&Kept> {
        let kept = self.kept[self.place(page, y)].as_ref()?;
        (kept.page == page && kept.first_row <= y && y < kept.end_row && !kept.chunk.is_evicted()).then_some(kept)
    }

    #[inline]
    fn fetch(&mut self, page: PageId, x: u32, y: u32) -> Result<[f32; 4], StoreError> {
        self.counters.texel_fetches += u64::from(T::COUNTS);
        if self.runs.is_some() {
            self.record(page, y);
        }
        if let Some(kept) = self.kept(page, y) {
            let (ticket, texel) = (kept.ticket, kept.texels.texel(x, y - kept.first_row));
            self.note_use(page, ticket);
            return Ok(texel);
        }
        let chunk = self.find(page, y)?;
        Ok(chunk.page.texel(x, y - chunk.rows.start))
    }

    #[inline]
    fn note_use(&mut self, page: PageId, ticket: Ticket) {
        if ticket != self.last_use {
            self.last_use = ticket;
            self.uses.push(ticket);
            self.note_visit(page);
            if self.uses.len() == USES {
                self.hand_on();
            }
        }
        if self.footprints >= UNTOLD_LOOK_UPS {
            self.hand_on();
        }
    }

    #[inline]
    fn note_visit(&mut self, page: PageId) {
        if T::COUNTS && page != self.visited {
            self.visited = page;
            self.visit_missed = false;
            self.counters.page_visits += 1;
        }
    }

    #[inline]
    fn end_look_up(&mut self) {
        if !T::COUNTS {
            return;
        }
        if !std::mem::take(&mut self.look_up_missed) {
            self.counters.look_ups += 1;
            self.counters.hits += 1;
        }
        if self.counters.look_ups >= UNTOLD_LOOK_UPS {
            self.hand_on();
        }
    }

    /// Not remembered here: from the cache or from below.
    #[cold]
    fn find(&mut self, page: PageId, y: u32) -> Result<Arc<Chunk>, StoreError> {
        self.is_by_block = self.table.strategy() == ReadStrategy::Block;
        let chunk = match self.resident(page, y) {
            Some(chunk) => {
                self.note_use(page, chunk.ticket);
                chunk
            }
            None => {
                self.note_visit(page);
                self.miss(page, y)?
            }
        };
        let place = self.place(page, y);
        self.kept[place] = Some(Kept::new(page, &chunk));
        Ok(chunk)
    }

    /// Without a read.
    fn resident(&self, page: PageId, y: u32) -> Option<Arc<Chunk>> {
        let slots = self.table.page(page)?;
        let of_page = slots.whole.get().filter(|chunk| chunk.rows.contains(&y));
        of_page.or_else(|| self.is_by_block.then(|| slots.block(y / BLOCK_ROWS)?.get())?)
    }

    fn miss(&mut self, page: PageId, y: u32) -> Result<Arc<Chunk>, StoreError> {
        self.count_miss();
        let table = self.table.clone();
        let Some(slots) = table.page(page) else { return Err(self.no_page(page)) };
        // A visit to a page that lacks the row is a use of it.
        if let Some(partial) = slots.whole.get().filter(|_| !self.is_by_block) {
            self.note_use(page, partial.ticket);
        }
        // The policy has to hear of all uses so far before it makes room.
        self.hand_on();
        let strategy = self.table.strategy();
        let part = if self.is_by_block { Part::Block(y / BLOCK_ROWS) } else { Part::Whole };
        let miss = Miss { version: self.version, slots, part, want: Want::Row(y), strategy };
        let mut found = self.cache.obtain(&miss, &mut || {}, &mut self.handed_on);
        if matches!(found, Err(StoreError::DamagedPage { .. })) && part == Part::Whole {
            // The damage may lie in rows that only the strategy wanted.
            let alone = Miss { part: Part::Block(y / BLOCK_ROWS), strategy: ReadStrategy::Block, ..miss };
            found = self.cache.obtain(&alone, &mut || {}, &mut self.handed_on);
        }
        let Obtained { chunk, was_resident } = found?;
        if was_resident {
            // It came between the look and the counting: another's read has answered.
            self.cache.count(&miss, &mut self.handed_on, |c| c.coalesced_waits += 1);
        }
        self.last_use = chunk.ticket;
        // What was evicted meanwhile is not held any longer than that.
        for kept in self.kept.iter_mut() {
            if kept.as_ref().is_some_and(|kept| kept.chunk.is_evicted()) {
                *kept = None;
            }
        }
        Ok(chunk)
    }

    fn count_miss(&mut self) {
        if !T::COUNTS {
            return;
        }
        self.counters.texel_misses += 1;
        if !self.look_up_missed {
            self.look_up_missed = true;
            self.counters.look_ups += 1;
            self.counters.misses += 1;
        }
        if !self.visit_missed {
            self.visit_missed = true;
            self.counters.visit_misses += 1;
        }
    }

    /// Gives the cache what was counted and noted here.
    #[cold]
    fn hand_on(&mut self) {
        let mut counters = std::mem::take(&mut self.counters);
        count_footprints(&mut counters, std::mem::take(&mut self.footprints));
        self.handed_on.add_events(&counters);
        let is_full = self.cache.stripes.count_uses(self.table.slot, &self.uses, |c| c.add_events(&counters));
        self.uses.clear();
        if is_full {
            self.cache.try_tell_policy();
        }
    }

    #[cold]
    fn record(&mut self, page: PageId, row: u32) {
        let Some(runs) = &mut self.runs else { return };
        match runs.last_mut() {
            Some((last_page, last_row, fetches)) if (*last_page, *last_row) == (page, row) && *fetches < u32::MAX => *fetches += 1,
            _ => {
                runs.push((page, row, 1));
                if runs.len() > RUNS {
                    self.hand_on_runs();
                }
            }
        }
    }

    fn hand_on_runs(&mut self) {
        if let Some(runs) = &mut self.runs {
            let events = runs.drain(..).map(|(page, row, fetches)| TraceEvent::Row { version: 0, page, row, fetches });
            self.cache.record_all(self.version, events);
        }
    }
}

/// Look-ups of four fetches, all hits.
fn count_footprints(counters: &mut CacheStats, count: u64) {
    counters.look_ups += count;
    counters.hits += count;
    counters.texel_fetches += 4 * count;
}

impl<T: Tally> Drop for Reader<'_, T> {
    fn drop(&mut self) {
        self.hand_on();
        self.hand_on_runs();
    }
}
