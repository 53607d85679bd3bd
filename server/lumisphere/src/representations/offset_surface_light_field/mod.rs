//! Offset surface light field (OSLF): incident radiance in cube maps at *sample points*, surface points offset by ε·n.
//!
//! Because the sample points lie just above the surface, both the surface's own appearance and what it would reflect can be
//! read from them. With x on the surface, n its normal, v the unit vector to the viewer, p a sample point, Lᵢ(p; d) its cube map:
//! - reconstruction: `L(x) = Lᵢ(p; normalize(x − p))`, p the nearest of the texel's four with `n · normalize(p − x) > cos 65°`;
//! - reconstruction of an object that was captured as authored, which does not look alike from everywhere:
//!   `L(x, v) = Σⱼ βⱼ Lᵢ(pⱼ; normalize(x − pⱼ))`, βⱼ by [`Blend`] with v in place of r, so that it can favour the view direction;
//! - mirror: `r = 2 n (n·v) − v`, `ŝⱼ = normalize(pⱼ − x)`, `L(x, v) = Σⱼ βⱼ Lᵢ(pⱼ; r)`, `Σⱼ βⱼ = 1`, βⱼ by [`Blend`];
//! - mirror, depth-corrected: `Σⱼ βⱼ Lᵢ(pⱼ; x + t·r − pⱼ)`, t where the ray meets a surface by the stored distances (`corrected.rs`);
//! - full: `reconstruction + C_s · mirror`;
//! - mirror and full with several reflections: the object as it sees itself (`reflections.rs`);
//! - glossy: `∫ f_r(v, l) Σⱼ βⱼ Lᵢ(pⱼ; l) (n·l) dl` by Monte Carlo, for any BRDF, in either order (`gloss.rs`);
//! - as a clear body: the mirror's radiance and that toward which a ray leaves the body, weighted by Fresnel's equations (`refraction.rs`);
//! - with a normal map: mirrored and glossy by turned normals (`bumps.rs`);
//! - in other light: the environment turned, point lights added (`relight.rs`);
//! - baseline: one environment map at the object's centre, taken without the object, read with r.
//!
//! Where it fails: near the horizon (85° when built, 65° when read), at high curvature, where something stands between p and x
//! (free-space violation, shrinks with ε), along sample-map texels, by the cube maps' resolution.
//!
//! Source: the methods page "Offset surface light field" and the paper behind it.

mod bumps;
#[cfg(feature = "gpu")]
mod coarse;
mod construct;
mod corrected;
mod density;
mod gloss;
#[cfg(feature = "gpu")]
mod kernel;
mod object_tree;
mod pilot;
mod prefiltered;
mod reference;
mod reflections;
mod refraction;
mod relight;
mod replacing;
mod requests;
mod sample_points;
mod shade;
mod storage;
#[cfg(test)]
pub(crate) mod tests;
mod thinning;

use std::any::Any;
use std::sync::Arc;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::capture::{Background, SurfaceMesh};
use crate::directions::{DirectionDifferential, FACES, PyramidLevel, Taps, Texel};
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuError};
use crate::radiometry::brdf::{AnalyticBrdf, BrdfModel, Measured};
use crate::radiometry::dielectric::Dielectric;
#[cfg(feature = "gpu")]
use crate::representations::GpuKernel;
use crate::representations::{Captured, CpuKernel, Kind, Original, RenderError, Representation};
use crate::scenes::Relighting;
use crate::textures::{ContentHash, PageId, PageShape};

pub use bumps::{Bumps, BumpsError, MOST_REPEATS, MOST_STRENGTH};
pub use construct::{ConstructError, ConstructSettings, construct};
pub use density::Placing;
#[cfg(all(test, feature = "gpu"))]
pub(crate) use kernel::SOURCE as KERNEL_SOURCE;
pub use replacing::{BAKED_FIRST, Placement, ReplaceError, ReplaceSettings, Shares, Surrounding, replace};
pub use sample_points::{PlacementError, Spacing, build_sample_maps, place_sample_points};
pub use storage::{from_parts, to_parts};
pub use thinning::{Kept, PixelError, Thinning, ThinningError, ValidationPixel, ValidationView, copy_pages};

