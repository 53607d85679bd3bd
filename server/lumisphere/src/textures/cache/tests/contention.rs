//! Many threads, and disks that make them wait.

use std::time::Duration;

use super::*;

fn sixteen() -> Published {
    published(Codec::DEFAULT, &[shape(4, 40); 16])
}

fn page_bytes() -> u64 {
    shape(4, 40).resident_bytes() as u64
}

fn check(page: &Page, number_of_page: u32) {
    for (x, y) in [(0, 0), (3, 39), (1, 20)] {
        assert_eq!(page.texel(x, y)[0], number(number_of_page, y, x, 0));
    }
}

#[test]
fn sixty_four_readers_of_one_cold_page_cause_one_read() {
    for by_texels in [false, true] {
        let published = sixteen();
        let cache = Arc::new(with_strategy(1 << 20, ReadStrategy::FullImage));
        // The header is known: a page is one read.
        cache.page(&published.version, PageId(0)).unwrap();
        cache.clear();
        let (reads, counted) = (published.disk.reads.load(Ordering::SeqCst), cache.stats().look_ups);
        // The read lasts until all others have come.
        let waiting = cache.clone();
        published.disk.on_read(move || {
            await_look_ups(&waiting, counted + 64);
            Ok(())
        });
        std::thread::scope(|scope| {
            for _ in 0..64 {
                scope.spawn(|| {
                    if by_texels {
                        assert_eq!(cache.reader(&published.version).texel(PageId(0), 1, 20).unwrap()[0], number(0, 20, 1, 0));
                    } else {
                        check(&cache.page(&published.version, PageId(0)).unwrap(), 0);
                    }
                });
            }
        });
        published.disk.let_go();
        let stats = cache.stats();
        assert_eq!(published.disk.reads.load(Ordering::SeqCst) - reads, 1);
        assert_eq!((stats.look_ups - counted, stats.hits, stats.misses, stats.coalesced_waits), (64, 0, 65, 63));
    }
}

/// Texels in even threads, whole pages in odd ones; all begin with one cold page, and one in four finds room.
#[test]
fn what_readers_and_pages_cost_adds_up_to_what_the_cache_counts() {
    let published = sixteen();
    let cache = Arc::new(with_strategy(4 * page_bytes(), ReadStrategy::FullImage));
    let waiting = cache.clone();
    published.disk.on_read(move || {
        await_look_ups(&waiting, 8);
        Ok(())
    });
    let told = Mutex::new(CacheStats::default());
    std::thread::scope(|scope| {
        for thread in 0..8u32 {
            let (cache, published, told) = (&cache, &published, &told);
            scope.spawn(move || {
                let mut reader = cache.reader(&published.version);
                for step in 0..300 {
                    let page = PageId(step * (thread + 1) % 16);
                    if thread.is_multiple_of(2) {
                        reader.bilinear(page, (1, step % 39), (1.0, 0.0)).unwrap();
                    } else {
                        let cost = cache.page_with_cost(&published.version, page).unwrap().1;
                        let hit = CacheStats { look_ups: 1, hits: 1, page_visits: 1, ..CacheStats::default() };
                        told.lock().unwrap().add_events(&cost.unwrap_or(hit));
                    }
                }
                told.lock().unwrap().add_events(&reader.counted());
            });
        }
    });
    published.disk.let_go();
    let (told, stats) = (told.into_inner().unwrap(), cache.stats());
    let mut counted = CacheStats::default();
    counted.add_events(&stats);
    assert_eq!(told, CacheStats { evictions: 0, ..counted });
    assert!(told.coalesced_waits >= 7 && told.wait_nanos > 0 && told.decode_nanos > 0 && told.rows_redundant > 0, "{told:?}");
}

