//! Killed or out of space at every step: afterwards the version is whole or not there, and the work goes on where it stopped.

use std::fs::{self, File};
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;

/// Does so many operations, then nothing any more, as for a killed process; the last write is torn.
#[derive(Debug)]
struct DyingDisk {
    left: AtomicU64,
    takes_along: TakesAlong,
}

/// What ends with the disk.
#[derive(Debug, Clone, Copy)]
enum TakesAlong {
    /// Only what is asked of it: destructors run, and the index is closed in order.
    Nothing,
    Process,
}

impl DyingDisk {
    fn after(operations: u64) -> Arc<Self> {
        Arc::new(Self { left: AtomicU64::new(operations), takes_along: TakesAlong::Nothing })
    }

    fn step(&self) -> io::Result<()> {
        let alive = self.left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1));
        alive.map(|_| ()).map_err(|_| self.die())
    }

    fn die(&self) -> io::Error {
        match self.takes_along {
            TakesAlong::Nothing => io::Error::other("killed"),
            TakesAlong::Process => std::process::abort(),
        }
    }
}

impl Disk for DyingDisk {
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        if self.left.load(Ordering::SeqCst) == 1 {
            LocalDisk.write_at(file, &bytes[..bytes.len() / 2], offset)?;
            return self.step().and_then(|()| Err(self.die()));
        }
        self.step()?;
        LocalDisk.write_at(file, bytes, offset)
    }
    fn open_writable(&self, path: &Path) -> io::Result<File> {
        self.step()?;
        LocalDisk.open_writable(path)
    }
    fn set_len(&self, file: &File, bytes: u64) -> io::Result<()> {
        self.step()?;
        LocalDisk.set_len(file, bytes)
    }
    fn sync(&self, _file: &File) -> io::Result<()> {
        // A killed process loses nothing that it wrote, so the real thing would only be slow.
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
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        LocalDisk.remove_file(path)
    }
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        LocalDisk.remove_dir_all(path)
    }
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        self.step()?;
        LocalDisk.create_dir_all(path)
    }
}

fn on_disk(root: &Path, disk: Arc<dyn Disk>) -> Result<Store, StoreError> {
    Ok(Store::open(root, StoreOptions { disk, ..StoreOptions::local() })?.0)
}

/// A job as the service runs it: goes on with whatever is there, and finishes or fails.
fn job(root: &Path, disk: Arc<dyn Disk>) -> Result<Arc<DatasetVersion>, StoreError> {
    job_named("job-1", root, disk)
}

