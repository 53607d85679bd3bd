//! Where every page's slots are found: by version number and page number, without a hash and without a lock.

use std::sync::atomic::{AtomicU8, AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};

use super::chunk::Chunk;
use super::slot::Slot;
use crate::textures::codec::BLOCK_ROWS;
use crate::textures::error::StoreError;
use crate::textures::page::PageId;
use crate::textures::policy::PageKey;
use crate::textures::read_strategy::ReadStrategy;
use crate::textures::segment::Header;
use crate::textures::version::DatasetVersion;

/// A slot for a page, or for a block of one.
pub(super) type ChunkSlot = Slot<Arc<Chunk>, StoreError>;

/// Places that are filled once and then read without a lock.
type Places<T> = Box<[OnceLock<T>]>;

/// Versions by their process-wide number. Segment k holds 2ᵏ of them and is made when first needed, so nothing ever moves.
#[derive(Debug)]
pub(super) struct Table {
    segments: [OnceLock<Places<Arc<VersionTable>>>; 32],
}

/// The pages of one version. Stays for the life of the cache: 16 bytes a page that was never asked for.
#[derive(Debug)]
pub(super) struct VersionTable {
    pub slot: u32,
    pub dataset: String,
    pub version: u64,
    strategy: AtomicU8,
    /// Of the tallest shape.
    blocks: u32,
    pages: Places<Arc<PageSlots>>,
}

/// What the cache knows of one page.
#[derive(Debug)]
pub(super) struct PageSlots {
    pub version: u32,
    pub page: PageId,
    /// The page, or its first rows.
    pub whole: ChunkSlot,
    /// Its blocks, under the strategy that caches them alone.
    blocks: OnceLock<Box<[ChunkSlot]>>,
    block_count: u32,
    /// Checked once, then kept: it says where the blocks lie and what they must hash to.
    pub header: OnceLock<Arc<Header>>,
    /// Rows of each block that were ever decoded: those that are decoded again are redundant.
    decoded: Box<[AtomicU32]>,
}

/// Which part of a page a slot is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    Whole,
    Block(u32),
}

impl Table {
    pub fn new() -> Self {
        Self { segments: std::array::from_fn(|_| OnceLock::new()) }
    }

    /// The version's table; `strategy` is what a new one starts with.
    pub fn version(&self, version: &DatasetVersion, strategy: impl FnOnce() -> ReadStrategy) -> &Arc<VersionTable> {
        let number = u64::from(version.slot()) + 1;
        let segment = number.ilog2();
        let places = self.segments[segment as usize].get_or_init(|| (0..1u64 << segment).map(|_| OnceLock::new()).collect());
        places[(number - (1 << segment)) as usize].get_or_init(|| Arc::new(VersionTable::new(version, strategy())))
    }

    /// Every version that was asked for.
    pub fn versions(&self) -> impl Iterator<Item = &Arc<VersionTable>> {
        self.segments.iter().filter_map(OnceLock::get).flat_map(|places| places.iter().filter_map(OnceLock::get))
    }
}

impl VersionTable {
    fn new(version: &DatasetVersion, strategy: ReadStrategy) -> Self {
        let manifest = version.manifest();
        let tallest = manifest.pages.shapes.iter().map(|s| s.height).max().unwrap_or(0);
        Self {
            slot: version.slot(),
            dataset: manifest.dataset.clone(),
            version: manifest.version,
            strategy: AtomicU8::new(strategy as u8),
            blocks: tallest.div_ceil(BLOCK_ROWS),
            pages: (0..manifest.pages.count).map(|_| OnceLock::new()).collect(),
        }
    }

    pub fn strategy(&self) -> ReadStrategy {
        ReadStrategy::ALL[usize::from(self.strategy.load(Ordering::Relaxed))]
    }

    pub fn set_strategy(&self, strategy: ReadStrategy) {
        self.strategy.store(strategy as u8, Ordering::Relaxed);
    }

    /// None for a page that the version does not have.
    #[inline]
    pub fn page(&self, page: PageId) -> Option<&Arc<PageSlots>> {
        let place = self.pages.get(page.0 as usize)?;
        Some(place.get_or_init(|| {
            Arc::new(PageSlots {
                version: self.slot,
                page,
                whole: Slot::new(),
                blocks: OnceLock::new(),
                block_count: self.blocks,
                header: OnceLock::new(),
                decoded: (0..self.blocks).map(|_| AtomicU32::new(0)).collect(),
            })
        }))
    }
}

impl PageSlots {
    /// None for a row below every page of the version.
    pub fn block(&self, block: u32) -> Option<&ChunkSlot> {
        self.blocks.get_or_init(|| (0..self.block_count).map(|_| Slot::new()).collect()).get(block as usize)
    }

    /// The slot of a part that was found before.
    pub fn slot(&self, part: Part) -> Option<&ChunkSlot> {
        match part {
            Part::Whole => Some(&self.whole),
            Part::Block(block) => self.block(block),
        }
    }

    /// Blocks that are cached on their own.
    pub fn resident_blocks(&self) -> impl Iterator<Item = Arc<Chunk>> {
        self.blocks.get().into_iter().flatten().filter_map(Slot::get)
    }

    /// By what eviction policies know a part: distinct for 2¹² versions of 2³² pages of 2²⁰ blocks, and a mix-up costs them only a
    /// wrong memory.
    pub fn key(&self, part: Part) -> PageKey {
        let part = match part {
            Part::Whole => 0,
            Part::Block(block) => u64::from(block) + 1,
        };
        PageKey((u64::from(self.version) << 52) ^ (u64::from(self.page.0) << 20) ^ part)
    }

    /// Notes that the rows were decoded; how many of them had been before.
    pub fn count_decoded(&self, rows: std::ops::Range<u32>) -> u32 {
        let mut redundant = 0;
        for block in rows.start / BLOCK_ROWS..rows.end.div_ceil(BLOCK_ROWS) {
            let Some(decoded) = self.decoded.get(block as usize) else { return redundant };
            let first = block * BLOCK_ROWS;
            let (from, to) = (rows.start.max(first) - first, (rows.end - first).min(BLOCK_ROWS));
            let before = decoded.fetch_max(to, Ordering::Relaxed);
            redundant += before.min(to).saturating_sub(from);
        }
        redundant
    }
}
