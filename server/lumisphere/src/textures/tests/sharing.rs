//! Names, writers, readers and deletion.

use super::*;

#[test]
fn a_dataset_has_one_writer_and_a_store_one_process() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    store.create_dataset("e").unwrap();
    let first = store.stage("d", "a").unwrap();
    for token in ["a", "b"] {
        assert!(matches!(store.stage("d", token), Err(StoreError::Busy { .. })));
    }
    assert!(store.stage("e", "b").is_ok());
    assert!(matches!(store.delete_dataset("d"), Err(StoreError::Busy { .. })));
    assert!(matches!(Store::open(root.path(), StoreOptions::local()), Err(StoreError::Busy { .. })));
    drop(first);
    assert!(store.stage("d", "c").is_ok());
    // A token stays with its dataset, and the refusal claims nothing.
    assert!(matches!(store.stage("e", "a"), Err(StoreError::AlreadyExists { .. })));
    assert!(store.stage("e", "b").is_ok());
}

#[test]
fn versions_are_numbered_and_each_stays_what_it_was() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let first = publish(&store, 2);
    let staging = store.stage("d", "second").unwrap();
    append(&staging, 0..3);
    staging.put_blob("geometry", b"four corners").unwrap();
    assert_eq!(store.versions("d").unwrap(), [1], "nothing is visible before it is published");
    let second = staging.publish(publication()).unwrap();
    assert_whole(&first, 2);
    assert_whole(&second, 3);
    assert_eq!((first.manifest().version, second.manifest().version), (1, 2));
    assert_eq!(store.open_version("d", None).unwrap().manifest().version, 2);
    assert!(Arc::ptr_eq(&second, &store.open_version("d", Some(2)).unwrap()));
    assert!(matches!(store.open_version("d", Some(3)), Err(StoreError::NotFound { .. })));
    assert!(matches!(store.stage("d", "second"), Err(StoreError::AlreadyPublished { version: 2, .. })));
}

#[test]
fn readers_outlive_deletion_and_shared_files_outlive_one_dataset() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let held = publish(&store, 2);
    // The same content under another name shares its segment and blob.
    store.create_dataset("twin").unwrap();
    let staging = store.stage("twin", "t").unwrap();
    append(&staging, 0..2);
    staging.put_blob("geometry", b"four corners").unwrap();
    staging.publish(publication()).unwrap();
    store.delete_dataset("d").unwrap();
    assert_eq!(store.datasets(), ["twin"]);
    assert!(matches!(store.open_version("d", None), Err(StoreError::NotFound { .. })));
    assert_whole(&held, 2);
    assert_whole(&store.open_version("twin", None).unwrap(), 2);
    store.delete_dataset("twin").unwrap();
    assert_eq!(std::fs::read_dir(root.path().join("segments")).unwrap().count(), 0);
    assert_eq!(std::fs::read_dir(root.path().join("blobs")).unwrap().count(), 0);
    assert_whole(&held, 2);
    // A new dataset of the old name is another one, in the cache too.
    let again = publish(&store, 1);
    assert_ne!(again.slot(), held.slot());
    assert_eq!(open_report_is_clean(store, root.path()), ["d"]);
}

fn open_report_is_clean(store: Store, root: &Path) -> Vec<String> {
    drop(store);
    let (store, report) = open(root);
    assert!(report.damaged.is_empty() && report.swept.is_empty() && report.index == IndexOutcome::Intact, "{report:?}");
    store.datasets()
}

#[test]
fn names_that_could_leave_their_folder_are_refused() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let long = "a".repeat(64);
    for name in ["", ".", "..", "../x", "a/b", "A", "ä", "-a", "_a", ".a", "a b", "a\0", &long] {
        assert!(matches!(store.create_dataset(name), Err(StoreError::InvalidName { .. })), "{name:?}");
    }
    for name in ["a", "0", "gazebo-128.f16_v2", &long[..63]] {
        store.create_dataset(name).unwrap();
    }
    assert!(matches!(store.create_dataset("a"), Err(StoreError::AlreadyExists { .. })));
    assert!(matches!(store.stage("a", "../t"), Err(StoreError::InvalidName { .. })));
    let staging = store.stage("a", "t").unwrap();
    assert!(matches!(staging.put_blob("../b", b""), Err(StoreError::InvalidName { .. })));
    assert!(matches!(store.stage("nowhere", "t"), Err(StoreError::NotFound { .. })));
    assert!(matches!(store.delete_dataset("nowhere"), Err(StoreError::NotFound { .. })));
}

#[test]
fn pages_are_dense_unique_and_an_abandoned_staging_is_gone() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    append(&staging, 0..2);
    append(&staging, 3..4);
    let twice = staging.append_page(PageId(1), &small(), &texels(&small(), 1));
    assert!(matches!(twice, Err(StoreError::AlreadyExists { .. })));
    let holed = staging.publish(publication()).unwrap_err();
    assert!(matches!(holed, StoreError::Incomplete { missing: PageId(2), last: PageId(3) }), "{holed}");
    let staging = store.stage("d", "t").unwrap();
    assert_eq!(staging.pages_present().len(), 3);
    staging.abandon().unwrap();
    assert!(store.stagings().is_empty());
    assert!(store.stage("d", "t").unwrap().pages_present().is_empty());
}

