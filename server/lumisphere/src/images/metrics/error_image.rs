//! Pictures of the error, pixel by pixel.

use super::{CompareError, CompareOptions, check_pair, flip};
use crate::images::{Image, Rgb8};

/// Linear |test − reference| of R, G, B.
pub fn absolute_error_image(reference: &Image, test: &Image) -> Result<Image, CompareError> {
    check_pair(reference, test)?;
    let difference = |channel: usize| {
        let pairs = reference.planes[channel].iter().zip(&test.planes[channel]);
        pairs.map(|(expected, actual)| (actual - expected).abs()).collect()
    };
    Ok(Image { width: reference.width, height: reference.height, planes: (0..3).map(difference).collect() })
}

/// FLIP's error map in its own colours: black where a viewer sees no change, through purple and orange to pale yellow.
pub fn flip_error_image(reference: &Image, test: &Image, options: CompareOptions) -> Result<Rgb8, CompareError> {
    check_pair(reference, test)?;
    if reference.width * reference.height == 0 {
        return Err(CompareError::Empty);
    }
    flip::magma(reference, test, options)
}
