//! Packed 8-bit colour: what screens, PNG and JPEG take.

use super::{Image, ImageError};
use crate::radiometry::color::linear_from_srgb8;

/// `bytes[3 · (row · width + column) + channel]`, row 0 is the top; sRGB-encoded unless a function's documentation says otherwise.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rgb8 {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Three bytes a pixel.
    pub bytes: Vec<u8>,
}

impl Rgb8 {
    /// All of one colour.
    pub fn filled(width: usize, height: usize, rgb: [u8; 3]) -> Self {
        Self { width, height, bytes: rgb.repeat(width * height) }
    }

    /// Takes bytes of the announced shape.
    pub fn from_bytes(width: usize, height: usize, bytes: Vec<u8>) -> Result<Self, ImageError> {
        match width.checked_mul(height).and_then(|pixels| pixels.checked_mul(3)) {
            Some(expected) if expected == bytes.len() => Ok(Self { width, height, bytes }),
            _ => Err(ImageError::Shape { expected: format!("{width} × {height} × 3 bytes"), actual: format!("{} bytes", bytes.len()) }),
        }
    }

    /// The three codes at (column, row).
    pub fn pixel(&self, column: usize, row: usize) -> [u8; 3] {
        let start = 3 * (row * self.width + column);
        [self.bytes[start], self.bytes[start + 1], self.bytes[start + 2]]
    }

    /// Linear planes R G B in [0, 1].
    pub fn to_linear(&self) -> Image {
        let plane = |channel: usize| self.bytes.iter().skip(channel).step_by(3).map(|&code| linear_from_srgb8(code)).collect();
        Image { width: self.width, height: self.height, planes: (0..3).map(plane).collect() }
    }
}
