//! What tests of several modules share: data of the library's own, the data pack, which tests pass without, and statistics.

pub mod chi_squared;
pub mod golden;

use std::io::Write;
use std::path::{Path, PathBuf};

/// Path inside the library's own `data/`, which is always there.
pub fn shipped(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(path)
}

/// Path inside the data pack (`$LUMISPHERE_SHARED_DATA`, else `../shared/data` beside the repository). None when it is not there, which is
/// said in a line, and which `REQUIRE_DATA=1` forbids.
pub fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("LUMISPHERE_SHARED_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"));
    let found = root.join(path);
    if found.exists() {
        return Some(found);
    }
    assert!(std::env::var_os("REQUIRE_DATA").is_none_or(|v| v != "1"), "no {path} in the data pack, and REQUIRE_DATA=1");
    let thread = std::thread::current();
    // Not `eprintln!`, which the harness keeps to itself when a test passes.
    let _ = writeln!(std::io::stderr(), "skipped {}: no {path} in the data pack", thread.name().unwrap_or("a test"));
    None
}
