//! Who is resident and who leaves: the byte budget and the policy of the decoded tier, under the one lock that only misses take.

use std::ops::Range;
use std::sync::{Arc, Mutex};

use super::chunk::{Chunk, Ticket, UNKEPT};
use super::table::{PageSlots, Part};
use crate::textures::codec::Stopped;
use crate::textures::page::Page;
use crate::textures::policy::{Policy, PolicyKind};

/// Decoded rows on their way into a slot.
#[derive(Debug)]
pub(super) struct Arriving {
    pub page: Arc<Page>,
    pub rows: Range<u32>,
    pub page_height: u32,
    /// Against the budget.
    pub bytes: u64,
    /// To go on behind the rows; None where it has been handed on.
    pub decoder: Mutex<Option<Stopped>>,
}

#[derive(Debug)]
struct Frame {
    slots: Arc<PageSlots>,
    part: Part,
    chunk: Arc<Chunk>,
    bytes: u64,
}

/// What one version has resident, and lost.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Share {
    pub evictions: u64,
    pub pages: u64,
    pub bytes: u64,
    /// Most bytes at once.
    pub peak_bytes: u64,
}

/// Frames are dense numbers, reused; a serial number tells their occupants apart.
#[derive(Debug)]
pub(super) struct Residency {
    policy: Box<dyn Policy>,
    kind: PolicyKind,
    frames: Vec<(u32, Option<Frame>)>,
    free: Vec<u32>,
    pub budget: u64,
    pub resident_bytes: u64,
    peak_bytes: u64,
    /// By version slot.
    shares: Vec<Share>,
}

impl Residency {
    pub fn new(budget: u64, kind: PolicyKind) -> Self {
        let policy = kind.make(budget);
        Self { policy, kind, frames: vec![], free: vec![], budget, resident_bytes: 0, peak_bytes: 0, shares: vec![] }
    }

    pub fn kind(&self) -> PolicyKind {
        self.kind
    }

    pub fn share(&self, version: u32) -> Share {
        self.shares.get(version as usize).copied().unwrap_or_default()
    }

    /// Of all versions.
    pub fn total(&self) -> Share {
        self.shares.iter().fold(Share::default(), |sum, s| Share {
            evictions: sum.evictions + s.evictions,
            pages: sum.pages + s.pages,
            bytes: sum.bytes + s.bytes,
            // Versions have theirs at different times.
            peak_bytes: self.peak_bytes,
        })
    }

    fn share_mut(&mut self, version: u32) -> &mut Share {
        let at = version as usize;
        if self.shares.len() <= at {
            self.shares.resize(at + 1, Share::default());
        }
        &mut self.shares[at]
    }

    /// A use that was noted earlier; void if the chunk has left since.
    pub fn touch(&mut self, ticket: Ticket) {
        if self.is_current(ticket) {
            self.policy.touch(ticket.frame);
        }
    }

    fn is_current(&self, ticket: Ticket) -> bool {
        self.frames.get(ticket.frame as usize).is_some_and(|(serial, frame)| *serial == ticket.serial && frame.is_some())
    }

