//! Do two results agree within a named tolerance? The judge of all tests that compare images, GPU with CPU, or with goldens.
//!
//! Two rules: every element (GPU = CPU, storage), and mean with worst pixels (goldens). Neither ever lets a NaN, a wrong size or a
//! wrong number of channels pass.

use super::{Image, Tolerance};

/// How two element sequences of one length differ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ElementReport {
    /// How many were compared.
    pub elements: usize,
    /// How many are beyond the tolerance.
    pub beyond: usize,
    /// The one furthest beyond it, if any.
    pub worst: Option<Difference>,
}

/// One element of both.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Position.
    pub index: usize,
    /// What it should be.
    pub reference: f32,
    /// What it is.
    pub actual: f32,
}

/// Why two results do not agree.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Mismatch {
    /// They cannot be compared element by element.
    #[error("different shapes: reference {reference}, actual {actual}")]
    Shape {
        /// Of the reference.
        reference: String,
        /// Of the result under test.
        actual: String,
    },
    /// One of them holds a NaN, which agrees with nothing.
    #[error("not a number at element {index} of plane {plane}: reference {reference}, actual {actual}")]
    NotANumber {
        /// Channel, 0 for plain sequences.
        plane: usize,
        /// Position in the plane.
        index: usize,
        /// What it should be.
        reference: f32,
        /// What it is.
        actual: f32,
    },
    /// Elements beyond the tolerance.
    #[error(
        "{beyond} of {elements} elements beyond {tolerance}; worst at {index} of plane {plane}: reference {reference}, actual {actual}"
    )]
    Beyond {
        /// The tolerance's name.
        tolerance: &'static str,
        /// How many are beyond.
        beyond: usize,
        /// How many were compared.
        elements: usize,
        /// Channel of the worst, 0 for plain sequences.
        plane: usize,
        /// Position of the worst in its plane.
        index: usize,
        /// What the worst should be.
        reference: f32,
        /// What it is.
        actual: f32,
    },
    /// A golden's mean or worst pixels are beyond their limits.
    #[error(
        "mean {mean:.3} (limit 1), worst 0.1 % {worst:.3} (limit {GOLDEN_WORST_LIMIT}), in units of {tolerance}; worst pixel {column}, {row}"
    )]
    Golden {
        /// The tolerance's name.
        tolerance: &'static str,
        /// Mean pixel error in units of the tolerance.
        mean: f64,
        /// Mean of the worst 0.1 % of pixels, in the same units.
        worst: f64,
        /// Of the worst pixel.
        column: usize,
        /// Of the worst pixel.
        row: usize,
    },
}

/// Counts elements beyond the tolerance. For results in which a known few may flip (silhouettes, nearest texels): the caller states
/// how many and why.
pub fn count_beyond(reference: &[f32], actual: &[f32], tolerance: &Tolerance) -> Result<ElementReport, Mismatch> {
    if reference.len() != actual.len() {
        let shape = |elements: &[f32]| format!("{} elements", elements.len());
        return Err(Mismatch::Shape { reference: shape(reference), actual: shape(actual) });
    }
    let mut report = ElementReport { elements: reference.len(), beyond: 0, worst: None };
    let mut furthest = 1.0;
    for (index, (&reference, &actual)) in reference.iter().zip(actual).enumerate() {
        let error = error_in_tolerances(reference, actual, tolerance);
        if error.is_nan() {
            return Err(Mismatch::NotANumber { plane: 0, index, reference, actual });
        }
        if error > 1.0 {
            report.beyond += 1;
            if error > furthest || report.worst.is_none() {
                furthest = error;
                report.worst = Some(Difference { index, reference, actual });
            }
        }
    }
    Ok(report)
}

/// Every element within the tolerance.
pub fn elements_agree(reference: &[f32], actual: &[f32], tolerance: &Tolerance) -> Result<(), Mismatch> {
    plane_agrees(0, reference, actual, tolerance)
}

/// Every sample of every plane within the tolerance.
pub fn images_agree(reference: &Image, actual: &Image, tolerance: &Tolerance) -> Result<(), Mismatch> {
    check_shapes(reference, actual)?;
    let planes = reference.planes.iter().zip(&actual.planes).enumerate();
    planes.into_iter().try_for_each(|(plane, (reference, actual))| plane_agrees(plane, reference, actual, tolerance))
}

fn plane_agrees(plane: usize, reference: &[f32], actual: &[f32], tolerance: &Tolerance) -> Result<(), Mismatch> {
    let report = count_beyond(reference, actual, tolerance).map_err(|mismatch| match mismatch {
        Mismatch::NotANumber { index, reference, actual, .. } => Mismatch::NotANumber { plane, index, reference, actual },
        other => other,
    })?;
    match report.worst {
        None => Ok(()),
        Some(Difference { index, reference, actual }) => {
            let ElementReport { beyond, elements, .. } = report;
            Err(Mismatch::Beyond { tolerance: tolerance.name(), beyond, elements, plane, index, reference, actual })
        }
    }
}

/// How many tolerances the worst 0.1 % of a golden's pixels may average. A single pixel of a 64 × 64 golden is a fifth of its
/// worst 0.1 % (5 pixels), so it is seen once it is 20 tolerances off; a mean cannot see it at all.
pub const GOLDEN_WORST_LIMIT: f64 = 4.0;

/// How far an image is from its golden, in units of the tolerance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GoldenReport {
    /// Mean over pixels of the worst channel's error.
    pub mean: f64,
    /// The same over the worst 0.1 % of pixels, at least one.
    pub worst: f64,
}

