//! From linear radiance to the 8-bit sRGB codes of a screen.
//!
//! Called once a frame by the server, and by the metrics that judge what a viewer sees. Both curves grow monotonically, so each of the
//! 256 codes is an interval of radiance: a table finds the interval instead of a power and an exponential per sample, and the codes are
//! those of the formula, correctly rounded.

use rayon::prelude::*;

use super::{Image, ImageError, Rgb8};
use crate::radiometry::color::{linear_from_srgb, srgb_from_linear};

/// Factor on radiance before the curve: 1 shows radiance 1 as white under [`ToneMap::Clamp`]. Between 2⁻³⁰ and 2³⁰.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Exposure(f32);

impl Exposure {
    /// Radiance as it is.
    pub const ONE: Self = Self(1.0);

    /// None outside 2⁻³⁰…2³⁰, beyond which no sample of a half-float image would land between black and white.
    pub fn new(factor: f32) -> Option<Self> {
        const RANGE: f32 = (1u32 << 30) as f32;
        (1.0 / RANGE..=RANGE).contains(&factor).then_some(Self(factor))
    }

    /// The factor.
    pub fn factor(self) -> f32 {
        self.0
    }
}

/// How radiance becomes light on the screen, in [0, 1]; the sRGB encoding follows in either case.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ToneMap {
    /// y = clamp(exposure · x): exact up to white, cut above. For metrics and comparisons.
    Clamp(Exposure),
    /// y = 1 − exp(−exposure · x): never cuts; about `Clamp` in the dark. The viewer's γ in the parameter-map thesis is this exposure.
    Exponential(Exposure),
}

impl ToneMap {
    /// Radiance 1 is white, no compression.
    pub const PLAIN: Self = Self::Clamp(Exposure::ONE);

    /// sRGB-encoded value, in [0, 1], shown for a linear sample; 0 for NaN and negative ones.
    pub fn encoded(self, linear: f32) -> f32 {
        if !(linear > 0.0) {
            return 0.0;
        }
        let light = match self {
            Self::Clamp(exposure) => (exposure.0 * linear).min(1.0),
            Self::Exponential(exposure) => -(-exposure.0 * linear).exp_m1(),
        };
        srgb_from_linear(light).min(1.0)
    }

    /// Radiance that is shown as an encoded value in [0, 1): the inverse of [`ToneMap::encoded`].
    fn decoded(self, encoded: f32) -> f32 {
        let light = linear_from_srgb(encoded);
        match self {
            Self::Clamp(exposure) => light / exposure.0,
            Self::Exponential(exposure) => -(-light).ln_1p() / exposure.0,
        }
    }
}

/// The first three planes as 8-bit sRGB codes. NaN and negative samples give 0, infinite ones 255.
pub fn tone_mapped(image: &Image, tone_map: ToneMap) -> Result<Rgb8, ImageError> {
    let [red, green, blue, ..] = &image.planes[..] else {
        return Err(ImageError::Shape { expected: "3 planes".into(), actual: format!("{} planes", image.channels()) });
    };
    Ok(codes(image.width, image.height, tone_map, |i| [red[i], green[i], blue[i]]))
}

/// The same of whole rows of linear R G B, as a renderer leaves them.
pub fn tone_mapped_pixels(pixels: &[[f32; 3]], width: usize, tone_map: ToneMap) -> Result<Rgb8, ImageError> {
    Ok(codes(width, whole_rows(pixels, width)?, tone_map, |i| pixels[i]))
}

/// How many.
pub(super) fn whole_rows(pixels: &[[f32; 3]], width: usize) -> Result<usize, ImageError> {
    match width > 0 && pixels.len().is_multiple_of(width) {
        true => Ok(pixels.len() / width),
        false => Err(ImageError::Shape { expected: format!("rows of {width} pixels"), actual: format!("{} pixels", pixels.len()) }),
    }
}