    /// Makes room, then takes the rows in and puts them into their slot: the budget holds at every step. None: larger than the
    /// budget, not kept.
    pub fn keep(&mut self, slots: &Arc<PageSlots>, part: Part, arriving: &Arriving) -> Option<Arc<Chunk>> {
        let slot = slots.slot(part)?;
        if let Some(old) = slot.get().filter(|old| self.is_current(old.ticket)) {
            // More rows of a page that is charged as a whole; the visit that wanted them was noted as a use.
            let chunk = Arc::new(arriving.chunk(old.ticket));
            self.frames[old.ticket.frame as usize].1.as_mut()?.chunk = chunk.clone();
            old.mark_evicted();
            slot.install(chunk.clone());
            self.supersede_blocks(slots, &chunk);
            return Some(chunk);
        }
        if arriving.bytes > self.budget {
            return None;
        }
        let key = slots.key(part);
        self.policy.expect(key, arriving.bytes);
        self.evict_down_to(self.budget - arriving.bytes);
        let frame = self.free.pop().unwrap_or_else(|| {
            self.frames.push((0, None));
            self.frames.len() as u32 - 1
        });
        let (serial, place) = &mut self.frames[frame as usize];
        *serial = serial.wrapping_add(1);
        let chunk = Arc::new(arriving.chunk(Ticket { frame, serial: *serial }));
        *place = Some(Frame { slots: slots.clone(), part, chunk: chunk.clone(), bytes: arriving.bytes });
        self.policy.insert(frame, key, arriving.bytes);
        self.resident_bytes += arriving.bytes;
        self.peak_bytes = self.peak_bytes.max(self.resident_bytes);
        let share = self.share_mut(slots.version);
        share.pages += 1;
        share.bytes += arriving.bytes;
        share.peak_bytes = share.peak_bytes.max(share.bytes);
        slot.install(chunk.clone());
        self.supersede_blocks(slots, &chunk);
        debug_assert!(self.resident_bytes <= self.budget, "{} of {} bytes", self.resident_bytes, self.budget);
        Some(chunk)
    }

    /// Blocks cached on their own are of no use beside the whole page.
    fn supersede_blocks(&mut self, slots: &PageSlots, chunk: &Chunk) {
        if chunk.is_whole() && chunk.page_height > 0 {
            for block in slots.resident_blocks().filter(|block| block.ticket != chunk.ticket) {
                if self.is_current(block.ticket) {
                    self.policy.remove(block.ticket.frame);
                    self.release(block.ticket.frame);
                }
            }
        }
    }

    fn evict_down_to(&mut self, bytes: u64) {
        while self.resident_bytes > bytes {
            let frame = self.policy.evict().expect("resident bytes belong to frames in the policy's order");
            self.release(frame);
        }
    }

    /// Empties a frame that the policy has let go of.
    fn release(&mut self, frame: u32) {
        let occupant = self.frames[frame as usize].1.take().expect("a frame in the policy's order is occupied");
        if let Some(slot) = occupant.slots.slot(occupant.part) {
            slot.vacate();
        }
        occupant.chunk.mark_evicted();
        self.free.push(frame);
        self.resident_bytes -= occupant.bytes;
        let share = self.share_mut(occupant.slots.version);
        share.evictions += 1;
        share.pages -= 1;
        share.bytes -= occupant.bytes;
    }

    pub fn set_budget(&mut self, bytes: u64) {
        self.budget = bytes;
        self.policy.set_capacity(bytes);
        self.evict_down_to(bytes);
    }

    /// Hands the residents over in the order in which the old policy would have given them up.
    pub fn set_policy(&mut self, kind: PolicyKind) {
        let mut policy = kind.make(self.budget);
        while let Some(frame) = self.policy.evict() {
            let occupant = self.frames[frame as usize].1.as_ref().expect("a frame in the policy's order is occupied");
            policy.insert(frame, occupant.slots.key(occupant.part), occupant.bytes);
        }
        (self.policy, self.kind) = (policy, kind);
    }

    pub fn clear(&mut self) {
        for frame in 0..self.frames.len() as u32 {
            if self.frames[frame as usize].1.is_some() {
                self.policy.remove(frame);
                self.release(frame);
            }
        }
    }

    pub fn forget_peaks(&mut self) {
        self.peak_bytes = self.resident_bytes;
        self.shares.iter_mut().for_each(|share| share.peak_bytes = share.bytes);
    }

    pub fn begin_frame(&mut self) {
        self.policy.begin_frame();
    }
}

impl Arriving {
    fn chunk(&self, ticket: Ticket) -> Chunk {
        let decoder = self.decoder.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
        Chunk::new(self.page.clone(), self.rows.clone(), self.page_height, ticket, decoder)
    }

    /// To be handed out without being kept.
    pub fn unkept(&self) -> Arc<Chunk> {
        Arc::new(self.chunk(UNKEPT))
    }
}
