//! What is counted, and the sums that are handed out.

use crate::textures::policy::PolicyKind;
use crate::textures::read_strategy::ReadStrategy;
use crate::textures::version::ReadCost;

/// What the tier of decoded pages did since the cache was made. `look_ups = hits + misses`, always; every miss was answered by a read or
/// by waiting for another's.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheStats {
    /// Requests: whole pages, and texel look-ups of one or several fetches.
    pub look_ups: u64,
    /// Found in memory.
    pub hits: u64,
    /// Not in memory, whoever read them then.
    pub misses: u64,
    /// Texels fetched: four a bilinear look-up. The paper's denominator.
    pub texel_fetches: u64,
    /// Fetches that had to read or wait.
    pub texel_misses: u64,
    /// Times a reader turned from one page to another; requests for whole pages are a visit each.
    pub page_visits: u64,
    /// Visits in which something was missing.
    pub visit_misses: u64,
    /// Misses that another reader's read answered.
    pub coalesced_waits: u64,
    /// Reads that failed.
    pub failed_reads: u64,
    /// Pages and blocks given up for others, for a smaller budget, or because the whole page came.
    pub evictions: u64,
    /// Pages larger than the whole budget: read, handed out, not kept.
    pub uncached: u64,
    /// Read ahead of their use, on request.
    pub prefetches: u64,
    /// Compressed blocks from disk.
    pub blocks_read: u64,
    /// From disk.
    pub bytes_read: u64,
    /// Rows unpacked.
    pub rows_decoded: u64,
    /// Of decoded texels.
    pub bytes_decoded: u64,
    /// Rows unpacked that had been unpacked before: what a larger cache, or another strategy, would have saved.
    pub rows_redundant: u64,
    /// Of those rows.
    pub bytes_redundant: u64,
    /// Spent waiting for the disk, summed over readers.
    pub read_nanos: u64,
    /// Spent checking and unpacking, summed over readers.
    pub decode_nanos: u64,
    /// Spent waiting for another's read, summed over readers.
    pub wait_nanos: u64,
    /// Pages, or blocks of some, held now.
    pub resident_pages: u64,
    /// Bytes held now; never above the budget.
    pub resident_bytes: u64,
    /// Most bytes held at once, since the peaks were last forgotten.
    pub peak_bytes: u64,
    /// Bytes that may be held.
    pub budget_bytes: u64,
}

impl CacheStats {
    /// Adds a read's cost.
    pub(super) fn count(&mut self, cost: &ReadCost) {
        self.blocks_read += cost.blocks_read;
        self.bytes_read += cost.bytes_read;
        self.rows_decoded += cost.rows_decoded;
        self.bytes_decoded += cost.bytes_decoded;
        self.rows_redundant += cost.rows_redundant;
        self.bytes_redundant += cost.bytes_redundant;
        self.read_nanos += cost.read_nanos;
        self.decode_nanos += cost.decode_nanos;
    }

    /// Adds the events of another, sizes aside.
    pub fn add_events(&mut self, other: &Self) {
        self.look_ups += other.look_ups;
        self.hits += other.hits;
        self.misses += other.misses;
        self.texel_fetches += other.texel_fetches;
        self.texel_misses += other.texel_misses;
        self.page_visits += other.page_visits;
        self.visit_misses += other.visit_misses;
        self.coalesced_waits += other.coalesced_waits;
        self.failed_reads += other.failed_reads;
        self.evictions += other.evictions;
        self.uncached += other.uncached;
        self.prefetches += other.prefetches;
        self.blocks_read += other.blocks_read;
        self.bytes_read += other.bytes_read;
        self.rows_decoded += other.rows_decoded;
        self.bytes_decoded += other.bytes_decoded;
        self.rows_redundant += other.rows_redundant;
        self.bytes_redundant += other.bytes_redundant;
        self.read_nanos += other.read_nanos;
        self.decode_nanos += other.decode_nanos;
        self.wait_nanos += other.wait_nanos;
    }
}

/// What the tier of compressed blocks did. `look_ups = hits + misses`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CompressedStats {
    /// Blocks asked for, by misses of the tier above.
    pub look_ups: u64,
    /// Found in memory.
    pub hits: u64,
    /// Read from disk.
    pub misses: u64,
    /// Given up for others or for a smaller budget.
    pub evictions: u64,
    /// Blocks held now.
    pub resident_blocks: u64,
    /// Bytes held now; never above the budget.
    pub resident_bytes: u64,
    /// Most bytes held at once, since the peaks were last forgotten.
    pub peak_bytes: u64,
    /// Bytes that may be held; 0: the tier is off and counts nothing.
    pub budget_bytes: u64,
}

/// One dataset version's part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VersionStats {
    /// [`DatasetVersion::slot`](crate::textures::DatasetVersion::slot): no other version of this process has it.
    pub slot: u32,
    /// Dataset's name.
    pub dataset: String,
    /// From 1.
    pub version: u64,
    /// How its misses are read.
    pub strategy: ReadStrategy,
    /// Its events and what it has, and had, resident; the budget is the whole cache's.
    pub decoded: CacheStats,
    /// The same of its compressed blocks.
    pub compressed: CompressedStats,
}

/// Everything at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CacheSnapshot {
    /// Of all versions.
    pub decoded: CacheStats,
    /// Order of eviction of decoded pages.
    pub decoded_policy: PolicyKind,
    /// Of all versions.
    pub compressed: CompressedStats,
    /// Order of eviction of compressed blocks.
    pub compressed_policy: PolicyKind,
    /// What datasets have that were given no strategy of their own.
    pub strategy: ReadStrategy,
    /// Every version that was asked for.
    pub versions: Vec<VersionStats>,
}
