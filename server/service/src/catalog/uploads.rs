//! Blobs coming in, in chunks: many at once, each in order, all bounded.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use lumisphere::textures::{BlobUpload, ContentHash, Store, StoreError};

use crate::errors::{ApiError, Reason};
use crate::wire::MAX_CHUNK_BYTES;

/// Uploads under way at once; each holds a file open.
const MAX_UNFINISHED: usize = 256;

/// Bounds on what clients may send.
#[derive(Debug, Clone, Copy)]
pub struct UploadLimits {
    /// Of one blob.
    pub blob_bytes: u64,
    /// Announced by all that are unfinished.
    pub unfinished_bytes: u64,
}

/// How far an upload is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// The next chunk starts there.
    pub offset: u64,
    /// Verified and visible.
    pub complete: bool,
}

/// The uploads under way.
pub struct Uploads {
    store: Store,
    limits: UploadLimits,
    unfinished: Mutex<HashMap<ContentHash, Arc<Unfinished>>>,
}

struct Unfinished {
    total_bytes: u64,
    /// None once finished, or discarded for its wrong hash.
    upload: Mutex<Option<BlobUpload>>,
    used: Mutex<Instant>,
}

impl Uploads {
    /// None yet.
    pub fn new(store: Store, limits: UploadLimits) -> Self {
        Self { store, limits, unfinished: Mutex::default() }
    }

    /// Announces a blob, or finds how far it is.
    pub fn begin(&self, hash: ContentHash, total_bytes: u64) -> Result<Progress, ApiError> {
        if total_bytes > self.limits.blob_bytes {
            let message = format!("{total_bytes} bytes, a blob has at most {}", self.limits.blob_bytes);
            return Err(ApiError::new(Reason::UploadTooLarge, message).with("max_blob_bytes", self.limits.blob_bytes));
        }
        if self.store.has_blob(&hash) {
            return self.held(hash, total_bytes);
        }
        let mut all = self.lock();
        if let Some(known) = all.get(&hash) {
            return known.progress(total_bytes);
        }
        self.make_room(&mut all, total_bytes)?;
        let upload = match self.store.begin_blob(hash, total_bytes) {
            Err(StoreError::AlreadyExists { .. }) => return self.held(hash, total_bytes),
            result => result?,
        };
        let offset = upload.offset();
        if offset == total_bytes {
            // Everything arrived before the last run ended, or there is nothing to send.
            upload.finish()?;
            return Ok(Progress { offset, complete: true });
        }
        let unfinished = Unfinished { total_bytes, upload: Mutex::new(Some(upload)), used: Mutex::new(Instant::now()) };
        all.insert(hash, Arc::new(unfinished));
        Ok(Progress { offset, complete: false })
    }

    /// Takes the next chunk; the last one makes the blob visible if its hash is right.
    pub fn put(&self, hash: ContentHash, offset: u64, data: &[u8]) -> Result<Progress, ApiError> {
        if data.len() > MAX_CHUNK_BYTES {
            return Err(ApiError::field("data", format!("{} bytes, at most {MAX_CHUNK_BYTES} expected", data.len())));
        }
        let known = self.lock().get(&hash).cloned();
        let Some(known) = known else {
            return match self.store.blob_bytes(&hash) {
                // Sent twice: the answer to the last chunk was lost.
                Ok(bytes) if offset.saturating_add(data.len() as u64) <= bytes => Ok(Progress { offset: bytes, complete: true }),
                _ => Err(ApiError::new(Reason::UploadNotBegun, format!("the upload of {hash} was not begun, or was forgotten: begin it"))),
            };
        };
        let mut upload = known.upload.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(current) = upload.as_mut() else {
            return Err(ApiError::new(Reason::UploadNotBegun, format!("the upload of {hash} has ended: begin it again")));
        };
        *known.used.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
        let next = current.write(offset, data)?;
        if next < known.total_bytes {
            return Ok(Progress { offset: next, complete: false });
        }
        let finished = upload.take().map(BlobUpload::finish);
        drop(upload);
        self.lock().remove(&hash);
        match finished {
            Some(Err(error)) => Err(error.into()),
            _ => Ok(Progress { offset: next, complete: true }),
        }
    }

