//! Whole pages, one thread.

use super::*;

/// Twenty-four pages, page p being p + 1 numbers wide.
fn growing() -> &'static Published {
    static PUBLISHED: OnceLock<Published> = OnceLock::new();
    PUBLISHED.get_or_init(|| published(Codec::DEFAULT, &(1..=24).map(|width| shape(width, 1)).collect::<Vec<_>>()))
}

fn bytes(page: u32) -> u64 {
    shape(page + 1, 1).resident_bytes() as u64
}

/// Asks for a page and says whether it had to be read.
fn ask(cache: &Cache, page: u32) -> bool {
    let (got, cost) = cache.page_with_cost(&growing().version, PageId(page)).unwrap();
    assert_eq!(got.texel(page, 0)[0], number(page, 0, page, 0));
    cost.is_some()
}

/// Least recently used, written as plainly as possible: newest at the front.
struct Model {
    pages: VecDeque<u32>,
    budget: u64,
}

impl Model {
    fn resident(&self) -> u64 {
        self.pages.iter().map(|&p| bytes(p)).sum()
    }

    fn shrink(&mut self, room: u64) {
        while self.resident() > room {
            self.pages.pop_back();
        }
    }

    fn ask(&mut self, number: u32) -> bool {
        if let Some(at) = self.pages.iter().position(|&p| p == number) {
            self.pages.remove(at);
            self.pages.push_front(number);
            return false;
        }
        if bytes(number) <= self.budget {
            self.shrink(self.budget - bytes(number));
            self.pages.push_front(number);
        }
        true
    }
}

#[derive(Debug, Clone)]
enum Step {
    Ask(u32),
    Budget(u64),
    Clear,
    Policy(PolicyKind),
}

fn steps(policies: Vec<PolicyKind>) -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        40 => (0u32..24).prop_map(Step::Ask),
        2 => (0u64..1200).prop_map(Step::Budget),
        1 => Just(Step::Clear),
        1 => prop::sample::select(policies).prop_map(Step::Policy),
    ];
    prop::collection::vec(step, 1..300)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn every_hit_miss_and_eviction_is_the_naive_models(budget in 0u64..1200, steps in steps(vec![PolicyKind::Lru])) {
        let cache = lru(budget);
        let mut model = Model { pages: VecDeque::new(), budget };
        for step in steps {
            match step {
                Step::Ask(number) => prop_assert_eq!(ask(&cache, number), model.ask(number), "page {}", number),
                Step::Budget(budget) => {
                    cache.set_budget(budget);
                    model.budget = budget;
                    model.shrink(budget);
                }
                Step::Clear => {
                    cache.clear();
                    model.pages.clear();
                }
                // From lru to lru: the order is handed over whole.
                Step::Policy(kind) => cache.set_policy(kind),
            }
            let stats = cache.stats();
            prop_assert_eq!(stats.resident_bytes, model.resident());
            prop_assert_eq!(stats.resident_pages, model.pages.len() as u64);
            assert_consistent(&stats);
            prop_assert_eq!(stats.misses, stats.evictions + stats.uncached + stats.resident_pages);
        }
    }

    /// Whatever the policy and whenever it changes.
    #[test]
    fn the_budget_holds_and_the_counters_add_up_under_every_policy(budget in 0u64..1200, steps in steps(PolicyKind::ALL.to_vec())) {
        let cache = lru(budget);
        for step in steps {
            match step {
                Step::Ask(number) => { ask(&cache, number); }
                Step::Budget(budget) => cache.set_budget(budget),
                Step::Clear => cache.clear(),
                Step::Policy(kind) => cache.set_policy(kind),
            }
            cache.begin_frame();
            let stats = cache.stats();
            assert_consistent(&stats);
            prop_assert_eq!(stats.misses, stats.evictions + stats.uncached + stats.resident_pages);
        }
        cache.clear();
        prop_assert_eq!(cache.stats().resident_bytes, 0);
    }
}

#[test]
fn a_page_larger_than_the_budget_is_handed_out_and_not_kept() {
    let cache = lru(bytes(3));
    assert!(ask(&cache, 3));
    assert!(ask(&cache, 4));
    assert!(ask(&cache, 4));
    // The large page pushed nothing out.
    assert!(!ask(&cache, 3));
    let stats = cache.stats();
    assert_eq!((stats.uncached, stats.evictions, stats.resident_bytes, stats.peak_bytes), (2, 0, bytes(3), bytes(3)));
}

#[test]
fn a_page_brought_ahead_is_a_hit_and_no_look_up() {
    let cache = lru(1 << 20);
    assert!(cache.prefetch(&growing().version, PageId(5)).unwrap().1);
    assert!(!cache.prefetch(&growing().version, PageId(5)).unwrap().1);
    assert!(cache.prefetch(&growing().version, PageId(99)).is_err());
    let stats = cache.stats();
    assert_eq!((stats.prefetches, stats.look_ups, stats.resident_pages), (1, 0, 1));
    assert!(!ask(&cache, 5));
}

#[test]
fn versions_do_not_share_pages_and_are_counted_apart() {
    // Versions are told in the order in which they were published.
    growing();
    let other = published(Codec::DEFAULT, &[shape(1, 1), shape(2, 1)]);
    let cache = lru(1 << 20);
    ask(&cache, 1);
    ask(&cache, 1);
    let got = cache.page(&other.version, PageId(1)).unwrap();
    assert_eq!(got.shape().width, 2);
    let snapshot = cache.snapshot();
    let misses: Vec<_> = snapshot.versions.iter().map(|v| (v.decoded.look_ups, v.decoded.misses, v.decoded.resident_pages)).collect();
    assert_eq!(misses, [(2, 1, 1), (1, 1, 1)]);
    assert_eq!((snapshot.decoded.look_ups, snapshot.decoded.misses, snapshot.decoded.resident_pages), (3, 2, 2));
}

#[test]
fn peaks_are_kept_apart_until_they_are_forgotten() {
    // Versions are told in the order in which they were published.
    growing();
    let other = published(Codec::DEFAULT, &[shape(1, 1), shape(2, 1)]);
    // Room for the largest page, or for two small ones.
    let cache = lru(bytes(23));
    let peaks = || {
        let snapshot = cache.snapshot();
        assert_eq!(snapshot.decoded, cache.stats());
        (snapshot.versions.iter().map(|v| v.decoded.peak_bytes).collect::<Vec<_>>(), snapshot.decoded.peak_bytes)
    };
    ask(&cache, 23);
    cache.page(&other.version, PageId(0)).unwrap();
    cache.page(&other.version, PageId(1)).unwrap();
    ask(&cache, 0);
    // The largest page has left for the others, the first of these for the last.
    assert_eq!(peaks(), (vec![bytes(23), bytes(0) + bytes(1)], bytes(23)));
    let evictions: Vec<_> = cache.snapshot().versions.iter().map(|v| v.decoded.evictions).collect();
    assert_eq!(evictions, [1, 1]);
    let held = (vec![bytes(0), bytes(1)], bytes(0) + bytes(1));
    cache.forget_peaks();
    assert_eq!(peaks(), held);
    cache.clear();
    cache.set_budget(0);
    assert_eq!(peaks(), held);
}
