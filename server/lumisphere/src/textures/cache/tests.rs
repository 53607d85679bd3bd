//! The cache against naive models, under contention, and over disks that are slow, failing and damaged.

use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Barrier, OnceLock, mpsc};

use proptest::prelude::*;
use tempfile::TempDir;

use super::*;
use crate::textures::codec::{BLOCK_ROWS, Codec, encode_as};
use crate::textures::disk::{Disk, LocalDisk};
use crate::textures::manifest::Publication;
use crate::textures::page::{PageShape, PixelFormat};
use crate::textures::store::{Store, StoreOptions};

mod contention;
mod strategies;
mod whole_pages;

type Hook = Arc<dyn Fn() -> io::Result<()> + Send + Sync>;

/// A local disk whose reads pass through a hook: it may wait, fail or panic.
#[derive(Default)]
struct HookedDisk {
    hook: Mutex<Option<Hook>>,
    reads: AtomicU64,
}

impl std::fmt::Debug for HookedDisk {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("HookedDisk")
    }
}

impl HookedDisk {
    fn on_read(&self, hook: impl Fn() -> io::Result<()> + Send + Sync + 'static) {
        *self.hook.lock().unwrap() = Some(Arc::new(hook));
    }

    fn let_go(&self) {
        *self.hook.lock().unwrap() = None;
    }
}

impl Disk for HookedDisk {
    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<()> {
        self.reads.fetch_add(1, Ordering::SeqCst);
        let hook = self.hook.lock().unwrap().clone();
        hook.map_or(Ok(()), |hook| hook())?;
        LocalDisk.read_at(file, buffer, offset)
    }
}

/// A published version and the disk under it.
struct Published {
    root: TempDir,
    disk: Arc<HookedDisk>,
    version: Arc<DatasetVersion>,
    store: Store,
}

/// Every number names its page, row, column and channel.
fn number(page: u32, row: u32, column: u32, channel: u32) -> f32 {
    (page * 1_000_003 + row * 4099 + column * 13 + channel) as f32
}

fn published(codec: Codec, shapes: &[PageShape]) -> Published {
    let root = tempfile::tempdir().unwrap();
    let disk = Arc::new(HookedDisk::default());
    let (store, _) = Store::open(root.path(), StoreOptions { disk: disk.clone(), ..StoreOptions::local() }).unwrap();
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    for (page, shape) in (0..).zip(shapes) {
        let texels = |i: u32| {
            let (texel, channel) = (i / shape.channels, i % shape.channels);
            number(page, texel / shape.width, texel % shape.width, channel)
        };
        let texels: Vec<f32> = (0..shape.values() as u32).map(texels).collect();
        staging.append_encoded(PageId(page), &encode_as(codec, shape, &texels).unwrap()).unwrap();
    }
    let publication = Publication {
        kind: "test".into(),
        parameters: serde_json::Value::Null,
        inputs: BTreeMap::new(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    let version = staging.publish(publication).unwrap();
    Published { root, disk, version, store }
}

fn shape(width: u32, height: u32) -> PageShape {
    PageShape { width, height, channels: 1, pixel: PixelFormat::F32 }
}

fn lru(decoded_bytes: u64) -> Cache {
    Cache::new(CacheOptions::decoded(decoded_bytes))
}

fn with_strategy(decoded_bytes: u64, strategy: ReadStrategy) -> Cache {
    Cache::new(CacheOptions { strategy, ..CacheOptions::decoded(decoded_bytes) })
}

/// Blocks until `count` look-ups have been counted: the waiters are then past the table, at the flight.
fn await_look_ups(cache: &Cache, count: u64) {
    while cache.stats().look_ups < count {
        std::thread::yield_now();
    }
}

fn assert_consistent(stats: &CacheStats) {
    assert!(stats.resident_bytes <= stats.budget_bytes && stats.peak_bytes >= stats.resident_bytes, "{stats:?}");
    assert_eq!(stats.look_ups, stats.hits + stats.misses);
}
