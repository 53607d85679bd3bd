//! What viewers get of a live server, through `Interact`, beside what the server says that rendering and encoding took.
//!
//! `cargo build --release --workspace --bins && cargo bench -p lumisphere-tests --bench viewers`; parts after `--` run only these:
//! - `motion`: from a pose to its decoded frame, 640 × 480, mirror reflection, JPEG, one credit: median within 10 ms of the server's own
//!   time, 99 % within twice the median.
//! - `delivery`: the same less the rendering, frames a second with two credits, and the server's memory while a viewer sends poses and reads
//!   nothing: to be held beside `docs/rivals/viser_frames.py`, whose frames are rendered beforehand.
//! - `fairness`: eight viewers beside one: Jain's index at least .95, all together at least .9 of one's frames.
//! - `alone`: frames a second with two credits beside those of the renderer alone in this process, in turn: at least .95.
//! - `link`: the same frames through a proxy of 5 Mbit/s and 100 ms there and back: what a frame waits for others, 95 %, at most its own
//!   time on the link; at least .8 of the link is used.
//! - `rate`: 30 frames a second of 640 × 480 asked for, over links of 1000, 20, 5 and 2 Mbit/s: frames are made smaller until they come so fast.
//! - `bulk`: what a download over the same link, of the same connection and of another, leaves of the frames: at least .4 of their rate alone.
//! - `idle`: what 32 viewers at rest cost: at most a hundredth of a core.
//! - `soak`: 200 sessions of small frames, one in ten mute, for `SOAK_SECONDS` (600): memory grows by at most 1 MB a minute, nobody
//!   starves, the mute ones are ended.

// Most of the tests' helpers are not needed here.
#[allow(dead_code)]
#[path = "../../it/process.rs"]
mod process;

mod alone;
mod link;
mod soak;

use std::time::{Duration, Instant};

use lumisphere::images::{ReadLimits, decode_image_codes};
use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::Channel;
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::{Blend, Component};
use wire::rendering_client::RenderingClient;

use process::{Server, temporary_folder};

const DATASET: &str = "teapot";
const WARM_UP: usize = 8;
const RUNS: usize = 101;
/// Of `fairness` and `link`.
const SECONDS: Duration = Duration::from_secs(15);
/// Between two poses of one who moves: a screen's.
const POSE: Duration = Duration::from_millis(16);
/// Of a viewer that reads nothing: shorter than the server's patience with it.
const STALL: Duration = Duration::from_secs(45);
/// Coarse: what is measured does not depend on the texels.
const CAPTURE: &str = "job submit capture --scene gazebo --object teapot --points 100 --face-size-texels 64 --samples-per-texel 1 \
                       --max-bounces 1 --dataset teapot --watch --quiet";

fn main() {
    let parts: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with("--")).collect();
    let wants = |part: &str| parts.is_empty() || parts.iter().any(|wanted| wanted == part);
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start_with(&data, &["--max-sessions", "256"]);
    server.succeed(&CAPTURE.split_whitespace().collect::<Vec<_>>());
    runtime.block_on(async {
        let stand = Stand::find(&server).await;
        if wants("motion") {
            motion(&server, &stand).await;
        }
        if wants("delivery") {
            delivery(&server, &stand).await;
        }
        if wants("fairness") {
            fairness(&server, &stand).await;
        }
        if wants("alone") {
            alone::alone(&server, &data, &stand).await;
        }
        if wants("link") {
            link::link(&server, &stand).await;
        }
        if wants("rate") {
            link::rate(&server, &stand).await;
        }
        if wants("bulk") {
            link::bulk(&server, &stand).await;
        }
        if wants("idle") {
            idle(&server, &stand).await;
        }
        if wants("soak") {
            soak::soak(&server, &stand).await;
        }
    });
}

fn bound(what: &str, value: f64, bound: f64, is_met: bool) {
    println!("  {what}: {value:.3}, bound {bound}: {}", if is_met { "met" } else { "MISSED" });
}

/// The captured object.
#[derive(Debug, Clone, Copy)]
struct Stand {
    middle: [f32; 3],
    radius: f32,
}

