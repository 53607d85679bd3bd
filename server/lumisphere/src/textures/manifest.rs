//! The manifest: all that a dataset version is, in one small file whose appearance publishes it.
//!
//! The file is JSON; its first line holds the BLAKE3 of all that follows the line, so that a changed byte is noticed before
//! anything is believed.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::error::StoreError;
use super::hash::ContentHash;
use super::page::PageShape;

/// Version of the manifest's own format.
pub const MANIFEST_FORMAT: u32 = 1;

/// What the writer says of the version it publishes.
#[derive(Debug, Clone, PartialEq)]
pub struct Publication {
    /// What the data are ("offset_surface_light_field"); not interpreted here.
    pub kind: String,
    /// The kind's own parameters; not interpreted here.
    pub parameters: Value,
    /// Hashes of what the data were made from, by name ("scene", "environment").
    pub inputs: BTreeMap<String, ContentHash>,
    /// Of the program that made them.
    pub code_version: String,
    /// Milliseconds since 1970, UTC. The store asks no clock.
    pub created_unix_millis: u64,
}

/// Content of a dataset version; immutable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`MANIFEST_FORMAT`].
    pub format: u32,
    /// Dataset's name.
    pub dataset: String,
    /// From 1.
    pub version: u64,
    /// The staging token of the job that wrote it.
    pub token: String,
    /// As in [`Publication`].
    pub kind: String,
    /// As in [`Publication`].
    pub parameters: Value,
    /// As in [`Publication`].
    pub inputs: BTreeMap<String, ContentHash>,
    /// As in [`Publication`].
    pub code_version: String,
    /// As in [`Publication`].
    pub created_unix_millis: u64,
    /// The pages 0…count−1.
    pub pages: PageSummary,
    /// Files that hold the pages.
    pub segments: Vec<SegmentEntry>,
    /// Small binary parts by name.
    pub blobs: BTreeMap<String, BlobEntry>,
}

/// The pages of a version.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PageSummary {
    /// How many.
    pub count: u32,
    /// The shapes that occur, sorted.
    pub shapes: Vec<PageShape>,
    /// Hash over every page's place; an index that does not give it is rebuilt.
    pub index: ContentHash,
}

/// One sealed segment; its file is `segments/<blake3>.seg`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SegmentEntry {
    /// Length of the file.
    pub bytes: u64,
    /// Its content.
    pub blake3: ContentHash,
}

/// One blob; its file is `blobs/<blake3>`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlobEntry {
    /// Length of the file.
    pub bytes: u64,
    /// Its content.
    pub blake3: ContentHash,
}

impl Manifest {
    /// Bytes of segments and blobs on disk.
    pub fn stored_bytes(&self) -> u64 {
        self.segments.iter().map(|s| s.bytes).chain(self.blobs.values().map(|b| b.bytes)).sum()
    }

    /// The file's content.
    pub(super) fn to_file(&self) -> Vec<u8> {
        sealed_json("manifest", self)
    }

    /// Reads a file's content; `path` is only named in errors.
    pub(super) fn from_file(bytes: &[u8], path: &Path) -> Result<Self, StoreError> {
        let damaged = |reason: String| StoreError::DamagedFile { reason, path: path.into() };
        let manifest: Self = open_sealed_json("manifest", bytes).map_err(damaged)?;
        if manifest.format != MANIFEST_FORMAT {
            return Err(damaged(format!("manifest format {}, this program reads {MANIFEST_FORMAT}", manifest.format)));
        }
        Ok(manifest)
    }
}

/// JSON `{"blake3": …, "<member>": …}` whose first line is the hash of the rest.
pub(super) fn sealed_json<T: Serialize>(member: &str, value: &T) -> Vec<u8> {
    let json = serde_json::to_string_pretty(value).expect("string keys and finite numbers serialise");
    let body = format!("\"{member}\": {json}}}\n");
    format!("{{\"blake3\": \"{}\",\n{body}", ContentHash::of(body.as_bytes())).into_bytes()
}

/// Reverses [`sealed_json`], or says what is wrong.
pub(super) fn open_sealed_json<T: for<'de> Deserialize<'de>>(member: &str, bytes: &[u8]) -> Result<T, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "not UTF-8".to_string())?;
    let (first, body) = text.split_once('\n').ok_or("no hash line")?;
    let hash = first.strip_prefix("{\"blake3\": \"").and_then(|rest| rest.strip_suffix("\",")).ok_or("no hash line")?;
    if hash != ContentHash::of(body.as_bytes()).to_string() {
        return Err("content does not have the hash in its first line".into());
    }
    let json = body.strip_prefix(&format!("\"{member}\": ")).and_then(|rest| rest.strip_suffix("}\n")).ok_or("no such member")?;
    serde_json::from_str(json).map_err(|error| error.to_string())
}
