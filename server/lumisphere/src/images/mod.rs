//! Images: planar f32 in memory, foreign formats at the edge, and how far two images are apart.

mod image;

pub use image::Image;