impl Stand {
    async fn find(server: &Server) -> Self {
        let dataset = server.datasets().await.get_dataset(wire::GetDatasetRequest { name: DATASET.into() }).await;
        let bounds = dataset.expect("it was captured").into_inner().versions[0].object_bounds.expect("this kind has bounds");
        let (min, max) = (bounds.min.expect("a corner"), bounds.max.expect("a corner"));
        let (min, max) = ([min.x, min.y, min.z], [max.x, max.y, max.z]);
        let middle = std::array::from_fn(|k| 0.5 * (min[k] + max[k]));
        let radius = 0.5 * (0..3).map(|k| (max[k] - min[k]).powi(2)).sum::<f32>().sqrt();
        Self { middle, radius }
    }

    /// Three and a half radii from its middle, half a degree further round at each step.
    fn camera(&self, step: u64, (width_px, height_px): (u32, u32)) -> wire::Camera {
        let (sin, cos) = (step as f32 * 0.5).to_radians().sin_cos();
        let [x, y, z] = self.middle;
        let away = 3.5 * self.radius;
        let vector = |x, y, z| Some(wire::Vector3 { x, y, z });
        let pose = wire::Pose {
            position: vector(x + sin * away, y, z + cos * away),
            right: vector(cos, 0.0, -sin),
            up: vector(0.0, 1.0, 0.0),
            backward: vector(sin, 0.0, cos),
        };
        let focal_x_px = 1.375 * height_px as f32;
        let intrinsics = wire::Intrinsics { width_px, height_px, focal_x_px, ..Default::default() };
        wire::Camera { pose: Some(pose), intrinsics: Some(intrinsics) }
    }
}

/// One interaction.
struct Viewer {
    up: mpsc::Sender<wire::InteractRequest>,
    down: Streaming<wire::InteractResponse>,
    stand: Stand,
    size: (u32, u32),
    steps: u64,
}

impl Viewer {
    /// Every frame of full size.
    async fn open(client: RenderingClient<Channel>, stand: Stand, size: (u32, u32), credits: u32) -> Self {
        Self::open_at(client, stand, size, credits, 0.0).await
    }

    /// So many frames a second in motion.
    async fn open_at(mut client: RenderingClient<Channel>, stand: Stand, size: (u32, u32), credits: u32, rate: f32) -> Self {
        let settings = wire::OffsetSurfaceLightFieldSettings {
            component: Component::Mirror.into(),
            blend: Blend::Normal.into(),
            ..Default::default()
        };
        let open = wire::OpenInteraction {
            dataset: DATASET.into(),
            settings: Some(wire::RenderSettings {
                representation: Some(wire::render_settings::Representation::OffsetSurfaceLightField(settings)),
                ..Default::default()
            }),
            output: Some(wire::OutputSettings { encoding: wire::Encoding::Jpeg.into(), ..Default::default() }),
            credits,
            moving_frames_per_second: Some(rate),
            ..Default::default()
        };
        let (up, messages) = mpsc::channel(64);
        let _ = up.send(wire::InteractRequest { message: Some(Up::Open(open)) }).await;
        let down = client.interact(ReceiverStream::new(messages)).await.expect("an interaction").into_inner();
        Self { up, down, stand, size, steps: 0 }
    }

    async fn send(&self, message: Up) {
        let _ = self.up.send(wire::InteractRequest { message: Some(message) }).await;
    }

    async fn step(&mut self) {
        self.steps += 1;
        let camera = Some(self.stand.camera(self.steps, self.size));
        self.send(Up::Pose(wire::PoseUpdate { pose_id: self.steps, camera })).await;
    }

