//! `lumisphere evaluate sweep`: captures what is missing, evaluates every dataset with every setting, and writes table, chart and report.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use lumisphere::charts::{png, svg};
use lumisphere::evaluate::{self, Conditions, Metric, SWEEP_FORMAT, Sweep, SweepRow, bytes_text};
use lumisphere_proto::v1alpha1 as wire;
use serde_json::{Value, json};
use wire::job_spec::Spec;

use super::super::download::{Wanted, download};
use super::super::job::{camera_list, submit};
use super::super::watch::{Events, watch};
use super::datasets::{Dataset, datasets};
use crate::cameras::Views;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, safe_name, write_atomically};
use crate::output::table;
use crate::progress::Meter;
use crate::render_settings::named_table;
use crate::sweep_file::{Setting, SweepFile};

const FILES: [&str; 5] = ["sweep.json", "sweep.csv", "chart.svg", "chart.png", "report.html"];
/// The pictures of a report are those of the first view.
const FIRST_VIEW: &str = "view-00-";

/// Flags of `evaluate sweep`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Axes over captures and settings (TOML; docs/command-line.md says what may be in it, docs/examples/sweep.toml is one)
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Write sweep.json, sweep.csv, chart.svg, chart.png, report.html and its pictures into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// The error in the chart: delta-e, delta-e-p95, flip, one-minus-ssim, rmse-rgb, rmse-l, rmse-lab or max-abs
    #[arg(long, value_name = "METRIC", default_value_t = Metric::DeltaE)]
    metric: Metric,
    /// Measure anew what an earlier, identical evaluation measured; datasets that are there are never captured again
    #[arg(long)]
    anew: bool,
    /// Overwrite files
    #[arg(long)]
    force: bool,
}

/// Runs the whole sweep.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let mut file = SweepFile::read(&arguments.file)?;
    let existing = Existing::from_force(arguments.force);
    if let Some(out) = &arguments.out {
        prepare_folder(out, FILES.map(String::from), existing)?;
    }
    let server = context.connect().await?;
    let info = server.system().get_server_info(context.request(wire::GetServerInfoRequest {})).await?.into_inner();
    check_limits(&file.views, &info.limits.unwrap_or_default())?;
    name_tables(&mut file.settings, context).await?;
    let datasets = datasets(context, &server, &file).await?;
    let (mut rows, mut about) = (Vec::new(), Value::Null);
    for (done, dataset) in datasets.iter().enumerate() {
        context.output.say(&format!("evaluating {} ({} of {})", dataset.name, done + 1, datasets.len()));
        let job = evaluated(arguments, context, &server, &file, dataset).await?;
        let result = job.result.unwrap_or_default();
        let summary: Value = serde_json::from_str(&result.summary_json).context("the evaluation's summary")?;
        rows.extend(sweep_rows(&summary, dataset, &file).with_context(|| format!("the evaluation of {}", dataset.name))?);
        about = summary;
        if let Some(out) = &arguments.out {
            fetch_pictures(context, &server, &result.blobs, &out.join("images").join(safe_name(&dataset.name)?)).await?;
        }
    }
    let version = server.system().get_version(context.request(wire::GetVersionRequest {})).await?.into_inner().version;
    let sweep = Sweep { format: SWEEP_FORMAT.into(), conditions: conditions(&file, &about, &info.adapter, version), rows };
    if let Some(out) = &arguments.out {
        write_files(&sweep, arguments.metric, out, existing)?;
    }
    let files = arguments.out.as_ref().map(|_| FILES);
    let document = json!({"sweep": sweep, "out": arguments.out, "files": files});
    context.output.document(&document, || text(&sweep, arguments))?;
    Ok(())
}

/// Uploads each table once, before anything is captured. Settings, and so rows, name it by its hash: its file may be another one later.
async fn name_tables(settings: &mut [Setting], context: &Context) -> anyhow::Result<()> {
    let mut named = BTreeMap::new();
    for setting in settings {
        let Some(asked) = setting.asked.brdf.clone() else { continue };
        if !named.contains_key(&asked) {
            named.insert(asked.clone(), named_table(&asked, context).await?);
        }
        setting.name_brdf(&named[&asked]);
    }
    Ok(())
}

