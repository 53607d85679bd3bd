//! Lumisphere: light fields as data. Capture them, hold them in five ways, render them, and measure the error.
//!
//! The library is usable alone, without the server and (`default-features = false`) without a GPU. It does not print,
//! read the environment or know the wire. Modules may import only from the left of this list; a test reads the `use` lines:
//! `geometry` ← `directions`, `radiometry`, `images` ← `charts`, `scenes`, `textures`, `raytrace`, `gpu`, `fitting`, `capture`, `formats`
//! ← `representations` ← `render`, `evaluate`.
//!
//! Conventions: right-handed world, +Y up; cameras look along −Z; radiance is linear Rec. 709, f32; directions are unit
//! vectors that point away from the surface point.

pub mod capture;
pub mod charts;
pub mod directions;
pub mod evaluate;
pub mod fitting;
pub mod formats;
pub mod geometry;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod images;
pub mod progress;
pub mod radiometry;
pub mod raytrace;
pub mod render;
pub mod representations;
pub mod scenes;
#[cfg(test)]
mod testdata;
pub mod textures;
