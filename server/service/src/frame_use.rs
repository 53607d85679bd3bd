//! What one frame asks of the texture cache. `frames` gives the renderer a version's pages through [`FramePages`], and notes the adapter's
//! counters around each frame.

use std::sync::{Mutex, MutexGuard, PoisonError};

use lumisphere::gpu::GpuCacheStats;
use lumisphere::render::GpuFrameStats;
use lumisphere::representations::{CachedPages, Fetched, PageSource, PageUse, TexelReader};
use lumisphere::textures::{CacheStats, Counted, PageId, PageShape, Reader, StoreError};

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
    fn version_slot(&self) -> u32 {
        self.pages.version_slot()
    }

    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let (page, cost) = self.pages.cache.page_with_cost(&self.pages.version, page)?;
        // As the cache counts a page that was there.
        let hit = CacheStats { look_ups: 1, hits: 1, page_visits: 1, ..CacheStats::default() };
        self.lock().add_events(cost.as_ref().unwrap_or(&hit));
        Ok(Fetched { page, was_resident: cost.is_none(), bytes_read: cost.unwrap_or_default().bytes_read })
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        Box::new(FrameReader { pages: self, reader: self.pages.cache.reader(&self.pages.version) })
    }
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
        self.pages.lock().add_events(&self.reader.counted());
    }
}
