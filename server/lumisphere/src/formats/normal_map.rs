//! Normal maps and height maps as PNG, 8 or 16 bits.
//!
//! R, G, B are x, y, z of a unit normal: code 128 (32 768 of 16 bits) is 0, 255 (65 535) is 1, so that the usual (128, 128, 255) is flat to the last bit. +X runs
//! along u, to the image's right, +Y along v, upward (as OpenGL and glTF have it). They are normalised; z must be above 0. Alpha is ignored.
//!
//! A grey PNG is a height map: its codes, from 0 to 1, are heights of which 1 is as high as one repeat of the map is wide on the surface's uv, and slopes
//! are central differences across its edges, at which it repeats. Strength scales them.

use glam::Vec2;
use thiserror::Error;

use crate::geometry::NormalMap;
use crate::images::{ImageError, Nan, ReadLimits, decode_png_texels};

/// Along an edge.
pub const MOST_TEXELS: usize = 4096;
/// Of a file: as many texels of 16 bits with alpha, not compressed, and what is around them.
pub const MOST_FILE_BYTES: u64 = 136 << 20;

/// Why a file is no normal map.
#[derive(Debug, Error)]
pub enum NormalMapError {
    /// It is no PNG, or holds more than any map.
    #[error("{0}; a PNG of 8 or 16 bits and at most {MOST_TEXELS} × {MOST_TEXELS} texels expected")]
    Image(#[from] ImageError),
    /// An edge is longer.
    #[error("{width} × {height} texels, at most {MOST_TEXELS} × {MOST_TEXELS} expected")]
    TooLarge {
        /// Of the image.
        width: usize,
        /// Of the image.
        height: usize,
    },
    /// A texel's normal does not leave the surface.
    #[error("texel ({column}, {row}) has a normal of z = {z}, above 0 expected: blue above 128 of 255, as in tangent-space maps")]
    Inward {
        /// From the left.
        column: usize,
        /// From the top.
        row: usize,
        /// As coded.
        z: f32,
    },
}

/// The map of a file.
pub fn read(bytes: &[u8]) -> Result<NormalMap, NormalMapError> {
    let image = decode_png_texels(bytes, ReadLimits { max_samples: 4 * MOST_TEXELS * MOST_TEXELS, nan: Nan::Reject })?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    if width.max(height) > MOST_TEXELS {
        return Err(NormalMapError::TooLarge { width, height });
    }
    let is_of_8_bits = image.color().bytes_per_pixel() == image.color().channel_count();
    let slopes = match (image.color().has_color(), is_of_8_bits) {
        (true, true) => of_normals(width, image.into_rgb8().as_raw(), |code| (f32::from(code) - 128.0) / 127.0),
        (true, false) => of_normals(width, image.into_rgb16().as_raw(), |code| (f32::from(code) - 32_768.0) / 32_767.0),
        (false, _) => Ok(of_heights(width, height, image.into_luma16().as_raw())),
    };
    Ok(NormalMap::new(width, height, slopes?).expect("a slope a texel, none beyond 32 767"))
}

fn of_normals<T: Copy>(width: usize, codes: &[T], value: impl Fn(T) -> f32) -> Result<Vec<Vec2>, NormalMapError> {
    let (texels, _) = codes.as_chunks::<3>();
    let slope = |(at, texel): (usize, &[T; 3])| {
        let [x, y, z] = texel.map(&value);
        if z > 0.0 { Ok(Vec2::new(x, y) / z) } else { Err(NormalMapError::Inward { column: at % width, row: at / width, z }) }
    };
    texels.iter().enumerate().map(slope).collect()
}

fn of_heights(width: usize, height: usize, codes: &[u16]) -> Vec<Vec2> {
    let at = |row: usize, column: usize| f32::from(codes[row % height * width + column % width]) / 65_535.0;
    let slope = |row: usize, column: usize| {
        let along_u = at(row, column + 1) - at(row, column + width - 1);
        let along_v = at(row + height - 1, column) - at(row + 1, column);
        -0.5 * Vec2::new(width as f32 * along_u, height as f32 * along_v)
    };
    (0..height).flat_map(|row| (0..width).map(move |column| (row, column))).map(|(row, column)| slope(row, column)).collect()
}

#[cfg(test)]
mod tests {
    use image::{DynamicImage, GrayImage, ImageBuffer, ImageFormat, Luma, Rgb, RgbImage};

