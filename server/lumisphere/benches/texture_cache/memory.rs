//! Real memory against the tiers' own counts, in a process of its own: this program started anew, so that nothing freed before is used again.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use lumisphere::textures::{Cache, CacheOptions, DatasetVersion, PageId, ReadStrategy, Store, StoreOptions};

use crate::data::FACE_BYTES;
use crate::traces;

/// Pages of both tiers, in faces: a third of the data.
const DECODED_FACES: u64 = 160;
const COMPRESSED_BYTES: u64 = 24 << 20;
const LOOK_UPS: usize = 40_000;

/// Starts the measurement of each strategy on a stored version.
pub fn measure(store: &Path) {
    println!("\nreal memory over what was there before the cache, and the bytes that its tiers count: filled, then churned");
    for strategy in [ReadStrategy::FullImage, ReadStrategy::OnDemand, ReadStrategy::Block] {
        let mut command = Command::new(std::env::current_exe().expect("a running program has a file"));
        let output = command.arg("memory-of").arg(store).arg(strategy.name()).output().expect("this program starts again");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        print!("{}", String::from_utf8_lossy(&output.stdout));
    }
}

/// The measurement itself.
pub fn measured(store: &Path, strategy: ReadStrategy) {
    let (store, _) = Store::open(store, StoreOptions::local()).expect("a store of this benchmark");
    let version = store.open_version("bench", None).expect("its one version");
    // Contexts, buffers and the version's table are no pages: a cache of one face makes them first.
    let options = CacheOptions { strategy, ..CacheOptions::decoded(FACE_BYTES) };
    let look_ups = traces::random(LOOK_UPS);
    look_all_up(&Cache::new(options), &version, &look_ups[..300]);
    let before = resident_bytes();
    let cache = Cache::new(CacheOptions { decoded_bytes: DECODED_FACES * FACE_BYTES, compressed_bytes: COMPRESSED_BYTES, ..options });
    for (state, part) in [("filled", &look_ups[..3 * 4000]), ("churned", &look_ups[3 * 4000..])] {
        look_all_up(&cache, &version, part);
        let (real, now) = (resident_bytes() - before, cache.snapshot());
        let counted = now.decoded.resident_bytes + now.compressed.resident_bytes;
        let budget = DECODED_FACES * FACE_BYTES + COMPRESSED_BYTES;
        let megabytes = |bytes: u64| 1e-6 * bytes as f64;
        println!(
            "  {strategy}, {state}: {:.1} MB real, {:.1} counted ({:.1} decoded, {:.1} compressed), {:.1} budget",
            megabytes(real),
            megabytes(counted),
            megabytes(now.decoded.resident_bytes),
            megabytes(now.compressed.resident_bytes),
            megabytes(budget)
        );
        super::bound("real / sum of the budgets", real as f64 / budget as f64, 1.1);
    }
}

fn look_all_up(cache: &Cache, version: &Arc<DatasetVersion>, look_ups: &[u32]) {
    let mut reader = cache.reader(version);
    for at in look_ups.as_chunks::<3>().0 {
        reader.texel(PageId(at[0]), at[1], at[2]).expect("intact data");
    }
}

/// Of this process.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux tells a process's memory");
    let line = status.lines().find(|line| line.starts_with("RssAnon:")).expect("and the part that is no file's");
    let kilobytes = line.split_whitespace().nth(1).and_then(|n| n.parse::<u64>().ok()).expect("in kB");
    kilobytes << 10
}
