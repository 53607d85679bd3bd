//! `lumisphere stream`: a path's frames in order, none left out, as numbered files, a video file, or a video on standard output.

mod sink;

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use lumisphere_proto::v1alpha1 as wire;
use serde::Serialize;

use crate::cameras::{Named, OrbitFlags, read_cameras};
use crate::commands::render::version_of;
use crate::context::Context;
use crate::exit::Failure;
use crate::files::Existing;
use crate::interaction::{Answer, Interaction, Wanted};
use crate::output::bytes_text;
use crate::progress::{Meter, Progress};
use crate::render_settings::{Format, OutputFlags, SettingsFlags, with_uploads};
use crate::target::{TargetFlags, alone_or_chosen};
use crate::video::{ColourFlags, FrameRate};
use crate::viewer_path::{PathKind, ViewerPaths};
use sink::{Destination, Sink, Slot};

/// Four seconds of an orbit.
const DEFAULT_FRAMES: &str = "120";

/// Flags of `stream`.
#[derive(Debug, Args)]
#[command(mut_args(alone_or_chosen), mut_arg("frames", |a| a.default_value(DEFAULT_FRAMES).help("Frames in all; an orbit is closed in so many")))]
pub struct Arguments {
    #[command(flatten)]
    target: TargetFlags,
    /// How the camera moves [default: orbit, or replayed with --cameras]
    #[arg(long, value_enum)]
    path: Option<PathKind>,
    /// Cameras of a scene file (neutral-scene/1), in order; without --path, each once
    #[arg(long, value_name = "FILE", required_if_eq("path", "replayed"))]
    cameras: Option<PathBuf>,
    /// Of walks and jumps
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Frames per second of y4m: 30, 23.976, 30000/1001
    #[arg(long, value_name = "HZ", default_value = "30")]
    fps: FrameRate,
    #[command(flatten)]
    orbit: OrbitFlags,
    #[command(flatten)]
    settings: SettingsFlags,
    #[command(flatten)]
    output: OutputFlags,
    #[command(flatten)]
    colours: ColourFlags,
    /// Take each camera's first frame, coarse where pages are still on their way, instead of its last
    #[arg(long)]
    unrefined: bool,
    /// A folder for frame-00000.png and on, a video FILE.y4m, or - for a video (y4m) on standard output
    #[arg(long, value_name = "DIR|FILE.y4m|-")]
    out: Destination,
    /// Overwrite files
    #[arg(long)]
    force: bool,
}

/// What `--json` says at the end.
#[derive(Debug, Serialize)]
struct Summary {
    out: String,
    dataset: String,
    dataset_version: u64,
    frames: u64,
    bytes: u64,
    seconds: f64,
    frames_per_second: f64,
    /// From a pose's sending to its frame's arrival.
    millis_median: f64,
    millis_p95: f64,
}

/// Where the camera is at each step.
struct Path<'a> {
    viewer: ViewerPaths<'a>,
    frames: u64,
}

/// Streams all frames.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    if arguments.out.is_video() {
        check_output(&arguments.output)?;
    }
    let mut target = arguments.target.target(context)?;
    let server = context.connect().await?;
    let (version, kind) = version_of(context, &server, &target.dataset, target.version).await?;
    let cameras = arguments.cameras.as_deref().map(read_cameras).transpose()?.unwrap_or_default();
    if arguments.out.is_video() {
        check_sizes(&cameras)?;
    }
    let path = Path::of(arguments, &version, &cameras)?;
    let existing = Existing::from_force(arguments.force);
    let mut sink = Sink::open(&arguments.out, &arguments.output, (arguments.fps, arguments.colours), path.frames, existing)?;
    let settings = target.settings.take().unwrap_or_else(|| arguments.settings.to_wire(&kind));
    let settings = with_uploads(settings, context).await?;
    let open = wire::OpenInteraction {
        dataset: target.dataset.clone(),
        version: version.version,
        settings: Some(settings),
        output: Some(arguments.output.to_wire()),
        // The opening's to know.
        credits: 0,
        // Every frame is kept: none shall be smaller for having moved.
        moving_frames_per_second: Some(0.0),
    };
    let mut interaction = Interaction::open(context, &server, open).await?;
    let wanted = if arguments.unrefined { Wanted::First } else { Wanted::Final };
    let mut meter = Meter::new(context.output);
    let (begun, mut seconds) = (Instant::now(), Vec::new());
    for step in 0..path.frames {
        let left = (step > 0).then(|| begun.elapsed().as_secs_f64() / step as f64 * (path.frames - step) as f64);
        meter.update(Progress { stage: "streaming", done: step, total: path.frames, seconds_left: left, detail: "" });
        // Room first: a frame waits for who reads, and is not asked for before.
        let slot = slot(&mut sink, &mut interaction).await?;
        let asked = Instant::now();
        interaction.look(step + 1, path.viewer.camera(0, step)?).await;
        let frame = interaction.frame(step + 1, wanted).await.map_err(|e| e.context(format!("frame {step}")))?;
        seconds.push(asked.elapsed().as_secs_f64());
        slot.send(frame);
    }
    match wanted {
        Wanted::Final => interaction.close().await?,
        // What would still make the last one better is not waited for.
        Wanted::First => drop(interaction),
    }
    let bytes = sink.finish().await?;
    meter.finish();
    let summary = Summary::of(arguments, (target.dataset, version.version), bytes, begun.elapsed().as_secs_f64(), seconds);
    summary.tell(&arguments.out, context)
}

