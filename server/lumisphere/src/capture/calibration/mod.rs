//! Where the cameras of photographs stood and how their lens images.
//!
//! Two steps, as in the source (chapter 9.2, appendix F): photographs of a checkerboard give the lens ([`find_checkerboard`],
//! [`calibrate`]); the four corners of the rectangular surface give each photograph's pose ([`pose_photographs`]). World space is the
//! plane's: z = 0, +Z toward the cameras, x right, y up, origin at the first corner. The result is a `PhotographCamera`, as from files of
//! known cameras.
//!
//! Where it fails, it says so: boards partly out of view, photographs that leave the focal length open, corners in the wrong order, and a
//! plane that is tilted either way equally well ([`DecidedBy::Nothing`]).

mod board;
mod calibrate;
mod corners;
mod error;
mod find_board;
mod grey;
mod homography;
mod lattice;
mod lens;
mod planar_pose;
mod refine;
mod start;
mod surface;

#[cfg(test)]
mod checkerboard_tests;
#[cfg(test)]
mod surface_tests;
#[cfg(test)]
mod synthetic;

pub use board::{BoardPhotograph, Checkerboard};
pub use calibrate::{CalibratedPhotograph, Calibration, LEAST_PHOTOGRAPHS, calibrate};
pub use error::CalibrationError;
pub use find_board::{Detection, find_checkerboard};
pub use grey::Grey;
pub use homography::{homography, mapped};
pub use lens::Lens;
pub use surface::{DecidedBy, LensUse, MarkedPhotograph, PosedPhotograph, PosedPhotographs, Surface, pose_photographs};
