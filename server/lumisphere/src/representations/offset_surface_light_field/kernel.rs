//! Host side of `kernel.wgsl`: what one dataset has on the device. `frame.rs` draws with it.

mod ahead;
mod frame;
mod light;
mod normal_map;
mod table;
mod tree;

use std::collections::HashMap;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::coarse::{Coarse, with_levels};
use super::relight::LightTables;
use super::{Blend, Component, Filter, Gloss, GlossBrdf, OffsetSurfaceLightField, Settings};
use crate::directions::FACES;
use crate::gpu::{Atlas, AtlasShape, Gpu, GpuCacheStats, GpuError, ReadBack, Shader, binding, storage_buffer, value_buffer};
use crate::radiometry::brdf::{BrdfUniform, Measured};
use crate::radiometry::dielectric::Body;
use crate::representations::frame_output::{BAND_BYTES, BYTES_PER_PIXEL, BoundBand, MAX_BAND_PIXELS};
use crate::representations::g_buffer::{ProxyGeometry, Rasterizer, band_entries, object_entries};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, GpuFrameStats, GpuKernel, Original, PendingPixels, RenderError, UploadUnit};
use crate::scenes::MOST_POINT_LIGHTS;
use crate::textures::{Page, PageId, PixelFormat, PolicyKind};
use light::LightTextures;
use normal_map::NormalMapTexture;
use table::TableTexture;
use tree::TreeTexture;

/// All of `kernel.wgsl`'s source.
pub(crate) const SOURCE: &str = concat!(
    include_str!("../g_buffer/camera.wgsl"),
    include_str!("../../gpu/table.wgsl"),
    include_str!("../g_buffer/band.wgsl"),
    include_str!("../g_buffer/object.wgsl"),
    include_str!("../../directions/cube_map.wgsl"),
    include_str!("../../directions/differential.wgsl"),
    include_str!("../../gpu/atlas.wgsl"),
    include_str!("kernel.wgsl"),
    include_str!("corrected.wgsl"),
    include_str!("relight.wgsl"),
    include_str!("object_tree.wgsl"),
    include_str!("reflections.wgsl"),
    include_str!("refraction.wgsl"),
    include_str!("../../geometry/tangent_frame.wgsl"),
    include_str!("../../radiometry/brdf/brdf.wgsl"),
    include_str!("bumps.wgsl"),
    include_str!("prefiltered.wgsl"),
    include_str!("gloss.wgsl")
);

/// Layout as WGSL's `Shading`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ShadingUniform {
    pub specular_reflectance: [f32; 3],
    pub exponent: f32,
    pub face_size: u32,
    pub map_size: u32,
    pub baseline_cube: u32,
    pub stamp: u32,
    pub coarse_level: u32,
    pub coarsest_level: u32,
    pub face_count: u32,
    pub first_pixel: u32,
    pub end_pixel: u32,
    pub pixel_scale: f32,
    pub directions: u32,
    pub block_shift: u32,
    pub first_direction: u32,
    pub refraction_index: f32,
    pub first_packet: u32,
    pub reflections: u32,
    pub normal_map_size: [u32; 2],
    pub normal_strength: f32,
    pub normal_repeat: f32,
}

/// Layout as WGSL's `LightInfo`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct LightUniform {
    pub turn_cos: f32,
    pub turn_sin: f32,
    pub environment_size: u32,
    pub environment_base: u32,
    pub point_light_count: u32,
    pub padding: [u32; 3],
    pub point_lights: [PointLightUniform; MOST_POINT_LIGHTS],
}

/// Layout as WGSL's `PointLight`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct PointLightUniform {
    pub position: [f32; 3],
    pub before: f32,
    pub intensity: [f32; 3],
    pub after: f32,
}

// A page's rows come in blocks of so many, as they are stored, or in as many blocks as a word has bits.
const BLOCK_ROWS: u32 = 16;
const MOST_BLOCKS: u32 = 32;

// All faces of the cube maps of eight sample points: four where light enters a clear body, four where it leaves.
const PAGES_OF_A_PIXEL: usize = 8 * FACES;

