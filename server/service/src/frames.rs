//! From a pose to an encoded frame: open the version, wait for the render thread, encode on a blocking thread.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use bytes::Bytes;
use lumisphere::geometry::Camera;
use lumisphere::images::{ExrStorage, Image, encode_exr_rgb, encode_jpeg, encode_png, tone_mapped};
use lumisphere::render::{Backend, Frame, FrameRequest, Outputs, Refine, RenderError, Renderer};
use lumisphere::textures::{Page, PageId};

use crate::api::blocking;
use crate::catalog::OpenedVersion;
use crate::config::BackendChoice;
use crate::errors::{ApiError, Reason};
use crate::frame_use::{AdapterUse, FramePages};
use crate::prefetch::Expected;
use crate::render_queue::{Priority, QueueError, RenderQueue, Rendered};
use crate::telemetry::Metrics;
use crate::wire::cache::GpuTier;
use crate::wire::frames::{EncodedFrame, cache_use};
use crate::wire::settings::{Encoding, Output, RenderSettings};
use crate::wire::{MAX_FRAME_MESSAGE_BYTES, proto};

/// zstd's level for raw planes: the fastest that still halves them.
const ZSTD_LEVEL: i32 = 1;
/// Of a frame's message, for everything but its images.
const MESSAGE_OVERHEAD_BYTES: usize = 64 << 10;

/// Renders frames, for viewers and for jobs.
#[derive(Clone)]
pub struct Frames {
    queue: RenderQueue<Renderer>,
    metrics: Arc<Metrics>,
    /// The adapter's tier as the last work on the render thread left it: asking does not wait for a frame.
    gpu: Arc<Mutex<Option<GpuTier>>>,
}

/// What one frame shows.
#[derive(Clone)]
pub struct FrameOrder {
    /// Of what.
    pub version: Arc<OpenedVersion>,
    /// From where.
    pub camera: Camera,
    /// What.
    pub settings: RenderSettings,
    /// What comes back.
    pub output: Output,
    /// What opening the version took, microseconds.
    pub opening_micros: u64,
    /// Whether it may be shown before all its pages are on the adapter.
    pub refine: Refine,
}

/// A frame and its account.
pub struct Drawn {
    /// The pixels themselves.
    pub frame: Frame,
    /// What computed them; None on the CPU.
    adapter: Option<String>,
    /// What the cache did for it.
    cache: proto::FrameCacheUse,
}

impl Frames {
    /// On this queue.
    pub fn new(queue: RenderQueue<Renderer>, metrics: Arc<Metrics>) -> Self {
        Self { queue, metrics, gpu: Arc::default() }
    }

