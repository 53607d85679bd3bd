//! Planar f32 image.

use serde::{Deserialize, Serialize};

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
}
