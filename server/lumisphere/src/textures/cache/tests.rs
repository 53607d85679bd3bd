//! The cache against a naive model, and under contention.

use std::collections::VecDeque;
use std::sync::Barrier;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;

use proptest::prelude::*;

use super::super::page::{PageShape, PixelFormat, Texels};
use super::*;

const COST: ReadCost = ReadCost { bytes_read: 10, bytes_decoded: 100, read_nanos: 1, decode_nanos: 2 };

/// A page of `width` numbers.
fn page(width: u32, value: f32) -> Page {
    let shape = PageShape { width, height: 1, channels: 1, pixel: PixelFormat::F32 };
    Page::new(shape, Texels::F32(vec![value; width as usize]))
}

fn key(page: u32) -> Key {
    Key { slot: 0, page: PageId(page) }
}

fn bytes(width: u32) -> u64 {
    page(width, 0.0).resident_bytes() as u64
}

/// Asks for a page that is `page + 1` wide and says whether it had to be read.
fn ask(cache: &Cache, number: u32) -> bool {
    let mut read = false;
    let got = cache
        .page_with(key(number), || {
            read = true;
            Ok((page(number + 1, number as f32), COST))
        })
        .unwrap();
    assert_eq!(got.0.texel(number, 0)[0], number as f32);
    read
}

/// Least recently used, written as plainly as possible: newest at the front.
struct Model {
    pages: VecDeque<u32>,
    budget: u64,
}

impl Model {
    fn resident(&self) -> u64 {
        self.pages.iter().map(|&p| bytes(p + 1)).sum()
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
        if bytes(number + 1) <= self.budget {
            self.shrink(self.budget - bytes(number + 1));
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
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        40 => (0u32..24).prop_map(Step::Ask),
        2 => (0u64..1200).prop_map(Step::Budget),
        1 => Just(Step::Clear),
    ];
    prop::collection::vec(step, 1..300)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn every_hit_miss_and_eviction_is_the_naive_models(budget in 0u64..1200, steps in steps()) {
        let cache = Cache::new(budget);
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
            }
            let stats = cache.stats();
            prop_assert_eq!(stats.resident_bytes, model.resident());
            prop_assert_eq!(stats.resident_pages, model.pages.len() as u64);
            prop_assert!(stats.resident_bytes <= stats.budget_bytes);
            prop_assert_eq!(stats.look_ups, stats.hits + stats.misses);
            prop_assert_eq!(stats.misses, stats.evictions + stats.uncached + stats.resident_pages);
            prop_assert_eq!(stats.bytes_read, 10 * stats.misses);
        }
    }
}

#[test]
fn a_page_larger_than_the_budget_is_handed_out_and_not_kept() {
    let cache = Cache::new(bytes(4));
    assert!(ask(&cache, 3));
    assert!(ask(&cache, 4));
    assert!(ask(&cache, 4));
    // The large page pushed nothing out.
    assert!(!ask(&cache, 3));
    let stats = cache.stats();
    assert_eq!((stats.uncached, stats.evictions, stats.resident_bytes, stats.peak_bytes), (2, 0, bytes(4), bytes(4)));
}

/// Blocks until `count` look-ups have been counted: the waiters are then past the table, at the flight.
fn await_look_ups(cache: &Cache, count: u64) {
    while cache.stats().look_ups < count {
        std::thread::yield_now();
    }
}

#[test]
fn sixty_four_readers_of_one_cold_page_cause_one_read() {
    let cache = Cache::new(1 << 20);
    let reads = AtomicU64::new(0);
    std::thread::scope(|scope| {
        for _ in 0..64 {
            scope.spawn(|| {
                let got = cache.page_with(key(0), || {
                    reads.fetch_add(1, Ordering::SeqCst);
                    // The read lasts until all others have come.
                    await_look_ups(&cache, 64);
                    Ok((page(1, 7.0), COST))
                });
                assert_eq!(got.unwrap().0.texel(0, 0)[0], 7.0);
            });
        }
    });
    let stats = cache.stats();
    assert_eq!(reads.into_inner(), 1);
    assert_eq!((stats.look_ups, stats.hits, stats.misses, stats.coalesced_waits), (64, 0, 64, 63));
}

