//! Host side of `kernel.wgsl`: buffers, bands, the passes of a frame, and bringing the pages it needs.
//!
//! A frame is drawn in bands of rows, so that memory on the device does not grow with it. For each band the object is shaded; the
//! kernel leaves word of every page it wanted; missing ones are fetched and uploaded, and the band is shaded again. In the steady
//! state one pass suffices. (A coarse level that stands in for missing pages has its place in `page_texel`.)

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::{Blend, Component, OffsetSurfaceLightField, Settings, check_page};
use crate::gpu::{Atlas, AtlasShape, Gpu, GpuError, ReadBack, Shader, binding, conform, storage_buffer, uniform_buffer};
use crate::representations::g_buffer::{BAND_BYTES_PER_PIXEL, Band, OUTPUT_WORDS, ProxyGeometry, Rasterizer, band_entries};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, GpuFrameStats, GpuKernel, Pixels, Provenance, RenderError, Settings as AnySettings};
use crate::textures::{Page, PageId};

/// All of `kernel.wgsl`'s source.
pub(crate) const SOURCE: &str = concat!(
    include_str!("../g_buffer/camera.wgsl"),
    include_str!("../g_buffer/band.wgsl"),
    include_str!("../g_buffer/object.wgsl"),
    include_str!("../../directions/cube_map.wgsl"),
    include_str!("../../gpu/atlas.wgsl"),
    include_str!("kernel.wgsl")
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
}

// A band has at most this many pixels: 32 MiB on the device with everything that grows with it.
const MAX_BAND_PIXELS: u32 = 1 << 19;
// With the copy of the output that is read back.
const BYTES_PER_PIXEL: u64 = BAND_BYTES_PER_PIXEL + 4 * OUTPUT_WORDS;
// Shading passes of one band: a second one finds every page, a third one means a bug.
const MAX_PASSES: u32 = 3;

/// One dataset on the device.
pub(crate) struct Kernel {
    gpu: Arc<Gpu>,
    field: Arc<OffsetSurfaceLightField>,
    budget_bytes: u64,
    rasterizer: Rasterizer,
    shader: Shader,
    shading: wgpu::Buffer,
    sample_points: wgpu::Buffer,
    sample_maps: wgpu::Buffer,
    touched: wgpu::Buffer,
    touched_read_back: ReadBack,
    pipelines: HashMap<(u32, u32), wgpu::ComputePipeline>,
    // Made with the first page, whose format it takes.
    atlas: Option<BoundAtlas>,
    band: Option<BoundBand>,
    stamp: u32,
    frames: u64,
}

struct BoundAtlas {
    atlas: Atlas,
    shape: AtlasShape,
    views: wgpu::BindGroup,
    resources: wgpu::BindGroup,
}

struct BoundBand {
    band: Band,
    resources: wgpu::BindGroup,
    read_back: ReadBack,
}

impl Kernel {
    pub fn new(gpu: Arc<Gpu>, field: Arc<OffsetSurfaceLightField>, budget_bytes: u64) -> Result<Self, GpuError> {
        let geometry = ProxyGeometry::new(&field.surface.mesh, &field.surface.part_of_triangle, &field.background);
        gpu.check_binding("the sample maps", size_of_val(field.sample_maps.indices.as_slice()) as u64)?;
        let entries = [
            binding::read_buffer(0),
            binding::read_buffer(1),
            binding::uniform(2),
            binding::read_buffer(3),
            binding::read_buffer(4),
            binding::read_buffer(5),
            binding::write_buffer(6),
        ];
        let atlas_entries = [0, 1, 2, 3].map(binding::texture_array);
        let none = wgpu::BufferUsages::empty();
        let positions: Vec<[f32; 4]> = field.sample_points.iter().map(|p| p.position.extend(0.0).into()).collect();
        // On little-endian machines, the only ones there are graphics drivers for, four u16 are the two words that WGSL unpacks.
        let maps: Vec<[u32; 2]> = field.sample_maps.indices.iter().map(|i| [pair(i[0], i[1]), pair(i[2], i[3])]).collect();
        let touched_words = vec![0u32; field.page_count()];
        let kernel = Self {
            rasterizer: Rasterizer::new(&gpu, &geometry)?,
            shader: Shader::new(&gpu, "offset surface light field", SOURCE, &[&band_entries(), &entries, &atlas_entries]),
            shading: uniform_buffer::<ShadingUniform>(&gpu, "shading"),
            sample_points: storage_buffer(&gpu, "sample points", &positions, none),
            sample_maps: storage_buffer(&gpu, "sample maps", &maps, none),
            touched: storage_buffer(&gpu, "touched", &touched_words, wgpu::BufferUsages::COPY_SRC),
            touched_read_back: ReadBack::new(&gpu, "touched", 4 * touched_words.len() as u64),
            pipelines: HashMap::new(),
            atlas: None,
            band: None,
            stamp: 0,
            frames: 0,
            budget_bytes,
            field,
            gpu,
        };
        kernel.gpu.check()?;
        let needed_bytes = kernel.fixed_bytes() + u64::from(MAX_BAND_PIXELS) * BYTES_PER_PIXEL;
        if needed_bytes >= budget_bytes {
            return Err(GpuError::OverBudget { what: "the dataset's geometry", needed_bytes, budget_bytes });
        }
        Ok(kernel)
    }

