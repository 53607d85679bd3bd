//! Eigenvalues of small dense symmetric matrices (at most 100 rows), in double precision. Matrices are full squares, row by row.

use crate::fitting::cholesky::dot;

/// Eigenvalues of a symmetric matrix and its unit eigenvectors, `vectors[n · k ..][..n]` belonging to value k, by Jacobi's rotations.
pub(super) fn eigen(n: usize, mut matrix: Vec<f64>) -> (Vec<f64>, Vec<f64>) {
    let mut vectors = vec![0.0; n * n];
    (0..n).for_each(|i| vectors[n * i + i] = 1.0);
    let size = dot(&matrix, &matrix).sqrt();
    // Quadratic from the third sweep or so on; twenty are never needed.
    for _ in 0..20 {
        let mut rest = 0.0;
        for p in 0..n {
            for q in p + 1..n {
                rest += matrix[n * p + q].abs();
                rotate(n, &mut matrix, &mut vectors, p, q);
            }
        }
        if !(rest > f64::EPSILON * size) {
            break;
        }
    }
    ((0..n).map(|i| matrix[n * i + i]).collect(), vectors)
}

/// Makes element (p, q) zero (Golub and Van Loan, "Matrix Computations", §8.5).
fn rotate(n: usize, matrix: &mut [f64], vectors: &mut [f64], p: usize, q: usize) {
    let element = matrix[n * p + q];
    if element == 0.0 {
        return;
    }
    let tau = (matrix[n * q + q] - matrix[n * p + p]) / (2.0 * element);
    let tangent = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    let sine = tangent * cosine;
    rotate_rows(n, matrix, p, q, cosine, sine);
    for row in matrix.chunks_exact_mut(n) {
        (row[p], row[q]) = (cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]);
    }
    rotate_rows(n, vectors, p, q, cosine, sine);
}

fn rotate_rows(n: usize, matrix: &mut [f64], p: usize, q: usize, cosine: f64, sine: f64) {
    let (above, below) = matrix.split_at_mut(n * q);
    for (p, q) in above[n * p..n * p + n].iter_mut().zip(&mut below[..n]) {
        (*p, *q) = (cosine * *p - sine * *q, sine * *p + cosine * *q);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Hilbert's matrix plus a little of the unit: ill-conditioned (10⁵) but definite.
    fn matrix(n: usize) -> Vec<f64> {
        (0..n * n).map(|at| 1.0 / (at / n + at % n + 1) as f64 + if at / n == at % n { 1e-5 } else { 0.0 }).collect()
    }

    fn times(n: usize, matrix: &[f64], x: &[f64]) -> Vec<f64> {
        matrix.chunks_exact(n).map(|row| dot(row, x)).collect()
    }

    #[test]
    fn eigenvectors_are_only_scaled_by_the_matrix() {
        let n = 21;
        let a = matrix(n);
        let (values, vectors) = eigen(n, a.clone());
        for (k, value) in values.iter().enumerate() {
            let vector = &vectors[n * k..n * (k + 1)];
            assert!((dot(vector, vector) - 1.0).abs() < 1e-13);
            assert!(times(n, &a, vector).iter().zip(vector).all(|(av, v)| (av - value * v).abs() < 1e-13), "{value}");
        }
        let trace: f64 = (0..n).map(|i| a[n * i + i]).sum();
        assert!((values.iter().sum::<f64>() - trace).abs() < 1e-13);
    }
}