/// Largest angle between a texel's normal and the direction to a sample point when sample maps are built.
pub const CONSTRUCTION_HORIZON_DEG: f32 = 85.0;
/// The same when a frame is rendered; smaller, because grazing reads bleed.
pub const RUNTIME_HORIZON_DEG: f32 = 65.0;
/// Texels of a level are so many pixels wide where it is read alone: a bilinear read already takes the mean over a texel's width and more.
const FOOTPRINT_WIDTH: f32 = 0.75;
/// Most directions of [`Gloss`].
pub const MOST_DIRECTIONS: u32 = 4096;
/// Most of a mirror that sees itself: of more the last is seldom more than a few pixels.
pub const MOST_REFLECTIONS: u32 = 4;
/// Most passes of a still: of most directions, a million a pixel.
pub const MOST_PASSES: u32 = 256;
/// Most of a frame, over all its pixels: 1920 × 1080 of 64 each; on a rasteriser in software that is a minute.
pub const MOST_DIRECTIONS_PER_FRAME: u64 = 1 << 27;
/// Sides ([`AnalyticBrdf::highlight`]) up to which one look shows a highlight nearly as well as drawn directions: Ashikhmin–Shirley's n of 3000, Phong's
/// of 750, Ward's α of .025 (docs/measurements.md, "How a highlight is best gathered"; the same of what follows).
const NARROW: f32 = 0.092;
/// The same of GGX, whose tails are not in the look: α of .01.
const NARROW_WITH_TAILS: f32 = 0.036;
/// Up to which half the directions show it as well: n of 30, Phong's of 7, α of .25.
const WIDE: f32 = 0.91;
/// Directions of what is wider, or not one highlight alone; twice as many show little more.
const DIRECTIONS_OF_WIDE: u32 = 64;
/// N by which depth-corrected frames favour sample points toward the viewer, of an object that was captured as authored: best or next to it for
/// lobes of every width (docs/measurements.md, "Specular originals").
const OWN_EXPONENT: f32 = 1.0;
/// Marks "no such sample point" in a sample map.
pub const NO_SAMPLE: u16 = u16::MAX;

/// One dataset version of this kind, without its pages.
///
/// Pages: face f of cube map k, n in all, is page `6·k + f`: `face_size_texels`² texels of R, G, B, distance. Its level l, from 1 to
/// `coarser_levels`, is page `6·n + (l − 1)·n + k`: its faces below each other, `face_size_texels / 2ˡ` texels an edge, R, G, B and the share
/// of the texel through which light comes from infinity, every texel the mean of four of the level before. (Datasets of earlier versions
/// have no shares; they cannot be shown in other light.) Cube map `sample_points.len()` is the baseline environment map at `parameters.object_center`,
/// taken without the object.
#[derive(Debug, Clone)]
pub struct OffsetSurfaceLightField {
    /// What it was built with.
    pub parameters: Parameters,
    /// The object.
    pub surface: SurfaceMesh,
    /// At most 65 535.
    pub sample_points: Vec<SamplePoint>,
    /// Per part, which sample points serve which texel.
    pub sample_maps: SampleMaps,
    /// Everything else in the scene, for the pixels around the object.
    pub background: Background,
}

/// Stored in the manifest. Lengths are in the scene's unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameters {
    /// Name of the object whose light field this is.
    pub object: String,
    /// Distance of the sample points from the surface; where it was not given and they lie denser in places, of those with the mean density.
    pub epsilon: f32,
    /// Texels along a cube-map face.
    pub face_size_texels: u32,
    /// How many coarser levels the cube maps have, each with faces of half the size.
    pub coarser_levels: u32,
    /// Texels along a sample map.
    pub sample_map_size_texels: u32,
    /// How far apart the sample points were placed.
    pub spacing: Spacing,
    /// Where denser.
    #[serde(default, skip_serializing_if = "Placing::is_uniform")]
    pub placing: Placing,
    /// Centre of the object's bounds, where the baseline environment map was taken.
    pub object_center: [f32; 3],
    /// Paths per texel of the capture.
    pub samples_per_texel: u32,
    /// 1 = direct light only.
    pub max_bounces: u32,
    /// Of the capture.
    pub seed: u64,
    /// What the object looked like to the cube maps.
    #[serde(default, skip_serializing_if = "Original::is_diffuse")]
    pub original: Original,
    /// What it had before it was thinned; None for what was captured so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub thinned_from: Option<ThinnedFrom>,
    /// Out of which light field this was made, where its object never stood in the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaced: Option<Replaced>,
}

