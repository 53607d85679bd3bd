//! Camera + representation → frame, on the GPU or on the CPU.
//!
//! One [`Renderer`] serves every dataset. What a dataset needs beside its pages (vertex buffers, sample maps, trees, an atlas of
//! pages on the GPU) is made at its first frame and kept until others need the room, least recently used first. All calls block;
//! frames on the GPU take turns.

use std::collections::VecDeque;
#[cfg(feature = "gpu")]
use std::sync::MutexGuard;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

#[cfg(feature = "gpu")]
use crate::gpu::{Gpu, GpuCacheStats, GpuError};
#[cfg(feature = "gpu")]
use crate::representations::GpuKernel;
use crate::representations::{CountingSource, CpuKernel};
pub use crate::representations::{
    FrameRequest, GpuFrameStats, Outputs, PageSource, PageUse, Pixels, Provenance, Refine, RenderError, Representation, Settings,
};
#[cfg(feature = "gpu")]
use crate::textures::PolicyKind;

/// What computes a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Backend {
    /// wgpu on any Vulkan, Metal or DX12 adapter, software ones included.
    Gpu,
    /// The multithreaded reference.
    Cpu,
}

impl Backend {
    /// In reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gpu => "gpu",
            Self::Cpu => "cpu",
        }
    }
}

/// A rendered frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Pixels along a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Colour, and what else was asked for.
    pub pixels: Pixels,
    /// What it took.
    pub stats: FrameStats,
}

/// What a frame took.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameStats {
    /// What computed it.
    pub backend: Backend,
    /// Why the CPU stood in for the GPU.
    pub fallback: Option<String>,
    /// Requests to the page source: on the GPU only pages that were not on the device, on the CPU those not at hand in a thread.
    pub page_use: PageUse,
    /// Distinct pages that the frame read.
    pub pages_needed: usize,
    /// Making what the dataset needs beside its pages; 0 after its first frame.
    pub prepare_millis: f64,
    /// The whole frame, preparation included.
    pub total_millis: f64,
    /// The GPU's part; None on the CPU.
    pub gpu: Option<GpuFrameStats>,
    /// Held on the device for this dataset when the frame was done; None on the CPU.
    pub device_bytes: Option<u64>,
}

// Of each dataset in use, least recently used first.
type Kernels<K> = VecDeque<Entry<K>>;
type Entry<K> = (Arc<dyn Representation>, K);

/// Renders frames of any dataset.
pub struct Renderer {
    cpu_kernels: Mutex<Kernels<Arc<dyn CpuKernel>>>,
    #[cfg(feature = "gpu")]
    gpu: Option<GpuSide>,
}

#[cfg(feature = "gpu")]
struct GpuSide {
    gpu: Arc<Gpu>,
    tier: Mutex<GpuTier>,
}

// Everything on the device, and what it may hold.
#[cfg(feature = "gpu")]
struct GpuTier {
    kernels: Kernels<Box<dyn GpuKernel>>,
    budget_bytes: u64,
    policy: PolicyKind,
    // Datasets that found too little room, and how much it was: the same room is not tried again.
    refused: VecDeque<(Arc<dyn Representation>, u64, RenderError)>,
    // Of datasets that left.
    earlier: GpuCacheStats,
    peak_bytes: u64,
}

// Trees of this many datasets stay in memory.
const CPU_KERNELS: usize = 4;

impl Renderer {
    /// On the CPU alone.
    pub fn cpu_only() -> Self {
        Self {
            cpu_kernels: Mutex::default(),
            #[cfg(feature = "gpu")]
            gpu: None,
        }
    }

    /// On the most capable adapter, holding at most `budget_bytes` of its memory; the CPU stands in for frames it cannot do.
    /// Errors when there is no adapter.
    #[cfg(feature = "gpu")]
    pub fn with_gpu(budget_bytes: u64) -> Result<Self, RenderError> {
        let tier = GpuTier {
            kernels: Kernels::new(),
            budget_bytes,
            policy: PolicyKind::Lru,
            refused: VecDeque::new(),
            earlier: GpuCacheStats::default(),
            peak_bytes: 0,
        };
        let gpu = GpuSide { gpu: Arc::new(Gpu::new()?), tier: Mutex::new(tier) };
        Ok(Self { gpu: Some(gpu), ..Self::cpu_only() })
    }

