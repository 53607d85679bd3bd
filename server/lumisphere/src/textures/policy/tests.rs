//! Every policy against a naive model of the same paper: lists of keys, searched from end to end.

mod gittins;

use std::collections::HashMap;

use proptest::prelude::*;

use super::*;

/// What the models agree on: which key leaves. Weights are 1; `expect` and `insert` are one step.
trait Model {
    fn hit(&mut self, key: u64);
    /// `key` is not resident. Returns the key that left for it, if the cache was full.
    fn miss(&mut self, key: u64, full: bool) -> Option<u64>;
    fn forget(&mut self, key: u64);
    fn begin_frame(&mut self) {}
}

fn drop_key(list: &mut Vec<u64>, key: u64) -> bool {
    let at = list.iter().position(|&k| k == key);
    at.map(|at| list.remove(at)).is_some()
}

/// Newest last.
#[derive(Default)]
struct NaiveLru(Vec<u64>);

impl Model for NaiveLru {
    fn hit(&mut self, key: u64) {
        drop_key(&mut self.0, key);
        self.0.push(key);
    }
    fn miss(&mut self, key: u64, full: bool) -> Option<u64> {
        let left = full.then(|| self.0.remove(0));
        self.0.push(key);
        left
    }
    fn forget(&mut self, key: u64) {
        drop_key(&mut self.0, key);
    }
}

/// A real ring with a hand.
#[derive(Default)]
struct NaiveClock {
    ring: Vec<(u64, bool)>,
    hand: usize,
}

impl Model for NaiveClock {
    fn hit(&mut self, key: u64) {
        self.ring.iter_mut().find(|(k, _)| *k == key).unwrap().1 = true;
    }
    fn miss(&mut self, key: u64, full: bool) -> Option<u64> {
        let mut left = None;
        if full {
            loop {
                self.hand %= self.ring.len();
                if !self.ring[self.hand].1 {
                    left = Some(self.ring.remove(self.hand).0);
                    break;
                }
                self.ring[self.hand].1 = false;
                self.hand += 1;
            }
        }
        // Just behind the hand: the last place it comes to.
        self.ring.insert(self.hand.min(self.ring.len()), (key, false));
        self.hand += 1;
        left
    }
    fn forget(&mut self, key: u64) {
        let at = self.ring.iter().position(|(k, _)| *k == key).unwrap();
        self.ring.remove(at);
        if at < self.hand {
            self.hand -= 1;
        }
    }
}

/// Figure 4 of the ARC paper with lists of keys, newest last.
struct NaiveArc {
    c: usize,
    p: usize,
    t1: Vec<u64>,
    t2: Vec<u64>,
    b1: Vec<u64>,
    b2: Vec<u64>,
}

impl NaiveArc {
    fn new(c: usize) -> Self {
        Self { c, p: 0, t1: vec![], t2: vec![], b1: vec![], b2: vec![] }
    }

    fn replace(&mut self, in_b2: bool) -> u64 {
        let from_t1 = !self.t1.is_empty() && (self.t1.len() > self.p || (in_b2 && self.t1.len() == self.p) || self.t2.is_empty());
        let (from, ghosts) = if from_t1 { (&mut self.t1, &mut self.b1) } else { (&mut self.t2, &mut self.b2) };
        let left = from.remove(0);
        ghosts.push(left);
        left
    }

    fn bound(&mut self) {
        while self.t1.len() + self.b1.len() > self.c && !self.b1.is_empty() {
            self.b1.remove(0);
        }
        while self.t1.len() + self.t2.len() + self.b1.len() + self.b2.len() > 2 * self.c && !self.b2.is_empty() {
            self.b2.remove(0);
        }
    }
}

impl Model for NaiveArc {
    fn hit(&mut self, key: u64) {
        let _ = drop_key(&mut self.t1, key) || drop_key(&mut self.t2, key);
        self.t2.push(key);
    }
    fn miss(&mut self, key: u64, full: bool) -> Option<u64> {
        let (in_b1, in_b2) = (self.b1.contains(&key), self.b2.contains(&key));
        let (one, two) = (self.b1.len().max(1), self.b2.len().max(1));
        if in_b1 {
            self.p = (self.p + (two / one).max(1)).min(self.c);
        } else if in_b2 {
            self.p = self.p.saturating_sub((one / two).max(1));
        }
        let left = full.then(|| self.replace(in_b2));
        self.bound();
        drop_key(&mut self.b1, key);
        drop_key(&mut self.b2, key);
        if in_b1 || in_b2 { &mut self.t2 } else { &mut self.t1 }.push(key);
        self.bound();
        left
    }
    fn forget(&mut self, key: u64) {
        let _ = drop_key(&mut self.t1, key) || drop_key(&mut self.t2, key);
    }
}

