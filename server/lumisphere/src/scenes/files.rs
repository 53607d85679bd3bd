//! Where a scene's files come from: a folder that cannot be left, or a bundle in memory (scenes that clients upload).
//!
//! Paths are relative to the scene, separated by `/`. Absolute paths, `..`, and links that lead out of the folder are refused,
//! so that a scene written by somebody else can read nothing but its own files.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use thiserror::Error;

/// Gives a scene's files by path.
pub trait SceneFiles: Sync {
    /// The whole file. `path`: relative to the scene's folder, separated by `/`.
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError>;
}

/// Why a file could not be had.
#[derive(Debug, Error)]
pub enum FileError {
    /// Absolute, contains `..`, or something else that no scene file needs.
    #[error("path may not leave the scene's folder, a relative path of names separated by / expected: {path:?}")]
    Outside {
        /// As the scene names it.
        path: String,
    },
    /// No such file.
    #[error("no such file: {path}")]
    Missing {
        /// As the scene names it.
        path: String,
    },
    /// Beyond the limit.
    #[error("file has more than {limit_bytes} bytes: {path}")]
    TooLarge {
        /// As the scene names it.
        path: String,
        /// What is accepted.
        limit_bytes: u64,
    },
    /// The operating system says no.
    #[error("{source}: {path}")]
    Io {
        /// As the scene names it.
        path: String,
        /// Why.
        source: std::io::Error,
    },
}

/// Largest scene file read by default: room for a large mesh, far below what could exhaust a server.
pub const DEFAULT_FILE_LIMIT_BYTES: u64 = 1 << 30;

/// Files below one folder.
#[derive(Debug, Clone)]
pub struct SceneFolder {
    root: PathBuf,
    limit_bytes: u64,
}

/// Files in memory, by normalised path.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneBundle {
    /// Path → contents; paths as `normalised` gives them.
    pub files: BTreeMap<String, Vec<u8>>,
}

/// Passes files on and remembers which were asked for.
pub(super) struct Recorder<'a> {
    inner: &'a dyn SceneFiles,
    read: Mutex<BTreeMap<String, Vec<u8>>>,
}

impl SceneFolder {
    /// The folder must exist. `limit_bytes` bounds every single file.
    pub fn open(root: &Path, limit_bytes: u64) -> Result<Self, FileError> {
        let root = root.canonicalize().map_err(|source| FileError::Io { path: root.display().to_string(), source })?;
        Ok(Self { root, limit_bytes })
    }
}

impl SceneFiles for SceneFolder {
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError> {
        let path = normalised(path)?;
        let io = |source: std::io::Error| match source.kind() {
            std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory => FileError::Missing { path: path.clone() },
            _ => FileError::Io { path: path.clone(), source },
        };
        // Resolved before it is opened: a link may point anywhere inside the folder, but not out of it.
        let resolved = self.root.join(&path).canonicalize().map_err(io)?;
        if !resolved.starts_with(&self.root) {
            return Err(FileError::Outside { path });
        }
        if !resolved.metadata().map_err(io)?.is_file() {
            return Err(FileError::Missing { path });
        }
        let mut bytes = Vec::new();
        std::fs::File::open(&resolved).map_err(io)?.take(self.limit_bytes + 1).read_to_end(&mut bytes).map_err(io)?;
        if bytes.len() as u64 > self.limit_bytes {
            return Err(FileError::TooLarge { path, limit_bytes: self.limit_bytes });
        }
        Ok(bytes)
    }
}

impl SceneBundle {
    /// Adds a file, replacing one of the same path.
    pub fn insert(&mut self, path: &str, bytes: Vec<u8>) -> Result<(), FileError> {
        self.files.insert(normalised(path)?, bytes);
        Ok(())
    }
}

impl SceneFiles for SceneBundle {
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError> {
        let path = normalised(path)?;
        self.files.get(&path).cloned().ok_or(FileError::Missing { path })
    }
}

