//! Host side of `kernel.wgsl`: what one map has on the device, and its frames.
//!
//! A map's numbers are brought whole, at its first frame: they are small by design. A map that does not fit into the budget is drawn by the CPU,
//! which reads what it needs through the page cache.

use std::sync::Arc;
use std::time::Instant;

use bytemuck::{Pod, Zeroable};

use super::device_tables::DeviceTables;
use super::{ModelCode, ParameterMap, Show};
use crate::directions::harmonics_wgsl;
use crate::fitting::Basis;
use crate::gpu::{Gpu, GpuCacheStats, GpuError, Shader, binding, value_buffer};
use crate::representations::frame_output::{BAND_BYTES, BYTES_PER_PIXEL, BoundBand, FrameOutput, MAX_BAND_PIXELS, bands};
use crate::representations::g_buffer::{ProxyGeometry, Rasterizer, band_entries, object_entries};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, GpuFrameStats, GpuKernel, PendingPixels, RenderError, Settings as AnySettings, UploadUnit};
use crate::textures::{Page, PageId, PixelFormat, PolicyKind};

const SOURCE: &str = concat!(
    include_str!("../g_buffer/camera.wgsl"),
    include_str!("../../gpu/table.wgsl"),
    include_str!("../g_buffer/band.wgsl"),
    include_str!("../g_buffer/object.wgsl"),
    include_str!("kernel.wgsl")
);

/// All of the kernel's source, for maps with harmonics of at most so many bands; 0 for none.
pub(crate) fn source(bands: usize) -> String {
    SOURCE.to_owned() + &harmonics_wgsl(bands)
}

/// Layout as WGSL's `Shading`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ShadingUniform {
    pub size: u32,
    pub show_what: u32,
}

/// One map on the device.
pub(crate) struct Kernel {
    gpu: Arc<Gpu>,
    map: Arc<ParameterMap>,
    budget_bytes: u64,
    rasterizer: Rasterizer,
    shader: Shader,
    pipeline: wgpu::ComputePipeline,
    shading: wgpu::Buffer,
    numbers: Option<Numbers>,
    band: Option<BoundBand>,
    stats: GpuCacheStats,
}

/// All pages of the map.
struct Numbers {
    tables: DeviceTables,
    resources: wgpu::BindGroup,
}

impl Kernel {
    pub fn new(gpu: Arc<Gpu>, map: Arc<ParameterMap>, budget_bytes: u64) -> Result<Self, GpuError> {
        let geometry = ProxyGeometry::new(&map.surface.mesh, &map.surface.part_of_triangle, &map.background);
        let [triangles, vertices] = object_entries();
        let entries = [triangles, vertices, binding::read_buffer(2), binding::uint_texture(3), binding::uint_texture(4)];
        let codes = || map.texels.texels.iter().map(|t| t.code);
        let lobes = codes().map(ModelCode::lobes).max().unwrap_or(0);
        let bands = codes().filter_map(ModelCode::bands).max().unwrap_or(0);
        let has = |basis| codes().any(|code| code.basis() == Some(basis));
        let constants = [
            ("LOBES", f64::from(lobes)),
            ("HEMISPHERICAL", f64::from(u8::from(has(Basis::Hemispherical)))),
            ("SPHERICAL", f64::from(u8::from(has(Basis::Spherical)))),
            ("IS_WIDE", f64::from(u8::from(map.parameters.pixel_format == PixelFormat::F32))),
        ];
        let shader = Shader::new(&gpu, "parameter map", source(bands as usize), &[&band_entries(), &entries]);
        let kernel = Self {
            rasterizer: Rasterizer::new(&gpu, &geometry)?,
            pipeline: shader.compute_pipeline(&gpu, "shade", &constants),
            shader,
            shading: value_buffer::<ShadingUniform>(&gpu, "shading"),
            numbers: None,
            band: None,
            stats: GpuCacheStats::default(),
            budget_bytes,
            map,
            gpu,
        };
        kernel.gpu.check()?;
        kernel.check_budget()?;
        Ok(kernel)
    }

    /// The last frame's last band's G-buffer.
    #[cfg(test)]
    pub fn read_g_buffer(&self) -> Vec<crate::representations::g_buffer::GBufferPixel> {
        self.rasterizer.read_g_buffer(&self.gpu, &self.band.as_ref().expect("a frame was rendered").band)
    }

    fn check_budget(&self) -> Result<(), GpuError> {
        let (needed_bytes, budget_bytes) = (self.rasterizer.bytes() + DeviceTables::bytes_of(&self.map) + BAND_BYTES, self.budget_bytes);
        match needed_bytes <= budget_bytes {
            true => Ok(()),
            false => Err(GpuError::OverBudget { what: "the parameter map", needed_bytes, budget_bytes }),
        }
    }

