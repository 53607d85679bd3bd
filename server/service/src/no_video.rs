//! In the place of `video` in a server that is built without H.264: there is no stream.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use lumisphere::images::{JpegQuality, Rgb8};

use crate::errors::ApiError;
use crate::frames::Encoded;

/// As in the other.
pub const NONE_SENT: u64 = 0;

/// Of which there is none.
pub enum Video {}

impl Video {
    /// None.
    pub fn new(_: Arc<AtomicU64>) -> Option<Self> {
        None
    }

    /// As in the other.
    pub fn encode(&mut self, _: &Rgb8, _: JpegQuality) -> Result<Encoded, ApiError> {
        match *self {}
    }
}
