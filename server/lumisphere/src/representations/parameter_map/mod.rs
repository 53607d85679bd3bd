//! Parameter map: a small function of the view direction at every texel of a surface, fitted to what was seen there.
//!
//! With x on the surface, `d` the unit vector to the viewer in the frame of normal and u-tangent at x, and `Mₛₜ` the model of texel (s, t)
//! (`fitting::Model`: a constant, `K (n·d)ᵃ`, `K_d + Σ K_s (r·d)ᵐ`, or harmonics): `L(x, d) = Σ wₛₜ Mₛₜ(d)` over the four texels around x.
//! Radiance is blended, never parameters: halfway between two lobes is no lobe in between. Texels without a model are left out.
//!
//! Each texel has the smallest model that explains it. Models are packed one behind the other: bytes follow need.
//!
//! Where it fails: light that moves (it is baked in); lobes narrower than the observations' spacing (flagged `unresolved`); views far from any
//! that was observed; many texels under one pixel (they are not averaged); anything behind the horizon of the shading normal.
//!
//! Source: the methods page "Parameter maps" and the thesis behind it, parts II and III.

mod budget;
mod construct;
#[cfg(feature = "gpu")]
mod device_tables;
mod kept_models;
#[cfg(feature = "gpu")]
mod kernel;
mod models;
mod packed_pages;
mod packing;
mod reference;
mod registration;
mod shade;
mod storage;
mod suggest;
mod summary;
#[cfg(test)]
pub(crate) mod tests;

use std::any::Any;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::capture::observation_map::ObservationParameters;
use crate::capture::{Background, SurfaceMesh};
use crate::fitting::{Flags, Outliers, Precision};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError};
#[cfg(feature = "gpu")]
use crate::representations::GpuKernel;
use crate::representations::{Captured, CpuKernel, Kind, Original, RenderError, Representation};
use crate::textures::{PageId, PageShape, PixelFormat};

pub use construct::{ConstructSettings, FitError, FitSource, FollowFit, PartialMap, ReadObservations, construct};
#[cfg(all(test, feature = "gpu"))]
pub(crate) use kernel::source as kernel_source;
pub use models::{AllowedModels, Observed, Solver, UnknownModels, fitted_models};
pub use packing::{ModelCode, Quads};
pub use registration::{Registration, Shifted};
pub use storage::{from_parts, to_parts};
pub use suggest::{
    MOST_CANDIDATES, MOST_SUGGESTIONS, Paged, SuggestError, SuggestSettings, SuggestedDirection, Suggestions, suggest_directions,
};
pub use summary::{BudgetReport, FitSummary};

/// Quads along a page's row.
const PAGE_QUADS: u32 = 128;
/// Rows of a page.
const PAGE_ROWS: u32 = 128;
const QUADS_PER_PAGE: u32 = PAGE_QUADS * PAGE_ROWS;

/// One dataset version of this kind, without its pages.
///
/// Pages hold *quads*, four numbers each, 128 × 128 a page: first those of the first texel in the map's order (part by part, in tiles of 8 × 8), as
/// many as its model needs (`packing.rs`), and so on.
#[derive(Debug, Clone)]
pub struct ParameterMap {
    /// What it was made with.
    pub parameters: Parameters,
    /// What carries it.
    pub surface: SurfaceMesh,
    /// Everything else in the scene, for the pixels around the object.
    pub background: Background,
    /// Which model every texel has.
    pub texels: TexelTable,
}

/// Stored in the manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// What was observed.
    pub observed: ObservationParameters,
    /// Dataset and version of the observations, for people.
    pub observations: String,
    /// What models were allowed ("auto", "lobes:1", …).
    pub models: String,
    /// What became of observations that stand alone.
    #[serde(default = "kept")]
    pub outliers: Outliers,
    /// Of lobes' last digits.
    #[serde(default = "single")]
    pub precision: Precision,
    /// What the version was to take at most.
    #[serde(default)]
    pub max_bytes: Option<u64>,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How many texels have which model, by name.
    pub histogram: std::collections::BTreeMap<String, u64>,
    /// What there was of it, where the fit was still under way.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub partial: Option<PartialFit>,
}

// What versions were made with that do not say it.
fn kept() -> Outliers {
    Outliers::Keep
}

fn single() -> Precision {
    Precision::Single
}

