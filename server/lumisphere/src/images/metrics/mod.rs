//! How far an image is from its reference, in the measures the papers and the field use.
//!
//! Called by `evaluate`, the client and tests. Radiance measures look at the linear samples; appearance measures (PSNR, SSIM, FLIP) look
//! at what a screen would show, through a [`ToneMap`] that is part of the options. Images of different shape or with a sample that is not
//! finite give an error, never a number. Equal input gives equal numbers for any number of threads.

mod error_image;
mod flip;
mod ssim;

#[cfg(test)]
mod tests;

pub use error_image::{absolute_error_image, flip_error_image};

use rayon::prelude::*;

use super::{Image, ToneMap};
use crate::radiometry::{color::Lab, delta_e_2000};

/// What the measures of appearance assume.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct CompareOptions {
    /// From radiance to the screen, for PSNR, SSIM and FLIP.
    pub display: ToneMap,
    /// How many pixels one degree of the viewer's sight covers, for FLIP.
    pub pixels_per_degree: f32,
}

impl CompareOptions {
    /// Radiance 1 is white; 67 pixels a degree is FLIP's own default (0.7 m from a 0.7 m wide screen of 3840 pixels).
    pub const STANDARD: Self = Self { display: ToneMap::PLAIN, pixels_per_degree: nv_flip::DEFAULT_PIXELS_PER_DEGREE };
}

/// The distance of two images over the compared pixels.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Comparison {
    /// How many pixels were compared: all, or those of the mask.
    pub pixels: usize,
    /// Root mean squared error of linear R, G, B.
    pub rmse_rgb: [f64; 3],
    /// Root mean squared error of L*, a*, b*, of the unclipped linear values, divided by 100 ([`Lab::UNIT_SCALE`]) as in the papers' tables.
    pub rmse_lab: [f64; 3],
    /// Largest absolute error of any linear channel.
    pub max_abs_error: f64,
    /// Peak signal-to-noise ratio of the displayed (sRGB-encoded, not rounded) channels together, in dB; the peak is white, 1. None where
    /// they are equal.
    pub psnr_db: Option<f64>,
    /// Mean structural similarity of the displayed luma (Wang 2004), 1 for equal images. None where no 11 × 11 window fits.
    pub ssim: Option<f64>,
    /// Mean LDR-FLIP error of the displayed 8-bit images, 0–1. Its filters reach beyond the mask's edge.
    pub flip_mean: f64,
    /// Mean CIEDE2000 difference of the unclipped linear colours, in its own unit (1 is just noticeable).
    pub delta_e_2000_mean: f64,
    /// The difference that 95 % of the pixels do not exceed.
    pub delta_e_2000_p95: f64,
}

/// Why two images have no distance.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CompareError {
    /// Different sizes, or not three (or four) planes each.
    #[error("different shapes: reference {reference}, test {test}; both need equal sizes and at least 3 planes")]
    Shape {
        /// Width × height × planes.
        reference: String,
        /// Width × height × planes.
        test: String,
    },
    /// The mask is not one flag a pixel.
    #[error("mask of {mask} flags for {pixels} pixels")]
    MaskSize {
        /// Flags in the mask.
        mask: usize,
        /// Pixels in the images.
        pixels: usize,
    },
    /// No pixel, or none in the mask.
    #[error("no pixel to compare")]
    Empty,
    /// A compared image holds NaN or infinity, in or outside of the mask.
    #[error("{image} image is not finite at column {column}, row {row}")]
    NotFinite {
        /// "reference" or "test".
        image: &'static str,
        /// From the left, from 0.
        column: usize,
        /// From the top, from 0.
        row: usize,
    },
    /// The viewing condition is impossible.
    #[error("pixels per degree must be between 1 and 1000, not {0}")]
    PixelsPerDegree(f32),
}

/// Distance of `test` from `reference` over the pixels whose mask flag is set (all where there is no mask). Only the first three planes
/// count.
pub fn compare(reference: &Image, test: &Image, mask: Option<&[bool]>, options: CompareOptions) -> Result<Comparison, CompareError> {
    check_pair(reference, test)?;
    let indices = compared_pixels(reference, mask)?;
    let radiance = radiance_errors(reference, test, &indices);
    let flip = flip::error_map(reference, test, options)?;
    Ok(Comparison {
        pixels: indices.len(),
        rmse_rgb: radiance.rmse_rgb,
        rmse_lab: radiance.rmse_lab,
        max_abs_error: radiance.max_abs_error,
        psnr_db: psnr_db(reference, test, &indices, options.display),
        ssim: ssim::mean_ssim(reference, test, mask, options.display),
        flip_mean: mean(indices.iter().map(|&index| f64::from(flip[index]))),
        delta_e_2000_mean: mean(radiance.delta_e.iter().copied()),
        delta_e_2000_p95: percentile_95(radiance.delta_e),
    })
}

