//! S3-FIFO (J. Yang et al., SOSP 2023): a small queue for newcomers, a main queue for what proved itself, ghosts of what left the small
//! one. Strong on skewed traffic of many clients; behind LRU on the short loops of a single frame.

use super::ghosts::Ghosts;
use super::order::Order;
use super::{PageKey, Policy};

/// The small queue's part of the capacity, in percent (the paper's 10 %).
const SMALL_PERCENT: u64 = 10;
/// Uses are counted up to this.
const MOST_USES: u8 = 3;

#[derive(Debug, Clone, Copy)]
struct Entry {
    key: PageKey,
    weight: u64,
    uses: u8,
    in_main: bool,
}

/// Queues S, M and G of the paper.
#[derive(Debug)]
pub struct S3Fifo {
    capacity: u64,
    entries: Vec<Entry>,
    small: Order,
    main: Order,
    small_weight: u64,
    ghosts: Ghosts,
}

impl S3Fifo {
    /// For pages whose weights sum up to at most `capacity`.
    pub fn new(capacity: u64) -> Self {
        Self { capacity, entries: Vec::new(), small: Order::new(), main: Order::new(), small_weight: 0, ghosts: Ghosts::new() }
    }

    fn main_capacity(&self) -> u64 {
        self.capacity - self.capacity * SMALL_PERCENT / 100
    }

    fn link(&mut self, slot: u32, entry: Entry) {
        if entry.in_main {
            self.main.push_newest(slot);
        } else {
            self.small.push_newest(slot);
            self.small_weight += entry.weight;
        }
        if self.entries.len() <= slot as usize {
            self.entries.resize(slot as usize + 1, entry);
        }
        self.entries[slot as usize] = entry;
    }

    /// From the small queue to the ghosts, if one is found that was used at most once; the others move to the main queue.
    fn evict_small(&mut self) -> Option<u32> {
        while let Some(slot) = self.small.pop_oldest() {
            let entry = self.entries[slot as usize];
            self.small_weight -= entry.weight;
            if entry.uses <= 1 {
                self.ghosts.push(entry.key, entry.weight, ());
                self.ghosts.shrink_to(self.main_capacity());
                return Some(slot);
            }
            self.link(slot, Entry { uses: 0, in_main: true, ..entry });
        }
        None
    }

    fn evict_main(&mut self) -> Option<u32> {
        loop {
            let slot = self.main.pop_oldest()?;
            let entry = &mut self.entries[slot as usize];
            if entry.uses == 0 {
                return Some(slot);
            }
            entry.uses -= 1;
            self.main.push_newest(slot);
        }
    }
}

impl Policy for S3Fifo {
    fn set_capacity(&mut self, capacity: u64) {
        self.capacity = capacity;
        self.ghosts.shrink_to(self.main_capacity());
    }
    fn insert(&mut self, slot: u32, key: PageKey, weight: u64) {
        let in_main = self.ghosts.take(key).is_some();
        self.link(slot, Entry { key, weight, uses: 0, in_main });
    }
    #[inline]
    fn touch(&mut self, slot: u32) {
        let uses = &mut self.entries[slot as usize].uses;
        *uses = (*uses + 1).min(MOST_USES);
    }
    fn remove(&mut self, slot: u32) {
        let entry = self.entries[slot as usize];
        if entry.in_main {
            self.main.remove(slot);
        } else {
            self.small.remove(slot);
            self.small_weight -= entry.weight;
        }
    }
    fn evict(&mut self) -> Option<u32> {
        let from_small = self.small_weight > self.capacity * SMALL_PERCENT / 100 || self.main.oldest().is_none();
        let first = if from_small { self.evict_small() } else { self.evict_main() };
        // Everything in the small queue may have been promoted; the main queue always yields while it holds anything.
        first.or_else(|| self.evict_main()).or_else(|| self.evict_small())
    }
}
