//! Slots in a row from newest to oldest: a doubly linked list through an array, O(1) an operation. What the policies are built of.

/// End of the list; also the links of a slot that is not in it.
const NONE: u32 = u32::MAX;

#[derive(Debug, Clone, Copy)]
struct Links {
    newer: u32,
    older: u32,
}

/// A row of slots. Grows as slots are added; never allocates otherwise. A slot must not be added twice nor removed when absent.
#[derive(Debug)]
pub(super) struct Order {
    links: Vec<Links>,
    newest: u32,
    oldest: u32,
}

impl Order {
    /// No slot.
    pub fn new() -> Self {
        Self { links: Vec::new(), newest: NONE, oldest: NONE }
    }

    /// Adds a slot at the newest end.
    pub fn push_newest(&mut self, slot: u32) {
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

    /// Makes a slot of the row its newest.
    #[inline]
    pub fn make_newest(&mut self, slot: u32) {
        if self.newest != slot {
            self.remove(slot);
            self.push_newest(slot);
        }
    }

    /// Takes a slot out.
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

    /// None when the row is empty.
    pub fn oldest(&self) -> Option<u32> {
        (self.oldest != NONE).then_some(self.oldest)
    }

    /// None when the row is empty.
    pub fn newest(&self) -> Option<u32> {
        (self.newest != NONE).then_some(self.newest)
    }

    /// Takes the oldest slot out.
    pub fn pop_oldest(&mut self) -> Option<u32> {
        let oldest = self.oldest()?;
        self.remove(oldest);
        Some(oldest)
    }
}
