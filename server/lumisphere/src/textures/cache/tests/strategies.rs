//! Texels through readers: right under every strategy, codec and size; counted as the paper counts.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;

const ROWS: u32 = 64;
const WIDTH: u32 = 8;
const PAGES: u32 = 12;

fn twelve(codec: Codec) -> &'static Published {
    static PUBLISHED: [OnceLock<Published>; Codec::ALL.len()] = [const { OnceLock::new() }; Codec::ALL.len()];
    PUBLISHED[codec as usize - 1].get_or_init(|| published(codec, &[shape(WIDTH, ROWS); PAGES as usize]))
}

fn page_bytes() -> u64 {
    shape(WIDTH, ROWS).resident_bytes() as u64
}

/// Look-ups as rendering makes them: three pages in turn, each from row to row, now and then elsewhere.
fn look_ups(seed: u64, count: usize) -> Vec<(PageId, u32, u32)> {
    let mut rng = Pcg32::seed_from_u64(seed);
    let mut at: [(u32, u32, u32); 3] = std::array::from_fn(|k| (k as u32, 0, 0));
    (0..count)
        .map(|k| {
            let at = &mut at[k % 3];
            if rng.random_range(0..12u32) == 0 {
                at.0 = rng.random_range(0..PAGES);
            }
            if rng.random_range(0..6u32) == 0 {
                at.2 = rng.random_range(0..ROWS - 1);
            }
            at.1 = (at.1 + 1) % (WIDTH - 1);
            at.2 = (at.2 + rng.random_range(0..3u32)).min(ROWS - 2);
            (PageId(at.0), at.1, at.2)
        })
        .collect()
}

fn read_all(cache: &Cache, version: &Arc<DatasetVersion>, look_ups: &[(PageId, u32, u32)]) -> CacheStats {
    let mut reader = cache.reader(version);
    for &(page, x, y) in look_ups {
        let got = reader.bilinear(page, (x, y), (0.0, 1.0)).unwrap();
        assert_eq!(got[0], number(page.0, y + 1, x, 0), "page {page}, column {x}, row {y}");
    }
    drop(reader);
    let stats = cache.stats();
    assert_consistent(&stats);
    assert_eq!((stats.look_ups, stats.texel_fetches), (look_ups.len() as u64, 4 * look_ups.len() as u64));
    stats
}

/// The stack of pages does not depend on the strategy, and what is decoded on demand is a part of what half threshold decodes, which
/// is a part of the full image.
#[test]
fn misses_on_demand_are_no_fewer_than_at_half_threshold_and_those_no_fewer_than_of_full_images() {
    for codec in Codec::ALL {
        let version = &twelve(codec).version;
        let mut differed = false;
        for pages in 1..=PAGES as u64 {
            for seed in 0..4 {
                let look_ups = look_ups(seed, 400);
                let misses = [ReadStrategy::OnDemandRestart, ReadStrategy::OnDemand, ReadStrategy::HalfThreshold, ReadStrategy::FullImage]
                    .map(|strategy| read_all(&with_strategy(pages * page_bytes(), strategy), version, &look_ups).texel_misses);
                assert_eq!(misses[0], misses[1], "to begin again decodes more, and misses as often");
                assert!(misses[1] >= misses[2] && misses[2] >= misses[3], "{codec}, {pages} pages: {misses:?}");
                differed |= misses[1] > misses[2] && misses[2] > misses[3];
            }
        }
        assert!(differed, "{codec}: a trace on which the strategies are alike proves nothing");
    }
}

/// The paper's cache, as plainly as can be: pages newest first, with the rows that each has.
fn naive_misses(strategy: ReadStrategy, codec: Codec, capacity: usize, look_ups: &[(PageId, u32, u32)]) -> u64 {
    let mut pages: VecDeque<(PageId, u32)> = VecDeque::new();
    let mut misses = 0;
    for &(page, _, y) in look_ups {
        for row in [y, y, y + 1, y + 1] {
            let had = pages.iter().position(|(p, _)| *p == page).map(|at| pages.remove(at).unwrap().1).unwrap_or(0);
            let mut has = had;
            if row >= had {
                misses += 1;
                let step = codec.step_rows();
                let up_to_row = (row / step + 1) * step;
                has = match strategy {
                    ReadStrategy::OnDemand | ReadStrategy::OnDemandRestart => up_to_row,
                    ReadStrategy::HalfThreshold if 2 * row < ROWS => up_to_row,
                    _ => ROWS,
                };
            }
            pages.push_front((page, has));
            pages.truncate(capacity);
        }
    }
    misses
}

