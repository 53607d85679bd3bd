//! Taking light from a scene with the path tracer: what is stored of it before any representation is built.

mod background;
mod cube_maps;

pub use background::{Background, BackgroundSurface, bake_background};
pub use cube_maps::{CaptureError, Viewpoint, shrunk_faces, trace_cube_maps};