    /// None once the server has ended it.
    async fn frame(&mut self) -> Option<wire::Frame> {
        loop {
            match self.down.message().await.ok()??.message? {
                Down::Frame(frame) => {
                    self.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: frame.frame_id })).await;
                    return Some(frame);
                }
                Down::Opened(_) => {}
                Down::Status(status) => panic!("{status:?}"),
            }
        }
    }

    /// A pose every 16 ms, as from a screen, for so long; frames a second.
    async fn follow(mut self, time: Duration, see: impl Fn(&wire::Frame)) -> f64 {
        let (begun, mut frames, mut poses) = (Instant::now(), 0.0, tokio::time::interval(POSE));
        while begun.elapsed() < time {
            tokio::select! {
                _ = poses.tick() => self.step().await,
                frame = self.down.message() => {
                    let Some(Down::Frame(frame)) = frame.expect("a frame").and_then(|response| response.message) else { continue };
                    self.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: frame.frame_id })).await;
                    see(&frame);
                    frames += 1.0;
                }
            }
        }
        frames / begun.elapsed().as_secs_f64()
    }

    /// Always moving, for so long; how many frames a second, decoded.
    async fn walk(mut self, seconds: Duration) -> f64 {
        let begun = Instant::now();
        let mut frames = 0.0;
        self.step().await;
        self.step().await;
        while begun.elapsed() < seconds
            && let Some(frame) = self.frame().await
        {
            self.step().await;
            decode_image_codes(&frame.color, ReadLimits::SCENE).expect("a picture");
            frames += 1.0;
        }
        frames / begun.elapsed().as_secs_f64()
    }
}

fn own_millis(frame: &wire::Frame) -> f64 {
    let t = frame.timings.expect("every frame has timings");
    1e-3 * (t.queue_micros + t.pages_micros + t.render_micros + t.encode_micros) as f64
}

fn quantile(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * part).round() as usize]
}

async fn motion(server: &Server, stand: &Stand) {
    let mut viewer = Viewer::open(server.rendering().await, *stand, (640, 480), 1).await;
    let (mut inside, mut all) = (Vec::new(), Vec::new());
    for run in 0..WARM_UP + RUNS {
        let begun = Instant::now();
        viewer.step().await;
        let frame = viewer.frame().await.expect("a frame");
        let picture = decode_image_codes(&frame.color, ReadLimits::SCENE).expect("a picture");
        assert_eq!((frame.pose_id, picture.width), (viewer.steps, 640));
        if run >= WARM_UP {
            all.push(1e3 * begun.elapsed().as_secs_f64());
            inside.push(own_millis(&frame));
        }
    }
    let (own, median, slow) = (quantile(&mut inside, 0.5), quantile(&mut all, 0.5), quantile(&mut all, 0.99));
    println!("\nmotion: {own:.1} ms in the server, {median:.1} ms from pose to decoded frame, 99 %: {slow:.1} ms");
    bound("added, ms", median - own, 10.0, median - own <= 10.0);
    bound("99 % / median", slow / median, 2.0, slow <= 2.0 * median);
}

/// JPEG's quality and at which resolution it stores colour: below 90 at half, as OpenCV's encoder does at 90.
const COLORS: [(u32, &str); 2] = [(90, "full"), (89, "half")];

fn jpeg(jpeg_quality: u32) -> Up {
    let output = wire::OutputSettings { encoding: wire::Encoding::Jpeg.into(), jpeg_quality, ..Default::default() };
    Up::Settings(wire::SettingsUpdate { settings: None, output: Some(output) })
}

