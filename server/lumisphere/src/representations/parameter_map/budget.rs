//! Which models a map can do without when it must not take more than so many bytes.
//!
//! Each texel has several models: larger ones leave less of what was observed. The one that the fit chose gives way to a smaller one where that
//! costs the least residual for each quad saved: texel by texel along the lower convex hull of residual over size, all texels together
//! by slope (Shoham and Gersho 1988, "Efficient bit allocation for an arbitrary set of quantizers"). The residual is the least for its size,
//! but for that of the last step taken and for the width of a bin.
//!
//! What a smaller model loses of a highlight that is clipped counts as far as it stays below the bound.
//!
//! Slopes are counted in bins, not held: memory does not grow with the map. Steps of one bin are taken in the map's order.

use super::models::{FittedRung, FittedTexel};

/// Bits of an f32 that tell one bin of slopes from the next: they are 2⁻¹¹ wide, relatively.
const BIN_SHIFT: u32 = 12;
/// Of numbers that are not negative.
const BINS: usize = 1 << (31 - BIN_SHIFT);

/// A step from a model to a smaller one.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Step {
    /// The rung it leads to.
    to: usize,
    /// Quads that it saves.
    saved: u64,
    bin: usize,
}

/// Down the hull from the model chosen, slopes rising. A smaller model that leaves no more than the chosen one costs nothing.
fn steps(rungs: &[FittedRung]) -> Vec<Step> {
    let Some(last) = rungs.len().checked_sub(1) else { return Vec::new() };
    let left = |at: usize| rungs[at].sum_of_squares + rungs[at].of_clipped;
    let least = left(last);
    let error = |at: usize| left(at).max(least);
    let size = |at: usize| rungs[at].quads.len();
    let (mut steps, mut from) = (Vec::new(), last);
    loop {
        let slope = |to: usize| ((error(to) - error(from)) / (size(from) - size(to)) as f64) as f32;
        let smaller = (0..rungs.len()).filter(|to| size(*to) < size(from));
        // Of equal slopes the longest step: the others lie on it.
        let next = smaller.min_by(|a, b| slope(*a).total_cmp(&slope(*b)).then(size(*a).cmp(&size(*b))));
        let Some(to) = next else { return steps };
        let bin = (slope(to).max(0.0).to_bits() >> BIN_SHIFT) as usize;
        steps.push(Step { to, saved: (size(from) - size(to)) as u64, bin });
        from = to;
    }
}

/// What all texels' models could save.
#[derive(Debug, Clone)]
pub(super) struct Savings {
    /// Quads of the models chosen.
    pub all: u64,
    by_bin: Vec<u64>,
}

impl Savings {
    /// Of no texels.
    pub fn new() -> Self {
        Self { all: 0, by_bin: vec![0; BINS] }
    }

    /// One more texel.
    pub fn add(&mut self, texel: &FittedTexel) {
        self.all += texel.rungs.last().map_or(0, |rung| rung.quads.len() as u64);
        for step in steps(&texel.rungs) {
            self.by_bin[step.bin] += step.saved;
        }
    }

    /// Quads of the smallest models.
    pub fn least(&self) -> u64 {
        self.all - self.by_bin.iter().sum::<u64>()
    }

    /// Which steps bring all texels down to `quads` quads, or as near as they get.
    pub fn keeping(&self, quads: u64) -> Keeping {
        let mut wanted = self.all.saturating_sub(quads);
        for (bin, saved) in self.by_bin.iter().enumerate() {
            if *saved >= wanted {
                return Keeping { bin, left: wanted };
            }
            wanted -= saved;
        }
        Keeping { bin: BINS, left: 0 }
    }
}

/// A choice of steps, made known texel by texel in the map's order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Keeping {
    /// Steps of lower bins are taken,
    bin: usize,
    /// and those of this one as long as quads are left to be saved.
    left: u64,
}

impl Keeping {
    /// Every model as the fit chose it.
    pub const ALL: Self = Self { bin: 0, left: 0 };

