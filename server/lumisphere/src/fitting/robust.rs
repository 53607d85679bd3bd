//! Samples that the fit must not follow: outliers (glints of a misregistered view, reflections of the photographer), and clipped values
//! once the model has passed them.
//!
//! An outlier is looked for before the first fit, since a lobe swallows it, and again in the residuals. A sample is not blamed where its
//! neighbours share its fate: that is structure which the model lacks. With few views a highlight that one of them sees looks the same.

use super::batch::State;
use super::candidate::Candidate;
use super::settings::Settings;
use super::tile::Tile;

/// Views nearest to each view that are looked at.
const NEIGHBOURS: usize = 6;
/// By how many standard deviations a sample must stand out before the first fit, and in the residuals.
const SPIKE: f32 = 6.0;
const TRIM: f32 = 5.0;
/// A neighbour above the median by this share of a spike's own height shows that it belongs to a lobe.
const FLANK: f32 = 0.1;
/// Deviation of normal numbers over their median absolute value; the same for differences from the median of six.
const MAD: f32 = 1.4826;
const MAD_OF_DIFFERENCE: f32 = MAD / 1.12;

/// Nearest views of each view, kept while the directions stay the same.
#[derive(Default)]
pub struct Neighbours {
    directions: Vec<[f32; 3]>,
    nearest: Vec<Vec<u32>>,
}

impl Neighbours {
    /// Of these directions.
    fn of(&mut self, directions: Vec<[f32; 3]>) -> &[Vec<u32>] {
        if self.directions != directions {
            self.nearest = (0..directions.len()).map(|i| nearest(&directions, i)).collect();
            self.directions = directions;
        }
        &self.nearest
    }
}

fn nearest(directions: &[[f32; 3]], i: usize) -> Vec<u32> {
    let mut best: Vec<(f32, u32)> = Vec::with_capacity(NEIGHBOURS + 1);
    let [x, y, z] = directions[i];
    for (j, d) in directions.iter().enumerate() {
        let cosine = x * d[0] + y * d[1] + z * d[2];
        if j == i || (best.len() == NEIGHBOURS && best.last().is_some_and(|least| cosine <= least.0)) {
            continue;
        }
        let at = best.partition_point(|other| other.0 >= cosine);
        best.insert(at, (cosine, j as u32));
        best.truncate(NEIGHBOURS);
    }
    best.into_iter().map(|(_, j)| j).collect()
}

/// One texel's samples that weigh anything.
struct Seen {
    /// Their indices.
    index: Vec<usize>,
    /// Values or residuals.
    value: Vec<[f32; 3]>,
}

fn seen(tile: &Tile, texel: usize, residuals_of: Option<&Candidate>) -> (Seen, Vec<[f32; 3]>) {
    let (group, lane) = tile.place(texel);
    let model = residuals_of.map(|candidate| candidate.model(1.0));
    let (mut seen, mut directions) = (Seen { index: Vec::new(), value: Vec::new() }, Vec::new());
    for (i, sample) in group.iter().enumerate() {
        // A sample that is clipped in a channel says nothing about its neighbours there.
        if (0..3).any(|c| sample.root_weight[c][lane] == 0.0) {
            continue;
        }
        let d = sample.direction.map(|row| row[lane]);
        let expected = model.as_ref().map_or([0.0; 3], |model| model.eval(d));
        // In units of the noise where it grows with the value.
        seen.value.push(std::array::from_fn(|c| (sample.value[c][lane] - expected[c]) * sample.root_weight[c][lane]));
        seen.index.push(i);
        directions.push(d);
    }
    (seen, directions)
}

/// Samples far above all of their neighbours, while these lie at the texel's usual level.
fn spikes(seen: &Seen, nearest: &[Vec<u32>], floor: f32) -> Vec<usize> {
    let mut found = Vec::new();
    for c in 0..3 {
        let around = |i: usize| nearest[i].iter().map(|&j| seen.value[j as usize][c]).collect::<Vec<f32>>();
        let off = |i: usize| (seen.value[i][c] - median(around(i))).abs();
        let sigma = (MAD_OF_DIFFERENCE * median((0..seen.value.len()).map(off).collect())).max(floor);
        let usual = median(seen.value.iter().map(|v| v[c]).collect());
        for i in 0..seen.value.len() {
            let others = around(i);
            let (low, high) = others.iter().fold((f32::MAX, f32::MIN), |(low, high), &v| (low.min(v), high.max(v)));
            let excess = seen.value[i][c] - high;
            let stands_out = excess > SPIKE * sigma && excess > high - low;
            if stands_out && high - usual < FLANK * excess + 2.0 * sigma {
                found.push(seen.index[i]);
            }
        }
    }
    found
}