fn job_named(token: &str, root: &Path, disk: Arc<dyn Disk>) -> Result<Arc<DatasetVersion>, StoreError> {
    let store = on_disk(root, disk)?;
    match store.create_dataset("d") {
        Err(StoreError::AlreadyExists { .. }) | Ok(()) => {}
        Err(error) => return Err(error),
    }
    let staging = match store.stage("d", token) {
        Err(StoreError::AlreadyPublished { version, .. }) => return store.open_version("d", Some(version)),
        other => other?,
    };
    if staging.blob("geometry")?.is_none() {
        staging.put_blob("geometry", b"four corners")?;
    }
    let present = staging.pages_present();
    for page in (0..3).map(PageId).filter(|page| !present.contains(page)) {
        staging.append_page(page, &small(), &texels(&small(), page.0))?;
    }
    staging.publish(publication())
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_job_killed_at_any_step_leaves_the_version_whole_or_absent_and_finishes_when_resumed() {
    let reference = tempfile::tempdir().unwrap();
    let expected = job(reference.path(), Arc::new(LocalDisk)).unwrap().manifest().clone();
    let (mut published, mut absent) = (0, 0);
    for steps in 0.. {
        let root = tempfile::tempdir().unwrap();
        let finished = job(root.path(), DyingDisk::after(steps)).is_ok();
        // What the next start sees.
        if let Ok((store, report)) = Store::open(root.path(), StoreOptions::local()) {
            assert!(report.damaged.is_empty(), "after {steps} steps: {report:?}");
            match store.versions("d").unwrap_or_default()[..] {
                [] => {
                    absent += 1;
                    assert!(!finished, "a version that was reported published is gone");
                    assert!(names(&root.path().join("segments")).is_empty() && names(&root.path().join("blobs")).is_empty());
                }
                [1] => {
                    published += 1;
                    assert_whole(&store.open_version("d", Some(1)).unwrap(), 3);
                    assert!(names(&root.path().join("staging")).is_empty(), "{report:?}");
                }
                ref other => panic!("versions {other:?}"),
            }
        }
        // Resumed, it ends as if nothing had happened: same bytes, one version, no garbage.
        let version = job(root.path(), Arc::new(LocalDisk)).unwrap();
        assert_eq!(*version.manifest(), expected, "after {steps} steps");
        assert_whole(&version, 3);
        for (folder, count) in [("segments", 1), ("blobs", 1), ("staging", 0), ("trash", 0), ("datasets/d", 1)] {
            assert_eq!(names(&root.path().join(folder)).len(), count, "{folder} after {steps} steps");
        }
        // Only once the removal of the staging went through too has every step been tried.
        if finished && published > 3 {
            break;
        }
    }
    assert!(absent > 30, "only {absent} steps before publication");
}

const CHILD_ROOT: &str = "LUMISPHERE_CRASH_ROOT";
const CHILD_STEPS: &str = "LUMISPHERE_CRASH_STEPS";
const CHILD_TEST: &str = "textures::tests::crash::a_process_that_is_told_to_dies_while_it_publishes";

/// Nothing, unless the test below has started this process.
#[test]
fn a_process_that_is_told_to_dies_while_it_publishes() {
    let (Ok(root), Ok(steps)) = (std::env::var(CHILD_ROOT), std::env::var(CHILD_STEPS)) else { return };
    let left = AtomicU64::new(steps.parse().unwrap());
    let disk = Arc::new(DyingDisk { left, takes_along: TakesAlong::Process });
    job(Path::new(&root), disk).unwrap();
}

/// A process of its own publishes over the store at `root` and dies after so many operations; whether it finished before.
fn published_by_a_child(root: &Path, steps: u64) -> bool {
    let mut child = Command::new(std::env::current_exe().unwrap());
    // A core file, where the machine writes one, goes with the folder.
    child.current_dir(root).args([CHILD_TEST, "--exact"]).env(CHILD_ROOT, root).env(CHILD_STEPS, steps.to_string());
    let output = child.output().unwrap();
    assert!(output.status.success() || output.status.signal().is_some(), "{}", String::from_utf8_lossy(&output.stdout));
    output.status.success()
}

/// No destructor runs and nobody closes the index. A version of other pages was published before.
#[test]
fn a_process_that_aborts_at_any_step_leaves_what_was_published_and_the_version_whole_or_absent() {
    let begun = || {
        let root = tempfile::tempdir().unwrap();
        publish(&open(root.path()).0, 5);
        root
    };
    let expected = job(begun().path(), Arc::new(LocalDisk)).unwrap().manifest().clone();
    let (mut published, mut absent) = (0, 0);
    for steps in 0.. {
        let root = begun();
        let finished = published_by_a_child(root.path(), steps);
        let (store, report) = open(root.path());
        assert!(report.damaged.is_empty(), "after {steps} steps: {report:?}");
        assert_whole(&store.open_version("d", Some(1)).unwrap(), 5);
        let versions = store.versions("d").unwrap();
        match versions[..] {
            [1] => {
                absent += 1;
                assert!(!finished, "a version that was reported published is gone");
            }
            [1, 2] => {
                published += 1;
                assert_whole(&store.open_version("d", Some(2)).unwrap(), 3);
                assert!(names(&root.path().join("staging")).is_empty(), "{report:?}");
            }
            ref other => panic!("versions {other:?}"),
        }
        // A segment a version, and no other: what was half-written is swept.
        assert_eq!(names(&root.path().join("segments")).len(), versions.len(), "after {steps} steps");
        drop(store);
        let version = job(root.path(), Arc::new(LocalDisk)).unwrap();
        assert_eq!(*version.manifest(), expected, "after {steps} steps");
        assert_whole(&version, 3);
        if finished {
            break;
        }
    }
    assert!(absent > 20 && published > 2, "{absent} steps before publication, {published} after");
}

/// Two segments' worth of work, two versions, any moment: 200 random points, each followed by up to three more kills while resuming.
#[test]
fn two_hundred_kills_at_random_points_lose_nothing_that_was_acknowledged() {
    let mut rng = Pcg32::seed_from_u64(11);
    let (mut kills, mut resumed_twice) = (0, 0);
    while kills < 200 {
        let root = tempfile::tempdir().unwrap();
        let mut acknowledged = 0;
        for attempt in 0.. {
            // Later attempts die later, so that the work ends.
            let steps = rng.random_range(0..60u64) + 30 * attempt;
            let disk = DyingDisk::after(steps);
            let done = versions_up_to(2, root.path(), disk, &mut acknowledged);
            kills += u64::from(done.is_err());
            resumed_twice += u64::from(attempt == 2);
            let (store, report) = open(root.path());
            assert!(report.damaged.is_empty(), "after {steps} steps of attempt {attempt}: {report:?}");
            let versions = store.versions("d").unwrap_or_default();
            assert!(versions.len() as u64 >= acknowledged, "version {acknowledged} was acknowledged; there are {versions:?}");
            for version in versions {
                assert_whole(&store.open_version("d", Some(version)).unwrap(), 3);
            }
            if done.is_ok() {
                break;
            }
        }
    }
    assert!(resumed_twice > 10, "only {resumed_twice} jobs were killed more than once");
}

/// Publishes versions until there are `count`; how many were acknowledged so far.
fn versions_up_to(count: u64, root: &Path, disk: Arc<dyn Disk>, acknowledged: &mut u64) -> Result<(), StoreError> {
    for version in 1..=count {
        job_named(&format!("job-{version}"), root, disk.clone())?;
        *acknowledged = (*acknowledged).max(version);
    }
    Ok(())
}

#[test]
fn a_deletion_killed_at_any_step_leaves_the_dataset_whole_or_absent() {
    for steps in 0..20 {
        let root = tempfile::tempdir().unwrap();
        let disk = DyingDisk::after(u64::MAX);
        let deleted = {
            let store = on_disk(root.path(), disk.clone()).unwrap();
            publish(&store, 2);
            disk.left.store(steps, Ordering::SeqCst);
            store.delete_dataset("d").is_ok()
        };
        let (store, report) = open(root.path());
        assert!(report.damaged.is_empty());
        if store.datasets().is_empty() {
            for folder in ["segments", "blobs", "staging", "trash", "datasets"] {
                assert!(names(&root.path().join(folder)).is_empty(), "{folder} after {steps} steps");
            }
        } else {
            assert!(!deleted);
            assert_whole(&store.open_version("d", None).unwrap(), 2);
        }
    }
}

/// Cuts a killed writer's segment everywhere: its whole records are kept, the rest is written again, and the result is the same.
#[test]
fn a_torn_segment_keeps_its_whole_records() {
    let reference = tempfile::tempdir().unwrap();
    let expected = publish(&open(reference.path()).0, 4).manifest().segments.clone();
    let record = |page| encode(&small(), &texels(&small(), page)).unwrap().stored_bytes();
    let ends: Vec<u64> = (0..4).scan(0, |end, page| Some(*end + record(page)).inspect(|&e| *end = e)).collect();
    let cuts = (0..=16).map(|i| ends[3] * i / 16).chain(ends.iter().flat_map(|&end| [end - 1, end]));
    for cut in cuts {
        let root = tempfile::tempdir().unwrap();
        let (store, _) = open(root.path());
        store.create_dataset("d").unwrap();
        append(&store.stage("d", "first").unwrap(), 0..4);
        let path = root.path().join("staging/first/0000.seg");
        File::options().write(true).open(&path).unwrap().set_len(cut).unwrap();
        let staging = store.stage("d", "first").unwrap();
        let whole = ends.iter().filter(|&&end| end <= cut).count() as u32;
        assert_eq!(staging.pages_present(), (0..whole).map(PageId).collect(), "cut at {cut}");
        append(&staging, whole..4);
        staging.put_blob("geometry", b"four corners").unwrap();
        let version = staging.publish(publication()).unwrap();
        assert_whole(&version, 4);
        assert_eq!(version.manifest().segments, expected);
    }
}

/// After a power cut the tail may have its length but not its bytes.
#[test]
fn a_segment_with_a_hole_is_cut_there() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    append(&store.stage("d", "first").unwrap(), 0..3);
    let path = root.path().join("staging/first/0000.seg");
    let mut bytes = fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..].fill(0);
    fs::write(&path, bytes).unwrap();
    assert_eq!(store.stage("d", "first").unwrap().pages_present(), [PageId(0)].into());
}

