//! Downloads that were interrupted: `.part` beside the file goes on where it ends, and wrong bytes never get the file's name.

use std::fs;
use std::path::{Path, PathBuf};

use crate::process::{Server, temporary_folder};

/// Three chunks of the wire, no two alike.
fn bytes() -> Vec<u8> {
    (0..(5u32 << 19)).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

/// A server that has the bytes, their hash, and where they are to go.
struct Place {
    server: Server,
    blake3: String,
    file: PathBuf,
    part: PathBuf,
    _folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let folder = temporary_folder();
        let server = Server::start(&folder.path().join("data"));
        let source = folder.path().join("source.bin");
        fs::write(&source, bytes()).unwrap();
        let uploaded = server.json(&["blob", "upload", source.to_str().unwrap(), "--quiet"]);
        let blake3 = uploaded["blake3"].as_str().unwrap().into();
        let at = |name: &str| folder.path().join(name);
        Self { server, blake3, file: at("copy.bin"), part: at("copy.bin.part"), _folder: folder }
    }

    /// The command's exit code.
    fn download(&self) -> Option<i32> {
        self.server.lumisphere(&["blob", "download", &self.blake3, "--out", text(&self.file), "--quiet"]).status.code()
    }

    fn assert_whole(&self, what: &str) {
        assert!(fs::read(&self.file).unwrap() == bytes(), "{what}: other bytes");
        assert!(!self.part.exists(), "{what}: the part is left");
        fs::remove_file(&self.file).unwrap();
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_download_goes_on_from_its_part_whatever_its_length() {
    let place = Place::new();
    let whole = bytes();
    let longer = [&whole[..], b"more"].concat();
    for (what, part) in [("half", &whole[..whole.len() / 2]), ("nothing", &[]), ("all", &whole), ("more than all", &longer)] {
        fs::write(&place.part, part).unwrap();
        assert_eq!(place.download(), Some(0), "{what}");
        place.assert_whole(what);
    }
}

#[test]
fn a_part_of_other_bytes_is_discarded_with_an_error_and_the_next_run_succeeds() {
    let place = Place::new();
    let mut wrong = bytes();
    wrong.truncate(wrong.len() / 2);
    wrong[1000] ^= 1;
    fs::write(&place.part, wrong).unwrap();
    // Had it not gone on from the part, it would have succeeded.
    assert_eq!(place.download(), Some(1));
    assert!(!place.file.exists() && !place.part.exists(), "wrong bytes are left");
    assert_eq!(place.download(), Some(0));
    place.assert_whole("after the error");
}
