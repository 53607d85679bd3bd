//! Camera + representation → frame, on the GPU or on the CPU.
//!
//! One [`Renderer`] serves every dataset. What a dataset needs beside its pages (vertex buffers, sample maps, trees, an atlas of
//! pages on the GPU) is made at its first frame and kept until others need the room, least recently used first. All calls block;
//! frames on the GPU take turns.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

#[cfg(feature = "gpu")]
use crate::gpu::Gpu;
#[cfg(feature = "gpu")]
use crate::representations::GpuKernel;
use crate::representations::{CountingSource, CpuKernel};
pub use crate::representations::{
    FrameRequest, GpuFrameStats, Outputs, PageSource, PageUse, Pixels, Provenance, RenderError, Representation, Settings,
};

/// What computes a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Backend {
    /// wgpu on any Vulkan, Metal or DX12 adapter, software ones included.
    Gpu,
    /// The multithreaded reference.
    Cpu,
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
}

// Of each dataset in use, least recently used first.
type Kernels<K> = VecDeque<(Arc<dyn Representation>, K)>;

/// Renders frames of any dataset.
pub struct Renderer {
    cpu_kernels: Mutex<Kernels<Arc<dyn CpuKernel>>>,
    #[cfg(feature = "gpu")]
    gpu: Option<GpuSide>,
}

#[cfg(feature = "gpu")]
struct GpuSide {
    gpu: Arc<Gpu>,
    budget_bytes: u64,
    kernels: Mutex<Kernels<Box<dyn GpuKernel>>>,
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
        let gpu = GpuSide { gpu: Arc::new(Gpu::new()?), budget_bytes, kernels: Mutex::default() };
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
        let mut kernels = side.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let known = kernels.iter().position(|(r, _)| Arc::ptr_eq(r, representation)).and_then(|at| kernels.remove(at));
        let (representation, mut kernel) = match known {
            Some(entry) => entry,
            None => (representation.clone(), side.new_kernel(representation, &mut kernels)?),
        };
        let prepare_millis = millis_since(begin);
        let pages = CountingSource::new(pages);
        let outcome = kernel.render(request, &pages);
        kernels.push_back((representation, kernel));
        drop(kernels);
        let (pixels, gpu) = outcome?;
        let stats = FrameStats {
            backend: Backend::Gpu,
            fallback: None,
            page_use: pages.usage(),
            pages_needed: pixels.pages_needed,
            prepare_millis,
            total_millis: millis_since(begin),
            gpu: Some(gpu),
        };
        Ok(frame(request, pixels, stats))
    }

    /// Held on the device by all datasets together.
    pub fn gpu_bytes(&self) -> u64 {
        self.gpu.as_ref().map_or(0, |g| g.kernels.lock().unwrap_or_else(PoisonError::into_inner).iter().map(|(_, k)| k.bytes()).sum())
    }
}

#[cfg(feature = "gpu")]
impl GpuSide {
    // Two datasets of half the budget each can stay; a new one otherwise displaces those unused for longest.
    fn new_kernel(
        &self,
        representation: &Arc<dyn Representation>,
        kernels: &mut Kernels<Box<dyn GpuKernel>>,
    ) -> Result<Box<dyn GpuKernel>, RenderError> {
        let held = |kernels: &Kernels<Box<dyn GpuKernel>>| kernels.iter().map(|(_, k)| k.bytes()).sum::<u64>();
        while held(kernels) > self.budget_bytes / 2 {
            kernels.pop_front();
        }
        let budget_bytes = self.budget_bytes - held(kernels);
        Ok(representation.clone().gpu_kernel(&self.gpu, budget_bytes)?)
    }
}

fn frame(request: &FrameRequest<'_>, pixels: Pixels, stats: FrameStats) -> Frame {
    let intrinsics = request.camera.intrinsics();
    Frame { width_px: intrinsics.width_px, height_px: intrinsics.height_px, pixels, stats }
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}
