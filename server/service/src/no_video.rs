//! In the place of `video` in a server that is built without H.264: there is no stream.

use lumisphere::images::{JpegQuality, Rgb8};

use crate::errors::ApiError;

/// Of which there is none.
pub enum Video {}

/// As in the other.
pub struct Encoded {
    /// An access unit.
    pub bytes: Vec<u8>,
    /// Whether it can be decoded alone.
    pub is_key: bool,
}

impl Video {
    /// None.
    pub fn new() -> Option<Self> {
        None
    }

    /// As in the other.
    pub fn encode(&mut self, _: &Rgb8, _: JpegQuality) -> Result<Encoded, ApiError> {
        match *self {}
    }

    /// As in the other.
    pub fn sent(&mut self) {
        match *self {}
    }

    /// As in the other.
    pub fn begin_anew(&mut self) {
        match *self {}
    }
}
