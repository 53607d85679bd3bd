//! `lumisphere render`: frames into a folder, one request a frame, or one stream for all.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::Args;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::Component;
use wire::render_settings::Representation;
use wire::rendering_client::RenderingClient;

use crate::cameras::{CameraFlags, Named};
use crate::choose_flags::ChooseFlags;
use crate::contact_sheet::contact_sheet;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, write_atomically};
use crate::output::bytes_text;
use crate::progress::{Meter, Progress};
use crate::render_settings::{Format, OutputFlags, SettingsFlags};
use crate::views;

/// The contact sheet's file name.
const CONTACT_SHEET: &str = "contact-sheet.png";
/// Frames on their way in a stream: one arriving while the next is rendered.
const CREDITS: u32 = 2;

/// Flags of `render`.
#[derive(Debug, Args)]
#[command(mut_args(alone_or_chosen))]
pub struct Arguments {
    /// Dataset to render
    #[arg(long, value_name = "NAME", required_unless_present = "choose", conflicts_with = "choose")]
    dataset: Option<String>,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true, conflicts_with = "choose")]
    version: u64,
    #[command(flatten)]
    choose: ChooseFlags,
    #[command(flatten)]
    cameras: CameraFlags,
    #[command(flatten)]
    settings: SettingsFlags,
    #[command(flatten)]
    output: OutputFlags,
    /// Into this folder: frame-00000.png and on, and a contact sheet of PNG frames
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Overwrite files
    #[arg(long)]
    force: bool,
    /// One Interact stream with credits instead of one request a frame
    #[arg(long)]
    stream: bool,
}

/// What a chosen row says is not said by flags, too.
fn alone_or_chosen(argument: clap::Arg) -> clap::Arg {
    let is_of_row =
        ["component", "blend", "specular", "filter", "backend", "brdf", "directions", "passes"].contains(&argument.get_id().as_str());
    if is_of_row { argument.conflicts_with("choose") } else { argument }
}

/// What is rendered, and how.
struct Target {
    dataset: String,
    version: u64,
    // As the dataset's kind shows by default where flags do not say.
    settings: Option<wire::RenderSettings>,
}

impl Target {
    fn of(arguments: &Arguments, context: &Context) -> anyhow::Result<Self> {
        let Some(chosen) = arguments.choose.chosen()? else {
            let (dataset, version) = (arguments.dataset.clone().unwrap_or_default(), arguments.version);
            return Ok(Self { dataset, version, settings: None });
        };
        context.output.say(&format!("chosen: {} of dataset {}", chosen.label, chosen.row.dataset));
        let settings = Some(chosen.settings()?);
        Ok(Self { dataset: chosen.row.dataset, version: chosen.row.version, settings })
    }
}

/// Renders all cameras.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let mut target = Target::of(arguments, context)?;
    let server = context.connect().await?;
    let (version, kind) = version_of(context, &server, &target.dataset, target.version).await?;
    target.settings.get_or_insert_with(|| arguments.settings.to_wire(&kind));
    let cameras = arguments.cameras.cameras(version.object_bounds.as_ref())?;
    let names = file_names(cameras.len(), &arguments.output);
    let existing = Existing::from_force(arguments.force);
    prepare_folder(&arguments.out, names.iter().flatten().cloned().chain([CONTACT_SHEET.into()]), existing)?;

    let mut source = FrameSource::open(arguments, &target, context, &server, version.version).await?;
    let mut meter = Meter::new(context.output);
    let mut pictures = Vec::new();
    for (index, (camera, names)) in cameras.iter().zip(&names).enumerate() {
        meter.update(Progress { stage: "rendering", done: index as u64, total: cameras.len() as u64, seconds_left: None, detail: "" });
        let started = Instant::now();
        let frame = source.frame(index as u64 + 1, camera).await.with_context(|| format!("frame {index}"))?;
        let round_trip = started.elapsed();
        for (name, bytes) in names.iter().zip([&frame.color, &frame.depth, &frame.provenance].into_iter().filter(|b| !b.is_empty())) {
            write_atomically(&arguments.out.join(name), bytes, existing)?;
        }
        let view = frame_view(index, &camera.0, arguments.out.join(&names[0]).display().to_string(), &frame, round_trip);
        context.output.line(&view, || frame_text(&view))?;
        if arguments.output.format == Format::Png {
            pictures.push(frame.color);
        }
    }
    meter.finish();
    source.close().await?;
    write_contact_sheet(arguments, context, &pictures, existing)
}

