//! Who looks for single lobes and polishes them: the kernels of `lobes`, or a graphics device (`device.rs`).

use std::convert::Infallible;

use super::candidate::Candidate;
use super::ladder::{Climb, Task, look, polish};
use super::lobes::Numbers;
use super::lobes::question::Stop;
use super::lobes::scan::{Look, Scratch};
use super::settings::Settings;
use super::tile::{self, Tile};

/// Fits single lobes.
pub trait OneLobe: Sync {
    /// Why it cannot.
    type Error: Send;

    /// Into tiles of how many groups so many are cut, whose texels have so many observations.
    fn groups_per_tile(&self, observations: usize, groups: usize) -> usize;

    /// What a lobe beside the constant would gain at `peaks` peaks, for each of `climbs` that climbs.
    fn look(
        &self,
        tile: &Tile,
        climbs: &[Climb],
        climbing: &[usize],
        peaks: usize,
        scratch: &mut Vec<Scratch>,
    ) -> Result<Vec<Look>, Self::Error>;

    /// Polishes every task in f32; in the order of the tasks.
    fn polish(&self, tile: &Tile, tasks: &[Task], settings: &Settings, stop: Stop) -> Result<Vec<Candidate>, Self::Error>;
}

/// The thread that asks.
pub struct Processor;

impl OneLobe for Processor {
    type Error = Infallible;

    fn groups_per_tile(&self, observations: usize, _groups: usize) -> usize {
        tile::groups_per_tile(observations)
    }

    fn look(
        &self,
        tile: &Tile,
        climbs: &[Climb],
        climbing: &[usize],
        peaks: usize,
        scratch: &mut Vec<Scratch>,
    ) -> Result<Vec<Look>, Infallible> {
        Ok(look(tile, climbs, climbing, 1, peaks, scratch))
    }

    fn polish(&self, tile: &Tile, tasks: &[Task], settings: &Settings, stop: Stop) -> Result<Vec<Candidate>, Infallible> {
        Ok(polish(tile, tasks, 1, settings, Numbers::Single, stop))
    }
}
