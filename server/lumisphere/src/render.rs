//! Camera + representation → frame, on the GPU or on the CPU.
//!
//! One [`Renderer`] serves every dataset. What a dataset needs beside its pages (vertex buffers, sample maps, trees, an atlas of
//! pages on the GPU) is made at its first frame and kept until others need the room, least recently used first. All calls block;
//! frames on the GPU take turns. A device that is lost takes all that with it: the CPU draws that frame, another device the next.

mod accumulator;
#[cfg(feature = "gpu")]
mod device;
#[cfg(feature = "gpu")]
mod gpu_tier;

use std::collections::VecDeque;
#[cfg(feature = "gpu")]
use std::sync::MutexGuard;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

pub use self::accumulator::Accumulator;
#[cfg(feature = "gpu")]
use self::device::{Device, OpenDevice};
#[cfg(feature = "gpu")]
use self::gpu_tier::GpuTier;
#[cfg(feature = "gpu")]
use crate::gpu::GpuCacheStats;
#[cfg(feature = "gpu")]
use crate::representations::GpuKernel;
#[cfg(feature = "gpu")]
#[doc(hidden)]
pub use crate::representations::UploadUnit;
use crate::representations::{CountingSource, CpuKernel};
pub use crate::representations::{
    FrameRequest, GpuFrameStats, Outputs, PageSource, PageUse, PendingPixels, Pixels, Provenance, Refine, RenderError, Representation,
    Settings, Uploads,
};
#[cfg(feature = "gpu")]
use crate::textures::{Page, PageId, PolicyKind};

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

/// A frame that is drawn. The last of its pixels may still lie in a buffer of the device's, from where they come while the next is drawn, or
/// with [`Renderer::settle`].
pub struct PendingFrame {
    width_px: u32,
    height_px: u32,
    pixels: PendingPixels,
    stats: FrameStats,
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

impl PendingFrame {
    /// Waits for its pixels. Errors where the device was given up before they were copied.
    pub fn finish(self) -> Result<Frame, RenderError> {
        let Self { width_px, height_px, pixels, mut stats } = self;
        let (pixels, copying_millis) = pixels.finish()?;
        stats.total_millis += copying_millis;
        if let Some(gpu) = &mut stats.gpu {
            gpu.read_back_millis += copying_millis;
        }
        Ok(Frame { width_px, height_px, pixels, stats })
    }

    /// What it took, but for the copy of its last pixels.
    pub fn stats(&self) -> &FrameStats {
        &self.stats
    }

    /// Whether no better frame of the view follows.
    pub fn is_final(&self) -> bool {
        self.pixels.is_final()
    }
}

impl From<Frame> for PendingFrame {
    fn from(frame: Frame) -> Self {
        let Frame { width_px, height_px, pixels, stats } = frame;
        Self { width_px, height_px, pixels: pixels.into(), stats }
    }
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
    device: OpenDevice,
    tier: Mutex<GpuTier>,
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
        let gpu = GpuSide { device: OpenDevice::new()?, tier: Mutex::new(GpuTier::new(budget_bytes)) };
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
    pub fn adapter(&self) -> Option<String> {
        #[cfg(feature = "gpu")]
        return self.gpu.as_ref().map(|g| g.device.latest().adapter().into());
        #[cfg(not(feature = "gpu"))]
        return None;
    }

    /// The adapter's driver and its version; None on the CPU.
    pub fn driver(&self) -> Option<String> {
        #[cfg(feature = "gpu")]
        return self.gpu.as_ref().map(|g| g.device.latest().driver().into());
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
        let pending = self.draw(representation, pages, request, backend)?;
        self.settle();
        pending.finish()
    }

