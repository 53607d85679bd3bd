//! What one frame asks of the texture cache. `frames` gives the renderer a version's pages through [`FramePages`], and notes the adapter's
//! counters around each frame.

use std::sync::{Mutex, MutexGuard, PoisonError};

use lumisphere::gpu::GpuCacheStats;
use lumisphere::render::GpuFrameStats;
use lumisphere::representations::{CachedPages, Fetched, PageSource, PageUse, TexelReader};
use lumisphere::textures::{CacheStats, Counted, PageId, PageShape, ReadCost, Reader, StoreError};

/// A version's pages through the shared cache, for one frame, counted.
pub struct FramePages<'a> {
    pages: &'a CachedPages,
    asked: Mutex<CacheStats>,
}

/// The adapter's tier around a frame. Only the render thread changes it, so that what it did meanwhile was for this frame.
pub struct AdapterUse {
    /// Of all datasets.
    pub before: GpuCacheStats,
    /// See `before`.
    pub after: GpuCacheStats,
    /// What the kernel tells itself.
    pub frame: GpuFrameStats,
}

impl<'a> FramePages<'a> {
    /// Nothing asked yet.
    pub fn new(pages: &'a CachedPages) -> Self {
        Self { pages, asked: Mutex::default() }
    }

    /// Events so far, of readers that were dropped; no sizes.
    pub fn asked(&self) -> CacheStats {
        *self.lock()
    }

    fn lock(&self) -> MutexGuard<'_, CacheStats> {
        self.asked.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PageSource for FramePages<'_> {
    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let (page, cost) = self.pages.cache.page_with_cost(&self.pages.version, page)?;
        count_page(&mut self.lock(), cost.as_ref());
        Ok(Fetched { page, was_resident: cost.is_none(), bytes_read: cost.unwrap_or_default().bytes_read })
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        Box::new(FrameReader { pages: self, reader: self.pages.cache.reader(&self.pages.version) })
    }
}

/// A whole page, as the cache counts it.
fn count_page(asked: &mut CacheStats, cost: Option<&ReadCost>) {
    asked.look_ups += 1;
    asked.page_visits += 1;
    let Some(cost) = cost else {
        asked.hits += 1;
        return;
    };
    asked.misses += 1;
    asked.visit_misses += 1;
    // A read has a cost.
    asked.coalesced_waits += u64::from(*cost == ReadCost::default());
    asked.blocks_read += cost.blocks_read;
    asked.bytes_read += cost.bytes_read;
    asked.rows_decoded += cost.rows_decoded;
    asked.bytes_decoded += cost.bytes_decoded;
    asked.rows_redundant += cost.rows_redundant;
    asked.bytes_redundant += cost.bytes_redundant;
    asked.read_nanos += cost.read_nanos;
    asked.decode_nanos += cost.decode_nanos;
}

/// A thread's reader; what it asked for counts when it is dropped.
struct FrameReader<'a> {
    pages: &'a FramePages<'a>,
    reader: Reader<'a, Counted>,
}

impl TexelReader for FrameReader<'_> {
    fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError> {
        self.reader.texels(at)
    }

    fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError> {
        self.reader.shape(page)
    }

    fn usage(&self) -> PageUse {
        let done = self.reader.counted();
        PageUse { hits: done.hits, misses: done.misses, bytes_read: done.bytes_read }
    }
}

impl Drop for FrameReader<'_> {
    fn drop(&mut self) {
        let done = self.reader.counted();
        let mut asked = self.pages.lock();
        asked.look_ups += done.look_ups;
        asked.hits += done.hits;
        asked.misses += done.misses;
        asked.texel_fetches += done.texel_fetches;
        asked.texel_misses += done.texel_misses;
        asked.page_visits += done.page_visits;
        asked.visit_misses += done.visit_misses;
        asked.bytes_read += done.bytes_read;
    }
}