fn codes(width: usize, height: usize, tone_map: ToneMap, pixel: impl Fn(usize) -> [f32; 3] + Sync) -> Rgb8 {
    const PIXELS_PER_TASK: usize = 1 << 14;
    let table = CodeTable::new(tone_map);
    let mut bytes = vec![0; 3 * width * height];
    bytes.par_chunks_mut(3 * PIXELS_PER_TASK).enumerate().for_each(|(task, codes)| {
        let first = task * PIXELS_PER_TASK;
        for (start, codes) in (first..).step_by(BLOCK).zip(codes.chunks_mut(3 * BLOCK)) {
            let mut block = [[0.0; 3]; BLOCK];
            let count = codes.len() / 3;
            block[..count].iter_mut().zip(start..).for_each(|(sample, i)| *sample = pixel(i));
            table.write(block[..count].as_flattened(), codes);
        }
    });
    Rgb8 { width, height, bytes }
}

/// Samples that are looked up together: first all their places in the table, which the compiler does several at a time, then what is there.
const BLOCK: usize = 16;

/// Finds a sample's code among 255 thresholds: the upper bits of an f32 (exponent and 7 bits of mantissa) are a bucket. Buckets are narrower than
/// codes, so that at most one threshold lies in each: an entry is the code of the bucket's lower end in its upper bits, and in its lower bits what,
/// added to the sample's lower bits, carries into the code where they reach the threshold's. Without branches, which noise would mislead.
pub(super) struct CodeTable {
    entries: Vec<u32>,
    first_bucket: u32,
    /// The bits of the lower end of the first bucket, and of what is shown as white.
    range: (i32, i32),
}

impl CodeTable {
    pub(super) fn new(tone_map: ToneMap) -> Self {
        // `thresholds[code]` is the least sample shown as `code`; the last belongs to none and lies in no bucket.
        let mut thresholds = [f32::INFINITY; 257];
        thresholds[0] = 0.0;
        for (code, threshold) in thresholds.iter_mut().enumerate().take(256).skip(1) {
            *threshold = tone_map.decoded((code as f32 - 0.5) / 255.0);
        }
        // One more before, so that the first one's lower end is below the least threshold and not at it.
        let (first_bucket, last_bucket) = (bucket(thresholds[1]) - 1, bucket(thresholds[255]));
        let lower_end = |bucket: u32| bucket << BUCKET_SHIFT;
        let entry = |number: u32| {
            let code = thresholds[1..256].partition_point(|&threshold| threshold.to_bits() <= lower_end(number)) as u32;
            let next = thresholds[code as usize + 1];
            let carry = if bucket(next) == number { (1 << BUCKET_SHIFT) - (next.to_bits() & LOWER_BITS) } else { 0 };
            (code << BUCKET_SHIFT) + carry
        };
        let entries = (first_bucket..=last_bucket).map(entry).collect();
        Self { entries, first_bucket, range: (lower_end(first_bucket) as i32, thresholds[255].to_bits() as i32) }
    }

    /// The codes of as many samples.
    pub(super) fn write(&self, samples: &[f32], codes: &mut [u8]) {
        for (samples, codes) in samples.chunks(BLOCK).zip(codes.chunks_mut(BLOCK)) {
            let mut bits = [0; BLOCK];
            bits.iter_mut().zip(samples).for_each(|(bits, sample)| *bits = self.within(*sample));
            for (bits, code) in bits.iter().zip(codes) {
                let entry = self.entries[((bits >> BUCKET_SHIFT) - self.first_bucket) as usize];
                *code = ((entry + (bits & LOWER_BITS)) >> BUCKET_SHIFT) as u8;
            }
        }
    }

    /// The bits of a sample, or of the end of the range that it is beyond; NaN is black. Of floats that are not negative the order is that of
    /// their bits, and negative ones are negative as integers, too.
    fn within(&self, sample: f32) -> u32 {
        let sample = if sample.is_nan() { 0.0 } else { sample };
        (sample.to_bits() as i32).max(self.range.0).min(self.range.1) as u32
    }
}

