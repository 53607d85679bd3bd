//! The texels that one thread fits at a time: their samples scaled and weighted, and gathered again for every rung so that only texels
//! that still climb take part.

use std::borrow::Cow;
use std::sync::atomic::{AtomicU64, Ordering};

use super::batch::Observation;
use super::lanes::{GROUP, Row};
use super::sample::{Sample, Weights};
use super::settings::Noise;

/// Samples' bytes that a tile should hold: what stays in a core's own cache.
const TILE_BYTES: usize = 1 << 20;

/// Groups of a tile whose texels have so many observations.
pub fn groups_per_tile(observations: usize) -> usize {
    (TILE_BYTES / (observations.max(1) * size_of::<Sample>())).clamp(2, 32)
}

/// What is known of a texel before any fit.
#[derive(Debug, Clone, Copy, Default)]
pub struct Texel {
    /// Values are divided by it: a power of two, so that nothing is rounded.
    pub scale: f32,
    /// Samples that weigh anything.
    pub views: usize,
    /// Numbers that weigh anything: up to three a sample.
    pub numbers: usize,
    /// Whether any value is only a lower bound.
    pub clipped: bool,
    /// Which kernel fits it: its own weights decide, not its neighbours'.
    pub weights: Weights,
}

/// Groups of texels with their weights.
pub struct Tile<'a> {
    source: &'a [Vec<Observation>],
    groups: Vec<Vec<Sample>>,
    texels: Vec<Texel>,
    stamp: u64,
}

/// Of what tiles have held so far.
static STAMPS: AtomicU64 = AtomicU64::new(0);

fn next_stamp() -> u64 {
    STAMPS.fetch_add(1, Ordering::Relaxed)
}

impl<'a> Tile<'a> {
    /// Scales and weighs. Clipped values weigh nothing at first.
    pub fn new(source: &'a [Vec<Observation>], texels: usize, noise: Noise) -> Self {
        let texels_known = vec![Texel::default(); source.len() * GROUP];
        let mut tile = Self { source, groups: Vec::with_capacity(source.len()), texels: texels_known, stamp: next_stamp() };
        for (g, observations) in source.iter().enumerate() {
            let known = &mut tile.texels[g * GROUP..][..GROUP];
            let scale = scales(observations);
            let samples = observations.iter().map(|o| weighted(o, &scale, noise)).collect();
            for (lane, texel) in known.iter_mut().enumerate() {
                texel.scale = scale[lane];
                texel.clipped = observations.iter().any(|o| !o.state[lane].is_missing() && (0..3).any(|c| o.state[lane].is_clipped(c)));
            }
            tile.groups.push(samples);
        }
        tile.texels.truncate(texels);
        (0..tile.texels.len())
            .filter(|&texel| tile.texels[texel].clipped)
            .collect::<Vec<_>>()
            .into_iter()
            .for_each(|t| tile.admit_bounds(t));
        (0..tile.texels.len()).for_each(|texel| tile.count(texel));
        tile
    }

    /// What is known of each texel.
    pub fn texels(&self) -> &[Texel] {
        &self.texels
    }

    /// Another for everything that any tile ever held: what was copied elsewhere is still the same under the same stamp.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only a device holds copies"))]
    pub fn stamp(&self) -> u64 {
        self.stamp
    }

    /// The samples of all groups.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only a device holds copies"))]
    pub fn groups(&self) -> &[Vec<Sample>] {
        &self.groups
    }

    /// The samples of a texel's group, and its lane there.
    pub fn place(&self, texel: usize) -> (&[Sample], usize) {
        (&self.groups[texel / GROUP], texel % GROUP)
    }

    /// A texel's observations as they came, and its lane.
    pub fn observations(&self, texel: usize) -> (&'a [Observation], usize) {
        (&self.source[texel / GROUP], texel % GROUP)
    }