    /// The same up to the copy of its last pixels, which goes on while the next frame is drawn.
    pub fn draw(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
        backend: Option<Backend>,
    ) -> Result<PendingFrame, RenderError> {
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

    /// Brings what was drawn and still lies on the device; to be called when no frame follows at once.
    pub fn settle(&self) {
        #[cfg(feature = "gpu")]
        if let Some(side) = &self.gpu {
            side.device.latest().settle();
        }
    }

    fn render_on_cpu(
        &self,
        representation: &Arc<dyn Representation>,
        pages: &dyn PageSource,
        request: &FrameRequest<'_>,
        fallback: Option<String>,
    ) -> Result<PendingFrame, RenderError> {
        // What the device drew before shall not wait for this.
        self.settle();
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
        Ok(pending_frame(request, pixels.into(), stats))
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
    ) -> Result<PendingFrame, RenderError> {
        let side = self.gpu.as_ref().ok_or(RenderError::NoGpu)?;
        let begin = Instant::now();
        let mut tier = side.tier();
        let Device { gpu: device, is_new } = side.device.working()?;
        if is_new {
            tier.lose_all();
        }
        let mut resident = tier.take(&device, representation, pages.version_slot())?;
        let prepare_millis = millis_since(begin);
        let pages = CountingSource::new(pages);
        let outcome = resident.kernel.draw(request, &pages);
        let device_bytes = resident.kernel.bytes();
        tier.put_back(resident);
        drop(tier);
        if outcome.is_err() {
            device.release_dropped();
        }
        let (pixels, gpu) = outcome?;
        side.device.has_worked();
        let stats = FrameStats {
            backend: Backend::Gpu,
            fallback: None,
            page_use: pages.usage(),
            pages_needed: pixels.pages_needed(),
            prepare_millis,
            total_millis: millis_since(begin),
            gpu: Some(gpu),
            device_bytes: Some(device_bytes),
        };
        Ok(pending_frame(request, pixels, stats))
    }

    /// How many devices were lost and others opened in their place.
    pub fn devices_replaced(&self) -> u64 {
        self.gpu.as_ref().map_or(0, |side| side.device.replaced())
    }

    /// As when the adapter is taken away. Nothing without a GPU.
    #[doc(hidden)]
    pub fn lose_device(&self) {
        if let Some(side) = &self.gpu {
            side.device.latest().lose();
        }
    }

    /// Pages that a frame like `request` would miss on the device, at most `upload_bytes` of texels: shading its object tells, reading
    /// nothing. None without a GPU, and for a dataset that has nothing there yet.
    pub fn look_ahead(
        &self,
        representation: &Arc<dyn Representation>,
        request: &FrameRequest<'_>,
        upload_bytes: u64,
    ) -> Result<Vec<PageId>, RenderError> {
        request.settings.check_frame(request.camera)?;
        self.with_known_kernel(representation, |kernel| kernel.look_ahead(request, upload_bytes))
    }

    /// Takes pages of that dataset onto the device before a frame wants them; how many. What the last frame showed and the last look ahead
    /// saw stays.
    pub fn bring_ahead(&self, representation: &Arc<dyn Representation>, pages: &[(PageId, Arc<Page>)]) -> Result<usize, RenderError> {
        self.with_known_kernel(representation, |kernel| kernel.bring_ahead(pages))
    }

    // Makes none: that would displace another dataset, whose viewers are at least as real.
    fn with_known_kernel<T: Default>(
        &self,
        representation: &Arc<dyn Representation>,
        work: impl FnOnce(&mut Box<dyn GpuKernel>) -> Result<T, RenderError>,
    ) -> Result<T, RenderError> {
        let Some(side) = &self.gpu else { return Ok(T::default()) };
        let mut tier = side.tier();
        let Some(mut resident) = tier.take_known(representation) else { return Ok(T::default()) };
        let outcome = work(&mut resident.kernel);
        tier.put_back(resident);
        outcome
    }

    /// Changes what all datasets together may hold on the device; what no longer fits leaves at once. Nothing without a GPU.
    pub fn set_gpu_budget(&self, budget_bytes: u64) {
        let Some(side) = &self.gpu else { return };
        side.tier().set_budget(budget_bytes);
    }

    /// The peaks of [`Self::gpu_stats`] and of its parts begin anew with what is held now. Nothing without a GPU.
    pub fn forget_gpu_peaks(&self) {
        let Some(side) = &self.gpu else { return };
        side.tier().forget_peaks();
    }

    /// Changes which pages leave the device when others need their place. Nothing without a GPU.
    pub fn set_gpu_policy(&self, policy: PolicyKind) {
        let Some(side) = &self.gpu else { return };
        side.tier().set_policy(policy);
    }

    /// For the bench that compares both.
    #[doc(hidden)]
    pub fn set_upload_unit(&self, unit: UploadUnit) {
        let Some(side) = &self.gpu else { return };
        side.tier().set_upload_unit(unit);
    }

    /// Which pages leave the device first; None without a GPU.
    pub fn gpu_policy(&self) -> Option<PolicyKind> {
        self.gpu.as_ref().map(|side| side.tier().policy())
    }

    /// Counters of the device's tier since the renderer was made, all of the same moment; None without a GPU.
    pub fn gpu_stats(&self) -> Option<GpuCacheStats> {
        self.gpu.as_ref().map(|side| side.tier().stats())
    }

    /// The same by dataset version, [`DatasetVersion::slot`](crate::textures::DatasetVersion::slot) ascending: every one that was ever on the
    /// device. Their sums are [`Self::gpu_stats`]; the budget is everyone's, and a peak is the version's own.
    pub fn gpu_stats_by_version(&self) -> Vec<(u32, GpuCacheStats)> {
        self.gpu.as_ref().map(|side| side.tier().stats_by_version().collect()).unwrap_or_default()
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

fn pending_frame(request: &FrameRequest<'_>, pixels: PendingPixels, stats: FrameStats) -> PendingFrame {
    let intrinsics = request.camera.intrinsics();
    PendingFrame { width_px: intrinsics.width_px, height_px: intrinsics.height_px, pixels, stats }
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}

#[cfg(all(test, feature = "gpu"))]
mod tests {
    use super::*;
    use crate::representations::offset_surface_light_field as oslf;
    use oslf::tests::fixture::WORLD;

    fn mirror() -> Settings {
        Settings::OffsetSurfaceLightField(oslf::Settings {
            component: oslf::Component::Mirror,
            blend: oslf::Blend::Distance,
            specular_reflectance: glam::Vec3::ONE,
            filter: oslf::Filter::Footprint,
            light: crate::scenes::Relighting::NONE,
            reflections: 1,
            bumps: None,
        })
    }

    #[test]
    fn a_dataset_without_room_on_the_device_is_tried_once_and_drawn_by_the_cpu() {
        if crate::gpu::test_gpu().is_none() {
            return;
        }
        let renderer = Renderer::with_gpu(1000).unwrap();
        let (field, pages) = WORLD.build();
        let camera = WORLD.camera(3.0 * glam::Vec3::Z, glam::Vec3::ZERO, 16, 12);
        let field: Arc<dyn Representation> = Arc::new(field);
        let settings = mirror();
        let outputs = Outputs { depth: false, provenance: false };
        let request = FrameRequest { camera: &camera, settings: &settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let refused = || renderer.gpu.as_ref().map_or(0, |side| side.tier().refused());
        for _ in 0..3 {
            let frame = renderer.render(&field, &pages, &request, Some(Backend::Gpu)).unwrap();
            assert!(frame.stats.backend == Backend::Cpu && frame.stats.fallback.is_some());
            assert_eq!(refused(), 1);
        }
        // With room it is tried again.
        renderer.set_gpu_budget(1 << 28);
        assert_eq!(renderer.render(&field, &pages, &request, Some(Backend::Gpu)).unwrap().stats.backend, Backend::Gpu);
    }

    #[test]
    fn a_device_that_is_lost_is_replaced_and_no_frame_is() {
        if crate::gpu::test_gpu().is_none() {
            return;
        }
        let renderer = Renderer::with_gpu(1 << 28).unwrap();
        let (field, pages) = WORLD.build();
        let camera = WORLD.camera(3.0 * glam::Vec3::Z, glam::Vec3::ZERO, 16, 12);
        let field: Arc<dyn Representation> = Arc::new(field);
        let settings = mirror();
        let outputs = Outputs { depth: false, provenance: false };
        let request = FrameRequest { camera: &camera, settings: &settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
        let frame = || renderer.render(&field, &pages, &request, None).unwrap();
        let before = frame();
        assert_eq!(before.stats.backend, Backend::Gpu);
        renderer.lose_device();
        // Whatever asks first hears of it.
        assert!(renderer.look_ahead(&field, &request, 1 << 20).is_err());
        let after = frame();
        assert_eq!((after.stats.backend, after.pixels.color == before.pixels.color), (Backend::Gpu, true));
        let asked = |frame: &Frame| frame.stats.page_use.hits + frame.stats.page_use.misses;
        assert!(asked(&after) > 0, "the pages are brought anew");
        assert_eq!((asked(&frame()), renderer.devices_replaced()), (0, 1));
    }

    #[test]
    fn a_frames_pixels_come_while_the_next_is_drawn_or_when_its_device_goes() {
        if crate::gpu::test_gpu().is_none() {
            return;
        }
        let renderer = Renderer::with_gpu(1 << 28).unwrap();
        let (field, pages) = WORLD.build();
        let field: Arc<dyn Representation> = Arc::new(field);
        let settings = mirror();
        let outputs = Outputs { depth: true, provenance: true };
        let cameras = [3.0, 4.0].map(|z| WORLD.camera(z * glam::Vec3::Z, glam::Vec3::ZERO, 16, 12));
        let [near, far] = cameras.each_ref().map(|camera| FrameRequest {
            camera,
            settings: &settings,
            outputs,
            refine: Refine::Whole,
            uploads: Uploads::NONE,
        });
        let whole = |request| renderer.render(&field, &pages, request, None).unwrap().pixels;
        let (expected_near, expected_far) = (whole(&near), whole(&far));
        assert_ne!(expected_near, expected_far);
        let draw = |request| renderer.draw(&field, &pages, request, None).unwrap();
        // Not for ever, where they do not come.
        let pixels = |frame: PendingFrame| {
            let (sender, here) = std::sync::mpsc::channel();
            std::thread::spawn(move || sender.send(frame.finish().map(|frame| frame.pixels)));
            here.recv_timeout(std::time::Duration::from_secs(60)).expect("they come").unwrap()
        };
        let (first, second, third) = (draw(&near), draw(&far), draw(&near));
        assert!(pixels(first) == expected_near && pixels(second) == expected_far);
        renderer.settle();
        assert!(pixels(third) == expected_near);
        let last = draw(&far);
        renderer.lose_device();
        assert!(pixels(last) == expected_far);
        let very_last = draw(&near);
        assert_eq!(renderer.devices_replaced(), 1);
        drop(renderer);
        assert!(pixels(very_last) == expected_near);
    }

    #[test]
    fn settings_of_another_kind_are_refused_by_name() {
        use crate::representations::parameter_map;
        let (field, field_pages) = WORLD.build();
        let (map, map_pages) = parameter_map::tests::fixture::WORLD.build(|_| None);
        let of_map = Settings::ParameterMap(parameter_map::Settings::default());
        let of_field = mirror();
        let camera = WORLD.camera(3.0 * glam::Vec3::Z, glam::Vec3::ZERO, 16, 12);
        let outputs = Outputs { depth: false, provenance: false };
        let refused = |dataset: Arc<dyn Representation>, pages: &dyn PageSource, settings: &Settings| {
            let request = FrameRequest { camera: &camera, settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
            Renderer::cpu_only().render(&dataset, pages, &request, Some(Backend::Cpu)).unwrap_err().to_string()
        };
        let expected = |kind: &str| format!("settings are of a {kind}, the dataset is of another kind");
        assert_eq!(refused(Arc::new(field), &field_pages, &of_map), expected("parameter_map"));
        assert_eq!(refused(Arc::new(map), &map_pages, &of_field), expected("offset_surface_light_field"));
    }
}