    /// The same, in a build without the feature `gpu`: always an error.
    #[cfg(not(feature = "gpu"))]
    pub fn with_gpu(_budget_bytes: u64) -> Result<Self, RenderError> {
        Err(RenderError::NoGpu)
    }

    /// What frames are computed on when the request does not say.
    pub fn default_backend(&self) -> Backend {
        if self.adapter().is_some() { Backend::Gpu } else { Backend::Cpu }
    }

    /// The adapter's name; None on the CPU.
    pub fn adapter(&self) -> Option<&str> {
        #[cfg(feature = "gpu")]
        return self.gpu.as_ref().map(|g| g.gpu.adapter());
        #[cfg(not(feature = "gpu"))]
        return None;
    }

    /// The adapter's driver and its version; None on the CPU.
    pub fn driver(&self) -> Option<&str> {
        #[cfg(feature = "gpu")]
        return self.gpu.as_ref().map(|g| g.gpu.driver());
        #[cfg(not(feature = "gpu"))]
        return None;
    }

    /// One frame, on `backend` or the default one. `pages` are those of the dataset version that `representation` was read from.
    pub fn render(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
        backend: Option<Backend>,
    ) -> Result<Frame, RenderError> {
        request.settings.check_frame(request.camera)?;
        match backend.unwrap_or(self.default_backend()) {
            Backend::Cpu => self.render_on_cpu(representation, pages, request, None),
            #[cfg(feature = "gpu")]
            Backend::Gpu => match self.render_on_gpu(representation, pages, request) {
                Err(RenderError::Gpu(reason)) => self.render_on_cpu(representation, pages, request, Some(reason.to_string())),
                outcome => outcome,
            },
            #[cfg(not(feature = "gpu"))]
            Backend::Gpu => Err(RenderError::NoGpu),
        }
    }

    fn render_on_cpu(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
        fallback: Option<String>,
    ) -> Result<Frame, RenderError> {
        let begin = Instant::now();
        let kernel = self.cpu_kernel(representation);
        let prepare_millis = millis_since(begin);
        let pages = CountingSource::new(pages);
        let pixels = kernel.render(request, &pages)?;
        let stats = FrameStats {
            backend: Backend::Cpu,
            fallback,
            page_use: pages.usage(),
            pages_needed: pixels.pages_needed,
            prepare_millis,
            total_millis: millis_since(begin),
            gpu: None,
            device_bytes: None,
        };
        Ok(frame(request, pixels, stats))
    }

    // The lock is held while a tree is built: two first frames of one dataset then build it once.
    fn cpu_kernel(&self, representation: &Arc<dyn Representation>) -> Arc<dyn CpuKernel> {
        let mut kernels = self.cpu_kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let known = kernels.iter().position(|(r, _)| Arc::ptr_eq(r, representation)).and_then(|at| kernels.remove(at));
        let entry = known.unwrap_or_else(|| (representation.clone(), representation.clone().cpu_kernel().into()));
        let kernel = entry.1.clone();
        kernels.push_back(entry);
        if kernels.len() > CPU_KERNELS {
            kernels.pop_front();
        }
        kernel
    }
}

