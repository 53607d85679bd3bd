//! Texels through the cache, for one thread: the pages used last are found without any lock, and counted without any shared write.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::chunk::{Chunk, Ticket, UNKEPT};
use super::read::{Miss, Want};
use super::stats::CacheStats;
use super::table::{Part, VersionTable};
use super::{Cache, Obtained};
use crate::textures::codec::BLOCK_ROWS;
use crate::textures::error::StoreError;
use crate::textures::page::{PageId, PageShape};
use crate::textures::read_strategy::ReadStrategy;
use crate::textures::trace::TraceEvent;
use crate::textures::version::DatasetVersion;

/// Pages or blocks remembered; a power of two. A bucket of 16×16 pixels uses a few dozen.
const KEPT: usize = 64;
/// Uses noted before they are handed on.
const USES: usize = 64;
/// Look-ups counted before they are handed on, so that the counters never lag by much.
const UNTOLD_LOOK_UPS: u64 = 1 << 16;
/// Runs recorded before they are handed on.
const RUNS: usize = 4096;

/// Reads texels of one dataset version. One a thread; dropping it hands on its counters.
///
/// A row that is missing is read as the dataset's [`ReadStrategy`] says, while the caller waits. Everything found in memory is a hit,
/// whether this reader remembers it or the cache does; what the cache has given up is never a hit.
#[derive(Debug)]
pub struct Reader<'a> {
    cache: &'a Cache,
    version: &'a Arc<DatasetVersion>,
    table: Arc<VersionTable>,
    kept: Vec<Kept>,
    is_by_block: bool,
    /// Uses since they were last handed on; the last one is not noted again.
    uses: Vec<Ticket>,
    last_use: Ticket,
    visited: PageId,
    visit_missed: bool,
    look_up_missed: bool,
    counters: CacheStats,
    /// What was handed on before, and the bytes that its misses read.
    handed_on: CacheStats,
    /// Runs of rows; None when nothing records.
    runs: Option<Vec<(PageId, u32, u32)>>,
}

#[derive(Debug, Clone)]
struct Kept {
    page: PageId,
    chunk: Option<Arc<Chunk>>,
}

impl Kept {
    #[inline]
    fn chunk(&self, page: PageId) -> Option<&Chunk> {
        match &self.chunk {
            Some(chunk) if self.page == page && !chunk.is_evicted() => Some(chunk),
            _ => None,
        }
    }
}

/// No page has this number: a version has fewer.
const NO_PAGE: PageId = PageId(u32::MAX);

impl<'a> Reader<'a> {
    pub(super) fn new(cache: &'a Cache, version: &'a Arc<DatasetVersion>, table: Arc<VersionTable>) -> Self {
        Self {
            cache,
            version,
            is_by_block: table.strategy() == ReadStrategy::Block,
            table,
            kept: vec![Kept { page: NO_PAGE, chunk: None }; KEPT],
            uses: Vec::with_capacity(USES),
            last_use: UNKEPT,
            visited: NO_PAGE,
            visit_missed: false,
            look_up_missed: false,
            counters: CacheStats::default(),
            handed_on: CacheStats::default(),
            runs: cache.is_recording.load(Ordering::Relaxed).then(Vec::new),
        }
    }

    /// What this reader asked for so far, and the bytes that its misses read.
    pub fn counted(&self) -> CacheStats {
        let mut all = self.handed_on;
        all.add_events(&self.counters);
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

    /// Bilinear interpolation within one page, between the texels (x, y) and (x+1, y+1): one look-up of four fetches. `u` and `v`, 0…1,
    /// are the weights of the right column and the lower row.
    #[inline]
    pub fn bilinear(&mut self, page: PageId, (x, y): (u32, u32), (u, v): (f32, f32)) -> Result<[f32; 4], StoreError> {
        let [a, b, c, d] = self.footprint(page, x, y)?;
        let mix = |channel: usize| {
            let upper = a[channel] + u * (b[channel] - a[channel]);
            let lower = c[channel] + u * (d[channel] - c[channel]);
            upper + v * (lower - upper)
        };
        Ok([mix(0), mix(1), mix(2), mix(3)])
    }

    #[inline]
    fn footprint(&mut self, page: PageId, x: u32, y: u32) -> Result<[[f32; 4]; 4], StoreError> {
        if self.runs.is_none()
            && let Some(chunk) = self.kept[self.place(page, y)].chunk(page)
            && chunk.rows.start <= y
            && y + 1 < chunk.rows.end
        {
            let (ticket, texels) = (chunk.ticket, chunk.page.footprint(x, y - chunk.rows.start));
            self.counters.texel_fetches += 4;
            self.note_use(page, ticket);
            self.end_look_up();
            return Ok(texels);
        }
        self.texels([(page, x, y), (page, x + 1, y), (page, x, y + 1), (page, x + 1, y + 1)])
    }

    #[inline]
    fn place(&self, page: PageId, y: u32) -> usize {
        let part = if self.is_by_block { y / BLOCK_ROWS } else { 0 };
        // Blocks of one page lie side by side; a page's six neighbours, too.
        (page.0.wrapping_mul(9).wrapping_add(part)) as usize % KEPT
    }

    #[inline]
    fn fetch(&mut self, page: PageId, x: u32, y: u32) -> Result<[f32; 4], StoreError> {
        self.counters.texel_fetches += 1;
        if self.runs.is_some() {
            self.record(page, y);
        }
        if let Some(chunk) = self.kept[self.place(page, y)].chunk(page)
            && chunk.rows.contains(&y)
        {
            let (ticket, texel) = (chunk.ticket, chunk.page.texel(x, y - chunk.rows.start));
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
    }

    #[inline]
    fn note_visit(&mut self, page: PageId) {
        if page != self.visited {
            self.visited = page;
            self.visit_missed = false;
            self.counters.page_visits += 1;
        }
    }

    #[inline]
    fn end_look_up(&mut self) {
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
        self.kept[place] = Kept { page, chunk: Some(chunk.clone()) };
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
        let mut found = self.cache.obtain(&miss, &mut || {});
        if matches!(found, Err(StoreError::DamagedPage { .. })) && part == Part::Whole {
            // The damage may lie in rows that only the strategy wanted.
            let alone = Miss { part: Part::Block(y / BLOCK_ROWS), strategy: ReadStrategy::Block, ..miss };
            found = self.cache.obtain(&alone, &mut || {});
        }
        let Obtained { chunk, cost } = found?;
        self.handed_on.bytes_read += cost.map_or(0, |cost| cost.bytes_read);
        if cost.is_none() {
            // It came between the look and the counting: another's read has answered.
            self.cache.stripes.count(slots.version, |c| c.coalesced_waits += 1);
        }
        self.last_use = chunk.ticket;
        // What was evicted meanwhile is not held any longer than that.
        for kept in &mut self.kept {
            if kept.chunk.as_ref().is_some_and(|chunk| chunk.is_evicted()) {
                kept.chunk = None;
            }
        }
        Ok(chunk)
    }

    fn count_miss(&mut self) {
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
        let counters = std::mem::take(&mut self.counters);
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

impl Drop for Reader<'_> {
    fn drop(&mut self) {
        self.hand_on();
        self.hand_on_runs();
    }
}
