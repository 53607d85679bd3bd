//! `lumisphere evaluate`: submits the job, waits, prints the table, fetches the pictures; and over many datasets and settings, `sweep`.

mod choose;
mod datasets;
mod parameter_map;
mod sweep;

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use lumisphere_proto::v1alpha1 as wire;
use serde::Deserialize;
use serde_json::{Value, json};
use wire::job_spec::Spec;

use super::job::{camera_list, download_results, submit};
use super::watch::{Events, watch};
use crate::cameras::{CameraFlags, Views, parse_vec3};
use crate::context::Context;
use crate::files::{Existing, prepare_folder};
use crate::normal_map_flags::NormalMapFlags;
use crate::output::table;
use crate::render_settings::{Backend, Blend, ClearFlags, Component, Filter, GlossFlags, LightFlags, Looks, settings, with_uploads};

/// What to evaluate.
#[derive(Debug, Args)]
pub struct EvaluateFlags {
    /// Dataset to evaluate
    // Present unless a verb of `evaluate` makes it needless.
    #[arg(long, value_name = "NAME", required = true)]
    dataset: Option<String>,
    /// Which version [default: the latest]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    version: u64,
    #[command(flatten)]
    cameras: CameraFlags,
    /// Terms to evaluate, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "reconstruction,mirror")]
    components: Vec<Component>,
    /// Blends to evaluate for mirror and full, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "distance,angle,average,reflection:4,normal:4,corrected,environment-map")]
    blends: Vec<Blend>,
    /// Specular reflectance, each in 0 to 1
    #[arg(long, value_name = "R,G,B", value_parser = parse_vec3, default_value = "1,1,1")]
    specular: [f32; 3],
    /// Mirror reflections of mirror and full one after the other, 1 to 4; the truth has as many [default: 1]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    reflections: u32,
    #[command(flatten)]
    gloss: GlossFlags,
    #[command(flatten)]
    light: LightFlags,
    #[command(flatten)]
    clear: ClearFlags,
    #[command(flatten)]
    bumps: NormalMapFlags,
    /// How cube maps are read, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "footprint")]
    filters: Vec<Filter>,
    /// Where to compute
    #[arg(long, value_enum, default_value = "auto")]
    backend: Backend,
    /// What mirror and full are compared with, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "one-reflection")]
    truths: Vec<Truth>,
    /// Paths per pixel of the truth [default: 256]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    truth_samples_per_pixel: u32,
    /// Surface interactions of the truth's paths [default: as captured]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    max_bounces: u32,
    /// Frames of each setting at each view whose time counts, beside a first one [default: 4]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    timed_frames_per_view: u32,
    /// Of the truth's random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// What is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Truth {
    /// One mirror reflection over the diffuse scene
    OneReflection,
    /// The object is a mirror and sees itself as one
    PhysicalMirror,
}

impl Truth {
    /// The wire's form.
    pub fn to_wire(self) -> wire::Truth {
        match self {
            Self::OneReflection => wire::Truth::OneReflection,
            Self::PhysicalMirror => wire::Truth::PhysicalMirror,
        }
    }
}

/// `evaluate` alone, or one of its verbs.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Arguments {
    #[command(flatten)]
    evaluate: EvaluateFlags,
    /// Fetch frames, truths and per-pixel error images into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Overwrite files
    #[arg(long)]
    force: bool,
    #[command(subcommand)]
    command: Option<Command>,
}

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Evaluate every combination of captures and settings that a file names; write table, chart and report
    Sweep(sweep::Arguments),
    /// The cheapest setting of a sweep that keeps a bound
    Choose(choose::Arguments),
    /// How well models fit what a texel looks like: the tests of the parameter-map thesis, its methods beside ours
    ParameterMap(parameter_map::Arguments),
}

impl EvaluateFlags {
    /// The wire's form.
    pub async fn to_wire(&self, context: &Context) -> anyhow::Result<wire::EvaluateSpec> {
        let views = match self.cameras.views()? {
            Views::Orbit(orbit) => wire::evaluate_spec::Views::Orbit(orbit),
            Views::Cameras(cameras) => wire::evaluate_spec::Views::Cameras(camera_list(cameras)),
        };
        let mut settings = Vec::new();
        for each in self.settings() {
            settings.push(with_uploads(each, context).await?);
        }
        Ok(wire::EvaluateSpec {
            dataset: self.dataset.clone().unwrap_or_default(),
            version: self.version,
            views: Some(views),
            truth_samples_per_pixel: self.truth_samples_per_pixel,
            settings,
            truths: self.truths.iter().map(|t| t.to_wire().into()).collect(),
            seed: self.seed,
            max_bounces: self.max_bounces,
            timed_frames_per_view: self.timed_frames_per_view,
        })
    }

    fn settings(&self) -> Vec<wire::RenderSettings> {
        let (bumps, reflections) = (&self.bumps, self.reflections);
        let looks = Looks { gloss: &self.gloss, light: &self.light, clear: &self.clear, bumps, reflections };
        let one = |component, blend, filter| settings(component, blend, self.specular, filter, self.backend, looks);
        let of = |component: Component, filter: Filter| {
            component.blends(&self.blends).into_iter().map(move |blend| one(component, blend, filter))
        };
        self.filters.iter().flat_map(|&filter| self.components.iter().flat_map(move |&component| of(component, filter))).collect()
    }
}