#[test]
fn texel_misses_are_the_naive_models_at_every_size() {
    for codec in Codec::ALL {
        for strategy in [ReadStrategy::OnDemand, ReadStrategy::OnDemandRestart, ReadStrategy::HalfThreshold, ReadStrategy::FullImage] {
            for pages in 1..=PAGES as u64 + 1 {
                let look_ups = look_ups(pages, 300);
                let stats = read_all(&with_strategy(pages * page_bytes(), strategy), &twelve(codec).version, &look_ups);
                assert_eq!(
                    stats.texel_misses,
                    naive_misses(strategy, codec, pages as usize, &look_ups),
                    "{codec}, {strategy}, {pages} pages"
                );
            }
        }
    }
}

/// Blocks are cached on their own: least recently used among blocks, not pages.
#[test]
fn blocks_take_their_own_bytes_and_leave_on_their_own() {
    let block_bytes = shape(WIDTH, BLOCK_ROWS).resident_bytes() as u64;
    for codec in Codec::ALL {
        for blocks in [1, 2, 3, 5, 8, 13, 48] {
            let look_ups = look_ups(blocks, 300);
            let stats = read_all(&with_strategy(blocks * block_bytes, ReadStrategy::Block), &twelve(codec).version, &look_ups);
            let mut newest: VecDeque<(PageId, u32)> = VecDeque::new();
            let mut misses = 0;
            for &(page, _, y) in &look_ups {
                for row in [y, y, y + 1, y + 1] {
                    let block = (page, row / BLOCK_ROWS);
                    match newest.iter().position(|b| *b == block) {
                        Some(at) => drop(newest.remove(at)),
                        None => misses += 1,
                    }
                    newest.push_front(block);
                    newest.truncate(blocks as usize);
                }
            }
            assert_eq!(stats.texel_misses, misses, "{codec}, {blocks} blocks");
        }
    }
}

/// A budget of one and a half pages, so that everything is evicted all the time, and everything changes between frames.
#[test]
fn strategy_policy_and_codec_switched_between_frames_change_no_texel() {
    let mut rng = Pcg32::seed_from_u64(7);
    let cache = Cache::new(CacheOptions { compressed_bytes: 3000, ..CacheOptions::decoded(page_bytes() * 3 / 2) });
    for frame in 0..200u64 {
        cache.begin_frame();
        cache.set_strategy(Some("d"), ReadStrategy::ALL[rng.random_range(0..5usize)]);
        cache.set_policy(PolicyKind::ALL[rng.random_range(0..PolicyKind::ALL.len())]);
        cache.set_compressed_policy(PolicyKind::ALL[rng.random_range(0..PolicyKind::ALL.len())]);
        let version = &twelve(Codec::ALL[rng.random_range(0..Codec::ALL.len())]).version;
        let mut reader = cache.reader(version);
        for (page, x, y) in look_ups(frame, 40) {
            let got = reader.texels([(page, x, y), (page, x + 1, y + 1)]).unwrap();
            assert_eq!([got[0][0], got[1][0]], [number(page.0, y, x, 0), number(page.0, y + 1, x + 1, 0)]);
            if rng.random_range(0..10u32) == 0 {
                let whole = cache.page(version, page).unwrap();
                assert_eq!(whole.texel(x, ROWS - 1)[0], number(page.0, ROWS - 1, x, 0));
            }
        }
        drop(reader);
        let snapshot = cache.snapshot();
        assert_consistent(&snapshot.decoded);
        let compressed = snapshot.compressed;
        assert_eq!(compressed.look_ups, compressed.hits + compressed.misses);
        assert!(compressed.resident_bytes <= compressed.budget_bytes);
    }
}

#[test]
fn a_whole_page_takes_the_place_of_its_blocks() {
    let cache = lru(1 << 20);
    let version = &twelve(Codec::DEFAULT).version;
    let mut reader = cache.reader(version);
    for y in [0, 20, 40] {
        reader.texel(PageId(3), 0, y).unwrap();
    }
    assert_eq!(cache.stats().resident_pages, 3);
    cache.page(version, PageId(3)).unwrap();
    assert_eq!((cache.stats().resident_pages, cache.stats().resident_bytes), (1, page_bytes()));
    assert_eq!(reader.texel(PageId(3), 1, 63).unwrap()[0], number(3, 63, 1, 0));
    drop(reader);
    assert_eq!(cache.stats().misses, 4);
}