    /// The adapter's tier of the texture cache after the last frame; None without an adapter.
    pub fn gpu_tier(&self) -> Option<GpuTier> {
        self.gpu.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Changes the adapter's tier, in its turn among the frames.
    pub async fn with_gpu_tier(&self, change: impl FnOnce(&Renderer) + Send + 'static) -> Result<(), ApiError> {
        let gpu = self.gpu.clone();
        let work = move |renderer: &mut Renderer| {
            change(renderer);
            note_gpu_tier(&gpu, renderer);
        };
        self.queue.run(Priority::Viewer, None, work).await.map_err(|e| self.refused(e))?;
        Ok(())
    }

    /// Which pages the expected frame would miss on the adapter, at most `upload_bytes` of texels; in its turn after all frames.
    pub async fn look_ahead(&self, expected: Expected, upload_bytes: u64) -> Result<Vec<PageId>, ApiError> {
        let work = move |renderer: &mut Renderer| {
            let outputs = Outputs { depth: false, provenance: false };
            let (camera, settings) = (&expected.camera, &expected.settings.settings);
            let request = FrameRequest { camera, settings, outputs, refine: Refine::Whole };
            renderer.look_ahead(&expected.version.representation, &request, upload_bytes)
        };
        Ok(self.queue.run_idle(work).await.map_err(|e| self.refused(e))??)
    }

    /// Hands pages to the adapter that no frame has asked for yet; how many found room. In its turn after all frames.
    pub async fn bring_ahead(&self, version: Arc<OpenedVersion>, pages: Vec<(PageId, Arc<Page>)>) -> Result<usize, ApiError> {
        let gpu = self.gpu.clone();
        let work = move |renderer: &mut Renderer| {
            let brought = renderer.bring_ahead(&version.representation, &pages);
            note_gpu_tier(&gpu, renderer);
            brought
        };
        Ok(self.queue.run_idle(work).await.map_err(|e| self.refused(e))??)
    }

    /// Renders waiting or in work.
    pub fn waiting(&self) -> usize {
        self.queue.waiting()
    }

    /// A frame as it goes over the wire. Dropping the future before rendering starts drops the work.
    pub async fn encoded(
        &self,
        order: FrameOrder,
        who: Priority,
        deadline: Option<tokio::time::Instant>,
    ) -> Result<EncodedFrame, ApiError> {
        Ok(self.encoded_late(move || (order, ()), who, deadline).await?.0)
    }

    /// The same of what is ordered when its turn comes, on the render thread; and what the orderer wants to remember of it.
    pub async fn encoded_late<T: Send + 'static>(
        &self,
        order: impl FnOnce() -> (FrameOrder, T) + Send + 'static,
        who: Priority,
        deadline: Option<tokio::time::Instant>,
    ) -> Result<(EncodedFrame, T), ApiError> {
        let order = move || {
            let (order, noted) = order();
            let told = (order.output, order.camera, order.opening_micros, noted);
            (order, told)
        };
        let (rendered, (output, camera, opening_micros, noted)) = self.draw(order, who, deadline).await?;
        let metrics = self.metrics.clone();
        let encoding = move || {
            let Rendered { value, queued, slot, admitted } = rendered;
            let encoded = encode(value, camera, output, opening_micros, queued.as_micros() as u64)?;
            drop((slot, admitted));
            observe(&metrics, &encoded.timings);
            Ok(encoded)
        };
        Ok((blocking(encoding).await?, noted))
    }

    /// The pixels, not encoded.
    pub async fn render(
        &self,
        order: FrameOrder,
        who: Priority,
        deadline: Option<tokio::time::Instant>,
    ) -> Result<Rendered<Drawn>, ApiError> {
        Ok(self.draw(move || (order, ()), who, deadline).await?.0)
    }

    async fn draw<T: Send + 'static>(
        &self,
        order: impl FnOnce() -> (FrameOrder, T) + Send + 'static,
        who: Priority,
        deadline: Option<tokio::time::Instant>,
    ) -> Result<(Rendered<Drawn>, T), ApiError> {
        let gpu = self.gpu.clone();
        let work = move |renderer: &mut Renderer| {
            let (order, noted) = order();
            let outputs = Outputs { depth: order.output.depth, provenance: order.output.provenance };
            let request = FrameRequest { camera: &order.camera, settings: &order.settings.settings, outputs, refine: order.refine };
            let backend = match order.settings.backend {
                BackendChoice::Auto => None,
                BackendChoice::Gpu => Some(Backend::Gpu),
                BackendChoice::Cpu => Some(Backend::Cpu),
            };
            let pages = FramePages::new(&order.version.pages);
            let before = renderer.gpu_stats().unwrap_or_default();
            let rendered = renderer.render(&order.version.representation, &pages, &request, backend);
            note_gpu_tier(&gpu, renderer);
            let frame = rendered?;
            let after = renderer.gpu_stats().unwrap_or_default();
            let adapter_use = frame.stats.gpu.map(|frame| AdapterUse { before, after, frame });
            let cache = cache_use(&pages.asked(), adapter_use.as_ref());
            let adapter = (frame.stats.backend == Backend::Gpu).then(|| renderer.adapter().unwrap_or_default().to_string());
            Ok::<_, RenderError>((Drawn { frame, adapter, cache }, noted))
        };
        let Rendered { value, queued, slot, admitted } = self.queue.run(who, deadline, work).await.map_err(|e| self.refused(e))?;
        let (value, noted) = value?;
        Ok((Rendered { value, queued, slot, admitted }, noted))
    }

    fn refused(&self, error: QueueError) -> ApiError {
        let reason = match &error {
            QueueError::Full { .. } => {
                self.metrics.renders_refused.inc();
                Reason::RenderQueueFull
            }
            QueueError::DeadlineExceeded => Reason::DeadlineExceeded,
            QueueError::Stopped => Reason::ShuttingDown,
            QueueError::Panicked(message) => return ApiError::internal(format!("rendering panicked: {message}")),
        };
        ApiError::new(reason, error.to_string())
    }
}

