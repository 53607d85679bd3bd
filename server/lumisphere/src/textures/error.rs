//! What can go wrong in the store, by what the caller can do about it.

use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::hash::ContentHash;
use super::page::PageId;

/// The store's only error. Cheap to clone, since every reader that waited on one failed read gets it.
#[derive(Debug, Clone, thiserror::Error)]
pub enum StoreError {
    /// No such dataset, version, page or blob.
    #[error("not found: {what}")]
    NotFound {
        /// "dataset gazebo", "page 7 of gazebo version 2".
        what: String,
    },
    /// The name or content is there already.
    #[error("already exists: {what}")]
    AlreadyExists {
        /// "dataset gazebo", "page 7".
        what: String,
    },
    /// The job's earlier run got as far as publishing: there is nothing left to resume.
    #[error("already published as version {version} of dataset {dataset}")]
    AlreadyPublished {
        /// Dataset's name.
        dataset: String,
        /// The version that holds the work.
        version: u64,
    },
    /// Someone else is writing it; try again when they have finished.
    #[error("busy: {what}")]
    Busy {
        /// "dataset gazebo is being written".
        what: String,
    },
    /// Names are a lower-case letter or digit followed by up to 62 of `a-z 0-9 . _ -`.
    #[error("invalid name {name:?}: a lower-case letter or digit, then at most 62 of a-z 0-9 . _ -")]
    InvalidName {
        /// As given.
        name: String,
    },
    /// A page's shape or texel count that cannot be stored.
    #[error("invalid page: {reason}")]
    InvalidPage {
        /// What was expected.
        reason: String,
    },
    /// Publishing needs pages 0…n−1 without a hole.
    #[error("incomplete: page {missing} is missing below page {last}")]
    Incomplete {
        /// First missing page.
        missing: PageId,
        /// Highest page present.
        last: PageId,
    },
    /// Stored texels fail their checksum. Other rows and pages can still be read.
    #[error("damaged page {page}, rows {} to {}: {reason}: {}", rows.start, rows.end, path.display())]
    DamagedPage {
        /// Which page.
        page: PageId,
        /// Rows that cannot be read, end exclusive.
        rows: Range<u32>,
        /// What does not agree.
        reason: &'static str,
        /// The segment.
        path: PathBuf,
    },
    /// A manifest, blob or staging file is not what was written.
    #[error("damaged file: {reason}: {}", path.display())]
    DamagedFile {
        /// What does not agree.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// A chunk of an upload does not start where the last one ended.
    #[error("chunk starts at byte {got}, expected {expected}")]
    WrongOffset {
        /// Next byte wanted.
        expected: u64,
        /// Where the chunk starts.
        got: u64,
    },
    /// More bytes than were announced.
    #[error("{got} bytes where {expected} were announced")]
    WrongLength {
        /// Announced.
        expected: u64,
        /// Received, or about to be.
        got: u64,
    },
    /// Content does not have the hash that was announced; what was received is discarded.
    #[error("content has hash {actual}, expected {expected}")]
    WrongHash {
        /// Announced.
        expected: ContentHash,
        /// Of the bytes received.
        actual: ContentHash,
    },
    /// No space left. Nothing is lost: make room and resume.
    #[error("disk full: {}", path.display())]
    DiskFull {
        /// What was being written.
        path: PathBuf,
    },
    /// Any other failure of the file system.
    #[error("cannot {action}: {source}: {}", path.display())]
    Io {
        /// "read", "rename".
        action: &'static str,
        /// The operating system's reason.
        source: Arc<io::Error>,
        /// What was acted on.
        path: PathBuf,
    },
}

/// Names the file and the action in an I/O error.
pub(super) trait At<T> {
    fn at(self, action: &'static str, path: &Path) -> Result<T, StoreError>;
}

impl<T> At<T> for io::Result<T> {
    fn at(self, action: &'static str, path: &Path) -> Result<T, StoreError> {
        self.map_err(|source| match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => StoreError::DiskFull { path: path.into() },
            _ => StoreError::Io { action, source: Arc::new(source), path: path.into() },
        })
    }
}
