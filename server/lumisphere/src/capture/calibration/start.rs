//! A first lens without distortion from homographies of a plane (Zhang 2000, "A flexible new technique for camera calibration", §3.1,
//! without skew).

use glam::{DMat3, DVec2, DVec3};

use super::homography::homography;
use super::lens::Lens;
use crate::fitting::cholesky::Cholesky;
use crate::geometry::Distortion;

/// Candidates, to be tried by their error: the closed form, and the one that takes the principal point as the image's middle, which holds
/// up where noise or distortion spoils the first. Empty where the views leave the focal length open. The error is a view
/// that has no homography.
pub(super) fn lens_candidates(size_px: [u32; 2], plane: &[DVec2], seen_px: &[&[DVec2]]) -> Result<Vec<Lens>, usize> {
    let middle = 0.5 * DVec2::new(f64::from(size_px[0]), f64::from(size_px[1]));
    let scale = middle.max_element();
    let mut homographies = Vec::with_capacity(seen_px.len());
    for (view, seen) in seen_px.iter().enumerate() {
        let unit: Vec<DVec2> = seen.iter().map(|&p| (p - middle) / scale).collect();
        let h = homography(plane, &unit).ok_or(view)?;
        // Its first column tells the scale: every view counts alike.
        homographies.push(h * h.x_axis.length().recip());
    }
    let lens = |(focal, center): (DVec2, DVec2)| Lens {
        size_px,
        focal_px: focal * scale,
        center_px: middle + center * scale,
        distortion: Distortion::NONE,
    };
    Ok([closed_form(&homographies), centered(&homographies)].into_iter().flatten().map(lens).collect())
}

// Focal lengths and principal point from the image of the absolute conic B = K⁻ᵀ K⁻¹, with B₁₁ = 1 and B₁₂ = 0.
fn closed_form(homographies: &[DMat3]) -> Option<(DVec2, DVec2)> {
    let [b22, b13, b23, b33] =
        least_squares(homographies, |p, q| ([p.y * q.y, p.x * q.z + p.z * q.x, p.y * q.z + p.z * q.y, p.z * q.z], -p.x * q.x))?;
    let center = -DVec2::new(b13, b23 / b22);
    let fx2 = b33 - center.x * center.x - b22 * center.y * center.y;
    let positive = b22 > 0.0 && fx2 > 0.0 && fx2.is_finite();
    positive.then(|| (DVec2::new(fx2.sqrt(), (fx2 / b22).sqrt()), center))
}

// 1/fx² and 1/fy² with the principal point at the origin.
fn centered(homographies: &[DMat3]) -> Option<(DVec2, DVec2)> {
    let [x, y] = least_squares(homographies, |p, q| ([p.x * q.x, p.y * q.y], -p.z * q.z))?;
    let positive = x > 0.0 && y > 0.0 && x.is_finite() && y.is_finite();
    positive.then(|| (DVec2::new(x.sqrt().recip(), y.sqrt().recip()), DVec2::ZERO))
}

// Of the two conditions h₁ᵀ B h₂ = 0 and h₁ᵀ B h₁ = h₂ᵀ B h₂ of every view; `form` gives pᵀ B q's coefficients and constant.
fn least_squares<const N: usize>(homographies: &[DMat3], form: impl Fn(DVec3, DVec3) -> ([f64; N], f64)) -> Option<[f64; N]> {
    let (mut matrix, mut right) = (vec![0.0; N * N], [0.0; N]);
    for h in homographies {
        let (mixed, (first, second)) = (form(h.x_axis, h.y_axis), (form(h.x_axis, h.x_axis), form(h.y_axis, h.y_axis)));
        let difference: [f64; N] = std::array::from_fn(|i| first.0[i] - second.0[i]);
        for (row, value) in [(mixed.0, mixed.1), (difference, first.1 - second.1)] {
            for i in 0..N {
                right[i] += row[i] * value;
                for j in 0..N {
                    matrix[i * N + j] += row[i] * row[j];
                }
            }
        }
    }
    Cholesky::new(&matrix, N)?.solve(&mut right);
    Some(right)
}