/// One dataset on the device.
pub(crate) struct Kernel {
    gpu: Arc<Gpu>,
    field: Arc<OffsetSurfaceLightField>,
    budget_bytes: u64,
    policy: PolicyKind,
    upload_unit: UploadUnit,
    rasterizer: Rasterizer,
    shader: Shader,
    shading: wgpu::Buffer,
    gloss: wgpu::Buffer,
    light: wgpu::Buffer,
    light_tables: LightTables,
    light_textures: LightTextures,
    tree: TreeTexture,
    table: TableTexture,
    normal_map: NormalMapTexture,
    sample_points: wgpu::Buffer,
    sample_maps: wgpu::Buffer,
    touched: wgpu::Buffer,
    touched_read_back: ReadBack,
    pipelines: HashMap<PipelineKey, wgpu::ComputePipeline>,
    // Made with the first page, whose format it takes.
    atlas: Option<BoundAtlas>,
    // Of the last frame, or the last look ahead.
    band: Option<BoundBand>,
    stamp: u32,
    // Which pages the last frame wanted; they do not fit together where there are more than slots.
    last_wanted: Vec<bool>,
    // Which pages the last look ahead saw.
    expected: Vec<bool>,
    // Of atlases that are gone.
    earlier: GpuCacheStats,
}

// Component and whether it sees itself, blend, BRDF, order and whether prefiltered, textures of the atlas, whether reads are filtered, whether coarse levels stand
// in, how light is another, whether a map turns normals.
type PipelineKey = ((u32, bool), u32, (u32, bool, bool), usize, bool, bool, (bool, bool), bool);

struct BoundAtlas {
    atlas: Atlas,
    shape: AtlasShape,
    coarse: Coarse,
    views: wgpu::BindGroup,
    resources: wgpu::BindGroup,
}

impl BoundAtlas {
    // Of these blocks of a page, with the levels that it holds.
    fn bytes_of(&self, blocks: u32) -> u64 {
        self.shape.bytes_of_blocks(blocks, self.coarse.levels_before())
    }
}

impl Kernel {
    pub fn new(gpu: Arc<Gpu>, field: Arc<OffsetSurfaceLightField>, budget_bytes: u64) -> Result<Self, GpuError> {
        let geometry = ProxyGeometry::new(&field.surface.mesh, &field.surface.part_of_triangle, &field.background);
        gpu.check_binding("the sample maps", size_of_val(field.sample_maps.indices.as_slice()) as u64)?;
        let [triangles, vertices] = object_entries();
        let entries = [
            triangles,
            vertices,
            binding::read_buffer(2),
            binding::read_buffer(3),
            binding::read_buffer(4),
            binding::read_buffer(5),
            binding::write_buffer(6),
            binding::read_buffer(7),
            binding::read_buffer(8),
        ];
        let [a, b, c, d] = [0, 1, 2, 3].map(binding::texture_array);
        let [e, f, g, h, i] = [4, 5, 6, 7, 8].map(binding::texture);
        let atlas_entries = [a, b, c, d, e, f, g, h, i];
        let none = wgpu::BufferUsages::empty();
        let positions: Vec<[f32; 4]> = field.sample_points.iter().map(|p| p.position.extend(0.0).into()).collect();
        // On little-endian machines, the only ones there are graphics drivers for, four u16 are the two words that WGSL unpacks.
        let maps: Vec<[u32; 2]> = field.sample_maps.indices.iter().map(|i| [pair(i[0], i[1]), pair(i[2], i[3])]).collect();
        let touched_words =
            vec![0u32; field.face_count() * MOST_BLOCKS.min(field.parameters.face_size_texels.div_ceil(BLOCK_ROWS)) as usize];
        let kernel = Self {
            rasterizer: Rasterizer::new(&gpu, &geometry)?,
            shader: Shader::new(&gpu, "offset surface light field", SOURCE, &[&band_entries(), &entries, &atlas_entries]),
            shading: value_buffer::<ShadingUniform>(&gpu, "shading"),
            gloss: value_buffer::<BrdfUniform>(&gpu, "gloss"),
            light: value_buffer::<LightUniform>(&gpu, "light"),
            light_tables: LightTables::default(),
            light_textures: LightTextures::none(&gpu),
            tree: TreeTexture::none(&gpu),
            table: TableTexture::none(&gpu),
            normal_map: NormalMapTexture::none(&gpu),
            sample_points: storage_buffer(&gpu, "sample points", &positions, none),
            sample_maps: storage_buffer(&gpu, "sample maps", &maps, none),
            touched: storage_buffer(&gpu, "touched", &touched_words, wgpu::BufferUsages::COPY_SRC),
            touched_read_back: ReadBack::new(&gpu, "touched", 4 * touched_words.len() as u64),
            pipelines: HashMap::new(),
            atlas: None,
            band: None,
            stamp: 0,
            last_wanted: vec![false; field.face_count()],
            expected: vec![false; field.face_count()],
            earlier: GpuCacheStats::default(),
            policy: PolicyKind::Lru,
            upload_unit: UploadUnit::Rows,
            budget_bytes,
            field,
            gpu,
        };
        kernel.gpu.check()?;
        kernel.atlas_budget()?;
        Ok(kernel)
    }

