//! Files sent in pieces and kept by the hash of their content: resumable by offset, visible only when whole and right.

use std::fs::{self, File};
use std::path::PathBuf;

use super::disk::{read_file, sync_dir};
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::store::Store;

/// Read at a time where a file is only passed through a hash.
const PIECE_BYTES: usize = 1 << 20;

/// An upload under way; the only one of its hash. Dropping it keeps the bytes, and [`Store::begin_blob`] goes on behind them.
#[derive(Debug)]
pub struct BlobUpload {
    store: Store,
    expected: ContentHash,
    total_bytes: u64,
    path: PathBuf,
    file: File,
    offset: u64,
    hasher: blake3::Hasher,
}

impl BlobUpload {
    /// Bytes that are here; the next chunk starts there.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Bytes that were announced.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes
    }

    /// Takes the chunk that starts at `offset`; returns the next offset. After an error nothing of the chunk was taken.
    pub fn write(&mut self, offset: u64, bytes: &[u8]) -> Result<u64, StoreError> {
        if offset != self.offset {
            return Err(StoreError::WrongOffset { expected: self.offset, got: offset });
        }
        let end = offset.saturating_add(bytes.len() as u64);
        if end > self.total_bytes {
            return Err(StoreError::WrongLength { expected: self.total_bytes, got: end });
        }
        let disk = self.store.disk();
        if let Err(error) = disk.write_at(&self.file, bytes, offset).at("write", &self.path) {
            let _ = disk.set_len(&self.file, offset);
            return Err(error);
        }
        self.hasher.update(bytes);
        self.offset = end;
        Ok(end)
    }

    /// Checks the hash and keeps the blob. Content with another hash is discarded, and the upload starts from nothing again.
    pub fn finish(self) -> Result<ContentHash, StoreError> {
        if self.offset != self.total_bytes {
            return Err(StoreError::WrongLength { expected: self.total_bytes, got: self.offset });
        }
        let disk = self.store.disk();
        let actual = ContentHash(*self.hasher.finalize().as_bytes());
        if actual != self.expected {
            disk.remove_file(&self.path).at("remove", &self.path)?;
            return Err(StoreError::WrongHash { expected: self.expected, actual });
        }
        disk.sync(&self.file).at("sync", &self.path)?;
        let kept = self.store.folders().upload(&self.expected);
        disk.rename(&self.path, &kept).at("rename", &kept)?;
        sync_dir(disk, &self.store.folders().uploads)?;
        Ok(self.expected)
    }

    /// Throws away what was received.
    pub fn abandon(self) -> Result<(), StoreError> {
        self.store.disk().remove_file(&self.path).at("remove", &self.path)
    }

    /// Hashes what an earlier connection left; what is longer than announced cannot be a part of it.
    fn resume(&mut self) -> Result<(), StoreError> {
        let disk = self.store.disk();
        let mut left = self.file.metadata().at("inspect", &self.path)?.len();
        if left > self.total_bytes {
            disk.set_len(&self.file, 0).at("truncate", &self.path)?;
            left = 0;
        }
        let mut piece = vec![0; PIECE_BYTES];
        while self.offset < left {
            let bytes = &mut piece[..(left - self.offset).min(PIECE_BYTES as u64) as usize];
            disk.read_at(&self.file, bytes, self.offset).at("read", &self.path)?;
            self.hasher.update(bytes);
            self.offset += bytes.len() as u64;
        }
        Ok(())
    }
}

impl Drop for BlobUpload {
    fn drop(&mut self) {
        self.store.catalog().uploading.remove(&self.expected);
    }
}

impl Store {
    /// Starts or resumes an upload of `total_bytes` with this content. `AlreadyExists` if it is here, `Busy` if it is just being sent.
    pub fn begin_blob(&self, expected: ContentHash, total_bytes: u64) -> Result<BlobUpload, StoreError> {
        if self.folders().upload(&expected).exists() {
            return Err(StoreError::AlreadyExists { what: format!("blob {expected}") });
        }
        if !self.catalog().uploading.insert(expected) {
            return Err(StoreError::Busy { what: format!("blob {expected} is being uploaded") });
        }
        let path = self.folders().partial.join(expected.to_string());
        let opened = self.disk().open_writable(&path).at("create", &path);
        let file = opened.inspect_err(|_| {
            self.catalog().uploading.remove(&expected);
        })?;
        let mut upload = BlobUpload { store: self.clone(), expected, total_bytes, path, file, offset: 0, hasher: blake3::Hasher::new() };
        upload.resume()?;
        Ok(upload)
    }

    /// Keeps `bytes` as an uploaded blob; nothing happens if it is here already.
    pub fn put_upload(&self, bytes: &[u8]) -> Result<ContentHash, StoreError> {
        let hash = ContentHash::of(bytes);
        if self.folders().upload(&hash).exists() {
            return Ok(hash);
        }
        let mut upload = self.begin_blob(hash, bytes.len() as u64)?;
        let offset = upload.offset();
        upload.write(offset, &bytes[offset as usize..])?;
        upload.finish()
    }

    /// Removes an uploaded blob; nothing happens if there is none. What versions hold of the same content stays.
    pub fn remove_upload(&self, hash: &ContentHash) -> Result<(), StoreError> {
        let path = self.folders().upload(hash);
        match self.disk().remove_file(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
            removed => removed.at("remove", &path),
        }
    }

    /// Whether content with this hash is here: an upload, a version's blob or a segment.
    pub fn has_blob(&self, hash: &ContentHash) -> bool {
        self.content_path(hash).is_some()
    }

    /// Its length.
    pub fn blob_bytes(&self, hash: &ContentHash) -> Result<u64, StoreError> {
        let path = self.existing(hash)?;
        Ok(fs::metadata(&path).at("inspect", &path)?.len())
    }

    /// The whole content, checked against its hash.
    pub fn read_blob(&self, hash: &ContentHash) -> Result<Vec<u8>, StoreError> {
        let path = self.existing(hash)?;
        let bytes = read_file(&path)?;
        if ContentHash::of(&bytes) == *hash {
            return Ok(bytes);
        }
        Err(StoreError::DamagedFile { reason: "content does not have the hash in its name".into(), path })
    }

    /// Up to `length` bytes from `offset` on; fewer at the end, none behind it. Not checked: who fetches the whole checks the hash.
    pub fn read_blob_range(&self, hash: &ContentHash, offset: u64, length: usize) -> Result<Vec<u8>, StoreError> {
        let path = self.existing(hash)?;
        let file = File::open(&path).at("open", &path)?;
        let left = file.metadata().at("inspect", &path)?.len().saturating_sub(offset);
        let mut bytes = vec![0; left.min(length as u64) as usize];
        self.disk().read_at(&file, &mut bytes, offset).at("read", &path)?;
        Ok(bytes)
    }

    fn existing(&self, hash: &ContentHash) -> Result<PathBuf, StoreError> {
        self.content_path(hash).ok_or_else(|| StoreError::NotFound { what: format!("blob {hash}") })
    }

    fn content_path(&self, hash: &ContentHash) -> Option<PathBuf> {
        let folders = self.folders();
        [folders.upload(hash), folders.blob(hash), folders.segment(hash)].into_iter().find(|path| path.exists())
    }
}
