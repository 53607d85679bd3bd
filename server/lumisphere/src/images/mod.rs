//! Images: planar f32 in memory, foreign formats at the edge, and how far two images are apart.

mod comparator;
mod contact_sheet;
mod display_referred;
mod error;
mod exr;
mod golden;
mod hdr;
mod image;
mod jpeg;
mod metrics;
mod png;
mod read;
mod rgb8;
mod tiff;
mod tolerances;
mod tone_map;

#[cfg(test)]
mod format_tests;
#[cfg(test)]
mod negative_controls;

pub use comparator::{
    Difference, ElementReport, GOLDEN_WORST_LIMIT, GoldenReport, Mismatch, count_beyond, elements_agree, golden_agrees, images_agree,
};
pub use contact_sheet::{contact_sheet, contact_sheet_linear};
pub use error::{Format, ImageError};
pub use exr::{ExrChannel, ExrCompression, ExrImage, ExrLayer, ExrStorage, decode_exr, encode_exr, encode_exr_rgb};
pub use golden::{GOLDEN_MAX_BYTES, Golden, GoldenError, check_golden};
pub use hdr::decode_hdr;
pub use image::Image;
pub use jpeg::{JpegQuality, decode_jpeg, decode_jpeg_codes, encode_jpeg, encode_jpeg_pixels};
pub use metrics::{CompareError, CompareOptions, Comparison, absolute_error_image, compare, flip_error_image};
pub(crate) use png::decode_png_texels;
pub use png::{decode_png, decode_png_codes, encode_png};
pub use read::{Nan, ReadLimits, decode_image, decode_image_codes, read_image};
pub use rgb8::Rgb8;
pub use tolerances::Tolerance;
pub use tone_map::{Exposure, ToneMap, tone_mapped, tone_mapped_pixels};