    /// The last frame's last band's G-buffer.
    #[cfg(test)]
    pub fn read_g_buffer(&self) -> Vec<crate::representations::g_buffer::GBufferPixel> {
        self.rasterizer.read_g_buffer(&self.gpu, &self.band.as_ref().expect("a frame was rendered").band)
    }

    /// A budget that leaves room for this many pages in f16, coarse levels aside.
    #[cfg(test)]
    pub fn set_slots(&mut self, slots: u64) {
        let mut atlas_budget = 0;
        for _ in 0..4 {
            let (_, shape) = self.plan(PixelFormat::F16, atlas_budget);
            atlas_budget = shape.bytes_beside() + (shape.pinned_slots as u64 + slots) * shape.page_bytes();
        }
        self.set_budget(self.fixed_bytes() + atlas_budget);
    }

    #[cfg(test)]
    pub fn capacity(&self) -> usize {
        self.atlas.as_ref().map_or(0, |bound| bound.atlas.capacity())
    }

    #[cfg(test)]
    pub fn budget(&self) -> u64 {
        self.budget_bytes
    }

    // What some frames need and others do not.
    fn forget_tables(&mut self) {
        self.light_tables = LightTables::default();
        self.light_textures = LightTextures::none(&self.gpu);
        self.tree = TreeTexture::none(&self.gpu);
        self.table = TableTexture::none(&self.gpu);
        self.normal_map = NormalMapTexture::none(&self.gpu);
    }

    fn forget_pages(&mut self) {
        self.earlier = self.stats().after_all_left();
        self.atlas = None;
        self.band = None;
    }

    // Everything but the atlas and what a frame has not needed yet.
    fn fixed_bytes(&self) -> u64 {
        let buffers = [&self.sample_points, &self.sample_maps, &self.touched, self.touched_read_back.buffer()];
        // Tables of other light are kept in ordinary memory, too, and leave with the rest.
        let light = self.light_textures.bytes() + self.light_tables.bytes();
        self.rasterizer.bytes()
            + light
            + self.tree.bytes()
            + self.table.bytes()
            + self.normal_map.bytes()
            + buffers.iter().map(|b| b.size()).sum::<u64>()
            + BAND_BYTES
    }

    // Whether so much more can be held and leave room for the pages that any pixel may want: what stays is there in the way of every later
    // frame, those that have no use for it included.
    fn check_room(&self, what: &'static str, more_bytes: u64, pages: &CountingSource<'_>) -> Result<(), RenderError> {
        self.check_room_for(PAGES_OF_A_PIXEL, what, more_bytes, pages)
    }

    // The same of pixels that want so many pages.
    fn check_room_for(
        &self,
        pages_of_a_pixel: usize,
        what: &'static str,
        more_bytes: u64,
        pages: &CountingSource<'_>,
    ) -> Result<(), RenderError> {
        let pixel = match &self.atlas {
            Some(bound) => bound.shape.pixel,
            None => pages.page(PageId(0))?.shape().pixel,
        };
        let (beside, budget_bytes) = (self.fixed_bytes() + more_bytes, self.budget_bytes);
        let page_bytes = self.plan(pixel, 0).1.page_bytes();
        let is_room = |bytes| {
            let (_, shape) = self.plan(pixel, bytes);
            shape.capacity(&self.gpu, bytes) >= pages_of_a_pixel.min(shape.page_count)
        };
        let left = budget_bytes.saturating_sub(beside);
        if budget_bytes > beside && is_room(left) {
            return Ok(());
        }
        // Page by page: layers are filled by whole rows of them. Where pages are so large that no budget is enough there is no such number.
        let most = 4 * (pages_of_a_pixel + self.plan(pixel, left).1.pinned_slots) as u64;
        let with = |pages: u64| page_bytes.checked_mul(pages).and_then(|bytes| left.checked_add(bytes));
        let needed = (1..=most).map_while(with).find(|bytes| is_room(*bytes)).unwrap_or(u64::MAX);
        Err(GpuError::OverBudget { what, needed_bytes: beside.saturating_add(needed), budget_bytes }.into())
    }

    fn atlas_budget(&self) -> Result<u64, GpuError> {
        let (needed_bytes, budget_bytes) = (self.fixed_bytes(), self.budget_bytes);
        let too_much = GpuError::OverBudget { what: "the dataset's geometry", needed_bytes, budget_bytes };
        budget_bytes.checked_sub(needed_bytes).filter(|left| *left > 0).ok_or(too_much)
    }