/// Algorithm 1 of the S3-FIFO paper, oldest first.
struct NaiveS3Fifo {
    capacity: usize,
    small: Vec<(u64, u8)>,
    main: Vec<(u64, u8)>,
    ghosts: Vec<u64>,
}

impl NaiveS3Fifo {
    fn evict(&mut self) -> u64 {
        let from_small = self.small.len() > self.capacity / 10 || self.main.is_empty();
        while from_small && !self.small.is_empty() {
            let (key, uses) = self.small.remove(0);
            if uses <= 1 {
                self.ghosts.push(key);
                while self.ghosts.len() > self.capacity - self.capacity / 10 {
                    self.ghosts.remove(0);
                }
                return key;
            }
            self.main.push((key, 0));
        }
        loop {
            let (key, uses) = self.main.remove(0);
            if uses == 0 {
                return key;
            }
            self.main.push((key, uses - 1));
        }
    }
}

impl Model for NaiveS3Fifo {
    fn hit(&mut self, key: u64) {
        let uses = self.small.iter_mut().chain(&mut self.main).find(|(k, _)| *k == key).unwrap();
        uses.1 = (uses.1 + 1).min(3);
    }
    fn miss(&mut self, key: u64, full: bool) -> Option<u64> {
        let left = full.then(|| self.evict());
        if drop_key(&mut self.ghosts, key) { &mut self.main } else { &mut self.small }.push((key, 0));
        left
    }
    fn forget(&mut self, key: u64) {
        self.small.retain(|(k, _)| *k != key);
        self.main.retain(|(k, _)| *k != key);
    }
}

/// Oldest first, with the frame of the last use.
#[derive(Default)]
struct NaiveFrameLru {
    pages: Vec<(u64, u64)>,
    frame: u64,
}

impl Model for NaiveFrameLru {
    fn hit(&mut self, key: u64) {
        self.forget(key);
        self.pages.push((key, self.frame));
    }
    fn miss(&mut self, key: u64, full: bool) -> Option<u64> {
        let frame = self.frame;
        let stale = self.pages.iter().position(|(_, used)| frame == 0 || frame - used >= 2);
        let left = full.then(|| self.pages.remove(stale.unwrap_or(self.pages.len() - 1)).0);
        self.pages.push((key, frame));
        left
    }
    fn forget(&mut self, key: u64) {
        self.pages.retain(|(k, _)| *k != key);
    }
    fn begin_frame(&mut self) {
        self.frame += 1;
    }
}

fn model(kind: PolicyKind, capacity: usize) -> Box<dyn Model> {
    match kind {
        // Gittins learns for the first time after more visits than are made here: until then it is LRU.
        PolicyKind::Lru | PolicyKind::Gittins => Box::new(NaiveLru::default()),
        PolicyKind::Clock => Box::new(NaiveClock::default()),
        PolicyKind::Arc => Box::new(NaiveArc::new(capacity)),
        PolicyKind::S3Fifo => Box::new(NaiveS3Fifo { capacity, small: vec![], main: vec![], ghosts: vec![] }),
        PolicyKind::FrameLru => Box::new(NaiveFrameLru::default()),
    }
}

/// Slots, as their owner keeps them.
struct Pool {
    policy: Box<dyn Policy>,
    slot_of: HashMap<u64, u32>,
    key_in: Vec<Option<u64>>,
}

impl Pool {
    fn new(kind: PolicyKind, capacity: usize) -> Self {
        Self::of(kind.make(capacity as u64), capacity)
    }

    fn of(policy: Box<dyn Policy>, capacity: usize) -> Self {
        Self { policy, slot_of: HashMap::new(), key_in: vec![None; capacity] }
    }

    fn is_full(&self) -> bool {
        self.slot_of.len() == self.key_in.len()
    }

    /// Whether it was a miss, and who left.
    fn ask(&mut self, key: u64) -> (bool, Option<u64>) {
        if let Some(&slot) = self.slot_of.get(&key) {
            self.policy.touch(slot);
            return (false, None);
        }
        self.policy.expect(PageKey(key), 1);
        let mut left = None;
        if self.is_full() {
            let slot = self.policy.evict().expect("a full pool yields");
            left = self.key_in[slot as usize].take();
            assert!(self.slot_of.remove(&left.expect("an occupied slot was given up")).is_some());
        }
        let slot = self.key_in.iter().position(Option::is_none).unwrap();
        self.key_in[slot] = Some(key);
        self.slot_of.insert(key, slot as u32);
        self.policy.insert(slot as u32, PageKey(key), 1);
        (true, left)
    }

    fn misses(&mut self, trace: impl IntoIterator<Item = u64>) -> u64 {
        trace.into_iter().map(|key| u64::from(self.ask(key).0)).sum()
    }
}

