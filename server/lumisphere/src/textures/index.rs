//! The page index in sled: a shortcut past reading every record header at start, and nothing more.
//!
//! sled 0.34.7 opens without an error and silently lacks keys after one changed byte, and may panic on others. So nothing is
//! believed that does not give the digest in the manifest, panics inside it count as errors, and whatever fails is deleted and
//! rebuilt from the segments.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};
use std::{fs, io, thread};

use super::hash::ContentHash;
use super::segment::Location;

/// The store's own lock keeps other processes out. But sled's threads hold its file for a moment after it was closed in this one.
const LOCK_PATIENCE: Duration = Duration::from_secs(2);
const LOCK_RETRY: Duration = Duration::from_millis(5);
const KEY_BYTES: usize = 20;
const VALUE_BYTES: usize = 24;

/// Places of the pages of every version, under a key that is the digest of those places.
#[derive(Debug)]
pub(super) struct Index {
    db: sled::Db,
}

/// Hash over the places of pages 0…n−1 and the segments they lie in.
pub(super) fn digest(pages: &[Location], segments: &[ContentHash]) -> ContentHash {
    let mut hasher = blake3::Hasher::new();
    for segment in segments {
        hasher.update(&segment.0);
    }
    for page in pages {
        hasher.update(&value_of(page));
    }
    ContentHash(*hasher.finalize().as_bytes())
}

impl Index {
    /// Opens or makes the index; the error says what sled said, or that it panicked.
    pub fn open(path: &Path, cache_bytes: u64) -> Result<Self, String> {
        let deadline = Instant::now() + LOCK_PATIENCE;
        loop {
            let config = sled::Config::new().path(path).cache_capacity(cache_bytes).flush_every_ms(None);
            match guarded(|| config.open()) {
                Err(reason) if reason.contains("could not acquire lock") && Instant::now() < deadline => thread::sleep(LOCK_RETRY),
                result => return result.map(|db| Self { db }),
            }
        }
    }

    /// Deletes whatever is there and makes an empty one.
    pub fn recreate(path: &Path, cache_bytes: u64) -> Result<Self, String> {
        let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        match removed {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.to_string()),
            _ => {}
        }
        Self::open(path, cache_bytes)
    }

    /// Lets go of the files; sled flushes then, and may panic on what it finds.
    pub fn close(self) {
        let _ = guarded(|| {
            drop(self.db);
            Ok(())
        });
    }

    /// The places under `key`, if they are all there and are what the key says.
    pub fn load(&self, key: &ContentHash, count: u32, segments: &[ContentHash]) -> Option<Vec<Location>> {
        let pages = guarded(|| {
            let mut pages = Vec::with_capacity(count as usize);
            for entry in self.db.scan_prefix(&key.0[..16]) {
                pages.push(location_of(&entry?.1));
            }
            Ok(pages)
        });
        let pages: Vec<Location> = pages.ok()?.into_iter().collect::<Option<_>>()?;
        (pages.len() == count as usize && digest(&pages, segments) == *key).then_some(pages)
    }

    /// Stores a version's places.
    pub fn store(&self, key: &ContentHash, pages: &[Location]) -> Result<(), String> {
        guarded(|| {
            // In pieces, so that a large version does not become one large log entry.
            for (piece, locations) in pages.chunks(1024).enumerate() {
                let mut batch = sled::Batch::default();
                for (i, location) in locations.iter().enumerate() {
                    batch.insert(&key_of(key, (piece * 1024 + i) as u32), &value_of(location));
                }
                self.db.apply_batch(batch)?;
            }
            self.db.flush().map(|_| ())
        })
    }

    /// Removes the places of versions that are gone.
    pub fn forget(&self, key: &ContentHash) -> Result<(), String> {
        guarded(|| {
            for entry in self.db.scan_prefix(&key.0[..16]).keys() {
                self.db.remove(entry?)?;
            }
            self.db.flush().map(|_| ())
        })
    }
}

/// sled's panics on damaged files become errors like the others.
fn guarded<T>(work: impl FnOnce() -> sled::Result<T>) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(result) => result.map_err(|error| error.to_string()),
        Err(_) => Err("the index library panicked".into()),
    }
}

/// Big-endian page number, so that sled's order is the pages'.
fn key_of(key: &ContentHash, page: u32) -> [u8; KEY_BYTES] {
    let mut bytes = [0; KEY_BYTES];
    bytes[..16].copy_from_slice(&key.0[..16]);
    bytes[16..].copy_from_slice(&page.to_be_bytes());
    bytes
}

fn value_of(location: &Location) -> [u8; VALUE_BYTES] {
    let mut bytes = [0; VALUE_BYTES];
    bytes[..4].copy_from_slice(&location.segment.to_le_bytes());
    bytes[4..8].copy_from_slice(&location.length.to_le_bytes());
    bytes[8..16].copy_from_slice(&location.offset.to_le_bytes());
    bytes[16..].copy_from_slice(&location.checksum.to_le_bytes());
    bytes
}

fn location_of(bytes: &[u8]) -> Option<Location> {
    let bytes: &[u8; VALUE_BYTES] = bytes.try_into().ok()?;
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    let long = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    Some(Location { segment: word(0), length: word(4), offset: long(8), checksum: long(16) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The loss of one key among many is what sled does not tell.
    #[test]
    fn an_index_that_lacks_changes_or_adds_one_entry_is_not_believed() {
        let root = tempfile::tempdir().unwrap();
        let index = Index::open(root.path(), 1 << 20).unwrap();
        let page = |i: u64| Location { segment: 0, offset: 40 * i, length: 40, checksum: i * i };
        let (pages, segments) = ((0..100).map(page).collect::<Vec<_>>(), [ContentHash::of(b"segment")]);
        let key = digest(&pages, &segments);
        index.store(&key, &pages).unwrap();
        assert_eq!(index.load(&key, 100, &segments).as_ref(), Some(&pages));
        assert_eq!(index.load(&key, 99, &segments), None);
        assert_eq!(index.load(&key, 100, &[ContentHash::of(b"another")]), None);
        let entry = key_of(&key, 57);
        let value = index.db.remove(entry).unwrap().unwrap();
        assert_eq!(index.load(&key, 100, &segments), None, "one is missing");
        index.db.insert(entry, &value_of(&page(58))).unwrap();
        assert_eq!(index.load(&key, 100, &segments), None, "one is another's");
        index.db.insert(entry, &value[..23]).unwrap();
        assert_eq!(index.load(&key, 100, &segments), None, "one is cut");
        index.db.insert(entry, value).unwrap();
        index.db.insert(key_of(&key, 100), &value_of(&page(100))).unwrap();
        assert_eq!(index.load(&key, 100, &segments), None, "one is too many");
        index.forget(&key).unwrap();
        index.store(&key, &pages).unwrap();
        assert_eq!(index.load(&key, 100, &segments), Some(pages));
    }
}
