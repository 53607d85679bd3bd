//! Doubts about a chosen model, and its summary.

use super::candidate::Candidate;
use super::further::Further;
use super::ladder::Climb;
use super::lane_list::in_groups;
use super::lobes;
use super::lobes::question::Lobes;
use super::lobes::scan::Scratch;
use super::lobes::support::{CAPS, Support};
use super::settings::{Choice, Fit, Flags, Rung, Settings, Termination};
use super::tile::Tile;

/// Views that must lie above half of a lobe's height.
const LEAST_VIEWS: f32 = 3.0;
/// With fewer views, a texel without a lobe may well have one that none of them sees.
const VIEWS_THAT_EXCLUDE: usize = 17;
/// Standard deviation of ln m beyond which an exponent is open.
const OPEN_EXPONENT: f64 = 0.5;
/// Views that a cap should hold to tell how far they are apart.
const DENSE_CAP: f32 = 7.0;
/// Peaks of the residuals at which one more lobe is tried for it.
const PEAKS: usize = 1;
/// By how much the criterion of one more lobe, unpolished, must be better for a misfit.
const MISFIT_MARGIN: f64 = 0.0;

/// Adds what the views say about the lobes of each climb.
pub fn flags(tile: &Tile, climbs: &[Climb], settings: &Settings, scratch: &mut Vec<Scratch>) -> Vec<Flags> {
    let mut flags = vec![Flags::NONE; climbs.len()];
    for count in 0..=lobes::question::MAX_LOBES {
        let these: Vec<usize> = (0..climbs.len()).filter(|&i| climbs[i].best.lobes() == count).collect();
        for lanes in in_groups(these.iter().map(|&i| climbs[i].texel)) {
            let (group, _) = tile.gather(&lanes.texels);
            let mut shape = Lobes::NONE;
            lanes.wanted().for_each(|(lane, i)| climbs[these[i]].best.put(&mut shape, lane));
            let support = lobes::support(count, &group, &shape);
            let may_be_more = these.iter().any(|&i| could_be_more(&climbs[i].best, settings));
            let found = may_be_more.then(|| lobes::candidates(count, &group, &shape, PEAKS, scratch));
            for (lane, i) in lanes.wanted() {
                let climb = &climbs[these[i]];
                let flag = &mut flags[these[i]];
                let hidden = count == 0 && tile.texels()[climb.texel].views < VIEWS_THAT_EXCLUDE;
                if hidden || (0..count).any(|j| is_unresolved(climb, j, &support, lane)) {
                    *flag = flag.with(Flags::UNRESOLVED);
                }
                let Some(found) = &found else { continue };
                let gain = found.gain.iter().flatten().map(|row| f64::from(row[lane])).fold(0.0, f64::max);
                let more = climb.criterion.value(climb.best.cost - gain, climb.best.parameters() + 6.0);
                let now = climb.criterion.value(climb.best.cost, climb.best.parameters());
                if could_be_more(&climb.best, settings) && more < now - MISFIT_MARGIN {
                    *flag = flag.with(Flags::MISFIT);
                }
            }
        }
    }
    flags
}

/// Whether no larger model has been tried.
fn could_be_more(best: &Candidate, settings: &Settings) -> bool {
    match settings.choice {
        Choice::Auto { lobes_at_most } => best.lobes() == lobes_at_most && best.rung != Rung::CosinePower,
        Choice::Exactly(rung) => rung != Rung::CosinePower,
    }
}

fn is_unresolved(climb: &Climb, j: usize, support: &Support, lane: usize) -> bool {
    let best = &climb.best;
    let half_angle = (2.0 * std::f64::consts::LN_2 / f64::from(best.shape.log_exponent[j]).exp()).sqrt();
    let within = support.within[j].map(|row| row[lane]);
    let (cap, views) = if within[0] >= DENSE_CAP { (CAPS[0], within[0]) } else { (CAPS[1], within[1]) };
    let spacing = (std::f64::consts::TAU * (1.0 - cap.cos()) / f64::from(views)).sqrt();
    let deviation = (climb.criterion.variance(best.cost, best.parameters()) * f64::from(best.log_exponent_variance[j])).sqrt();
    !(half_angle >= 0.5 * spacing) || support.above_half[j][lane] < LEAST_VIEWS || !(deviation <= OPEN_EXPONENT)
}

/// What the caller is told.
pub fn summary(tile: &Tile, climb: &Climb, flags: Flags) -> Fit {
    let known = tile.texels()[climb.texel];
    let square = known.scale * known.scale;
    Fit {
        model: climb.best.model(known.scale),
        termination: climb.best.termination,
        iterations: climb.best.iterations,
        initial_cost: climb.best.initial_cost as f32 * square,
        final_cost: climb.best.cost as f32 * square,
        rms_residual: (climb.best.cost / known.numbers.max(1) as f64).sqrt() as f32 * known.scale,
        margin: (climb.runner_up - climb.value) as f32,
        flags: if known.clipped { flags.with(Flags::CLIPPED) } else { flags },
    }
}

/// The same where a further rung has won. Its residuals are its own: doubts about lobes are none about it.
pub fn further_summary(tile: &Tile, climb: &Climb, further: Further, margin: f64, flags: Flags) -> Fit {
    let kept = [Flags::CLIPPED, Flags::OUTLIERS].into_iter().filter(|&flag| flags.contains(flag));
    let numbers = tile.texels()[climb.texel].numbers.max(1) as f64;
    Fit {
        model: further.model,
        termination: Termination::Linear,
        iterations: 0,
        initial_cost: further.cost as f32,
        final_cost: further.cost as f32,
        rms_residual: (further.cost / numbers).sqrt() as f32,
        margin: margin as f32,
        flags: kept.fold(Flags::NONE, Flags::with),
    }
}