#[derive(Debug, Clone)]
enum Step {
    Ask(u64),
    /// The n-th resident page is removed by its owner.
    Remove(usize),
    Frame,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    // Half the requests go to a few pages, so that hits, second hits and returning ghosts are all common.
    let step = prop_oneof![
        20 => (0u64..40).prop_map(Step::Ask),
        20 => (0u64..8).prop_map(Step::Ask),
        1 => (0usize..32).prop_map(Step::Remove),
        2 => Just(Step::Frame),
    ];
    prop::collection::vec(step, 1..400)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn every_policy_gives_up_what_its_naive_model_does(capacity in 1usize..24, steps in steps()) {
        for kind in PolicyKind::ALL {
            let (mut pool, mut model) = (Pool::new(kind, capacity), model(kind, capacity));
            for step in &steps {
                match step {
                    Step::Ask(key) => {
                        let full = pool.is_full();
                        let (missed, left) = pool.ask(*key);
                        let expected = if missed { model.miss(*key, full) } else { model.hit(*key); None };
                        prop_assert_eq!(left, expected, "{} at capacity {}, page {}", kind, capacity, key);
                    }
                    Step::Remove(nth) => {
                        let mut resident: Vec<u64> = pool.slot_of.keys().copied().collect();
                        resident.sort_unstable();
                        if let Some(&key) = resident.get(*nth) {
                            let slot = pool.slot_of.remove(&key).unwrap();
                            pool.key_in[slot as usize] = None;
                            pool.policy.remove(slot);
                            model.forget(key);
                        }
                    }
                    Step::Frame => {
                        pool.policy.begin_frame();
                        model.begin_frame();
                    }
                }
            }
            // Everything resident can be given up, each once.
            for _ in 0..pool.slot_of.len() {
                let slot = pool.policy.evict().unwrap();
                prop_assert!(pool.key_in[slot as usize].take().is_some());
            }
            prop_assert_eq!(pool.policy.evict(), None);
        }
    }
}

/// Fewest misses possible (L. Belady 1966): what is needed last, or never again, leaves.
fn belady(trace: &[u64], capacity: usize) -> u64 {
    let mut resident: Vec<u64> = Vec::new();
    let mut misses = 0;
    for (now, key) in trace.iter().enumerate() {
        if resident.contains(key) {
            continue;
        }
        misses += 1;
        if resident.len() == capacity {
            let next = |key: &u64| trace[now..].iter().position(|k| k == key).unwrap_or(usize::MAX);
            let farthest = (0..capacity).max_by_key(|&at| next(&resident[at])).unwrap();
            resident.swap_remove(farthest);
        }
        resident.push(*key);
    }
    misses
}

/// Each of 120 pages once a frame, in one order, with room for 63: plain LRU misses every time.
#[test]
fn frame_lru_keeps_what_the_next_frame_needs_first() {
    let (pages, capacity, frames) = (120u64, 63, 12);
    let trace: Vec<u64> = (0..frames).flat_map(|_| 0..pages).collect();
    let lru = Pool::new(PolicyKind::Lru, capacity).misses(trace.iter().copied());
    let mut pool = Pool::new(PolicyKind::FrameLru, capacity);
    let frame_lru: u64 = (0..frames)
        .map(|_| {
            pool.policy.begin_frame();
            pool.misses(0..pages)
        })
        .sum();
    let best = belady(&trace, capacity);
    assert_eq!(lru, frames * pages);
    assert!(frame_lru as f64 <= 1.05 * best as f64, "{frame_lru} misses, Belady {best}");
    assert!(frame_lru as f64 <= 0.6 * lru as f64, "{frame_lru} misses, LRU {lru}");
}

/// Just below, at and above capacity.
#[test]
fn cyclic_scans_around_the_capacity_never_stop_a_policy() {
    for kind in PolicyKind::ALL {
        for pages in [15, 16, 17] {
            let mut pool = Pool::new(kind, 16);
            let misses: u64 = (0..10)
                .map(|_| {
                    pool.policy.begin_frame();
                    pool.misses(0..pages)
                })
                .sum();
            let best = belady(&(0..10).flat_map(|_| 0..pages).collect::<Vec<_>>(), 16);
            assert!(misses >= best && misses <= 10 * pages, "{kind}: {misses} for {pages} pages");
            if pages <= 16 {
                assert_eq!(misses, pages, "{kind} gives up pages although all fit");
            }
        }
    }
}

#[test]
fn a_policy_is_found_by_its_name_only() {
    for kind in PolicyKind::ALL {
        assert_eq!(kind.to_string().parse(), Ok(kind));
    }
    for wrong in ["", "LRU", "s3fifo", "lru "] {
        assert_eq!(wrong.parse::<PolicyKind>(), Err(UnknownPolicy(wrong.into())));
    }
}
