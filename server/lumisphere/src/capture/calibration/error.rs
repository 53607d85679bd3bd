//! Why photographs could not be calibrated.

use thiserror::Error;

use crate::geometry::{CameraError, PoseError};

/// Why photographs could not be calibrated; `file` is the photograph.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CalibrationError {
    /// A board that is none.
    #[error("checkerboard of {columns}x{rows} inner corners with squares of {square}, 3 to 64 corners a side and squares above 0 expected")]
    Board {
        /// As given.
        columns: usize,
        /// As given.
        rows: usize,
        /// As given.
        square: f64,
    },
    /// A surface that is none.
    #[error("surface of {width} x {height}, two lengths above 0 expected")]
    Surface {
        /// As given.
        width: f64,
        /// As given.
        height: f64,
    },
    /// Too few photographs of the checkerboard.
    #[error("{found} photographs of the checkerboard, at least {least} expected")]
    TooFewPhotographs {
        /// As given.
        found: usize,
        /// For Zhang's method.
        least: usize,
    },
    /// Photographs by one lens are of one size.
    #[error("photograph is {}x{} pixels, {}x{} expected as of the lens and the others: {file}", found[0], found[1], expected[0], expected[1])]
    Size {
        /// Of this one.
        found: [u32; 2],
        /// Of the lens, or of the first photograph.
        expected: [u32; 2],
        /// Which photograph.
        file: String,
    },
    /// Corners are missing, or there are more.
    #[error("{found} corners, {expected} expected: {file}")]
    CornerCount {
        /// As given.
        found: usize,
        /// Of the board or surface.
        expected: usize,
        /// Which photograph.
        file: String,
    },
    /// A corner is NaN or infinite.
    #[error("corner {corner} is at ({x}, {y}), finite pixels expected: {file}")]
    NotFinite {
        /// From 0.
        corner: usize,
        /// As given.
        x: f64,
        /// As given.
        y: f64,
        /// Which photograph.
        file: String,
    },
    /// The corners run the wrong way round.
    #[error(
        "corners run clockwise in the photograph, counter-clockwise expected: they are in reversed order, or the camera is behind the surface: {file}"
    )]
    Clockwise {
        /// Which photograph.
        file: String,
    },
    /// No camera sees a rectangle like that.
    #[error(
        "corners are those of no rectangle before a camera (their sides cross, three lie on a line, or one is beyond the horizon): {file}"
    )]
    NoRectangle {
        /// Which photograph.
        file: String,
    },
    /// The corners have no pose with this lens.
    #[error("no pose in front of the plane images the corners where they were seen: {file}")]
    NoPose {
        /// Which photograph.
        file: String,
    },
    /// The photographs leave intrinsics open: all face the board at about the same tilt.
    #[error(
        "photographs do not determine {parameter}: standard deviation {deviation:.3}, at most {limit:.3} expected; tilt the board more, and differently, between photographs"
    )]
    Undetermined {
        /// Which.
        parameter: &'static str,
        /// Infinite where nothing determines it.
        deviation: f64,
        /// Greatest accepted.
        limit: f64,
    },
    /// The best camera images the corners elsewhere: they are not those of the board or surface, or its size, or the lens, is another.
    #[error("no camera explains the corners: {rms_px:.2} px remain, at most {limit_px:.2} expected: {file}")]
    Misfit {
        /// Root mean square distance.
        rms_px: f64,
        /// Greatest accepted.
        limit_px: f64,
        /// The photograph, or of several the worst.
        file: String,
    },
    /// A solved pose is none in f32.
    #[error("{source}: {file}")]
    Pose {
        /// Why.
        source: PoseError,
        /// Which photograph.
        file: String,
    },
    /// A solved camera is none in f32.
    #[error("{source}: {file}")]
    Camera {
        /// Why.
        source: CameraError,
        /// Which photograph.
        file: String,
    },
}
