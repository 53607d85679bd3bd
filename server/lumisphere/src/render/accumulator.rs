//! A still: the mean of passes over one view. Whoever shows a frame for longer than it takes to render renders further passes
//! ([`Settings::of_pass`](super::Settings::of_pass)) and shows their mean: the server's unary frames, its sessions and evaluations alike.
//!
//! Colour is a running mean in f32, `m ← m + (x − m)/k`, pass by pass in their order: the same passes give the same bytes, whoever asks.
//! Whatever a pass has, the mean stays between the least and the greatest. Distances are pass 0's, as they are all others'; so is
//! provenance, which does not tell where a later pass has filled in what no sample point knows.

use super::Pixels;

/// The mean of the passes so far.
#[derive(Debug, Clone, PartialEq)]
pub struct Accumulator {
    mean: Pixels,
    passes: u32,
}

impl Accumulator {
    /// After pass 0.
    pub fn new(first: Pixels) -> Self {
        Self { mean: first, passes: 1 }
    }

    /// Adds the next pass, which has as many pixels.
    pub fn add(&mut self, pass: &Pixels) {
        debug_assert_eq!(pass.color.len(), self.mean.color.len());
        self.passes += 1;
        let share = 1.0 / self.passes as f32;
        for (mean, value) in self.mean.color.iter_mut().zip(&pass.color) {
            *mean += (value - *mean) * share;
        }
        self.mean.pages_needed = self.mean.pages_needed.max(pass.pages_needed);
        self.mean.is_final &= pass.is_final;
    }

    /// Passes so far, at least 1.
    pub fn passes(&self) -> u32 {
        self.passes
    }

    /// Their mean; `pages_needed` is that of the pass that needed most.
    pub fn pixels(&self) -> &Pixels {
        &self.mean
    }

    /// Held in memory: 12 bytes a pixel, and 4 each for distances and provenance.
    pub fn bytes(&self) -> u64 {
        let Pixels { color, depth, provenance, .. } = &self.mean;
        let words = color.len() + depth.as_ref().map_or(0, Vec::len) + provenance.as_ref().map_or(0, Vec::len);
        4 * words as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(color: [f32; 3], pages_needed: usize) -> Pixels {
        Pixels { color: color.to_vec(), depth: Some(vec![2.0]), provenance: None, pages_needed, is_final: true }
    }

    /// Sums of 1e5 in f32 would carry an error of k ulp; the running mean errs by half an ulp a pass at most, and less where passes agree.
    #[test]
    fn the_mean_is_that_of_all_passes_and_equal_passes_change_nothing() {
        let mut mean = Accumulator::new(of([1e5, 1.0, 0.1], 3));
        (0..99).for_each(|_| mean.add(&of([1e5, 1.0, 0.1], 2)));
        assert_eq!(mean.pixels(), &of([1e5, 1.0, 0.1], 3));
        let mut mean = Accumulator::new(of([0.0, 1e5, 0.0], 1));
        (1..64).for_each(|k| mean.add(&of([k as f32, 0.0, 0.0], 1)));
        assert_eq!((mean.passes(), mean.bytes()), (64, 16));
        let [a, b, c] = mean.pixels().color[..] else { panic!("three channels") };
        assert!((a - 31.5).abs() < 1e-4 && (b / (1e5 / 64.0) - 1.0).abs() < 1e-5 && c == 0.0, "{a} {b}");
    }
}