/// Room for a frame. Better ones of the last, which come meanwhile where the first was taken, go.
async fn slot(sink: &mut Sink, interaction: &mut Interaction) -> anyhow::Result<Slot> {
    loop {
        tokio::select! {
            biased;
            slot = sink.slot() => return slot,
            answer = interaction.next() => match answer? {
                Answer::Frame(frame) => interaction.acknowledge(&frame).await,
                Answer::Refused(status) => return Err(status.into()),
            },
        }
    }
}

/// A video is made of codes.
fn check_output(output: &OutputFlags) -> Result<(), Failure> {
    let problem = match output.format {
        Format::Exr | Format::Raw => "--format exr and raw are for folders; a video is made of png (lossless) or jpeg frames",
        Format::Png | Format::Jpeg if output.depth || output.provenance => {
            "--depth and --provenance are for folders; a video has no room for them"
        }
        Format::Png | Format::Jpeg => return Ok(()),
    };
    Err(Failure::Usage(problem.into()))
}

/// A video has one size.
fn check_sizes(cameras: &[Named]) -> Result<(), Failure> {
    let size = |camera: &Named| camera.1.intrinsics.map(|i| (i.width_px, i.height_px)).unwrap_or_default();
    let Some(first) = cameras.first() else { return Ok(()) };
    let Some(other) = cameras.iter().find(|camera| size(camera) != size(first)) else { return Ok(()) };
    let told = |camera: &Named| format!("{:?} is {}x{}", camera.0, size(camera).0, size(camera).1);
    Err(Failure::Usage(format!("--cameras: camera {}, {}; one size expected in a video", told(first), told(other))))
}

impl<'a> Path<'a> {
    fn of(arguments: &'a Arguments, version: &wire::DatasetVersion, cameras: &'a [Named]) -> Result<Self, Failure> {
        let has_cameras = !cameras.is_empty();
        let kind = match (arguments.path, has_cameras) {
            (None, true) | (Some(PathKind::Replayed), _) => PathKind::Replayed,
            (None, false) => PathKind::Orbit,
            (Some(kind), false) => kind,
            (Some(_), true) => return Err(Failure::Usage("--cameras goes with --path replayed, or without --path".into())),
        };
        let bounds = match (version.object_bounds, kind) {
            (Some(bounds), _) => bounds,
            (None, PathKind::Replayed) => wire::Box3::default(),
            (None, _) => return Err(Failure::Precondition("the dataset tells no object's box; give --cameras FILE".into())),
        };
        let frames = if arguments.path.is_none() && has_cameras { cameras.len() as u64 } else { arguments.orbit.frames.into() };
        let viewer = ViewerPaths { kind, orbit: &arguments.orbit, bounds, viewers: 1, cameras, seed: arguments.seed };
        Ok(Self { viewer, frames })
    }
}

impl Summary {
    fn of(arguments: &Arguments, (dataset, dataset_version): (String, u64), bytes: u64, seconds: f64, mut each: Vec<f64>) -> Self {
        each.sort_by(f64::total_cmp);
        let (frames, out) = (each.len() as u64, arguments.out.to_string());
        let frames_per_second = frames as f64 / seconds.max(f64::MIN_POSITIVE);
        let (millis_median, millis_p95) = (1e3 * nearest_rank(&each, 0.5), 1e3 * nearest_rank(&each, 0.95));
        Self { out, dataset, dataset_version, frames, bytes, seconds, frames_per_second, millis_median, millis_p95 }
    }

    /// Standard output is the video's where the video goes there.
    fn tell(&self, out: &Destination, context: &Context) -> anyhow::Result<()> {
        match out {
            Destination::Pipe if context.output.is_json() => eprintln!("{}", serde_json::to_string(self)?),
            Destination::Pipe => context.output.say(&self.text()),
            Destination::Folder(_) | Destination::Video(_) => context.output.document(self, || self.text())?,
        }
        Ok(())
    }

    fn text(&self) -> String {
        format!(
            "{}  {} frames  {}  {:.1} s, {:.1} frames/s  median {:.1} ms, p95 {:.1} ms a frame",
            self.out,
            self.frames,
            bytes_text(self.bytes),
            self.seconds,
            self.frames_per_second,
            self.millis_median,
            self.millis_p95
        )
    }
}

/// The least of the sorted values that at least this share of them does not exceed; 0 of none.
fn nearest_rank(sorted: &[f64], share: f64) -> f64 {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_ranks() {
        let hundred: Vec<f64> = (1..=100).map(f64::from).collect();
        assert_eq!((nearest_rank(&hundred, 0.5), nearest_rank(&hundred, 0.95), nearest_rank(&[], 0.5)), (50.0, 95.0, 0.0));
        assert_eq!((nearest_rank(&[7.0], 0.5), nearest_rank(&[7.0], 0.95)), (7.0, 7.0));
    }

    #[test]
    fn a_video_of_two_sizes_is_refused_by_the_cameras_names() {
        let camera = |name: &str, width_px| {
            let intrinsics = wire::Intrinsics { width_px, height_px: 4, ..Default::default() };
            (name.to_string(), wire::Camera { intrinsics: Some(intrinsics), pose: None })
        };
        assert!(check_sizes(&[camera("a", 8), camera("b", 8)]).is_ok());
        let problem = check_sizes(&[camera("a", 8), camera("b", 8), camera("c", 9)]).unwrap_err().to_string();
        assert!(problem.contains("\"a\" is 8x4") && problem.contains("\"c\" is 9x4"), "{problem}");
    }
}
