//! From a pose to an encoded frame: open the version, wait for the render thread, encode on a blocking thread. What is a mean of several passes
//! waits for each of them (`still`). Ground truth waits for a thread of its own.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use lumisphere::geometry::Camera;
use lumisphere::images::{
    ExrStorage, Image, ImageError, Rgb8, ToneMap, encode_exr_rgb, encode_jpeg_pixels, encode_png, tone_mapped_pixels,
};
use lumisphere::render::{Backend, Frame, FrameRequest, Outputs, PendingFrame, Refine, Renderer};
use lumisphere::textures::{Page, PageId};
use tokio::sync::OwnedSemaphorePermit;

use crate::api::{begin_blocking, blocking};
use crate::catalog::OpenedVersion;
use crate::config::BackendChoice;
use crate::errors::{ApiError, Reason};
use crate::frame_use::{AdapterUse, FramePages};
use crate::ground_truth::{Abandoned, Tracers};
use crate::looks::HeldLooks;
use crate::prefetch::Expected;
use crate::render_queue::{Idle, Priority, QueueError, RenderQueue, Rendered, Slot};
use crate::still::{Held, Rooms, Still};
use crate::telemetry::Metrics;
use crate::video::Video;
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
    /// Of ground truth: with slots and places of its own.
    truths: RenderQueue<Tracers>,
    metrics: Arc<Metrics>,
    rooms: Rooms,
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
    /// Of a still: those that the settings ask for; 1 for a frame that is not refined.
    pub passes: u32,
    /// Which it goes on with, where its encoding is H.264.
    pub video: Option<VideoStream>,
}

/// A frame's colour.
#[derive(Debug)]
pub struct Encoded {
    /// As the encoding says.
    pub bytes: Vec<u8>,
    /// Whether it can be decoded without the frames before.
    pub is_key: bool,
    /// In its stream, from 1; 0 for what is none.
    pub number: u64,
}

/// Of one viewer, one frame after the other.
pub type VideoStream = Arc<Mutex<Video>>;

/// Who waits for a frame, and how long.
#[derive(Debug, Clone, Copy)]
pub struct Caller {
    /// In the line.
    pub who: Priority,
    /// Work that has not begun by then is not begun.
    pub deadline: Option<tokio::time::Instant>,
}

/// Whose turn it takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Painter {
    Renderer,
    Tracers,
}

/// A painter at work.
enum Brush<'a> {
    Renderer(&'a Renderer),
    Tracers(&'a mut Tracers, &'a Abandoned),
}

/// The first pass of a viewer's frame, to be encoded.
pub struct DrawnLate {
    order: FrameOrder,
    drawn: Drawn,
    queued: Duration,
    slot: Slot,
    admitted: OwnedSemaphorePermit,
}

/// What became of an order that was taken up late.
struct Late<T> {
    order: FrameOrder,
    noted: T,
    /// None: meanwhile it is another painter's.
    drawn: Option<Drawn>,
}

/// Tells that the caller has gone.
struct Caring(Arc<Abandoned>);

impl Drop for Caring {
    fn drop(&mut self) {
        self.0.set();
    }
}

/// A pass that is drawn, and its account; its pixels may still be on their way.
struct Drawn {
    frame: PendingFrame,
    adapter: Option<String>,
    cache: proto::FrameCacheUse,
}

/// A pass and its account.
pub struct Pass {
    /// The pixels themselves.
    pub frame: Frame,
    /// What computed them; None on the CPU.
    pub adapter: Option<String>,
    /// What the cache did for it.
    pub cache: proto::FrameCacheUse,
}

impl Drawn {
    /// Blocks until its pixels are here.
    fn finish(self) -> Result<Pass, ApiError> {
        let Self { frame, adapter, cache } = self;
        Ok(Pass { frame: frame.finish()?, adapter, cache })
    }
}

impl DrawnLate {
    /// Whether nothing stood in for missing pages.
    pub fn all_pages(&self) -> bool {
        self.drawn.frame.is_final()
    }

    /// What it will be encoded in.
    pub fn encoding(&self) -> Encoding {
        encoding_of(&self.order.output, self.all_pages() && self.order.passes <= 1)
    }

    /// What the adapter's cache did for it.
    pub fn adapter_use(&self) -> proto::AdapterCacheUse {
        self.drawn.cache.adapter.unwrap_or_default()
    }
}