#[test]
fn a_slow_read_delays_neither_hits_nor_other_reads() {
    let published = sixteen();
    let cache = lru(1 << 20);
    cache.page(&published.version, PageId(1)).unwrap();
    let (release, released) = mpsc::channel::<()>();
    let (begin, begun) = mpsc::channel::<()>();
    let (released, begin, is_first) = (Mutex::new(released), Mutex::new(begin), AtomicBool::new(true));
    published.disk.on_read(move || {
        if is_first.swap(false, Ordering::SeqCst) {
            begin.lock().unwrap().send(()).unwrap();
            released.lock().unwrap().recv().unwrap();
        }
        Ok(())
    });
    std::thread::scope(|scope| {
        let slow = scope.spawn(|| cache.page(&published.version, PageId(0)));
        // The slow read is at the disk: none of those below can be taken for it.
        begun.recv().unwrap();
        // Were any of these blocked, the slow read would never be released and this test would hang.
        check(&cache.page(&published.version, PageId(1)).unwrap(), 1);
        assert_eq!(cache.reader(&published.version).texel(PageId(1), 1, 20).unwrap()[0], number(1, 20, 1, 0));
        check(&cache.page(&published.version, PageId(2)).unwrap(), 2);
        cache.clear();
        cache.set_budget(page_bytes());
        release.send(()).unwrap();
        check(&slow.join().unwrap().unwrap(), 0);
    });
    assert_consistent(&cache.stats());
    assert_eq!(cache.stats().resident_pages, 1);
}

#[test]
fn a_failed_read_fails_all_who_waited_and_is_tried_again_next_time() {
    let published = sixteen();
    let cache = Arc::new(lru(1 << 20));
    let waiting = cache.clone();
    published.disk.on_read(move || {
        await_look_ups(&waiting, 8);
        Err(io::Error::other("this read is meant to fail"))
    });
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| assert!(matches!(cache.page(&published.version, PageId(0)), Err(StoreError::Io { .. }))));
        }
    });
    published.disk.let_go();
    check(&cache.page(&published.version, PageId(0)).unwrap(), 0);
    let stats = cache.stats();
    assert_eq!((stats.failed_reads, stats.misses, stats.coalesced_waits, stats.resident_pages), (1, 9, 7, 1));
}

#[test]
fn a_read_that_panics_leaves_the_page_to_those_who_waited() {
    let published = sixteen();
    let cache = Arc::new(lru(1 << 20));
    let (waiting, is_first) = (cache.clone(), AtomicBool::new(true));
    published.disk.on_read(move || {
        if is_first.swap(false, Ordering::SeqCst) {
            await_look_ups(&waiting, 3);
            panic!("this read is meant to panic");
        }
        Ok(())
    });
    std::thread::scope(|scope| {
        let lost = scope.spawn(|| cache.page(&published.version, PageId(0)));
        await_look_ups(&cache, 1);
        let waiters: Vec<_> = (0..2).map(|_| scope.spawn(|| cache.page(&published.version, PageId(0)))).collect();
        for waiter in waiters {
            check(&waiter.join().unwrap().unwrap(), 0);
        }
        assert!(lost.join().is_err());
    });
    let stats = cache.stats();
    assert_eq!((stats.look_ups, stats.hits + stats.misses, stats.resident_pages), (3, 3, 1));
}

/// Room for about four of sixteen pages; pages and texels, every strategy and policy, clearing and budgets, all at once.
#[test]
fn no_texel_is_torn_and_no_count_is_lost_while_everything_changes() {
    let published = sixteen();
    let cache = Cache::new(CacheOptions { compressed_bytes: 4000, ..CacheOptions::decoded(4 * page_bytes()) });
    let start = Barrier::new(8);
    let rounds = 3000u32;
    std::thread::scope(|scope| {
        for thread in 0..8u32 {
            let (cache, start, published) = (&cache, &start, &published);
            scope.spawn(move || {
                start.wait();
                let mut reader = cache.reader(&published.version);
                for step in 0..rounds {
                    let page = (step * (thread + 3) + thread) % 16;
                    if thread.is_multiple_of(2) {
                        let (x, y) = (step % 3, (step * 7) % 39);
                        let got = reader.bilinear(PageId(page), (x, y), (1.0, 0.0)).unwrap();
                        assert_eq!(got[0], number(page, y, x + 1, 0));
                    } else {
                        check(&cache.page(&published.version, PageId(page)).unwrap(), page);
                    }
                    change(cache, thread, step);
                    if step.is_multiple_of(16) {
                        assert_consistent(&cache.stats());
                    }
                }
            });
        }
    });
    let stats = cache.stats();
    assert_consistent(&stats);
    assert_eq!(stats.look_ups, 8 * u64::from(rounds));
    cache.clear();
    assert_eq!((cache.stats().resident_bytes, cache.stats().resident_pages), (0, 0));
}