    /// How far an upload is that may have ended.
    pub fn progress(&self, hash: ContentHash) -> Result<Progress, ApiError> {
        let known = self.lock().get(&hash).cloned();
        match known {
            Some(known) => known.progress(known.total_bytes),
            None => Ok(Progress { offset: self.store.blob_bytes(&hash)?, complete: true }),
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<ContentHash, Arc<Unfinished>>> {
        self.unfinished.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A blob that is here, if it has the announced length.
    fn held(&self, hash: ContentHash, total_bytes: u64) -> Result<Progress, ApiError> {
        let bytes = self.store.blob_bytes(&hash)?;
        match bytes == total_bytes {
            true => Ok(Progress { offset: bytes, complete: true }),
            false => Err(ApiError::field("total_bytes", format!("{total_bytes}, but the content with this hash has {bytes}"))),
        }
    }

    /// Gives up the uploads that were idle longest until another of `total_bytes` fits; what was received of them goes too.
    fn make_room(&self, all: &mut HashMap<ContentHash, Arc<Unfinished>>, total_bytes: u64) -> Result<(), ApiError> {
        loop {
            let announced: u64 = all.values().map(|u| u.total_bytes).sum();
            if all.len() < MAX_UNFINISHED && announced.saturating_add(total_bytes) <= self.limits.unfinished_bytes {
                return Ok(());
            }
            let idle = all.iter().filter(|(_, u)| u.idle_seconds() >= IDLE_SECONDS).max_by_key(|(_, u)| u.idle_seconds());
            let Some(hash) = idle.map(|(hash, _)| *hash) else {
                let message =
                    format!("unfinished uploads of {announced} bytes are under way, at most {} allowed", self.limits.unfinished_bytes);
                return Err(ApiError::new(Reason::UploadTooLarge, message));
            };
            let dropped = all.remove(&hash);
            if let Some(upload) = dropped.and_then(|u| u.upload.lock().unwrap_or_else(PoisonError::into_inner).take()) {
                upload.abandon()?;
            }
        }
    }
}

/// An upload without a chunk for so long makes room for others when there is need.
const IDLE_SECONDS: u64 = 300;

impl Unfinished {
    fn progress(&self, total_bytes: u64) -> Result<Progress, ApiError> {
        if total_bytes != self.total_bytes {
            let problem = format!("{total_bytes}, but the upload was begun with {}", self.total_bytes);
            return Err(ApiError::field("total_bytes", problem));
        }
        let upload = self.upload.lock().unwrap_or_else(PoisonError::into_inner);
        let offset = upload.as_ref().map_or(total_bytes, BlobUpload::offset);
        Ok(Progress { offset, complete: upload.is_none() })
    }

    fn idle_seconds(&self) -> u64 {
        self.used.lock().unwrap_or_else(PoisonError::into_inner).elapsed().as_secs()
    }
}

#[cfg(test)]
mod tests {
    use lumisphere::textures::StoreOptions;

    use super::*;

    fn uploads(folder: &tempfile::TempDir) -> Uploads {
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        Uploads::new(store, UploadLimits { blob_bytes: 1000, unfinished_bytes: 1500 })
    }

    const HALF: Progress = Progress { offset: 3, complete: false };
    const WHOLE: Progress = Progress { offset: 6, complete: true };

    #[test]
    fn chunks_in_order_make_a_blob_and_a_repeated_last_one_is_no_error() {
        let folder = tempfile::tempdir().unwrap();
        let uploads = uploads(&folder);
        let hash = ContentHash::of(b"abcdef");
        assert_eq!(uploads.put(hash, 0, b"abc").unwrap_err().reason(), Reason::UploadNotBegun);
        assert_eq!(uploads.begin(hash, 6).unwrap(), Progress { offset: 0, complete: false });
        assert_eq!(uploads.put(hash, 0, b"abc").unwrap(), HALF);
        assert_eq!(uploads.begin(hash, 6).unwrap(), HALF);
        let order = uploads.put(hash, 0, b"abc").unwrap_err();
        assert_eq!(order.reason(), Reason::ChunkOutOfOrder);
        assert_eq!(uploads.put(hash, 3, b"def").unwrap(), WHOLE);
        assert_eq!(uploads.put(hash, 3, b"def").unwrap(), WHOLE);
        assert_eq!(uploads.begin(hash, 6).unwrap(), WHOLE);
        assert_eq!(uploads.begin(hash, 7).unwrap_err().reason(), Reason::FieldInvalid);
    }

    #[test]
    fn an_upload_goes_on_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let hash = ContentHash::of(b"abcdef");
        {
            let uploads = uploads(&folder);
            uploads.begin(hash, 6).unwrap();
            uploads.put(hash, 0, b"abc").unwrap();
        }
        let uploads = uploads(&folder);
        assert_eq!(uploads.begin(hash, 6).unwrap(), HALF);
        assert_eq!(uploads.put(hash, 3, b"def").unwrap(), WHOLE);
    }

    #[test]
    fn wrong_bytes_too_many_bytes_and_too_large_blobs_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let uploads = uploads(&folder);
        let hash = ContentHash::of(b"abcdef");
        uploads.begin(hash, 6).unwrap();
        assert_eq!(uploads.put(hash, 0, b"abcdefg").unwrap_err().reason(), Reason::FieldInvalid);
        assert_eq!(uploads.put(hash, 0, b"abcdeX").unwrap_err().reason(), Reason::BlobHashMismatch);
        assert_eq!(uploads.put(hash, 0, b"abcdef").unwrap_err().reason(), Reason::UploadNotBegun);
        assert_eq!(uploads.begin(hash, 6).unwrap(), Progress { offset: 0, complete: false });
        assert_eq!(uploads.put(hash, 0, &vec![0; MAX_CHUNK_BYTES + 1]).unwrap_err().reason(), Reason::FieldInvalid);
        assert_eq!(uploads.begin(ContentHash::of(b"x"), 1001).unwrap_err().reason(), Reason::UploadTooLarge);
    }

    #[test]
    fn all_unfinished_uploads_together_are_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let uploads = uploads(&folder);
        uploads.begin(ContentHash::of(b"x"), 1000).unwrap();
        assert_eq!(uploads.begin(ContentHash::of(b"y"), 501).unwrap_err().reason(), Reason::UploadTooLarge);
        uploads.begin(ContentHash::of(b"y"), 500).unwrap();
    }

    #[test]
    fn a_blob_without_bytes_is_complete_when_begun() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(uploads(&folder).begin(ContentHash::of(b""), 0).unwrap(), Progress { offset: 0, complete: true });
    }
}