    use super::*;
    use crate::geometry::Mapping;
    use crate::images::{Rgb8, encode_png};

    fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    fn at(map: &NormalMap, u: f32, v: f32) -> Vec2 {
        map.slopes(Vec2::new(u, v), &Mapping { strength: 1.0, repeat: 1.0 })
    }

    #[test]
    fn the_usual_flat_colour_has_no_slope_and_others_that_of_their_normal() {
        let flat = Rgb8 { width: 3, height: 2, bytes: [128, 128, 255].repeat(6) };
        assert_eq!(read(&encode_png(&flat).unwrap()).unwrap().texels().as_flattened(), [half::f16::ZERO; 12]);
        // Top left leans to +u, bottom right to +v; the length does not matter.
        let mut image = RgbImage::from_pixel(2, 2, Rgb([128, 128, 255]));
        image.put_pixel(0, 0, Rgb([128 + 60, 128, 128 + 120]));
        image.put_pixel(1, 1, Rgb([128, 128 + 25, 128 + 100]));
        let map = read(&png(image)).unwrap();
        assert_eq!([at(&map, 0.25, 0.75), at(&map, 0.75, 0.25)], [Vec2::new(0.5, 0.0), Vec2::new(0.0, 0.25)]);
        assert_eq!(at(&map, 0.25, 0.25), Vec2::ZERO);
        let of_16_bits = ImageBuffer::<Rgb<u16>, _>::from_pixel(1, 1, Rgb([32_768 - 6000, 32_768, 32_768 + 24_000]));
        assert_eq!(at(&read(&png(of_16_bits)).unwrap(), 0.5, 0.5), Vec2::new(-0.25, 0.0));
    }

    #[test]
    fn heights_slope_down_from_where_they_are_high() {
        // A ramp along u of 4 texels, each 16/255 higher, but for the edge over which it repeats.
        let image = GrayImage::from_fn(4, 3, |column, _| Luma([(16 * column) as u8]));
        let map = read(&png(image)).unwrap();
        let rise = 16.0 / 255.0;
        // f16 keeps eleven bits.
        assert!((at(&map, 0.375, 0.5) - Vec2::new(-4.0 * rise, 0.0)).length() < 1e-3);
        assert!((at(&map, 0.125, 0.5) - Vec2::new(4.0 * rise, 0.0)).length() < 1e-3);
        // Higher to the top, which is where v grows.
        let image = GrayImage::from_fn(3, 4, |_, row| Luma([(16 * (3 - row)) as u8]));
        assert!((at(&read(&png(image)).unwrap(), 0.5, 0.375) - Vec2::new(0.0, -4.0 * rise)).length() < 1e-3);
    }

    #[test]
    fn what_is_no_map_is_refused_by_what_was_expected() {
        let refused = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
        assert!(refused(b"normal").contains("a PNG of 8 or 16 bits and at most 4096 × 4096"), "{}", refused(b"normal"));
        assert!(refused(b"#?RADIANCE").contains("Radiance HDR image not supported"), "{}", refused(b"#?RADIANCE"));
        let whole = png(RgbImage::from_pixel(8, 8, Rgb([128, 128, 255])));
        assert!(refused(&whole[..whole.len() / 2]).contains("malformed or truncated PNG"));
        let mut inward = RgbImage::from_pixel(4, 4, Rgb([128, 128, 255]));
        inward.put_pixel(2, 1, Rgb([255, 128, 128]));
        assert!(refused(&png(inward)).starts_with("texel (2, 1) has a normal of z = 0, above 0 expected"));
        assert!(refused(&png(GrayImage::new(4097, 1))).starts_with("4097 × 1 texels, at most 4096 × 4096"));
    }
}