    /// The last band's G-buffer.
    #[cfg(test)]
    pub fn read_g_buffer(&self) -> Vec<crate::representations::g_buffer::GBufferPixel> {
        self.rasterizer.read_g_buffer(&self.gpu, &self.band.as_ref().expect("a frame was rendered").band)
    }

    /// From the next frame on the atlas takes at most this much.
    #[cfg(test)]
    pub fn set_atlas_budget(&mut self, bytes: u64) {
        self.budget_bytes = self.fixed_bytes() + u64::from(MAX_BAND_PIXELS) * BYTES_PER_PIXEL + bytes;
    }

    fn fixed_bytes(&self) -> u64 {
        let buffers = [&self.sample_points, &self.sample_maps, &self.touched, self.touched_read_back.buffer()];
        self.rasterizer.bytes() + buffers.iter().map(|b| b.size()).sum::<u64>()
    }

    fn pipelines(&mut self, settings: &Settings) -> (u32, u32) {
        let key = (component_number(settings.component), blend_number(settings));
        let textures = self.atlas.as_ref().map_or(1, |a| a.atlas.texture_count());
        let constants = [("COMPONENT", f64::from(key.0)), ("BLEND", f64::from(key.1)), ("ATLAS_TEXTURES", textures as f64)];
        self.pipelines.entry(key).or_insert_with(|| self.shader.compute_pipeline(&self.gpu, "shade", &constants));
        key
    }

    // The first page tells what all of them look like.
    fn ensure_atlas(&mut self, pages: &CountingSource<'_>) -> Result<(), RenderError> {
        if self.atlas.is_some() {
            return Ok(());
        }
        let page_size = self.field.parameters.face_size_texels;
        let pixel = pages.page(PageId(0))?.shape().pixel;
        let shape = AtlasShape { page_count: self.field.page_count(), page_size, pixel };
        let budget = self.budget_bytes - self.fixed_bytes() - u64::from(MAX_BAND_PIXELS) * BYTES_PER_PIXEL;
        let atlas = Atlas::new(&self.gpu, shape, budget)?;
        let views: Vec<_> = atlas.views().iter().map(wgpu::BindingResource::TextureView).collect();
        let views = self.shader.bind(&self.gpu, 2, &views);
        let [triangles, vertices] = self.rasterizer.object_buffers();
        let resources = [triangles, vertices, &self.shading, &self.sample_points, &self.sample_maps, atlas.indirection(), &self.touched];
        let resources = self.shader.bind(&self.gpu, 1, &resources.map(wgpu::Buffer::as_entire_binding));
        self.atlas = Some(BoundAtlas { atlas, shape, views, resources });
        Ok(())
    }

    fn ensure_band(&mut self, width: u32, rows: u32) -> Result<(), GpuError> {
        if self.band.as_ref().is_some_and(|b| (b.band.width, b.band.rows) == (width, rows)) {
            return Ok(());
        }
        // The old one first, so that both are never held at once.
        self.band = None;
        let band = self.rasterizer.band(&self.gpu, width, rows);
        let resources = self.rasterizer.bind_band(&self.gpu, &self.shader, &band);
        let read_back = ReadBack::new(&self.gpu, "output", band.output().size());
        self.gpu.check()?;
        self.band = Some(BoundBand { band, resources, read_back });
        Ok(())
    }

    fn render_band(&mut self, frame: &mut FrameInProgress<'_, '_>, first_row: u32, rows: u32) -> Result<(), RenderError> {
        let begin = Instant::now();
        let camera = frame.request.camera;
        self.ensure_band(camera.intrinsics().width_px, rows)?;
        let gpu = self.gpu.clone();
        let mut encoder = new_encoder(&gpu);
        let band = &self.band.as_ref().expect("made above").band;
        self.rasterizer.draw(&gpu, &mut encoder, camera, first_row, band)?;
        self.record_pass(&mut encoder, frame);
        let mut passes = 1;
        loop {
            let recorded = std::mem::replace(&mut encoder, new_encoder(&gpu));
            gpu.queue().submit([recorded.finish()]);
            let missing = self.missing_pages(&gpu, frame)?;
            if missing.is_empty() {
                break;
            }
            if passes == MAX_PASSES {
                return Err(GpuError::Failed { reason: "pages stay missing after they were uploaded".into() }.into());
            }
            frame.stats.gpu_millis += millis_since(begin) - frame.stats.pages_millis;
            self.bring(&gpu, frame, &missing)?;
            self.record_pass(&mut encoder, frame);
            passes += 1;
        }
        frame.stats.passes = frame.stats.passes.max(passes);
        frame.stats.gpu_millis += millis_since(begin);
        self.read_band(frame)
    }

