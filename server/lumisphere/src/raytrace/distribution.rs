//! Choice of one of many by weight, from a uniform number.

/// Discrete distribution: index i with probability wᵢ / Σw. Monotone in the uniform number, so stratification survives.
#[derive(Debug, Clone)]
pub(super) struct Discrete {
    /// `cumulative[i]` = Σ_{j ≤ i} wⱼ / Σw; the last is 1.
    cumulative: Vec<f32>,
    /// First index whose cumulative weight exceeds k/len: where to start looking for u ∈ [k/len, (k+1)/len).
    guide: Vec<u32>,
}

/// What was drawn.
#[derive(Debug, Clone, Copy)]
pub(super) struct Choice {
    pub index: usize,
    pub probability: f32,
    /// Where the uniform number lay within the index's share: uniform again, in [0, 1).
    pub rest: f32,
}

impl Discrete {
    /// None when there is no weight above zero. Weights are finite and not negative.
    pub fn new(weights: &[f64]) -> Option<Self> {
        let total: f64 = weights.iter().sum();
        if !(total > 0.0) {
            return None;
        }
        let cumulative = cumulate(weights, total);
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

    /// The index for u ∈ [0, 1).
    #[inline]
    pub fn choose(&self, u: f32) -> Choice {
        let bucket = ((u * self.guide.len() as f32) as usize).min(self.guide.len() - 1);
        let mut index = self.guide[bucket] as usize;
        // The product above may round into the next bucket.
        while index > 0 && self.cumulative[index - 1] > u {
            index -= 1;
        }
        while index + 1 < self.cumulative.len() && self.cumulative[index] <= u {
            index += 1;
        }
        chosen(&self.cumulative, index, u)
    }

    /// Probability of an index.
    #[inline]
    pub fn probability(&self, index: usize) -> f32 {
        probability(&self.cumulative, index)
    }
}

/// `[i]` = Σ_{j ≤ i} wⱼ / total. Some weight is above zero.
pub(super) fn cumulate(weights: &[f64], total: f64) -> Vec<f32> {
    let mut sum = 0.0;
    let add = |w: &f64| {
        sum += w;
        (sum / total) as f32
    };
    let mut cumulative: Vec<f32> = weights.iter().map(add).collect();
    // Rounding must not leave a gap below 1 that a uniform number could fall into, nor give it to a trailing zero weight.
    let last = weights.iter().rposition(|w| *w > 0.0).unwrap_or(0);
    cumulative[last..].fill(1.0);
    cumulative
}

/// The choice of `Discrete` from cumulative weights alone, by bisection: for short tables that share one allocation.
#[inline]
pub(super) fn choose_in(cumulative: &[f32], u: f32) -> Choice {
    chosen(cumulative, cumulative.partition_point(|c| *c <= u).min(cumulative.len() - 1), u)
}

/// Probability of an index.
#[inline]
pub(super) fn probability(cumulative: &[f32], index: usize) -> f32 {
    cumulative[index] - if index == 0 { 0.0 } else { cumulative[index - 1] }
}

#[inline]
fn chosen(cumulative: &[f32], index: usize, u: f32) -> Choice {
    let below = if index == 0 { 0.0 } else { cumulative[index - 1] };
    let probability = cumulative[index] - below;
    Choice { index, probability, rest: ((u - below) / probability).min(ALMOST_ONE) }
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
            let Choice { index, probability, rest } = choice.choose(u);
            let bisected = choose_in(&cumulate(&weights, 8.0), u);
            assert_eq!((bisected.index, bisected.probability, bisected.rest), (index, probability, rest));
            let below: f64 = weights[..index].iter().sum::<f64>() / 8.0;
            assert!(weights[index] > 0.0);
            assert!((probability as f64 - weights[index] / 8.0).abs() < 1e-6 && probability == choice.probability(index));
            assert!((0.0..1.0).contains(&rest) && (below as f32 + rest * probability - u).abs() < 1e-6);
        }
        assert!(Discrete::new(&[0.0, 0.0]).is_none() && Discrete::new(&[]).is_none());
    }
}
