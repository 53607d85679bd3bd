//! `lumisphere cache record`: a trace file.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;
use tonic::Streaming;

use crate::cameras::CameraFlags;
use crate::commands::render::version_of;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::files::{Existing, write_atomically};
use crate::output::bytes_text;
use crate::render_settings::{SettingsFlags, with_uploads};
use crate::viewer_path::{PathKind, ViewerPaths};

/// Flags of `cache record`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The trace file to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Record all that is rendered, by anyone, for so long; else one frame for each camera
    #[arg(long, value_name = "SECONDS", conflicts_with = "dataset")]
    traffic_seconds: Option<f64>,
    /// Dataset whose frames to record
    #[arg(long, value_name = "NAME", required_unless_present = "traffic_seconds")]
    dataset: Option<String>,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// Order of the pixels
    #[arg(long, value_enum, default_value = "buckets")]
    order: Order,
    /// Directions about the mirror direction for each pixel, as a glossy reflection by Monte Carlo needs; 0: the mirror direction alone
    #[arg(long, value_name = "N", default_value_t = 0)]
    lobe_samples: u32,
    /// The lobe's density is the cosine to this power
    #[arg(long, value_name = "N", default_value_t = 40.0)]
    lobe_exponent: f32,
    /// The first --frames places of a wandering viewer, as `load --path walk` has it, in place of the orbit
    #[arg(long, conflicts_with_all = ["path", "cameras", "position", "traffic_seconds"])]
    walk: bool,
    #[command(flatten)]
    cameras: CameraFlags,
    #[command(flatten)]
    settings: SettingsFlags,
    /// Overwrite the file
    #[arg(long)]
    force: bool,
}

/// Orders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Order {
    /// 16 by 16 pixels at a time, as frames are computed
    Buckets,
    /// Row by row, as in the paper
    Scanlines,
}

impl Order {
    /// The wire's number.
    pub fn to_wire(self) -> wire::PixelOrder {
        match self {
            Self::Buckets => wire::PixelOrder::Buckets,
            Self::Scanlines => wire::PixelOrder::Scanlines,
        }
    }
}

/// Records and writes.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let existing = Existing::from_force(arguments.force);
    if arguments.out.exists() && !arguments.force {
        return Err(Failure::Precondition(format!("{} exists; --force overwrites it", arguments.out.display())).into());
    }
    let server = context.connect().await?;
    let bytes = match arguments.traffic_seconds {
        Some(seconds) => {
            context.output.say(&format!("recording for {seconds} s"));
            let request = context.patient_request(wire::RecordTrafficRequest { seconds });
            collected(server.cache().record_traffic(request).await?.into_inner()).await?
        }
        None => frames(arguments, context, &server).await?,
    };
    write_atomically(&arguments.out, &bytes, existing)?;
    let document = json!({"file": arguments.out, "size_bytes": bytes.len()});
    context.output.document(&document, || format!("{}  {}", arguments.out.display(), bytes_text(bytes.len() as u64)))?;
    Ok(())
}

async fn frames(arguments: &Arguments, context: &Context, server: &Server) -> anyhow::Result<Vec<u8>> {
    let dataset = arguments.dataset.clone().expect("clap requires it where there are no seconds");
    let (version, kind) = version_of(context, server, &dataset, arguments.version).await?;
    let cameras = cameras(arguments, version.object_bounds.as_ref())?;
    let request = wire::RecordTraceRequest {
        dataset,
        version: version.version,
        cameras,
        settings: Some(with_uploads(arguments.settings.to_wire(&kind), context).await?),
        order: arguments.order.to_wire().into(),
        lobe_samples: arguments.lobe_samples,
        lobe_exponent: arguments.lobe_exponent,
        seed: 0,
    };
    collected(server.cache().record_trace(context.patient_request(request)).await?.into_inner()).await
}

fn cameras(arguments: &Arguments, bounds: Option<&wire::Box3>) -> anyhow::Result<Vec<wire::Camera>> {
    if !arguments.walk {
        return Ok(arguments.cameras.cameras(bounds)?.into_iter().map(|(_, camera)| camera).collect());
    }
    let orbit = &arguments.cameras.orbit;
    let bounds = *bounds.ok_or_else(|| Failure::Precondition("the dataset tells no object's box to walk around".into()))?;
    let paths = ViewerPaths { kind: PathKind::Walk, orbit, bounds, viewers: 1, cameras: &[], seed: 0 };
    (0..u64::from(orbit.frames)).map(|step| paths.camera(0, step)).collect()
}

/// The whole file.
pub async fn collected(mut chunks: Streaming<wire::TraceChunk>) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    while let Some(chunk) = chunks.message().await? {
        bytes.extend_from_slice(&chunk.data);
    }
    Ok(bytes)
}
