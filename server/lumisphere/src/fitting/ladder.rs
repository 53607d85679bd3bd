//! The ladder: constant, cosine power, one lobe, two, … and for each texel the rung with the best criterion.
//!
//! A rung with J lobes starts from the one with J − 1 and what its residuals leave. A texel climbs one rung past its best: two lobes may
//! be worth their price where one is not. It stops earlier where not even a perfect fit could pay for a larger model, or where a lobe
//! at the residuals' peaks gains far less than its price.

use super::candidate::{Candidate, Start};
use super::lane_list::in_groups;
use super::lanes::{GROUP, Row};
use super::lobes::flat::Rungs;
use super::lobes::question::{Lobes, MAX_LOBES, Question, Stop};
use super::lobes::scan::{EXPONENTS, Look, Scratch};
use super::lobes::{self, Numbers};
use super::one_lobe::OneLobe;
use super::sample::Weights;
use super::selection::Criterion;
use super::settings::{Choice, Rung, Settings, Starts};
use super::tile::Tile;

/// Views from which one start serves where the best is clear.
const MANY_VIEWS: usize = 73;
/// A start is clear if no other peak gains this share of it.
const CLEAR: f32 = 0.8;
/// A polished lobe gains at most this many times what the scan saw, as a rule of thumb with room: beyond it a rung is not tried.
const OPTIMISM: f64 = 4.0;
/// Cosine of the largest angle from a lobe to two peaks that it may stand for, 40°.
const BETWEEN: f32 = 0.77;
/// Parameters that may be fitted, as a share of the numbers observed.
const MOST_PARAMETERS: f64 = 0.75;
/// The last steps in f64.
const LAST_DIGITS: Stop = Stop { tolerance: 1e-13, iterations: 2 };
/// Enough to tell which of several starts or rungs is the best.
const EXPLORE: Stop = Stop { tolerance: 1e-4, iterations: 30 };

/// A texel on the ladder.
#[derive(Debug, Clone, Copy)]
pub struct Climb {
    /// Which texel of the tile.
    pub texel: usize,
    /// How it weighs residuals against size.
    pub criterion: Criterion,
    /// The best rung so far.
    pub best: Candidate,
    /// Its criterion, and by how much the next best is behind.
    pub value: f64,
    /// Smallest criterion of all other rungs.
    pub runner_up: f64,
    /// The highest rung fitted: where the next starts.
    pub top: Candidate,
}

impl Climb {
    fn offer(&mut self, candidate: Candidate) {
        let value = self.criterion.of(&candidate);
        if value < self.value {
            (self.best, self.runner_up, self.value) = (candidate, self.value, value);
        } else {
            self.runner_up = self.runner_up.min(value);
        }
    }
}

/// Fits these texels of a tile.
pub fn climb<O: OneLobe>(
    tile: &Tile,
    texels: &[usize],
    settings: &Settings,
    one_lobe: &O,
    scratch: &mut Vec<Scratch>,
) -> Result<Vec<Climb>, O::Error> {
    let mut climbs = flat_rungs(tile, texels, settings);
    let highest = match settings.choice {
        Choice::Auto { lobes_at_most } => lobes_at_most,
        Choice::Exactly(Rung::Lobes(count)) => count,
        Choice::Exactly(_) => 0,
    };
    let mut unfinished = false;
    for count in 1..=highest {
        let climbing: Vec<usize> = (0..climbs.len()).filter(|&i| may_climb(&climbs[i], count, settings)).collect();
        if climbing.is_empty() {
            break;
        }
        let peaks = if settings.starts == Starts::Exactly(1) { 1 } else { 3 };
        let looks = match count {
            1 => one_lobe.look(tile, &climbs, &climbing, peaks, scratch)?,
            _ => look(tile, &climbs, &climbing, count, peaks, scratch),
        };
        let tasks = starts(tile, &climbs, &climbing, count, settings, &looks, peaks);
        // One start each of the model asked for goes all the way; where starts or rungs compete, only the winner does.
        let competing = tasks.len() > climbing.len() || matches!(settings.choice, Choice::Auto { .. });
        let stop = if competing || count < highest { EXPLORE } else { stop(settings) };
        let polished = match count {
            1 => one_lobe.polish(tile, &tasks, settings, stop)?,
            _ => polish(tile, &tasks, count, settings, Numbers::Single, stop),
        };
        unfinished |= competing;
        for (i, candidate) in winners(tile, &climbs, &tasks, polished, settings) {
            let climb = &mut climbs[i];
            climb.top = candidate;
            match settings.choice {
                Choice::Auto { .. } => climb.offer(candidate),
                Choice::Exactly(_) => (climb.best, climb.runner_up) = (candidate, f64::INFINITY),
            }
        }
    }
    if unfinished {
        let all: Vec<usize> = (0..climbs.len()).collect();
        polish_these(tile, &mut climbs, &all, settings, one_lobe)?;
    }
    Ok(climbs)
}