    // Shading, and the copies that a pass's results leave by.
    fn record_pass(&mut self, encoder: &mut wgpu::CommandEncoder, frame: &FrameInProgress<'_, '_>) {
        let key = self.pipelines(frame.settings);
        self.stamp = self.stamp.wrapping_add(1).max(1);
        let uniform = ShadingUniform {
            specular_reflectance: frame.settings.specular_reflectance.into(),
            exponent: exponent(frame.settings.blend),
            face_size: self.field.parameters.face_size_texels,
            map_size: self.field.sample_maps.size as u32,
            baseline_cube: self.field.sample_points.len() as u32,
            stamp: self.stamp,
        };
        self.gpu.queue().write_buffer(&self.shading, 0, bytemuck::bytes_of(&uniform));
        let (band, atlas) = (self.band.as_ref().expect("made before"), self.atlas.as_ref().expect("made before"));
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_bind_group(0, &band.resources, &[]);
        pass.set_bind_group(1, &atlas.resources, &[]);
        pass.set_bind_group(2, &atlas.views, &[]);
        pass.set_pipeline(&self.pipelines[&key]);
        band.band.dispatch_over_object(&mut pass);
        drop(pass);
        let pages = self.touched_read_back.buffer();
        encoder.copy_buffer_to_buffer(&self.touched, 0, pages, 0, self.touched.size());
        for range in wanted_ranges(band.band.pixels(), frame.request) {
            encoder.copy_buffer_to_buffer(band.band.output(), range.start, band.read_back.buffer(), range.start, range.end - range.start);
        }
    }

    // Waits for the pass; which pages it wanted, and which of them were not there.
    fn missing_pages(&mut self, gpu: &Gpu, frame: &mut FrameInProgress<'_, '_>) -> Result<Vec<u32>, GpuError> {
        let atlas = &mut self.atlas.as_mut().expect("made before").atlas;
        let stamp = self.stamp;
        let mut missing = Vec::new();
        self.touched_read_back.request(0..self.touched_read_back.bytes()).finish(gpu, |bytes| {
            let stamps = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            for (page, _) in stamps.enumerate().filter(|(_, s)| *s == stamp) {
                frame.needed[page] = true;
                if atlas.is_resident(page as u32) {
                    atlas.touch(page as u32, frame.number);
                } else {
                    missing.push(page as u32);
                }
            }
        })?;
        Ok(missing)
    }

    // Fetches and uploads.
    fn bring(&mut self, gpu: &Gpu, frame: &mut FrameInProgress<'_, '_>, missing: &[u32]) -> Result<(), RenderError> {
        let begin = Instant::now();
        let bound = self.atlas.as_mut().expect("made before");
        let face_size = self.field.parameters.face_size_texels;
        let fetch = |page: &u32| {
            let fetched = frame.pages.page(PageId(*page))?;
            check_page(*page, &fetched, face_size)?;
            Ok((*page, conform(fetched, bound.shape)?))
        };
        let needed = frame.needed.iter().filter(|n| **n).count();
        if missing.len() > bound.atlas.capacity() {
            return Err(GpuError::TooManyPages { needed, capacity: bound.atlas.capacity() }.into());
        }
        // In batches, so that pages in flight do not fill memory: the source's cache may be small.
        for batch in missing.chunks(PAGES_IN_FLIGHT) {
            let pages: Vec<(u32, Arc<Page>)> = batch.par_iter().map(fetch).collect::<Result<_, RenderError>>()?;
            bound.atlas.upload(gpu, frame.number, pages.iter().map(|(number, page)| (*number, page.as_ref())))?;
        }
        frame.stats.pages_uploaded += missing.len();
        frame.stats.pages_millis += millis_since(begin);
        Ok(())
    }

