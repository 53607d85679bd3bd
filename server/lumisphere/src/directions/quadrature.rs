//! Integrals over the hemisphere: Gauss–Legendre in the height, even steps in the azimuth.

use std::f64::consts::{PI, TAU};

use glam::DVec3;

/// Directions above the plane z = 0 with weights in steradians (sum 2π): exact for polynomials in x, y, z of degree below 2·`points`, of which
/// there are 2·`points`². At least one point is used.
pub fn hemisphere_quadrature(points: usize) -> Vec<(DVec3, f64)> {
    let azimuths = 2 * points.max(1);
    let ring = |(height, weight): (f64, f64)| {
        let radius = (1.0 - height * height).sqrt();
        (0..azimuths).map(move |k| {
            let azimuth = TAU * (k as f64 + 0.5) / azimuths as f64;
            (DVec3::new(radius * azimuth.cos(), radius * azimuth.sin(), height), weight * TAU / azimuths as f64)
        })
    };
    gauss_legendre(points.max(1)).into_iter().flat_map(ring).collect()
}

/// Nodes and weights on [0, 1], by Newton's method from Tricomi's first guess (Press and others, "Numerical Recipes", gauleg).
fn gauss_legendre(points: usize) -> Vec<(f64, f64)> {
    let node = |k: usize| {
        let mut x = (PI * (k as f64 + 0.75) / (points as f64 + 0.5)).cos();
        // Quadratic from six digits on: five steps leave rounding alone.
        for _ in 0..5 {
            let (value, slope) = legendre(points, x);
            x -= value / slope;
        }
        let slope = legendre(points, x).1;
        (0.5 * (1.0 + x), 1.0 / ((1.0 - x * x) * slope * slope))
    };
    (0..points).map(node).collect()
}

/// Legendre polynomial and its derivative inside (−1, 1).
fn legendre(degree: usize, x: f64) -> (f64, f64) {
    let (mut before, mut value) = (1.0, x);
    for l in 2..=degree {
        (before, value) = (value, ((2 * l - 1) as f64 * x * value - (l - 1) as f64 * before) / l as f64);
    }
    (value, degree as f64 * (x * value - before) / (x * x - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_below_twice_the_points_are_exact() {
        let integral = |f: &dyn Fn(DVec3) -> f64, points| hemisphere_quadrature(points).iter().map(|(d, w)| w * f(*d)).sum::<f64>();
        for points in [1, 2, 5, 12] {
            let power = 2 * points as i32 - 1;
            // ∫ zᵖ = 2π/(p + 1); rounding of some hundred terms.
            assert!((integral(&|d| d.z.powi(power), points) - TAU / f64::from(power + 1)).abs() < 1e-13, "{points}");
        }
        // ∫ x²y² over the hemisphere is 2π/15.
        assert!((integral(&|d| (d.x * d.y).powi(2), 3) - TAU / 15.0).abs() < 1e-14);
    }
}