/// Runs what was asked for.
pub async fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    match &arguments.command {
        Some(Command::Sweep(arguments)) => sweep::run(arguments, context).await,
        Some(Command::Choose(arguments)) => choose::run(arguments, context),
        Some(Command::ParameterMap(arguments)) => parameter_map::run(arguments, context),
        None => run_one(arguments, context).await,
    }
}

/// Evaluates and prints.
async fn run_one(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let spec = arguments.evaluate.to_wire(context).await?;
    let existing = Existing::from_force(arguments.force);
    if let Some(out) = &arguments.out {
        prepare_folder(out, [], existing)?;
    }
    let server = context.connect().await?;
    let job = submit(context, &server, Spec::Evaluate(spec), String::new()).await?;
    context.output.say(&format!("submitted {}", job.name));
    let job = watch(context, &server, &job.name, Events::Show).await?;
    let files = match &arguments.out {
        Some(out) => download_results(context, &server, &job, out, existing).await?,
        None => Vec::new(),
    };
    let summary: Value = serde_json::from_str(&job.result.unwrap_or_default().summary_json).unwrap_or(Value::Null);
    let document = json!({"job": job.name, "summary": summary, "out": arguments.out, "files": files});
    context.output.document(&document, || {
        let mut text = summary_text(&summary);
        if let Some(out) = &arguments.out {
            text.push_str(&format!("\n\n{} files in {}", files.len(), out.display()));
        }
        text
    })?;
    Ok(())
}

/// One row of the job's summary (`lumisphere::evaluate::Row` as JSON); a figure that the server does not give is shown as "-".
#[derive(Debug, Deserialize)]
struct Row {
    component: String,
    #[serde(default)]
    blend: Option<String>,
    #[serde(default)]
    exponent: Option<f64>,
    #[serde(default)]
    filter: Option<String>,
    #[serde(default)]
    truth: Option<String>,
    #[serde(default)]
    rmse_rgb: Vec<Option<f64>>,
    #[serde(default)]
    rmse_lab: Vec<Option<f64>>,
    #[serde(default)]
    psnr_db: Option<f64>,
    #[serde(default)]
    ssim: Option<f64>,
    #[serde(default)]
    flip_mean: Option<f64>,
    #[serde(default)]
    delta_e_2000_mean: Option<f64>,
    #[serde(default)]
    delta_e_2000_p95: Option<f64>,
    #[serde(default)]
    millis_per_frame: Option<f64>,
    #[serde(default)]
    millis_per_frame_p95: Option<f64>,
}

const HEAD: [&str; 17] = [
    "COMPONENT",
    "BLEND",
    "FILTER",
    "TRUTH",
    "R",
    "G",
    "B",
    "L*",
    "a*",
    "b*",
    "PSNR",
    "SSIM",
    "FLIP",
    "dE00",
    "dE00 p95",
    "ms/frame",
    "ms p95",
];

/// The table of errors: RMSE in linear RGB and in L*a*b*, PSNR (dB), SSIM, FLIP, CIEDE2000.
fn summary_text(summary: &Value) -> String {
    let rows: Vec<Row> = summary["rows"].as_array().into_iter().flatten().filter_map(|r| serde_json::from_value(r.clone()).ok()).collect();
    if rows.is_empty() {
        return format!("{summary:#}");
    }
    let cells: Vec<Vec<String>> = std::iter::once(HEAD.map(String::from).to_vec()).chain(rows.iter().map(Row::cells)).collect();
    table(&cells, &(4..HEAD.len()).collect::<Vec<_>>())
}

impl Row {
    fn cells(&self) -> Vec<String> {
        let blend = match (&self.blend, self.exponent) {
            (Some(blend), Some(n)) => format!("{blend}({n})"),
            (Some(blend), None) => blend.clone(),
            (None, _) => "-".into(),
        };
        let number = |value: Option<f64>, digits: usize| value.map_or("-".to_string(), |v| format!("{v:.digits$}"));
        let nth = |values: &[Option<f64>], i: usize| number(values.get(i).copied().flatten(), 5);
        let name = |name: &Option<String>| name.clone().unwrap_or_else(|| "-".into());
        let mut cells = vec![self.component.clone(), blend, name(&self.filter), name(&self.truth)];
        cells.extend((0..3).map(|i| nth(&self.rmse_rgb, i)));
        cells.extend((0..3).map(|i| nth(&self.rmse_lab, i)));
        let figures = [
            (self.psnr_db, 2),
            (self.ssim, 4),
            (self.flip_mean, 4),
            (self.delta_e_2000_mean, 3),
            (self.delta_e_2000_p95, 3),
            (self.millis_per_frame, 1),
            (self.millis_per_frame_p95, 1),
        ];
        cells.extend(figures.map(|(value, digits)| number(value, digits)));
        cells
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_a_line_a_row_and_says_what_is_missing() {
        let summary = json!({"rows": [
            {"component": "reconstruction", "blend": null, "rmse_rgb": [0.001, 0.002, 0.003], "psnr_db": 50.0},
            {"component": "mirror", "blend": "normal", "exponent": 4.0, "truth": "one_reflection", "ssim": 0.5},
        ]});
        let text = summary_text(&summary);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 3);
        assert!(lines[1].contains("0.00200") && lines[1].contains("50.00") && lines[1].contains('-'), "{text}");
        assert!(lines[2].contains("normal(4)") && lines[2].contains("0.5000"), "{text}");
    }
}