const BUCKET_SHIFT: u32 = 16;
const LOWER_BITS: u32 = (1 << BUCKET_SHIFT) - 1;

fn bucket(sample: f32) -> u32 {
    sample.to_bits() >> BUCKET_SHIFT
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAPS: [ToneMap; 5] = [
        ToneMap::PLAIN,
        ToneMap::Clamp(Exposure(0.013)),
        ToneMap::Exponential(Exposure::ONE),
        ToneMap::Exponential(Exposure(37.5)),
        ToneMap::Exponential(Exposure(9.3e-10)),
    ];

    fn coded<const N: usize>(table: &CodeTable, samples: [f32; N]) -> [u8; N] {
        let mut codes = [0; N];
        table.write(&samples, &mut codes);
        codes
    }

    #[test]
    fn table_codes_are_the_formulas_rounded() {
        for tone_map in MAPS {
            let table = CodeTable::new(tone_map);
            let mut seen = [false; 256];
            // Every 4099th float from 2⁻⁶⁰ to 2⁵⁰.
            for bits in (0x2180_0000..0x5880_0000u32).step_by(4_099) {
                let sample = f32::from_bits(bits);
                let exact = tone_map.encoded(sample) * 255.0;
                let [code] = coded(&table, [sample]);
                seen[usize::from(code)] = true;
                // Half a code, and the rounding of f32 powers near the thresholds.
                assert!((f32::from(code) - exact).abs() <= 0.5 + 1e-3, "{tone_map:?}: {sample} is {exact}, table says {code}");
            }
            assert!(seen.iter().all(|&seen| seen), "{tone_map:?} skips codes");
        }
    }

    #[test]
    fn exponential_map_has_its_closed_form() {
        // 1 − e^(−2 · 0.5) = 0.63212 of white, encoded 1.055 · 0.63212^(1/2.4) − 0.055.
        let shown = ToneMap::Exponential(Exposure::new(2.0).unwrap()).encoded(0.5);
        assert!((shown - 0.816_48).abs() < 1e-4, "{shown}");
    }

    #[test]
    fn samples_that_are_not_colours_have_defined_codes() {
        for tone_map in MAPS {
            let table = CodeTable::new(tone_map);
            let codes = coded(&table, [f32::NAN, -f32::NAN, -1.0, f32::NEG_INFINITY, -0.0, 0.0, f32::INFINITY]);
            assert_eq!(codes, [0, 0, 0, 0, 0, 0, 255]);
        }
    }

    #[test]
    fn exposure_outside_its_range_cannot_be_made() {
        for factor in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-10, 1e10] {
            assert!(Exposure::new(factor).is_none(), "{factor}");
        }
    }

    #[test]
    fn planes_become_interleaved_codes_and_back() {
        let codes = Rgb8 { width: 256, height: 3, bytes: (0..256 * 9).map(|index| (index * 31 % 256) as u8).collect() };
        let linear = codes.to_linear();
        assert_eq!(tone_mapped(&linear, ToneMap::PLAIN).unwrap(), codes);
        let [red, green, blue] = &linear.planes[..] else { panic!("three planes") };
        let pixels: Vec<[f32; 3]> = red.iter().zip(green).zip(blue).map(|((r, g), b)| [*r, *g, *b]).collect();
        assert_eq!(tone_mapped_pixels(&pixels, 256, ToneMap::PLAIN).unwrap(), codes);
    }

    #[test]
    fn too_few_planes_and_parts_of_rows_are_typed_errors() {
        for (pixels, width) in [(5, 2), (0, 0), (3, 0)] {
            let refused = tone_mapped_pixels(&vec![[0.0; 3]; pixels], width, ToneMap::PLAIN);
            assert!(matches!(refused, Err(ImageError::Shape { .. })), "{pixels} pixels in rows of {width}");
        }
        assert!(matches!(tone_mapped(&Image::zeros(4, 4, 2), ToneMap::PLAIN), Err(ImageError::Shape { .. })));
    }
}
