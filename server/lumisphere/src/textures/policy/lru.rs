//! Exact least recently used (P. Denning 1968): the reference of all others.

use super::order::Order;
use super::{PageKey, Policy};

/// Gives up what has not been used for longest.
#[derive(Debug)]
pub struct Lru {
    order: Order,
}

impl Lru {
    /// Knows no slot yet.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        Self { order: Order::new() }
    }
}

impl Policy for Lru {
    fn insert(&mut self, slot: u32, _: PageKey, _: u64) {
        self.order.push_newest(slot);
    }
    #[inline]
    fn touch(&mut self, slot: u32) {
        self.order.make_newest(slot);
    }
    fn remove(&mut self, slot: u32) {
        self.order.remove(slot);
    }
    fn evict(&mut self) -> Option<u32> {
        self.order.pop_oldest()
    }
}
