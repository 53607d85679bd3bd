//! The checkerboard and what a photograph shows of it.

use glam::DVec2;

use super::CalibrationError;

/// A printed checkerboard: its inner corners, where four squares meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Checkerboard {
    columns: usize,
    rows: usize,
    square: f64,
}

/// Where a photograph shows the corners.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardPhotograph {
    /// The photograph's name.
    pub file: String,
    /// Its width and height.
    pub size_px: [u32; 2],
    /// In the order of [`Checkerboard::corner`]; pixel centres at half integers, y down.
    pub corners_px: Vec<DVec2>,
}

impl Checkerboard {
    /// Smallest number of inner corners along a side: a square around one of them.
    pub const LEAST_CORNERS: usize = 3;
    /// Greatest: finer boards are beyond what is told apart in a photograph reduced to 1000 pixels.
    pub const MOST_CORNERS: usize = 64;

    /// `columns` × `rows` inner corners (one less than squares), the side of a square in the unit that the poses are wanted in.
    pub fn new(columns: usize, rows: usize, square: f64) -> Result<Self, CalibrationError> {
        let fits = [columns, rows].iter().all(|n| (Self::LEAST_CORNERS..=Self::MOST_CORNERS).contains(n));
        if !(fits && square > 0.0 && square.is_finite()) {
            return Err(CalibrationError::Board { columns, rows, square });
        }
        Ok(Self { columns, rows, square })
    }

    /// Inner corners in a row.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Rows of inner corners.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// How many inner corners.
    pub fn corner_count(&self) -> usize {
        self.columns * self.rows
    }

    /// Place on the board of corner `index`: columns run along +x, then rows along +y. The square beyond corner 0, at the far side of it
    /// from the board's middle, is black where the pattern allows a choice.
    pub fn corner(&self, index: usize) -> DVec2 {
        DVec2::new((index % self.columns) as f64, (index / self.columns) as f64) * self.square
    }

    /// Every corner, in order.
    pub fn corners(&self) -> Vec<DVec2> {
        (0..self.corner_count()).map(|index| self.corner(index)).collect()
    }
}
