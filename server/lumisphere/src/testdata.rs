//! What tests of several modules share: the data pack, which tests pass without, and statistics.

pub mod chi_squared;

use std::path::{Path, PathBuf};

/// Path inside the data pack (`$LUMISPHERE_SHARED_DATA`, else `../shared/data` beside the repository); None when it is not there.
pub fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("LUMISPHERE_SHARED_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"));
    let found = root.join(path);
    found.exists().then_some(found)
}
