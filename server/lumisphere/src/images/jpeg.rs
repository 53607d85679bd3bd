//! JPEG: the quick lossy format for streamed frames (out), textures and photographs (in).

use std::ops::Range;

use image::codecs::jpeg::JpegDecoder;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use rayon::prelude::*;

use super::display_referred::{decode_codes, linear_planes, rgb8};
use super::tone_map::{CodeTable, whole_rows};
use super::{Format, Image, ImageError, ReadLimits, Rgb8, ToneMap};

/// Pixels: a multiple of every minimum coded unit's, of which a strip of the widest image has fewer than 2¹⁶.
const STRIP_ROWS: usize = 32;

/// The second bytes of markers.
const START_OF_FRAME: u8 = 0xc0;
const FIRST_RESTART: u8 = 0xd0;
const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;

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

/// Bytes of a baseline JPEG file, the same for any number of threads: each strip of rows is a restart interval (ITU-T T.81, E.1.4), which depends
/// on no other and is encoded beside the others.
pub fn encode_jpeg(image: &Rgb8, quality: JpegQuality) -> Result<Vec<u8>, ImageError> {
    let (width, height) = sides(image.width, image.height)?;
    let strips = image.bytes.par_chunks(3 * image.width * STRIP_ROWS).map(|rows| encode_strip(rows, width, quality));
    joined(&strips.collect::<Result<Vec<_>, _>>()?, height)
}

/// The same file as of [`tone_mapped_pixels`](super::tone_mapped_pixels), strip by strip, so that the codes of one are still in the processor's
/// cache when they are encoded.
pub fn encode_jpeg_pixels(pixels: &[[f32; 3]], width: usize, tone_map: ToneMap, quality: JpegQuality) -> Result<Vec<u8>, ImageError> {
    let rows = whole_rows(pixels, width)?;
    let (width_px, height_px) = sides(width, rows)?;
    let table = CodeTable::new(tone_map);
    let strips = pixels.par_chunks(width * STRIP_ROWS).map(|rows| {
        let mut codes = vec![0; 3 * rows.len()];
        table.write(rows.as_flattened(), &mut codes);
        encode_strip(&codes, width_px, quality)
    });
    joined(&strips.collect::<Result<Vec<_>, _>>()?, height_px)
}

fn sides(width: usize, height: usize) -> Result<(u16, u16), ImageError> {
    let side = |length: usize| u16::try_from(length).ok().filter(|&length| length > 0);
    side(width)
        .zip(side(height))
        .ok_or_else(|| ImageError::Shape { expected: "1 to 65535 pixels a side".into(), actual: format!("{width} × {height}") })
}

/// As a file of its own, of one restart interval.
fn encode_strip(rows: &[u8], width: u16, quality: JpegQuality) -> Result<Vec<u8>, ImageError> {
    // Minimum coded units: 16 pixels a side where colour is stored at half resolution.
    let (sampling, side) = match quality.0 {
        90.. => (SamplingFactor::F_1_1, 8),
        _ => (SamplingFactor::F_2_2, 16),
    };
    let mut bytes = Vec::with_capacity(rows.len() / 8);
    let mut encoder = Encoder::new(&mut bytes, quality.0);
    encoder.set_sampling_factor(sampling);
    encoder.set_restart_interval(width.div_ceil(side) * (STRIP_ROWS as u16 / side));
    encoder
        .encode(rows, width, (rows.len() / (3 * usize::from(width))) as u16, ColorType::Rgb)
        .map_err(|error| ImageError::Shape { expected: "an image JPEG can hold".into(), actual: error.to_string() })?;
    Ok(bytes)
}

/// Strips one below the other.
fn joined(strips: &[Vec<u8>], height: u16) -> Result<Vec<u8>, ImageError> {
    whole_file(strips, height).ok_or_else(|| ImageError::Malformed { format: Format::Jpeg, reason: "the encoder left out a header".into() })
}

/// None if one of them is no file.
fn whole_file(strips: &[Vec<u8>], height: u16) -> Option<Vec<u8>> {
    let [first, ..] = strips else { return None };
    let mut whole = Vec::with_capacity(strips.iter().map(Vec::len).sum());
    let (frame, scan) = (segment(first, START_OF_FRAME)?, coded(first)?);
    whole.extend_from_slice(&first[..scan.start]);
    // Behind the marker, the segment's length and the bits per sample.
    whole[frame.start + 5..frame.start + 7].copy_from_slice(&height.to_be_bytes());
    for (number, strip) in strips.iter().enumerate() {
        if number > 0 {
            whole.extend_from_slice(&[0xff, FIRST_RESTART + (number - 1) as u8 % 8]);
        }
        whole.extend_from_slice(&strip[coded(strip)?]);
    }
    whole.extend_from_slice(&[0xff, END_OF_IMAGE]);
    Some(whole)
}

/// Where the entropy-coded data of a file of one scan are.
fn coded(file: &[u8]) -> Option<Range<usize>> {
    let scan = segment(file, START_OF_SCAN)?;
    file.ends_with(&[0xff, END_OF_IMAGE]).then_some(scan.end..file.len() - 2).filter(|coded| coded.start <= coded.end)
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

/// Where the first segment of a kind is, with its marker; those behind the beginning of the scan are not looked for.
fn segment(file: &[u8], kind: u8) -> Option<Range<usize>> {
    let mut at = 2;
    loop {
        match *file.get(at..)? {
            // A marker may be preceded by any number of fill bytes.
            [0xff, 0xff, ..] => at += 1,
            [0xff, found, high, low, ..] => {
                let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
                match found {
                    found if found == kind => return (end <= file.len()).then_some(at..end),
                    START_OF_SCAN => return None,
                    _ => at = end,
                }
            }
            _ => return None,
        }
    }
}

/// The decoder fills what is missing with grey and calls it a success, so a cut file is told by its missing end marker: in entropy-coded
/// data 0xFF is never followed by it. (Thumbnails, which have an end marker of their own, lie in segments before the scan.)
fn check_end(bytes: &[u8]) -> Result<(), ImageError> {
    let scan = segment(bytes, START_OF_SCAN).unwrap_or(bytes.len()..bytes.len());
    match bytes[scan.start..].windows(2).any(|pair| pair == [0xff, END_OF_IMAGE]) {
        true => Ok(()),
        false => Err(ImageError::Malformed { format: Format::Jpeg, reason: "ends before its end marker".into() }),
    }
}
