//! TIFF: photographs (in).

use image::codecs::tiff::TiffDecoder;

use super::display_referred::{decode_codes, linear_planes, rgb8};
use super::{Format, Image, ImageError, ReadLimits, Rgb8};

/// Linear planes R G B, and A where the file has alpha; integers are taken as sRGB, floating-point samples are refused.
pub(super) fn decode_tiff(bytes: &[u8], limits: ReadLimits) -> Result<Image, ImageError> {
    linear_planes(integers(bytes, limits)?)
}

/// The codes as they are in the file, 16-bit ones rounded to 8, alpha dropped.
pub(super) fn decode_tiff_codes(bytes: &[u8], limits: ReadLimits) -> Result<Rgb8, ImageError> {
    Ok(rgb8(integers(bytes, limits)?))
}

fn integers(bytes: &[u8], limits: ReadLimits) -> Result<image::DynamicImage, ImageError> {
    let image = decode_codes(Format::Tiff, bytes, TiffDecoder::new, limits)?;
    match image.color() {
        image::ColorType::Rgb32F | image::ColorType::Rgba32F => {
            Err(ImageError::Unsupported { format: Format::Tiff, feature: "floating-point samples".into() })
        }
        _ => Ok(image),
    }
}