#[test]
fn a_slow_read_delays_neither_hits_nor_other_reads() {
    let cache = Cache::new(1 << 20);
    ask(&cache, 1);
    let (release, released) = mpsc::channel::<()>();
    std::thread::scope(|scope| {
        let slow = scope.spawn(|| {
            cache.page_with(key(0), move || {
                released.recv().unwrap();
                Ok((page(1, 0.0), COST))
            })
        });
        await_look_ups(&cache, 2);
        // Were either blocked, the slow read would never be released and this test would hang.
        assert!(!ask(&cache, 1));
        assert!(ask(&cache, 2));
        release.send(()).unwrap();
        slow.join().unwrap().unwrap();
    });
}

#[test]
fn a_failed_read_fails_all_who_waited_and_is_tried_again_next_time() {
    let cache = Cache::new(1 << 20);
    let failures = AtomicU64::new(0);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                let got = cache.page_with(key(0), || {
                    await_look_ups(&cache, 8);
                    Err(StoreError::NotFound { what: "test".into() })
                });
                failures.fetch_add(u64::from(got.is_err()), Ordering::SeqCst);
            });
        }
    });
    assert_eq!(failures.into_inner(), 8);
    assert!(ask(&cache, 0));
    let stats = cache.stats();
    assert_eq!((stats.failed_reads, stats.misses, stats.coalesced_waits, stats.resident_pages), (1, 9, 7, 1));
}

#[test]
fn a_read_that_panics_leaves_the_page_to_those_who_waited() {
    let cache = Cache::new(1 << 20);
    std::thread::scope(|scope| {
        let lost = scope.spawn(|| {
            cache.page_with(key(0), || {
                await_look_ups(&cache, 3);
                panic!("this read is meant to panic")
            })
        });
        await_look_ups(&cache, 1);
        let waiters: Vec<_> = (0..2).map(|_| scope.spawn(|| cache.page_with(key(0), || Ok((page(1, 5.0), COST))))).collect();
        for waiter in waiters {
            assert_eq!(waiter.join().unwrap().unwrap().0.texel(0, 0)[0], 5.0);
        }
        assert!(lost.join().is_err());
    });
    let stats = cache.stats();
    assert_eq!((stats.look_ups, stats.hits + stats.misses, stats.resident_pages), (3, 3, 1));
}

#[test]
fn counters_add_up_and_the_budget_holds_under_contention() {
    // Room for about four of sixteen pages; every step of every thread is checked.
    let cache = Cache::new(4 * bytes(16));
    let start = Barrier::new(8);
    std::thread::scope(|scope| {
        for thread in 0..8u32 {
            let (cache, start) = (&cache, &start);
            scope.spawn(move || {
                start.wait();
                for step in 0..2000u32 {
                    ask(cache, (step * (thread + 3) + thread) % 16);
                    if step % 500 == 499 {
                        cache.clear();
                    }
                    let stats = cache.stats();
                    assert!(stats.resident_bytes <= stats.budget_bytes);
                    assert_eq!(stats.look_ups, stats.hits + stats.misses);
                }
            });
        }
    });
    let stats = cache.stats();
    assert_eq!(stats.look_ups, 16_000);
    let reads = stats.misses - stats.coalesced_waits;
    assert_eq!(stats.bytes_read, 10 * reads);
    assert_eq!(reads, stats.evictions + stats.resident_pages);
}

#[test]
fn versions_do_not_share_pages() {
    let cache = Cache::new(1 << 20);
    for slot in [0, 5, 2] {
        let got = cache.page_with(Key { slot, page: PageId(3) }, || Ok((page(1, slot as f32), COST))).unwrap();
        assert_eq!(got.0.texel(0, 0)[0], slot as f32);
    }
    assert_eq!(cache.stats().misses, 3);
}
