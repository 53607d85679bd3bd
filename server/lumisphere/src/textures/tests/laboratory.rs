//! The laboratory against the cache it stands for, against Belady written plainly, and trace files that lie.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use xxhash_rust::xxh3::xxh3_64;

use super::*;

const SHAPE: PageShape = PageShape { width: 4, height: 48, channels: 2, pixel: PixelFormat::F32 };
const PAGES: u32 = 10;

fn stored(root: &Path, codec: Codec) -> Arc<DatasetVersion> {
    let (store, _) = open(root);
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    for page in 0..PAGES {
        staging.append_encoded(PageId(page), &encode_as(codec, &SHAPE, &texels(&SHAPE, page)).unwrap()).unwrap();
    }
    staging.publish(publication()).unwrap()
}

/// Runs that wander through rows and jump between pages; frames in between, no row twice in a row.
fn trace(seed: u64, events: usize) -> Trace {
    let mut rng = Pcg32::seed_from_u64(seed);
    let (mut page, mut row) = (0, 0);
    let version = TracedVersion { dataset: "d".into(), version: 1, page_count: PAGES, shape: SHAPE };
    let events = (0..events).map(|at| {
        if at % 50 == 0 {
            return TraceEvent::Frame;
        }
        if rng.random_range(0..3u32) == 0 {
            page = rng.random_range(0..PAGES) * rng.random_range(0..PAGES) / PAGES;
        }
        row = (row + rng.random_range(1..9u32)) % SHAPE.height;
        TraceEvent::Row { version: 0, page: PageId(page), row, fetches: rng.random_range(1..5u32) }
    });
    Trace { versions: vec![version], events: events.collect(), is_truncated: false }
}

#[test]
fn what_the_laboratory_counts_is_what_the_cache_does() {
    for codec in Codec::ALL {
        let root = tempfile::tempdir().unwrap();
        let version = [stored(root.path(), codec)];
        for strategy in ReadStrategy::ALL {
            for (seed, policy) in (0..).zip(PolicyKind::ALL) {
                let trace = trace(seed, 400);
                for pages in [1, 2, 4, 7] {
                    let capacity_bytes = pages * SHAPE.resident_bytes() as u64;
                    let simulated = simulate(&trace, Setting { strategy, codec, order: Order::Policy(policy), capacity_bytes });
                    let options = CacheOptions { strategy, decoded_policy: policy, ..CacheOptions::decoded(capacity_bytes) };
                    let (real, nanos) = replay(&trace, &version, options, &|| false).unwrap().unwrap();
                    assert!(replay(&trace, &version, options, &|| true).unwrap().is_none());
                    let got = (real.decoded.texel_fetches, real.decoded.texel_misses, real.decoded.rows_decoded);
                    let expected = (simulated.texel_fetches, simulated.misses, simulated.rows_decoded);
                    assert_eq!(got, expected, "{codec}, {strategy}, {policy}, {pages} pages");
                    assert_eq!(real.decoded.bytes_decoded, simulated.bytes_decoded);
                    assert!(nanos > 0);
                }
            }
        }
    }
}

/// Loads of the best order, searched for plainly.
fn plain_optimum(trace: &Trace, capacity: usize) -> u64 {
    let mut visits: Vec<u32> =
        trace.events.iter().filter_map(|e| if let TraceEvent::Row { page, .. } = e { Some(page.0) } else { None }).collect();
    visits.dedup();
    let (mut resident, mut loads): (Vec<u32>, u64) = (vec![], 0);
    for (now, page) in visits.iter().enumerate() {
        if !resident.contains(page) {
            loads += 1;
            if resident.len() == capacity {
                let next = |page: u32| visits[now..].iter().position(|p| *p == page).unwrap_or(usize::MAX);
                let last = (0..capacity).max_by_key(|&at| next(resident[at])).unwrap();
                resident.swap_remove(last);
            }
            resident.push(*page);
        }
    }
    loads
}