#[cfg(feature = "gpu")]
impl Renderer {
    fn render_on_gpu(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
    ) -> Result<Frame, RenderError> {
        let side = self.gpu.as_ref().ok_or(RenderError::NoGpu)?;
        let begin = Instant::now();
        let mut tier = side.tier();
        let mut entry = tier.take(&side.gpu, representation)?;
        let prepare_millis = millis_since(begin);
        let pages = CountingSource::new(pages);
        let outcome = entry.1.render(request, &pages);
        let device_bytes = entry.1.bytes();
        tier.put_back(entry);
        drop(tier);
        if outcome.is_err() {
            side.gpu.release_dropped();
        }
        let (pixels, gpu) = outcome?;
        let stats = FrameStats {
            backend: Backend::Gpu,
            fallback: None,
            page_use: pages.usage(),
            pages_needed: pixels.pages_needed,
            prepare_millis,
            total_millis: millis_since(begin),
            gpu: Some(gpu),
            device_bytes: Some(device_bytes),
        };
        Ok(frame(request, pixels, stats))
    }

    /// Brings pages to the device that a frame like `request` would miss, at most `upload_bytes` of texels; how many. Does nothing without
    /// a GPU.
    pub fn prefetch(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
        upload_bytes: u64,
    ) -> Result<usize, RenderError> {
        request.settings.check_frame(request.camera)?;
        let Some(side) = &self.gpu else { return Ok(0) };
        let mut tier = side.tier();
        let mut entry = tier.take(&side.gpu, representation)?;
        let outcome = entry.1.prefetch(request, &CountingSource::new(pages), upload_bytes);
        tier.put_back(entry);
        outcome
    }

    /// Changes what all datasets together may hold on the device; what no longer fits leaves at once. Nothing without a GPU.
    pub fn set_gpu_budget(&self, budget_bytes: u64) {
        let Some(side) = &self.gpu else { return };
        side.tier().set_budget(budget_bytes);
    }

    /// Changes which pages leave the device when others need their place. Nothing without a GPU.
    pub fn set_gpu_policy(&self, policy: PolicyKind) {
        let Some(side) = &self.gpu else { return };
        let mut tier = side.tier();
        tier.policy = policy;
        tier.kernels.iter_mut().for_each(|(_, kernel)| kernel.set_policy(policy));
    }

    /// Which pages leave the device first; None without a GPU.
    pub fn gpu_policy(&self) -> Option<PolicyKind> {
        self.gpu.as_ref().map(|side| side.tier().policy)
    }

    /// Counters of the device's tier since the renderer was made, all of the same moment; None without a GPU.
    pub fn gpu_stats(&self) -> Option<GpuCacheStats> {
        self.gpu.as_ref().map(|side| side.tier().stats())
    }

    /// Held on the device by all datasets together.
    pub fn gpu_bytes(&self) -> u64 {
        self.gpu_stats().map_or(0, |s| s.device_bytes)
    }
}

#[cfg(feature = "gpu")]
impl GpuSide {
    fn tier(&self) -> MutexGuard<'_, GpuTier> {
        self.tier.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(feature = "gpu")]
impl GpuTier {
    fn held(&self) -> u64 {
        self.kernels.iter().map(|(_, k)| k.bytes()).sum()
    }

    fn stats(&self) -> GpuCacheStats {
        let mut stats = GpuCacheStats { peak_device_bytes: self.peak_bytes, budget_bytes: self.budget_bytes, ..self.earlier };
        self.kernels.iter().for_each(|(_, kernel)| stats.add(&kernel.stats()));
        stats
    }

    // The dataset's kernel, out of the list while it works. Two datasets of half the budget each can stay; a new one otherwise displaces
    // those unused for longest.
    fn take(&mut self, gpu: &Arc<Gpu>, representation: &Arc<dyn Representation>) -> Result<Entry<Box<dyn GpuKernel>>, RenderError> {
        let known = self.kernels.iter().position(|(r, _)| Arc::ptr_eq(r, representation));
        if let Some(entry) = known.and_then(|at| self.kernels.remove(at)) {
            return Ok(entry);
        }
        while self.held() > self.budget_bytes / 2 && self.give_up_oldest() {}
        let room = self.budget_bytes.saturating_sub(self.held());
        if let Some((_, _, error)) = self.refused.iter().find(|(r, tried, _)| Arc::ptr_eq(r, representation) && room <= *tried) {
            return Err(error.clone());
        }
        let mut kernel = match representation.clone().gpu_kernel(gpu, room) {
            Ok(kernel) => kernel,
            Err(error) => {
                let is_for_want_of_room = matches!(error, GpuError::OverBudget { .. });
                let error = RenderError::from(error);
                // A device that failed may work again; a room that was too small stays so.
                if is_for_want_of_room {
                    self.refused.retain(|(r, ..)| !Arc::ptr_eq(r, representation));
                    self.refused.push_back((representation.clone(), room, error.clone()));
                }
                if self.refused.len() > CPU_KERNELS {
                    self.refused.pop_front();
                }
                gpu.release_dropped();
                return Err(error);
            }
        };
        kernel.set_policy(self.policy);
        Ok((representation.clone(), kernel))
    }

