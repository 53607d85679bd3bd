//! Lens distortion after Brown (1966, "Decentering distortion of lenses"): two radial and two tangential coefficients.
//!
//! Called by [`PhotographCamera`](super::PhotographCamera) and by calibration. Coordinates are normalised: image position less principal
//! point, divided by the focal length; x right, y down, as in OpenCV, COLMAP and Bouguet's toolbox, whose coefficients are these.
//! Far outside the image the radial polynomial may turn back: a point beyond that fold would land inside the image again. It has no
//! image here, and nothing beyond the fold is ever returned.

use glam::{DMat2, DVec2};
use thiserror::Error;

/// `x_d = x (1 + k₁ r² + k₂ r⁴) + (2 p₁ x y + p₂ (r² + 2 x²), p₁ (r² + 2 y²) + 2 p₂ x y)`, `r = |x|`. No coefficient has a unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Distortion {
    k1: f64,
    k2: f64,
    p1: f64,
    p2: f64,
    fold_radius: f64,
}

/// Why there is no distortion, or no undistorted position.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum DistortionError {
    /// A coefficient is NaN or infinite.
    #[error("distortion coefficients k1 k2 p1 p2 are {0:?}, finite numbers expected")]
    NotFinite([f64; 4]),
    /// No position before the lens's fold is imaged here.
    #[error("no ray reaches the normalised image position ({}, {}): the distortion folds back at radius {fold_radius}", at.x, at.y)]
    NoRay {
        /// As asked.
        at: DVec2,
        /// See [`Distortion::fold_radius`].
        fold_radius: f64,
    },
}

impl Distortion {
    /// A pinhole.
    pub const NONE: Self = Self { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, fold_radius: f64::INFINITY };

    /// From k₁ k₂ p₁ p₂, in OpenCV's order. Errors when one is not finite.
    pub fn new(coefficients: [f64; 4]) -> Result<Self, DistortionError> {
        let [k1, k2, p1, p2] = coefficients;
        if !coefficients.iter().all(|c| c.is_finite()) {
            return Err(DistortionError::NotFinite(coefficients));
        }
        Ok(Self { k1, k2, p1, p2, fold_radius: fold_radius(k1, k2) })
    }

    /// k₁ k₂ p₁ p₂.
    pub fn coefficients(&self) -> [f64; 4] {
        [self.k1, self.k2, self.p1, self.p2]
    }

    /// Undistorted radius up to which the radial part grows: beyond it `distort` has no image. Infinite where it always grows.
    pub fn fold_radius(&self) -> f64 {
        self.fold_radius
    }

    /// Where the lens images the undistorted position `at`; None at or beyond the fold.
    pub fn distort(&self, at: DVec2) -> Option<DVec2> {
        let inside = at.length() < self.fold_radius && self.jacobian(at).determinant() > 0.0;
        inside.then(|| self.polynomial(at))
    }

    /// Derivative of the distorted by the undistorted position; columns by x and y.
    pub fn jacobian(&self, at: DVec2) -> DMat2 {
        let DVec2 { x, y } = at;
        let r2 = at.length_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * self.k2);
        let slope = 2.0 * self.k1 + 4.0 * self.k2 * r2;
        let cross = slope * x * y + 2.0 * (self.p1 * x + self.p2 * y);
        DMat2::from_cols(
            DVec2::new(radial + slope * x * x + 2.0 * self.p1 * y + 6.0 * self.p2 * x, cross),
            DVec2::new(cross, radial + slope * y * y + 6.0 * self.p1 * y + 2.0 * self.p2 * x),
        )
    }

    /// The undistorted position that the lens images at `at`, by Newton's method. Errors where there is none before the fold.
    pub fn undistort(&self, at: DVec2) -> Result<DVec2, DistortionError> {
        // Newton converges quadratically; from the far side of a strong barrel it is damped first.
        const MOST_STEPS: usize = 60;
        const CLOSE: f64 = 1e-13;
        let no_ray = DistortionError::NoRay { at, fold_radius: self.fold_radius };
        let limit = CLOSE * (1.0 + at.length());
        let mut found = DVec2::ZERO;
        for _ in 0..MOST_STEPS {
            let missing = at - self.polynomial(found);
            if missing.length() <= limit {
                return self.distort(found).map(|_| found).ok_or(no_ray);
            }
            let jacobian = self.jacobian(found);
            if !(jacobian.determinant() > 0.0) {
                return Err(no_ray);
            }
            found = self.nearer(found, jacobian.inverse() * missing, at, missing.length()).ok_or(no_ray)?;
        }
        Err(no_ray)
    }

    // The step, halved until it stays before the fold and brings the image nearer to `at`.
    fn nearer(&self, from: DVec2, step: DVec2, at: DVec2, before: f64) -> Option<DVec2> {
        (0..40).map(|halvings| from + step * 0.5f64.powi(halvings)).find(|&to| {
            to.length() < self.fold_radius && self.jacobian(to).determinant() > 0.0 && (at - self.polynomial(to)).length() < before
        })
    }

    fn polynomial(&self, at: DVec2) -> DVec2 {
        let DVec2 { x, y } = at;
        let r2 = at.length_squared();
        let tangential = DVec2::new(
            2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x), //
            self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        );
        at * (1.0 + r2 * (self.k1 + r2 * self.k2)) + tangential
    }
}

