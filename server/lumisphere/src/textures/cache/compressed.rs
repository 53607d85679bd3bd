//! The tier below: compressed blocks in memory, under their own budget and policy. Only misses of the decoded tier come here, each of
//! which unpacks for microseconds, so one lock for all is enough.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::stats::CompressedStats;
use crate::textures::policy::{PageKey, Policy, PolicyKind};

/// What a block costs beside its bytes: its entry in the table, in the policy, and its allocation.
const OVERHEAD_BYTES: u64 = 128;

#[derive(Debug)]
pub(super) struct CompressedTier {
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    policy: Box<dyn Policy>,
    kind: PolicyKind,
    frame_of: HashMap<PageKey, u32>,
    frames: Vec<Option<(PageKey, Arc<[u8]>)>>,
    free: Vec<u32>,
    stats: CompressedStats,
}

fn charge(bytes: &[u8]) -> u64 {
    bytes.len() as u64 + OVERHEAD_BYTES
}

impl CompressedTier {
    pub fn new(budget: u64, kind: PolicyKind) -> Self {
        let stats = CompressedStats { budget_bytes: budget, ..CompressedStats::default() };
        let state = State { policy: kind.make(budget), kind, frame_of: HashMap::new(), frames: vec![], free: vec![], stats };
        Self { state: Mutex::new(state) }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Its lock, for a test of who waits for it.
    #[cfg(test)]
    pub fn held(&self) -> MutexGuard<'_, impl Sized> {
        self.state()
    }

    /// Whether it may hold anything.
    pub fn is_on(&self) -> bool {
        self.state().stats.budget_bytes > 0
    }

    pub fn get(&self, key: PageKey) -> Option<Arc<[u8]>> {
        let state = &mut *self.state();
        state.stats.look_ups += 1;
        let Some(&frame) = state.frame_of.get(&key) else {
            state.stats.misses += 1;
            return None;
        };
        state.stats.hits += 1;
        state.policy.touch(frame);
        state.frames[frame as usize].as_ref().map(|(_, bytes)| bytes.clone())
    }

    /// Keeps a block that has proved to be what was written.
    pub fn keep(&self, key: PageKey, bytes: Arc<[u8]>) {
        let state = &mut *self.state();
        let weight = charge(&bytes);
        if weight > state.stats.budget_bytes || state.frame_of.contains_key(&key) {
            return;
        }
        state.policy.expect(key, weight);
        state.evict_down_to(state.stats.budget_bytes - weight);
        let frame = state.free.pop().unwrap_or_else(|| {
            state.frames.push(None);
            state.frames.len() as u32 - 1
        });
        state.frames[frame as usize] = Some((key, bytes));
        state.frame_of.insert(key, frame);
        state.policy.insert(frame, key, weight);
        state.stats.resident_blocks += 1;
        state.stats.resident_bytes += weight;
        state.stats.peak_bytes = state.stats.peak_bytes.max(state.stats.resident_bytes);
        debug_assert!(state.stats.resident_bytes <= state.stats.budget_bytes);
    }

    pub fn stats(&self) -> (CompressedStats, PolicyKind) {
        let state = self.state();
        (state.stats, state.kind)
    }

    pub fn set_budget(&self, bytes: u64) {
        let mut state = self.state();
        state.stats.budget_bytes = bytes;
        state.policy.set_capacity(bytes);
        state.evict_down_to(bytes);
    }

    pub fn set_policy(&self, kind: PolicyKind) {
        let state = &mut *self.state();
        let mut policy = kind.make(state.stats.budget_bytes);
        while let Some(frame) = state.policy.evict() {
            let (key, bytes) = state.frames[frame as usize].as_ref().expect("a frame in the policy's order is occupied");
            policy.insert(frame, *key, charge(bytes));
        }
        (state.policy, state.kind) = (policy, kind);
    }

    pub fn clear(&self) {
        self.state().evict_down_to(0);
    }

    pub fn forget_peak(&self) {
        let stats = &mut self.state().stats;
        stats.peak_bytes = stats.resident_bytes;
    }

    pub fn begin_frame(&self) {
        self.state().policy.begin_frame();
    }
}

impl State {
    fn evict_down_to(&mut self, bytes: u64) {
        while self.stats.resident_bytes > bytes {
            let frame = self.policy.evict().expect("resident bytes belong to frames in the policy's order");
            let (key, block) = self.frames[frame as usize].take().expect("a frame in the policy's order is occupied");
            self.frame_of.remove(&key);
            self.free.push(frame);
            self.stats.evictions += 1;
            self.stats.resident_blocks -= 1;
            self.stats.resident_bytes -= charge(&block);
        }
    }
}