#[test]
fn rows_decoded_again_are_redundant_and_the_others_are_not() {
    let version = &twelve(Codec::DEFAULT).version;
    let cases = [(ReadStrategy::OnDemand, 64, 0), (ReadStrategy::OnDemandRestart, 16 + 32 + 48 + 64, 96), (ReadStrategy::FullImage, 64, 0)];
    for (strategy, decoded, redundant) in cases {
        let cache = with_strategy(1 << 20, strategy);
        for y in [0, 16, 32, 48] {
            cache.reader(version).texel(PageId(1), 0, y).unwrap();
        }
        let stats = cache.stats();
        assert_eq!((stats.rows_decoded, stats.rows_redundant), (decoded, redundant), "{strategy}");
        assert_eq!(stats.bytes_redundant, redundant * u64::from(WIDTH) * 4);
        // Cleared, everything is redundant.
        cache.clear();
        cache.page(version, PageId(1)).unwrap();
        assert_eq!(cache.stats().rows_redundant, redundant + 64);
    }
}

/// Rows that each visit of a page from top to bottom decodes: a sequential codec goes on where its decoder was kept, which is while it fits into what the
/// page has yet to take of the budget; restarting it decodes everything above, too.
#[test]
fn a_sequential_codec_goes_on_while_its_decoder_fits() {
    let tall = shape(1024, 300);
    for codec in [Codec::LzwSeq, Codec::ZstdSeq] {
        let published = published(codec, &[tall; 2]);
        let visits = [3, 20, 60, 61, 130, 299];
        for strategy in [ReadStrategy::OnDemand, ReadStrategy::OnDemandRestart] {
            let cache = with_strategy(8 << 20, strategy);
            let (mut had, mut expected, mut resumed) = (0, 0, 0);
            for y in visits {
                assert_eq!(cache.reader(&published.version).texel(PageId(1), 7, y).unwrap()[0], number(1, y, 7, 0), "{codec}, row {y}");
                let end = strategy.rows_wanted(codec, &tall, y).end;
                if end > had {
                    let goes_on = had > 0 && strategy == ReadStrategy::OnDemand && codec.decoder_fits(&tall, had);
                    resumed += u32::from(goes_on);
                    expected += if goes_on { end - had } else { end };
                    had = end;
                }
            }
            assert_eq!(cache.stats().rows_decoded, u64::from(expected), "{codec}, {strategy}");
            assert_eq!(resumed >= 2, strategy == ReadStrategy::OnDemand, "{codec}, {strategy}: {resumed}");
            // All of it is right, whatever was decoded in which go.
            let whole = cache.page(&published.version, PageId(1)).unwrap();
            for (y, x) in (0..300).flat_map(|y| (0..1024).step_by(97).map(move |x| (y, x))) {
                assert_eq!(whole.texel(x, y)[0], number(1, y, x, 0), "{codec}, {strategy}: row {y}, column {x}");
            }
        }
    }
}

#[test]
fn compressed_blocks_in_memory_save_the_disk_and_are_counted() {
    let published = published(Codec::DEFAULT, &[shape(WIDTH, ROWS); 4]);
    let cache = Cache::new(CacheOptions { compressed_bytes: 1 << 20, ..CacheOptions::decoded(1 << 20) });
    for _ in 0..3 {
        for page in 0..4 {
            assert_eq!(cache.page(&published.version, PageId(page)).unwrap().texel(1, 50)[0], number(page, 50, 1, 0));
        }
        cache.told_residency().clear();
    }
    let (reads, snapshot) = (published.disk.reads.load(Ordering::SeqCst), cache.snapshot());
    assert_eq!((snapshot.compressed.look_ups, snapshot.compressed.hits, snapshot.compressed.misses), (48, 32, 16));
    assert_eq!((snapshot.decoded.blocks_read, snapshot.decoded.misses), (16, 12));
    // A smaller budget gives up at once; none at all turns the tier off.
    cache.set_compressed_budget(snapshot.compressed.resident_bytes / 2);
    let halved = cache.snapshot().compressed;
    assert!(halved.resident_bytes <= halved.budget_bytes && halved.resident_blocks > 0 && halved.evictions > 0);
    cache.set_compressed_budget(0);
    cache.page(&published.version, PageId(0)).unwrap();
    assert_eq!(cache.snapshot().compressed.look_ups, 48);
    assert!(published.disk.reads.load(Ordering::SeqCst) > reads);
}

