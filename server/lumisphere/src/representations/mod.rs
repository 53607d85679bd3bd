//! Ways of holding a light field, side by side: one folder each, none imports another.
//!
//! Adding one: a value in `Kind` and in the proto, a folder, an arm in `open` and in the service's `wire.rs`.

mod buckets;
#[cfg(feature = "gpu")]
mod frame_output;
mod g_buffer;
pub mod offset_surface_light_field;
mod page_source;
pub mod parameter_map;
mod pending_pixels;
mod provenance;
mod requests;
mod uploads;

use std::any::Any;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::geometry::Camera;
#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuCacheStats, GpuError};
use crate::radiometry::dielectric::Dielectric;
use crate::raytrace::{Mirrors, Under};
use crate::scenes::Relighting;
use crate::textures::{ContentHash, PageId, StoreError};
#[cfg(feature = "gpu")]
use crate::textures::{Page, PolicyKind};
use offset_surface_light_field as oslf;

#[cfg(test)]
pub(crate) use page_source::MemoryPages;
pub use page_source::{CachedPages, CountingReader, CountingSource, Fetched, PageSource, PageUse, TexelReader, WholePages};
pub use pending_pixels::PendingPixels;
pub use provenance::{Answer, Provenance};
pub use requests::{Lobe, PixelOrder, Recording, RequestTrace, TexelRequest};
pub use uploads::Uploads;

/// Which representation a dataset holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Cube maps at sample points just above a surface.
    OffsetSurfaceLightField,
    /// A small function of the view direction at every texel of a surface.
    ParameterMap,
}

impl Kind {
    /// The name in manifests and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::OffsetSurfaceLightField => "offset_surface_light_field",
            Self::ParameterMap => "parameter_map",
        }
    }

    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::OffsetSurfaceLightField, Self::ParameterMap].into_iter().find(|k| k.name() == name)
    }
}

/// How to render, by kind.
#[expect(clippy::large_enum_variant, reason = "250 bytes, copied a few times a frame")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Settings {
    /// Component, blend and specular reflectance.
    OffsetSurfaceLightField(oslf::Settings),
    /// What to show.
    ParameterMap(parameter_map::Settings),
}

/// A setting in reports.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SettingName {
    /// `reconstruction`, `mirror`, `full`, `glossy`, `refraction`; of a parameter map `radiance`, `models`, `flags`.
    pub component: &'static str,
    /// `distance`, `angle`, `average`, `reflection`, `normal`, `environment_map`, `corrected`; of a reconstruction only the last.
    pub blend: Option<&'static str>,
    /// N of `reflection` and `normal`.
    pub exponent: Option<f32>,
    /// `footprint` or `bilinear`.
    pub filter: &'static str,
    /// `turned-90-1-lights`; None in the light that was captured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub light: Option<String>,
    /// `prefiltered`, where one look takes in the whole highlight.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub integration: Option<&'static str>,
    /// Directions of each pixel, where it is the mean over some.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub directions: Option<u32>,
    /// `solid-1.5`, where a clear body is shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub body: Option<String>,
    /// Mirror reflections one after the other; None for one, or without a mirror.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reflections: Option<u32>,
    /// `integrate-first`; None where it is the default or there are no directions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub order: Option<&'static str>,
    /// `9f86d081-strength-1-repeat-3`, where a map turns the normals.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normal_map: Option<String>,
}

impl SettingName {
    /// Joined by hyphens, for file names; filter, reflections, light, order and normal map only where they are not the default ones.
    pub fn slug(&self) -> String {
        let exponent = self.exponent.map(|n| n.to_string());
        let filter = (self.filter != oslf::Filter::default().name()).then_some(self.filter);
        let reflections = self.reflections.map(|n| format!("reflections-{n}"));
        let map = self.normal_map.as_ref().map(|name| format!("bumps-{name}"));
        let names = [Some(self.component), self.blend, exponent.as_deref(), filter, reflections.as_deref(), self.light.as_deref()];
        names.into_iter().chain([self.order, map.as_deref()]).flatten().collect::<Vec<_>>().join("-")
    }
}

impl Settings {
    /// Whose settings they are.
    pub fn kind(&self) -> Kind {
        match self {
            Self::OffsetSurfaceLightField(_) => Kind::OffsetSurfaceLightField,
            Self::ParameterMap(_) => Kind::ParameterMap,
        }
    }