/// The last steps from f32's digits to f64's, quadratically.
pub fn polish_double(tile: &Tile, climbs: &mut [Climb], settings: &Settings) {
    for count in 1..=MAX_LOBES {
        let tasks = of_count(climbs, 0..climbs.len(), count);
        let polished = polish(tile, &tasks, count, settings, Numbers::Double, LAST_DIGITS);
        keep(climbs, &tasks, polished);
    }
}

fn stop(settings: &Settings) -> Stop {
    Stop { tolerance: f64::from(settings.tolerance), iterations: settings.iterations_at_most }
}

/// Constant and cosine power of every texel.
fn flat_rungs(tile: &Tile, texels: &[usize], settings: &Settings) -> Vec<Climb> {
    let wanted = match settings.choice {
        Choice::Auto { .. } | Choice::Exactly(Rung::CosinePower) => Rungs::Both,
        Choice::Exactly(_) => Rungs::Constant,
    };
    let mut climbs = Vec::with_capacity(texels.len());
    for lanes in in_groups(texels.iter().copied()) {
        let (group, _) = tile.gather(&lanes.texels);
        let flat = lobes::flat_rungs(&group, wanted);
        for (lane, i) in lanes.wanted() {
            let known = tile.texels()[texels[i]];
            let floor = f64::from(settings.noise.floor / known.scale);
            let criterion = Criterion::new(known.numbers.max(1) as f64, floor);
            let constant = Candidate::flat(Rung::Constant, flat.constant.map(|row| row[lane]), 0.0, flat.constant_cost[lane]);
            let value = criterion.value(constant.cost, constant.parameters());
            let mut climb = Climb { texel: texels[i], criterion, best: constant, value, runner_up: f64::INFINITY, top: constant };
            let power = Candidate::flat(Rung::CosinePower, flat.value.map(|row| row[lane]), flat.exponent[lane], flat.cost[lane]);
            match settings.choice {
                Choice::Auto { .. } => climb.offer(power),
                Choice::Exactly(Rung::CosinePower) => climb.best = power,
                Choice::Exactly(_) => {}
            }
            climbs.push((i, climb));
        }
    }
    climbs.sort_by_key(|(i, _)| *i);
    climbs.into_iter().map(|(_, climb)| climb).collect()
}

/// Whether a rung of `count` lobes can pay, as far as is known without looking.
fn may_climb(climb: &Climb, count: usize, settings: &Settings) -> bool {
    if matches!(settings.choice, Choice::Exactly(_)) {
        return true;
    }
    let parameters = 3.0 + 6.0 * count as f64;
    let more = parameters - climb.best.parameters();
    parameters <= MOST_PARAMETERS * climb.criterion.numbers()
        && count <= climb.best.lobes() + 2
        && climb.top.lobes() + 1 == count
        && climb.criterion.cost_to_beat(climb.best.cost, more) >= 0.0
}

/// A texel (by its place among the climbs) and one start.
#[derive(Debug, Clone, Copy)]
pub struct Task {
    /// Index of the climb.
    pub climb: usize,
    /// Texel of the tile.
    pub texel: usize,
    /// Where to start.
    pub start: Start,
    /// Constant and amplitudes there, as far as known: residuals of a good guess keep their digits.
    pub linear: [[f32; 3]; MAX_LOBES + 1],
}

/// What one more lobe than `count − 1` would gain, for each that climbs.
pub fn look(tile: &Tile, climbs: &[Climb], climbing: &[usize], count: usize, peaks: usize, scratch: &mut Vec<Scratch>) -> Vec<Look> {
    let mut looks = vec![Look::NONE; climbing.len()];
    for lanes in in_groups(climbing.iter().map(|&i| climbs[i].texel)) {
        let (group, _) = tile.gather(&lanes.texels);
        let mut shape = Lobes::NONE;
        for (lane, i) in lanes.wanted() {
            climbs[climbing[i]].top.put(&mut shape, lane);
        }
        let found = lobes::candidates(count - 1, &group, &shape, peaks, scratch);
        lanes.wanted().for_each(|(lane, i)| looks[i] = found.of_lane(lane));
    }
    looks
}