/// The golden rule: the mean pixel error is within the tolerance *and* the worst 0.1 % of pixels average at most [`GOLDEN_WORST_LIMIT`]
/// of it. A pixel's error is its worst channel's.
pub fn golden_agrees(golden: &Image, actual: &Image, tolerance: &Tolerance) -> Result<GoldenReport, Mismatch> {
    check_shapes(golden, actual)?;
    let mut errors = vec![(0.0f64, 0usize); golden.width * golden.height];
    for (plane, (reference, actual)) in golden.planes.iter().zip(&actual.planes).enumerate() {
        for (index, (&reference, &actual)) in reference.iter().zip(actual).enumerate() {
            let error = error_in_tolerances(reference, actual, tolerance);
            if error.is_nan() {
                return Err(Mismatch::NotANumber { plane, index, reference, actual });
            }
            errors[index] = (errors[index].0.max(error), index);
        }
    }
    let mean = errors.iter().map(|(error, _)| error).sum::<f64>() / errors.len().max(1) as f64;
    errors.sort_by(|a, b| b.0.total_cmp(&a.0));
    let worst_pixels = &errors[..errors.len().div_ceil(1_000)];
    let worst = worst_pixels.iter().map(|(error, _)| error).sum::<f64>() / worst_pixels.len().max(1) as f64;
    if mean <= 1.0 && worst <= GOLDEN_WORST_LIMIT {
        return Ok(GoldenReport { mean, worst });
    }
    let index = errors.first().map_or(0, |&(_, index)| index);
    Err(Mismatch::Golden { tolerance: tolerance.name(), mean, worst, column: index % golden.width, row: index / golden.width })
}

/// |actual − reference| over what is allowed: NaN where either is NaN, infinite where nothing is allowed.
fn error_in_tolerances(reference: f32, actual: f32, tolerance: &Tolerance) -> f64 {
    if reference == actual {
        return 0.0;
    }
    (f64::from(actual) - f64::from(reference)).abs() / f64::from(tolerance.allowed(reference))
}

fn check_shapes(reference: &Image, actual: &Image) -> Result<(), Mismatch> {
    let shape = |image: &Image| format!("{} × {} × {}", image.width, image.height, image.channels());
    let planes_are_full = |image: &Image| image.planes.iter().all(|plane| plane.len() == image.width * image.height);
    if shape(reference) == shape(actual) && planes_are_full(reference) && planes_are_full(actual) {
        return Ok(());
    }
    Err(Mismatch::Shape { reference: shape(reference), actual: shape(actual) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::negative_controls::{controls, textured};

    #[test]
    fn equal_images_agree_exactly() {
        let image = textured();
        images_agree(&image, &image, &Tolerance::EXACT).unwrap();
        assert_eq!(golden_agrees(&image, &image, &Tolerance::EXACT).unwrap(), GoldenReport { mean: 0.0, worst: 0.0 });
    }

    #[test]
    fn every_negative_control_is_rejected_by_both_rules_under_every_tolerance() {
        let image = textured();
        for tolerance in Tolerance::ALL {
            for (what, changed) in controls(&image) {
                assert!(images_agree(&image, &changed, &tolerance).is_err(), "elements, {}: {what}", tolerance.name());
                assert!(golden_agrees(&image, &changed, &tolerance).is_err(), "golden, {}: {what}", tolerance.name());
                assert!(images_agree(&changed, &image, &tolerance).is_err(), "elements reversed, {}: {what}", tolerance.name());
                assert!(golden_agrees(&changed, &image, &tolerance).is_err(), "golden reversed, {}: {what}", tolerance.name());
            }
        }
    }

    #[test]
    fn an_element_at_the_bound_passes_and_one_beyond_it_is_counted() {
        let reference = [100.0, 0.0, 1.0, f32::INFINITY];
        let bound = Tolerance::F32_LOOKUP.allowed(100.0);
        elements_agree(&reference, &[100.0 + 0.99 * bound, 0.000_99, 1.0, f32::INFINITY], &Tolerance::F32_LOOKUP).unwrap();
        let report = count_beyond(&reference, &[100.0 - 1.01 * bound, 0.0, 1.1, f32::INFINITY], &Tolerance::F32_LOOKUP).unwrap();
        assert_eq!((report.elements, report.beyond, report.worst.unwrap().index), (4, 2, 2));
    }

    #[test]
    fn infinity_equals_only_itself() {
        for (reference, actual) in [(f32::INFINITY, 1.0), (1.0, f32::INFINITY), (f32::INFINITY, f32::NEG_INFINITY)] {
            for tolerance in Tolerance::ALL {
                assert!(elements_agree(&[reference], &[actual], &tolerance).is_err(), "{reference} and {actual}");
            }
        }
    }

    #[test]
    fn two_nans_do_not_agree() {
        assert!(matches!(elements_agree(&[f32::NAN], &[f32::NAN], &Tolerance::F32_LOOKUP), Err(Mismatch::NotANumber { .. })));
    }

    #[test]
    fn a_golden_forgives_noise_within_its_tolerance_and_no_drift_beyond_it() {
        let golden = textured();
        let shifted_by = |tolerances: f32| {
            let mut actual = golden.clone();
            actual.planes.iter_mut().flatten().for_each(|sample| *sample += tolerances * Tolerance::F16_STORAGE.allowed(*sample));
            golden_agrees(&golden, &actual, &Tolerance::F16_STORAGE)
        };
        shifted_by(0.9).unwrap();
        assert!(matches!(shifted_by(1.2), Err(Mismatch::Golden { .. })));
    }
}