/// Where an object stands in light that was captured around another.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Replaced {
    /// The object that was captured; what it reflected onto its surroundings is still there.
    pub object: String,
    /// The light field that it was captured in, as whoever made this names it.
    pub light: String,
}

/// What a light field was thinned from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ThinnedFrom {
    /// Sample points that it had.
    pub sample_points: u32,
    /// Texels along a cube-map face.
    pub face_size_texels: u32,
}

/// Where a cube map was taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SamplePoint {
    /// Surface point + ε·normal, world space.
    pub position: Vec3,
    /// The surface's unit normal there.
    pub normal: Vec3,
}

/// Per part a square texture of the four best sample points' indices, nearest first, [`NO_SAMPLE`] where fewer qualify.
///
/// `indices[(part · size + row) · size + column]`; column = ⌊u·size⌋, row = ⌊v·size⌋. Read at the nearest texel, never interpolated.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SampleMaps {
    /// Texels along an edge.
    pub size: usize,
    /// Four indices a texel.
    pub indices: Vec<[u16; 4]>,
}

/// What of the object to show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Component {
    /// Its own diffuse appearance.
    Reconstruction,
    /// C_s · mirror: what it would reflect as a mirror of reflectance C_s.
    Mirror,
    /// Reconstruction + C_s · mirror.
    Full,
    /// What it would look like with another BRDF, in the light that is stored.
    Glossy(Gloss),
    /// What it would look like as a clear body, in what is stored.
    Refraction(Dielectric),
}

/// How a surface reflects, and how precisely that is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gloss {
    /// Its diffuse part included.
    pub brdf: GlossBrdf,
    /// By how many looks. What follows is of [`Integration::MonteCarlo`] only.
    pub integration: Integration,
    /// In which order sample points are blended and directions summed.
    pub order: Order,
    /// Directions drawn from it, 1 to [`MOST_DIRECTIONS`], and at most [`MOST_DIRECTIONS_PER_FRAME`] for all pixels.
    pub directions: u32,
    /// Which pass of a still, 0 to [`MOST_PASSES`] − 1; 0 for a frame that is shown alone. The mean of passes 0 … P − 1
    /// ([`Accumulator`](crate::render::Accumulator)) goes to the integral as P grows (`gloss.rs` says how fast).
    pub pass: u32,
}

/// By which BRDF a glossy frame is lit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GlossBrdf {
    /// By a few numbers.
    Analytic(AnalyticBrdf),
    /// By MERL's table with this hash, which comes with the request ([`FrameRequest::table`](crate::representations::FrameRequest::table)).
    Measured(ContentHash),
}

/// How the light that a lobe reflects is gathered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Integration {
    /// From directions drawn from the BRDF.
    MonteCarlo,
    /// By one look at each sample point, over the whole highlight, of a BRDF that has one and nothing else
    /// ([`AnalyticBrdf::highlight`]); of others as [`Self::MonteCarlo`].
    Prefiltered,
}

impl Integration {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::MonteCarlo => "monte-carlo",
            Self::Prefiltered => "prefiltered",
        }
    }
}

/// The two orders of the double sum over sample points and directions. They have one limit where the weights βⱼ do not depend on the direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// For each direction the sample points' light is blended, by weights for that direction (the thesis' method 2): M directions, each read at every
    /// sample point that weighs anything.
    BlendFirst,
    /// At each sample point that weighs anything M directions of its own are summed, then the sums blended, by weights for the mirror direction (method
    /// 1): up to four times as many directions with as many reads. Of `Corrected`, whose weights are a direction's own, and of the one environment map
    /// as [`Self::BlendFirst`].
    IntegrateFirst,
}

impl Order {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::BlendFirst => "blend-first",
            Self::IntegrateFirst => "integrate-first",
        }
    }
}