    // What is always resident, and the slots.
    fn plan(&self, pixel: PixelFormat, atlas_budget: u64) -> (Coarse, AtlasShape) {
        let (page_size, page_count) = (self.field.parameters.face_size_texels, self.field.face_count());
        let coarse = Coarse::planned(&self.field, pixel, atlas_budget);
        let coarse_levels = self.field.parameters.coarser_levels + 1 - coarse.level;
        let levels = coarse.levels_before().max(coarse_levels);
        let block_rows = match self.upload_unit {
            UploadUnit::Pages => page_size.next_power_of_two(),
            // A row of the coarsest level that a page holds lies within a block.
            UploadUnit::Rows => BLOCK_ROWS.max(page_size.div_ceil(MOST_BLOCKS).next_power_of_two()).max(1 << (coarse.levels_before() - 1)),
        };
        (coarse, AtlasShape { page_count, page_size, pixel, levels, pinned_slots: coarse.slots, block_rows })
    }

    // The first page tells what all of them look like.
    fn ensure_atlas(&mut self, pages: &CountingSource<'_>) -> Result<(), RenderError> {
        if self.atlas.is_some() {
            return Ok(());
        }
        // The frame before shall not wait for what only this one needs; so wherever something is made.
        self.gpu.settle();
        let first = pages.page(PageId(0))?.shape();
        self.field.check_page(0, first)?;
        let (coarse, shape) = self.plan(first.pixel, self.atlas_budget()?);
        let mut atlas = Atlas::new(&self.gpu, shape, self.atlas_budget()?, self.policy)?;
        if coarse.exists() {
            let levels = self.field.parameters.coarser_levels + 1 - coarse.level;
            let images = coarse.read(&self.field, shape.pixel, pages)?;
            let images = images.into_par_iter().map(|image| with_levels(Arc::new(image), levels)).collect::<Result<Vec<_>, _>>()?;
            atlas.upload_pinned(&self.gpu, &images)?;
        }
        let views = self.bind_views(&atlas);
        let resources = self.bind_resources(&atlas);
        self.atlas = Some(BoundAtlas { atlas, shape, coarse, views, resources });
        Ok(())
    }

    fn bind_views(&self, atlas: &Atlas) -> wgpu::BindGroup {
        let views: Vec<_> = atlas
            .views()
            .iter()
            .chain(self.light_textures.views())
            .chain([self.tree.view(), self.table.view(), self.normal_map.view()])
            .map(wgpu::BindingResource::TextureView)
            .collect();
        self.shader.bind(&self.gpu, 2, &views)
    }

    fn bind_resources(&self, atlas: &Atlas) -> wgpu::BindGroup {
        let views = self.rasterizer.object_views();
        let tables = views.iter().map(wgpu::BindingResource::TextureView);
        let (shading, points, maps) = (&self.shading, &self.sample_points, &self.sample_maps);
        let buffers = [shading, points, maps, atlas.indirection(), &self.touched, &self.gloss, &self.light];
        let resources: Vec<_> = tables.chain(buffers.map(wgpu::Buffer::as_entire_binding)).collect();
        self.shader.bind(&self.gpu, 1, &resources)
    }

    fn ensure_band(&mut self, width: u32, rows: u32) -> Result<(), GpuError> {
        BoundBand::ensure(&mut self.band, &self.gpu, (&self.rasterizer, &self.shader), (width, rows))
    }

    fn pipeline(&mut self, settings: &Settings, stand_in: bool) -> PipelineKey {
        let textures = self.atlas.as_ref().map_or(1, |a| a.atlas.texture_count());
        let filtered = settings.filter == Filter::Footprint;
        let brdf = gloss(settings.component)
            .map_or((0, false, false), |gloss| (brdf_number(gloss.brdf), gloss.integrates_first(settings.blend), gloss.is_prefiltered()));
        let key = (
            (component_number(settings.component), settings.sees_itself()),
            blend_number(settings, self.field.parameters.original),
            brdf,
            textures,
            filtered,
            stand_in,
            (settings.light.turns(), settings.light.changes_light()),
            settings.bumps.is_some(),
        );
        let constants = [
            ("COMPONENT", f64::from(key.0.0)),
            ("AS_AUTHORED", f64::from(u8::from(self.field.parameters.original == Original::AsAuthored))),
            ("SEES_ITSELF", f64::from(u8::from(key.0.1))),
            ("BLEND", f64::from(key.1)),
            ("BRDF_MODEL", f64::from(key.2.0)),
            ("INTEGRATES_FIRST", f64::from(u8::from(key.2.1))),
            ("PREFILTERED", f64::from(u8::from(key.2.2))),
            ("ATLAS_TEXTURES", textures as f64),
            ("FILTERED", f64::from(u8::from(filtered))),
            ("STAND_IN", f64::from(u8::from(stand_in))),
            ("TURNED", f64::from(u8::from(settings.light.turns()))),
            ("RELIT", f64::from(u8::from(settings.light.changes_light()))),
            ("BUMPED", f64::from(u8::from(key.7))),
        ];
        if !self.pipelines.contains_key(&key) {
            self.gpu.settle();
        }
        self.pipelines.entry(key).or_insert_with(|| self.shader.compute_pipeline(&self.gpu, "shade", &constants));
        key
    }
}

