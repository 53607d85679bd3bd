//! Images: planar f32 in memory, foreign formats at the edge, and how far two images are apart.

mod display_referred;
mod error;
mod exr;
mod hdr;
mod image;
mod jpeg;
mod png;
mod read;
mod rgb8;

#[cfg(test)]
mod format_tests;

pub use error::{Format, ImageError};
pub use exr::{ExrChannel, ExrCompression, ExrImage, ExrLayer, ExrStorage, decode_exr, encode_exr, encode_exr_rgb};
pub use hdr::decode_hdr;
pub use image::Image;
pub use jpeg::{JpegQuality, decode_jpeg, decode_jpeg_codes, encode_jpeg};
pub use png::{decode_png, decode_png_codes, encode_png};
pub use read::{Nan, ReadLimits, decode_image, read_image};
pub use rgb8::Rgb8;