#[test]
fn a_full_disk_is_told_loses_nothing_and_the_work_goes_on_when_there_is_room() {
    let reference = tempfile::tempdir().unwrap();
    let expected = job(reference.path(), Arc::new(LocalDisk)).unwrap().manifest().clone();
    let needed: u64 = 100_000;
    for free in (0..needed).step_by(2311) {
        let root = tempfile::tempdir().unwrap();
        let disk = Arc::new(LimitedDisk::new(free));
        match job(root.path(), disk.clone()) {
            Ok(version) => assert_eq!(*version.manifest(), expected),
            Err(StoreError::DiskFull { .. }) => {
                // Without a restart in between, and with one: both go on.
                disk.set_free_bytes(u64::MAX);
                assert_eq!(*job(root.path(), disk).unwrap().manifest(), expected, "{free} bytes free");
            }
            Err(other) => panic!("{free} bytes free: {other}"),
        }
    }
}

#[test]
fn the_same_staging_goes_on_after_a_full_disk() {
    let root = tempfile::tempdir().unwrap();
    let disk = Arc::new(LimitedDisk::new(u64::MAX));
    let store = on_disk(root.path(), disk.clone()).unwrap();
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "first").unwrap();
    append(&staging, 0..1);
    for free in [0, 1, 100, 3000] {
        disk.set_free_bytes(free);
        let refused = staging.append_page(PageId(1), &small(), &texels(&small(), 1));
        assert!(matches!(refused, Err(StoreError::DiskFull { .. })), "{refused:?}");
        assert!(matches!(staging.put_blob("big", &[7; 5000]), Err(StoreError::DiskFull { .. })));
        assert_eq!(staging.pages_present(), [PageId(0)].into());
    }
    disk.set_free_bytes(u64::MAX);
    append(&staging, 1..3);
    staging.put_blob("geometry", b"four corners").unwrap();
    assert_whole(&staging.publish(publication()).unwrap(), 3);
}