/// Pinned, so that a version published meanwhile does not change the path's second half.
pub async fn version_of(context: &Context, server: &Server, name: &str, version: u64) -> anyhow::Result<(wire::DatasetVersion, String)> {
    let dataset = server.datasets().get_dataset(context.request(wire::GetDatasetRequest { name: name.into() })).await?.into_inner();
    let wanted = if version == 0 { dataset.latest_version } else { version };
    if wanted == 0 {
        return Err(Failure::Precondition(format!("dataset {name} has no version yet")).into());
    }
    let found = dataset.versions.into_iter().find(|v| v.version == wanted);
    let found = found.ok_or_else(|| Failure::NotFound(format!("dataset {name} has no version {wanted}")))?;
    Ok((found, dataset.kind))
}

/// For each frame: colour, then depth and provenance where asked for.
fn file_names(count: usize, output: &OutputFlags) -> Vec<Vec<String>> {
    let endings = [(true, output.format.extension()), (output.depth, "depth.zst"), (output.provenance, "provenance.zst")];
    let names = |index| endings.iter().filter(|(wanted, _)| *wanted).map(|(_, ending)| format!("frame-{index:05}.{ending}")).collect();
    (0..count).map(names).collect()
}

/// Where frames come from.
enum FrameSource<'a> {
    Unary { context: &'a Context, client: RenderingClient<Channel>, template: wire::RenderFrameRequest },
    Stream { up: mpsc::Sender<wire::InteractRequest>, down: Streaming<wire::InteractResponse>, passes: u32 },
}

impl<'a> FrameSource<'a> {
    async fn open(arguments: &Arguments, target: &Target, context: &'a Context, server: &Server, version: u64) -> anyhow::Result<Self> {
        let (settings, output) = (target.settings.clone(), Some(arguments.output.to_wire()));
        let dataset = target.dataset.clone();
        let mut client = server.rendering();
        if !arguments.stream {
            let template = wire::RenderFrameRequest { dataset, version, camera: None, settings, output, pose_id: 0 };
            return Ok(Self::Unary { context, client, template });
        }
        let passes = passes(settings.as_ref());
        let (up, messages) = mpsc::channel(4);
        // Every frame is kept: none shall be smaller for having moved.
        let open = wire::OpenInteraction { dataset, version, settings, output, credits: CREDITS, moving_frames_per_second: 0.0 };
        send(&up, Up::Open(open)).await?;
        let down = client.interact(context.patient_request(ReceiverStream::new(messages))).await?.into_inner();
        Ok(Self::Stream { up, down, passes })
    }

    /// The frame of this camera; `pose_id` from 1, increasing.
    async fn frame(&mut self, pose_id: u64, camera: &Named) -> anyhow::Result<wire::Frame> {
        match self {
            Self::Unary { context, client, template } => {
                let request = wire::RenderFrameRequest { camera: Some(camera.1), pose_id, ..template.clone() };
                Ok(client.render_frame(context.request(request)).await?.into_inner())
            }
            Self::Stream { up, down, passes } => {
                // If the server has gone, the answer says why; a failed send does not.
                let _ = send(up, Up::Pose(wire::PoseUpdate { pose_id, camera: Some(camera.1) })).await;
                loop {
                    let frame = streamed_frame(down, pose_id).await?;
                    let _ = send(up, Up::Acknowledge(wire::FrameAcknowledgement { frame_id: frame.frame_id })).await;
                    if frame.passes_done >= *passes {
                        return Ok(frame);
                    }
                }
            }
        }
    }

    /// Half-closes a stream and waits for the server's end of it.
    async fn close(self) -> anyhow::Result<()> {
        if let Self::Stream { up, mut down, .. } = self {
            drop(up);
            while down.message().await?.is_some() {}
        }
        Ok(())
    }
}