#[test]
fn belady_is_the_optimum_and_no_policy_loads_less() {
    let sizes: Vec<u64> = (1..=PAGES as u64).map(|pages| pages * SHAPE.resident_bytes() as u64).collect();
    let orders: Vec<Order> = PolicyKind::ALL.into_iter().map(Order::Policy).chain([Order::Belady]).collect();
    for seed in 0..6 {
        let trace = trace(seed, 600);
        let outcomes = compare(&trace, Codec::DEFAULT, &[ReadStrategy::FullImage], &orders, &sizes);
        assert_eq!(outcomes.len(), orders.len() * sizes.len());
        for (pages, of_size) in (1..).zip(outcomes.chunks(orders.len())) {
            let best = of_size.last().unwrap();
            assert_eq!((best.setting.order, best.loads), (Order::Belady, plain_optimum(&trace, pages)), "{pages} pages");
            for outcome in of_size {
                assert!(outcome.loads >= best.loads, "{} beats the optimum", outcome.setting.order.name());
                assert_eq!(outcome.misses, outcome.loads, "full images miss once a load");
            }
            if let Some(excess) = of_size[0].excess {
                assert_eq!((of_size[0].setting.order, excess), (Order::Policy(PolicyKind::Lru), 1.0));
                assert_eq!(best.excess, Some(0.0));
            }
        }
        // Least recently used is a stack: more room, fewer loads.
        let lru: Vec<u64> = outcomes.iter().step_by(orders.len()).map(|o| o.loads).collect();
        assert!(lru.is_sorted_by(|a, b| a >= b), "{lru:?}");
        assert!(lru[0] > lru[PAGES as usize - 1]);
    }
}

#[test]
fn a_trace_is_read_back_as_it_was() {
    let mut trace = trace(3, 500);
    trace.events.push(TraceEvent::Page { version: 0, page: PageId(7) });
    for is_truncated in [false, true] {
        trace.is_truncated = is_truncated;
        let bytes = trace.to_bytes();
        assert_eq!(Trace::from_bytes(&bytes).as_ref(), Ok(&trace));
        assert!(bytes.len() < 6 * trace.events.len(), "{} bytes for {} events", bytes.len(), trace.events.len());
    }
}

#[test]
fn a_cut_or_changed_trace_is_refused() {
    let bytes = trace(4, 60).to_bytes();
    for cut in 0..bytes.len() {
        assert!(Trace::from_bytes(&bytes[..cut]).is_err(), "cut at {cut}");
    }
    for at in 0..bytes.len() {
        let mut changed = bytes.clone();
        changed[at] ^= 0x11;
        assert!(Trace::from_bytes(&changed).is_err(), "byte {at}");
    }
}

/// With a checksum that fits: whatever is read is within its versions.
#[test]
fn a_trace_that_lies_is_refused_or_harmless() {
    let bytes = trace(5, 80).to_bytes();
    let content = bytes.len() - 8;
    let mut rng = Pcg32::seed_from_u64(1);
    let (mut refused, mut read) = (0, 0);
    for _ in 0..4000 {
        let mut changed = bytes[..content].to_vec();
        for _ in 0..rng.random_range(1..4u32) {
            let at = rng.random_range(0..changed.len());
            changed[at] = rng.random_range(0..=255u8);
        }
        if rng.random_range(0..4u32) == 0 {
            changed.truncate(rng.random_range(0..changed.len()));
        }
        let checksum = xxh3_64(&changed);
        changed.extend_from_slice(&checksum.to_le_bytes());
        match Trace::from_bytes(&changed) {
            Err(_) => refused += 1,
            Ok(trace) => {
                read += 1;
                let within = |event: &TraceEvent| match *event {
                    TraceEvent::Frame => true,
                    TraceEvent::Page { version, page } => page.0 < trace.versions[version as usize].page_count,
                    TraceEvent::Row { version, page, row, fetches } => {
                        let of = &trace.versions[version as usize];
                        page.0 < of.page_count && row < of.shape.height && fetches > 0
                    }
                };
                assert!(trace.events.iter().all(within));
                let capacity_bytes = 3 * SHAPE.resident_bytes() as u64;
                let order = Order::Policy(PolicyKind::Lru);
                simulate(&trace, Setting { strategy: ReadStrategy::OnDemand, codec: Codec::LzwSeq, order, capacity_bytes });
            }
        }
    }
    assert!(refused > 500 && read > 100, "{refused} refused, {read} read");
}
