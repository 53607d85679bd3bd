//! Planar f32 image.

use serde::{Deserialize, Serialize};

use super::ImageError;

/// `planes[channel][row · width + column]`; row 0 is the top. Linear unless a function's documentation says otherwise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Image {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// One plane a channel, each `width · height` long.
    pub planes: Vec<Vec<f32>>,
}

impl Image {
    /// All zero.
    pub fn zeros(width: usize, height: usize, channels: usize) -> Self {
        Self { width, height, planes: vec![vec![0.0; width * height]; channels] }
    }

    /// How many channels.
    pub fn channels(&self) -> usize {
        self.planes.len()
    }

    /// Every channel at (column, row).
    pub fn pixel(&self, column: usize, row: usize) -> impl Iterator<Item = f32> + '_ {
        self.planes.iter().map(move |p| p[row * self.width + column])
    }

    /// First three channels at pixel index `row · width + column`.
    pub fn rgb(&self, index: usize) -> [f32; 3] {
        [self.planes[0][index], self.planes[1][index], self.planes[2][index]]
    }

    /// Sets the first three channels at pixel index `row · width + column`.
    pub fn set_rgb(&mut self, index: usize, rgb: [f32; 3]) {
        for (plane, value) in self.planes.iter_mut().zip(rgb) {
            plane[index] = value;
        }
    }

    /// Samples interleaved by pixel, each a little-endian f32: what goes over the wire as raw.
    pub fn to_interleaved_bytes(&self) -> Vec<u8> {
        let channels = self.channels();
        let mut bytes = vec![0; 4 * channels * self.width * self.height];
        for (channel, plane) in self.planes.iter().enumerate() {
            for (pixel, sample) in bytes.chunks_exact_mut(4 * channels).zip(plane) {
                pixel[4 * channel..4 * channel + 4].copy_from_slice(&sample.to_le_bytes());
            }
        }
        bytes
    }

    /// The inverse of [`Image::to_interleaved_bytes`]; there must be exactly as many bytes as the shape needs.
    pub fn from_interleaved_bytes(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Result<Self, ImageError> {
        let needed = width.checked_mul(height).and_then(|pixels| pixels.checked_mul(channels)?.checked_mul(4));
        if channels == 0 || needed != Some(bytes.len()) {
            let expected = format!("{width} × {height} × {channels} samples of 4 bytes");
            return Err(ImageError::Shape { expected, actual: format!("{} bytes", bytes.len()) });
        }
        let mut image = Self::zeros(width, height, channels);
        for (channel, plane) in image.planes.iter_mut().enumerate() {
            for (sample, pixel) in plane.iter_mut().zip(bytes.chunks_exact(4 * channels)) {
                let start = 4 * channel;
                *sample = f32::from_le_bytes([pixel[start], pixel[start + 1], pixel[start + 2], pixel[start + 3]]);
            }
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interleaved_bytes_come_back_bit_for_bit() {
        let image = Image { width: 2, height: 1, planes: vec![vec![1.0, -2.5], vec![f32::INFINITY, 1e-40]] };
        let bytes = image.to_interleaved_bytes();
        assert_eq!(bytes[4..8], f32::INFINITY.to_le_bytes(), "the second sample is the first pixel's second channel");
        assert_eq!(Image::from_interleaved_bytes(2, 1, 2, &bytes).unwrap(), image);
    }

    #[test]
    fn bytes_of_another_shape_are_refused() {
        for (width, height, channels) in [(2, 1, 3), (2, 2, 2), (usize::MAX, 2, 2), (2, 1, 0)] {
            assert!(matches!(Image::from_interleaved_bytes(width, height, channels, &[0; 16]), Err(ImageError::Shape { .. })));
        }
    }
}
