//! LDR-FLIP: what a viewer who flips between two images sees change, per pixel.
//!
//! Source: P. Andersson and others, "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, in its authors' implementation
//! (`nv-flip`), which takes 8-bit sRGB.

use super::{CompareError, CompareOptions};
use crate::images::{Image, Rgb8, tone_mapped};

/// Error of each pixel, 0–1. Both images have been checked to be equally large and to have three planes.
pub(super) fn error_map(reference: &Image, test: &Image, options: CompareOptions) -> Result<Vec<f32>, CompareError> {
    Ok(flip(reference, test, options)?.to_vec())
}

/// The error map in FLIP's own colours (magma: black is equal, yellow-white is as different as can be).
pub(super) fn magma(reference: &Image, test: &Image, options: CompareOptions) -> Result<Rgb8, CompareError> {
    let colours = flip(reference, test, options)?.apply_color_lut(&nv_flip::magma_lut());
    Ok(Rgb8 { width: reference.width, height: reference.height, bytes: colours.to_vec() })
}

fn flip(reference: &Image, test: &Image, options: CompareOptions) -> Result<nv_flip::FlipImageFloat, CompareError> {
    // The filters' width grows with it.
    if !(1.0..=1000.0).contains(&options.pixels_per_degree) {
        return Err(CompareError::PixelsPerDegree(options.pixels_per_degree));
    }
    let shown = |image: &Image| {
        let shape = || format!("{} × {} × {}", image.width, image.height, image.channels());
        let error = || CompareError::Shape { reference: shape(), test: shape() };
        let codes = tone_mapped(image, options.display).map_err(|_| error())?;
        // The library indexes with 32 bits.
        let fits = codes.bytes.len() <= i32::MAX as usize;
        fits.then(|| nv_flip::FlipImageRgb8::with_data(codes.width as u32, codes.height as u32, &codes.bytes)).ok_or_else(error)
    };
    Ok(nv_flip::flip(shown(reference)?, shown(test)?, options.pixels_per_degree))
}