fn change(cache: &Cache, thread: u32, step: u32) {
    let turn = (step / 500 + thread) as usize;
    match (thread, step % 500) {
        (1, 499) => cache.clear(),
        (2, 250) => cache.set_strategy(None, ReadStrategy::ALL[turn % 5]),
        (3, 100) => cache.set_policy(PolicyKind::ALL[turn % PolicyKind::ALL.len()]),
        (4, 400) => cache.set_budget(page_bytes() * (turn as u64 % 4 + 2)),
        (5, 300) => cache.begin_frame(),
        (6, 200) => cache.set_compressed_budget(1000 * (turn as u64 % 4)),
        _ => {}
    }
}

/// Readers only: while no page has to give way, reads = misses − waits, and every page was read once.
#[test]
fn without_evictions_every_page_is_read_once_however_many_ask() {
    let published = sixteen();
    let cache = with_strategy(1 << 20, ReadStrategy::FullImage);
    std::thread::scope(|scope| {
        for thread in 0..8u32 {
            let (cache, published) = (&cache, &published);
            scope.spawn(move || {
                let mut reader = cache.reader(&published.version);
                for step in 0..500 {
                    let page = (step + thread) % 16;
                    assert_eq!(reader.texel(PageId(page), 2, 39).unwrap()[0], number(page, 39, 2, 0));
                }
            });
        }
    });
    let stats = cache.stats();
    assert_eq!((stats.look_ups, stats.texel_fetches, stats.misses - stats.coalesced_waits), (4000, 4000, 16));
    assert_eq!((stats.rows_decoded, stats.rows_redundant, stats.resident_pages), (16 * 40, 0, 16));
    assert_eq!(stats.misses, stats.texel_misses);
}

/// Pages 0 to 7 whole; texels of these and of others, which a reader remembers, and which it has to look up.
fn ask(cache: &Cache, version: &Arc<DatasetVersion>, rounds: u32) {
    let mut reader = cache.reader(version);
    for step in 0..rounds {
        let page = step % 16;
        check(&cache.page(version, PageId(page % 8)).unwrap(), page % 8);
        assert_eq!(reader.texel(PageId(page), 2, 39).unwrap()[0], number(page, 39, 2, 0));
        assert_eq!(reader.bilinear(PageId(page), (1, 20), (1.0, 0.0)).unwrap()[0], number(page, 20, 2, 0));
        assert_eq!(cache.reader(version).texel(PageId(page), 1, 5).unwrap()[0], number(page, 5, 1, 0));
    }
}

#[test]
fn hits_take_no_lock_that_all_threads_share() {
    let published = sixteen();
    for strategy in [ReadStrategy::Block, ReadStrategy::FullImage] {
        let cache = Arc::new(with_strategy(1 << 20, strategy));
        // From here on all is a hit; pages 8 to 15 are there as the strategy reads them.
        ask(&cache, &published.version, 16);
        let before = cache.stats();
        let held = (cache.residency(), cache.strategies(), cache.recorder(), cache.compressed.held());
        let (finish, finished) = mpsc::channel();
        let (theirs, version) = (cache.clone(), published.version.clone());
        let thread = std::thread::spawn(move || {
            ask(&theirs, &version, 3000);
            finish.send(()).unwrap();
        });
        // They take milliseconds. Who waits for a lock waits until the end of this test.
        finished.recv_timeout(Duration::from_secs(20)).expect("a hit failed, or waits for a lock that this thread holds");
        drop(held);
        thread.join().unwrap();
        let stats = cache.stats();
        assert_eq!((stats.hits - before.hits, stats.misses - before.misses), (4 * 3000, 0));
    }
}
