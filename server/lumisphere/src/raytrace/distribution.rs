//! Choice of one of many by weight, from a uniform number.

/// Discrete distribution: index i with probability wᵢ / Σw. Monotone in the uniform number, so stratification survives.
#[derive(Debug, Clone)]
pub(super) struct Discrete {
    /// `cumulative[i]` = Σ_{j ≤ i} wⱼ / Σw; the last is 1.
    cumulative: Vec<f32>,
    /// First index whose cumulative weight exceeds k/len: where to start looking for u ∈ [k/len, (k+1)/len).
    guide: Vec<u32>,
}

impl Discrete {
    /// None when there is no weight above zero. Weights are finite and not negative.
    pub fn new(weights: &[f64]) -> Option<Self> {
        let total: f64 = weights.iter().sum();
        if !(total > 0.0) {
            return None;
        }
        let mut sum = 0.0;
        let mut cumulative: Vec<f32> = weights
            .iter()
            .map(|w| {
                sum += w;
                (sum / total) as f32
            })
            .collect();
        // Rounding must not leave a gap below 1 that a uniform number could fall into, nor give it to a trailing zero weight.
        let last = weights.iter().rposition(|w| *w > 0.0).unwrap_or(0);
        cumulative[last..].fill(1.0);
        let mut index = 0;
        let guide = (0..weights.len())
            .map(|k| {
                let u = k as f32 / weights.len() as f32;
                while cumulative[index] <= u {
                    index += 1;
                }
                index as u32
            })
            .collect();
        Some(Self { cumulative, guide })
    }

    /// The index for u ∈ [0, 1), its probability, and u's position within it, again in [0, 1).
    #[inline]
    pub fn choose(&self, u: f32) -> (usize, f32, f32) {
        let bucket = ((u * self.guide.len() as f32) as usize).min(self.guide.len() - 1);
        let mut index = self.guide[bucket] as usize;
        // The product above may round into the next bucket.
        while index > 0 && self.cumulative[index - 1] > u {
            index -= 1;
        }
        while index + 1 < self.cumulative.len() && self.cumulative[index] <= u {
            index += 1;
        }
        let below = if index == 0 { 0.0 } else { self.cumulative[index - 1] };
        let probability = self.cumulative[index] - below;
        (index, probability, ((u - below) / probability).min(ALMOST_ONE))
    }

    /// Probability of an index.
    #[inline]
    pub fn probability(&self, index: usize) -> f32 {
        self.cumulative[index] - if index == 0 { 0.0 } else { self.cumulative[index - 1] }
    }
}

/// The largest f32 below 1.
pub(super) const ALMOST_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_choice_inverts_the_cumulative_weights() {
        let weights = [0.0, 3.0, 0.0, 1.0, 4.0, 0.0];
        let choice = Discrete::new(&weights).unwrap();
        for k in 0..800 {
            let u = k as f32 / 800.0;
            let (index, probability, rest) = choice.choose(u);
            let below: f64 = weights[..index].iter().sum::<f64>() / 8.0;
            assert!(weights[index] > 0.0);
            assert!((probability as f64 - weights[index] / 8.0).abs() < 1e-6 && probability == choice.probability(index));
            assert!((0.0..1.0).contains(&rest) && (below as f32 + rest * probability - u).abs() < 1e-6);
        }
        assert!(Discrete::new(&[0.0, 0.0]).is_none() && Discrete::new(&[]).is_none());
    }
}
