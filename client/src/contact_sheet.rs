//! All frames of a rendering in one small picture.

use lumisphere::images::{self, ImageError, ReadLimits, Rgb8, decode_png_codes, encode_png};

/// Longer edge of a thumbnail, at most.
const THUMBNAIL_PX: usize = 240;

/// PNG of thumbnails, left to right, top to bottom, of frames given as PNG, all of one size.
pub fn contact_sheet(frames: &[impl AsRef<[u8]>]) -> Result<Vec<u8>, ImageError> {
    let thumbnails = frames.iter().map(|png| Ok(thumbnail(&decode_png_codes(png.as_ref(), ReadLimits::SCENE)?)));
    let thumbnails = thumbnails.collect::<Result<Vec<_>, ImageError>>()?;
    let columns = (thumbnails.len() as f64).sqrt().ceil() as usize;
    encode_png(&images::contact_sheet(&thumbnails, columns)?)
}

/// Each pixel the mean of its box of codes: good enough to find a frame, not to measure it.
fn thumbnail(image: &Rgb8) -> Rgb8 {
    let factor = image.width.max(image.height).div_ceil(THUMBNAIL_PX).max(1);
    let (width, height) = ((image.width / factor).max(1), (image.height / factor).max(1));
    let mut small = Rgb8::filled(width, height, [0; 3]);
    for row in 0..height {
        for column in 0..width {
            let rows = row * factor..((row + 1) * factor).min(image.height);
            let columns = column * factor..((column + 1) * factor).min(image.width);
            let count = (rows.len() * columns.len()) as u32;
            let mut sum = [0u32; 3];
            for (i, j) in rows.flat_map(|j| columns.clone().map(move |i| (i, j))) {
                let rgb = image.pixel(i, j);
                sum = [0, 1, 2].map(|c| sum[c] + u32::from(rgb[c]));
            }
            let at = 3 * (row * width + column);
            small.bytes[at..at + 3].copy_from_slice(&sum.map(|s| (s / count) as u8));
        }
    }
    small
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_lie_in_reading_order() {
        let colours = [[200, 0, 0], [0, 200, 0], [0, 0, 200]];
        let frames: Vec<Vec<u8>> = colours.iter().map(|&c| encode_png(&Rgb8::filled(480, 320, c)).unwrap()).collect();
        let sheet = decode_png_codes(&contact_sheet(&frames).unwrap(), ReadLimits::SCENE).unwrap();
        // Two columns of 240 × 160 thumbnails, a gap between.
        let (width, height) = (sheet.width, sheet.height);
        assert_eq!((width / 10, height / 10), (48, 32));
        let centres = [(120, 80), (width - 120, 80), (120, height - 80)];
        assert_eq!(centres.map(|(x, y)| sheet.pixel(x, y)), colours);
    }
}
