//! ARC, adaptive replacement (N. Megiddo, D. Modha, FAST 2003): pages seen once (T1) and more often (T2) share the capacity; keys given
//! up lately (B1, B2) show which of the two should have had more, and the share moves there. The paper's figure 4 with weights in
//! place of counts.

use super::ghosts::Ghosts;
use super::order::Order;
use super::{PageKey, Policy};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum List {
    Once,
    Often,
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    key: PageKey,
    weight: u64,
    list: List,
}

/// T1, T2, B1, B2 and p of the paper.
#[derive(Debug)]
pub struct Arc {
    capacity: u64,
    /// What T1 should weigh: p.
    target: u64,
    entries: Vec<Entry>,
    once: Order,
    often: Order,
    once_weight: u64,
    often_weight: u64,
    once_ghosts: Ghosts,
    often_ghosts: Ghosts,
    /// The page about to be inserted is in B2.
    expects_often: bool,
    /// It is in B1 or B2, so it was seen before.
    expects_known: bool,
}

impl Arc {
    /// For pages whose weights sum up to at most `capacity`.
    pub fn new(capacity: u64) -> Self {
        Self {
            capacity,
            target: 0,
            entries: Vec::new(),
            once: Order::new(),
            often: Order::new(),
            once_weight: 0,
            often_weight: 0,
            once_ghosts: Ghosts::new(),
            often_ghosts: Ghosts::new(),
            expects_often: false,
            expects_known: false,
        }
    }

    fn unlink(&mut self, slot: u32) -> Entry {
        let entry = self.entries[slot as usize];
        match entry.list {
            List::Once => {
                self.once.remove(slot);
                self.once_weight -= entry.weight;
            }
            List::Often => {
                self.often.remove(slot);
                self.often_weight -= entry.weight;
            }
        }
        entry
    }

    fn link(&mut self, slot: u32, entry: Entry) {
        match entry.list {
            List::Once => {
                self.once.push_newest(slot);
                self.once_weight += entry.weight;
            }
            List::Often => {
                self.often.push_newest(slot);
                self.often_weight += entry.weight;
            }
        }
        if self.entries.len() <= slot as usize {
            self.entries.resize(slot as usize + 1, entry);
        }
        self.entries[slot as usize] = entry;
    }

    /// |T1| + |B1| ≤ c, and all four ≤ 2c.
    fn bound_ghosts(&mut self) {
        self.once_ghosts.shrink_to(self.capacity.saturating_sub(self.once_weight));
        let others = self.once_weight + self.often_weight + self.once_ghosts.weight();
        self.often_ghosts.shrink_to((2 * self.capacity).saturating_sub(others));
    }
}

impl Policy for Arc {
    fn set_capacity(&mut self, capacity: u64) {
        self.capacity = capacity;
        self.target = self.target.min(capacity);
        self.bound_ghosts();
    }

    /// The paper's cases II and III: a page that was given up too early moves the target by its weight, or by more where the other
    /// ghost list is the longer one.
    fn expect(&mut self, key: PageKey, weight: u64) {
        let (once, often) = (self.once_ghosts.weight().max(1), self.often_ghosts.weight().max(1));
        self.expects_often = self.often_ghosts.contains(key);
        self.expects_known = self.expects_often || self.once_ghosts.contains(key);
        if self.once_ghosts.contains(key) {
            self.target = (self.target + weight.max(weight.saturating_mul(often / once))).min(self.capacity);
        } else if self.expects_often {
            self.target = self.target.saturating_sub(weight.max(weight.saturating_mul(once / often)));
        }
    }

    fn insert(&mut self, slot: u32, key: PageKey, weight: u64) {
        let known = self.once_ghosts.take(key).is_some() | self.often_ghosts.take(key).is_some();
        let list = if known || self.expects_known { List::Often } else { List::Once };
        (self.expects_often, self.expects_known) = (false, false);
        self.link(slot, Entry { key, weight, list });
        self.bound_ghosts();
    }

    fn touch(&mut self, slot: u32) {
        let entry = self.unlink(slot);
        self.link(slot, Entry { list: List::Often, ..entry });
    }

    fn remove(&mut self, slot: u32) {
        self.unlink(slot);
    }

    /// The paper's REPLACE.
    fn evict(&mut self) -> Option<u32> {
        let over = self.once_weight > self.target || (self.expects_often && self.once_weight == self.target);
        let from_once = if over { self.once.oldest() } else { None };
        let slot = from_once.or(self.often.oldest()).or(self.once.oldest())?;
        let entry = self.unlink(slot);
        let ghosts = if entry.list == List::Once { &mut self.once_ghosts } else { &mut self.often_ghosts };
        ghosts.push(entry.key, entry.weight, ());
        self.bound_ghosts();
        Some(slot)
    }
}
