//! Where a renderer gets pages from.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::textures::{Cache, DatasetVersion, Page, PageId, PageShape, Reader, StoreError};

/// A page and what it took to get it.
#[derive(Debug, Clone)]
pub struct Fetched {
    /// Decoded.
    pub page: Arc<Page>,
    /// From memory, no disk involved.
    pub was_resident: bool,
    /// From disk.
    pub bytes_read: u64,
}

/// Pages of one dataset version, from anywhere and by any number of threads.
pub trait PageSource: Sync {
    /// Which version: [`DatasetVersion::slot`].
    fn version_slot(&self) -> u32;

    /// The page, read if need be.
    fn page(&self, page: PageId) -> Result<Fetched, StoreError>;

    /// Texels of them, for one thread.
    fn reader(&self) -> Box<dyn TexelReader + '_>;
}

/// Texels of a source's pages, for one thread.
pub trait TexelReader {
    /// One look-up: page, column and row of each texel, in the order in which they are fetched. All lie within their pages.
    fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError>;

    /// A page's size and format, so that it can be checked before the first texel is asked for.
    fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError>;

    /// What was asked of the source so far.
    fn usage(&self) -> PageUse;
}

/// A version's pages through the shared cache.
#[derive(Debug, Clone)]
pub struct CachedPages {
    /// Shared by all datasets.
    pub cache: Arc<Cache>,
    /// Whose pages.
    pub version: Arc<DatasetVersion>,
}

impl PageSource for CachedPages {
    fn version_slot(&self) -> u32 {
        self.version.slot()
    }

    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let (page, cost) = self.cache.page_with_cost(&self.version, page)?;
        Ok(Fetched { page, was_resident: cost.is_none(), bytes_read: cost.unwrap_or_default().bytes_read })
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        Box::new(ThroughCache(self.cache.reader(&self.version)))
    }
}

/// Row by row, as the dataset's read strategy says.
struct ThroughCache<'a>(Reader<'a>);

impl TexelReader for ThroughCache<'_> {
    fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError> {
        self.0.texels(at)
    }

    fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError> {
        self.0.shape(page)
    }

    fn usage(&self) -> PageUse {
        let done = self.0.counted();
        PageUse { hits: done.hits, misses: done.misses, bytes_read: done.bytes_read }
    }
}

/// Whole pages of any source, the latest of which are kept, so that most reads ask for nothing.
pub struct WholePages<'a> {
    source: &'a dyn PageSource,
    /// Page p has its place at p mod `PAGES_KEPT`.
    kept: Vec<Option<(PageId, Arc<Page>)>>,
    usage: PageUse,
}

// A power of two; a bucket of 16×16 pixels reads a few dozen pages.
const PAGES_KEPT: usize = 64;

impl<'a> WholePages<'a> {
    /// Nothing read yet.
    pub fn new(source: &'a dyn PageSource) -> Self {
        Self { source, kept: vec![None; PAGES_KEPT], usage: PageUse::default() }
    }

    fn page(&mut self, page: PageId) -> Result<&Arc<Page>, StoreError> {
        let place = &mut self.kept[page.0 as usize % PAGES_KEPT];
        if place.as_ref().is_none_or(|(kept, _)| *kept != page) {
            let fetched = self.source.page(page)?;
            self.usage.hits += u64::from(fetched.was_resident);
            self.usage.misses += u64::from(!fetched.was_resident);
            self.usage.bytes_read += fetched.bytes_read;
            *place = Some((page, fetched.page));
        }
        Ok(&place.as_ref().expect("filled above").1)
    }
}

impl TexelReader for WholePages<'_> {
    fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError> {
        let mut texels = [[0.0; 4]; 4];
        for (texel, (page, x, y)) in texels.iter_mut().zip(at) {
            *texel = self.page(page)?.texel(x, y);
        }
        Ok(texels)
    }

    fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError> {
        Ok(self.page(page)?.shape())
    }

    fn usage(&self) -> PageUse {
        self.usage
    }
}

/// What a frame asked of its [`PageSource`]. `hits + misses` = requests, repeated ones included: whole pages, or, where texels are read
/// through the cache, look-ups of four texels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PageUse {
    /// Answered from memory.
    pub hits: u64,
    /// Read from disk.
    pub misses: u64,
    /// From disk.
    pub bytes_read: u64,
}

/// A source that counts. One per frame.
pub struct CountingSource<'a> {
    source: &'a dyn PageSource,
    hits: AtomicU64,
    misses: AtomicU64,
    bytes_read: AtomicU64,
}

impl<'a> CountingSource<'a> {
    /// Nothing counted yet.
    pub fn new(source: &'a dyn PageSource) -> Self {
        Self { source, hits: AtomicU64::new(0), misses: AtomicU64::new(0), bytes_read: AtomicU64::new(0) }
    }

    /// The page, counted.
    pub fn page(&self, page: PageId) -> Result<Arc<Page>, StoreError> {
        let fetched = self.source.page(page)?;
        let counter = if fetched.was_resident { &self.hits } else { &self.misses };
        counter.fetch_add(1, Ordering::Relaxed);
        self.bytes_read.fetch_add(fetched.bytes_read, Ordering::Relaxed);
        Ok(fetched.page)
    }

    /// Texels, counted when the reader is dropped.
    pub fn reader(&self) -> CountingReader<'_> {
        CountingReader { counts: self, reader: self.source.reader() }
    }

    /// So far.
    pub fn usage(&self) -> PageUse {
        let get = |c: &AtomicU64| c.load(Ordering::Relaxed);
        PageUse { hits: get(&self.hits), misses: get(&self.misses), bytes_read: get(&self.bytes_read) }
    }
}

/// A thread's reader whose requests count.
pub struct CountingReader<'a> {
    counts: &'a CountingSource<'a>,
    reader: Box<dyn TexelReader + 'a>,
}

impl CountingReader<'_> {
    /// See [`TexelReader::texels`].
    pub fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError> {
        self.reader.texels(at)
    }

    /// See [`TexelReader::shape`].
    pub fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError> {
        self.reader.shape(page)
    }
}

impl Drop for CountingReader<'_> {
    fn drop(&mut self) {
        let PageUse { hits, misses, bytes_read } = self.reader.usage();
        self.counts.hits.fetch_add(hits, Ordering::Relaxed);
        self.counts.misses.fetch_add(misses, Ordering::Relaxed);
        self.counts.bytes_read.fetch_add(bytes_read, Ordering::Relaxed);
    }
}

/// All of a dataset's pages in memory.
#[cfg(test)]
#[derive(Debug, Clone)]
pub(crate) struct MemoryPages(pub Vec<Arc<Page>>);

#[cfg(test)]
impl PageSource for MemoryPages {
    // Of no store.
    fn version_slot(&self) -> u32 {
        u32::MAX
    }

    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let found = self.0.get(page.0 as usize).ok_or_else(|| StoreError::NotFound { what: format!("page {page}") })?;
        Ok(Fetched { page: found.clone(), was_resident: true, bytes_read: 0 })
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        Box::new(WholePages::new(self))
    }
}