impl Gloss {
    /// The first pass, sample points blended direction by direction.
    pub fn of(brdf: impl Into<GlossBrdf>, directions: u32) -> Self {
        Self { brdf: brdf.into(), integration: Integration::MonteCarlo, order: Order::BlendFirst, directions, pass: 0 }
    }

    /// The highlight that is read as a whole, in tangent space; None where directions are drawn.
    fn highlight_about(&self, wo: Vec3) -> Option<(Vec3, [Vec3; 2])> {
        match (self.integration, &self.brdf) {
            (Integration::Prefiltered, GlossBrdf::Analytic(brdf)) => brdf.highlight_about(wo),
            (Integration::Prefiltered, GlossBrdf::Measured(_)) | (Integration::MonteCarlo, _) => None,
        }
    }

    /// Whether that is so for every direction.
    pub fn is_prefiltered(&self) -> bool {
        self.highlight_about(Vec3::Z).is_some()
    }

    /// As measurements say: with as little work as shows it nearly as well as more would (docs/measurements.md, "How a highlight is best gathered").
    pub fn suited(brdf: GlossBrdf, filter: Filter) -> Self {
        let drawn = Self::of(brdf, Self::enough_directions(&brdf));
        // Single directions know no means.
        let suits = filter == Filter::Footprint && brdf.is_narrow();
        if suits { Self { integration: Integration::Prefiltered, ..drawn } } else { drawn }
    }

    /// Looks that a pixel takes: what work is measured in.
    pub fn looks(&self) -> u32 {
        if self.is_prefiltered() { 1 } else { self.directions }
    }

    /// Of Monte Carlo.
    fn enough_directions(brdf: &GlossBrdf) -> u32 {
        if brdf.is_at_most(WIDE) { DIRECTIONS_OF_WIDE / 2 } else { DIRECTIONS_OF_WIDE }
    }

    /// Number of its first direction in the sequence that all passes share.
    fn first_direction(&self) -> u32 {
        self.pass * self.directions
    }

    /// Whether with this blend sample points are integrated one by one.
    fn integrates_first(&self, blend: Blend) -> bool {
        match blend {
            Blend::Corrected | Blend::EnvironmentMap => false,
            Blend::Distance | Blend::Angle | Blend::Average | Blend::Reflection { .. } | Blend::Normal { .. } => {
                self.order == Order::IntegrateFirst
            }
        }
    }
}

impl From<AnalyticBrdf> for GlossBrdf {
    fn from(brdf: AnalyticBrdf) -> Self {
        Self::Analytic(brdf)
    }
}

impl GlossBrdf {
    /// Itself, for which `table` was given if it is measured; None if none was.
    pub fn model(self, table: Option<&Arc<Measured>>) -> Option<BrdfModel> {
        match self {
            Self::Analytic(brdf) => Some(brdf.into()),
            Self::Measured(_) => table.cloned().map(BrdfModel::Measured),
        }
    }

    /// Whether it has one highlight and nothing else.
    pub fn is_one_highlight(&self) -> bool {
        matches!(self, Self::Analytic(brdf) if brdf.highlight().is_some())
    }

    /// Whether one look shows its only highlight nearly as well as directions drawn from it.
    fn is_narrow(&self) -> bool {
        let has_tails = matches!(self, Self::Analytic(AnalyticBrdf::CookTorrance(_)));
        self.is_at_most(if has_tails { NARROW_WITH_TAILS } else { NARROW })
    }

    /// Whether it is one highlight with no longer sides.
    fn is_at_most(&self, side: f32) -> bool {
        matches!(self, Self::Analytic(brdf) if brdf.highlight().is_some_and(|sides| sides.max_element() <= side))
    }

    /// Of the table that it needs.
    pub fn table(self) -> Option<ContentHash> {
        match self {
            Self::Analytic(_) => None,
            Self::Measured(hash) => Some(hash),
        }
    }
}

