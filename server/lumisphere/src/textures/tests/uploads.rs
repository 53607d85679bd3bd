//! Uploads that are cut, repeated, disordered or lies.

use super::*;

const CONTENT: &[u8] = b"an environment, sent in several pieces";

fn total() -> u64 {
    CONTENT.len() as u64
}

#[test]
fn an_upload_goes_on_where_it_was_cut_even_after_a_restart() {
    let root = tempfile::tempdir().unwrap();
    let hash = ContentHash::of(CONTENT);
    {
        let (store, _) = open(root.path());
        let mut upload = store.begin_blob(hash, total()).unwrap();
        assert_eq!(upload.write(0, &CONTENT[..10]).unwrap(), 10);
    }
    let (store, _) = open(root.path());
    assert!(!store.has_blob(&hash), "nothing is visible before it is whole");
    let mut upload = store.begin_blob(hash, total()).unwrap();
    assert_eq!(upload.offset(), 10);
    upload.write(10, &CONTENT[10..]).unwrap();
    assert_eq!(upload.finish().unwrap(), hash);
    assert_eq!(store.read_blob(&hash).unwrap(), CONTENT);
    assert_eq!(store.blob_bytes(&hash).unwrap(), total());
    assert_eq!(store.read_blob_range(&hash, 3, 11).unwrap(), b"environment");
    assert_eq!(store.read_blob_range(&hash, total() - 2, 100).unwrap(), b"es");
    assert!(store.read_blob_range(&hash, total() + 5, 100).unwrap().is_empty());
    assert!(matches!(store.begin_blob(hash, total()), Err(StoreError::AlreadyExists { .. })));
}

#[test]
fn chunks_out_of_order_or_too_many_are_refused_and_change_nothing() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let mut upload = store.begin_blob(ContentHash::of(CONTENT), total()).unwrap();
    upload.write(0, &CONTENT[..5]).unwrap();
    assert!(matches!(upload.write(0, &CONTENT[..5]), Err(StoreError::WrongOffset { expected: 5, got: 0 })));
    assert!(matches!(upload.write(9, &CONTENT[9..]), Err(StoreError::WrongOffset { expected: 5, got: 9 })));
    assert!(matches!(upload.write(5, &[0; 100]), Err(StoreError::WrongLength { got: 105, .. })));
    upload.write(5, &CONTENT[5..]).unwrap();
    assert!(matches!(upload.write(total(), b"x"), Err(StoreError::WrongLength { .. })));
    upload.finish().unwrap();
}

#[test]
fn an_unfinished_upload_cannot_be_finished_and_is_kept() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let hash = ContentHash::of(CONTENT);
    let mut upload = store.begin_blob(hash, total()).unwrap();
    upload.write(0, &CONTENT[..5]).unwrap();
    assert!(matches!(upload.finish(), Err(StoreError::WrongLength { got: 5, .. })));
    assert_eq!(store.begin_blob(hash, total()).unwrap().offset(), 5);
}

#[test]
fn content_with_another_hash_is_discarded() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let hash = ContentHash::of(CONTENT);
    let mut upload = store.begin_blob(hash, total()).unwrap();
    upload.write(0, &vec![b'x'; CONTENT.len()]).unwrap();
    assert!(matches!(upload.finish(), Err(StoreError::WrongHash { expected, .. }) if expected == hash));
    assert!(!store.has_blob(&hash));
    let mut upload = store.begin_blob(hash, total()).unwrap();
    assert_eq!(upload.offset(), 0, "the lie is not resumed");
    upload.write(0, CONTENT).unwrap();
    upload.finish().unwrap();
}

#[test]
fn a_shorter_announcement_does_not_resume_a_longer_upload() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let hash = ContentHash::of(CONTENT);
    store.begin_blob(hash, 1000).unwrap().write(0, &[1; 500]).unwrap();
    assert_eq!(store.begin_blob(hash, total()).unwrap().offset(), 0);
}

#[test]
fn one_hash_has_one_upload() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let hash = ContentHash::of(CONTENT);
    let upload = store.begin_blob(hash, total()).unwrap();
    assert!(matches!(store.begin_blob(hash, total()), Err(StoreError::Busy { .. })));
    upload.abandon().unwrap();
    assert!(store.begin_blob(hash, total()).is_ok());
}

#[test]
fn an_upload_survives_a_full_disk() {
    let root = tempfile::tempdir().unwrap();
    let disk = Arc::new(LimitedDisk::new(20));
    let store = Store::open(root.path(), StoreOptions { disk: disk.clone(), ..StoreOptions::local() }).unwrap().0;
    let mut upload = store.begin_blob(ContentHash::of(CONTENT), total()).unwrap();
    upload.write(0, &CONTENT[..15]).unwrap();
    assert!(matches!(upload.write(15, &CONTENT[15..]), Err(StoreError::DiskFull { .. })));
    drop(upload);
    disk.set_free_bytes(1000);
    let mut upload = store.begin_blob(ContentHash::of(CONTENT), total()).unwrap();
    assert_eq!(upload.offset(), 15);
    upload.write(15, &CONTENT[15..]).unwrap();
    upload.finish().unwrap();
}

#[test]
fn an_upload_outlives_a_dataset_with_the_same_content() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    publish(&store, 1);
    let hash = ContentHash::of(b"four corners");
    assert!(store.has_blob(&hash));
    assert_eq!(store.put_upload(b"four corners").unwrap(), hash);
    store.delete_dataset("d").unwrap();
    assert_eq!(store.read_blob(&hash).unwrap(), b"four corners");
    assert!(matches!(store.read_blob(&ContentHash::of(b"nothing")), Err(StoreError::NotFound { .. })));
}

#[test]
fn a_hash_is_read_only_in_its_one_spelling() {
    let hash = ContentHash::of(CONTENT);
    assert_eq!(hash.to_string().parse::<ContentHash>().unwrap(), hash);
    for text in ["", "00", "../../etc/passwd", &hash.to_string().to_uppercase(), &format!("{hash}0")] {
        assert!(text.parse::<ContentHash>().is_err(), "{text}");
    }
}