    /// The model of the next texel; None where it has none.
    pub fn next<'a>(&mut self, texel: &'a FittedTexel) -> Option<&'a FittedRung> {
        let mut rung = texel.rungs.len().checked_sub(1)?;
        for step in steps(&texel.rungs) {
            if step.bin > self.bin || (step.bin == self.bin && self.left == 0) {
                break;
            }
            if step.bin == self.bin {
                self.left = self.left.saturating_sub(step.saved);
            }
            rung = step.to;
        }
        texel.rungs.get(rung)
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    fn rung(quads: usize, sum_of_squares: f64) -> FittedRung {
        FittedRung { code: 1, flags: 0, quads: vec![[0.0; 4]; quads], sum_of_squares, of_clipped: 0.0 }
    }

    // Some texels with two to five models of sizes 1 … 27, residuals falling with size.
    fn texels(count: u32, rng: &mut Pcg32) -> Vec<FittedTexel> {
        let one = |index: u32| {
            let sizes = [1, 3, 5, 7, 12, 27];
            let mut error = rng.random_range(0.1..50.0);
            let rungs = sizes[..rng.random_range(2..6)].iter().map(|quads| {
                error *= rng.random_range(0.05..1.0);
                rung(*quads, error)
            });
            FittedTexel { index, samples: 30, rungs: rungs.collect() }
        };
        (0..count).map(one).collect()
    }

    fn savings(texels: &[FittedTexel]) -> Savings {
        let mut savings = Savings::new();
        texels.iter().for_each(|t| savings.add(t));
        savings
    }

    fn kept(texels: &[FittedTexel], mut keeping: Keeping) -> (u64, f64) {
        let rungs = texels.iter().filter_map(|t| keeping.next(t)).collect::<Vec<_>>();
        (rungs.iter().map(|r| r.quads.len() as u64).sum(), rungs.iter().map(|r| r.sum_of_squares).sum())
    }

    /// The least residual of every choice that takes at most so many quads.
    fn exhaustive(texels: &[FittedTexel], quads: u64) -> f64 {
        let Some((first, rest)) = texels.split_first() else { return 0.0 };
        let fitting = first.rungs.iter().filter(|r| r.quads.len() as u64 <= quads);
        fitting.map(|r| r.sum_of_squares + exhaustive(rest, quads - r.quads.len() as u64)).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn every_bound_is_kept_and_a_larger_one_leaves_no_more() {
        let texels = texels(300, &mut Pcg32::seed_from_u64(5));
        let savings = savings(&texels);
        let (least, all) = (savings.least(), savings.all);
        assert_eq!(least, 300);
        let mut before = f64::INFINITY;
        for quads in least..=all {
            let (taken, error) = kept(&texels, savings.keeping(quads));
            assert!(taken <= quads && error <= before, "{quads}: {taken} quads leave {error}, one quad less {before}");
            before = error;
        }
        assert_eq!(kept(&texels, savings.keeping(all)), kept(&texels, Keeping::ALL));
        assert_eq!(kept(&texels, savings.keeping(0)).0, least);
    }

    #[test]
    fn no_choice_of_so_many_quads_leaves_less_by_more_than_one_step() {
        for seed in 0..30 {
            let texels = texels(7, &mut Pcg32::seed_from_u64(seed));
            let savings = savings(&texels);
            let largest_step =
                texels.iter().flat_map(|t| t.rungs.windows(2).map(|w| w[0].sum_of_squares - w[1].sum_of_squares)).sum::<f64>();
            for quads in (savings.least()..=savings.all).step_by(3) {
                let (_, error) = kept(&texels, savings.keeping(quads));
                let best = exhaustive(&texels, quads);
                // The last step taken may save more than was wanted: its whole cost at most is lost, and a bin's width of all.
                let last_step = last_step(&texels, &savings, quads);
                assert!(last_step <= largest_step);
                assert!(error <= best + last_step + 1e-3 * error, "seed {seed}, {quads} quads: {error}, {best} possible, step {last_step}");
            }
        }
    }

    /// What the costliest step taken costs.
    fn last_step(texels: &[FittedTexel], savings: &Savings, quads: u64) -> f64 {
        let mut keeping = savings.keeping(quads);
        let mut worst = 0f64;
        for texel in texels {
            let to = keeping.next(texel).unwrap();
            let mut from = texel.rungs.last().unwrap();
            for step in steps(&texel.rungs).iter().take_while(|_| !std::ptr::eq(from, to)).copied().collect::<Vec<_>>() {
                worst = worst.max(texel.rungs[step.to].sum_of_squares - from.sum_of_squares);
                from = &texel.rungs[step.to];
            }
        }
        worst
    }

    /// Their steps are of one bin.
    #[test]
    fn of_texels_that_are_alike_no_more_are_reduced_than_has_to_be() {
        let texels: Vec<FittedTexel> =
            (0..100).map(|index| FittedTexel { index, samples: 30, rungs: vec![rung(1, 2.0), rung(4, 1.0)] }).collect();
        let savings = savings(&texels);
        for (quads, taken) in [(400, 400), (399, 397), (397, 397), (251, 250), (101, 100), (100, 100)] {
            assert_eq!(kept(&texels, savings.keeping(quads)), (taken, 100.0 + (400 - taken) as f64 / 3.0), "{quads}");
        }
    }

    #[test]
    fn texels_reduced_at_random_leave_more() {
        let mut rng = Pcg32::seed_from_u64(11);
        let texels = texels(200, &mut rng);
        let savings = savings(&texels);
        for part in 1..10 {
            let quads = savings.least() + (savings.all - savings.least()) * part / 10;
            let (_, error) = kept(&texels, savings.keeping(quads));
            for _ in 0..10 {
                let mut chosen: Vec<&FittedRung> = texels.iter().map(|t| t.rungs.last().unwrap()).collect();
                while chosen.iter().map(|r| r.quads.len() as u64).sum::<u64>() > quads {
                    let at = rng.random_range(0..texels.len());
                    chosen[at] = &texels[at].rungs[0];
                }
                let at_random: f64 = chosen.iter().map(|r| r.sum_of_squares).sum();
                assert!(error < at_random, "{quads} quads: {error} left, {at_random} at random");
            }
        }
    }

    #[test]
    fn a_clipped_highlight_that_a_smaller_model_loses_counts() {
        let lost = FittedRung { of_clipped: 5.0, ..rung(1, 1.0) };
        let texels: Vec<FittedTexel> = [vec![lost, rung(3, 1.0)], vec![rung(1, 2.0), rung(3, 1.0)]]
            .into_iter()
            .map(|rungs| FittedTexel { index: 0, samples: 30, rungs })
            .collect();
        let mut keeping = savings(&texels).keeping(4);
        let sizes: Vec<usize> = texels.iter().map(|texel| keeping.next(texel).unwrap().quads.len()).collect();
        assert_eq!(sizes, [3, 1]);
    }

    #[test]
    fn steps_go_down_the_hull_and_what_lies_above_it_is_left_out() {
        // From 7 quads: to 3 for (2.5 − 1)/4, to 1 for (9 − 2.5)/2; 5 quads leave more than the way from 7 to 3 would.
        let rungs = [rung(1, 9.0), rung(1, 9.5), rung(3, 2.5), rung(5, 2.0), rung(7, 1.0)];
        assert_eq!(steps(&rungs).iter().map(|s| (s.to, s.saved)).collect::<Vec<_>>(), [(2, 4), (0, 2)]);
        // A smaller one that leaves less costs nothing and goes first.
        assert_eq!(steps(&[rung(1, 0.5), rung(3, 1.0)]), [Step { to: 0, saved: 2, bin: 0 }]);
        assert!(steps(&[]).is_empty());
    }
}
