//! PNG: 8-bit sRGB out, 1–16 bits in.
//!
//! Called for frames and contact sheets (out), textures and photographs (in).

use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageEncoder as _};

use super::display_referred::{decode_codes, linear_planes, rgb8};
use super::{Format, Image, ImageError, ReadLimits, Rgb8};

/// Bytes of a PNG file, fast compression: about a tenth larger than the best and many times faster.
pub fn encode_png(image: &Rgb8) -> Result<Vec<u8>, ImageError> {
    let size = |size: usize| u32::try_from(size).ok().filter(|&size| size > 0);
    let (Some(width), Some(height)) = (size(image.width), size(image.height)) else {
        let actual = format!("{} × {}", image.width, image.height);
        return Err(ImageError::Shape { expected: "1 to 2³²−1 pixels a side".into(), actual });
    };
    let mut bytes = Vec::with_capacity(image.bytes.len() / 2);
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
        .write_image(&image.bytes, width, height, ExtendedColorType::Rgb8)
        .map_err(|error| ImageError::Shape { expected: "an image PNG can hold".into(), actual: error.to_string() })?;
    Ok(bytes)
}

/// Linear planes R G B, and A where the file has alpha (unassociated); the file is taken as sRGB.
pub fn decode_png(bytes: &[u8], limits: ReadLimits) -> Result<Image, ImageError> {
    linear_planes(decode_codes(Format::Png, bytes, PngDecoder::new, limits)?)
}

/// The codes as they are in the file, 16-bit ones rounded to 8, alpha dropped: for photographs whose transfer curve is not sRGB.
pub fn decode_png_codes(bytes: &[u8], limits: ReadLimits) -> Result<Rgb8, ImageError> {
    Ok(rgb8(decode_codes(Format::Png, bytes, PngDecoder::new, limits)?))
}

/// The codes as they are in the file, of its own depth and channels: for maps of what is no colour.
pub(crate) fn decode_png_texels(bytes: &[u8], limits: ReadLimits) -> Result<DynamicImage, ImageError> {
    match Format::of(bytes)? {
        Format::Png => decode_codes(Format::Png, bytes, PngDecoder::new, limits),
        format => Err(ImageError::Unsupported { format, feature: "a map of what is no colour".into() }),
    }
}