    /// By the names that the command line uses.
    pub fn name(&self) -> SettingName {
        match self {
            Self::OffsetSurfaceLightField(s) => {
                let has_blend = s.component != oslf::Component::Reconstruction || s.blend == oslf::Blend::Corrected;
                let blend = has_blend.then_some(s.blend);
                let exponent = blend.and_then(oslf::Blend::exponent);
                SettingName {
                    component: s.component.name(),
                    blend: blend.map(oslf::Blend::name),
                    exponent,
                    filter: s.filter.name(),
                    light: s.light.name(),
                    integration: s.is_prefiltered().then_some(oslf::Integration::Prefiltered.name()),
                    directions: match s.component {
                        oslf::Component::Glossy(gloss) if !gloss.is_prefiltered() => Some(gloss.directions),
                        _ => None,
                    },
                    body: self.dielectric().map(|dielectric| dielectric.name()),
                    reflections: s.sees_itself().then_some(s.reflections),
                    order: s.order().filter(|order| *order != oslf::Order::BlendFirst).map(oslf::Order::name),
                    normal_map: s.bumps.map(|bumps| bumps.name()),
                }
            }
            Self::ParameterMap(s) => SettingName {
                component: s.show.name(),
                blend: None,
                exponent: None,
                filter: "bilinear",
                light: None,
                integration: None,
                directions: None,
                body: None,
                reflections: None,
                order: None,
                normal_map: None,
            },
        }
    }

    /// The BRDF that the object is shown with, where it is another than its own or a mirror's.
    pub fn brdf(&self) -> Option<oslf::GlossBrdf> {
        self.gloss().map(|gloss| gloss.brdf)
    }

    /// The same, and how what it reflects is gathered.
    pub fn gloss(&self) -> Option<oslf::Gloss> {
        match self {
            Self::OffsetSurfaceLightField(s) => match s.component {
                oslf::Component::Glossy(gloss) => Some(gloss),
                oslf::Component::Reconstruction | oslf::Component::Mirror | oslf::Component::Full | oslf::Component::Refraction(_) => None,
            },
            Self::ParameterMap(_) => None,
        }
    }

    /// The clear body that the object is shown as.
    pub fn dielectric(&self) -> Option<Dielectric> {
        match self {
            Self::OffsetSurfaceLightField(oslf::Settings { component: oslf::Component::Refraction(dielectric), .. }) => Some(*dielectric),
            Self::OffsetSurfaceLightField(_) | Self::ParameterMap(_) => None,
        }
    }

    /// What turns the object's normals.
    pub fn bumps(&self) -> Option<oslf::Bumps> {
        match self {
            Self::OffsetSurfaceLightField(s) => s.bumps,
            Self::ParameterMap(_) => None,
        }
    }

    /// In which light it is shown.
    pub fn light(&self) -> Relighting {
        match self {
            Self::OffsetSurfaceLightField(s) => s.light,
            Self::ParameterMap(_) => Relighting::NONE,
        }
    }

    /// How pass `pass` of a still is rendered; None where a second frame would be no other than the first.
    pub fn of_pass(self, pass: u32) -> Option<Self> {
        match self {
            Self::OffsetSurfaceLightField(s) => match s.component {
                oslf::Component::Glossy(gloss) if !gloss.is_prefiltered() => {
                    let component = oslf::Component::Glossy(oslf::Gloss { pass, ..gloss });
                    Some(Self::OffsetSurfaceLightField(oslf::Settings { component, ..s }))
                }
                _ => None,
            },
            Self::ParameterMap(_) => None,
        }
    }

    /// Whether such a frame of `camera` is little enough work to be started.
    pub fn check_frame(&self, camera: &Camera) -> Result<(), RenderError> {
        let pixels = u64::from(camera.intrinsics().width_px) * u64::from(camera.intrinsics().height_px);
        let most = oslf::MOST_DIRECTIONS_PER_FRAME;
        match self {
            Self::OffsetSurfaceLightField(oslf::Settings { component: oslf::Component::Glossy(gloss), .. })
                if !gloss.is_prefiltered() && pixels.saturating_mul(gloss.directions.into()) > most =>
            {
                Err(RenderError::TooManyDirections { pixels, directions: gloss.directions, most })
            }
            Self::OffsetSurfaceLightField(_) | Self::ParameterMap(_) => Ok(()),
        }
    }

    /// How the object mirrors; None where it does not.
    pub fn mirrors(&self) -> Option<Mirrors> {
        match self {
            Self::OffsetSurfaceLightField(s) => {
                let under = match s.component {
                    oslf::Component::Mirror => Under::Nothing,
                    oslf::Component::Full => Under::Diffuse,
                    oslf::Component::Reconstruction | oslf::Component::Glossy(_) | oslf::Component::Refraction(_) => return None,
                };
                Some(Mirrors { reflectance: s.specular_reflectance, reflections: s.reflections, under })
            }
            Self::ParameterMap(_) => None,
        }
    }
}

/// A dataset version without its pages, ready to make kernels.
pub trait Representation: std::fmt::Debug + Send + Sync {
    /// Which it is.
    fn kind(&self) -> Kind;

    /// Itself, for work that only one kind knows.
    fn as_any(&self) -> &dyn Any;

