//! Radiance .hdr: three 8-bit mantissas and a shared exponent a pixel, run-length coded; reading only.
//!
//! Called by [`super::decode_image`] for environments. Source: G. Ward, "Real Pixels", Graphics Gems II (1991), and Radiance's
//! `color.c`: both run-length schemes and flat pixels. `EXPOSURE` lines multiply, and the pixels are divided by them, which gives
//! radiance back; `COLORCORR`, `PRIMARIES` are ignored. The eight orientations of the format's resolution line reduce to the four
//! that keep rows horizontal; the others are refused.

use super::{Format, Image, ImageError, ReadLimits};

/// Decodes to planes R G B, linear.
pub fn decode_hdr(bytes: &[u8], limits: ReadLimits) -> Result<Image, ImageError> {
    let mut reader = Reader { bytes };
    let header = read_header(&mut reader)?;
    limits.check_size(header.width, header.height, 3)?;
    // A row is coded in no fewer than 4 bytes, so a lying height ends before it costs memory.
    if header.height > reader.bytes.len() / 4 {
        return Err(malformed("ends before its last row"));
    }
    let mut image = Image::zeros(header.width, header.height, 3);
    let mut row = vec![[0u8; 4]; header.width];
    for stored_row in 0..header.height {
        read_row(&mut reader, &mut row)?;
        let target_row = if header.bottom_up { header.height - 1 - stored_row } else { stored_row };
        for (stored_column, &rgbe) in row.iter().enumerate() {
            let column = if header.right_to_left { header.width - 1 - stored_column } else { stored_column };
            image.set_rgb(target_row * header.width + column, radiance(rgbe, header.exposure));
        }
    }
    for (name, plane) in ["R", "G", "B"].iter().zip(&image.planes) {
        limits.check_samples(name, header.width, plane)?;
    }
    Ok(image)
}

struct Header {
    width: usize,
    height: usize,
    exposure: f32,
    bottom_up: bool,
    right_to_left: bool,
}

fn read_header(reader: &mut Reader) -> Result<Header, ImageError> {
    let mut exposure = 1.0f32;
    loop {
        let line = reader.line()?;
        if line.is_empty() {
            break;
        }
        if let Some(format) = line.strip_prefix("FORMAT=")
            && format.trim() != "32-bit_rle_rgbe"
        {
            return Err(ImageError::Unsupported { format: Format::Hdr, feature: format!("pixel format {}", format.trim()) });
        }
        if let Some(value) = line.strip_prefix("EXPOSURE=") {
            exposure *= value.trim().parse::<f32>().map_err(|_| malformed("unreadable EXPOSURE"))?;
        }
    }
    if !(exposure > 0.0 && exposure.is_finite()) {
        return Err(malformed("EXPOSURE is not a positive number"));
    }
    let resolution = reader.line()?;
    let words: Vec<_> = resolution.split_whitespace().collect();
    let [vertical @ ("-Y" | "+Y"), height, horizontal @ ("-X" | "+X"), width] = words[..] else {
        return Err(ImageError::Unsupported { format: Format::Hdr, feature: format!("resolution line {resolution:?}") });
    };
    let size = |word: &str| word.parse::<usize>().ok().filter(|&size| size > 0).ok_or_else(|| malformed("unreadable size"));
    Ok(Header { width: size(width)?, height: size(height)?, exposure, bottom_up: vertical == "+Y", right_to_left: horizontal == "-X" })
}

/// Linear colour of a pixel. Radiance's own reader adds half a step to each mantissa; every other reader and writer of .hdr
/// environments does not, and a black channel must stay black, so neither does this one.
fn radiance([r, g, b, e]: [u8; 4], exposure: f32) -> [f32; 3] {
    if e == 0 {
        return [0.0; 3];
    }
    let scale = 2f64.powi(i32::from(e) - (128 + 8)) / f64::from(exposure);
    [r, g, b].map(|mantissa| (f64::from(mantissa) * scale) as f32)
}

fn read_row(reader: &mut Reader, row: &mut [[u8; 4]]) -> Result<(), ImageError> {
    let first = reader.take::<4>()?;
    let width = row.len();
    // The newer scheme marks each row with 2, 2 and the width; it is defined for these widths only.
    if (8..32_768).contains(&width) && first[..2] == [2, 2] && first[2] < 128 {
        if usize::from(first[2]) << 8 | usize::from(first[3]) != width {
            return Err(malformed("a row's width is not the image's"));
        }
        return (0..4).try_for_each(|component| read_component(reader, row, component));
    }
    read_flat_row(reader, row, first)
}

/// One component's bytes of a row: runs (count above 128) and literals.
fn read_component(reader: &mut Reader, row: &mut [[u8; 4]], component: usize) -> Result<(), ImageError> {
    let mut column = 0;
    while column < row.len() {
        let [count] = reader.take::<1>()?;
        let (length, is_run) = if count > 128 { (usize::from(count - 128), true) } else { (usize::from(count), false) };
        let target = row.get_mut(column..column + length).filter(|target| !target.is_empty());
        let target = target.ok_or_else(|| malformed("a run is empty or exceeds its row"))?;
        let mut value = 0;
        for (index, pixel) in target.iter_mut().enumerate() {
            if index == 0 || !is_run {
                [value] = reader.take::<1>()?;
            }
            pixel[component] = value;
        }
        column += length;
    }
    Ok(())
}

/// Whole pixels, where (1, 1, 1, n) repeats the one before n times; consecutive repeats count in base 256.
fn read_flat_row(reader: &mut Reader, row: &mut [[u8; 4]], first: [u8; 4]) -> Result<(), ImageError> {
    let mut pixel = first;
    let mut column = 0usize;
    let mut shift = 0;
    loop {
        if pixel[..3] == [1, 1, 1] {
            let length = usize::from(pixel[3]).checked_shl(shift).unwrap_or(usize::MAX);
            let Some(end) = column.checked_add(length).filter(|&end| column > 0 && shift <= 24 && end <= row.len()) else {
                return Err(malformed("a run exceeds its row"));
            };
            let repeated = row[column - 1];
            row[column..end].fill(repeated);
            column = end;
            shift += 8;
        } else {
            row[column] = pixel;
            column += 1;
            shift = 0;
        }
        if column == row.len() {
            return Ok(());
        }
        pixel = reader.take::<4>()?;
    }
}

/// The bytes not read yet.
struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], ImageError> {
        let (&taken, rest) = self.bytes.split_first_chunk::<N>().ok_or_else(|| malformed("ends in the middle of a row"))?;
        self.bytes = rest;
        Ok(taken)
    }

    /// Text up to the next line feed, which is consumed.
    fn line(&mut self) -> Result<String, ImageError> {
        let end = self.bytes.iter().position(|&byte| byte == b'\n').ok_or_else(|| malformed("ends in its header"))?;
        let line = String::from_utf8_lossy(&self.bytes[..end]).trim_end().to_owned();
        self.bytes = &self.bytes[end + 1..];
        Ok(line)
    }
}

fn malformed(reason: &str) -> ImageError {
    ImageError::Malformed { format: Format::Hdr, reason: reason.to_owned() }
}