fn note_gpu_tier(place: &Mutex<Option<GpuTier>>, renderer: &Renderer) {
    let versions = renderer.gpu_stats_by_version();
    let tier = renderer.gpu_stats().zip(renderer.gpu_policy()).map(|(stats, policy)| GpuTier { stats, versions, policy });
    *place.lock().unwrap_or_else(PoisonError::into_inner) = tier;
}

/// The colour of a frame as an image.
pub fn color_image(frame: &Frame) -> Image {
    let (width, height) = (frame.width_px as usize, frame.height_px as usize);
    let mut image = Image::zeros(width, height, 3);
    let [red, green, blue] = &mut image.planes[..] else { unreachable!("three planes were asked for") };
    for (((pixel, r), g), b) in frame.pixels.color.as_chunks::<3>().0.iter().zip(red).zip(green).zip(blue) {
        [*r, *g, *b] = *pixel;
    }
    image
}

fn observe(metrics: &Metrics, timings: &proto::FrameTimings) {
    metrics.frames.inc();
    metrics.frame_stage("queue", timings.queue_micros);
    metrics.frame_stage("pages", timings.pages_micros);
    metrics.frame_stage("render", timings.render_micros);
    metrics.frame_stage("encode", timings.encode_micros);
}

fn encode(drawn: Drawn, camera: Camera, output: Output, opening_micros: u64, queue_micros: u64) -> Result<EncodedFrame, ApiError> {
    let Drawn { frame, adapter, cache } = drawn;
    let begun = Instant::now();
    let color = encode_color(&frame, output.encoding)?;
    let depth = frame.pixels.depth.as_deref().map_or(Ok(Bytes::new()), |d| compressed(d.iter().map(|v| v.to_le_bytes())))?;
    let provenance = frame.pixels.provenance.as_deref();
    let provenance = provenance.map_or(Ok(Bytes::new()), |p| compressed(p.iter().map(|v| v.bits().to_le_bytes())))?;
    let bytes = color.len() + depth.len() + provenance.len();
    if bytes > MAX_FRAME_MESSAGE_BYTES - MESSAGE_OVERHEAD_BYTES {
        let message = format!(
            "the encoded frame has {bytes} bytes, its message at most {MAX_FRAME_MESSAGE_BYTES}: ask for fewer pixels or another encoding"
        );
        return Err(ApiError::new(Reason::FrameTooLarge, message));
    }
    let stats = &frame.stats;
    let prepare_micros = (1e3 * stats.prepare_millis) as u64;
    Ok(EncodedFrame {
        camera,
        encoding: output.encoding,
        color,
        depth,
        provenance,
        timings: proto::FrameTimings {
            queue_micros,
            pages_micros: opening_micros + prepare_micros,
            render_micros: ((1e3 * stats.total_millis) as u64).saturating_sub(prepare_micros),
            encode_micros: begun.elapsed().as_micros() as u64,
        },
        cache,
        adapter,
        is_final: frame.pixels.is_final,
    })
}

fn encode_color(frame: &Frame, encoding: Encoding) -> Result<Bytes, ApiError> {
    let failed = |e: lumisphere::images::ImageError| ApiError::internal(format!("cannot encode a frame: {e}"));
    let encoded = match encoding {
        Encoding::RawZstd => return compressed(frame.pixels.color.iter().map(|v| v.to_le_bytes())),
        Encoding::Exr => encode_exr_rgb(&color_image(frame), ExrStorage::Float),
        Encoding::Png { tone_map } => tone_mapped(&color_image(frame), tone_map).and_then(|i| encode_png(&i)),
        Encoding::Jpeg { quality, tone_map } => tone_mapped(&color_image(frame), tone_map).and_then(|i| encode_jpeg(&i, quality)),
    };
    Ok(encoded.map_err(failed)?.into())
}

/// One zstd frame of little-endian words.
fn compressed(words: impl ExactSizeIterator<Item = [u8; 4]>) -> Result<Bytes, ApiError> {
    let mut bytes = Vec::with_capacity(4 * words.len());
    words.for_each(|word| bytes.extend_from_slice(&word));
    let packed = zstd::bulk::compress(&bytes, ZSTD_LEVEL).map_err(|e| ApiError::internal(format!("cannot compress a frame: {e}")))?;
    Ok(packed.into())
}
