//! `lumisphere load`: viewers that ask for frames on time, whether or not the last ones came, and what that does to the cache.

mod paper;
mod phases;
mod report;

use std::path::PathBuf;

use clap::Args;
use lumisphere::textures::ReadStrategy;
use lumisphere_proto::v1alpha1 as wire;

use crate::cameras::{Named, OrbitFlags, read_cameras};
use crate::commands::render::version_of;
use crate::context::Context;
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, write_atomically};
use crate::progress::{Meter, Progress};
use crate::render_settings::{OutputFlags, SettingsFlags, with_uploads};
use crate::viewer_path::{PathKind, ViewerPaths};
use phases::{Phase, Runner, Schedule};

/// Each sleeps in memory until it is due.
const MAX_REQUESTS: u64 = 1_000_000;
const REPORT: &str = "load.json";
const CHART: &str = "load.svg";

/// Flags of `load`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Dataset to look at
    #[arg(long, value_name = "NAME")]
    dataset: String,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    /// How many viewers at once
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1000))]
    viewers: u32,
    /// Frames that each viewer asks for in a second
    #[arg(long, value_name = "HZ", default_value_t = 1.0)]
    rate: f64,
    /// Frames that each viewer asks for in a phase
    #[arg(long, value_name = "N", default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    requests: u32,
    /// How viewers move
    #[arg(long, value_enum, default_value = "orbit")]
    motion: PathKind,
    /// Cameras of `--motion replayed`: a scene file (neutral-scene/1)
    #[arg(long, value_name = "FILE", required_if_eq("motion", "replayed"))]
    cameras: Option<PathBuf>,
    /// What to run, in this order
    #[arg(long, value_enum, value_delimiter = ',', default_value = "cold,warm,larger-than-cache,scan")]
    phases: Vec<Phase>,
    /// Read strategies to run the phases with, one after the other [default: the one in use]
    #[arg(long, value_name = "STRATEGY", value_delimiter = ',')]
    strategies: Vec<ReadStrategy>,
    /// Of walks and jumps
    #[arg(long, default_value_t = 1)]
    seed: u64,
    #[command(flatten)]
    orbit: OrbitFlags,
    #[command(flatten)]
    settings: SettingsFlags,
    #[command(flatten)]
    output: OutputFlags,
    /// No load: print the paper's cache tables (6.3 to 6.7) beside the same from the orbit's first frame, pixel by pixel
    #[arg(long, conflicts_with_all = ["motion", "phases", "strategies", "out"])]
    paper: bool,
    /// With --paper: also replay on the server, through real caches over the dataset as it is stored (`job submit capture --codec lzw-seq
    /// --pixel-format f32` stores as the paper did), and print what that took
    #[arg(long, requires = "paper")]
    times: bool,
    /// Write load.json and load.svg into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Overwrite files
    #[arg(long)]
    force: bool,
}

/// Runs all phases and puts the cache back as it was.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    if !(arguments.rate > 0.0 && arguments.rate <= 10_000.0) {
        return Err(Failure::Usage(format!("--rate is {}, above 0 and at most 10000 expected", arguments.rate)).into());
    }
    let requests = u64::from(arguments.viewers) * u64::from(arguments.requests);
    if requests > MAX_REQUESTS {
        let problem = format!("{} viewers with {} requests each: at most {MAX_REQUESTS} in a phase", arguments.viewers, arguments.requests);
        return Err(Failure::Usage(problem).into());
    }
    let server = context.connect().await?;
    let (version, kind) = version_of(context, &server, &arguments.dataset, arguments.version).await?;
    if arguments.paper {
        return paper::run(context, &server, &arguments.dataset, &version, &arguments.orbit, arguments.times).await;
    }
    let existing = Existing::from_force(arguments.force);
    if let Some(out) = &arguments.out {
        prepare_folder(out, [REPORT.to_string(), CHART.to_string()], existing)?;
    }
    let cameras = arguments.cameras.as_deref().map(read_cameras).transpose()?.unwrap_or_default();
    let paths = paths(arguments, &version, &cameras)?;
    let template = wire::RenderFrameRequest {
        dataset: arguments.dataset.clone(),
        version: version.version,
        camera: None,
        settings: Some(with_uploads(arguments.settings.to_wire(&kind), context).await?),
        output: Some(arguments.output.to_wire()),
        pose_id: 0,
    };
    let schedule = Schedule { viewers: arguments.viewers, rate: arguments.rate, requests: arguments.requests };
    let mut runner = Runner::new(context, &server, schedule, template).await?;
    let mut meter = Meter::new(context.output);
    let outcome = run_all(arguments, &mut runner, &paths, &mut meter).await;
    meter.finish();
    // Also after an error: a load test that fails leaves no small cache behind.
    let restored = runner.restore().await;
    let results = outcome?;
    restored?;
    let document = report::document(arguments, version.version, &results);
    if let Some(out) = &arguments.out {
        write_atomically(&out.join(REPORT), serde_json::to_string_pretty(&document)?.as_bytes(), existing)?;
        write_atomically(&out.join(CHART), report::chart(&results)?.as_bytes(), existing)?;
    }
    context.output.document(&document, || report::text(&results))?;
    Ok(())
}

async fn run_all(
    arguments: &Arguments,
    runner: &mut Runner<'_>,
    paths: &ViewerPaths<'_>,
    meter: &mut Meter,
) -> anyhow::Result<Vec<phases::Outcome>> {
    let strategies: Vec<Option<ReadStrategy>> = match arguments.strategies.is_empty() {
        true => vec![None],
        false => arguments.strategies.iter().copied().map(Some).collect(),
    };
    let mut results = Vec::new();
    for strategy in strategies {
        for phase in &arguments.phases {
            let stage = format!("{}{}", phase.name(), strategy.map(|s| format!(" ({s})")).unwrap_or_default());
            let show = |done, total| meter.update(Progress { stage: &stage, done, total, seconds_left: None, detail: "" });
            results.push(runner.run(*phase, strategy, paths, show).await?);
        }
    }
    Ok(results)
}

fn paths<'a>(arguments: &'a Arguments, version: &wire::DatasetVersion, cameras: &'a [Named]) -> anyhow::Result<ViewerPaths<'a>> {
    let bounds = match (arguments.motion, version.object_bounds) {
        (_, Some(bounds)) => bounds,
        (PathKind::Replayed, None) => wire::Box3::default(),
        (_, None) => {
            return Err(Failure::Precondition("the dataset tells no object's box; give --motion replayed --cameras FILE".into()).into());
        }
    };
    let (kind, orbit, viewers, seed) = (arguments.motion, &arguments.orbit, arguments.viewers, arguments.seed);
    Ok(ViewerPaths { kind, orbit, bounds, viewers, cameras, seed })
}
