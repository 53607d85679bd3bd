//! The criterion that weighs a model's residuals against its size (Schwarz 1978), with a noise floor and a dearer price where views are
//! few. Measured choices: AIC, AICc, generalised cross-validation and "stop when the gain is small" count lobes wrongly far more often.

use super::candidate::Candidate;

/// Two of the axis, the exponent, three amplitudes.
pub const LOBE_PARAMETERS: f64 = 6.0;
/// Below so many numbers, parameters cost twice as much.
const FEW_NUMBERS: f64 = 60.0;

/// The criterion of one texel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Criterion {
    /// Numbers observed.
    numbers: f64,
    /// Variance that is never counted as structure.
    floor: f64,
}

impl Criterion {
    /// For `numbers` observed numbers whose noise has at least the deviation `floor`.
    pub fn new(numbers: f64, floor: f64) -> Self {
        Self { numbers, floor: floor * floor }
    }

    /// Numbers observed.
    pub fn numbers(&self) -> f64 {
        self.numbers
    }

    /// `N ln(cost/N + floor²) + k ln N`: the smaller the better.
    pub fn value(&self, cost: f64, parameters: f64) -> f64 {
        self.numbers * (cost.max(0.0) / self.numbers + self.floor).ln() + parameters * self.price()
    }

    /// The criterion of a candidate. A lobe that rests on a view or two costs twice, as everything does where views are few: noise has
    /// many places to make one.
    pub fn of(&self, candidate: &Candidate) -> f64 {
        let lonely = if self.numbers < FEW_NUMBERS { 0.0 } else { candidate.lonely().count() as f64 };
        self.value(candidate.cost, candidate.parameters() + LOBE_PARAMETERS * lonely)
    }

    /// What one more parameter costs.
    fn price(&self) -> f64 {
        let price = self.numbers.max(2.0).ln();
        if self.numbers < FEW_NUMBERS { 2.0 * price } else { price }
    }

    /// Variance of one number: from the residuals, but no less than the floor.
    pub fn variance(&self, cost: f64, parameters: f64) -> f64 {
        (cost / (self.numbers - parameters).max(1.0)).max(self.floor)
    }

    /// The cost that a model with `more` parameters must reach to be no worse than one with this `cost`; below zero where none can.
    pub fn cost_to_beat(&self, cost: f64, more: f64) -> f64 {
        let variance = (cost / self.numbers + self.floor) * (-more * self.price() / self.numbers).exp();
        (variance - self.floor) * self.numbers
    }
}