    fn ensure_numbers(&mut self, pages: &CountingSource<'_>) -> Result<usize, RenderError> {
        let count = self.map.page_count() as u64;
        if self.numbers.is_some() {
            self.stats.look_ups += count;
            self.stats.hits += count;
            return Ok(0);
        }
        // The frame before shall not wait for them.
        self.gpu.settle();
        self.check_budget()?;
        let tables = DeviceTables::new(&self.gpu, &self.map, |number, packer| {
            let page = pages.page(PageId(number))?;
            self.map.check_page(number, page.shape())?;
            packer.append(page.bytes());
            Ok::<_, RenderError>(())
        })?;
        let (object, of_map) = (self.rasterizer.object_views(), tables.views());
        let [triangles, vertices] = object.each_ref().map(wgpu::BindingResource::TextureView);
        let [heads, pairs] = of_map.each_ref().map(wgpu::BindingResource::TextureView);
        let resources = [triangles, vertices, self.shading.as_entire_binding(), heads, pairs];
        let resources = self.shader.bind(&self.gpu, 1, &resources);
        self.stats.bytes_uploaded += tables.bytes();
        self.numbers = Some(Numbers { tables, resources });
        self.stats.look_ups += count;
        self.stats.misses += count;
        self.stats.uploads += count;
        Ok(count as usize)
    }

    fn draw_band(
        &mut self,
        request: &FrameRequest<'_>,
        (first_row, rows): (u32, u32),
        output: &FrameOutput,
        stats: &mut GpuFrameStats,
    ) -> Result<(), RenderError> {
        let begin = Instant::now();
        let width = request.camera.intrinsics().width_px;
        BoundBand::ensure(&mut self.band, &self.gpu, (&self.rasterizer, &self.shader), (width, rows))?;
        let (bound, numbers) = (self.band.as_ref().expect("made above"), self.numbers.as_ref().expect("made before"));
        let mut encoder = self.gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") });
        self.rasterizer.draw(&self.gpu, &mut encoder, (request.camera, 0.0), first_row, &bound.band)?;
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_bind_group(0, &bound.resources, &[]);
        pass.set_bind_group(1, &numbers.resources, &[]);
        pass.set_pipeline(&self.pipeline);
        bound.band.dispatch_over_object(&mut pass);
        drop(pass);
        FrameOutput::copy(request.outputs, &mut encoder, bound);
        self.gpu.queue().submit([encoder.finish()]);
        self.gpu.wait()?;
        stats.gpu_millis += millis_since(begin);
        let begin = Instant::now();
        output.read(&self.gpu, self.band.as_mut().expect("made above"))?;
        stats.read_back_millis += millis_since(begin);
        Ok(())
    }

    fn forget_numbers(&mut self) {
        if self.numbers.take().is_some() {
            self.stats.evictions += self.map.page_count() as u64;
        }
        self.band = None;
    }
}

impl GpuKernel for Kernel {
    fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    fn draw(&mut self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<(PendingPixels, GpuFrameStats), RenderError> {
        let AnySettings::ParameterMap(settings) = request.settings else {
            return Err(RenderError::OtherKind { settings: request.settings.kind() });
        };
        let begin = Instant::now();
        let mut stats = GpuFrameStats { passes: 1, ..GpuFrameStats::default() };
        let bands = bands(&self.gpu, request.camera)?;
        stats.pages_uploaded = self.ensure_numbers(pages)?;
        stats.pages_millis = millis_since(begin);
        let show_what = match settings.show {
            Show::Radiance => 0,
            Show::Models => 1,
            Show::Flags => 2,
        };
        let uniform = ShadingUniform { size: self.map.texels.size as u32, show_what };
        self.gpu.queue().write_buffer(&self.shading, 0, bytemuck::bytes_of(&uniform));
        let output = FrameOutput::new(request);
        for band in bands {
            self.draw_band(request, band, &output, &mut stats)?;
        }
        Ok((output.into_pixels(&self.gpu, self.map.page_count(), true), stats))
    }

    // All pages come with the first frame.
    fn look_ahead(&mut self, _request: &FrameRequest<'_>, _upload_bytes: u64) -> Result<Vec<PageId>, RenderError> {
        Ok(Vec::new())
    }

    fn bring_ahead(&mut self, _pages: &[(PageId, Arc<Page>)]) -> Result<usize, RenderError> {
        Ok(0)
    }

    // Nothing leaves for others.
    fn set_policy(&mut self, _kind: PolicyKind) {}

    fn set_upload_unit(&mut self, _unit: UploadUnit) {}

    fn set_budget(&mut self, budget_bytes: u64) {
        self.budget_bytes = budget_bytes;
        if self.check_budget().is_err() {
            self.forget_numbers();
        }
    }

    fn bytes(&self) -> u64 {
        let band = self.band.as_ref().map_or(0, |b| u64::from(b.band.pixels().min(MAX_BAND_PIXELS)) * BYTES_PER_PIXEL);
        self.rasterizer.bytes() + band + self.numbers.as_ref().map_or(0, |n| n.tables.bytes())
    }

    fn stats(&self) -> GpuCacheStats {
        let (pages, bytes) = self.numbers.as_ref().map_or((0, 0), |n| (self.map.page_count() as u64, n.tables.bytes()));
        GpuCacheStats { resident_pages: pages, resident_bytes: bytes, device_bytes: self.bytes(), ..self.stats }
    }
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}
