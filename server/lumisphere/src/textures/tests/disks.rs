//! Disks that fail, return nothing, or are slow, under a store that is being read and written: every failure is a typed error that names
//! the file, and once the disk is well again everything is there.

use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

use super::*;

/// Every n-th operation fails with an I/O error; 0: none.
#[derive(Debug, Default)]
struct FaultyDisk {
    period: AtomicU32,
    operations: AtomicU32,
}

impl FaultyDisk {
    fn step(&self) -> io::Result<()> {
        let period = self.period.load(Ordering::SeqCst);
        let fails = period > 0 && self.operations.fetch_add(1, Ordering::SeqCst) % period == period - 1;
        if fails { Err(io::Error::other("the disk is meant to fail")) } else { Ok(()) }
    }
}

impl Disk for FaultyDisk {
    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<()> {
        self.step()?;
        LocalDisk.read_at(file, buffer, offset)
    }
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        self.step()?;
        LocalDisk.write_at(file, bytes, offset)
    }
    fn open_writable(&self, path: &Path) -> io::Result<File> {
        self.step()?;
        LocalDisk.open_writable(path)
    }
    fn sync(&self, _: &File) -> io::Result<()> {
        self.step()
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.step()?;
        LocalDisk.rename(from, to)
    }
    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.step()?;
        LocalDisk.link(from, to)
    }
}

fn on(disk: &Arc<FaultyDisk>, root: &Path) -> Store {
    Store::open(root, StoreOptions { disk: disk.clone(), ..StoreOptions::local() }).unwrap().0
}

#[test]
fn a_failing_disk_fails_the_reads_it_fails_and_poisons_nothing() {
    let root = tempfile::tempdir().unwrap();
    let disk = Arc::new(FaultyDisk::default());
    let version = publish(&on(&disk, root.path()), 6);
    for strategy in ReadStrategy::ALL {
        let cache =
            Cache::new(CacheOptions { strategy, compressed_bytes: 4000, ..CacheOptions::decoded(2 * small().resident_bytes() as u64) });
        disk.period.store(3, Ordering::SeqCst);
        let mut reader = cache.reader(&version);
        let (mut failed, mut served) = (0, 0);
        for step in 0..600u32 {
            let (page, y) = (step * 5 % 6, step * 7 % 40);
            match reader.texel(PageId(page), 3, y) {
                Ok(texel) => {
                    assert_eq!(texel, texels(&small(), page)[(y as usize * 24 + 3) * 4..][..4]);
                    served += 1;
                }
                Err(StoreError::Io { action, path, .. }) => {
                    assert!(action == "read" && path.starts_with(root.path()));
                    failed += 1;
                }
                Err(other) => panic!("{other}"),
            }
        }
        assert!(failed > 10 && served > 10, "{strategy}: {failed} failed, {served} served");
        // Well again, at once.
        disk.period.store(0, Ordering::SeqCst);
        (0..6).for_each(|page| assert_eq!(cache.page(&version, PageId(page)).unwrap().to_f32(), texels(&small(), page)));
        drop(reader);
        let stats = cache.stats();
        assert_eq!(stats.look_ups, stats.hits + stats.misses);
        assert!(stats.failed_reads >= failed);
    }
}

#[test]
fn writing_goes_on_where_a_failing_disk_stopped_it() {
    for period in [2, 3, 5, 7, 11, 13] {
        let root = tempfile::tempdir().unwrap();
        let disk = Arc::new(FaultyDisk::default());
        let store = on(&disk, root.path());
        store.create_dataset("d").unwrap();
        disk.period.store(period, Ordering::SeqCst);
        let mut failures = 0;
        let version = loop {
            match write_once(&store) {
                Ok(version) => break version,
                Err(StoreError::Io { .. }) => failures += 1,
                Err(other) => panic!("{other}"),
            }
            // A period of two would fail the same step for ever.
            if failures == 40 {
                disk.period.store(0, Ordering::SeqCst);
            }
        };
        assert!(failures > 0, "every {period}. operation");
        disk.period.store(0, Ordering::SeqCst);
        assert_whole(&version, 3);
        drop((version, store));
        let (store, report) = open(root.path());
        assert!(report.damaged.is_empty(), "{report:?}");
        assert_eq!(store.versions("d").unwrap(), [1]);
        assert_whole(&store.open_version("d", None).unwrap(), 3);
    }
}

/// As a job does: with what is there already.
fn write_once(store: &Store) -> Result<Arc<DatasetVersion>, StoreError> {
    let staging = match store.stage("d", "t") {
        Err(StoreError::AlreadyPublished { version, .. }) => return store.open_version("d", Some(version)),
        other => other?,
    };
    let present = staging.pages_present();
    for page in (0..3).map(PageId).filter(|page| !present.contains(page)) {
        staging.append_page(page, &small(), &texels(&small(), page.0))?;
    }
    if staging.blob("geometry")?.is_none() {
        staging.put_blob("geometry", b"four corners")?;
    }
    staging.publish(publication())
}
