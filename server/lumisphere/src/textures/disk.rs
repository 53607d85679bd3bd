//! The file operations of the store, behind a trait so that a full, failing or slow disk can be put in their place.

use std::fmt::Debug;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use super::error::{At, StoreError};

/// What the store asks of a file system. Every default is the local one; an implementation overrides what it wants to disturb.
/// The index (sled) does its own I/O, since losing it loses nothing.
pub trait Disk: Send + Sync + Debug {
    /// Fills `buffer` from byte `offset` on; `UnexpectedEof` if the file ends before.
    fn read_at(&self, file: &File, buffer: &mut [u8], offset: u64) -> io::Result<()> {
        file.read_exact_at(buffer, offset)
    }
    /// Writes all of `bytes` at `offset`. A failure may leave a part of them there.
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        file.write_all_at(bytes, offset)
    }
    /// Opens for reading and writing; makes the file if it is not there, never empties it.
    fn open_writable(&self, path: &Path) -> io::Result<File> {
        File::options().read(true).write(true).create(true).truncate(false).open(path)
    }
    /// Cuts or extends a file.
    fn set_len(&self, file: &File, bytes: u64) -> io::Result<()> {
        file.set_len(bytes)
    }
    /// Returns once content and metadata of a file or folder would survive a power cut.
    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_all()
    }
    /// Replaces `to` by `from`, at once.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }
    /// A second name for the same file, or a copy where the file system has no links.
    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        match fs::hard_link(from, to) {
            Err(error) if error.kind() == io::ErrorKind::Unsupported => copy_then_rename(from, to),
            result => result,
        }
    }
    /// Removes one file.
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }
    /// Removes a folder and what is in it.
    fn remove_dir_all(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }
    /// Makes a folder and those above it.
    fn create_dir_all(&self, path: &Path) -> io::Result<()> {
        fs::create_dir_all(path)
    }
}

/// A copy that is never seen half-written under its final name.
fn copy_then_rename(from: &Path, to: &Path) -> io::Result<()> {
    let partial = to.with_extension("copying");
    fs::copy(from, &partial)?;
    File::open(&partial)?.sync_all()?;
    fs::rename(&partial, to)
}

/// The machine's own file system.
#[derive(Debug, Clone, Copy)]
pub struct LocalDisk;

impl Disk for LocalDisk {}

/// A local disk on which only so many more bytes may be written: a quota, and the way tests fill a disk.
#[derive(Debug)]
pub struct LimitedDisk {
    free_bytes: AtomicU64,
}

impl LimitedDisk {
    /// `free_bytes` may be written before the disk is full.
    pub fn new(free_bytes: u64) -> Self {
        Self { free_bytes: AtomicU64::new(free_bytes) }
    }

    /// Makes room, or takes it away.
    pub fn set_free_bytes(&self, free_bytes: u64) {
        self.free_bytes.store(free_bytes, Ordering::SeqCst);
    }
}

impl Disk for LimitedDisk {
    fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
        let wanted = bytes.len() as u64;
        let before = self.free_bytes.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |free| Some(free.saturating_sub(wanted)));
        let free = before.unwrap_or_else(|free| free);
        // As a real disk does: what fits is written, then the call fails.
        file.write_all_at(&bytes[..bytes.len().min(free as usize)], offset)?;
        if free < wanted { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
    }
}

/// Makes the entries of a folder durable.
pub(super) fn sync_dir(disk: &dyn Disk, path: &Path) -> Result<(), StoreError> {
    let folder = File::open(path).at("open", path)?;
    disk.sync(&folder).at("sync", path)
}

/// Writes a file so that a crash at any moment leaves the old content or the new, durably.
pub(super) fn write_atomically(disk: &dyn Disk, path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    let partial = path.with_extension("tmp");
    let file = disk.open_writable(&partial).at("create", &partial)?;
    disk.set_len(&file, 0).at("truncate", &partial)?;
    disk.write_at(&file, bytes, 0).at("write", &partial)?;
    disk.sync(&file).at("sync", &partial)?;
    disk.rename(&partial, path).at("rename", path)?;
    path.parent().map_or(Ok(()), |folder| sync_dir(disk, folder))
}

/// A whole file.
pub(super) fn read_file(path: &Path) -> Result<Vec<u8>, StoreError> {
    fs::read(path).at("read", path)
}
