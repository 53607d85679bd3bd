//! Damped Gauss–Newton (Levenberg 1944, Marquardt 1963) in f64 for residuals in blocks that share some parameters.
//!
//! Every residual depends on the shared parameters and on those of its own block, so the normal equations are an arrow: the blocks are
//! eliminated one by one and what remains (Schur's complement) is as small as the shared part. No shared parameters: independent small
//! problems. One block: an ordinary dense problem. Parameters may be of any type that can be moved by a step (rotations are).
//! Called by `capture::calibration`. The damping follows Nielsen (1999, IMM-REP-1999-05).

use thiserror::Error;

use super::cholesky::Cholesky;

/// Takes a residual and its derivatives by the shared and by the block's step.
pub type Rows<'a> = dyn FnMut(f64, &[f64], &[f64]) + 'a;

/// A sum of squares to be minimised.
pub trait Problem {
    /// Parameters that every residual may depend on.
    type Shared: Clone;
    /// Parameters of one block.
    type Block: Clone;

    /// Length of a step of the shared parameters.
    fn shared_len(&self) -> usize;

    /// Length of a step of a block's parameters.
    fn block_len(&self) -> usize;

    /// Calls `row` with each residual of block `index` and its derivatives by the shared and by the block's step. None where the residuals
    /// are undefined; such parameters are never stepped to.
    fn rows(&self, index: usize, shared: &Self::Shared, block: &Self::Block, row: &mut Rows) -> Option<()>;

    /// Parameters after a step.
    fn shared_moved(&self, shared: &Self::Shared, step: &[f64]) -> Self::Shared;

    /// Parameters after a step.
    fn block_moved(&self, block: &Self::Block, step: &[f64]) -> Self::Block;
}

/// Why the minimisation ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Termination {
    /// No step is predicted to lower the cost by more than a part in 10¹⁴, or the step vanished.
    Converged,
    /// The iterations are used up.
    IterationLimit,
    /// However short, no step lowers the cost.
    Stuck,
}

/// What the minimisation did. Costs are half the sum of the squared residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// Why it ended.
    pub termination: Termination,
    /// Systems solved.
    pub iterations: usize,
    /// Before.
    pub initial_cost: f64,
    /// After; never above `initial_cost`.
    pub final_cost: f64,
}

/// The minimum found.
#[derive(Debug, Clone)]
pub struct Solution<Shared, Block> {
    /// Shared parameters.
    pub shared: Shared,
    /// Each block's parameters.
    pub blocks: Vec<Block>,
    /// How it was reached.
    pub summary: Summary,
    /// Covariance of the shared step under residuals of unit variance, row by row. None where the residuals do not determine it.
    pub shared_covariance: Option<Vec<f64>>,
}

/// Why there is nothing to minimise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("residuals are undefined or not finite at the start, in block {block}")]
pub struct UndefinedStart {
    /// The first such block.
    pub block: usize,
}

/// Minimises from a start at which the residuals are defined.
pub fn minimise<P: Problem>(
    problem: &P,
    shared: P::Shared,
    blocks: Vec<P::Block>,
    most_iterations: usize,
) -> Result<Solution<P::Shared, P::Block>, UndefinedStart> {
    const INITIAL_DAMPING: f64 = 1e-4;
    const GREATEST_DAMPING: f64 = 1e20;
    // Of the cost: below it, differences of sums of squares are rounding.
    const LEAST_DECREASE: f64 = 1e-14;

    let (mut shared, mut blocks) = (shared, blocks);
    let mut normal = Normal::at(problem, &shared, &blocks)?;
    let initial_cost = normal.cost;
    let (mut damping, mut growth) = (INITIAL_DAMPING, 2.0);
    let (mut termination, mut iterations) = (Termination::IterationLimit, 0);
    while iterations < most_iterations {
        iterations += 1;
        let step = normal.step(damping);
        if step.as_ref().is_some_and(|step| !(step.predicted_decrease > LEAST_DECREASE * normal.cost)) {
            termination = Termination::Converged;
            break;
        }
        let moved = step.and_then(|step| {
            let shared = problem.shared_moved(&shared, &step.shared);
            let blocks: Vec<_> = blocks.iter().zip(&step.blocks).map(|(block, step)| problem.block_moved(block, step)).collect();
            let next = Normal::at(problem, &shared, &blocks).ok().filter(|next| next.cost < normal.cost)?;
            Some((shared, blocks, next, step.predicted_decrease))
        });
        if let Some((moved_shared, moved_blocks, next, predicted_decrease)) = moved {
            let gain = (normal.cost - next.cost) / predicted_decrease;
            damping *= (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0);
            growth = 2.0;
            (shared, blocks, normal) = (moved_shared, moved_blocks, next);
            continue;
        }
        damping *= growth;
        growth *= 2.0;
        if damping > GREATEST_DAMPING {
            termination = Termination::Stuck;
            break;
        }
    }
    let summary = Summary { termination, iterations, initial_cost, final_cost: normal.cost };
    Ok(Solution { shared, blocks, summary, shared_covariance: normal.shared_covariance() })
}