// Smallest r > 0 at which d/dr (r + k₁ r³ + k₂ r⁵) = 1 + 3 k₁ s + 5 k₂ s², s = r², is zero.
fn fold_radius(k1: f64, k2: f64) -> f64 {
    let (a, b) = (5.0 * k2, 3.0 * k1);
    let discriminant = b * b - 4.0 * a;
    if !(discriminant >= 0.0) {
        return f64::INFINITY;
    }
    // 1/s from the reversed polynomial s⁻² + b s⁻¹ + a: no division by a vanishing k₂.
    let largest_inverse = 0.5 * (-b + discriminant.sqrt());
    if largest_inverse > 0.0 { largest_inverse.recip().sqrt() } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Of the data pack's checkerboard camera, of a strong barrel, of a pincushion.
    const LENSES: [[f64; 4]; 3] = [[-0.2651, -0.0467, 0.0018, -0.0003], [-0.4, 0.12, 0.002, -0.003], [0.15, 0.02, -0.001, 0.004]];

    #[test]
    fn undistorting_undoes_distorting_up_to_the_fold() {
        for lens in LENSES.map(|c| Distortion::new(c).unwrap()) {
            let reach = lens.fold_radius().min(1.5);
            for turn in 0..12 {
                for part in [0.0, 0.3, 0.6, 0.9, 0.97] {
                    let at = DVec2::from_angle(0.5 * turn as f64) * part * reach;
                    let Some(image) = lens.distort(at) else { panic!("{at} is before the fold at {reach}") };
                    // Newton stops at 1e-13; near the fold the inverse's slope is at most 1 / 0.05.
                    let back = lens.undistort(image).unwrap();
                    assert!((back - at).length() < 1e-11, "{at} came back as {back}");
                }
            }
        }
    }

    #[test]
    fn the_coefficients_stand_in_opencvs_order() {
        // cv2.projectPoints of (0.3, -0.2, 1) with these coefficients and K = I, OpenCV 5.0.
        let at = Distortion::new([-0.3, 0.1, 0.01, -0.02]).unwrap().distort(DVec2::new(0.3, -0.2)).unwrap();
        assert!((at - DVec2::new(0.281407, -0.188038)).length() < 1e-12, "{at}");
    }

    #[test]
    fn the_jacobian_is_the_slope() {
        let lens = Distortion::new(LENSES[1]).unwrap();
        let (at, h) = (DVec2::new(0.4, -0.3), 1e-6);
        let column = |d: DVec2| (lens.distort(at + h * d).unwrap() - lens.distort(at - h * d).unwrap()) / (2.0 * h);
        // Central differences: h² · third derivative (about 10) + rounding 1e-16 / h.
        assert!((lens.jacobian(at).x_axis - column(DVec2::X)).length() < 1e-9);
        assert!((lens.jacobian(at).y_axis - column(DVec2::Y)).length() < 1e-9);
    }

    #[test]
    fn beyond_the_fold_there_is_neither_image_nor_ray() {
        // r − 0.4 r³ grows up to r = √(1/1.2) and reaches 2/3 of that.
        let lens = Distortion::new([-0.4, 0.0, 0.0, 0.0]).unwrap();
        let fold = (1.0f64 / 1.2).sqrt();
        assert!((lens.fold_radius() - fold).abs() < 1e-12);
        assert_eq!(lens.distort(DVec2::X * 1.01 * fold), None);
        assert!(lens.undistort(DVec2::X * 0.99 * fold * 2.0 / 3.0).is_ok());
        assert!(matches!(lens.undistort(DVec2::X * 1.01 * fold * 2.0 / 3.0), Err(DistortionError::NoRay { .. })));
        assert!(matches!(lens.undistort(DVec2::new(f64::NAN, 0.0)), Err(DistortionError::NoRay { .. })));
    }

    #[test]
    fn coefficients_that_are_not_finite_are_refused() {
        assert!(matches!(Distortion::new([0.0, f64::NAN, 0.0, 0.0]), Err(DistortionError::NotFinite(_))));
    }
}
