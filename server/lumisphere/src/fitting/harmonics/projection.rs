//! The parameter-map thesis' own fits, sections 12.3.2 and 12.3.3, for comparison: projections that integrate over the samples' areas.
//!
//! Not to be used otherwise: LSOP multiplies the areas' error by the hemisphere's Gram matrix inverted, whose condition is 6·10³ for 16 functions and
//! 3·10¹² for 100, and its error grows from 36 functions on.

use glam::Vec3;

use super::{Basis, HarmonicsFitError, check_directions, check_length, check_numbers};
use crate::directions::{Harmonics, hemisphere_quadrature, planar_voronoi_areas};
use crate::fitting::cholesky::Cholesky;

/// ZH: c = Σ f y Δs, in the spherical basis; zero is assumed below the horizon. Δs is the area of the direction's planar Voronoi cell by its z.
///
/// `directions`: unit, z > 0; `values`: one per direction, finite. The result: one coefficient per function and channel.
pub fn project(functions: usize, directions: &[Vec3], values: &[[f32; 3]]) -> Result<Vec<[f32; 3]>, HarmonicsFitError> {
    let projected = integrals(functions, directions, values)?;
    Ok(interleaved(functions, &projected))
}

/// LSOP: A c = b with A the products' integrals over the hemisphere and b those of [`project`]. The integrals in A are exact.
pub fn optimal_projection(functions: usize, directions: &[Vec3], values: &[[f32; 3]]) -> Result<Vec<[f32; 3]>, HarmonicsFitError> {
    let mut projected = integrals(functions, directions, values)?;
    // Definite in exact arithmetic; with 100 functions pivots come within a factor of a thousand of rounding.
    let gram = Cholesky::new(&hemisphere_gram(functions)?, functions).ok_or(HarmonicsFitError::NoSamples)?;
    for channel in &mut projected {
        gram.solve(channel);
    }
    Ok(interleaved(functions, &projected))
}

/// Per channel, b of each function.
fn integrals(functions: usize, directions: &[Vec3], values: &[[f32; 3]]) -> Result<[Vec<f64>; 3], HarmonicsFitError> {
    let harmonics = Harmonics::new(Basis::Spherical, functions)?;
    check_length("values", values.len(), directions.len())?;
    check_directions(directions)?;
    check_numbers("height of direction", "above 0", directions.iter().map(|d| d.z), |z| z > 0.0)?;
    check_numbers("value", "a finite number", values.iter().flatten().copied(), f32::is_finite)?;
    let mut sums = [0; 3].map(|_| vec![0.0; functions]);
    let mut row = vec![0.0; functions];
    for ((direction, value), area) in directions.iter().zip(values).zip(planar_voronoi_areas(directions)) {
        harmonics.evaluate(direction.as_dvec3().to_array(), &mut row);
        for (sums, &value) in sums.iter_mut().zip(value) {
            sums.iter_mut().zip(&row).for_each(|(sum, y)| *sum += area * f64::from(value) * y);
        }
    }
    Ok(sums)
}

/// ∫ yᵢ yₖ over the hemisphere: polynomials of degree 18 at most in x, y and z.
pub(super) fn hemisphere_gram(functions: usize) -> Result<Vec<f64>, HarmonicsFitError> {
    let harmonics = Harmonics::new(Basis::Spherical, functions)?;
    let mut gram = vec![0.0; functions * functions];
    let mut row = vec![0.0; functions];
    for (direction, weight) in hemisphere_quadrature(10) {
        harmonics.evaluate(direction.to_array(), &mut row);
        for (products, y) in gram.chunks_exact_mut(functions).zip(&row) {
            products.iter_mut().zip(&row).for_each(|(sum, other)| *sum += weight * y * other);
        }
    }
    Ok(gram)
}

/// One array per function from one list per channel.
pub(super) fn interleaved(functions: usize, channels: &[Vec<f64>; 3]) -> Vec<[f32; 3]> {
    (0..functions).map(|index| channels.each_ref().map(|channel| channel[index] as f32)).collect()
}
