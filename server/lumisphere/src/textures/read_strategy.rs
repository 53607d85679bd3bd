//! How much of a page a miss decodes: the three strategies of the paper (offset surface light fields: pages are stored compressed and
//! can be decoded from the start only) and one for codecs that can do better.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use super::codec::{BLOCK_ROWS, Codec};
use super::page::PageShape;

/// What a request for one row of a page that lacks it brings in. Requests for whole pages are the same under every strategy.
///
/// Under the first four a page takes the whole page's bytes of the budget however much of it is decoded, as a cache of equal slots
/// does; so which pages are resident does not depend on the strategy, and misses on demand ≥ half threshold ≥ full image, always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ReadStrategy {
    /// From where decoding stopped to the requested row. A sequential codec needs its decoder for that, which is kept while it takes no more memory
    /// than the rows that are still missing will; else it begins again, and decodes rows it has.
    OnDemand,
    /// From the page's start to the requested row, every time: as in the paper.
    OnDemandRestart,
    /// On demand while requests stay in the upper half of the page; everything once one lies in the lower half.
    HalfThreshold,
    /// Everything.
    FullImage,
    /// The 16 rows that the requested one lies in, cached on their own and taking only their own bytes.
    Block,
}

impl ReadStrategy {
    /// Every one.
    pub const ALL: [Self; 5] = [Self::OnDemand, Self::OnDemandRestart, Self::HalfThreshold, Self::FullImage, Self::Block];

    /// As written in configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::OnDemand => "on_demand",
            Self::OnDemandRestart => "on_demand_restart",
            Self::HalfThreshold => "half_threshold",
            Self::FullImage => "full_image",
            Self::Block => "block",
        }
    }

    /// Rows that are present after a miss on `row`.
    pub fn rows_wanted(self, codec: Codec, shape: &PageShape, row: u32) -> Range<u32> {
        let up_to_row = 0..(row / codec.step_rows() + 1).saturating_mul(codec.step_rows()).min(shape.height);
        match self {
            Self::OnDemand | Self::OnDemandRestart => up_to_row,
            Self::HalfThreshold if row < shape.height / 2 => up_to_row,
            Self::HalfThreshold | Self::FullImage => 0..shape.height,
            Self::Block => {
                let start = row / BLOCK_ROWS * BLOCK_ROWS;
                start..(start + BLOCK_ROWS).min(shape.height)
            }
        }
    }

    /// Whether decoding may go on behind the `resident` first rows instead of beginning again. With a sequential codec, if its decoder was kept.
    pub(super) fn resumes(self, codec: Codec, shape: &PageShape, resident: u32) -> bool {
        let can = if codec.is_sequential() { codec.decoder_fits(shape, resident) } else { resident.is_multiple_of(BLOCK_ROWS) };
        self != Self::OnDemandRestart && can
    }
}

impl fmt::Display for ReadStrategy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// No strategy has this name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no read strategy {0:?}: expected on_demand, on_demand_restart, half_threshold, full_image or block")]
pub struct UnknownStrategy(pub String);

impl FromStr for ReadStrategy {
    type Err = UnknownStrategy;

    fn from_str(name: &str) -> Result<Self, UnknownStrategy> {
        Self::ALL.into_iter().find(|strategy| strategy.name() == name).ok_or_else(|| UnknownStrategy(name.into()))
    }
}
