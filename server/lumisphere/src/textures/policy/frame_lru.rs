//! Modified least-recently-used order for frames that touch each page once, in much the same sequence, as surface light fields do:
//! plain LRU then gives up exactly what the next frame needs first.
//!
//! Pages that neither this frame nor the last one used go first, oldest first. When there are none the memory has turned over within
//! the frame: then the page used last goes, which the next frame needs last, and the frame's early pages survive into the next.
//! For a cyclic scan this is Belady's choice. Where a frame returns to a page soon after it used it, prefer `lru`.

use super::order::Order;
use super::{PageKey, Policy};

/// Needs [`Policy::begin_frame`]; before its first call it is plain LRU.
#[derive(Debug)]
pub struct FrameLru {
    order: Order,
    frame: u64,
    /// Frame of a slot's last use.
    used_in: Vec<u64>,
}

impl FrameLru {
    /// Knows no slot yet.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        Self { order: Order::new(), frame: 0, used_in: Vec::new() }
    }
}

impl Policy for FrameLru {
    fn insert(&mut self, slot: u32, _: PageKey, _: u64) {
        if self.used_in.len() <= slot as usize {
            self.used_in.resize(slot as usize + 1, 0);
        }
        self.used_in[slot as usize] = self.frame;
        self.order.push_newest(slot);
    }
    #[inline]
    fn touch(&mut self, slot: u32) {
        self.used_in[slot as usize] = self.frame;
        self.order.make_newest(slot);
    }
    fn remove(&mut self, slot: u32) {
        self.order.remove(slot);
    }
    fn evict(&mut self) -> Option<u32> {
        let oldest = self.order.oldest()?;
        let is_stale = self.frame == 0 || self.used_in[oldest as usize] + 1 < self.frame;
        let victim = if is_stale { oldest } else { self.order.newest()? };
        self.order.remove(victim);
        Some(victim)
    }
    fn begin_frame(&mut self) {
        self.frame += 1;
    }
}
