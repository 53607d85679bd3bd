//! Which models a fit may choose from, and the fit of some texels.

use std::fmt;
use std::str::FromStr;
#[cfg(feature = "gpu")]
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{FitError, ModelCode, Quads};
use crate::capture::observation_map::{Observation, ObservedTexel, State as Seen};
use crate::fitting::harmonics::{OwnDirectionsFit, Penalty, Samples, Sign};
use crate::fitting::{
    Basis, Batch, Choice, Flags, Further, FurtherRung, Model, Noise, Outcome, Outliers, Precision, Rung, Samples as TexelSamples, Settings,
    State, fit_with,
};
#[cfg(feature = "gpu")]
use crate::fitting::{LobeKernel, fit_on};

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

/// A texel's models, packed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct FittedTexel {
    /// In the map.
    pub index: u32,
    /// Numbers observed that no model's residual leaves out: three for each observation that is not clipped.
    pub samples: u64,
    /// The one that the fit chose comes last, before it the smaller ones that could stand for it; none where nothing was seen.
    pub rungs: Vec<FittedRung>,
}

/// A model that a texel may be stored with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct FittedRung {
    /// [`ModelCode::number`].
    pub code: u8,
    /// [`Flags::bits`].
    pub flags: u8,
    pub quads: Quads,
    /// What the model leaves, over all `samples`.
    pub sum_of_squares: f64,
    /// What it leaves of observations that are clipped in any channel: of a clipped one, how far it stays below.
    pub of_clipped: f64,
}

/// How texels are fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct HowToFit {
    pub models: AllowedModels,
    pub noise: Noise,
    pub outliers: Outliers,
    pub precision: Precision,
    pub rungs: Rungs,
}

/// What fits single lobes; everything else of a fit is the processor's.
#[derive(Debug, Clone)]
pub enum Solver {
    /// The threads that fit.
    Processor,
    /// A graphics device.
    #[cfg(feature = "gpu")]
    Device(Arc<LobeKernel>),
}

/// Which models of a texel are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rungs {
    /// What the fit chose.
    Chosen,
    /// The smaller ones, too.
    AndSmaller,
}

/// One texel's observations: direction in its frame and entry.
pub type Observed<'a> = (&'a ObservedTexel, Vec<([f32; 3], Observation)>);

/// One kind of fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Asked {
    Ladder(Choice),
    Harmonics(u32),
}

impl AllowedModels {
    fn asked(self) -> Asked {
        match self {
            Self::Auto => Asked::Ladder(Choice::Auto { lobes_at_most: MOST_LOBES }),
            Self::Constant => Asked::Ladder(Choice::Exactly(Rung::Constant)),
            Self::Phong(lobes) => Asked::Ladder(Choice::Exactly(Rung::Lobes(lobes as usize))),
            Self::Harmonics(count) => Asked::Harmonics(count),
        }
    }

    // Models that may stand for what was chosen among these; whether one is smaller, its size says.
    fn stand_ins(self) -> Vec<Asked> {
        let lobes = |most: usize| (1..=most).map(|count| Asked::Ladder(Choice::Exactly(Rung::Lobes(count))));
        let flat = [Rung::Constant, Rung::CosinePower].map(|rung| Asked::Ladder(Choice::Exactly(rung)));
        let further = match self {
            Self::Auto => lobes(MOST_LOBES).chain([Asked::Harmonics(LAST_RUNGS[0] as u32)]).collect(),
            Self::Constant => Vec::new(),
            Self::Phong(most) => lobes(most as usize).collect(),
            Self::Harmonics(most) => [4, 16, 36, 64].into_iter().filter(|count| *count < most).map(Asked::Harmonics).collect(),
        };
        flat.into_iter().chain(further).collect()
    }
}