    /// Gives the samples of a texel new weights, as their roots.
    pub fn reweigh(&mut self, texel: usize, mut root_weight: impl FnMut(usize, usize, f32) -> f32) {
        let (g, lane) = (texel / GROUP, texel % GROUP);
        self.stamp = next_stamp();
        for (i, sample) in self.groups[g].iter_mut().enumerate() {
            for c in 0..3 {
                sample.root_weight[c][lane] = root_weight(i, c, sample.root_weight[c][lane]);
            }
        }
        self.count(texel);
    }

    /// A channel of which only lower bounds are known takes these as its values: the least that it can be.
    fn admit_bounds(&mut self, texel: usize) {
        let (observations, lane) = self.observations(texel);
        let (group, _) = self.place(texel);
        let known: [bool; 3] = std::array::from_fn(|c| group.iter().any(|s| s.root_weight[c][lane] > 0.0));
        self.reweigh(texel, |i, c, old| {
            let bound = observations.get(i).is_some_and(|o| !o.state[lane].is_missing() && o.state[lane].is_clipped(c));
            if bound && !known[c] { 1.0 } else { old }
        });
    }

    fn count(&mut self, texel: usize) {
        let (group, lane) = self.place(texel);
        let (mut views, mut numbers, mut weights) = (0, 0, Weights::Shared);
        for sample in group {
            let roots = sample.root_weight.map(|row| row[lane]);
            let seen = roots.iter().filter(|&&root| root > 0.0).count();
            views += usize::from(seen > 0);
            numbers += seen;
            if roots[0] != roots[1] || roots[0] != roots[2] {
                weights = Weights::PerChannel;
            }
        }
        let known = &mut self.texels[texel];
        (known.views, known.numbers, known.weights) = (views, numbers, weights);
    }

    /// The samples of up to 16 texels, one to a lane in the order given; a texel may appear twice.
    pub fn gather(&self, texels: &[usize]) -> (Cow<'_, [Sample]>, Row) {
        let mut observed = [0.0; GROUP];
        for (number, &texel) in observed.iter_mut().zip(texels) {
            *number = self.texels[texel].numbers as f32;
        }
        let Some(&first) = texels.first() else { return (Cow::Borrowed(&[]), observed) };
        let in_place = first % GROUP == 0 && texels.windows(2).all(|pair| pair[1] == pair[0] + 1);
        if in_place {
            return (Cow::Borrowed(&self.groups[first / GROUP]), observed);
        }
        let count = texels.iter().map(|&t| self.groups[t / GROUP].len()).max().unwrap_or_default();
        let mut samples = vec![Sample::NONE; count];
        for (lane, &texel) in texels.iter().enumerate() {
            let (from, from_lane) = self.place(texel);
            for (to, sample) in samples.iter_mut().zip(from) {
                to.copy_lane(lane, sample, from_lane);
            }
        }
        (Cow::Owned(samples), observed)
    }
}

/// For each lane, a power of two not below the largest absolute value.
fn scales(observations: &[Observation]) -> Row {
    let mut most = [0.0_f32; GROUP];
    for observation in observations {
        for values in &observation.value {
            for (most, value) in most.iter_mut().zip(values) {
                *most = most.max(value.abs());
            }
        }
    }
    // Bounded, so that neither the scale nor its reciprocal leaves the normal numbers.
    most.map(|value| if value > 0.0 { value.log2().ceil().clamp(-100.0, 100.0).exp2() } else { 1.0 })
}

fn weighted(observation: &Observation, scale: &Row, noise: Noise) -> Sample {
    let mut sample = Sample { direction: observation.direction, value: observation.value, root_weight: [[0.0; GROUP]; 3] };
    for c in 0..3 {
        for (lane, scale) in scale.iter().enumerate() {
            let state = observation.state[lane];
            let value = observation.value[c][lane];
            sample.value[c][lane] = value / scale;
            if !state.is_missing() && !state.is_clipped(c) {
                let growth = noise.relative * value.max(0.0) / noise.floor;
                sample.root_weight[c][lane] = 1.0 / growth.mul_add(growth, 1.0).sqrt();
            }
        }
    }
    sample
}