// Normal equations: JᵀJ in its arrow's parts, Jᵀr, and the cost.
struct Normal {
    shared_len: usize,
    block_len: usize,
    cost: f64,
    shared: Vec<f64>,
    shared_gradient: Vec<f64>,
    blocks: Vec<BlockPart>,
}

struct BlockPart {
    own: Vec<f64>,
    // Shared rows, block columns.
    coupling: Vec<f64>,
    gradient: Vec<f64>,
}

struct Step {
    shared: Vec<f64>,
    blocks: Vec<Vec<f64>>,
    predicted_decrease: f64,
}

impl Normal {
    fn at<P: Problem>(problem: &P, shared: &P::Shared, blocks: &[P::Block]) -> Result<Self, UndefinedStart> {
        let (s, b) = (problem.shared_len(), problem.block_len());
        let mut sum =
            Self { shared_len: s, block_len: b, cost: 0.0, shared: vec![0.0; s * s], shared_gradient: vec![0.0; s], blocks: Vec::new() };
        for (index, block) in blocks.iter().enumerate() {
            let mut part = BlockPart { own: vec![0.0; b * b], coupling: vec![0.0; s * b], gradient: vec![0.0; b] };
            let mut row = |residual: f64, by_shared: &[f64], by_block: &[f64]| {
                sum.cost += 0.5 * residual * residual;
                add_outer(&mut sum.shared, by_shared, by_shared);
                add_outer(&mut part.coupling, by_shared, by_block);
                add_outer(&mut part.own, by_block, by_block);
                add_scaled(&mut sum.shared_gradient, residual, by_shared);
                add_scaled(&mut part.gradient, residual, by_block);
            };
            problem.rows(index, shared, block, &mut row).ok_or(UndefinedStart { block: index })?;
            if !sum.cost.is_finite() {
                return Err(UndefinedStart { block: index });
            }
            sum.blocks.push(part);
        }
        Ok(sum)
    }

    // Of (JᵀJ + damping · diag(JᵀJ)) step = −Jᵀr. None when that is singular.
    fn step(&self, damping: f64) -> Option<Step> {
        let (schur, mut shared, solved) = self.reduced(damping)?;
        let factor = Cholesky::new(&schur, self.shared_len)?;
        factor.solve(&mut shared);
        let mut blocks = Vec::with_capacity(self.blocks.len());
        for (part, solved) in self.blocks.iter().zip(&solved) {
            let mut right: Vec<f64> = part.gradient.iter().map(|g| -g).collect();
            for (row, step) in part.coupling.chunks_exact(self.block_len.max(1)).zip(&shared) {
                add_scaled(&mut right, -step, row);
            }
            solved.solve(&mut right);
            blocks.push(right);
        }
        let predicted_decrease = self.predicted_decrease(&shared, &blocks, damping);
        Some(Step { shared, blocks, predicted_decrease })
    }

