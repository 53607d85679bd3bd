//! Pages that were given up lately, by key: what lets a policy see that it was wrong.

use std::collections::{HashMap, VecDeque};

use super::PageKey;

/// Keys in the order they left, under a bound of weight, each with what is remembered of the page. A key taken out leaves a hole that is
/// skipped when its turn comes.
#[derive(Debug)]
pub(super) struct Ghosts<T = ()> {
    queue: VecDeque<(PageKey, u64)>,
    // A queue entry whose serial number differs is a hole.
    present: HashMap<PageKey, Ghost<T>>,
    next_serial: u64,
    weight: u64,
}

#[derive(Debug)]
struct Ghost<T> {
    serial: u64,
    weight: u64,
    memory: T,
}

impl<T> Ghosts<T> {
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

    /// Of every key, in no order.
    pub fn memories(&self) -> impl Iterator<Item = &T> {
        self.present.values().map(|ghost| &ghost.memory)
    }

    pub fn len(&self) -> usize {
        self.present.len()
    }

    /// Adds a key as the newest.
    pub fn push(&mut self, key: PageKey, weight: u64, memory: T) {
        self.take(key);
        self.queue.push_back((key, self.next_serial));
        self.present.insert(key, Ghost { serial: self.next_serial, weight, memory });
        self.next_serial += 1;
        self.weight += weight;
    }

    /// Takes a key out; None if it was not there.
    pub fn take(&mut self, key: PageKey) -> Option<T> {
        let Ghost { weight, memory, .. } = self.present.remove(&key)?;
        self.weight -= weight;
        // Holes never outnumber keys by much, so memory stays proportional to the keys.
        if self.queue.len() > 2 * self.present.len() + 16 {
            let present = &self.present;
            self.queue.retain(|(key, serial)| present.get(key).is_some_and(|ghost| ghost.serial == *serial));
        }
        Some(memory)
    }

    /// Forgets the oldest key if more than `bound` is left; None if not.
    pub fn pop_beyond(&mut self, bound: u64) -> Option<T> {
        while self.weight > bound {
            let (key, serial) = self.queue.pop_front()?;
            if self.present.get(&key).is_some_and(|ghost| ghost.serial == serial) {
                return self.take(key);
            }
        }
        None
    }

    /// Forgets the oldest keys until at most `bound` is left.
    pub fn shrink_to(&mut self, bound: u64) {
        while self.pop_beyond(bound).is_some() {}
    }
}