/// Samples whose residual is too large, unless neighbours share it; and those that alone carry a lobe.
fn strays(seen: &Seen, nearest: &[Vec<u32>], floor: f32) -> Vec<usize> {
    let mut far = vec![false; seen.value.len()];
    for c in 0..3 {
        let sigma = (MAD * median(seen.value.iter().map(|v| v[c].abs()).collect())).max(floor);
        for (far, value) in far.iter_mut().zip(&seen.value) {
            *far |= value[c].abs() > TRIM * sigma;
        }
    }
    let alone = |&i: &usize| far[i] && nearest[i].iter().filter(|&&j| far[j as usize]).count() < 2;
    (0..far.len()).filter(alone).map(|i| seen.index[i]).collect()
}

fn median(mut values: Vec<f32>) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn exclude(tile: &mut Tile, texel: usize, samples: &[usize]) {
    tile.reweigh(texel, |i, _, old| if samples.contains(&i) { 0.0 } else { old });
}

/// Leaves out what stands alone before any fit; whether there was any.
pub fn gate(tile: &mut Tile, texel: usize, neighbours: &mut Neighbours, settings: &Settings) -> bool {
    let (seen, directions) = seen(tile, texel, None);
    let floor = settings.noise.floor / tile.texels()[texel].scale;
    let found = spikes(&seen, neighbours.of(directions), floor);
    exclude(tile, texel, &found);
    !found.is_empty()
}

/// Leaves out what a fitted model shows to stand alone; whether there was any.
pub fn trim(tile: &mut Tile, texel: usize, fitted: &Candidate, neighbours: &mut Neighbours, settings: &Settings) -> bool {
    let (seen, directions) = seen(tile, texel, Some(fitted));
    let floor = settings.noise.floor / tile.texels()[texel].scale;
    let carriers = carriers(&directions, &seen.index, fitted);
    let mut found = strays(&seen, neighbours.of(directions), floor);
    found.extend(carriers);
    exclude(tile, texel, &found);
    !found.is_empty()
}

/// The samples that see a lobe which rests on one or two of them.
fn carriers(directions: &[[f32; 3]], index: &[usize], fitted: &Candidate) -> Vec<usize> {
    let mut found = Vec::new();
    for j in fitted.lonely() {
        let ([x, y, z], exponent) = (fitted.shape.axis[j], fitted.shape.log_exponent[j].exp());
        let height = |d: &[f32; 3]| (x * d[0] + y * d[1] + z * d[2]).max(0.0).powf(exponent);
        found.extend(directions.iter().zip(index).filter(|(d, _)| height(d) > 0.3).map(|(_, &i)| i));
    }
    found
}

/// Gives clipped values the weight that a one-sided residual has: one where the model is below the bound, none above. Whether any changed.
pub fn bound(tile: &mut Tile, texel: usize, fitted: &Candidate) -> bool {
    let (observations, lane) = tile.observations(texel);
    let (group, _) = tile.place(texel);
    let residuals = fitted.residuals(group, lane);
    let is_bound = |state: State, c: usize| !state.is_missing() && state.is_clipped(c);
    let is_value = |state: State, c: usize| !state.is_missing() && !state.is_clipped(c);
    // Where nothing but bounds is known of a channel, they are its values.
    let known: [bool; 3] = std::array::from_fn(|c| observations.iter().any(|o| is_value(o.state[lane], c)));
    let mut changed = false;
    tile.reweigh(texel, |i, c, old| {
        if !known[c] || observations.get(i).is_none_or(|o| !is_bound(o.state[lane], c)) {
            return old;
        }
        let new = if residuals[i][c] > 0.0 { 1.0 } else { 0.0 };
        changed |= new != old;
        new
    });
    changed
}