    // Schur's complement, its right-hand side, and the factored blocks.
    fn reduced(&self, damping: f64) -> Option<(Vec<f64>, Vec<f64>, Vec<Cholesky>)> {
        let (s, b) = (self.shared_len, self.block_len);
        let mut schur = damped(&self.shared, s, damping);
        let mut right: Vec<f64> = self.shared_gradient.iter().map(|g| -g).collect();
        let mut factors = Vec::with_capacity(self.blocks.len());
        for part in &self.blocks {
            let factor = Cholesky::new(&damped(&part.own, b, damping), b)?;
            let mut by_gradient = part.gradient.clone();
            factor.solve(&mut by_gradient);
            for i in 0..s {
                let mut column = part.coupling[i * b..(i + 1) * b].to_vec();
                right[i] += dot(&column, &by_gradient);
                factor.solve(&mut column);
                for j in 0..s {
                    schur[j * s + i] -= dot(&part.coupling[j * b..(j + 1) * b], &column);
                }
            }
            factors.push(factor);
        }
        Some((schur, right, factors))
    }

    // Half of stepᵀ (damping · diag · step − Jᵀr): what the quadratic model loses.
    fn predicted_decrease(&self, shared: &[f64], blocks: &[Vec<f64>], damping: f64) -> f64 {
        let lost = |matrix: &[f64], gradient: &[f64], step: &[f64]| -> f64 {
            let n = step.len();
            step.iter().enumerate().map(|(i, &d)| 0.5 * d * (damping * matrix[i * n + i] * d - gradient[i])).sum()
        };
        let of_blocks: f64 = self.blocks.iter().zip(blocks).map(|(part, step)| lost(&part.own, &part.gradient, step)).sum();
        lost(&self.shared, &self.shared_gradient, shared) + of_blocks
    }

    fn shared_covariance(&self) -> Option<Vec<f64>> {
        let (schur, _, _) = self.reduced(0.0)?;
        Some(Cholesky::new(&schur, self.shared_len)?.inverse())
    }
}

fn damped(matrix: &[f64], size: usize, damping: f64) -> Vec<f64> {
    let mut damped = matrix.to_vec();
    for diagonal in damped.iter_mut().step_by(size + 1) {
        *diagonal *= 1.0 + damping;
    }
    damped
}

fn add_outer(matrix: &mut [f64], rows: &[f64], columns: &[f64]) {
    if columns.is_empty() {
        return;
    }
    for (row, &r) in matrix.chunks_exact_mut(columns.len()).zip(rows) {
        add_scaled(row, r, columns);
    }
}