/// Weights βⱼ of the texel's sample points in a mirror read; each set is normalised to sum 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Blend {
    /// Nearest only.
    Distance,
    /// Only the one that maximises ŝ·r.
    Angle,
    /// All the same.
    Average,
    /// `max(r·ŝ, 0)ᴺ`.
    Reflection {
        /// N ≥ 0.
        exponent: f32,
    },
    /// `max(n·ŝ, 0)ᴺ`.
    Normal {
        /// N ≥ 0.
        exponent: f32,
    },
    /// The baseline: the one environment map at the object's centre.
    EnvironmentMap,
    /// Read toward the point that is reflected, by the stored distances; sample points that see something else there are left out. The
    /// reconstruction, too, passes over sample points that do not see the surface's point.
    Corrected,
}

/// How to render this kind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// What to show.
    pub component: Component,
    /// How mirror reads are blended.
    pub blend: Blend,
    /// C_s in `Mirror` and `Full`, per channel in [0, 1].
    pub specular_reflectance: Vec3,
    /// How cube maps are read.
    pub filter: Filter,
    /// In which light.
    pub light: Relighting,
    /// Mirror reflections one after the other in `Mirror` and `Full`, 1 to [`MOST_REFLECTIONS`]: where the ray meets the object again, that is
    /// a mirror, too, but for the last. 1 is the paper's.
    pub reflections: u32,
    /// What turns the normals by which `Mirror`, `Full` and `Glossy` reflect.
    pub bumps: Option<Bumps>,
}

impl Settings {
    /// What was captured as authored has its light and its reflections in it: neither can be added or exchanged.
    pub fn check_original(&self, original: Original) -> Result<(), RenderError> {
        let is_there_already = match self.component {
            Component::Full => true,
            Component::Reconstruction => self.light.changes_light(),
            Component::Mirror | Component::Glossy(_) | Component::Refraction(_) => false,
        };
        match original {
            Original::AsAuthored if is_there_already => Err(RenderError::AsAuthored),
            Original::AsAuthored | Original::Diffuse => Ok(()),
        }
    }

    /// Whether what is mirrored may be a mirror itself.
    pub fn sees_itself(&self) -> bool {
        self.reflections > 1 && matches!(self.component, Component::Mirror | Component::Full)
    }

    /// Whether rays are followed through the object's triangles.
    fn needs_tree(&self) -> bool {
        self.sees_itself() || matches!(self.component, Component::Refraction(_))
    }

    /// Whether one look at each sample point takes in a highlight.
    pub fn is_prefiltered(&self) -> bool {
        matches!(self.component, Component::Glossy(gloss) if gloss.is_prefiltered())
    }

    /// In which order light is blended and summed, where it is summed over directions.
    pub fn order(&self) -> Option<Order> {
        match self.component {
            Component::Glossy(gloss) if gloss.is_prefiltered() => None,
            Component::Glossy(gloss) if gloss.integrates_first(self.blend) => Some(Order::IntegrateFirst),
            Component::Glossy(_) => Some(Order::BlendFirst),
            Component::Reconstruction | Component::Mirror | Component::Full | Component::Refraction(_) => None,
        }
    }
}

/// What of a cube map a pixel reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Filter {
    /// The four texels around the direction through the pixel's centre, as the paper does: where a pixel covers many texels it shows their
    /// noise.
    Bilinear,
    /// The mean over what the pixel covers: up to four reads side by side, each of eight texels of the two levels whose texels are about as
    /// large as its part of the pixel.
    #[default]
    Footprint,
}

impl Component {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reconstruction => "reconstruction",
            Self::Mirror => "mirror",
            Self::Full => "full",
            Self::Glossy(_) => "glossy",
            Self::Refraction(_) => "refraction",
        }
    }
}

impl Filter {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bilinear => "bilinear",
            Self::Footprint => "footprint",
        }
    }
}

impl Blend {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Distance => "distance",
            Self::Angle => "angle",
            Self::Average => "average",
            Self::Reflection { .. } => "reflection",
            Self::Normal { .. } => "normal",
            Self::EnvironmentMap => "environment_map",
            Self::Corrected => "corrected",
        }
    }

    /// N, where there is one.
    pub fn exponent(self) -> Option<f32> {
        match self {
            Self::Reflection { exponent } | Self::Normal { exponent } => Some(exponent),
            Self::Distance | Self::Angle | Self::Average | Self::EnvironmentMap | Self::Corrected => None,
        }
    }
}

