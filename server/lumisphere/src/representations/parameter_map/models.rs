//! Which models a fit may choose from, and the fit of some texels.

use std::fmt;
use std::str::FromStr;

use rayon::prelude::*;
use thiserror::Error;

use super::{FitError, ModelCode, Quads};
use crate::capture::observation_map::{Observation, ObservedTexel, State as Seen};
use crate::fitting::harmonics::{OwnDirectionsFit, Penalty, Samples, Sign};
use crate::fitting::{
    Basis, Batch, Choice, Flags, Further, FurtherRung, Model, Noise, Outcome, Outliers, Rung, Samples as TexelSamples, Settings, State,
    fit_with,
};

/// Which models a fit may choose from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AllowedModels {
    /// The smallest that explains what was seen.
    Auto,
    /// The same radiance in all directions.
    Constant,
    /// So many lobes, 1 to 4.
    Phong(u32),
    /// So many hemispherical harmonics: 1, 4, 9 … 100.
    Harmonics(u32),
}

/// Lobes that `auto` goes up to.
const MOST_LOBES: usize = 3;

/// Not a name of models.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("models are {0:?}, auto, constant, phong:1 to phong:4, or sh:4, sh:9 … sh:100 expected")]
pub struct UnknownModels(pub String);

impl fmt::Display for AllowedModels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => write!(f, "auto"),
            Self::Constant => write!(f, "constant"),
            Self::Phong(lobes) => write!(f, "phong:{lobes}"),
            Self::Harmonics(count) => write!(f, "sh:{count}"),
        }
    }
}

impl FromStr for AllowedModels {
    type Err = UnknownModels;

    fn from_str(name: &str) -> Result<Self, UnknownModels> {
        let unknown = || UnknownModels(name.into());
        match name.split_once(':') {
            None if name == "auto" => Ok(Self::Auto),
            None if name == "constant" => Ok(Self::Constant),
            Some(("phong", lobes)) => lobes.parse().ok().filter(|l| (1..=4).contains(l)).map(Self::Phong).ok_or_else(unknown),
            Some(("sh", count)) => {
                let is_square = |n: &u32| (1..=10).any(|b| b * b == *n);
                count.parse().ok().filter(is_square).map(Self::Harmonics).ok_or_else(unknown)
            }
            _ => Err(unknown()),
        }
    }
}

/// A texel's model, packed.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FittedTexel {
    /// In the map.
    pub index: u32,
    pub code: ModelCode,
    pub flags: Flags,
    pub quads: Quads,
    /// What the model leaves, over `samples` numbers.
    pub sum_of_squares: f64,
    pub samples: u64,
}

/// One texel's observations: direction in its frame and entry.
pub(super) type Observed<'a> = (&'a ObservedTexel, Vec<([f32; 3], Observation)>);

