//! Files that appear whole or not at all.

use std::fs::{self, Permissions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::exit::Failure;

/// What to do with a file that exists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Existing {
    /// Fail (exit code 7).
    Keep,
    /// Overwrite (`--force`).
    Replace,
}

impl Existing {
    /// As `--force` says.
    pub fn from_force(force: bool) -> Self {
        if force { Self::Replace } else { Self::Keep }
    }
}

/// Makes the folder and checks, before any work, that none of the names exists in it.
pub fn prepare_folder(folder: &Path, names: impl IntoIterator<Item = String>, existing: Existing) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    if existing == Existing::Replace {
        return Ok(());
    }
    match names.into_iter().map(|name| folder.join(name)).find(|path| path.exists()) {
        Some(path) => Err(exists(&path).into()),
        None => Ok(()),
    }
}

/// Writes beside the place and renames: a reader sees the old file, none, or the whole new one.
pub fn write_atomically(path: &Path, bytes: &[u8], existing: Existing) -> anyhow::Result<()> {
    let growing = Growing::beside(path, existing)?;
    (&growing.part).write_all(bytes).with_context(|| cannot_write(path))?;
    growing.finish()
}

/// A file that is written bit by bit and appears when it is whole; dropped before, it leaves nothing.
pub struct Growing {
    part: tempfile::NamedTempFile,
    path: PathBuf,
    existing: Existing,
}

impl Growing {
    /// Refuses, before any work, what `existing` forbids.
    pub fn create(path: &Path, existing: Existing) -> anyhow::Result<Self> {
        if existing == Existing::Keep && path.exists() {
            return Err(exists(path).into());
        }
        Self::beside(path, existing)
    }

    fn beside(path: &Path, existing: Existing) -> anyhow::Result<Self> {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let mut builder = tempfile::Builder::new();
        builder.prefix(".lumisphere-").suffix(".part");
        readable_by_others(&mut builder);
        let part = builder.tempfile_in(folder).with_context(|| cannot_write(path))?;
        Ok(Self { part, path: path.to_path_buf(), existing })
    }

    /// What to write to, from another thread, too.
    pub fn writer(&self) -> anyhow::Result<fs::File> {
        self.part.as_file().try_clone().with_context(|| cannot_write(&self.path))
    }

    /// All is written: the file appears.
    pub fn finish(self) -> anyhow::Result<()> {
        let Self { part, path, existing } = self;
        match existing {
            Existing::Replace => part.persist(&path).map_err(|e| e.error).with_context(|| cannot_write(&path))?,
            Existing::Keep => part.persist_noclobber(&path).map_err(|e| match e.error.kind() {
                std::io::ErrorKind::AlreadyExists => anyhow::Error::from(exists(&path)),
                _ => anyhow::Error::from(e.error).context(cannot_write(&path)),
            })?,
        };
        Ok(())
    }
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write {}", path.display())
}

/// A temporary file is private by default; a result is as open as the user's mask allows.
#[cfg(unix)]
fn readable_by_others(builder: &mut tempfile::Builder<'_, '_>) {
    use std::os::unix::fs::PermissionsExt;
    builder.permissions(Permissions::from_mode(0o666));
}

#[cfg(not(unix))]
fn readable_by_others(_builder: &mut tempfile::Builder<'_, '_>) {
    let _: Option<Permissions> = None;
}

fn exists(path: &Path) -> Failure {
    Failure::Precondition(format!("{} exists; --force overwrites", path.display()))
}

/// A name that the server gave, as a file name: no folder, nothing hidden.
pub fn safe_name(name: &str) -> anyhow::Result<&str> {
    let is_plain = !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\\', '\0']);
    anyhow::ensure!(is_plain, "the server names a file {name:?}, a plain name expected");
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_existing_file_is_kept_unless_forced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frame.png");
        write_atomically(&path, b"one", Existing::Keep).unwrap();
        let error = write_atomically(&path, b"two", Existing::Keep).unwrap_err();
        assert_eq!((crate::exit::code(&error), fs::read(&path).unwrap()), (7, b"one".to_vec()));
        write_atomically(&path, b"two", Existing::Replace).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "a temporary file is left");
    }

    #[test]
    fn a_growing_file_appears_when_it_is_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.y4m");
        let names = || fs::read_dir(folder.path()).unwrap().count();
        let begin = || {
            let growing = Growing::create(&path, Existing::Keep).unwrap();
            growing.writer().unwrap().write_all(b"half").unwrap();
            assert!(!path.exists());
            growing
        };
        drop(begin());
        assert_eq!(names(), 0, "a temporary file is left");
        begin().finish().unwrap();
        assert_eq!((fs::read(&path).unwrap(), names()), (b"half".to_vec(), 1));
        assert_eq!(Growing::create(&path, Existing::Keep).map(drop).map_err(|e| crate::exit::code(&e)), Err(7));
    }

    #[test]
    fn a_name_from_the_server_cannot_leave_the_folder() {
        for bad in ["../x", "a/b", "", ".hidden", "a\\b"] {
            assert!(safe_name(bad).is_err(), "{bad:?}");
        }
        assert!(safe_name("error-00000.png").is_ok());
    }
}
