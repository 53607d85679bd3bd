//! CLOCK (F. J. Corbató 1968): first in, first out, with a second chance for what was used since the hand last came by.
//! A page's arrival does not count as a use, so that pages used once go before pages used twice.

use super::order::Order;
use super::{PageKey, Policy};

/// The hand points at the oldest slot; passing one puts it at the newest end.
#[derive(Debug)]
pub struct Clock {
    order: Order,
    used: Vec<bool>,
}

impl Clock {
    /// Knows no slot yet.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        Self { order: Order::new(), used: Vec::new() }
    }
}

impl Policy for Clock {
    fn insert(&mut self, slot: u32, _: PageKey, _: u64) {
        if self.used.len() <= slot as usize {
            self.used.resize(slot as usize + 1, false);
        }
        self.used[slot as usize] = false;
        self.order.push_newest(slot);
    }
    #[inline]
    fn touch(&mut self, slot: u32) {
        self.used[slot as usize] = true;
    }
    fn remove(&mut self, slot: u32) {
        self.order.remove(slot);
    }
    fn evict(&mut self) -> Option<u32> {
        loop {
            let slot = self.order.pop_oldest()?;
            if !std::mem::take(&mut self.used[slot as usize]) {
                return Some(slot);
            }
            self.order.push_newest(slot);
        }
    }
}
