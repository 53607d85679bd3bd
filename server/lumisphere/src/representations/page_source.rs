//! Where a renderer gets pages from.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::textures::{Cache, DatasetVersion, Page, PageId, StoreError};

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
    /// The page, read if need be.
    fn page(&self, page: PageId) -> Result<Fetched, StoreError>;
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
    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let (page, cost) = self.cache.page_with_cost(&self.version, page)?;
        Ok(Fetched { page, was_resident: cost.is_none(), bytes_read: cost.unwrap_or_default().bytes_read })
    }
}

/// What a frame asked of its [`PageSource`]. `hits + misses` = pages asked for, repeated requests included.
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

    /// So far.
    pub fn usage(&self) -> PageUse {
        let get = |c: &AtomicU64| c.load(Ordering::Relaxed);
        PageUse { hits: get(&self.hits), misses: get(&self.misses), bytes_read: get(&self.bytes_read) }
    }
}
