//! Observation map: what a surface was seen to look like, texels × observations, before any model is fitted to it.
//!
//! A texel has a place and a frame (normal, tangent along u); an observation is a photograph's place, or a direction where all texels share it
//! (a far camera; by reciprocity, the light of a photograph under a moving light: `I(wo, wi) = I(wi, wo)`). An entry is radiance, which of
//! its channels are clipped (the sensor was saturated: at least so much), or nothing (hidden, turned away, outside the picture, dark).
//!
//! Pages: page k holds texels 64·k … 64·k + 63 of `texels` in its columns and the observations in its rows; four channels: R, G, B, and a
//! [`State`]'s number. Columns beyond the last texel are missing.
//!
//! Source: the methods page "Parameter maps" ("Observation map") and the thesis behind it, part II.

mod photographs;
mod storage;
#[cfg(test)]
mod tests;
mod virtual_photographs;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::{Background, SurfaceMesh};
use crate::geometry::TangentFrame;
use crate::textures::{Page, PageShape, PixelFormat};

pub use photographs::{ImportError, ImportSettings, Photographed, RadiancePhotograph, Response, import};
pub use storage::{from_parts, to_parts};
pub use virtual_photographs::{Coverage, Entries, ObserveError, ObserveSettings, directions_about, mean_normal, observe, observed};

/// The kind of such a dataset in its manifest. It is not rendered; models are fitted to it.
pub const OBSERVATION_MAP: &str = "observation_map";
/// Columns of a page.
pub const TEXELS_PER_PAGE: usize = 64;
/// Most observations of a texel.
pub const MOST_OBSERVATIONS: u32 = 4096;
/// Most texels along the edge of a part.
pub const MOST_TEXELS_PER_EDGE: u32 = 4096;
/// Most texels of all parts together: what is held of each in memory is some forty bytes.
pub const MOST_TEXELS: u64 = 1 << 24;

/// A dataset version of this kind, without its pages.
#[derive(Debug, Clone)]
pub struct ObservationMap {
    /// What it was made with.
    pub parameters: ObservationParameters,
    /// What was observed.
    pub surface: SurfaceMesh,
    /// Everything else in the scene, for the pixels around the object.
    pub background: Background,
    /// In the order of the pages' rows.
    pub observers: Vec<Observer>,
    /// In the order of the pages' columns: part by part, in tiles of 8 × 8.
    pub texels: Vec<ObservedTexel>,
}

/// Stored in the manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationParameters {
    /// Name of the object.
    pub object: String,
    /// Texels along the edge of a part.
    pub size_texels: u32,
    /// Where from, for people: a sampling scheme, or files.
    pub directions: String,
    /// Paths per observation; 0 for photographs.
    pub samples_per_observation: u32,
    /// Of the paths; 0 for photographs.
    pub max_bounces: u32,
    /// Of the random numbers.
    pub seed: u64,
}

/// From where texels were seen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Observer {
    /// A camera's centre, world space.
    At(Vec3),
    /// So far away that all texels see it in this direction (unit, world space).
    Toward(Vec3),
}

/// A texel that can be seen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ObservedTexel {
    /// `part · size² + row · size + column`.
    pub index: u32,
    /// Its centre, world space.
    pub position: Vec3,
    /// Unit.
    pub normal: Vec3,
    /// Along u, of any length.
    pub tangent: Vec3,
}

/// What an entry of the map is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not seen; its numbers mean nothing.
    Missing,
    /// Seen; bit c: channel c is clipped, its number a lower bound.
    Seen {
        /// R = 1, G = 2, B = 4.
        clipped: u8,
    },
}

/// One texel in one observation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Linear, per channel.
    pub radiance: [f32; 3],
    /// How far it counts.
    pub state: State,
}

impl Observation {
    /// Nothing was seen.
    pub const MISSING: Self = Self { radiance: [0.0; 3], state: State::Missing };

    /// As in a page. Radiance that is not finite is missing.
    pub fn to_texel(self) -> [f32; 4] {
        let [r, g, b] = self.radiance;
        match self.state {
            State::Seen { clipped } if self.radiance.iter().all(|c| c.is_finite()) => [r, g, b, 1.0 + f32::from(clipped & 7)],
            State::Seen { .. } | State::Missing => [0.0; 4],
        }
    }

    /// From a page; what no `to_texel` writes is missing.
    pub fn from_texel([r, g, b, state]: [f32; 4]) -> Self {
        let is_sound = (1.0..=8.0).contains(&state) && [r, g, b].iter().all(|c| c.is_finite());
        match is_sound {
            true => Self { radiance: [r, g, b], state: State::Seen { clipped: (state - 1.0) as u8 } },
            false => Self::MISSING,
        }
    }
}

impl ObservedTexel {
    /// Tangent along u, normal.
    pub fn frame(&self) -> TangentFrame {
        TangentFrame::along(self.normal, self.tangent)
    }

    /// Unit direction to an observer in this texel's frame; z below 0 is behind the surface.
    pub fn direction_to(&self, observer: &Observer) -> Vec3 {
        let toward = match observer {
            Observer::At(place) => (*place - self.position).normalize_or_zero(),
            Observer::Toward(direction) => *direction,
        };
        self.frame().local_from_world(toward)
    }
}

impl ObservationMap {
    /// How many pages its dataset has.
    pub fn page_count(&self) -> usize {
        self.texels.len().div_ceil(TEXELS_PER_PAGE)
    }

    /// The texels in the columns of a page.
    pub fn texels_of_page(&self, page: usize) -> &[ObservedTexel] {
        let first = (page * TEXELS_PER_PAGE).min(self.texels.len());
        &self.texels[first..self.texels.len().min(first + TEXELS_PER_PAGE)]
    }

    /// What its pages look like.
    pub fn page_shape(&self, pixel: PixelFormat) -> PageShape {
        PageShape { width: TEXELS_PER_PAGE as u32, height: self.observers.len() as u32, channels: 4, pixel }
    }

    /// Whether a page is as `page_shape` says.
    pub fn is_shaped(&self, page: &Page) -> bool {
        let shape = page.shape();
        shape == self.page_shape(shape.pixel)
    }
}

/// Texels of a part of `size`² in tiles of 8 × 8: neighbours share pages. `row · size + column`.
pub fn tiled_order(size: usize) -> impl Iterator<Item = usize> {
    let tiles = size.div_ceil(TILE);
    (0..tiles * tiles).flat_map(move |tile| {
        let (top, left) = (tile / tiles * TILE, tile % tiles * TILE);
        (top..size.min(top + TILE)).flat_map(move |row| (left..size.min(left + TILE)).map(move |column| row * size + column))
    })
}

const TILE: usize = 8;