#[test]
fn a_version_may_have_blobs_and_no_page() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let version = publish(&store, 0);
    assert_whole(&version, 0);
    assert!(version.manifest().segments.is_empty());
    assert!(version.read_page(PageId(0)).is_err());
    drop(version);
    assert_eq!(open_report_is_clean(store, root.path()), ["d"]);
}

#[test]
fn a_blob_is_replaced_by_its_name_and_found_by_the_next_run() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    assert_eq!(staging.blob("map").unwrap(), None);
    staging.put_blob("map", b"old and longer").unwrap();
    staging.put_blob("map", b"new").unwrap();
    drop(staging);
    let staging = store.stage("d", "t").unwrap();
    assert_eq!(staging.blob("map").unwrap().unwrap(), b"new");
    let version = staging.publish(publication()).unwrap();
    assert_eq!(version.blob("map").unwrap(), b"new");
    assert_eq!(std::fs::read_dir(root.path().join("blobs")).unwrap().count(), 1);
}

#[test]
fn the_cache_reads_a_version_once_and_counts_what_it_cost() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let version = publish(&store, 3);
    let cache = Cache::new(CacheOptions::decoded(1 << 20));
    for _ in 0..2 {
        for page in 0..3 {
            assert_eq!(cache.page(&version, PageId(page)).unwrap().to_f32(), texels(&small(), page));
        }
    }
    let stats = cache.stats();
    assert_eq!((stats.look_ups, stats.hits, stats.misses), (6, 3, 3));
    assert_eq!(stats.bytes_read, version.manifest().segments[0].bytes);
    assert_eq!(stats.bytes_decoded, 3 * small().decoded_bytes() as u64);
    assert!(stats.decode_nanos > 0);
    // Opened again, it is the same version.
    drop(version);
    let version = store.open_version("d", None).unwrap();
    cache.page(&version, PageId(0)).unwrap();
    assert_eq!(cache.stats().hits, 4);
    assert!(cache.page(&version, PageId(3)).is_err());
}

#[test]
fn older_versions_go_for_good_and_who_reads_one_goes_on() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let first = publish(&store, 2);
    let staging = store.stage("d", "second").unwrap();
    append(&staging, 5..6);
    staging.append_page(PageId(0), &small(), &texels(&small(), 9)).unwrap();
    // The first version's blob is this one's, too.
    staging.put_blob("geometry", b"four corners").unwrap();
    assert!(staging.publish(publication()).is_err(), "pages have a hole");
    let staging = store.stage("d", "third").unwrap();
    append(&staging, 0..3);
    staging.put_blob("geometry", b"four corners").unwrap();
    let last = staging.publish(publication()).unwrap();
    store.stage("d", "second").unwrap().abandon().unwrap();
    let segments = || std::fs::read_dir(root.path().join("segments")).unwrap().count();
    assert_eq!((segments(), store.versions("d").unwrap()), (2, vec![1, 2]));
    store.delete_older_versions("d").unwrap();
    assert_eq!((segments(), store.versions("d").unwrap()), (1, vec![2]));
    assert!(matches!(store.open_version("d", Some(1)), Err(StoreError::NotFound { .. })));
    assert_whole(&first, 2);
    assert_whole(&last, 3);
    // Numbers go on, and nothing to delete is nothing to complain about.
    store.delete_older_versions("d").unwrap();
    drop((first, last));
    assert_eq!(open_report_is_clean(store, root.path()), ["d"]);
    let (store, _) = open(root.path());
    assert_eq!(store.versions("d").unwrap(), [2]);
    assert_whole(&store.open_version("d", None).unwrap(), 3);
}

#[test]
fn scratch_is_found_by_who_resumes_is_checked_and_goes_with_the_staging() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    staging.put_scratch("models-000001", b"some").unwrap();
    staging.put_scratch("models-000001", b"others").unwrap();
    drop(staging);
    let staging = store.stage("d", "t").unwrap();
    assert_eq!(staging.scratch("models-000001").unwrap().as_deref(), Some(&b"others"[..]));
    assert_eq!(staging.scratch("models-000002").unwrap(), None);
    let path = root.path().join("staging/t/scratch/models-000001");
    let mut bytes = std::fs::read(&path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    assert!(matches!(staging.scratch("models-000001"), Err(StoreError::DamagedFile { .. })));
    std::fs::write(&path, b"short").unwrap();
    assert!(matches!(staging.scratch("models-000001"), Err(StoreError::DamagedFile { .. })));
    append(&staging, 0..1);
    let version = staging.publish(publication()).unwrap();
    assert!(version.manifest().blobs.is_empty() && !root.path().join("staging/t").exists());
}
