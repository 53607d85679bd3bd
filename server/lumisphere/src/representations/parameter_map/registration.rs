//! Whether photographs lie on each other: those that show the surface beside where the others show it.
//!
//! A texel's model is what all photographs say of it together. If photograph k is shifted by δ texels, what it shows at x is what the model of the
//! texel at x + δ says, all over the surface: tile by tile, `O(x, k)` follows `M(x+δ, d)` better than `M(x, d)`, up to a factor ≥ 0 and an offset of
//! the tile's own, since highlights that no model holds are smooth. Both models are read in the *same* direction d, so that a highlight's place and
//! shape play no part: where nothing but the highlight varies, both say the same. Noise and too small a model speak for δ = 0, since M(x) has seen
//! `O(x, k)`. Tiles weigh by their deviation, not its square, so that few of them do not outweigh the others.
//!
//! Where it fails: on a surface without texture nothing shows a shift; one that all photographs share is none; where all are shifted by more than a
//! quarter of the texture's waves the models are blurred; shifts beyond √10 texels; fewer than nine tiles.

use rayon::prelude::*;
use serde::Serialize;

use super::models::is_whole;
use crate::capture::observation_map::{Observation, ObservedTexel};
use crate::fitting::{Model, Noise};

/// Photographs that lie beside the others. Written as `compared`, how many are `shifted`, and the four of them that are `worst`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(into = "Report")]
pub struct Registration {
    /// Photographs that were compared: those that show enough of the surface.
    pub compared: u64,
    /// Those that lie beside the others, first those whose shift explains most.
    pub shifted: Vec<Shifted>,
}

#[derive(Serialize)]
struct Report {
    compared: u64,
    shifted: u64,
    worst: Vec<Shifted>,
}

impl From<Registration> for Report {
    fn from(Registration { compared, shifted: mut worst }: Registration) -> Self {
        let shifted = worst.len() as u64;
        worst.truncate(MOST_NAMED);
        Self { compared, shifted, worst }
    }
}

/// A photograph that lies beside the others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Shifted {
    /// Which observation, from 0.
    pub observation: u32,
    /// What it shows at a texel is that much along columns and rows from there.
    pub texels: [i32; 2],
    /// The part of its deviation from the models that the shift takes away.
    pub explained: f64,
}

/// Longest shift that is looked for, texels along a row or column.
const FARTHEST: i32 = 3;
/// Shifts that are looked for: all of at most √10 texels.
const SHIFTS: usize = 36;
const SHIFT: [[i32; 2]; SHIFTS] = shifts();
/// A shift must take away that part of a photograph's deviation.
const LEAST_EXPLAINED: f64 = 0.06;
/// And be so many standard deviations of its sum over the tiles.
const LEAST_DEVIATIONS: f64 = 2.5;
/// Fewer tiles say nothing.
const LEAST_TILES: u64 = 9;
/// Fewer pairs of texels of a tile are left out.
const LEAST_PAIRS: f64 = 12.0;
const MOST_NAMED: usize = 4;

/// Sums over the texels that have been looked at.
pub(super) struct Comparison {
    noise: Noise,
    /// By observation, then by shift.
    sums: Vec<[Sums; SHIFTS]>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    tiles: u64,
    /// Deviations from the models there are, and those from the shifted ones subtracted.
    here: f64,
    gained: f64,
    squares: f64,
}

/// Sums of a tile's channel over pairs of what is seen and what a model says.
#[derive(Debug, Clone, Copy, Default)]
struct Line {
    said: f64,
    said_squared: f64,
    product: f64,
}

impl Line {
    fn add(&mut self, said: f64, seen: f64) {
        (self.said, self.said_squared, self.product) = (self.said + said, self.said_squared + said * said, self.product + said * seen);
    }

    /// Squares that the best line through them leaves, rising or flat; `seen`: the sums of what is seen and of its squares.
    fn left(&self, pairs: f64, (seen, seen_squared): (f64, f64)) -> f64 {
        let spread = (self.said_squared - self.said * self.said / pairs).max(0.0);
        let along = (self.product - self.said * seen / pairs).max(0.0);
        let all = (seen_squared - seen * seen / pairs).max(0.0);
        if spread > 0.0 { (all - along * along / spread).max(0.0) } else { all }
    }
}

/// A tile in a photograph, for one shift.
#[derive(Debug, Clone, Copy, Default)]
struct Pairs {
    count: f64,
    seen: [(f64, f64); 3],
    here: [Line; 3],
    there: [Line; 3],
}

impl Pairs {
    fn add(&mut self, seen: [f32; 3], here: [f32; 3], there: [f32; 3]) {
        self.count += 1.0;
        for c in 0..3 {
            let (seen, here, there) = (f64::from(seen[c]), f64::from(here[c]), f64::from(there[c]));
            self.seen[c] = (self.seen[c].0 + seen, self.seen[c].1 + seen * seen);
            self.here[c].add(here, seen);
            self.there[c].add(there, seen);
        }
    }

