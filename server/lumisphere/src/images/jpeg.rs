//! JPEG: the quick lossy format for streamed frames (out), textures and photographs (in).

use image::codecs::jpeg::JpegDecoder;

use super::display_referred::{decode_codes, linear_planes, rgb8};
use super::{Format, Image, ImageError, ReadLimits, Rgb8};

/// JPEG quality, 1 (smallest) to 100 (best). Below 90 colour is stored at half resolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JpegQuality(u8);

impl JpegQuality {
    /// For streams: differences are hard to see in motion.
    pub const STREAM: Self = Self(85);

    /// None outside 1–100.
    pub fn new(quality: u8) -> Option<Self> {
        (1..=100).contains(&quality).then_some(Self(quality))
    }

    /// 1 to 100.
    pub fn value(self) -> u8 {
        self.0
    }
}

/// Bytes of a baseline JPEG file.
pub fn encode_jpeg(image: &Rgb8, quality: JpegQuality) -> Result<Vec<u8>, ImageError> {
    let size = |size: usize| u16::try_from(size).ok().filter(|&size| size > 0);
    let (Some(width), Some(height)) = (size(image.width), size(image.height)) else {
        let actual = format!("{} × {}", image.width, image.height);
        return Err(ImageError::Shape { expected: "1 to 65535 pixels a side".into(), actual });
    };
    let mut bytes = Vec::with_capacity(image.bytes.len() / 8);
    jpeg_encoder::Encoder::new(&mut bytes, quality.0)
        .encode(&image.bytes, width, height, jpeg_encoder::ColorType::Rgb)
        .map_err(|error| ImageError::Shape { expected: "an image JPEG can hold".into(), actual: error.to_string() })?;
    Ok(bytes)
}

/// Linear planes R G B; the file is taken as sRGB. The EXIF orientation is not applied.
pub fn decode_jpeg(bytes: &[u8], limits: ReadLimits) -> Result<Image, ImageError> {
    check_end(bytes)?;
    linear_planes(decode_codes(Format::Jpeg, bytes, JpegDecoder::new, limits)?)
}

/// The codes as they are in the file: for photographs whose transfer curve is not sRGB.
pub fn decode_jpeg_codes(bytes: &[u8], limits: ReadLimits) -> Result<Rgb8, ImageError> {
    check_end(bytes)?;
    Ok(rgb8(decode_codes(Format::Jpeg, bytes, JpegDecoder::new, limits)?))
}

/// The decoder fills what is missing with grey and calls it a success, so a cut file is told by its missing end marker: in entropy-coded
/// data 0xFF is never followed by it. (Thumbnails, which have an end marker of their own, lie in segments before the scan.)
fn check_end(bytes: &[u8]) -> Result<(), ImageError> {
    const START_OF_SCAN: u8 = 0xda;
    const END_OF_IMAGE: u8 = 0xd9;
    let cut = || ImageError::Malformed { format: Format::Jpeg, reason: "ends before its end marker".into() };
    let mut rest = bytes.get(2..).ok_or_else(cut)?;
    loop {
        match *rest {
            // A marker may be preceded by any number of fill bytes.
            [0xff, 0xff, ..] => rest = &rest[1..],
            [0xff, START_OF_SCAN, ..] => break,
            [0xff, _, high, low, ..] => {
                let length = usize::from(u16::from_be_bytes([high, low]));
                rest = rest.get(2 + length..).ok_or_else(cut)?;
            }
            _ => return Err(cut()),
        }
    }
    match rest.windows(2).any(|pair| pair == [0xff, END_OF_IMAGE]) {
        true => Ok(()),
        false => Err(cut()),
    }
}
