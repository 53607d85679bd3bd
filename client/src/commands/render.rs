//! `lumisphere render`: frames into a folder, one request a frame, or one stream for all.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::Args;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;
use tonic::transport::Channel;
use wire::rendering_client::RenderingClient;

use crate::cameras::{CameraFlags, Named};
use crate::contact_sheet::contact_sheet;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, write_atomically};
use crate::interaction::{Interaction, Wanted};
use crate::output::bytes_text;
use crate::progress::{Meter, Progress};
use crate::render_settings::{Format, OutputFlags, SettingsFlags, with_uploads};
use crate::target::{Target, TargetFlags, alone_or_chosen};
use crate::views;

/// The contact sheet's file name.
const CONTACT_SHEET: &str = "contact-sheet.png";

/// Flags of `render`.
#[derive(Debug, Args)]
#[command(mut_args(alone_or_chosen))]
pub struct Arguments {
    #[command(flatten)]
    target: TargetFlags,
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

/// Renders all cameras.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let mut target = arguments.target.target(context)?;
    let server = context.connect().await?;
    let (version, kind) = version_of(context, &server, &target.dataset, target.version).await?;
    let settings = target.settings.take().unwrap_or_else(|| arguments.settings.to_wire(&kind));
    target.settings = Some(with_uploads(settings, context).await?);
    let cameras = arguments.cameras.cameras(version.object_bounds.as_ref())?;
    let names: Vec<_> = (0..cameras.len() as u64).map(|index| file_names(index, &arguments.output)).collect();
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
        for (name, bytes) in names.iter().zip(file_contents(&frame)) {
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

/// Of one frame: colour, then depth and provenance where asked for.
pub fn file_names(index: u64, output: &OutputFlags) -> Vec<String> {
    let endings = [(true, output.format.extension()), (output.depth, "depth.zst"), (output.provenance, "provenance.zst")];
    endings.iter().filter(|(wanted, _)| *wanted).map(|(_, ending)| format!("frame-{index:05}.{ending}")).collect()
}

/// The bytes that belong to `file_names`, in their order.
pub fn file_contents(frame: &wire::Frame) -> impl Iterator<Item = &bytes::Bytes> {
    [&frame.color, &frame.depth, &frame.provenance].into_iter().filter(|bytes| !bytes.is_empty())
}

/// Where frames come from.
enum FrameSource<'a> {
    Unary { context: &'a Context, client: RenderingClient<Channel>, template: Box<wire::RenderFrameRequest> },
    Stream(Interaction),
}

impl<'a> FrameSource<'a> {
    async fn open(arguments: &Arguments, target: &Target, context: &'a Context, server: &Server, version: u64) -> anyhow::Result<Self> {
        let (settings, output) = (target.settings.clone(), Some(arguments.output.to_wire()));
        let dataset = target.dataset.clone();
        if !arguments.stream {
            let client = server.rendering();
            let template = Box::new(wire::RenderFrameRequest { dataset, version, camera: None, settings, output, pose_id: 0 });
            return Ok(Self::Unary { context, client, template });
        }
        // Every frame is kept: none shall be smaller for having moved. Credits are the opening's to know.
        let open = wire::OpenInteraction { dataset, version, settings, output, credits: 0, moving_frames_per_second: Some(0.0) };
        Ok(Self::Stream(Interaction::open(context, server, open).await?))
    }

    /// The frame of this camera; `pose_id` from 1, increasing.
    async fn frame(&mut self, pose_id: u64, camera: &Named) -> anyhow::Result<wire::Frame> {
        match self {
            Self::Unary { context, client, template } => {
                let request = wire::RenderFrameRequest { camera: Some(camera.1), pose_id, ..wire::RenderFrameRequest::clone(template) };
                Ok(client.render_frame(context.request(request)).await?.into_inner())
            }
            Self::Stream(interaction) => {
                interaction.look(pose_id, camera.1).await;
                interaction.frame(pose_id, Wanted::Final).await
            }
        }
    }

    /// Half-closes a stream and waits for the server's end of it.
    async fn close(self) -> anyhow::Result<()> {
        match self {
            Self::Unary { .. } => Ok(()),
            Self::Stream(interaction) => interaction.close().await,
        }
    }
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
        integration: views::integration_name(frame.integration()),
        directions: (frame.directions > 0).then_some(frame.directions),
        round_trip_millis: 1e3 * round_trip.as_secs_f64(),
        timings_micros: views::Timings { queue: t.queue_micros, pages: t.pages_micros, render: t.render_micros, encode: t.encode_micros },
        cache: frame.cache.unwrap_or_default().into(),
    }
}

fn frame_text(f: &views::Frame) -> String {
    let t = &f.timings_micros;
    let millis = |micros: u64| micros as f64 / 1e3;
    let gathered = match (f.integration, f.directions) {
        (Some(_), Some(directions)) => format!("  {directions} directions"),
        (Some(name), None) => format!("  {name}"),
        (None, _) => String::new(),
    };
    format!(
        "{}  {}x{}  {}  {:.1} ms (queue {:.1}, pages {:.1}, render {:.1}, encode {:.1})  cache {} of {}{gathered}",
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
        assert_eq!(file_names(1, &output), ["frame-00001.exr", "frame-00001.depth.zst"]);
    }
}