    /// Root mean squares that the model there is and the shifted one leave, in standard deviations of noise.
    fn deviations(&self, noise: Noise) -> (f64, f64) {
        let mean = self.seen.iter().map(|(sum, _)| sum.abs()).sum::<f64>() / (3.0 * self.count);
        let scale = f64::from(noise.floor) + f64::from(noise.relative) * mean;
        let left = |lines: &[Line; 3]| (0..3).map(|c| lines[c].left(self.count, self.seen[c])).sum::<f64>();
        let deviation = |lines| (left(lines) / (3.0 * self.count)).sqrt() / scale;
        (deviation(&self.here), deviation(&self.there))
    }
}

/// A page's texels with their models, in order, and what was seen of them.
pub(super) struct Tile<'a> {
    pub texels: &'a [ObservedTexel],
    pub models: &'a [Option<Model>],
    /// Texels along the edge of a part.
    pub size: u32,
    /// By column and observation: the direction in the texel's frame, and the entry.
    pub seen: &'a (dyn Fn(usize, usize) -> ([f32; 3], Observation) + Sync),
}

impl Comparison {
    pub fn new(observations: usize, noise: Noise) -> Self {
        Self { noise, sums: vec![[Sums::default(); SHIFTS]; observations] }
    }

    /// Compares what a tile's texels show with the models of their neighbours in it.
    pub fn add(&mut self, tile: &Tile<'_>) {
        let neighbours: Vec<[Option<&Model>; SHIFTS]> = tile.texels.iter().map(|texel| neighbours(tile, texel)).collect();
        let noise = self.noise;
        self.sums.par_iter_mut().enumerate().for_each(|(row, sums)| {
            let mut pairs = [Pairs::default(); SHIFTS];
            for (column, (model, around)) in tile.models.iter().zip(&neighbours).enumerate() {
                let (Some(model), entry) = (model, (tile.seen)(column, row)) else { continue };
                if !is_whole(&entry) {
                    continue;
                }
                let (direction, Observation { radiance: seen, .. }) = entry;
                let here = model.eval(direction);
                for (pairs, other) in pairs.iter_mut().zip(around) {
                    if let Some(other) = other {
                        pairs.add(seen, here, other.eval(direction));
                    }
                }
            }
            for (sums, pairs) in sums.iter_mut().zip(&pairs).filter(|(_, pairs)| pairs.count >= LEAST_PAIRS) {
                let (here, there) = pairs.deviations(noise);
                sums.tiles += 1;
                (sums.here, sums.gained) = (sums.here + here, sums.gained + here - there);
                sums.squares += (here - there).powi(2);
            }
        });
    }

    pub fn report(&self) -> Registration {
        let compared = self.sums.iter().filter(|sums| sums.iter().any(|s| s.tiles >= LEAST_TILES)).count() as u64;
        let mut shifted: Vec<Shifted> = self.sums.iter().enumerate().filter_map(|(row, sums)| shift_of(row, sums)).collect();
        shifted.sort_by(|a, b| b.explained.total_cmp(&a.explained).then(a.observation.cmp(&b.observation)));
        Registration { compared, shifted }
    }
}

// The shift that explains most, where one explains enough.
fn shift_of(row: usize, sums: &[Sums; SHIFTS]) -> Option<Shifted> {
    let explained = |sums: &Sums| sums.gained / sums.here;
    let is_enough = |sums: &Sums| {
        sums.tiles >= LEAST_TILES && explained(sums) > LEAST_EXPLAINED && sums.gained > LEAST_DEVIATIONS * sums.squares.sqrt()
    };
    let enough = sums.iter().enumerate().filter(|(_, sums)| is_enough(sums));
    let (at, best) = enough.max_by(|a, b| explained(a.1).total_cmp(&explained(b.1)))?;
    Some(Shifted { observation: row as u32, texels: SHIFT[at], explained: explained(best) })
}

const fn shifts() -> [[i32; 2]; SHIFTS] {
    let (mut shifts, mut count, mut at) = ([[0; 2]; SHIFTS], 0, 0);
    let side = 2 * FARTHEST + 1;
    while at < side * side {
        let (right, up) = (at % side - FARTHEST, at / side - FARTHEST);
        let square = right * right + up * up;
        if square > 0 && square <= FARTHEST * FARTHEST + 1 {
            shifts[count] = [right, up];
            count += 1;
        }
        at += 1;
    }
    shifts
}

fn neighbours<'a>(tile: &Tile<'a>, texel: &ObservedTexel) -> [Option<&'a Model>; SHIFTS] {
    let (size, of_part) = (tile.size as i32, tile.size * tile.size);
    let (part, within) = (texel.index / of_part, (texel.index % of_part) as i32);
    std::array::from_fn(|at| {
        let [right, up] = SHIFT[at];
        let (column, row) = (within % size + right, within / size + up);
        let is_inside = (0..size).contains(&column) && (0..size).contains(&row);
        let index = is_inside.then(|| part * of_part + (row * size + column) as u32)?;
        let place = tile.texels.iter().position(|other| other.index == index)?;
        tile.models[place].as_ref()
    })
}