/// Equal sizes, three finite planes each.
fn check_pair(reference: &Image, test: &Image) -> Result<(), CompareError> {
    let shape = |image: &Image| format!("{} × {} × {}", image.width, image.height, image.channels());
    let fits = |image: &Image| {
        let pixels = image.width * image.height;
        image.channels() >= 3 && image.planes.iter().all(|plane| plane.len() == pixels)
    };
    if (reference.width, reference.height) != (test.width, test.height) || !fits(reference) || !fits(test) {
        return Err(CompareError::Shape { reference: shape(reference), test: shape(test) });
    }
    for (name, image) in [("reference", reference), ("test", test)] {
        for plane in &image.planes[..3] {
            if let Some(index) = plane.iter().position(|sample| !sample.is_finite()) {
                return Err(CompareError::NotFinite { image: name, column: index % image.width, row: index / image.width });
            }
        }
    }
    Ok(())
}

fn compared_pixels(image: &Image, mask: Option<&[bool]>) -> Result<Vec<usize>, CompareError> {
    let pixels = image.width * image.height;
    let indices: Vec<usize> = match mask {
        None => (0..pixels).collect(),
        Some(mask) if mask.len() == pixels => (0..pixels).filter(|&index| mask[index]).collect(),
        Some(mask) => return Err(CompareError::MaskSize { mask: mask.len(), pixels }),
    };
    if indices.is_empty() { Err(CompareError::Empty) } else { Ok(indices) }
}

struct RadianceErrors {
    rmse_rgb: [f64; 3],
    rmse_lab: [f64; 3],
    max_abs_error: f64,
    delta_e: Vec<f64>,
}

fn radiance_errors(reference: &Image, test: &Image, indices: &[usize]) -> RadianceErrors {
    let mut squares_rgb = [0.0; 3];
    let mut max_abs_error = 0.0f64;
    for &index in indices {
        let (expected, actual) = (reference.rgb(index), test.rgb(index));
        for channel in 0..3 {
            let error = f64::from(actual[channel]) - f64::from(expected[channel]);
            squares_rgb[channel] += error * error;
            max_abs_error = max_abs_error.max(error.abs());
        }
    }
    // Colours in parallel, sums in order: the same bytes for any number of threads.
    let colours: Vec<([f64; 3], f64)> = indices.par_iter().map(|&index| lab_error(reference.rgb(index), test.rgb(index))).collect();
    let mut squares_lab = [0.0; 3];
    for (error, _) in &colours {
        for channel in 0..3 {
            squares_lab[channel] += error[channel] * error[channel];
        }
    }
    let root_mean = |squares: f64| (squares / indices.len() as f64).sqrt();
    RadianceErrors {
        rmse_rgb: squares_rgb.map(root_mean),
        rmse_lab: squares_lab.map(|squares| root_mean(squares) / Lab::UNIT_SCALE),
        max_abs_error,
        delta_e: colours.into_iter().map(|(_, delta_e)| delta_e).collect(),
    }
}

/// Differences of L*, a*, b*, and ΔE₀₀.
fn lab_error(expected: [f32; 3], actual: [f32; 3]) -> ([f64; 3], f64) {
    if expected == actual {
        return ([0.0; 3], 0.0);
    }
    let (expected, actual) = (Lab::from_linear(expected), Lab::from_linear(actual));
    ([actual.l - expected.l, actual.a - expected.a, actual.b - expected.b], delta_e_2000(expected, actual))
}

fn psnr_db(reference: &Image, test: &Image, indices: &[usize], display: ToneMap) -> Option<f64> {
    let square = |&index: &usize| -> f64 {
        let shown = |rgb: [f32; 3]| rgb.map(|sample| f64::from(display.encoded(sample)));
        let (expected, actual) = (shown(reference.rgb(index)), shown(test.rgb(index)));
        (0..3).map(|channel| (actual[channel] - expected[channel]).powi(2)).sum()
    };
    let squares: Vec<f64> = indices.par_iter().map(square).collect();
    let mean_square = mean(squares.iter().copied()) / 3.0;
    (mean_square > 0.0).then(|| -10.0 * mean_square.log10())
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

/// The smallest value that at least 95 % of them do not exceed; there is at least one.
fn percentile_95(mut values: Vec<f64>) -> f64 {
    let rank = (values.len() * 95).div_ceil(100) - 1;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}