impl OffsetSurfaceLightField {
    /// Page of face `face` of cube map `cube`.
    pub fn page(cube: usize, face: usize) -> u32 {
        (FACES * cube + face) as u32
    }

    /// How many cube maps there are, the baseline's included.
    pub fn cube_count(&self) -> usize {
        self.sample_points.len() + 1
    }

    /// How many pages are faces of full size.
    pub fn face_count(&self) -> usize {
        FACES * self.cube_count()
    }

    /// How many pages its dataset has.
    pub fn page_count(&self) -> usize {
        self.face_count() + self.parameters.coarser_levels as usize * self.cube_count()
    }

    /// Texels along a face of a level.
    pub fn level_size(&self, level: u32) -> u32 {
        self.parameters.face_size_texels >> level
    }

    /// Page of level `level` ≥ 1 of cube map `cube`.
    pub fn level_page(&self, cube: usize, level: u32) -> u32 {
        (self.face_count() + (level as usize - 1) * self.cube_count() + cube) as u32
    }

    /// Page and row in it of a texel of a level of cube map `cube`.
    fn texel_place(&self, cube: u32, level: u32, texel: Texel) -> (u32, u32) {
        match level {
            0 => (Self::page(cube as usize, texel.face), texel.row as u32),
            _ => (self.level_page(cube as usize, level), texel.face as u32 * self.level_size(level) + texel.row as u32),
        }
    }

    /// How a pixel reads that sees a cube map so: where, and between which levels.
    fn reads_over(&self, toward: &DirectionDifferential) -> (Taps, PyramidLevel) {
        let taps = toward.taps(self.parameters.face_size_texels);
        (taps, PyramidLevel::for_texels(FOOTPRINT_WIDTH * taps.texels, self.parameters.coarser_levels))
    }

    // A page must have its level's shape before anything indexes into it.
    fn check_page(&self, page: u32, shape: PageShape) -> Result<(), RenderError> {
        let level = (page as usize).checked_sub(self.face_count()).map_or(0, |at| 1 + at / self.cube_count()) as u32;
        let width = self.level_size(level);
        let height = if level == 0 { width } else { FACES as u32 * width };
        if (shape.width, shape.height) == (width, height) && shape.channels >= 3 {
            return Ok(());
        }
        Err(RenderError::PageShape { page, width: shape.width, height: shape.height, channels: shape.channels, expected: [width, height] })
    }
}

impl Representation for OffsetSurfaceLightField {
    fn kind(&self) -> Kind {
        Kind::OffsetSurfaceLightField
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn captured(&self) -> Captured<'_> {
        let Parameters { object, max_bounces, original, .. } = &self.parameters;
        Captured { object, max_bounces: *max_bounces, original: *original }
    }

    fn page_count(&self) -> usize {
        self.page_count()
    }

    fn page_groups(&self) -> Vec<PageId> {
        let levels = (1..=self.parameters.coarser_levels).map(|level| self.level_page(0, level));
        std::iter::once(0).chain(levels).map(PageId).collect()
    }

    fn sample_map_rows(&self) -> (u32, u32) {
        (self.surface.parts, self.sample_maps.size as u32)
    }

    fn cpu_kernel(self: Arc<Self>) -> Box<dyn CpuKernel> {
        Box::new(reference::Reference::new(self))
    }

    #[cfg(feature = "gpu")]
    fn gpu_kernel(self: Arc<Self>, gpu: &Arc<Gpu>, budget_bytes: u64) -> Result<Box<dyn GpuKernel>, GpuError> {
        Ok(Box::new(kernel::Kernel::new(gpu.clone(), self, budget_bytes)?))
    }
}

impl SampleMaps {
    /// The four candidates at (u, v) in [0, 1]² of `part`, nearest first.
    pub fn at(&self, part: u32, u: f32, v: f32) -> [u16; 4] {
        self.indices[(part as usize * self.size + self.texel(v)) * self.size + self.texel(u)]
    }

    /// The row that is read at v.
    pub fn row(&self, v: f32) -> u32 {
        self.texel(v) as u32
    }

    fn texel(&self, c: f32) -> usize {
        ((c * self.size as f32) as usize).min(self.size - 1)
    }
}
