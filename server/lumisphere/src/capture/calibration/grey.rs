//! Brightness of a photograph, for finding corners: any monotone curve of radiance will do.

use glam::DVec2;

use crate::images::{Image, Rgb8};

/// `values[row · width + column]`, row 0 at the top; black 0, white about 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Grey {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) values: Vec<f32>,
}

impl Grey {
    /// Mean of the three codes, over 255. Codes serve better than radiance here: corners in the shade count as those in the light.
    pub fn from_codes(codes: &Rgb8) -> Self {
        let values = codes.bytes.chunks_exact(3).map(|p| p.iter().map(|&code| f32::from(code)).sum::<f32>() / (3.0 * 255.0)).collect();
        Self { width: codes.width, height: codes.height, values }
    }

    /// Square root of the mean of the first three planes (or of the only one), a curve near that of codes. What is not finite is black.
    pub fn from_image(image: &Image) -> Self {
        let planes = &image.planes[..image.channels().min(3)];
        let mean = |pixel: usize| planes.iter().map(|plane| plane[pixel]).sum::<f32>() / planes.len().max(1) as f32;
        let values = (0..image.width * image.height).map(mean).map(|v| if v.is_finite() { v.max(0.0).sqrt() } else { 0.0 }).collect();
        Self { width: image.width, height: image.height, values }
    }

    /// Width and height.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width as u32, self.height as u32]
    }

    pub(super) fn at(&self, column: usize, row: usize) -> f64 {
        f64::from(self.values[row * self.width + column])
    }

    /// Between pixel centres, which lie at whole numbers here; None outside of the outermost.
    pub(super) fn between(&self, at: DVec2) -> Option<f64> {
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < self.width as f64 - 1.0 && at.y < self.height as f64 - 1.0;
        if !inside {
            return None;
        }
        let (column, row) = (at.x as usize, at.y as usize);
        let part = at - DVec2::new(column as f64, row as f64);
        let across = |row: usize| self.at(column, row) + part.x * (self.at(column + 1, row) - self.at(column, row));
        Some(across(row) + part.y * (across(row + 1) - across(row)))
    }

    /// Means of two by two pixels; an odd last row or column is dropped.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let value = |i: usize| {
            let (column, row) = (2 * (i % width), 2 * (i / width));
            let sum = self.at(column, row) + self.at(column + 1, row) + self.at(column, row + 1) + self.at(column + 1, row + 1);
            (0.25 * sum) as f32
        };
        Self { width, height, values: (0..width * height).map(value).collect() }
    }

    /// Blurred by a Gaussian of standard deviation `sigma` pixels; the border is continued.
    pub(super) fn blurred(&self, sigma: f64) -> Self {
        let reach = (3.0 * sigma).ceil() as usize;
        let weights: Vec<f32> = (0..=2 * reach).map(|i| (-0.5 * ((i as f64 - reach as f64) / sigma).powi(2)).exp() as f32).collect();
        let sum: f32 = weights.iter().sum();
        let weights: Vec<f32> = weights.iter().map(|w| w / sum).collect();
        let (width, height) = (self.width, self.height);
        let mut rows = vec![0.0; self.values.len()];
        for (from, to) in self.values.chunks_exact(width.max(1)).zip(rows.chunks_exact_mut(width.max(1))) {
            let padded: Vec<f32> = (0..width + 2 * reach).map(|i| from[i.saturating_sub(reach).min(width - 1)]).collect();
            for (i, weight) in weights.iter().enumerate() {
                add_scaled(to, *weight, &padded[i..i + width]);
            }
        }
        let mut values = vec![0.0; rows.len()];
        for (row, to) in values.chunks_exact_mut(width.max(1)).enumerate() {
            for (i, weight) in weights.iter().enumerate() {
                let from = (row + i).saturating_sub(reach).min(height - 1);
                add_scaled(to, *weight, &rows[from * width..(from + 1) * width]);
            }
        }
        Self { width, height, values }
    }
}

fn add_scaled(to: &mut [f32], factor: f32, from: &[f32]) {
    for (t, f) in to.iter_mut().zip(from) {
        *t += factor * f;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_pixels_and_after_halving_a_ramp_stays_a_ramp() {
        let ramp = Grey { width: 6, height: 4, values: (0..24).map(|i| (i % 6) as f32 + 10.0 * (i / 6) as f32).collect() };
        assert!((ramp.between(DVec2::new(2.25, 1.5)).unwrap() - 17.25).abs() < 1e-12);
        assert_eq!(ramp.between(DVec2::new(5.0, 1.0)), None);
        assert_eq!(ramp.between(DVec2::new(f64::NAN, 1.0)), None);
        // The first mean is over columns 0 1 and rows 0 1.
        assert_eq!(ramp.halved().values, vec![5.5, 7.5, 9.5, 25.5, 27.5, 29.5]);
    }

    #[test]
    fn a_blur_keeps_the_sum_and_spreads_by_its_sigma() {
        let mut dot = Grey { width: 31, height: 31, values: vec![0.0; 961] };
        dot.values[15 * 31 + 15] = 1.0;
        let blurred = dot.blurred(2.0);
        let moment = |f: &dyn Fn(f64) -> f64| -> f64 { (0..961).map(|i| f64::from(blurred.values[i]) * f((i % 31) as f64 - 15.0)).sum() };
        // f32 sums of 961 terms; cut at three sigma the variance lacks 3 %.
        assert!((moment(&|_| 1.0) - 1.0).abs() < 1e-5);
        assert!((moment(&|d| d * d) / 4.0 - 0.97).abs() < 0.02);
    }
}