/// Under the strategy that wants the whole image, too.
#[test]
fn a_damaged_block_costs_its_own_rows_only_under_every_strategy_and_is_not_remembered() {
    for (strategy, compressed_bytes) in ReadStrategy::ALL.into_iter().zip([0, 1 << 20, 0, 1 << 20, 0]) {
        let published = published(Codec::DEFAULT, &[shape(WIDTH, ROWS); 2]);
        let segments = published.root.path().join("segments");
        let path = std::fs::read_dir(segments).unwrap().next().unwrap().unwrap().path();
        let intact = std::fs::read(&path).unwrap();
        let header = published.version.page_header(PageId(0)).unwrap().0;
        let mut bytes = intact.clone();
        bytes[header.bytes() + header.blocks[1].offset as usize + 3] ^= 0x20;
        std::fs::write(&path, &bytes).unwrap();
        let cache = Cache::new(CacheOptions { strategy, compressed_bytes, ..CacheOptions::decoded(1 << 20) });
        let mut reader = cache.reader(&published.version);
        for y in 0..ROWS {
            match reader.texel(PageId(0), 2, y) {
                Ok(texel) => assert_eq!((texel[0], (16..32).contains(&y)), (number(0, y, 2, 0), false)),
                Err(StoreError::DamagedPage { page, rows, .. }) => {
                    assert_eq!((page, rows, (16..32).contains(&y)), (PageId(0), 16..32, true))
                }
                Err(other) => panic!("{other}"),
            }
        }
        assert_eq!(reader.texel(PageId(1), 2, 20).unwrap()[0], number(1, 20, 2, 0));
        // Healed, it is served.
        std::fs::write(&path, &intact).unwrap();
        assert_eq!(reader.texel(PageId(0), 2, 20).unwrap()[0], number(0, 20, 2, 0));
        drop(reader);
        assert_consistent(&cache.stats());
    }
}

#[test]
fn rows_and_pages_that_are_not_there_are_errors() {
    for strategy in ReadStrategy::ALL {
        let cache = with_strategy(1 << 20, strategy);
        let mut reader = cache.reader(&twelve(Codec::ZstdSeq).version);
        for (page, y) in [(0, ROWS), (0, u32::MAX), (PAGES, 0), (u32::MAX, 0)] {
            assert!(matches!(reader.texel(PageId(page), 0, y), Err(StoreError::NotFound { .. })), "{strategy}: page {page}, row {y}");
        }
        reader.texel(PageId(0), 0, ROWS - 1).unwrap();
        drop(reader);
        assert_consistent(&cache.stats());
        assert_eq!(cache.stats().misses, 5, "the four errors and the one read");
    }
}

#[test]
fn a_recording_has_every_request_in_order() {
    let published = twelve(Codec::DEFAULT);
    let cache = lru(1 << 20);
    cache.page(&published.version, PageId(9)).unwrap();
    cache.start_recording(1 << 20);
    cache.begin_frame();
    let mut reader = cache.reader(&published.version);
    reader.texels([(PageId(4), 0, 7), (PageId(4), 1, 7), (PageId(4), 0, 8), (PageId(5), 0, 7)]).unwrap();
    reader.bilinear(PageId(5), (0, 7), (0.5, 0.5)).unwrap();
    drop(reader);
    cache.page(&published.version, PageId(2)).unwrap();
    let trace = cache.stop_recording().unwrap();
    let row = |page, row, fetches| TraceEvent::Row { version: 0, page: PageId(page), row, fetches };
    let expected =
        [TraceEvent::Frame, row(4, 7, 2), row(4, 8, 1), row(5, 7, 3), row(5, 8, 2), TraceEvent::Page { version: 0, page: PageId(2) }];
    assert_eq!(trace.events, expected);
    assert_eq!((trace.versions[0].page_count, trace.versions[0].shape), (PAGES, shape(WIDTH, ROWS)));
    assert_eq!(Trace::from_bytes(&trace.to_bytes()), Ok(trace));
    assert_eq!(cache.stop_recording(), None);
    // What does not fit is left out, and told.
    cache.start_recording(100);
    (0..20).for_each(|_| cache.begin_frame());
    let cut = cache.stop_recording().unwrap();
    assert!(cut.is_truncated && cut.events.len() < 20);
    drop(published.store.datasets());
}