/// What the server would refuse later, when captures are done.
fn check_limits(views: &Views, limits: &wire::Limits) -> Result<(), Failure> {
    let (count, sizes): (u64, Vec<(u32, u32)>) = match views {
        Views::Orbit(orbit) => (orbit.count.into(), vec![(orbit.width_px, orbit.height_px)]),
        Views::Cameras(cameras) => {
            let sizes = cameras.iter().filter_map(|(_, c)| c.intrinsics).map(|i| (i.width_px, i.height_px));
            (cameras.len() as u64, sizes.collect())
        }
    };
    if count > limits.max_cameras_per_job {
        return Err(Failure::Usage(format!("{count} views, at most {} expected by this server", limits.max_cameras_per_job)));
    }
    let large = sizes.iter().find(|(w, h)| u64::from(*w) * u64::from(*h) > limits.max_pixels_per_frame || *w == 0 || *h == 0);
    match large {
        Some((w, h)) => {
            let most = limits.max_pixels_per_frame;
            Err(Failure::Usage(format!("views of {w}x{h} pixels, 1 to {most} pixels a view expected by this server")))
        }
        None => Ok(()),
    }
}

/// The evaluation of one dataset, now or, unless asked for anew, by an earlier run.
async fn evaluated(
    arguments: &Arguments,
    context: &Context,
    server: &Server,
    file: &SweepFile,
    dataset: &Dataset,
) -> anyhow::Result<wire::Job> {
    let views = match file.views.clone() {
        Views::Orbit(orbit) => wire::evaluate_spec::Views::Orbit(orbit),
        Views::Cameras(cameras) => wire::evaluate_spec::Views::Cameras(camera_list(cameras)),
    };
    let spec = Spec::Evaluate(wire::EvaluateSpec {
        dataset: dataset.name.clone(),
        version: dataset.version,
        views: Some(views),
        truth_samples_per_pixel: file.truth_samples_per_pixel,
        settings: file.settings.iter().map(|setting| setting.wire.clone()).collect(),
        truths: file.truths.iter().map(|t| t.to_wire().into()).collect(),
        seed: file.truth_seed,
        max_bounces: file.truth_max_bounces,
        timed_frames_per_view: file.timed_frames_per_view,
    });
    if arguments.anew {
        let job = submit(context, server, spec, String::new()).await?;
        return watch(context, server, &job.name, Events::Show).await;
    }
    // The same question has the same name, so the server answers with the job of an earlier run.
    let request_id = format!("sweep-{}", &blake3::hash(format!("{spec:?}").as_bytes()).to_hex()[..40]);
    let job = submit(context, server, spec.clone(), request_id).await?;
    match job.state() {
        wire::JobState::Succeeded => {
            context.output.say(&format!("{} has measured this already; --anew measures again", job.name));
            Ok(job)
        }
        wire::JobState::Failed | wire::JobState::Cancelled => {
            let job = submit(context, server, spec, String::new()).await?;
            watch(context, server, &job.name, Events::Show).await
        }
        _ => watch(context, server, &job.name, Events::Show).await,
    }
}

/// The summary's rows with what they have in common.
fn sweep_rows(summary: &Value, dataset: &Dataset, file: &SweepFile) -> anyhow::Result<Vec<SweepRow>> {
    let row = |row: &Value| {
        let mut row = row.as_object().context("a row is no object")?.clone();
        let index = row.get("setting_index").and_then(Value::as_u64).context("a row does not say which setting it is of")?;
        let setting = file.settings.get(index as usize).with_context(|| format!("a row is of setting {index}"))?;
        let parameters = &summary["parameters"];
        let object = parameters["object"].as_str().unwrap_or_default();
        let common = json!({
            "scene": dataset.scene,
            "object": object,
            "dataset": dataset.name,
            "version": dataset.version,
            "kind": summary["kind"],
            "variant": dataset.variant,
            "parameters": parameters,
            "dataset_bytes": summary["dataset_bytes"],
            "asked_backend": setting.backend,
            "asked_looks": setting.asked,
        });
        row.extend(common.as_object().cloned().unwrap_or_default());
        Ok(serde_json::from_value(Value::Object(row))?)
    };
    summary["rows"].as_array().context("it has no rows")?.iter().map(row).collect()
}

