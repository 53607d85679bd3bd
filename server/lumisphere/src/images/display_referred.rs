//! What PNG and JPEG have in common: decoding to codes within limits, and from sRGB codes to linear planes.

use std::io::Cursor;

use image::{ColorType, DynamicImage, ImageDecoder, ImageResult};

use super::read::check_expansion;
use super::{Format, Image, ImageError, ReadLimits, Rgb8};
use crate::radiometry::color::{linear_from_srgb, linear_from_srgb8};

/// Decodes after checking the announced size.
pub(super) fn decode_codes<'a, D: ImageDecoder>(
    format: Format,
    bytes: &'a [u8],
    decoder: impl FnOnce(Cursor<&'a [u8]>) -> ImageResult<D>,
    limits: ReadLimits,
) -> Result<DynamicImage, ImageError> {
    let mut decoder = decoder(Cursor::new(bytes)).map_err(|error| decode_error(format, error))?;
    let (width, height) = decoder.dimensions();
    limits.check_size(width as usize, height as usize, usize::from(decoder.color_type().channel_count()))?;
    check_expansion(format, usize::try_from(decoder.total_bytes()).unwrap_or(usize::MAX), bytes.len())?;
    // Working memory beyond the image itself: rows, Huffman tables, ICC profiles and text chunks.
    let mut foreign = image::Limits::no_limits();
    foreign.max_alloc = Some(decoder.total_bytes().saturating_add(64 << 20));
    decoder.set_limits(foreign).map_err(|error| decode_error(format, error))?;
    DynamicImage::from_decoder(decoder).map_err(|error| decode_error(format, error))
}

/// Planes R G B, and A where there is alpha; colour from sRGB to linear, alpha scaled to [0, 1].
pub(super) fn linear_planes(image: DynamicImage) -> Result<Image, ImageError> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let has_alpha = image.color().has_alpha();
    let channels = if has_alpha { 4 } else { 3 };
    let planes = match image.color() {
        ColorType::L8 | ColorType::La8 | ColorType::Rgb8 | ColorType::Rgba8 => {
            split(&image.into_rgba8(), channels, linear_from_srgb8, |alpha| f32::from(alpha) / 255.0)
        }
        _ => {
            let linear = |code: u16| linear_from_srgb(f32::from(code) / 65_535.0);
            split(&image.into_rgba16(), channels, linear, |alpha| f32::from(alpha) / 65_535.0)
        }
    };
    Ok(Image { width, height, planes })
}

fn split<T: Copy>(rgba: &[T], channels: usize, color: impl Fn(T) -> f32, alpha: impl Fn(T) -> f32) -> Vec<Vec<f32>> {
    let plane = |channel: usize| {
        let samples = rgba.iter().skip(channel).step_by(4);
        if channel == 3 { samples.map(|&code| alpha(code)).collect() } else { samples.map(|&code| color(code)).collect() }
    };
    (0..channels).map(plane).collect()
}

/// Codes as stored, alpha dropped.
pub(super) fn rgb8(image: DynamicImage) -> Rgb8 {
    let image = image.into_rgb8();
    Rgb8 { width: image.width() as usize, height: image.height() as usize, bytes: image.into_raw() }
}

fn decode_error(format: Format, error: image::ImageError) -> ImageError {
    match error {
        image::ImageError::Unsupported(error) => ImageError::Unsupported { format, feature: error.to_string() },
        other => ImageError::Malformed { format, reason: other.to_string() },
    }
}