async fn delivery(server: &Server, stand: &Stand) {
    println!("\ndelivery: from pose to decoded frame, less the rendering");
    for (quality, color) in COLORS {
        let mut viewer = Viewer::open(server.rendering().await, *stand, (640, 480), 1).await;
        viewer.send(jpeg(quality)).await;
        let (mut delivered, mut rendering, mut parts): (Vec<f64>, Vec<f64>, [Vec<f64>; 3]) = Default::default();
        for run in 0..WARM_UP + RUNS {
            let begun = Instant::now();
            viewer.step().await;
            let frame = viewer.frame().await.expect("a frame");
            let came = Instant::now();
            decode_image_codes(&frame.color, ReadLimits::SCENE).expect("a picture");
            let t = frame.timings.expect("every frame has timings");
            if run >= WARM_UP {
                rendering.push(1e-3 * (t.pages_micros + t.render_micros) as f64);
                delivered.push(1e3 * begun.elapsed().as_secs_f64() - rendering[rendering.len() - 1]);
                let millis = [t.queue_micros, t.encode_micros, came.elapsed().as_micros() as u64].map(|micros| 1e-3 * micros as f64);
                parts.iter_mut().zip(millis).for_each(|(part, millis)| part.push(millis));
            }
        }
        let (median, slow, render) = (quantile(&mut delivered, 0.5), quantile(&mut delivered, 0.95), quantile(&mut rendering, 0.5));
        let [queue, encoding, decoding] = parts.each_mut().map(|part| quantile(part, 0.5));
        println!("  JPEG {quality}, colour at {color} resolution, {render:.1} ms of rendering: median {median:.1} ms, 95 % {slow:.1} ms;");
        println!("    of these {queue:.1} in the queue, {encoding:.1} encoding, {decoding:.1} decoding");
    }
    // Brings the pages of all poses.
    Viewer::open(server.rendering().await, *stand, (640, 480), 2).await.walk(2 * SECONDS).await;
    for (quality, color) in COLORS {
        let viewer = Viewer::open(server.rendering().await, *stand, (640, 480), 2).await;
        viewer.send(jpeg(quality)).await;
        let rate = viewer.follow(SECONDS, |frame| drop(decode_image_codes(&frame.color, ReadLimits::SCENE).expect("a picture"))).await;
        println!("  frames a second with two credits, JPEG {quality}, colour at {color} resolution: {rate:.2}");
    }
    // As many credits as there may be: what the server may send without an answer.
    let mut mute = Viewer::open(server.rendering().await, *stand, (640, 480), 16).await;
    let (before, begun, mut middle) = (server.resident_bytes(), Instant::now(), None);
    while begun.elapsed() < STALL {
        mute.step().await;
        tokio::time::sleep(POSE).await;
        if begun.elapsed() > STALL / 2 {
            middle.get_or_insert_with(|| server.resident_bytes());
        }
    }
    let megabytes = |since: u64| 1e-6 * (server.resident_bytes() as f64 - since as f64);
    let (all, half) = (megabytes(before), megabytes(middle.unwrap_or(before)));
    println!(
        "  a viewer that stalls for {} s, {} poses: {all:.1} MB more, {half:.1} of them in the second half",
        STALL.as_secs(),
        mute.steps
    );
}

async fn fairness(server: &Server, stand: &Stand) {
    let alone = Viewer::open(server.rendering().await, *stand, (640, 480), 2).await.walk(SECONDS).await;
    let mut together = Vec::new();
    for _ in 0..8 {
        // A connection each, as from eight machines.
        let viewer = Viewer::open(server.rendering().await, *stand, (640, 480), 2).await;
        together.push(tokio::spawn(viewer.walk(SECONDS)));
    }
    let mut rates = Vec::new();
    for viewer in together {
        rates.push(viewer.await.expect("a viewer does not panic"));
    }
    let all: f64 = rates.iter().sum();
    let jain = all.powi(2) / (8.0 * rates.iter().map(|rate| rate * rate).sum::<f64>());
    println!("\nfairness: one viewer {alone:.2} frames/s, eight {all:.2} together: {rates:.2?}");
    bound("Jain's index", jain, 0.95, jain >= 0.95);
    bound("eight together / one", all / alone, 0.9, all >= 0.9 * alone);
}

async fn idle(server: &Server, stand: &Stand) {
    let mut viewers = Vec::new();
    for _ in 0..32 {
        let mut viewer = Viewer::open(server.rendering().await, *stand, (64, 48), 2).await;
        viewer.step().await;
        // Acknowledged; what may come after it is what rest costs.
        viewer.frame().await.expect("a frame");
        viewers.push(viewer);
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
    let (before, begun) = (server.cpu_seconds(), Instant::now());
    tokio::time::sleep(SECONDS).await;
    let cores = (server.cpu_seconds() - before) / begun.elapsed().as_secs_f64();
    println!("\nidle: {} viewers at rest", viewers.len());
    bound("cores", cores, 0.01, cores <= 0.01);
}