/// The models of some texels, in order. A texel that nobody saw has none.
pub(super) fn fit_texels(observed: &[Observed<'_>], how: &HowToFit, solver: &Solver) -> Result<Vec<FittedTexel>, FitError> {
    let of = |(texel, seen): &Observed<'_>| FittedTexel { index: texel.index, samples: samples(seen), rungs: Vec::new() };
    let mut fitted: Vec<FittedTexel> = observed.iter().map(of).collect();
    let chosen = rungs(&observed.iter().collect::<Vec<_>>(), how.models.asked(), how, solver)?;
    if how.rungs == Rungs::AndSmaller {
        for asked in how.models.stand_ins() {
            let is_larger = |at: &usize| chosen[*at].as_ref().is_some_and(|rung| rung.quads.len() > asked.quads());
            let these: Vec<usize> = (0..observed.len()).filter(is_larger).collect();
            let smaller = rungs(&these.iter().map(|at| &observed[*at]).collect::<Vec<_>>(), asked, how, solver)?;
            these.iter().zip(smaller).for_each(|(at, rung)| fitted[*at].rungs.extend(rung));
        }
    }
    fitted.iter_mut().zip(chosen).for_each(|(texel, rung)| texel.rungs.extend(rung));
    Ok(fitted)
}

impl Asked {
    fn quads(self) -> usize {
        match self {
            Self::Ladder(Choice::Exactly(Rung::Lobes(count))) => 1 + 2 * count,
            Self::Ladder(_) => 1,
            Self::Harmonics(count) => 3 * (count as usize).div_ceil(4),
        }
    }
}

fn rungs(observed: &[&Observed<'_>], asked: Asked, how: &HowToFit, solver: &Solver) -> Result<Vec<Option<FittedRung>>, FitError> {
    let choice = match asked {
        Asked::Ladder(choice) => choice,
        Asked::Harmonics(count) => return harmonics(observed, count),
    };
    let mut batch = Batch::new();
    for (_, seen) in observed {
        let (directions, values): (Vec<_>, Vec<_>) = seen.iter().map(|(direction, o)| (*direction, o.radiance)).unzip();
        let states: Vec<State> = seen.iter().map(|(_, o)| state(o.state)).collect();
        batch.push(&directions, &values, &states).expect("three vectors of one length");
    }
    let settings = Settings { outliers: how.outliers, precision: how.precision, ..Settings::new(choice, how.noise) };
    let further = HarmonicsRung::new();
    let outcomes = match solver {
        Solver::Processor => fit_with(&batch, &settings, Some(&further))?,
        #[cfg(feature = "gpu")]
        Solver::Device(kernel) => fit_on(kernel, &batch, &settings, Some(&further))?,
    };
    let one = |((_, seen), outcome): (&&Observed<'_>, &Outcome)| outcome.fit().and_then(|fit| packed(seen, &fit.model, fit.flags));
    Ok(observed.iter().zip(&outcomes).map(one).collect())
}

/// The models of some texels, in order, as they would be stored; None for a texel that nobody saw.
pub fn fitted_models(observed: &[Observed<'_>], models: AllowedModels, noise: Noise) -> Result<Vec<Option<Model>>, FitError> {
    let how = HowToFit { models, noise, outliers: Outliers::Keep, precision: Precision::Single, rungs: Rungs::Chosen };
    let model = |texel: FittedTexel| texel.rungs.last().and_then(|rung| ModelCode::from_number(rung.code)?.unpack(&rung.quads));
    Ok(fit_texels(observed, &how, &Solver::Processor)?.into_iter().map(model).collect())
}

fn state(state: Seen) -> State {
    match state {
        Seen::Missing => State::MISSING,
        Seen::Seen { clipped } => State::clipped([0, 1, 2].map(|c| clipped >> c & 1 != 0)),
    }
}

// A model that cannot be stored is none.
fn packed(seen: &[([f32; 3], Observation)], model: &Model, flags: Flags) -> Option<FittedRung> {
    let (code, quads) = ModelCode::pack(model);
    let sum_of_squares = seen.iter().filter_map(|entry| residual(model, entry)).sum();
    let of_clipped = seen.iter().filter_map(|entry| residual_of_clipped(model, entry)).sum();
    (code != ModelCode::NONE).then(|| FittedRung { code: code.number(), flags: flags.bits(), quads, sum_of_squares, of_clipped })
}

/// What a model leaves of an observation: the sum over the channels of the squares; None where it was not seen whole.
pub(super) fn residual(model: &Model, entry: &([f32; 3], Observation)) -> Option<f64> {
    is_whole(entry).then(|| {
        let (said, seen) = (model.eval(entry.0), entry.1.radiance);
        (0..3).map(|c| f64::from(said[c] - seen[c]).powi(2)).sum()
    })
}

// The same of an observation that is clipped in any channel: a clipped value is a lower bound.
fn residual_of_clipped(model: &Model, (direction, observation): &([f32; 3], Observation)) -> Option<f64> {
    let Seen::Seen { clipped: clipped @ 1.. } = observation.state else { return None };
    (direction[2] > 0.0).then(|| {
        let said = model.eval(*direction);
        let below = |c: usize| f64::from(observation.radiance[c] - said[c]);
        (0..3).map(|c| if clipped >> c & 1 != 0 { below(c).max(0.0) } else { below(c) }.powi(2)).sum()
    })
}

fn samples(seen: &[([f32; 3], Observation)]) -> u64 {
    3 * seen.iter().filter(|entry| is_whole(entry)).count() as u64
}

// Seen from above the horizon, no channel clipped.
pub(super) fn is_whole((direction, observation): &([f32; 3], Observation)) -> bool {
    direction[2] > 0.0 && observation.state == Seen::Seen { clipped: 0 }
}

/// Rounds in which clipped values follow the fit; most fits rest after two.
const ROUNDS: usize = 6;

/// Hemispherical harmonics, penalised as cross-validation says and nowhere negative. All observations weigh the same, since what few harmonics
/// cannot say is more than noise.
fn harmonics(observed: &[&Observed<'_>], count: u32) -> Result<Vec<Option<FittedRung>>, FitError> {
    let solver = OwnDirectionsFit::new(Basis::Hemispherical, count as usize)?;
    Ok(observed.par_iter().map(|(_, seen)| harmonics_of(seen, &solver)).collect())
}

/// A clipped value is a lower bound: where the fit is above it, it becomes what the fit says, which then holds the fit no more (Dempster, Laird and
/// Rubin 1977, "Maximum likelihood from incomplete data", section 4.2: censored values). It begins as what the others of its channel say alone:
/// from the bound the way to there is long.
fn harmonics_of(seen: &[([f32; 3], Observation)], solver: &OwnDirectionsFit) -> Option<FittedRung> {
    let above: Vec<([f32; 3], Observation)> = seen.iter().filter(|(d, o)| d[2] > 0.0 && o.state != Seen::Missing).copied().collect();
    let bounds = [0, 1, 2].map(|c| {
        let is_bound = |(_, o): &([f32; 3], Observation)| matches!(o.state, Seen::Seen { clipped } if clipped >> c & 1 != 0);
        above.iter().map(is_bound).collect::<Vec<bool>>()
    });
    let directions = [0, 1, 2].map(|k| above.iter().map(|(direction, _)| direction[k]).collect::<Vec<f32>>());
    let mut values = [0, 1, 2].map(|c| above.iter().map(|(_, o)| o.radiance[c]).collect::<Vec<f32>>());
    let fitted = |values: [&[f32]; 3], weights: &[f32]| {
        let samples = Samples { directions: directions.each_ref().map(Vec::as_slice), values, weights };
        let fit = solver.fit(samples, Penalty::CrossValidated, Sign::NotNegative).ok()?;
        Some(Model::Harmonics { basis: Basis::Hemispherical, coefficients: fit.coefficients })
    };
    for (values, bounds) in values.iter_mut().zip(&bounds).filter(|(_, bounds)| bounds.contains(&true)) {
        let weights: Vec<f32> = bounds.iter().map(|is_bound| if *is_bound { 0.0 } else { 1.0 }).collect();
        // Where nothing but bounds is known of a channel, they are its values.
        if let Some(alone) = fitted([&values[..]; 3], &weights) {
            let of_bounds = values.iter_mut().zip(&above).zip(bounds).filter(|(_, is_bound)| **is_bound);
            of_bounds.for_each(|((value, (direction, _)), _)| *value = value.max(alone.eval(*direction)[0]));
        }
    }
    let is_clipped = bounds.iter().any(|bounds| bounds.contains(&true));
    let weights = vec![1.0; above.len()];
    let mut model = None;
    for _ in 0..if is_clipped { ROUNDS } else { 1 } {
        let fit = model.insert(fitted(values.each_ref().map(Vec::as_slice), &weights)?);
        let mut is_at_rest = true;
        for (at, (direction, observation)) in above.iter().enumerate() {
            let said = fit.eval(*direction);
            for c in (0..3).filter(|c| bounds[*c][at]) {
                let value = said[c].max(observation.radiance[c]);
                // A hundredth of the bound is not seen.
                is_at_rest &= (value - values[c][at]).abs() <= 0.01 * observation.radiance[c];
                values[c][at] = value;
            }
        }
        if is_at_rest {
            break;
        }
    }
    packed(seen, &model?, if is_clipped { Flags::CLIPPED } else { Flags::NONE })
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
