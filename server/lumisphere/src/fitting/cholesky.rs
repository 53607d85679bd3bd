//! Small dense symmetric systems, solved by Cholesky's factorisation in f64. Matrices are full squares, row by row.

/// Lower factor L of a symmetric positive definite matrix L Lᵀ; zeros above the diagonal.
#[derive(Debug, Clone)]
pub struct Cholesky {
    size: usize,
    lower: Vec<f64>,
}

impl Cholesky {
    /// None when the matrix (`size`² entries, of which the lower half is read) is not positive definite within rounding, or holds NaN.
    pub fn new(matrix: &[f64], size: usize) -> Option<Self> {
        // A pivot that lost all its digits is zero in truth: singular, not badly conditioned.
        const LEAST_PIVOT: f64 = 1e-14;
        if matrix.len() != size * size {
            return None;
        }
        let mut lower = vec![0.0; size * size];
        for i in 0..size {
            let (above, row) = lower.split_at_mut(size * i);
            for j in 0..i {
                let other = &above[size * j..size * j + size];
                row[j] = (matrix[size * i + j] - dot(&row[..j], &other[..j])) / other[j];
            }
            let pivot = matrix[size * i + i] - dot(&row[..i], &row[..i]);
            if !(pivot > LEAST_PIVOT * matrix[size * i + i] && pivot.is_finite()) {
                return None;
            }
            row[i] = pivot.sqrt();
        }
        Some(Self { size, lower })
    }

    /// `x` of `matrix · x = right`, in place. `right` is `size` long.
    pub fn solve(&self, right: &mut [f64]) {
        self.solve_lower(right);
        self.solve_upper(right);
    }

    /// L⁻¹ x in place. `x` is `size` long.
    pub fn solve_lower(&self, x: &mut [f64]) {
        for (i, row) in self.lower.chunks_exact(self.size.max(1)).enumerate() {
            x[i] = (x[i] - dot(&row[..i], &x[..i])) / row[i];
        }
    }

    /// L⁻ᵀ x in place. `x` is `size` long.
    pub fn solve_upper(&self, x: &mut [f64]) {
        for (i, row) in self.lower.chunks_exact(self.size.max(1)).enumerate().rev() {
            let value = x[i] / row[i];
            x[i] = value;
            x[..i].iter_mut().zip(row).for_each(|(x, factor)| *x -= factor * value);
        }
    }

    /// The matrix's inverse.
    pub fn inverse(&self) -> Vec<f64> {
        let n = self.size;
        let mut inverse = vec![0.0; n * n];
        // Symmetric, so a solved column is a row.
        for (i, row) in inverse.chunks_exact_mut(n.max(1)).enumerate() {
            row[i] = 1.0;
            self.solve(row);
        }
        inverse
    }

    /// Diagonal of the matrix's inverse, at a third of its cost: sums of squares down the columns of L⁻¹.
    pub fn inverse_diagonal(&self) -> Vec<f64> {
        let n = self.size;
        // Row i of L⁻¹ from the rows before it.
        let mut inverse = vec![0.0; n * n];
        let mut diagonal = vec![0.0; n];
        for i in 0..n {
            let factor = &self.lower[n * i..n * (i + 1)];
            let (above, row) = inverse.split_at_mut(n * i);
            for j in 0..i {
                let other = &above[n * j..n * j + j + 1];
                row.iter_mut().zip(other).for_each(|(sum, other)| *sum -= factor[j] * other);
            }
            row[i] = 1.0;
            let scale = 1.0 / factor[i];
            for (value, sum) in row[..=i].iter_mut().zip(&mut diagonal) {
                *value *= scale;
                *sum += *value * *value;
            }
        }
        diagonal
    }
}

/// Σ aᵢ bᵢ in eight partial sums, which the compiler keeps in vector registers.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut sums = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..8 {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum::<f64>() + rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_satisfies_the_system() {
        let matrix = [4.0, 1.0, 0.5, 1.0, 3.0, -1.0, 0.5, -1.0, 2.0];
        let mut x = [1.0, 2.0, 3.0];
        Cholesky::new(&matrix, 3).unwrap().solve(&mut x);
        for (row, expected) in matrix.chunks(3).zip([1.0, 2.0, 3.0]) {
            let found: f64 = row.iter().zip(x).map(|(a, b)| a * b).sum();
            // Condition number below 10.
            assert!((found - expected).abs() < 1e-14);
        }
    }

    #[test]
    fn an_ill_conditioned_system_is_solved_and_its_inverse_known() {
        // Hilbert's matrix and a little of the unit: condition 10⁵.
        let n = 21;
        let matrix: Vec<f64> =
            (0..n * n).map(|at| 1.0 / (at / n + at % n + 1) as f64 + if at / n == at % n { 1e-5 } else { 0.0 }).collect();
        let cholesky = Cholesky::new(&matrix, n).unwrap();
        let (inverse, diagonal) = (cholesky.inverse(), cholesky.inverse_diagonal());
        for (i, column) in inverse.chunks(n).enumerate() {
            // Backward stable: a residual of some rounding errors of the solution's size, 10⁵.
            let expected = |k: usize| if k == i { 1.0 } else { 0.0 };
            assert!(matrix.chunks(n).enumerate().all(|(k, row)| (dot(row, column) - expected(k)).abs() < 1e-10));
            assert!((diagonal[i] - column[i]).abs() < 1e-10 * column[i]);
        }
    }

    #[test]
    fn what_is_singular_indefinite_or_no_number_is_refused() {
        assert!(Cholesky::new(&[1.0, 1.0, 1.0, 1.0], 2).is_none());
        assert!(Cholesky::new(&[1.0, 2.0, 2.0, 1.0], 2).is_none());
        assert!(Cholesky::new(&[f64::NAN], 1).is_none());
        assert!(Cholesky::new(&[1.0], 2).is_none());
    }
}