/// Starts of a rung, for the texels for which a look at the residuals does not rule it out.
fn starts(tile: &Tile, climbs: &[Climb], climbing: &[usize], count: usize, settings: &Settings, looks: &[Look], peaks: usize) -> Vec<Task> {
    let mut tasks = Vec::new();
    for (&i, look) in climbing.iter().zip(looks) {
        let climb = &climbs[i];
        let ranked = ranked(look, peaks);
        if rules_out(climb, count, ranked[0].gain, settings) {
            continue;
        }
        let views = tile.texels()[climb.texel].views;
        let number = number_of_starts(&ranked, views, settings);
        for place in &ranked[..number.min(ranked.len())] {
            let mut start = climb.top.shape;
            start.axis[count - 1] = place.axis;
            start.log_exponent[count - 1] = place.log_exponent;
            tasks.push(Task { climb: i, texel: climb.texel, start, linear: climb.top.linear });
        }
        if let Some(start) = split(&climb.top, &ranked).filter(|_| settings.starts == Starts::Adaptive) {
            tasks.push(Task { climb: i, texel: climb.texel, start, linear: climb.top.linear });
        }
    }
    tasks
}

/// One lobe amid two lights is drawn to both: as a start, the lobe nearest to two peaks of the residuals gives way to one at each.
fn split(top: &Candidate, ranked: &[Place]) -> Option<Start> {
    let first = ranked.first()?;
    let second = ranked.iter().find(|place| place.peak != first.peak)?;
    let count = top.lobes();
    let nearness = |j: usize| {
        let toward = |place: &Place| (0..3).map(|c| place.axis[c] * top.shape.axis[j][c]).sum::<f32>();
        toward(first).min(toward(second))
    };
    let between = (0..count).max_by(|&a, &b| nearness(a).total_cmp(&nearness(b))).filter(|&j| nearness(j) > BETWEEN)?;
    let mut start = top.shape;
    let log_exponent = start.log_exponent[between] + std::f32::consts::LN_2;
    (start.axis[between], start.axis[count]) = (first.axis, second.axis);
    (start.log_exponent[between], start.log_exponent[count]) = (log_exponent, log_exponent);
    Some(start)
}

fn rules_out(climb: &Climb, count: usize, gain: f32, settings: &Settings) -> bool {
    if matches!(settings.choice, Choice::Exactly(_)) {
        return false;
    }
    let more = 3.0 + 6.0 * count as f64 - climb.best.parameters();
    climb.top.cost - OPTIMISM * f64::from(gain) > climb.criterion.cost_to_beat(climb.best.cost, more)
}

/// A lobe that could start.
#[derive(Debug, Clone, Copy)]
struct Place {
    axis: [f32; 3],
    log_exponent: f32,
    gain: f32,
    peak: usize,
}

/// The best two exponents of every peak and of the first one's centroid, best first.
fn ranked(look: &Look, peaks: usize) -> Vec<Place> {
    let mut places = Vec::with_capacity(2 * peaks + 2);
    for at in 0..=peaks {
        let gain = look.gain[at];
        let mut order: [usize; EXPONENTS.len()] = std::array::from_fn(|k| k);
        order.sort_by(|&a, &b| gain[b].total_cmp(&gain[a]));
        let axis = look.place[at];
        for (rank, &k) in order[..2].iter().enumerate() {
            let log_exponent = if rank == 0 { between(&gain, k) } else { EXPONENTS[k].ln() };
            places.push(Place { axis, log_exponent, gain: gain[k], peak: at % peaks });
        }
    }
    places.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    places
}

/// Where the parabola through the gains around exponent `k` peaks, as ln m.
fn between(gain: &[f32; EXPONENTS.len()], k: usize) -> f32 {
    let middle = EXPONENTS[k].ln();
    if k == 0 || k + 1 == EXPONENTS.len() {
        return middle;
    }
    let (down, up) = (gain[k] - gain[k - 1], gain[k] - gain[k + 1]);
    let bend = down + up;
    if !(bend > 0.0) {
        return middle;
    }
    middle + 0.5 * (down - up) / bend * (EXPONENTS[1] / EXPONENTS[0]).ln()
}

fn number_of_starts(ranked: &[Place], views: usize, settings: &Settings) -> usize {
    match settings.starts {
        Starts::Exactly(number) => number.max(1),
        Starts::Adaptive if views < MANY_VIEWS => 5,
        Starts::Adaptive => {
            let other = ranked.iter().find(|place| place.peak != ranked[0].peak);
            if views >= 150 && other.is_none_or(|place| place.gain < CLEAR * ranked[0].gain) { 1 } else { 3 }
        }
    }
}