impl<'a> Recorder<'a> {
    pub fn new(inner: &'a dyn SceneFiles) -> Self {
        Self { inner, read: Mutex::default() }
    }

    pub fn into_bundle(self) -> SceneBundle {
        SceneBundle { files: self.read.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()) }
    }
}

impl SceneFiles for Recorder<'_> {
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError> {
        let bytes = self.inner.read(path)?;
        self.read.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).insert(normalised(path)?, bytes.clone());
        Ok(bytes)
    }
}

/// The path without `.` and doubled separators. Errors for what leaves the folder on any platform: absolute, `..`, backslash,
/// drive letter, NUL.
pub fn normalised(path: &str) -> Result<String, FileError> {
    let outside = || FileError::Outside { path: path.to_owned() };
    if path.starts_with('/') || path.contains(['\\', ':', '\0']) {
        return Err(outside());
    }
    let names: Vec<&str> = path.split('/').filter(|n| !n.is_empty() && *n != ".").collect();
    if names.is_empty() || names.contains(&"..") {
        return Err(outside());
    }
    Ok(names.join("/"))
}

/// `path` as named inside the file `beside`.
pub(super) fn sibling(beside: &str, path: &str) -> String {
    match beside.rsplit_once('/') {
        // A path that is refused must stay refused: it may not become harmless by what is put before it.
        Some((folder, _)) if !path.starts_with('/') => format!("{folder}/{path}"),
        _ => path.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_that_leaves_the_folder_is_refused_in_every_spelling() {
        for path in ["/etc/passwd", "../a", "a/../../b", "a/..", "..\\a", "C:/a", "a\0b", "", ".", "//x"] {
            assert!(matches!(normalised(path), Err(FileError::Outside { .. })), "{path:?}");
            assert!(normalised(&sibling("sub/scene.json", path)).is_err() || path.is_empty() || path == ".", "{path:?}");
        }
        assert_eq!(normalised("./a//b.obj").unwrap(), "a/b.obj");
        assert_eq!(sibling("sub/scene.json", "b.obj"), "sub/b.obj");
    }

    #[test]
    fn a_folder_gives_its_own_files_and_nothing_else() {
        let outer = tempfile::tempdir().unwrap();
        let root = outer.path().join("scene");
        std::fs::create_dir_all(root.join("meshes")).unwrap();
        std::fs::write(root.join("meshes/a.obj"), b"twelve bytes").unwrap();
        std::fs::write(outer.path().join("secret"), b"x").unwrap();
        let folder = SceneFolder::open(&root, 12).unwrap();
        assert_eq!(folder.read("meshes/a.obj").unwrap(), b"twelve bytes");
        assert!(matches!(folder.read("meshes/b.obj"), Err(FileError::Missing { .. })));
        assert!(matches!(folder.read("meshes"), Err(FileError::Missing { .. })));
        assert!(matches!(folder.read("../secret"), Err(FileError::Outside { .. })));
        assert!(matches!(SceneFolder::open(&root, 11).unwrap().read("meshes/a.obj"), Err(FileError::TooLarge { limit_bytes: 11, .. })));
        assert!(SceneFolder::open(&outer.path().join("absent"), 1).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_link_may_stay_inside_but_not_lead_out() {
        let outer = tempfile::tempdir().unwrap();
        let root = outer.path().join("scene");
        std::fs::create_dir_all(&root).unwrap();
        std::fs::write(root.join("a"), b"inside").unwrap();
        std::fs::write(outer.path().join("secret"), b"outside").unwrap();
        std::os::unix::fs::symlink(outer.path().join("secret"), root.join("out")).unwrap();
        std::os::unix::fs::symlink(root.join("a"), root.join("in")).unwrap();
        let folder = SceneFolder::open(&root, 100).unwrap();
        assert_eq!(folder.read("in").unwrap(), b"inside");
        assert!(matches!(folder.read("out"), Err(FileError::Outside { .. })));
    }
}