impl GpuKernel for Kernel {
    fn draw(&mut self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<(PendingPixels, GpuFrameStats), RenderError> {
        self.draw_frame(request, pages)
    }

    fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    fn look_ahead(&mut self, request: &FrameRequest<'_>, upload_bytes: u64) -> Result<Vec<PageId>, RenderError> {
        self.pages_ahead(request, upload_bytes)
    }

    fn bring_ahead(&mut self, pages: &[(PageId, Arc<Page>)]) -> Result<usize, RenderError> {
        self.take_ahead(pages)
    }

    fn set_policy(&mut self, kind: PolicyKind) {
        self.policy = kind;
        if let Some(bound) = &mut self.atlas {
            bound.atlas.set_policy(kind);
        }
    }

    fn set_upload_unit(&mut self, unit: UploadUnit) {
        self.upload_unit = unit;
        self.forget_pages();
    }

    fn set_budget(&mut self, budget_bytes: u64) {
        // With what a larger frame would take beside it.
        let fits = |a: &BoundAtlas| self.fixed_bytes() + a.atlas.bytes() <= budget_bytes;
        let keeps = self.atlas.as_ref().is_some_and(|a| a.atlas.capacity() >= a.shape.page_count && fits(a));
        self.budget_bytes = budget_bytes;
        if !keeps {
            // Frames make them anew if they leave room for pages still.
            self.forget_tables();
            self.forget_pages();
        }
    }

    fn bytes(&self) -> u64 {
        let unused = u64::from(MAX_BAND_PIXELS - self.band.as_ref().map_or(0, |b| b.band.pixels())) * BYTES_PER_PIXEL;
        self.fixed_bytes() - unused + self.atlas.as_ref().map_or(0, |a| a.atlas.bytes())
    }

    fn stats(&self) -> GpuCacheStats {
        let mut stats = GpuCacheStats { device_bytes: self.bytes(), ..self.atlas.as_ref().map(|a| a.atlas.stats()).unwrap_or_default() };
        stats.add(&GpuCacheStats { device_bytes: 0, ..self.earlier });
        stats
    }
}

fn pair(low: u16, high: u16) -> u32 {
    u32::from(low) | u32::from(high) << 16
}

fn component_number(component: Component) -> u32 {
    match component {
        Component::Reconstruction => 0,
        Component::Mirror => 1,
        Component::Full => 2,
        Component::Glossy(_) => 3,
        Component::Refraction(dielectric) => match dielectric.body() {
            Body::Solid => 4,
            Body::Thin => 5,
        },
    }
}

fn gloss(component: Component) -> Option<Gloss> {
    match component {
        Component::Glossy(gloss) => Some(gloss),
        Component::Reconstruction | Component::Mirror | Component::Full | Component::Refraction(_) => None,
    }
}

fn brdf_number(brdf: GlossBrdf) -> u32 {
    match brdf {
        GlossBrdf::Analytic(brdf) => brdf.number(),
        GlossBrdf::Measured(_) => Measured::NUMBER,
    }
}

// Reconstruction is corrected or not: of its other blends one pipeline serves all.
fn blend_number(settings: &Settings, original: Original) -> u32 {
    match settings.blend {
        Blend::Corrected => 6,
        // One sample point shows it, whatever the blend.
        _ if settings.component == Component::Reconstruction && original == Original::Diffuse => 0,
        Blend::Distance => 0,
        Blend::Angle => 1,
        Blend::Average => 2,
        Blend::Reflection { .. } => 3,
        Blend::Normal { .. } => 4,
        Blend::EnvironmentMap => 5,
    }
}
