//! What the caller decides about a fit, and what it is told about each texel.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Model;
pub use super::lobes::question::{LobePrior, MAX_LOBES};

/// How samples scatter: variance `floor² + (relative · value)²`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation of a dark sample, in the samples' unit: at least that of quantisation, a step/√12. No residual below it counts
    /// for a larger model.
    pub floor: f32,
    /// Share of the value: 0 weighs all samples alike; 0.01 is usual for radiance recovered from several exposures.
    pub relative: f32,
}

/// Which model a texel gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Choice {
    /// The one with the best criterion: constant, cosine power, 1 … `lobes_at_most` lobes.
    Auto {
        /// 0 … 4.
        lobes_at_most: usize,
    },
    /// This one.
    Exactly(Rung),
}

/// A kind of model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rung {
    /// `Model::Constant`.
    Constant,
    /// `Model::CosinePower`.
    CosinePower,
    /// `Model::Lobes` with so many, 1 … 4.
    Lobes(usize),
}

/// From how many starts a lobe is polished.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Starts {
    /// One where there are many views and the best is clear, else four to six.
    Adaptive,
    /// So many, at least one.
    Exactly(usize),
}

/// What becomes of samples that stand alone against their neighbours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outliers {
    /// They count. A highlight that one view alone sees and an outlier are the same data.
    Keep,
    /// They are left out and the texel is flagged.
    Reject,
}

/// The numbers that the last steps are calculated in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// f32: residuals of exact data end near 10⁻⁷ of the largest value.
    Single,
    /// f64 for the last steps: two to four times the time.
    Polished,
}

/// All of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Which model.
    pub choice: Choice,
    /// Of the samples.
    pub noise: Noise,
    /// Of a lobe.
    pub starts: Starts,
    /// Rejected or kept.
    pub outliers: Outliers,
    /// Of the result.
    pub precision: Precision,
    /// On lobes; `None` lets exponents and amplitudes that the data do not determine run away.
    pub prior: Option<LobePrior>,
    /// A fit ends when a step would lower its cost by no more than this share.
    pub tolerance: f32,
    /// Or after so many passes over the samples.
    pub iterations_at_most: usize,
}

impl Settings {
    /// The measured choices for samples with this noise.
    pub fn new(choice: Choice, noise: Noise) -> Self {
        Self {
            choice,
            noise,
            starts: Starts::Adaptive,
            outliers: Outliers::Keep,
            precision: Precision::Single,
            prior: Some(LobePrior { log_exponent: 3.0, deviation: 1.2, amplitude: 1.0 }),
            tolerance: 1e-6,
            iterations_at_most: 60,
        }
    }

    /// Refuses what no fit can be made with.
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        let lobes = match self.choice {
            Choice::Auto { lobes_at_most } => lobes_at_most,
            Choice::Exactly(Rung::Lobes(0)) => return Err(SettingsError::Lobes(0)),
            Choice::Exactly(Rung::Lobes(count)) => count,
            Choice::Exactly(_) => 0,
        };
        if lobes > MAX_LOBES {
            return Err(SettingsError::Lobes(lobes));
        }
        if !(self.noise.floor > 0.0 && self.noise.floor.is_finite()) {
            return Err(SettingsError::NoiseFloor(self.noise.floor));
        }
        if !(self.noise.relative >= 0.0 && self.noise.relative.is_finite()) {
            return Err(SettingsError::RelativeNoise(self.noise.relative));
        }
        Ok(())
    }
}

/// Settings that no fit can be made with.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SettingsError {
    /// Too many lobes, or none where some are forced.
    #[error("{0} lobes asked for, expected 1 to 4")]
    Lobes(usize),
    /// The floor is what ends the search for ever larger models.
    #[error("noise floor {0}, expected a positive number")]
    NoiseFloor(f32),
    /// Negative or not a number.
    #[error("relative noise {0}, expected zero or more")]
    RelativeNoise(f32),
}

/// Doubts about a texel's model, a set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash)]
pub struct Flags(u8);

impl Flags {
    /// No doubt.
    pub const NONE: Self = Self(0);
    /// The views do not determine a lobe: it is narrower than they are apart, or fewer than three see it, or its exponent is open.
    pub const UNRESOLVED: Self = Self(1);
    /// Some values were only lower bounds.
    pub const CLIPPED: Self = Self(2);
    /// Samples were left out as outliers.
    pub const OUTLIERS: Self = Self(4);
    /// The residuals show structure that the model does not have.
    pub const MISFIT: Self = Self(8);

    /// Whether all of `other` is in this set.
    pub fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// This set and `other`.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// As stored: bit 0 unresolved, 1 clipped, 2 outliers, 3 misfit.
    pub fn bits(self) -> u8 {
        self.0
    }

    /// The reverse of `bits`; bits that mean nothing are dropped.
    pub fn from_bits(bits: u8) -> Self {
        Self(bits & 15)
    }
}

/// Why a fit ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Termination {
    /// No step would lower the cost by more than the tolerance.
    Converged,
    /// Out of iterations.
    IterationLimit,
    /// No iteration was needed: the model is linear.
    Linear,
}

/// A texel's model and how it came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// The model chosen.
    pub model: Model,
    /// Why it ended.
    pub termination: Termination,
    /// Passes over the samples, of the start that won.
    pub iterations: u32,
    /// Weighted sum of squared residuals at that start.
    pub initial_cost: f32,
    /// The same at the end.
    pub final_cost: f32,
    /// Root of the mean squared residual over all numbers that counted, in the samples' unit.
    pub rms_residual: f32,
    /// By how much the criterion prefers this model to the best of the others; infinite where there was no other.
    pub margin: f32,
    /// Doubts.
    pub flags: Flags,
}

/// What becomes of one texel.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It has a model.
    Fitted(Fit),
    /// Nobody saw it.
    Unobserved,
}

impl Outcome {
    /// The fit, if there is one.
    pub fn fit(&self) -> Option<&Fit> {
        match self {
            Self::Fitted(fit) => Some(fit),
            Self::Unobserved => None,
        }
    }
}
