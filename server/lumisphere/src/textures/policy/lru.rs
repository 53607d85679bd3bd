//! Exact least-recently-used order: a doubly linked list through an array of slots, O(1) an operation.

/// End of the list; also the links of a slot that is not in it.
const NONE: u32 = u32::MAX;

#[derive(Debug, Clone, Copy)]
struct Links {
    newer: u32,
    older: u32,
}

/// Orders slots 0…n−1 by last use. Grows as slots are added; never allocates on a touch.
#[derive(Debug)]
pub(in crate::textures) struct Lru {
    links: Vec<Links>,
    newest: u32,
    oldest: u32,
}

impl Lru {
    /// No slot.
    pub fn new() -> Self {
        Self { links: Vec::new(), newest: NONE, oldest: NONE }
    }

    /// Adds a slot that is not in the order, as the newest.
    pub fn insert(&mut self, slot: u32) {
        if self.links.len() <= slot as usize {
            self.links.resize(slot as usize + 1, Links { newer: NONE, older: NONE });
        }
        self.links[slot as usize] = Links { newer: NONE, older: self.newest };
        match self.newest {
            NONE => self.oldest = slot,
            newest => self.links[newest as usize].newer = slot,
        }
        self.newest = slot;
    }

    /// Makes a slot of the order the newest.
    #[inline]
    pub fn touch(&mut self, slot: u32) {
        if self.newest != slot {
            self.remove(slot);
            self.insert(slot);
        }
    }

    /// Takes a slot out of the order.
    pub fn remove(&mut self, slot: u32) {
        let Links { newer, older } = self.links[slot as usize];
        match newer {
            NONE => self.newest = older,
            newer => self.links[newer as usize].older = older,
        }
        match older {
            NONE => self.oldest = newer,
            older => self.links[older as usize].newer = newer,
        }
    }

    /// The slot to give up next; None when there is none.
    pub fn victim(&self) -> Option<u32> {
        (self.oldest != NONE).then_some(self.oldest)
    }
}
