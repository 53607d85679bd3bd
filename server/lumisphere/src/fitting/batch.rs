//! What the fits read: many texels' samples, 16 texels to a group, one lane each. The caller streams batches, so memory is bounded by one.
//!
//! Radiance as seen, so any finite number of any size; a sample that is not finite, has no unit direction or lies below the horizon is
//! held as missing, never as an error: photographs are full of them.

use thiserror::Error;

use super::lanes::{GROUP, Row};

/// What is known of one sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct State(u8);

impl State {
    /// All three values hold.
    pub const VALID: Self = Self(0);
    /// No value: hidden, outside of the photograph, masked.
    pub const MISSING: Self = Self(8);

    /// In the channels named, the value is only a lower bound: the sensor was full.
    pub fn clipped(channels: [bool; 3]) -> Self {
        Self(channels.iter().enumerate().map(|(c, &clipped)| u8::from(clipped) << c).sum())
    }

    /// Whether there is no value.
    pub fn is_missing(self) -> bool {
        self.0 & Self::MISSING.0 != 0
    }

    /// Whether the value of this channel (0 to 2) is a lower bound.
    pub fn is_clipped(self, channel: usize) -> bool {
        self.0 >> channel & 1 != 0
    }
}

/// A texel does not fit its batch.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum BatchError {
    /// The three slices of a texel differ in length.
    #[error("texel {texel}: {directions} directions, {values} values and {states} states, expected as many of each")]
    Lengths {
        /// Its index in the batch.
        texel: usize,
        /// How many directions.
        directions: usize,
        /// How many values.
        values: usize,
        /// How many states.
        states: usize,
    },
}

/// One observation of 16 texels.
#[derive(Clone, Copy)]
pub(super) struct Observation {
    pub direction: [Row; 3],
    pub value: [Row; 3],
    pub state: [State; GROUP],
}

impl Observation {
    const MISSING: Self =
        Self { direction: [[0.0; GROUP], [0.0; GROUP], [1.0; GROUP]], value: [[0.0; GROUP]; 3], state: [State::MISSING; GROUP] };
}

/// Samples of many texels.
#[derive(Clone, Default)]
pub struct Batch {
    shared: Vec<[f32; 3]>,
    texels: usize,
    groups: Vec<Vec<Observation>>,
}

impl Batch {
    /// An empty batch whose texels bring their own directions.
    pub fn new() -> Self {
        Self::default()
    }

    /// An empty batch whose texels all see along the same unit directions (a distant camera; a fixed camera under moving light).
    pub fn with_shared_directions(directions: &[[f32; 3]]) -> Self {
        Self { shared: directions.to_vec(), ..Self::default() }
    }

    /// How many texels there are.
    pub fn texels(&self) -> usize {
        self.texels
    }

    /// Adds a texel: unit directions of the hemisphere z ≥ 0, values and states, one of each per sample.
    pub fn push(&mut self, directions: &[[f32; 3]], values: &[[f32; 3]], states: &[State]) -> Result<(), BatchError> {
        if directions.len() != values.len() || states.len() != values.len() {
            let (texel, directions) = (self.texels, directions.len());
            return Err(BatchError::Lengths { texel, directions, values: values.len(), states: states.len() });
        }
        let lane = self.texels % GROUP;
        if lane == 0 {
            self.groups.push(Vec::with_capacity(values.len()));
        }
        let Some(group) = self.groups.last_mut() else { return Ok(()) };
        if group.len() < values.len() {
            group.resize(values.len(), Observation::MISSING);
        }
        for (observation, ((d, v), &state)) in group.iter_mut().zip(directions.iter().zip(values).zip(states)) {
            if state.is_missing() || !is_usable(*d, *v) {
                continue;
            }
            for c in 0..3 {
                observation.direction[c][lane] = d[c];
                observation.value[c][lane] = v[c];
            }
            observation.state[lane] = state;
        }
        self.texels += 1;
        Ok(())
    }

    /// Adds a texel that sees along the shared directions.
    pub fn push_shared(&mut self, values: &[[f32; 3]], states: &[State]) -> Result<(), BatchError> {
        let shared = std::mem::take(&mut self.shared);
        let pushed = self.push(&shared, values, states);
        self.shared = shared;
        pushed
    }

    pub(super) fn groups(&self) -> &[Vec<Observation>] {
        &self.groups
    }
}

/// How far from 1 the squared length of a unit direction may lie, and how far below the horizon it may point: rounding, no more.
const UNIT_TOLERANCE: f32 = 1e-3;

fn is_usable(d: [f32; 3], value: [f32; 3]) -> bool {
    let length = d.iter().map(|x| x * x).sum::<f32>();
    (length - 1.0).abs() < UNIT_TOLERANCE && d[2] > -UNIT_TOLERANCE && value.iter().all(|v| v.is_finite())
}
