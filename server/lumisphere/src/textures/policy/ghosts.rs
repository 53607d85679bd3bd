//! Keys of pages that were given up lately: what lets a policy see that it was wrong.

use std::collections::{HashMap, VecDeque};

use super::PageKey;

/// Keys in the order they left, under a bound of weight. A key taken out leaves a hole that is skipped when its turn comes.
#[derive(Debug)]
pub(super) struct Ghosts {
    queue: VecDeque<(PageKey, u64)>,
    // Serial number and weight; a queue entry whose serial differs is a hole.
    present: HashMap<PageKey, (u64, u64)>,
    next_serial: u64,
    weight: u64,
}

impl Ghosts {
    pub fn new() -> Self {
        Self { queue: VecDeque::new(), present: HashMap::new(), next_serial: 0, weight: 0 }
    }

    /// Sum over the keys.
    pub fn weight(&self) -> u64 {
        self.weight
    }

    pub fn contains(&self, key: PageKey) -> bool {
        self.present.contains_key(&key)
    }

    /// Adds a key as the newest.
    pub fn push(&mut self, key: PageKey, weight: u64) {
        self.take(key);
        self.queue.push_back((key, self.next_serial));
        self.present.insert(key, (self.next_serial, weight));
        self.next_serial += 1;
        self.weight += weight;
    }

    /// Takes a key out; whether it was there.
    pub fn take(&mut self, key: PageKey) -> bool {
        let Some((_, weight)) = self.present.remove(&key) else { return false };
        self.weight -= weight;
        // Holes never outnumber keys by much, so memory stays proportional to the keys.
        if self.queue.len() > 2 * self.present.len() + 16 {
            let present = &self.present;
            self.queue.retain(|(key, serial)| present.get(key).is_some_and(|(s, _)| s == serial));
        }
        true
    }

    /// Forgets the oldest keys until at most `bound` is left.
    pub fn shrink_to(&mut self, bound: u64) {
        while self.weight > bound {
            let Some((key, serial)) = self.queue.pop_front() else { return };
            if self.present.get(&key).is_some_and(|(s, _)| *s == serial) {
                self.take(key);
            }
        }
    }
}
