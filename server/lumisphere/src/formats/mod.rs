//! Foreign formats, one file each: bytes in, our geometry (+Y up), cameras or reflectance out. Nothing here panics on what somebody else wrote.

pub mod bpt;
pub mod colmap;
pub mod gltf;
mod known_cameras;
pub mod lens;
pub mod lp;
pub mod marked_corners;
pub mod merl;
pub mod normal_map;
pub mod obj;
pub mod photograph_list;
pub mod transforms_json;

pub use known_cameras::{KnownCamerasError, MAX_FILE_BYTES, MAX_PHOTOGRAPHS, MAX_SIDE_PX};
use thiserror::Error;

use crate::geometry::MeshError;

/// What is wrong with a foreign file.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FormatError {
    /// A line of a text format cannot be understood.
    #[error("line {line}: {message}")]
    Line {
        /// From 1.
        line: usize,
        /// What is there and what was expected.
        message: String,
    },
    /// The file as a whole.
    #[error("{0}")]
    File(String),
    /// Its triangles are none.
    #[error("{0}")]
    Mesh(#[from] MeshError),
    /// It is no table of measured reflectance.
    #[error("{0}")]
    Merl(#[from] merl::MerlError),
}