/// That a frame with these settings is the mean of in the end.
fn passes(settings: Option<&wire::RenderSettings>) -> u32 {
    match settings.and_then(|s| s.representation.as_ref()) {
        Some(Representation::OffsetSurfaceLightField(s)) if s.component() == Component::Glossy => s.gloss.as_ref().map_or(1, |g| g.passes),
        _ => 1,
    }
}

async fn send(up: &mpsc::Sender<wire::InteractRequest>, message: Up) -> anyhow::Result<()> {
    up.send(wire::InteractRequest { message: Some(message) }).await.context("the stream is closed")
}

async fn streamed_frame(down: &mut Streaming<wire::InteractResponse>, pose_id: u64) -> anyhow::Result<wire::Frame> {
    loop {
        let response = down.message().await?.context("the server ended the stream")?;
        match response.message {
            Some(Down::Frame(frame)) if frame.pose_id == pose_id => return Ok(frame),
            Some(Down::Status(status)) => return Err(status_error(status).into()),
            Some(Down::Opened(_) | Down::Frame(_)) | None => {}
        }
    }
}

/// The same error that a unary call would give.
fn status_error(status: wire::InteractStatus) -> Status {
    let details = ErrorDetails::with_error_info(status.reason, lumisphere_proto::ERROR_DOMAIN, [] as [(String, String); 0]);
    Status::with_error_details(Code::from_i32(status.code), status.message, details)
}

fn frame_view(index: usize, camera: &str, file: String, frame: &wire::Frame, round_trip: Duration) -> views::Frame {
    let t = frame.timings.unwrap_or_default();
    views::Frame {
        index,
        camera: camera.into(),
        file,
        dataset_version: frame.dataset_version,
        width_px: frame.width_px,
        height_px: frame.height_px,
        size_bytes: frame.color.len(),
        backend: views::backend_name(frame.backend()),
        adapter: frame.adapter.clone(),
        is_final: frame.is_final,
        passes_done: frame.passes_done,
        round_trip_millis: 1e3 * round_trip.as_secs_f64(),
        timings_micros: views::Timings { queue: t.queue_micros, pages: t.pages_micros, render: t.render_micros, encode: t.encode_micros },
        cache: frame.cache.unwrap_or_default().into(),
    }
}

fn frame_text(f: &views::Frame) -> String {
    let t = &f.timings_micros;
    let millis = |micros: u64| micros as f64 / 1e3;
    format!(
        "{}  {}x{}  {}  {:.1} ms (queue {:.1}, pages {:.1}, render {:.1}, encode {:.1})  cache {} of {}",
        f.file,
        f.width_px,
        f.height_px,
        bytes_text(f.size_bytes as u64),
        f.round_trip_millis,
        millis(t.queue),
        millis(t.pages),
        millis(t.render),
        millis(t.encode),
        f.cache.hits,
        f.cache.look_ups,
    )
}

fn write_contact_sheet(arguments: &Arguments, context: &Context, pictures: &[bytes::Bytes], existing: Existing) -> anyhow::Result<()> {
    if pictures.is_empty() {
        return Ok(());
    }
    let path = arguments.out.join(CONTACT_SHEET);
    write_atomically(&path, &contact_sheet(pictures).context("contact sheet")?, existing)?;
    context.output.line(&json!({"contact_sheet": path}), || path.display().to_string())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_numbered_and_named_by_what_they_hold() {
        let output = OutputFlags { format: Format::Exr, jpeg_quality: 90, exposure_stops: 0.0, gamma: 0.0, depth: true, provenance: false };
        assert_eq!(file_names(2, &output), [["frame-00000.exr", "frame-00000.depth.zst"], ["frame-00001.exr", "frame-00001.depth.zst"]]);
    }

    #[test]
    fn a_status_in_a_stream_has_the_exit_code_of_the_same_status_alone() {
        let status =
            wire::InteractStatus { code: Code::InvalidArgument as i32, reason: "FIELD_INVALID".into(), message: "no".into(), pose_id: 1 };
        assert_eq!(crate::exit::code(&status_error(status).into()), 2);
    }
}
