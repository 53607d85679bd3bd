//! Camera + representation → frame, on the GPU or on the CPU.
//!
//! One [`Renderer`] serves every dataset. What a dataset needs beside its pages (vertex buffers, sample maps, trees, an atlas of
//! pages on the GPU) is made at its first frame and kept until others need the room, least recently used first. All calls block;
//! frames on the GPU take turns.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::representations::{CountingSource, CpuKernel};
pub use crate::representations::{FrameRequest, Outputs, PageSource, PageUse, Pixels, Provenance, RenderError, Representation, Settings};

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
}

/// Renders frames of any dataset.
pub struct Renderer {
    cpu_kernels: Mutex<VecDeque<(Arc<dyn Representation>, Arc<dyn CpuKernel>)>>,
}

// Trees of this many datasets stay in memory.
const CPU_KERNELS: usize = 4;

impl Renderer {
    /// On the CPU alone.
    pub fn cpu_only() -> Self {
        Self { cpu_kernels: Mutex::default() }
    }

    /// What frames are computed on when the request does not say.
    pub fn default_backend(&self) -> Backend {
        if self.adapter().is_some() { Backend::Gpu } else { Backend::Cpu }
    }

    /// The adapter's name; None on the CPU.
    pub fn adapter(&self) -> Option<&str> {
        None
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

fn frame(request: &FrameRequest<'_>, pixels: Pixels, stats: FrameStats) -> Frame {
    let intrinsics = request.camera.intrinsics();
    Frame { width_px: intrinsics.width_px, height_px: intrinsics.height_px, pixels, stats }
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}