/// How far the fit was that a version shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartialFit {
    /// Texels that had been fitted, and have a model if they were seen.
    pub texels_fitted: u64,
    /// All that can be seen.
    pub texels: u64,
}

/// Which model every texel has, where its numbers begin, and what the fit says of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TexelTable {
    /// Texels along the edge of a part.
    pub size: usize,
    /// `[part · size² + row · size + column]`, row = ⌊v · size⌋.
    pub texels: Vec<Texel>,
}

/// A texel's entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Texel {
    /// Of its numbers, in quads from the first page's first.
    pub first_quad: u32,
    /// Which model.
    pub code: ModelCode,
    /// Doubts about it.
    pub flags: Flags,
}

/// What to show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Show {
    /// What the models say.
    #[default]
    Radiance,
    /// Which model the nearest texel has, as a colour.
    Models,
    /// What the fit says of it, as a colour.
    Flags,
}

impl Show {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Radiance => "radiance",
            Self::Models => "models",
            Self::Flags => "flags",
        }
    }
}

/// How to render this kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Settings {
    /// What to show.
    pub show: Show,
}

impl TexelTable {
    /// From codes and flags in the order of `texels`; None where they would need more quads than can be counted.
    pub fn new(size: usize, codes: &[(ModelCode, Flags)]) -> Option<Self> {
        let mut texels: Vec<Texel> = codes.iter().map(|(code, flags)| Texel { first_quad: 0, code: *code, flags: *flags }).collect();
        let mut next = 0u32;
        for at in texel_order(size, texels.len()) {
            texels[at].first_quad = next;
            next = next.checked_add(texels[at].code.quads())?;
        }
        Some(Self { size, texels })
    }

    /// How many quads all models need.
    pub fn quads(&self) -> u64 {
        self.texels.iter().map(|t| u64::from(t.code.quads())).sum()
    }
}

/// The map's order of the texels of parts of `size`²: part by part, in tiles.
pub(crate) fn texel_order(size: usize, texels: usize) -> impl Iterator<Item = usize> {
    let of_part = size * size;
    (0..texels / of_part.max(1)).flat_map(move |part| crate::capture::observation_map::tiled_order(size).map(move |at| part * of_part + at))
}

impl ParameterMap {
    /// How many pages its dataset has.
    pub fn page_count(&self) -> usize {
        self.texels.quads().div_ceil(u64::from(QUADS_PER_PAGE)).max(1) as usize
    }

    /// What its pages look like.
    pub fn page_shape(pixel: PixelFormat) -> PageShape {
        PageShape { width: PAGE_QUADS, height: PAGE_ROWS, channels: 4, pixel }
    }

    /// Page, column and row of a quad.
    fn place(quad: u32) -> (PageId, u32, u32) {
        let within = quad % QUADS_PER_PAGE;
        (PageId(quad / QUADS_PER_PAGE), within % PAGE_QUADS, within / PAGE_QUADS)
    }

    // A page must have its shape before anything indexes into it.
    fn check_page(&self, page: u32, shape: PageShape) -> Result<(), RenderError> {
        let expected = Self::page_shape(self.parameters.pixel_format);
        if shape == expected {
            return Ok(());
        }
        let expected = [expected.width, expected.height];
        Err(RenderError::PageShape { page, width: shape.width, height: shape.height, channels: shape.channels, expected })
    }
}

impl Representation for ParameterMap {
    fn kind(&self) -> Kind {
        Kind::ParameterMap
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn captured(&self) -> Captured<'_> {
        let observed = &self.parameters.observed;
        Captured { object: &observed.object, max_bounces: observed.max_bounces, original: Original::AsAuthored }
    }

    fn page_count(&self) -> usize {
        self.page_count()
    }

    fn page_groups(&self) -> Vec<PageId> {
        vec![PageId(0)]
    }

    fn sample_map_rows(&self) -> (u32, u32) {
        (0, 0)
    }

    fn cpu_kernel(self: Arc<Self>) -> Box<dyn CpuKernel> {
        Box::new(reference::Reference::new(self))
    }

    #[cfg(feature = "gpu")]
    fn gpu_kernel(self: Arc<Self>, gpu: &Arc<Gpu>, budget_bytes: u64) -> Result<Box<dyn GpuKernel>, GpuError> {
        Ok(Box::new(kernel::Kernel::new(gpu.clone(), self, budget_bytes)?))
    }
}