/// The link in the store and the staging share one file. If it grows after a failed attempt, the old name must not keep it.
#[test]
fn a_failed_publication_can_be_followed_by_more_pages() {
    let root = tempfile::tempdir().unwrap();
    let disk = Arc::new(LimitedDisk::new(u64::MAX));
    let store = on_disk(root.path(), disk.clone()).unwrap();
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "first").unwrap();
    append(&staging, 0..2);
    staging.put_blob("geometry", b"four corners").unwrap();
    disk.set_free_bytes(0);
    assert!(matches!(staging.publish(publication()), Err(StoreError::DiskFull { .. })));
    disk.set_free_bytes(u64::MAX);
    let staging = store.stage("d", "first").unwrap();
    append(&staging, 2..3);
    assert_whole(&staging.publish(publication()).unwrap(), 3);
    // Another dataset with just the first two pages: its segment's name exists from the failed attempt.
    store.create_dataset("e").unwrap();
    let staging = store.stage("e", "first").unwrap();
    append(&staging, 0..2);
    staging.put_blob("geometry", b"four corners").unwrap();
    let version = staging.publish(publication()).unwrap();
    let segment = &version.manifest().segments[0];
    let file = root.path().join(format!("segments/{}.seg", segment.blake3));
    assert_eq!(ContentHash::of(&fs::read(file).unwrap()), segment.blake3);
    assert_whole(&version, 2);
}
