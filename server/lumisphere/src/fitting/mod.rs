//! Fits of small functions of direction to samples, many texels at once. Knows no light.
//!
//! For each texel of a batch the smallest of these models that its samples ask for: a constant, `value · z^a`, one to four lobes with
//! an axis and an exponent each. Method: variable projection (Golub and Pereyra 1973, Kaufman 1975) in f32, texels side by side in the
//! lanes of vector registers, with exact non-negative linear unknowns; models weighed by Schwarz's criterion (1978). Where asked, a graphics
//! device fits single lobes (`fit_on`); all else is the processor's.
//!
//! Who calls it: `representations::parameter_map`, batch by batch. Where it fails: a lobe that fewer than three views see, or that is
//! narrower than the views are apart, cannot be told from an outlier; such texels say `unresolved`.

mod assess;
mod batch;
mod candidate;
pub mod cholesky;
#[cfg(feature = "gpu")]
mod device;
mod further;
pub mod harmonics;
mod ladder;
mod lane_list;
mod lanes;
pub mod least_squares;
mod lobes;
mod model;
mod one_lobe;
mod robust;
mod sample;
mod selection;
mod settings;
mod spread;
pub mod suggest;
mod tile;

use rayon::prelude::*;

pub use batch::{Batch, BatchError, State};
#[cfg(feature = "gpu")]
pub use device::LobeKernel;
#[cfg(all(test, feature = "gpu"))]
pub(crate) use device::SOURCE as LOBE_KERNEL_SOURCE;
pub use further::{Further, FurtherRung, Samples};
pub use harmonics::Basis;
pub use model::{LEAST_COSINE, Lobe, Model};
pub use settings::{
    Choice, Fit, Flags, LobePrior, MAX_LOBES, Noise, Outcome, Outliers, Precision, Rung, Settings, SettingsError, Starts, Termination,
};
pub(crate) use spread::spread;

use self::ladder::Climb;
use self::lobes::scan::Scratch;
use self::one_lobe::{OneLobe, Processor};
use self::tile::Tile;
#[cfg(feature = "gpu")]
use crate::gpu::GpuError;

/// Fits every texel of a batch, on all threads of the current pool. The result depends on no texel but its own and not on their number.
pub fn fit(batch: &Batch, settings: &Settings) -> Result<Vec<Outcome>, SettingsError> {
    fit_with(batch, settings, None)
}

/// `fit` with one more rung above the lobes, where the model is chosen.
pub fn fit_with(batch: &Batch, settings: &Settings, further: Option<&dyn FurtherRung>) -> Result<Vec<Outcome>, SettingsError> {
    settings.check()?;
    let Ok(outcomes) = fit_all(batch, settings, further, &Processor);
    Ok(outcomes)
}

/// `fit_with`, single lobes by a graphics device. What comes of it is `fit_with`'s but for rounding: a texel between two models, or a
/// lobe between two minima, may fall the other way.
#[cfg(feature = "gpu")]
pub fn fit_on(
    kernel: &LobeKernel,
    batch: &Batch,
    settings: &Settings,
    further: Option<&dyn FurtherRung>,
) -> Result<Vec<Outcome>, DeviceFitError> {
    settings.check()?;
    Ok(fit_all(batch, settings, further, kernel)?)
}

