//! Taking light from a scene with the path tracer: what is stored of it before any representation is built.

mod background;
mod cube_maps;
mod levels;

pub use background::{Background, BackgroundSurface, bake_background};
pub use cube_maps::{CaptureError, Viewpoint, trace_cube_maps};
pub use levels::{coarser_levels, halved, halved_distances, inverse_distance, stacked};