/// The best start of every climb that has tasks: (index of the climb, what was reached).
fn winners(tile: &Tile, climbs: &[Climb], tasks: &[Task], polished: Vec<Candidate>, settings: &Settings) -> Vec<(usize, Candidate)> {
    let mut best: Vec<(usize, Candidate)> = Vec::new();
    for (of_climb, candidates) in tasks.chunk_by(|a, b| a.climb == b.climb).scan(0, |at, chunk| {
        let candidates = &polished[*at..*at + chunk.len()];
        *at += chunk.len();
        Some((chunk[0].climb, candidates))
    }) {
        let least = candidates.iter().map(|c| c.cost).fold(f64::INFINITY, f64::min);
        let numbers = tile.texels()[climbs[of_climb].texel].numbers as f64;
        let objective = |c: &Candidate| c.objective(settings.prior, least / (numbers - c.parameters()).max(1.0));
        if let Some(winner) = candidates.iter().min_by(|a, b| objective(a).total_cmp(&objective(b))) {
            best.push((of_climb, *winner));
        }
    }
    best
}

/// Polishes every task: `count` lobes, in the order of the tasks.
pub fn polish(tile: &Tile, tasks: &[Task], count: usize, settings: &Settings, numbers: Numbers, stop: Stop) -> Vec<Candidate> {
    let mut polished: Vec<(usize, Candidate)> = Vec::with_capacity(tasks.len());
    for weights in [Weights::Shared, Weights::PerChannel] {
        let these: Vec<usize> = (0..tasks.len()).filter(|&i| tile.texels()[tasks[i].texel].weights == weights).collect();
        for lanes in in_groups(these.iter().map(|&i| tasks[i].texel)) {
            let (samples, all_observed) = tile.gather(&lanes.texels);
            let mut lobes = Lobes::NONE;
            let (mut observed, mut floor): (Row, Row) = ([0.0; GROUP], [0.0; GROUP]);
            for (lane, i) in lanes.wanted() {
                let task = &tasks[these[i]];
                floor[lane] = (settings.noise.floor / tile.texels()[task.texel].scale).powi(2);
                observed[lane] = all_observed[lane];
                task.start.put(&mut lobes, lane);
                lobes.put_linear(&task.linear, lane);
            }
            let question = Question { samples: &samples, observed: &observed, floor: &floor, prior: settings.prior, stop };
            let report = lobes::fit(count, numbers, weights, &question, &mut lobes);
            polished.extend(lanes.wanted().map(|(lane, i)| (these[i], Candidate::from_lane(count, &lobes, &report, lane))));
        }
    }
    polished.sort_by_key(|(i, _)| *i);
    polished.into_iter().map(|(_, candidate)| candidate).collect()
}

/// Fits the best rung of some climbs again, from where it stands, after their weights have changed.
pub fn refit<O: OneLobe>(
    tile: &Tile,
    climbs: &mut [Climb],
    these: &[usize],
    settings: &Settings,
    one_lobe: &O,
    scratch: &mut Vec<Scratch>,
) -> Result<(), O::Error> {
    for rung in [Rung::Constant, Rung::CosinePower] {
        let flat: Vec<usize> = these.iter().copied().filter(|&i| climbs[i].best.rung == rung).collect();
        let texels: Vec<usize> = flat.iter().map(|&i| climbs[i].texel).collect();
        let again = climb(tile, &texels, &Settings { choice: Choice::Exactly(rung), ..*settings }, one_lobe, scratch)?;
        flat.iter().zip(again).for_each(|(&i, again)| climbs[i].best = again.best);
    }
    polish_these(tile, climbs, these, settings, one_lobe)
}

/// All the way, from where they stand.
fn polish_these<O: OneLobe>(tile: &Tile, climbs: &mut [Climb], these: &[usize], settings: &Settings, one_lobe: &O) -> Result<(), O::Error> {
    for count in 1..=MAX_LOBES {
        let tasks = of_count(climbs, these.iter().copied(), count);
        let polished = match count {
            1 => one_lobe.polish(tile, &tasks, settings, stop(settings))?,
            _ => polish(tile, &tasks, count, settings, Numbers::Single, stop(settings)),
        };
        keep(climbs, &tasks, polished);
    }
    Ok(())
}

/// Those of the climbs whose best has `count` lobes.
fn of_count(climbs: &[Climb], these: impl Iterator<Item = usize>, count: usize) -> Vec<Task> {
    let of_count = these.filter(|&i| climbs[i].best.lobes() == count);
    of_count.map(|i| Task { climb: i, texel: climbs[i].texel, start: climbs[i].best.shape, linear: climbs[i].best.linear }).collect()
}

fn keep(climbs: &mut [Climb], tasks: &[Task], polished: Vec<Candidate>) {
    for (task, polished) in tasks.iter().zip(polished) {
        let best = &mut climbs[task.climb].best;
        let (initial_cost, iterations) = (best.initial_cost, best.iterations + polished.iterations);
        *best = Candidate { initial_cost, iterations, ..polished };
    }
}
