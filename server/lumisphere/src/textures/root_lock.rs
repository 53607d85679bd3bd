//! One process has a store open: the lock on its folder's file `lock`, for `store`.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::error::{At, StoreError};

/// Held until it is dropped, or the process ends, however it ends.
#[derive(Debug)]
pub(super) struct RootLock(File);

impl RootLock {
    /// `Busy` if another has the store open.
    pub fn take(root: &Path) -> Result<Self, StoreError> {
        let path = root.join("lock");
        let file = File::options().write(true).create(true).truncate(false).open(&path).at("create", &path)?;
        match file.try_lock() {
            Ok(()) => Ok(Self(file)),
            Err(TryLockError::WouldBlock) => {
                Err(StoreError::Busy { what: format!("another process has the store open: {}", root.display()) })
            }
            Err(TryLockError::Error(error)) => Err(error).at("lock", &path),
        }
    }
}

impl Drop for RootLock {
    fn drop(&mut self) {
        // Closing the file would not do: a process that is being started at this moment has a copy of every open file, the lock with it.
        let _ = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_that_is_let_go_is_free_although_a_copy_of_its_file_is_open() {
        let root = tempfile::tempdir().unwrap();
        let lock = RootLock::take(root.path()).unwrap();
        let copy = lock.0.try_clone().unwrap();
        assert!(matches!(RootLock::take(root.path()), Err(StoreError::Busy { .. })));
        drop(lock);
        assert!(RootLock::take(root.path()).is_ok());
        drop(copy);
    }
}
