//! What the device's tier of the page cache did.

/// Counters and sizes of pages in the device's memory. A look-up is one page wanted by one band of a frame (a frame of up to 2¹⁹ pixels
/// has one), before anything is uploaded for it: `look_ups = hits + misses`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GpuCacheStats {
    /// Pages that frames wanted.
    pub look_ups: u64,
    /// Of these, on the device.
    pub hits: u64,
    /// Not there, or not all rows of them that were wanted.
    pub misses: u64,
    /// Pages copied to the device, whole or some rows of them, ahead of need or for a frame.
    pub uploads: u64,
    /// Of these, ahead of need: `prefetched = prefetch_used + prefetch_wasted` + those that still wait for their frame.
    pub prefetched: u64,
    /// Of those ahead of need, wanted by a frame before they left.
    pub prefetch_used: u64,
    /// Of those ahead of need, given up before a frame wanted them.
    pub prefetch_wasted: u64,
    /// Texels copied to the device.
    pub bytes_uploaded: u64,
    /// Pages given up: for others, for a smaller budget, with their dataset.
    pub evictions: u64,
    /// On the device now.
    pub resident_pages: u64,
    /// Their slots.
    pub resident_bytes: u64,
    /// Everything held on the device now: geometry, slots whether used or not, coarse level, upload ring, targets of a frame.
    pub device_bytes: u64,
    /// Most of that at the end of any frame, since the peak was last forgotten.
    pub peak_device_bytes: u64,
    /// What `device_bytes` may reach.
    pub budget_bytes: u64,
}

impl GpuCacheStats {
    /// What stays to be told once every page has left the device.
    pub(crate) fn after_all_left(self) -> Self {
        Self {
            evictions: self.evictions + self.resident_pages,
            prefetch_wasted: self.prefetched - self.prefetch_used,
            resident_pages: 0,
            resident_bytes: 0,
            device_bytes: 0,
            ..self
        }
    }

    /// Counters and sizes of two datasets together; peak and budget, which are not sums, stay.
    pub fn add(&mut self, other: &Self) {
        self.look_ups += other.look_ups;
        self.hits += other.hits;
        self.misses += other.misses;
        self.uploads += other.uploads;
        self.prefetched += other.prefetched;
        self.prefetch_used += other.prefetch_used;
        self.prefetch_wasted += other.prefetch_wasted;
        self.bytes_uploaded += other.bytes_uploaded;
        self.evictions += other.evictions;
        self.resident_pages += other.resident_pages;
        self.resident_bytes += other.resident_bytes;
        self.device_bytes += other.device_bytes;
    }
}
