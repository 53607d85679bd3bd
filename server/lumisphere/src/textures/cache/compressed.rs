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

/// Names a block for good: its version's slot beside the key, which distant versions share.
pub(super) type BlockId = (u32, PageKey);

#[derive(Debug)]
struct State {
    policy: Box<dyn Policy>,
    kind: PolicyKind,
    frame_of: HashMap<BlockId, u32>,
    frames: Vec<Option<(BlockId, Arc<[u8]>)>>,
    free: Vec<u32>,
    budget: u64,
    resident_bytes: u64,
    peak_bytes: u64,
    /// By version slot; without the budget.
    shares: Vec<CompressedStats>,
}

fn charge(bytes: &[u8]) -> u64 {
    bytes.len() as u64 + OVERHEAD_BYTES
}

impl CompressedTier {
    pub fn new(budget: u64, kind: PolicyKind) -> Self {
        Self {
            state: Mutex::new(State {
                policy: kind.make(budget),
                kind,
                frame_of: HashMap::new(),
                frames: vec![],
                free: vec![],
                budget,
                resident_bytes: 0,
                peak_bytes: 0,
                shares: vec![],
            }),
        }
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
        self.state().budget > 0
    }

    pub fn get(&self, id: BlockId) -> Option<Arc<[u8]>> {
        let state = &mut *self.state();
        let found = state.frame_of.get(&id).copied();
        let share = state.share(id);
        share.look_ups += 1;
        share.hits += u64::from(found.is_some());
        share.misses += u64::from(found.is_none());
        let frame = found?;
        state.policy.touch(frame);
        state.frames[frame as usize].as_ref().map(|(_, bytes)| bytes.clone())
    }

    /// Keeps a block that has proved to be what was written.
    pub fn keep(&self, id: BlockId, bytes: Arc<[u8]>) {
        let state = &mut *self.state();
        let weight = charge(&bytes);
        if weight > state.budget || state.frame_of.contains_key(&id) {
            return;
        }
        state.policy.expect(id.1, weight);
        state.evict_down_to(state.budget - weight);
        let frame = state.free.pop().unwrap_or_else(|| {
            state.frames.push(None);
            state.frames.len() as u32 - 1
        });
        state.frames[frame as usize] = Some((id, bytes));
        state.frame_of.insert(id, frame);
        state.policy.insert(frame, id.1, weight);
        state.resident_bytes += weight;
        state.peak_bytes = state.peak_bytes.max(state.resident_bytes);
        let share = state.share(id);
        share.resident_blocks += 1;
        share.resident_bytes += weight;
        share.peak_bytes = share.peak_bytes.max(share.resident_bytes);
        debug_assert!(state.resident_bytes <= state.budget);
    }

    /// Of all versions, and by version slot.
    pub fn stats(&self) -> (CompressedStats, PolicyKind, Vec<CompressedStats>) {
        let state = self.state();
        let shares: Vec<_> = state.shares.iter().map(|share| CompressedStats { budget_bytes: state.budget, ..*share }).collect();
        let nothing = CompressedStats { budget_bytes: state.budget, peak_bytes: state.peak_bytes, ..CompressedStats::default() };
        let total = shares.iter().fold(nothing, |sum, share| CompressedStats {
            look_ups: sum.look_ups + share.look_ups,
            hits: sum.hits + share.hits,
            misses: sum.misses + share.misses,
            evictions: sum.evictions + share.evictions,
            resident_blocks: sum.resident_blocks + share.resident_blocks,
            resident_bytes: sum.resident_bytes + share.resident_bytes,
            // Versions have theirs at different times.
            ..sum
        });
        (total, state.kind, shares)
    }

    pub fn set_budget(&self, bytes: u64) {
        let mut state = self.state();
        state.budget = bytes;
        state.policy.set_capacity(bytes);
        state.evict_down_to(bytes);
    }

    pub fn set_policy(&self, kind: PolicyKind) {
        let state = &mut *self.state();
        let mut policy = kind.make(state.budget);
        while let Some(frame) = state.policy.evict() {
            let ((_, key), bytes) = state.frames[frame as usize].as_ref().expect("a frame in the policy's order is occupied");
            policy.insert(frame, *key, charge(bytes));
        }
        (state.policy, state.kind) = (policy, kind);
    }

    pub fn clear(&self) {
        self.state().evict_down_to(0);
    }

    pub fn forget_peaks(&self) {
        let state = &mut *self.state();
        state.peak_bytes = state.resident_bytes;
        state.shares.iter_mut().for_each(|share| share.peak_bytes = share.resident_bytes);
    }

    pub fn begin_frame(&self) {
        self.state().policy.begin_frame();
    }
}

impl State {
    fn share(&mut self, (version, _): BlockId) -> &mut CompressedStats {
        let at = version as usize;
        if self.shares.len() <= at {
            self.shares.resize(at + 1, CompressedStats::default());
        }
        &mut self.shares[at]
    }

    fn evict_down_to(&mut self, bytes: u64) {
        while self.resident_bytes > bytes {
            let frame = self.policy.evict().expect("resident bytes belong to frames in the policy's order");
            let (id, block) = self.frames[frame as usize].take().expect("a frame in the policy's order is occupied");
            self.frame_of.remove(&id);
            self.free.push(frame);
            self.resident_bytes -= charge(&block);
            let share = self.share(id);
            share.evictions += 1;
            share.resident_blocks -= 1;
            share.resident_bytes -= charge(&block);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Their keys are the same, and what one wrote would be damage to the other.
    #[test]
    fn versions_far_apart_do_not_share_blocks_and_have_counters_of_their_own() {
        let tier = CompressedTier::new(1000, PolicyKind::Lru);
        let key = PageKey(7);
        let [near, far] = [(1, key), (1 + (1 << 12), key)];
        tier.keep(near, [1; 100].into());
        assert!(tier.get(far).is_none());
        tier.keep(far, [2; 600].into());
        assert_eq!((tier.get(near).as_deref(), tier.get(far).as_deref()), (Some(&[1; 100][..]), Some(&[2; 600][..])));
        // No room for three.
        tier.keep((1, PageKey(8)), [3; 100].into());
        let (total, _, shares) = tier.stats();
        let share = |(version, _): BlockId| shares[version as usize];
        let told = |s: CompressedStats| [s.look_ups, s.hits, s.misses, s.evictions, s.resident_blocks, s.resident_bytes, s.peak_bytes];
        assert_eq!(told(share(near)), [1, 1, 0, 1, 1, 228, 228]);
        assert_eq!(told(share(far)), [2, 1, 1, 0, 1, 728, 728]);
        assert_eq!(told(total), [3, 2, 1, 1, 2, 956, 956]);
    }
}
