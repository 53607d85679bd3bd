//! Structural similarity of what the screen shows.
//!
//! Source: Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli, "Image quality assessment: from error visibility to structural similarity",
//! IEEE Transactions on Image Processing 13(4), 2004, equation 13: an 11 × 11 Gaussian window of σ = 1.5, K₁ = 0.01, K₂ = 0.03, windows that
//! lie wholly inside the image, no downsampling. The one plane compared is the Rec. 709 luma of the displayed (sRGB-encoded) values,
//! whose range is L = 1.

use rayon::prelude::*;

use crate::images::{Image, ToneMap};
use crate::radiometry::color::luminance;

const RADIUS: usize = 5;
const WINDOW: usize = 2 * RADIUS + 1;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Mean over windows whose centre is in the mask; None where there is none.
pub(super) fn mean_ssim(reference: &Image, test: &Image, mask: Option<&[bool]>, display: ToneMap) -> Option<f64> {
    let (width, height) = (reference.width, reference.height);
    if width < WINDOW || height < WINDOW {
        return None;
    }
    let (x, y) = (luma(reference, display), luma(test, display));
    let weights = gaussian();
    let rows: Vec<Row> = (0..height).into_par_iter().map(|row| Row::blurred(&x, &y, row * width..(row + 1) * width, &weights)).collect();
    // One sum a row, added in order: the same bytes for any number of threads.
    let sums: Vec<(f64, usize)> = (RADIUS..height - RADIUS)
        .into_par_iter()
        .map(|row| {
            let inside = |column: usize| mask.is_none_or(|mask| mask[row * width + column]);
            let centres = (RADIUS..width - RADIUS).filter(|&column| inside(column));
            let similarities = centres.map(|column| similarity(&rows[row - RADIUS..=row + RADIUS], column - RADIUS, &weights));
            similarities.fold((0.0, 0), |(sum, count), similarity| (sum + similarity, count + 1))
        })
        .collect();
    let (sum, count) = sums.into_iter().fold((0.0, 0), |(sum, count), row| (sum + row.0, count + row.1));
    (count > 0).then(|| sum / count as f64)
}

fn luma(image: &Image, display: ToneMap) -> Vec<f64> {
    let luma = |index: usize| f64::from(luminance(image.rgb(index).map(|sample| display.encoded(sample))));
    (0..image.width * image.height).into_par_iter().map(luma).collect()
}

fn gaussian() -> [f64; WINDOW] {
    let weights: [f64; WINDOW] = std::array::from_fn(|tap| (-(tap as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// Weighted sums of x, y, x², y², xy.
type Moments = [f64; 5];

/// The window's horizontal pass over one row, for each centre at least `RADIUS` from the ends.
struct Row(Vec<Moments>);

impl Row {
    fn blurred(x: &[f64], y: &[f64], row: std::ops::Range<usize>, weights: &[f64; WINDOW]) -> Self {
        let (x, y) = (&x[row.clone()], &y[row]);
        let moments = x.windows(WINDOW).zip(y.windows(WINDOW)).map(|(x, y)| {
            let mut moments = [0.0; 5];
            for ((&x, &y), &weight) in x.iter().zip(y).zip(weights) {
                for (moment, value) in moments.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                    *moment += weight * value;
                }
            }
            moments
        });
        Self(moments.collect())
    }
}

/// Equation 13 at one window, from its `WINDOW` blurred rows.
fn similarity(rows: &[Row], column: usize, weights: &[f64; WINDOW]) -> f64 {
    let mut moments = [0.0; 5];
    for (row, &weight) in rows.iter().zip(weights) {
        for (moment, value) in moments.iter_mut().zip(row.0[column]) {
            *moment += weight * value;
        }
    }
    let [mean_x, mean_y, xx, yy, xy] = moments;
    let (variance_x, variance_y, covariance) = (xx - mean_x * mean_x, yy - mean_y * mean_y, xy - mean_x * mean_y);
    (2.0 * mean_x * mean_y + C1) * (2.0 * covariance + C2) / ((mean_x * mean_x + mean_y * mean_y + C1) * (variance_x + variance_y + C2))
}