/// The models of some texels, in order. A texel that nobody saw has none.
pub(super) fn fit_texels(observed: &[Observed<'_>], models: AllowedModels, noise: Noise) -> Result<Vec<FittedTexel>, FitError> {
    let choice = match models {
        AllowedModels::Auto => Choice::Auto { lobes_at_most: MOST_LOBES },
        AllowedModels::Constant => Choice::Exactly(Rung::Constant),
        AllowedModels::Phong(lobes) => Choice::Exactly(Rung::Lobes(lobes as usize)),
        AllowedModels::Harmonics(count) => return harmonics(observed, count),
    };
    let mut batch = Batch::new();
    for (_, seen) in observed {
        let (directions, values): (Vec<_>, Vec<_>) = seen.iter().map(|(direction, o)| (*direction, o.radiance)).unzip();
        let states: Vec<State> = seen.iter().map(|(_, o)| state(o.state)).collect();
        batch.push(&directions, &values, &states).expect("three vectors of one length");
    }
    let settings = Settings { outliers: Outliers::Keep, ..Settings::new(choice, noise) };
    let outcomes = fit_with(&batch, &settings, Some(&HarmonicsRung::new()))?;
    let one = |((texel, seen), outcome): (&Observed<'_>, &Outcome)| match outcome.fit() {
        Some(fit) => packed(texel, seen, Some(&fit.model), fit.flags),
        None => packed(texel, seen, None, Flags::NONE),
    };
    Ok(observed.iter().zip(&outcomes).map(one).collect())
}

fn state(state: Seen) -> State {
    match state {
        Seen::Missing => State::MISSING,
        Seen::Seen { clipped } => State::clipped([0, 1, 2].map(|c| clipped >> c & 1 != 0)),
    }
}

/// A texel with its model, or with none.
fn packed(texel: &ObservedTexel, seen: &[([f32; 3], Observation)], model: Option<&Model>, flags: Flags) -> FittedTexel {
    let (code, quads) = model.map_or((ModelCode::NONE, Vec::new()), ModelCode::pack);
    let mut fitted = FittedTexel { index: texel.index, code, flags, quads, sum_of_squares: 0.0, samples: 0 };
    let Some(model) = model else { return fitted };
    for (direction, observation) in seen.iter().filter(|entry| is_whole(entry)) {
        let said = model.eval(*direction);
        fitted.sum_of_squares += (0..3).map(|c| f64::from(said[c] - observation.radiance[c]).powi(2)).sum::<f64>();
        fitted.samples += 3;
    }
    fitted
}

// Seen from above the horizon, no channel clipped.
fn is_whole((direction, observation): &([f32; 3], Observation)) -> bool {
    direction[2] > 0.0 && observation.state == Seen::Seen { clipped: 0 }
}

/// Hemispherical harmonics, penalised as cross-validation says and nowhere negative. Clipped observations are left out; all others weigh the same,
/// since what few harmonics cannot say is more than noise.
fn harmonics(observed: &[Observed<'_>], count: u32) -> Result<Vec<FittedTexel>, FitError> {
    let solver = OwnDirectionsFit::new(Basis::Hemispherical, count as usize)?;
    Ok(observed.par_iter().map(|(texel, seen)| harmonics_of(texel, seen, &solver)).collect())
}

fn harmonics_of(texel: &ObservedTexel, seen: &[([f32; 3], Observation)], solver: &OwnDirectionsFit) -> FittedTexel {
    let whole: Vec<&([f32; 3], Observation)> = seen.iter().filter(|entry| is_whole(entry)).collect();
    let axis = |k: usize| whole.iter().map(|(direction, _)| direction[k]).collect::<Vec<f32>>();
    let channel = |c: usize| whole.iter().map(|(_, o)| o.radiance[c]).collect::<Vec<f32>>();
    let (directions, values, weights) = ([0, 1, 2].map(axis), [0, 1, 2].map(channel), vec![1.0; whole.len()]);
    let samples =
        Samples { directions: directions.each_ref().map(Vec::as_slice), values: values.each_ref().map(Vec::as_slice), weights: &weights };
    let fit = solver.fit(samples, Penalty::CrossValidated, Sign::NotNegative).ok();
    let model = fit.map(|fit| Model::Harmonics { basis: Basis::Hemispherical, coefficients: fit.coefficients });
    let is_clipped = seen.iter().any(|(_, o)| matches!(o.state, Seen::Seen { clipped } if clipped != 0));
    packed(texel, seen, model.as_ref(), if is_clipped { Flags::CLIPPED } else { Flags::NONE })
}

/// What `auto` tries last, where lobes leave more than noise: numbers of hemispherical harmonics.
const LAST_RUNGS: [usize; 2] = [16, 36];

struct HarmonicsRung(Vec<OwnDirectionsFit>);

impl HarmonicsRung {
    fn new() -> Self {
        Self(LAST_RUNGS.iter().filter_map(|count| OwnDirectionsFit::new(Basis::Hemispherical, *count).ok()).collect())
    }
}

impl FurtherRung for HarmonicsRung {
    fn fit(&self, samples: &TexelSamples) -> Option<Further> {
        let numbers = 3.0 * samples.values.len() as f64;
        // Schwarz's criterion between the two; against the lobes the ladder weighs the better one.
        let value = |f: &Further| numbers * f.cost.max(f64::MIN_POSITIVE).ln() + f.parameters * numbers.ln();
        self.0.iter().filter_map(|solver| further(samples, solver)).min_by(|a, b| value(a).total_cmp(&value(b)))
    }
}

fn further(samples: &TexelSamples, solver: &OwnDirectionsFit) -> Option<Further> {
    let column = |of: &[[f32; 3]], k: usize| of.iter().map(|v| v[k]).collect::<Vec<f32>>();
    let directions = [0, 1, 2].map(|k| column(&samples.directions, k));
    let values = [0, 1, 2].map(|k| column(&samples.values, k));
    let weights: Vec<f32> = samples.weights.iter().map(|w| (w[0] + w[1] + w[2]) / 3.0).collect();
    let (directions, values) = (directions.each_ref().map(Vec::as_slice), values.each_ref().map(Vec::as_slice));
    // Free is a tenth of the time; what it says below zero is shown as zero, and so it is weighed.
    let fit = solver.fit(Samples { directions, values, weights: &weights }, Penalty::CrossValidated, Sign::Free).ok()?;
    let model = Model::Harmonics { basis: Basis::Hemispherical, coefficients: fit.coefficients };
    let residual = |((direction, value), weight): ((&[f32; 3], &[f32; 3]), &[f32; 3])| {
        let said = model.eval(*direction);
        (0..3).map(|c| f64::from(weight[c]) * f64::from(said[c] - value[c]).powi(2)).sum::<f64>()
    };
    let cost = samples.directions.iter().zip(&samples.values).zip(&samples.weights).map(residual).sum();
    Some(Further { model, cost, parameters: fit.parameters })
}