    fn read_band(&mut self, frame: &mut FrameInProgress<'_, '_>) -> Result<(), RenderError> {
        let begin = Instant::now();
        let band = self.band.as_ref().expect("made before");
        let pixels = band.band.pixels() as usize;
        let last = wanted_ranges(band.band.pixels(), frame.request).last().map_or(0, |r| r.end);
        let (color, depth, provenance) = (&mut frame.color, &mut frame.depth, &mut frame.provenance);
        band.read_back.request(0..last.next_multiple_of(wgpu::MAP_ALIGNMENT).min(band.read_back.bytes())).finish(&self.gpu, |bytes| {
            // Mapped memory is aligned to 8 bytes; pod_collect does not depend on it.
            extend_from_bytes(color, &bytes[..12 * pixels]);
            if let Some(depth) = depth {
                extend_from_bytes(depth, &bytes[12 * pixels..16 * pixels]);
            }
            if let Some(provenance) = provenance {
                extend_from_bytes(provenance, &bytes[16 * pixels..20 * pixels]);
            }
        })?;
        frame.stats.read_back_millis += millis_since(begin);
        Ok(())
    }
}

// At most this many decoded pages wait for their upload.
const PAGES_IN_FLIGHT: usize = 256;

/// A frame of which some bands are done.
struct FrameInProgress<'a, 'p> {
    request: &'a FrameRequest<'a>,
    settings: &'a Settings,
    pages: &'a CountingSource<'p>,
    number: u64,
    needed: Vec<bool>,
    color: Vec<f32>,
    depth: Option<Vec<f32>>,
    provenance: Option<Vec<Provenance>>,
    stats: GpuFrameStats,
}

impl GpuKernel for Kernel {
    fn render(&mut self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<(Pixels, GpuFrameStats), RenderError> {
        let AnySettings::OffsetSurfaceLightField(settings) = request.settings;
        let (width, height) = (request.camera.intrinsics().width_px, request.camera.intrinsics().height_px);
        let limit = self.gpu.device().limits().max_texture_dimension_2d.min(MAX_BAND_PIXELS);
        if width > limit {
            let what = "width of the frame in pixels";
            return Err(GpuError::BeyondLimit { what, needed: u64::from(width), limit: u64::from(limit) }.into());
        }
        self.ensure_atlas(pages)?;
        self.frames += 1;
        let pixels = width as usize * height as usize;
        let mut frame = FrameInProgress {
            request,
            settings,
            pages,
            number: self.frames,
            needed: vec![false; self.field.page_count()],
            color: Vec::with_capacity(3 * pixels),
            depth: request.outputs.depth.then(|| Vec::with_capacity(pixels)),
            provenance: request.outputs.provenance.then(|| Vec::with_capacity(pixels)),
            stats: GpuFrameStats::default(),
        };
        let band_rows = (MAX_BAND_PIXELS / width).min(limit).min(height);
        for first_row in (0..height).step_by(band_rows as usize) {
            self.render_band(&mut frame, first_row, band_rows.min(height - first_row))?;
        }
        let pages_needed = frame.needed.iter().filter(|n| **n).count();
        let pixels = Pixels { color: frame.color, depth: frame.depth, provenance: frame.provenance, pages_needed };
        Ok((pixels, frame.stats))
    }

    fn bytes(&self) -> u64 {
        let band = self.band.as_ref().map_or(0, |b| u64::from(b.band.pixels()) * BYTES_PER_PIXEL);
        self.fixed_bytes() + band + self.atlas.as_ref().map_or(0, |a| a.atlas.bytes())
    }
}

// Colour, and what else was asked for, as byte ranges of the output; neighbours are merged.
fn wanted_ranges(pixels: u32, request: &FrameRequest<'_>) -> impl Iterator<Item = Range<u64>> {
    let n = 4 * u64::from(pixels);
    let (first, second) = match (request.outputs.depth, request.outputs.provenance) {
        (false, false) => (0..3 * n, 0..0),
        (true, false) => (0..4 * n, 0..0),
        (true, true) => (0..5 * n, 0..0),
        (false, true) => (0..3 * n, 4 * n..5 * n),
    };
    [first, second].into_iter().filter(|r| !r.is_empty())
}

fn extend_from_bytes<T: Pod>(out: &mut Vec<T>, bytes: &[u8]) {
    match bytemuck::try_cast_slice(bytes) {
        Ok(values) => out.extend_from_slice(values),
        Err(_) => out.extend(bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned::<T>)),
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
    }
}

// Reconstruction reads no blend: one pipeline serves all.
fn blend_number(settings: &Settings) -> u32 {
    match settings.blend {
        _ if settings.component == Component::Reconstruction => 0,
        Blend::Distance => 0,
        Blend::Angle => 1,
        Blend::Average => 2,
        Blend::Reflection { .. } => 3,
        Blend::Normal { .. } => 4,
        Blend::EnvironmentMap => 5,
    }
}

fn exponent(blend: Blend) -> f32 {
    match blend {
        Blend::Reflection { exponent } | Blend::Normal { exponent } => exponent,
        Blend::Distance | Blend::Angle | Blend::Average | Blend::EnvironmentMap => 0.0,
    }
}

fn new_encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") })
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}