    /// What of which scene it shows.
    fn captured(&self) -> Captured<'_>;

    /// How many pages its dataset has.
    fn page_count(&self) -> usize;

    /// The first page of each run of pages of one shape, in order; the first is page 0.
    fn page_groups(&self) -> Vec<PageId>;

    /// Parts with a table of sample points, and the rows of each.
    fn sample_map_rows(&self) -> (u32, u32);

    /// The readable reference.
    fn cpu_kernel(self: Arc<Self>) -> Box<dyn CpuKernel>;

    /// Its twin, with everything but the pages uploaded, taking at most `budget_bytes` of the device's memory at any time.
    #[cfg(feature = "gpu")]
    fn gpu_kernel(self: Arc<Self>, gpu: &Arc<Gpu>, budget_bytes: u64) -> Result<Box<dyn GpuKernel>, GpuError>;
}

/// What of a scene was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Captured<'a> {
    /// The object's name.
    pub object: &'a str,
    /// Of the capture's paths; 0 for photographs.
    pub max_bounces: u32,
    /// What the object looked like.
    pub original: Original,
}

/// What an object looked like while it was captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Original {
    /// Its diffuse part alone, which looks alike from everywhere.
    #[default]
    Diffuse,
    /// As its materials say: highlights and what it reflects, as they were seen from each place.
    AsAuthored,
}

impl Original {
    fn is_diffuse(&self) -> bool {
        *self == Self::Diffuse
    }
}

/// Renders frames of one dataset on the CPU.
pub trait CpuKernel: Send + Sync {
    /// One frame; blocks.
    fn render(&self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<Pixels, RenderError>;

    /// Every request for stored texels that such a frame makes, pixel by pixel, by one thread; reads no page.
    fn record(&self, recording: &Recording<'_>, sink: &mut dyn FnMut(TexelRequest)) -> Result<(), RenderError>;
}

/// Renders frames of one dataset on the GPU.
#[cfg(feature = "gpu")]
pub trait GpuKernel: Send {
    /// One frame, of which the last pixels may come later; blocks. `RenderError::Gpu` means that the CPU might still do it.
    fn draw(&mut self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<(PendingPixels, GpuFrameStats), RenderError>;

    /// What it draws on.
    fn gpu(&self) -> &Gpu;

    /// The same with its pixels; blocks until they are here.
    fn render(&mut self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<(Pixels, GpuFrameStats), RenderError> {
        let (pending, stats) = self.draw(request, pages)?;
        self.gpu().settle();
        let (pixels, copying_millis) = pending.finish()?;
        Ok((pixels, GpuFrameStats { read_back_millis: stats.read_back_millis + copying_millis, ..stats }))
    }

    /// Pages that such a frame would miss, at most `upload_bytes` of texels: a guess that reads nothing. None before the first frame.
    fn look_ahead(&mut self, request: &FrameRequest<'_>, upload_bytes: u64) -> Result<Vec<PageId>, RenderError>;

    /// Takes pages onto the device before a frame wants them; how many found room without another's leaving that the last frame showed or
    /// the last look ahead saw.
    fn bring_ahead(&mut self, pages: &[(PageId, Arc<Page>)]) -> Result<usize, RenderError>;

    /// Which pages leave when others need their place, from now on.
    fn set_policy(&mut self, kind: PolicyKind);

    /// How pages come from now on; forgets those that are there.
    fn set_upload_unit(&mut self, unit: UploadUnit);

    /// Takes at most `budget_bytes` from now on; forgets its pages where they have to be laid out anew. Where geometry alone takes more, the
    /// next frame fails.
    fn set_budget(&mut self, budget_bytes: u64);

    /// Held on the device.
    fn bytes(&self) -> u64;

    /// Since it was made; peak and budget are the caller's to know.
    fn stats(&self) -> GpuCacheStats;
}

/// What comes to the device together.
#[cfg(feature = "gpu")]
#[doc(hidden)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UploadUnit {
    /// Blocks of 16 rows, or of the next power of two that makes at most 32 of a page: those that a frame wants, or whole pages where few are missing.
    Rows,
    /// Pages, for the bench that measures what the other saves.
    Pages,
}

/// What the GPU did for a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct GpuFrameStats {
    /// Pages that were not on the device.
    pub pages_uploaded: usize,
    /// Shading passes: 1 when every page was there.
    pub passes: u32,
    /// Fetching and uploading pages.
    pub pages_millis: f64,
    /// From the first command to the last pixel in the device's memory.
    pub gpu_millis: f64,
    /// From there into ours.
    pub read_back_millis: f64,
}

/// What to show of a representation, seen from where.
#[derive(Debug, Clone, Copy)]
pub struct FrameRequest<'a> {
    /// Its size is the frame's; the caller limits it.
    pub camera: &'a Camera,
    /// Of the representation's own kind.
    pub settings: &'a Settings,
    /// What to return beside colour.
    pub outputs: Outputs,
    /// Whether the frame may be shown before all of its pages are on the device.
    pub refine: Refine,
    /// What the settings name.
    pub uploads: Uploads<'a>,
}

/// What to do about pages that a frame needs and that are not on the device. The CPU draws whole frames only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refine {
    /// Bring all of them: the frame is final.
    Whole,
    /// Bring at most so many bytes of texels (at least one page, unless 0), and let the coarse level stand in for the others: the frame
    /// is then not final, and asking again refines it. A frame whose pages cannot be on the device together, and a dataset
    /// without a coarse level, are drawn whole.
    UpTo {
        /// Of a frame.
        upload_bytes: u64,
    },
}

/// What a frame carries beside colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outputs {
    /// Distances along the rays.
    pub depth: bool,
    /// Which sample answered.
    pub provenance: bool,
}