    fn put_back(&mut self, entry: Entry<Box<dyn GpuKernel>>) {
        self.kernels.push_back(entry);
        self.peak_bytes = self.peak_bytes.max(self.held());
    }

    fn set_budget(&mut self, budget_bytes: u64) {
        self.budget_bytes = budget_bytes;
        while self.kernels.len() > 1 && self.held() > budget_bytes {
            self.give_up_oldest();
        }
        if let Some((_, last)) = self.kernels.back() {
            let others = self.held() - last.bytes();
            if let Some((_, last)) = self.kernels.back_mut() {
                last.set_budget(budget_bytes.saturating_sub(others));
            }
        }
        // Geometry and sample maps of the last one may be too much by themselves.
        if self.held() > budget_bytes {
            self.give_up_oldest();
        }
        self.peak_bytes = self.held();
    }

    // False when there is none.
    fn give_up_oldest(&mut self) -> bool {
        let Some((_, kernel)) = self.kernels.pop_front() else { return false };
        let stats = kernel.stats();
        let evictions = stats.evictions + stats.resident_pages;
        self.earlier.add(&GpuCacheStats { evictions, resident_pages: 0, resident_bytes: 0, device_bytes: 0, ..stats });
        true
    }
}

fn frame(request: &FrameRequest<'_>, pixels: Pixels, stats: FrameStats) -> Frame {
    let intrinsics = request.camera.intrinsics();
    Frame { width_px: intrinsics.width_px, height_px: intrinsics.height_px, pixels, stats }
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}

#[cfg(all(test, feature = "gpu"))]
mod tests {
    use super::*;
    use crate::representations::offset_surface_light_field as oslf;
    use oslf::tests::fixture::WORLD;

    #[test]
    fn a_dataset_without_room_on_the_device_is_tried_once_and_drawn_by_the_cpu() {
        if crate::gpu::test_gpu().is_none() {
            return;
        }
        let renderer = Renderer::with_gpu(1000).unwrap();
        let (field, pages) = WORLD.build();
        let camera = WORLD.camera(3.0 * glam::Vec3::Z, glam::Vec3::ZERO, 16, 12);
        let field: Arc<dyn Representation> = Arc::new(field);
        let settings = Settings::OffsetSurfaceLightField(oslf::Settings {
            component: oslf::Component::Mirror,
            blend: oslf::Blend::Distance,
            specular_reflectance: glam::Vec3::ONE,
            filter: oslf::Filter::Footprint,
        });
        let outputs = Outputs { depth: false, provenance: false };
        let request = FrameRequest { camera: &camera, settings: &settings, outputs, refine: Refine::Whole };
        let refused = || renderer.gpu.as_ref().map_or(0, |side| side.tier().refused.len());
        for _ in 0..3 {
            let frame = renderer.render(&field, &pages, &request, Some(Backend::Gpu)).unwrap();
            assert!(frame.stats.backend == Backend::Cpu && frame.stats.fallback.is_some());
            assert_eq!(refused(), 1);
        }
        // With room it is tried again.
        renderer.set_gpu_budget(1 << 28);
        assert_eq!(renderer.render(&field, &pages, &request, Some(Backend::Gpu)).unwrap().stats.backend, Backend::Gpu);
    }
}