fn add_scaled(sum: &mut [f64], factor: f64, values: &[f64]) {
    for (s, v) in sum.iter_mut().zip(values) {
        *s += factor * v;
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    // Decays y = a·exp(−rate·t) that share the rate; a is each block's own.
    struct Decays {
        observed: Vec<Vec<f64>>,
    }

    impl Decays {
        fn of(rate: f64, amplitudes: &[f64], noise: f64) -> Self {
            let at = |a: f64, t: usize| a * (-rate * t as f64).exp() + noise * if t.is_multiple_of(2) { 1.0 } else { -1.0 };
            Self { observed: amplitudes.iter().map(|&a| (0..8).map(|t| at(a, t)).collect()).collect() }
        }
    }

    impl Problem for Decays {
        type Shared = f64;
        type Block = f64;

        fn shared_len(&self) -> usize {
            1
        }

        fn block_len(&self) -> usize {
            1
        }

        fn rows(&self, index: usize, rate: &f64, a: &f64, row: &mut Rows) -> Option<()> {
            for (t, y) in self.observed[index].iter().enumerate() {
                let e = (-rate * t as f64).exp();
                row(a * e - y, &[-a * e * t as f64], &[e]);
            }
            // Growing instead of decaying counts as undefined.
            (*rate > 0.0).then_some(())
        }

        fn shared_moved(&self, rate: &f64, step: &[f64]) -> f64 {
            rate + step[0]
        }

        fn block_moved(&self, a: &f64, step: &[f64]) -> f64 {
            a + step[0]
        }
    }

    #[test]
    fn shared_and_own_parameters_are_found_together() {
        let truth = [1.0, 2.0, -0.5];
        let solution = minimise(&Decays::of(0.4, &truth, 0.0), 2.5, vec![0.1; 3], 100).unwrap();
        assert_eq!(solution.summary.termination, Termination::Converged);
        // Quadratic convergence on exact data ends at rounding of the squares' sum, 1e-16, that is 1e-8 of a parameter or better.
        assert!((solution.shared - 0.4).abs() < 1e-7, "{}", solution.shared);
        assert!(solution.blocks.iter().zip(truth).all(|(found, a)| (found - a).abs() < 1e-7));
    }

    #[test]
    fn the_step_is_that_of_the_whole_system() {
        // Damped normal equations of (rate, a₁, a₂) written out and solved in one piece.
        let problem = Decays::of(0.4, &[1.0, 2.0], 0.01);
        let (rate, blocks, damping) = (0.7, vec![0.8, 1.5], 0.3);
        let (mut matrix, mut right) = (vec![0.0; 9], vec![0.0; 3]);
        for index in 0..2 {
            let mut row = |residual: f64, by_shared: &[f64], by_block: &[f64]| {
                let mut jacobian = [by_shared[0], 0.0, 0.0];
                jacobian[1 + index] = by_block[0];
                add_outer(&mut matrix, &jacobian, &jacobian);
                add_scaled(&mut right, -residual, &jacobian);
            };
            problem.rows(index, &rate, &blocks[index], &mut row).unwrap();
        }
        Cholesky::new(&damped(&matrix, 3, damping), 3).unwrap().solve(&mut right);
        let step = Normal::at(&problem, &rate, &blocks).unwrap().step(damping).unwrap();
        for (found, expected) in [step.shared[0], step.blocks[0][0], step.blocks[1][0]].iter().zip(&right) {
            // Two orders of the same few hundred operations on a well-conditioned system.
            assert!((found - expected).abs() < 1e-12 * expected.abs().max(1.0), "{found} instead of {expected}");
        }
    }

    #[test]
    fn the_covariance_is_that_of_the_whole_systems_inverse() {
        let problem = Decays::of(0.4, &[1.0], 0.0);
        let solution = minimise(&problem, 0.5, vec![0.9], 100).unwrap();
        // [Σ(t a e)², −Σ t a e²; …, Σ e²]⁻¹ at the truth, e = exp(−0.4 t).
        let e = |t: usize| (-0.4 * t as f64).exp();
        let sum = |power: i32| (0..8).map(|t| (t as f64).powi(power) * e(t) * e(t)).sum::<f64>();
        let expected = sum(0) / (sum(2) * sum(0) - sum(1) * sum(1));
        let found = solution.shared_covariance.unwrap()[0];
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} instead of {expected}");
    }

    #[test]
    fn parameters_without_defined_residuals_are_never_stepped_to() {
        // From so fast a decay the first Gauss–Newton steps lead below zero.
        let solution = minimise(&Decays::of(0.05, &[1.0, 1.0], 0.0), 5.0, vec![1.0, 1.0], 200).unwrap();
        assert!((solution.shared - 0.05).abs() < 1e-6, "{}", solution.shared);
        assert_eq!(minimise(&Decays::of(0.4, &[1.0], 0.0), -1.0, vec![1.0], 10).unwrap_err(), UndefinedStart { block: 0 });
        assert_eq!(minimise(&Decays::of(0.4, &[1.0], f64::NAN), 1.0, vec![1.0], 10).unwrap_err(), UndefinedStart { block: 0 });
    }

    #[test]
    fn what_the_residuals_do_not_determine_has_no_covariance() {
        // Amplitude zero: the rate changes nothing.
        let solution = minimise(&Decays::of(0.4, &[0.0], 0.0), 0.4, vec![0.0], 10).unwrap();
        assert_eq!(solution.shared_covariance, None);
    }
}