/// Nothing was fitted.
#[cfg(feature = "gpu")]
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DeviceFitError {
    /// No fit can be made with these.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// Lost, out of memory, or beyond its limits.
    #[error(transparent)]
    Device(#[from] GpuError),
}

fn fit_all<O: OneLobe>(
    batch: &Batch,
    settings: &Settings,
    further: Option<&dyn FurtherRung>,
    one_lobe: &O,
) -> Result<Vec<Outcome>, O::Error> {
    let further = further.filter(|_| matches!(settings.choice, Choice::Auto { .. }));
    let observations = batch.groups().iter().map(Vec::len).max().unwrap_or_default();
    let groups = one_lobe.groups_per_tile(observations, batch.groups().len());
    let tiles = batch.groups().par_chunks(groups).enumerate();
    let outcomes = tiles.map(|(i, source)| {
        let texels = (batch.texels() - i * groups * lanes::GROUP).min(source.len() * lanes::GROUP);
        fit_tile(Tile::new(source, texels, settings.noise), settings, further, one_lobe)
    });
    Ok(outcomes.collect::<Result<Vec<_>, _>>()?.concat())
}

/// Rounds in which outliers are sought, and in which clipped values change sides.
const ROUNDS: usize = 3;

fn fit_tile<O: OneLobe>(
    mut tile: Tile,
    settings: &Settings,
    further: Option<&dyn FurtherRung>,
    one_lobe: &O,
) -> Result<Vec<Outcome>, O::Error> {
    let mut scratch = Vec::new();
    let seen: Vec<usize> = (0..tile.texels().len()).filter(|&texel| tile.texels()[texel].numbers > 0).collect();
    let mut doubts = vec![Flags::NONE; tile.texels().len()];
    let mut climbs = match settings.outliers {
        Outliers::Keep => ladder::climb(&tile, &seen, settings, one_lobe, &mut scratch)?,
        Outliers::Reject => climb_without_outliers(&mut tile, &seen, settings, one_lobe, &mut doubts, &mut scratch)?,
    };
    keep_to_bounds(&mut tile, &mut climbs, settings, one_lobe, &mut scratch)?;
    if settings.precision == Precision::Polished {
        ladder::polish_double(&tile, &mut climbs, settings);
    }
    let flags = assess::flags(&tile, &climbs, settings, &mut scratch);
    let mut outcomes = vec![Outcome::Unobserved; tile.texels().len()];
    for (climb, &flags) in climbs.iter().zip(&flags) {
        let fit = assess::summary(&tile, climb, flags.with(doubts[climb.texel]));
        let better = further.and_then(|rung| further::better(&tile, climb, rung));
        outcomes[climb.texel] = Outcome::Fitted(match better {
            Some((further, margin)) => assess::further_summary(&tile, climb, further, margin, fit.flags),
            None => fit,
        });
    }
    Ok(outcomes)
}

fn climb_without_outliers<O: OneLobe>(
    tile: &mut Tile,
    seen: &[usize],
    settings: &Settings,
    one_lobe: &O,
    doubts: &mut [Flags],
    scratch: &mut Vec<Scratch>,
) -> Result<Vec<Climb>, O::Error> {
    let mut neighbours = robust::Neighbours::default();
    for &texel in seen {
        if robust::gate(tile, texel, &mut neighbours, settings) {
            doubts[texel] = doubts[texel].with(Flags::OUTLIERS);
        }
    }
    let mut climbs = ladder::climb(tile, seen, settings, one_lobe, scratch)?;
    let mut pending: Vec<usize> = (0..climbs.len()).collect();
    for _ in 0..ROUNDS {
        pending.retain(|&i| robust::trim(tile, climbs[i].texel, &climbs[i].best, &mut neighbours, settings));
        let texels: Vec<usize> = pending.iter().map(|&i| climbs[i].texel).collect();
        for (&i, climb) in pending.iter().zip(ladder::climb(tile, &texels, settings, one_lobe, scratch)?) {
            doubts[climb.texel] = doubts[climb.texel].with(Flags::OUTLIERS);
            climbs[i] = climb;
        }
    }
    Ok(climbs)
}

/// A clipped value is a lower bound: it counts while the model is below it. The kind of model stays.
fn keep_to_bounds<O: OneLobe>(
    tile: &mut Tile,
    climbs: &mut [Climb],
    settings: &Settings,
    one_lobe: &O,
    scratch: &mut Vec<Scratch>,
) -> Result<(), O::Error> {
    let mut pending: Vec<usize> = (0..climbs.len()).filter(|&i| tile.texels()[climbs[i].texel].clipped).collect();
    for _ in 0..ROUNDS {
        pending.retain(|&i| robust::bound(tile, climbs[i].texel, &climbs[i].best));
        if pending.is_empty() {
            break;
        }
        ladder::refit(tile, climbs, &pending, settings, one_lobe, scratch)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