impl Frames {
    /// On these queues: of what is stored, and of ground truth.
    pub fn new(queue: RenderQueue<Renderer>, truths: RenderQueue<Tracers>, metrics: Arc<Metrics>) -> Self {
        Self { queue, truths, rooms: Rooms::new(metrics.clone()), metrics, gpu: Arc::default() }
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
            // Without a file that cannot be read nothing is seen; the frame will tell.
            let held = expected.version.looks.of(settings).unwrap_or(HeldLooks::NONE);
            let request = FrameRequest { camera, settings, outputs, refine: Refine::Whole, uploads: held.uploads() };
            renderer.look_ahead(&expected.version.representation, &request, upload_bytes)
        };
        Ok(self.queue.run_idle(Idle::Ahead, work).await.map_err(|e| self.refused(e))??)
    }

    /// Hands pages to the adapter that no frame has asked for yet; how many found room. In its turn after all frames.
    pub async fn bring_ahead(&self, version: Arc<OpenedVersion>, pages: Vec<(PageId, Arc<Page>)>) -> Result<usize, ApiError> {
        let gpu = self.gpu.clone();
        let work = move |renderer: &mut Renderer| {
            let brought = renderer.bring_ahead(&version.representation, &pages);
            note_gpu_tier(&gpu, renderer);
            brought
        };
        Ok(self.queue.run_idle(Idle::Ahead, work).await.map_err(|e| self.refused(e))??)
    }

    /// Renders waiting or in work.
    pub fn waiting(&self) -> usize {
        self.queue.waiting() + self.truths.waiting()
    }

    /// A frame as it goes over the wire, all its passes. Dropping the future before one starts drops it and all further ones.
    pub async fn encoded(&self, order: FrameOrder, caller: Caller) -> Result<EncodedFrame, ApiError> {
        let mut still = self.first_pass(order, caller).await?;
        while !still.is_done() {
            still = self.next_pass(still, caller).await?;
        }
        Ok(self.encoded_still(still).await?.0)
    }

    /// One pass of what is ordered when its turn comes, which most likely has the `expected` settings, drawn; and what the orderer wants to
    /// remember of it.
    pub async fn drawn_late<T: Send + 'static>(
        &self,
        order: impl FnOnce() -> (FrameOrder, T) + Send + 'static,
        expected: &RenderSettings,
        who: Priority,
    ) -> Result<(DrawnLate, T), ApiError> {
        let mut painter = Painter::of(expected);
        let mut order: Box<dyn FnOnce() -> (FrameOrder, T) + Send> = Box::new(order);
        loop {
            let gpu = self.gpu.clone();
            let work = move |brush: Brush<'_>| {
                let (order, noted) = order();
                let is_mine = Painter::of(&order.settings) == painter;
                let drawn = is_mine.then(|| draw(brush, &gpu, &order, 0)).transpose()?;
                Ok::<_, ApiError>(Late { order, noted, drawn })
            };
            let Rendered { value, queued, slot, admitted } = self.turn(painter, self.admit(painter)?, who, None, work).await?;
            match value? {
                Late { order, noted, drawn: Some(drawn) } => return Ok((DrawnLate { order, drawn, queued, slot, admitted }, noted)),
                // As it is now: it changes no more while it waits for the other.
                Late { order: again, noted, drawn: None } => {
                    (painter, order) = (Painter::of(&again.settings), Box::new(move || (again, noted)));
                }
            }
        }
    }

    /// Begins at once: its frame, and the still that it begins, where more passes are ordered, nothing stood in for missing pages and there
    /// is room.
    pub fn encoded_late(&self, drawn: DrawnLate) -> impl Future<Output = Result<(EncodedFrame, Option<Still>), ApiError>> + Send + 'static {
        let (metrics, rooms) = (self.metrics.clone(), self.rooms.clone());
        begin_blocking(move || {
            let DrawnLate { order, drawn, queued, slot, admitted } = drawn;
            let mut still = Still::begin(order, drawn.finish()?, queued, Held::by_call(admitted, slot, None));
            let encoded = encode(&mut still, &metrics)?;
            let goes_on = !still.is_done() && still.pixels().is_final;
            let room = goes_on.then(|| rooms.of_viewer_now(&still.order)).flatten();
            still.held = Held::by_viewer(room);
            Ok((encoded, still.held.room.is_some().then_some(still)))
        })
    }

    /// The first pass of a still, which waits for room if it is one of several.
    pub async fn first_pass(&self, order: FrameOrder, caller: Caller) -> Result<Still, ApiError> {
        // Room first: who waits for it takes no place in the queue from those who need none.
        let room = match order.passes {
            1 => None,
            _ => Some(self.rooms.of_call(&order, caller).await?),
        };
        let painter = Painter::of(&order.settings);
        let (admitted, work) = (self.admit(painter)?, self.pass(order.clone(), 0));
        let Rendered { value, queued, slot, admitted } = self.turn(painter, admitted, caller.who, caller.deadline, work).await?;
        let drawn = value?;
        blocking(move || Ok(Still::begin(order, drawn.finish()?, queued, Held::by_call(admitted, slot, room)))).await
    }

    /// The next pass of that still, in the place that it has.
    pub async fn next_pass(&self, mut still: Still, caller: Caller) -> Result<Still, ApiError> {
        let painter = Painter::of(&still.order.settings);
        let admitted = match still.held.admitted.take() {
            Some(admitted) => admitted,
            None => self.admit(painter)?,
        };
        let work = self.pass(still.order.clone(), still.passes());
        let Rendered { value, queued, slot, admitted } = self.turn(painter, admitted, caller.who, caller.deadline, work).await?;
        let drawn = value?;
        blocking(move || {
            let pass = drawn.finish()?;
            still.add(&pass, queued);
            still.held.admitted = Some(admitted);
            drop((pass, slot));
            Ok(still)
        })
        .await
    }

    /// One more pass for a viewer at rest, after everyone else: of that still, or the first of a new one once there is room. A pass for which
    /// pages are still missing brings some of them and is not added; None where that was the first.
    pub async fn refined(&self, still: Option<Still>, order: FrameOrder) -> Result<Option<Still>, ApiError> {
        let room = match &still {
            Some(_) => None,
            None => Some(self.rooms.of_viewer(&order).await),
        };
        let (work, called) = (self.pass(order.clone(), still.as_ref().map_or(0, Still::passes)), Instant::now());
        let drawn = self.idle_turn(Painter::of(&order.settings), work).await??;
        let queued = called.elapsed().saturating_sub(Duration::from_secs_f64(1e-3 * drawn.frame.stats().total_millis));
        blocking(move || {
            let pass = drawn.finish()?;
            Ok(match still {
                Some(mut still) if pass.frame.pixels.is_final => {
                    still.add(&pass, queued);
                    Some(still)
                }
                Some(mut still) => {
                    still.note(&pass, queued);
                    Some(still)
                }
                None if pass.frame.pixels.is_final => Some(Still::begin(order, pass, queued, Held::by_viewer(room))),
                None => None,
            })
        })
        .await
    }

    /// The passes so far as they go over the wire.
    pub async fn encoded_still(&self, mut still: Still) -> Result<(EncodedFrame, Still), ApiError> {
        let metrics = self.metrics.clone();
        blocking(move || Ok((encode(&mut still, &metrics)?, still))).await
    }

    fn pass(&self, order: FrameOrder, pass: u32) -> impl FnOnce(Brush<'_>) -> Result<Drawn, ApiError> + Send + 'static {
        let gpu = self.gpu.clone();
        move |brush| draw(brush, &gpu, &order, pass)
    }

    fn admit(&self, painter: Painter) -> Result<OwnedSemaphorePermit, ApiError> {
        let admitted = match painter {
            Painter::Renderer => self.queue.admit(),
            Painter::Tracers => self.truths.admit(),
        };
        admitted.map_err(|e| self.refused(e))
    }

    /// Work in that painter's turn. A pass of paths is given up with the future that waits for it.
    async fn turn<T: Send + 'static>(
        &self,
        painter: Painter,
        admitted: OwnedSemaphorePermit,
        who: Priority,
        deadline: Option<tokio::time::Instant>,
        work: impl FnOnce(Brush<'_>) -> T + Send + 'static,
    ) -> Result<Rendered<T>, ApiError> {
        let abandoned = Arc::new(Abandoned::default());
        let _caring = Caring(abandoned.clone());
        let rendered = match painter {
            Painter::Renderer => self.queue.run_admitted(admitted, who, deadline, |r| work(Brush::Renderer(r))).await,
            Painter::Tracers => self.truths.run_admitted(admitted, who, deadline, move |t| work(Brush::Tracers(t, &abandoned))).await,
        };
        rendered.map_err(|e| self.refused(e))
    }

    /// The same after everyone who waits for that painter.
    async fn idle_turn<T: Send + 'static>(
        &self,
        painter: Painter,
        work: impl FnOnce(Brush<'_>) -> T + Send + 'static,
    ) -> Result<T, ApiError> {
        let abandoned = Arc::new(Abandoned::default());
        let _caring = Caring(abandoned.clone());
        let done = match painter {
            Painter::Renderer => self.queue.run_idle(Idle::Refine, |r| work(Brush::Renderer(r))).await,
            Painter::Tracers => self.truths.run_idle(Idle::Refine, move |t| work(Brush::Tracers(t, &abandoned))).await,
        };
        done.map_err(|e| self.refused(e))
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

impl Painter {
    fn of(settings: &RenderSettings) -> Self {
        match settings.ground_truth {
            None => Self::Renderer,
            Some(_) => Self::Tracers,
        }
    }
}

/// One pass of what is ordered; on the painter's thread.
fn draw(brush: Brush<'_>, gpu: &Mutex<Option<GpuTier>>, order: &FrameOrder, pass: u32) -> Result<Drawn, ApiError> {
    match (brush, order.settings.ground_truth) {
        (Brush::Renderer(renderer), None) => render(renderer, gpu, order, pass),
        (Brush::Tracers(tracers, abandoned), Some(truth)) => {
            let frame = tracers.trace(order, truth, pass, abandoned)?;
            Ok(Drawn { frame: frame.into(), adapter: None, cache: proto::FrameCacheUse::default() })
        }
        (Brush::Renderer(_), Some(_)) | (Brush::Tracers(..), None) => Err(ApiError::internal("a frame in another painter's turn")),
    }
}

/// Renders it.
fn render(renderer: &Renderer, gpu: &Mutex<Option<GpuTier>>, order: &FrameOrder, pass: u32) -> Result<Drawn, ApiError> {
    let outputs = Outputs { depth: order.output.depth.is_some(), provenance: order.output.provenance };
    let settings = order.settings.settings;
    let settings = settings.of_pass(pass).unwrap_or(settings);
    let held = order.version.looks.of(&settings)?;
    let request = FrameRequest { camera: &order.camera, settings: &settings, outputs, refine: order.refine, uploads: held.uploads() };
    let backend = match order.settings.backend {
        BackendChoice::Auto => None,
        BackendChoice::Gpu => Some(Backend::Gpu),
        BackendChoice::Cpu => Some(Backend::Cpu),
    };
    let pages = FramePages::new(&order.version.pages);
    let (before, replaced) = (renderer.gpu_stats().unwrap_or_default(), renderer.devices_replaced());
    let rendered = renderer.draw(&order.version.representation, &pages, &request, backend);
    note_gpu_tier(gpu, renderer);
    let frame = rendered?;
    if renderer.devices_replaced() > replaced {
        tracing::warn!(adapter = renderer.adapter(), "the graphics device was lost; another was opened");
    }
    if let Some(reason) = &frame.stats().fallback {
        tracing::debug!(dataset = order.version.dataset, reason, "the CPU stands in for the GPU");
    }
    let after = renderer.gpu_stats().unwrap_or_default();
    let adapter_use = frame.stats().gpu.map(|frame| AdapterUse { before, after, frame });
    let cache = cache_use(&pages.asked(), adapter_use.as_ref());
    let adapter = (frame.stats().backend == Backend::Gpu).then(|| renderer.adapter().unwrap_or_default());
    Ok(Drawn { frame, adapter, cache })
}

fn note_gpu_tier(place: &Mutex<Option<GpuTier>>, renderer: &Renderer) {
    let versions = renderer.gpu_stats_by_version();
    let tier = renderer.gpu_stats().zip(renderer.gpu_policy()).map(|(stats, policy)| GpuTier { stats, versions, policy });
    *place.lock().unwrap_or_else(PoisonError::into_inner) = tier;
}

/// The colour of a still as an image.
pub fn color_image(still: &Still) -> Image {
    let intrinsics = still.order.camera.intrinsics();
    let mut image = Image::zeros(intrinsics.width_px as usize, intrinsics.height_px as usize, 3);
    let [red, green, blue] = &mut image.planes[..] else { unreachable!("three planes were asked for") };
    for (((pixel, r), g), b) in still.pixels().color.as_chunks::<3>().0.iter().zip(red).zip(green).zip(blue) {
        [*r, *g, *b] = *pixel;
    }
    image
}

/// The colour of a still as a screen shows it.
fn color_codes(still: &Still, tone_map: ToneMap) -> Result<Rgb8, ImageError> {
    tone_mapped_pixels(still.pixels().color.as_chunks().0, width_of(still), tone_map)
}

fn width_of(still: &Still) -> usize {
    still.order.camera.intrinsics().width_px as usize
}

fn observe(metrics: &Metrics, timings: &proto::FrameTimings) {
    metrics.frames.inc();
    metrics.frame_stage("queue", timings.queue_micros);
    metrics.frame_stage("pages", timings.pages_micros);
    metrics.frame_stage("render", timings.render_micros);
    metrics.frame_stage("encode", timings.encode_micros);
}

fn encoding_of(output: &Output, is_final: bool) -> Encoding {
    output.encoding_at_rest.filter(|_| is_final).unwrap_or(output.encoding)
}

fn encode(still: &mut Still, metrics: &Metrics) -> Result<EncodedFrame, ApiError> {
    let begun = Instant::now();
    let (pixels, output) = (still.pixels(), still.order.output);
    let is_final = pixels.is_final && still.is_done();
    let encoding = encoding_of(&output, is_final);
    let Encoded { bytes, is_key, number } = encode_color(still, encoding)?;
    let color = Bytes::from(bytes);
    let width = still.order.camera.intrinsics().width_px;
    let depth = output.depth.zip(pixels.depth.as_deref()).map(|(plane, distances)| plane.encode(distances, width));
    let depth = depth.transpose()?.unwrap_or_default();
    let provenance = pixels.provenance.as_deref();
    let provenance = provenance.map_or(Ok(Vec::new()), |p| compressed(p.iter().map(|v| v.bits().to_le_bytes())))?;
    let bytes = color.len() + depth.bytes.len() + provenance.len();
    if bytes > MAX_FRAME_MESSAGE_BYTES - MESSAGE_OVERHEAD_BYTES {
        let message = format!(
            "the encoded frame has {bytes} bytes, its message at most {MAX_FRAME_MESSAGE_BYTES}: ask for fewer pixels or another encoding"
        );
        return Err(ApiError::new(Reason::FrameTooLarge, message));
    }
    let (timings, cache) = still.take_account();
    let timings = proto::FrameTimings { encode_micros: begun.elapsed().as_micros() as u64, ..timings };
    observe(metrics, &timings);
    Ok(EncodedFrame {
        camera: still.order.camera,
        encoding,
        color,
        depth,
        provenance: provenance.into(),
        timings,
        cache,
        adapter: still.adapter.clone(),
        is_final,
        passes_done: still.passes(),
        gloss: still.order.settings.settings.gloss().filter(|_| still.order.settings.ground_truth.is_none()),
        is_key,
        stream_number: number,
    })
}

/// Every image is a key but those of H.264 that say what has changed.
fn encode_color(still: &Still, encoding: Encoding) -> Result<Encoded, ApiError> {
    let failed = |e: ImageError| ApiError::internal(format!("cannot encode a frame: {e}"));
    let encoded = match encoding {
        Encoding::RawZstd => {
            return Ok(Encoded { bytes: compressed(still.pixels().color.iter().map(|v| v.to_le_bytes()))?, is_key: true, number: 0 });
        }
        Encoding::Exr => encode_exr_rgb(&color_image(still), ExrStorage::Float),
        Encoding::Png { tone_map } => color_codes(still, tone_map).and_then(|i| encode_png(&i)),
        Encoding::Jpeg { quality, tone_map } => encode_jpeg_pixels(still.pixels().color.as_chunks().0, width_of(still), tone_map, quality),
        Encoding::H264 { quality, tone_map } => {
            let image = color_codes(still, tone_map).map_err(failed)?;
            let video = still.order.video.as_ref().ok_or_else(|| ApiError::internal("a frame of a stream without the stream"))?;
            return video.lock().unwrap_or_else(PoisonError::into_inner).encode(&image, quality);
        }
    };
    Ok(Encoded { bytes: encoded.map_err(failed)?, is_key: true, number: 0 })
}

/// One zstd frame of little-endian words.
pub fn compressed<const N: usize>(words: impl ExactSizeIterator<Item = [u8; N]>) -> Result<Vec<u8>, ApiError> {
    let mut bytes = Vec::with_capacity(N * words.len());
    words.for_each(|word| bytes.extend_from_slice(&word));
    zstd::bulk::compress(&bytes, ZSTD_LEVEL).map_err(|e| ApiError::internal(format!("cannot compress a frame: {e}")))
}