/// A frame's pixels, rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Pixels {
    /// `[3 · (row · width + column) + channel]`: linear radiance, R G B, finite.
    pub color: Vec<f32>,
    /// Distance along the pixel's ray, scene units, +∞ where nothing is.
    pub depth: Option<Vec<f32>>,
    /// Where each colour comes from.
    pub provenance: Option<Vec<Provenance>>,
    /// Distinct pages that the frame read; on the GPU those of full size, since coarser levels come with them or are always there.
    pub pages_needed: usize,
    /// Whether every read was at full resolution; see [`Refine`].
    pub is_final: bool,
}

/// Why there is no frame.
#[derive(Debug, Clone, Error)]
pub enum RenderError {
    /// A page cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A page does not have the shape that the dataset's parameters announce.
    #[error("page {page} has {width}x{height} texels of {channels} channels, {}x{} of at least 3 expected", expected[0], expected[1])]
    PageShape {
        /// Which page.
        page: u32,
        /// As read.
        width: u32,
        /// As read.
        height: u32,
        /// As read.
        channels: u32,
        /// Columns and rows.
        expected: [u32; 2],
    },
    /// The GPU was asked for and cannot, or there is none.
    #[cfg(feature = "gpu")]
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// More work than a frame may be.
    #[error("{pixels} pixels of {directions} directions each, at most {most} directions a frame expected: fewer of either")]
    TooManyDirections {
        /// Of the frame.
        pixels: u64,
        /// Of each pixel.
        directions: u32,
        /// Their product's limit.
        most: u64,
    },
    /// Requests of such a frame cannot be recorded.
    #[error(
        "which texels depth-corrected reads ask for depends on what is stored; to record a frame another blend than corrected is expected"
    )]
    DependsOnPages,
    /// Requests of frames in other light, of clear bodies, with a normal map, or of mirrors that see themselves cannot be recorded.
    #[error(
        "frames in other light, of clear bodies, with a normal map and of mirrors that see themselves read more than cube maps; to record one no relighting, another component, no map or one reflection is expected"
    )]
    ReadsMore,
    /// A frame that would light, or coat, what has its own light and reflections in it.
    #[error(
        "the object was captured as authored, its light and reflections are in it: its reconstruction in the light of the capture, mirror, glossy or a clear body expected"
    )]
    AsAuthored,
    /// Cube maps that do not tell how much of a coarse texel's light comes from infinity.
    #[error("the dataset was captured by a version that did not store what frames in other light need: capture it anew")]
    NoSkyShares,
    /// Settings that name a measured BRDF, without it.
    #[error("the measured BRDF {table} did not come with the request")]
    NoTable {
        /// Hash of its file.
        table: ContentHash,
    },
    /// Settings that name a normal map, without it.
    #[error("the normal map {map} did not come with the request")]
    NoNormalMap {
        /// Hash of its file.
        map: ContentHash,
    },
    /// A normal map on what it cannot be on.
    #[error(transparent)]
    Bumps(#[from] oslf::BumpsError),
    /// Settings of another kind than the dataset's.
    #[error("settings are of a {}, the dataset is of another kind", settings.name())]
    OtherKind {
        /// Of the settings.
        settings: Kind,
    },
    /// The GPU was asked for where there is none.
    #[error("no GPU is in use")]
    NoGpu,
}

/// Every whole WGSL source of this room, for the test that validates them.
#[cfg(all(test, feature = "gpu"))]
pub(crate) fn wgsl_sources() -> Vec<String> {
    let fixed = [g_buffer::VISIBILITY_SOURCE, g_buffer::G_BUFFER_SOURCE, g_buffer::RESOLVE_SOURCE, oslf::KERNEL_SOURCE];
    fixed.map(String::from).into_iter().chain((0..=crate::directions::MOST_BANDS).map(parameter_map::kernel_source)).collect()
}