/// What is there already under its own bytes is kept.
async fn fetch_pictures(context: &Context, server: &Server, blobs: &[wire::ResultBlob], folder: &Path) -> anyhow::Result<()> {
    prepare_folder(folder, [], Existing::Replace)?;
    let mut client = server.datasets();
    let mut meter = Meter::new(context.output);
    for blob in blobs.iter().filter(|b| b.name.starts_with(FIRST_VIEW) && b.name.ends_with(".png")) {
        let path = folder.join(safe_name(&blob.name)?);
        if path.exists() && crate::upload::Blob::from_file(&path)?.blake3 == blob.blake3 {
            continue;
        }
        let wanted = Wanted { blake3: &blob.blake3, dataset: None, label: &blob.name };
        download(context, &mut client, &wanted, &path, Existing::Replace, &mut meter).await?;
    }
    meter.finish();
    Ok(())
}

/// `about` is any of the evaluations' summaries: it knows what the file left to the server.
fn conditions(file: &SweepFile, about: &Value, adapter: &str, server: String) -> Conditions {
    let number = |key: &str| about[key].as_u64().and_then(|n| u32::try_from(n).ok()).unwrap_or_default();
    let size_text = |w: u32, h: u32| format!("{w} × {h}");
    let (views, mut sizes) = match &file.views {
        Views::Orbit(orbit) => (orbit.count as usize, vec![size_text(orbit.width_px, orbit.height_px)]),
        Views::Cameras(cameras) => {
            let sizes = cameras.iter().filter_map(|(_, c)| c.intrinsics).map(|i| size_text(i.width_px, i.height_px));
            (cameras.len(), sizes.collect())
        }
    };
    sizes.dedup();
    Conditions {
        views,
        size: if sizes.len() == 1 { sizes.pop() } else { None },
        truth_samples_per_pixel: number("truth_samples_per_pixel"),
        timed_frames_per_view: number("timed_frames_per_view"),
        specular_reflectance: file.specular,
        adapter: Some(adapter.to_string()).filter(|a| !a.is_empty()),
        server,
    }
}

fn write_files(sweep: &Sweep, metric: Metric, out: &Path, existing: Existing) -> anyhow::Result<()> {
    let chart = evaluate::chart(sweep, metric);
    // Each before the next is drawn: a chart that cannot be loses no figures.
    let draw: [&dyn Fn() -> anyhow::Result<Vec<u8>>; 5] = [
        &|| Ok(serde_json::to_string_pretty(sweep)?.into_bytes()),
        &|| Ok(evaluate::csv(&sweep.rows)?.into_bytes()),
        &|| Ok(svg(&chart)?.into_bytes()),
        &|| Ok(png(&chart)?),
        &|| Ok(evaluate::report(sweep, metric)?.into_bytes()),
    ];
    FILES.iter().zip(draw).try_for_each(|(name, content)| write_atomically(&out.join(name), &content()?, existing))
}

/// A table a group; rows on the front are starred.
fn text(sweep: &Sweep, arguments: &Arguments) -> String {
    let (labels, on_front) = (sweep.labels(), evaluate::on_front(sweep, arguments.metric));
    let head = ["", "SETTING", "dE00", "dE00 p95", "FLIP", "SSIM", "L*", "ms/frame", "ms p95", "DISK", "GPU"].map(String::from).to_vec();
    let row = |i: &usize| {
        let row = &sweep.rows[*i];
        let e = &row.error;
        vec![
            if on_front[*i] { "*".into() } else { String::new() },
            labels[*i].clone(),
            format!("{:.3}", e.delta_e_2000_mean),
            format!("{:.3}", e.delta_e_2000_p95),
            format!("{:.4}", e.flip_mean),
            e.ssim.map_or("-".into(), |s| format!("{s:.4}")),
            format!("{:.4}", e.rmse_lab[0]),
            format!("{:.2}", row.millis_per_frame),
            format!("{:.2}", row.millis_per_frame_p95),
            bytes_text(row.dataset_bytes),
            row.gpu_bytes.map_or("-".into(), bytes_text),
        ]
    };
    let right: Vec<usize> = (2..head.len()).collect();
    let of_group = |group: &evaluate::Group| {
        let rows: Vec<Vec<String>> = std::iter::once(head.clone()).chain(group.rows.iter().map(row)).collect();
        format!("{}\n{}", group.name(), table(&rows, &right))
    };
    let mut text = sweep.groups().iter().map(of_group).collect::<Vec<_>>().join("\n\n");
    text.push_str(&format!("\n\n*: on the front of {} and time", arguments.metric.label()));
    if let Some(out) = &arguments.out {
        text.push_str(&format!("\n{} in {}", FILES.join(", "), out.display()));
    }
    text
}
