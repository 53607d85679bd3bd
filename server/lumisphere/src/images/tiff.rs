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

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use image::codecs::tiff::TiffEncoder;
    use image::{ExtendedColorType, ImageEncoder};

    use super::*;

    /// Two pixels.
    fn tiff(samples: &[u8], color: ExtendedColorType) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        TiffEncoder::new(&mut bytes).write_image(samples, 2, 1, color).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn codes_are_those_of_the_file_and_16_bits_are_rounded() {
        let codes = [0, 1, 127, 128, 254, 255];
        let read = |bytes: &[u8]| decode_tiff_codes(bytes, ReadLimits::SCENE).unwrap().bytes;
        assert_eq!(read(&tiff(&codes, ExtendedColorType::Rgb8)), codes);
        // 257 steps of 16 bits are one of 8: 128 is over the half.
        let finer: Vec<u8> = [0_u16, 128, 129, 257, 65_535, 65_406].iter().flat_map(|code| code.to_ne_bytes()).collect();
        assert_eq!(read(&tiff(&finer, ExtendedColorType::Rgb16)), [0, 0, 1, 1, 255, 254]);
    }

    #[test]
    fn floating_point_samples_are_refused() {
        for (color, channels) in [(ExtendedColorType::Rgb32F, 3), (ExtendedColorType::Rgba32F, 4)] {
            let bytes = tiff(&0.5_f32.to_ne_bytes().repeat(2 * channels), color);
            for error in [decode_tiff(&bytes, ReadLimits::SCENE).err(), decode_tiff_codes(&bytes, ReadLimits::SCENE).err()] {
                let told = error.map(|error| error.to_string()).unwrap_or_default();
                assert!(told.contains("floating-point samples"), "{color:?}: {told:?}");
            }
        }
    }
}
