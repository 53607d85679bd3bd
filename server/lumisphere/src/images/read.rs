//! Reads an image of any known format into linear planes, within limits.
//!
//! Called by `scenes` (textures, environments), `formats`, `evaluate` and the client. The format is told by the bytes, never by
//! the file's name.

use std::path::Path;

use super::{Format, Image, ImageError, Rgb8, exr, hdr, jpeg, png, tiff};

/// How much an image may hold and whether it may hold NaN. A header can announce any size; it is checked before memory is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadLimits {
    /// Greatest width × height × channels, summed over layers; 4 bytes each once decoded.
    pub max_samples: usize,
    /// What a NaN sample means.
    pub nan: Nan,
}

impl ReadLimits {
    /// For scene textures and environments: 2²⁷ samples (an 8192 × 4096 RGBA image, 512 MiB), no NaN.
    pub const SCENE: Self = Self { max_samples: 1 << 27, nan: Nan::Reject };
}

/// What to do with samples that are not numbers. Infinity is a number here: it is the distance where nothing is hit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Nan {
    /// The image is refused and the first NaN named.
    Reject,
    /// The image is taken as it is.
    Keep,
}

impl Format {
    /// The format that the bytes' beginning belongs to.
    pub fn of(bytes: &[u8]) -> Result<Self, ImageError> {
        match bytes {
            [0x76, 0x2f, 0x31, 0x01, ..] => Ok(Self::Exr),
            [b'#', b'?', ..] => Ok(Self::Hdr),
            [0x89, b'P', b'N', b'G', ..] => Ok(Self::Png),
            [0xff, 0xd8, 0xff, ..] => Ok(Self::Jpeg),
            [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => Ok(Self::Tiff),
            _ => Err(ImageError::UnknownFormat),
        }
    }
}

/// Linear image in a file: see [`decode_image`].
pub fn read_image(path: &Path, limits: ReadLimits) -> Result<Image, ImageError> {
    let read = || decode_image(&std::fs::read(path)?, limits);
    read().map_err(|error| error.in_file(path))
}

/// Linear planes R G B, and A where the image has alpha, of an encoded image.
///
/// PNG, JPEG and TIFF are taken as sRGB and linearised (their gamma chunks and profiles are ignored); alpha is linear in the file and
/// stays as it is. EXR (first layer) and Radiance HDR are linear already. A grey image gives three equal planes.
pub fn decode_image(bytes: &[u8], limits: ReadLimits) -> Result<Image, ImageError> {
    match Format::of(bytes)? {
        Format::Exr => exr::decode_exr(bytes, limits)?.into_first_rgb(),
        Format::Hdr => hdr::decode_hdr(bytes, limits),
        Format::Png => png::decode_png(bytes, limits),
        Format::Jpeg => jpeg::decode_jpeg(bytes, limits),
        Format::Tiff => tiff::decode_tiff(bytes, limits),
    }
}

/// The codes of a photograph as they are in its file, 16-bit ones rounded to 8; not of formats that hold linear values.
pub fn decode_image_codes(bytes: &[u8], limits: ReadLimits) -> Result<Rgb8, ImageError> {
    match Format::of(bytes)? {
        Format::Png => png::decode_png_codes(bytes, limits),
        Format::Jpeg => jpeg::decode_jpeg_codes(bytes, limits),
        Format::Tiff => tiff::decode_tiff_codes(bytes, limits),
        format @ (Format::Exr | Format::Hdr) => {
            Err(ImageError::Unsupported { format, feature: "linear values where codes are expected".into() })
        }
    }
}

impl ReadLimits {
    /// Fails where an image of this size is more than the limit.
    pub(super) fn check_size(&self, width: usize, height: usize, channels: usize) -> Result<(), ImageError> {
        let samples = width.checked_mul(height).and_then(|pixels| pixels.checked_mul(channels));
        match samples {
            Some(samples) if samples <= self.max_samples => Ok(()),
            _ => Err(ImageError::TooLarge { width, height, channels, max_samples: self.max_samples }),
        }
    }

    /// Fails at the first NaN of a channel, unless NaN is kept.
    pub(super) fn check_samples(&self, channel: &str, width: usize, samples: &[f32]) -> Result<(), ImageError> {
        if self.nan == Nan::Keep {
            return Ok(());
        }
        match samples.iter().position(|sample| sample.is_nan()) {
            None => Ok(()),
            Some(index) => Err(ImageError::NotANumber { channel: channel.to_owned(), column: index % width, row: index / width }),
        }
    }
}

/// No format decodes a byte into more than about 1400: deflate (PNG, EXR's ZIP and PXR24) reaches 1032, JPEG with the coarsest chroma 1365, EXR's
/// other schemes some hundreds.
const MAX_EXPANSION: usize = 2048;

/// Fails where so short a file cannot hold so much: its header lies, or it is cut off.
pub(super) fn check_expansion(format: Format, decoded_bytes: usize, file_bytes: usize) -> Result<(), ImageError> {
    if decoded_bytes / MAX_EXPANSION <= file_bytes {
        return Ok(());
    }
    Err(ImageError::Malformed { format, reason: format!("announces {decoded_bytes} bytes of pixels in a file of {file_bytes}") })
}
