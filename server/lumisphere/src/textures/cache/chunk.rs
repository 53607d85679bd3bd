//! What a slot holds: decoded rows, immutable. More rows of the page make a new chunk.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use crate::textures::codec::Stopped;
use crate::textures::page::Page;

/// Names an entry of the order of eviction, also after it has left it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Ticket {
    pub frame: u32,
    pub serial: u32,
}

/// No entry: handed out without being kept.
pub(super) const UNKEPT: Ticket = Ticket { frame: u32::MAX, serial: 0 };

/// Rows of a page.
#[derive(Debug)]
pub(super) struct Chunk {
    /// The rows, as a page of their height.
    pub page: Arc<Page>,
    pub rows: Range<u32>,
    /// Of the whole page.
    pub page_height: u32,
    pub ticket: Ticket,
    /// Where a sequential codec stopped behind the rows; it takes no more memory than the rows that are missing.
    decoder: Mutex<Option<Stopped>>,
    evicted: AtomicBool,
}

impl Chunk {
    pub fn new(page: Arc<Page>, rows: Range<u32>, page_height: u32, ticket: Ticket, decoder: Option<Stopped>) -> Self {
        Self { page, rows, page_height, ticket, decoder: Mutex::new(decoder), evicted: AtomicBool::new(ticket == UNKEPT) }
    }

    /// Takes the decoder, to go on behind the rows; who takes it makes the chunk that replaces this one.
    pub fn take_decoder(&self) -> Option<Stopped> {
        self.decoder.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take()
    }

    pub fn is_whole(&self) -> bool {
        self.rows == (0..self.page_height)
    }

    /// Whether the cache has given it up. Who still holds it may use it, but not take it for a hit.
    #[inline]
    pub fn is_evicted(&self) -> bool {
        self.evicted.load(Ordering::Relaxed)
    }

    pub fn mark_evicted(&self) {
        self.evicted.store(true, Ordering::Relaxed);
    }
}
