//! The bytes of what a dataset version holds beside its pages: named parts, each one zstd frame of a format byte and the postcard encoding
//! (little-endian floats) of a struct.

use std::io::Read;

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

// Of every part; a new layout gets a new number.
const FORMAT: u8 = 1;
// No part of a sensible dataset is larger; a lying one stops here instead of filling memory.
const MAX_PART_BYTES: u64 = 1 << 31;

/// A part cannot be encoded or decoded, or contradicts the others.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("part {part} of the dataset is malformed: {reason}")]
pub struct PartsError {
    /// Which part.
    pub part: &'static str,
    /// What does not agree.
    pub reason: String,
}

/// A part's bytes.
pub fn encode<T: Serialize>(part: &'static str, value: &T) -> Result<Vec<u8>, PartsError> {
    let malformed = |reason: String| PartsError { part, reason };
    let bytes = postcard::to_extend(value, vec![FORMAT]).map_err(|e| malformed(e.to_string()))?;
    zstd::encode_all(bytes.as_slice(), 1).map_err(|e| malformed(e.to_string()))
}

/// What [`encode`] was given; not yet checked for sense.
pub fn decode<T: DeserializeOwned>(part: &'static str, compressed: &[u8]) -> Result<T, PartsError> {
    let malformed = |reason: String| PartsError { part, reason };
    let decoder = zstd::Decoder::new(compressed).map_err(|e| malformed(e.to_string()))?;
    let mut bytes = Vec::new();
    decoder.take(MAX_PART_BYTES + 1).read_to_end(&mut bytes).map_err(|e| malformed(e.to_string()))?;
    if bytes.len() as u64 > MAX_PART_BYTES {
        return Err(malformed(format!("larger than {MAX_PART_BYTES} bytes")));
    }
    match bytes.split_first() {
        Some((&FORMAT, rest)) => postcard::from_bytes(rest).map_err(|e| malformed(e.to_string())),
        Some((other, _)) => Err(malformed(format!("format {other}, {FORMAT} expected"))),
        None => Err(malformed("empty".into())),
    }
}
