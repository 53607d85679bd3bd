//! Taking light from a scene with the path tracer, or from photographs: what is stored of it before any representation is built.

mod background;
pub mod calibration;
mod cube_maps;
#[cfg(test)]
mod exposure_tests;
mod levels;
mod merge;
pub mod observation_map;
pub mod parts;
mod photograph;
mod read_stack;
mod response_curve;
mod surface;

pub use background::{Background, BackgroundSurface, bake_background};
pub use cube_maps::{CaptureError, Viewpoint, store_cube_maps, trace_cube_maps};
pub use levels::{coarser_levels, halved, halved_distances, inverse_distance, sky_share, stacked, with_sky_shares};
pub use merge::{MergeError, Merged, Validity, merge, merge_linear};
pub use parts::PartsError;
pub use photograph::{CODES, ExposureStack, StackError, check_exposures};
pub use read_stack::{Exposures, ReadStackError, read_stack};
pub use response_curve::{ResponseCurve, ResponseError};
pub use surface::{SurfaceMesh, SurfaceTexel, surface_texels};
