//! `lumisphere evaluate parameter-map`: the parameter-map thesis' tests of its models, with its methods beside ours. Asks no server.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use clap::{Args, ValueEnum};
use lumisphere::charts::{Axes, Line, LineChart, png, svg};
use lumisphere::evaluate::csv;
use lumisphere::evaluate::fits::{
    PhotographRow, PlaneRow, Slice, SurfaceTest, View, photographed, plane_test, plane_tests, surface_methods, surface_tests,
};
use lumisphere::images::{Rgb8, contact_sheet, encode_png};
use lumisphere::scenes::{BuiltinOptions, builtin};
use serde_json::json;

use crate::context::Context;
use crate::exit::Failure;
use crate::files::{Existing, prepare_folder, write_atomically};
use crate::output::table;
use crate::progress::{Meter, Progress};

/// Flags of `evaluate parameter-map`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Which tests
    #[arg(long, value_enum, default_value = "paper")]
    suite: Suite,
    /// Sections of the paper, separated by commas [default: all]
    #[arg(long, value_name = "SECTION", value_delimiter = ',')]
    sections: Vec<String>,
    /// Texels across the photographed surfaces
    #[arg(long, value_name = "N", default_value_t = 96, value_parser = clap::value_parser!(u32).range(16..=128))]
    size_texels: u32,
    /// Paths per observation of the photographed surfaces
    #[arg(long, value_name = "N", default_value_t = 16, value_parser = clap::value_parser!(u32).range(1..=4096))]
    samples_per_observation: u32,
    /// Write fits.json, plane.csv, surfaces.csv, charts and pictures into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Overwrite files
    #[arg(long)]
    force: bool,
}

/// A set of tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Suite {
    /// 11.3.1 to 13.3 and 16.2 to 16.3 of Mortensen & Andersen 2007
    Paper,
}

const TABLES: [&str; 3] = ["fits.json", "plane.csv", "surfaces.csv"];

/// What came of it.
#[derive(Default)]
struct Outcome {
    plane: Vec<PlaneRow>,
    surfaces: Vec<PhotographRow>,
    /// In `--out`.
    files: Vec<String>,
}

/// Runs the tests.
pub fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let Suite::Paper = arguments.suite;
    let (plane, surfaces) = (plane_tests(), surface_tests());
    let known: Vec<&str> = plane.iter().map(|test| test.section).chain(surfaces.iter().map(|test| test.section)).collect();
    if let Some(unknown) = arguments.sections.iter().find(|section| !known.contains(&section.as_str())) {
        return Err(Failure::Usage(format!("--sections {unknown}: {} expected", known.join(", "))).into());
    }
    let is_wanted = |section: &str| arguments.sections.is_empty() || arguments.sections.iter().any(|s| s == section);
    let existing = Existing::from_force(arguments.force);
    if let Some(out) = &arguments.out {
        prepare_folder(out, [], existing)?;
        // Before any work: names of charts follow from it.
        if existing == Existing::Keep && std::fs::read_dir(out).is_ok_and(|mut files| files.next().is_some()) {
            return Err(Failure::Precondition(format!("{} is not empty; --force writes into it", out.display())).into());
        }
    }
    let mut outcome = Outcome::default();
    for test in plane.iter().filter(|test| is_wanted(test.section)) {
        context.output.say(&format!("{} {}", test.section, test.title));
        let (rows, slices) = plane_test(test)?;
        outcome.plane.extend(rows);
        if let Some(out) = &arguments.out {
            write_slices(&slices, test.section, out, existing, &mut outcome.files)?;
        }
    }
    for test in surfaces.iter().filter(|test| is_wanted(test.section)) {
        context.output.say(&format!("{} {}", test.section, test.title));
        surface(test, arguments, existing, context, &mut outcome)?;
    }
    let document = json!({
        "suite": "paper",
        "about": plane.iter().map(|t| (t.section, t.title, t.thesis)).chain(surfaces.iter().map(|t| (t.section, t.title, t.thesis)))
            .filter(|(section, ..)| is_wanted(section))
            .map(|(section, title, thesis)| json!({"section": section, "title": title, "thesis": thesis})).collect::<Vec<_>>(),
        "size_texels": arguments.size_texels,
        "samples_per_observation": arguments.samples_per_observation,
        "plane": outcome.plane,
        "surfaces": outcome.surfaces,
        "out": arguments.out,
        "files": outcome.files,
    });
    if let Some(out) = &arguments.out {
        write_atomically(&out.join(TABLES[0]), &serde_json::to_vec_pretty(&document)?, existing)?;
        write_atomically(&out.join(TABLES[1]), csv(&outcome.plane)?.as_bytes(), existing)?;
        write_atomically(&out.join(TABLES[2]), csv(&outcome.surfaces)?.as_bytes(), existing)?;
    }
    context.output.document(&document, || text(&outcome))?;
    Ok(())
}

/// Lines that are told apart at a glance.
const LINES_A_CHART: usize = 7;

/// A chart a case, or one a family of methods: radiance of a texel in the plane of the highlight.
fn write_slices(slices: &[Slice], section: &str, out: &Path, existing: Existing, files: &mut Vec<String>) -> anyhow::Result<()> {
    for slice in slices {
        let Some(((truth, truth_points), fits)) = slice.lines.split_first() else { continue };
        // "zh:16" is of "zh".
        let family = |name: &str| name.split(':').next().unwrap_or(name).to_string();
        let mut charts: Vec<(Option<String>, Vec<Line>)> = Vec::new();
        for (name, points) in fits {
            let wanted = (fits.len() > LINES_A_CHART).then(|| family(name));
            if charts.last().is_none_or(|(last, _)| *last != wanted) {
                charts.push((wanted, vec![Line { name: truth.clone(), points: truth_points.clone() }]));
            }
            charts.last_mut().into_iter().for_each(|(_, lines)| lines.push(Line { name: name.clone(), points: points.clone() }));
        }
        for (family, lines) in charts {
            let words = slice.case.split(' ').filter(|word| *word != "=").map(String::from);
            let last = family.iter().flat_map(|family| family.split(' ').map(String::from));
            let name = [section.to_string()].into_iter().chain(words).chain(last).collect::<Vec<_>>().join("-");
            let title = format!("{section}: {}", slice.case);
            let chart = LineChart {
                axes: Axes::Linear,
                title: &title,
                x_label: "degrees from the normal toward the mirror direction",
                y_label: "green radiance of texel (8, 8)",
                lines,
            };
            write_atomically(&out.join(format!("{name}.svg")), svg(&chart)?.as_bytes(), existing)?;
            write_atomically(&out.join(format!("{name}.png")), &png(&chart)?, existing)?;
            files.extend([format!("{name}.svg"), format!("{name}.png")]);
        }
    }
    Ok(())
}

fn surface(test: &SurfaceTest, arguments: &Arguments, existing: Existing, context: &Context, outcome: &mut Outcome) -> anyhow::Result<()> {
    let scene = builtin("patchwork", &BuiltinOptions::full())?;
    let shown = Shown(Mutex::new(Meter::new(context.output)));
    let surface = photographed(test, &scene, arguments.size_texels, arguments.samples_per_observation, &shown)?;
    let mut sheets: [Vec<Rgb8>; 2] = Default::default();
    let methods = surface_methods();
    for (done, &method) in methods.iter().enumerate() {
        shown.update("fitting", done as u64, methods.len() as u64);
        let (rows, pictures) = surface.compare(method)?;
        outcome.surfaces.extend(rows);
        sheets.iter_mut().zip(pictures).for_each(|(sheet, pictures)| sheet.extend(pictures.map(enlarged)));
    }
    shown.finish();
    let Some(out) = &arguments.out else { return Ok(()) };
    for (view, sheet) in [View::Glossy, View::Diffuse].into_iter().zip(&sheets) {
        let name = format!("{}-{}.png", test.section, if view == View::Glossy { "glossy" } else { "diffuse" });
        write_atomically(&out.join(&name), &encode_png(&contact_sheet(sheet, 6)?)?, existing)?;
        outcome.files.push(name);
    }
    Ok(())
}

/// Texels as squares, so that a small map can be looked at.
fn enlarged(picture: Rgb8) -> Rgb8 {
    const LEAST_WIDTH_PX: usize = 160;
    let factor = LEAST_WIDTH_PX.div_ceil(picture.width.max(1));
    let mut large = Rgb8::filled(factor * picture.width, factor * picture.height, [0; 3]);
    for (at, pixel) in large.bytes.chunks_exact_mut(3).enumerate() {
        let (column, row) = (at % (factor * picture.width), at / (factor * picture.width));
        pixel.copy_from_slice(&picture.pixel(column / factor, row / factor));
    }
    large
}

/// A library's progress on a meter.
struct Shown(Mutex<Meter>);

impl Shown {
    fn update(&self, stage: &str, done: u64, total: u64) {
        if let Ok(mut meter) = self.0.lock() {
            meter.update(Progress { stage, done, total, seconds_left: None, detail: "" });
        }
    }

    fn finish(self) {
        if let Ok(meter) = self.0.into_inner() {
            meter.finish();
        }
    }
}

impl lumisphere::progress::Progress for Shown {
    fn report(&self, what: &str, done: u64, total: u64) {
        self.update(what, done, total);
    }

    fn is_cancelled(&self) -> bool {
        false
    }
}

fn text(outcome: &Outcome) -> String {
    let mut parts = Vec::new();
    if !outcome.plane.is_empty() {
        parts.push(plane_table(&outcome.plane));
    }
    if !outcome.surfaces.is_empty() {
        parts.push(surface_table(&outcome.surfaces));
    }
    parts.join("\n\n")
}

fn plane_table(rows: &[PlaneRow]) -> String {
    let head = ["section", "case", "method", "numbers", "residual %", "thesis %", "rmse", "rmse low", "peak", "m", "drift % K_d r K_s m"];
    let percent = |p: [f64; 3]| p.map(|v| format!("{v:.2}")).join(" ");
    let line = |row: &PlaneRow| {
        let drift = row.drift.map(|d| [d.diffuse_percent, d.axis_percent, d.specular_percent, d.exponent_percent]);
        vec![
            row.section.to_string(),
            row.case.clone(),
            row.method.clone(),
            format!("{:.1}", row.floats),
            percent(row.residual_percent),
            row.thesis_percent.map_or(String::new(), percent),
            format!("{:.5}", row.rmse),
            format!("{:.5}", row.rmse_low),
            format!("{:.3}", row.peak),
            row.exponent.map_or(String::new(), |m| format!("{m:.1}")),
            drift.map_or(String::new(), |d| d.map(|v| format!("{v:.2}")).join(" ")),
        ]
    };
    let rows: Vec<Vec<String>> = std::iter::once(head.map(String::from).to_vec()).chain(rows.iter().map(line)).collect();
    table(&rows, &[3, 4, 5, 6, 7, 8, 9, 10])
}

fn surface_table(rows: &[PhotographRow]) -> String {
    let head = ["section", "view", "fit knew it", "method", "numbers", "mean", "std. dev.", "thesis"];
    let line = |row: &PhotographRow| {
        vec![
            row.section.to_string(),
            if row.view == View::Glossy { "glossy" } else { "diffuse" }.to_string(),
            if row.held_out { "no" } else { "yes" }.to_string(),
            row.method.clone(),
            format!("{:.1}", row.floats),
            format!("{:.2}", row.mean),
            format!("{:.2}", row.deviation),
            row.thesis.map_or(String::new(), |[mean, deviation]| format!("{mean:.2} {deviation:.2}")),
        ]
    };
    let rows: Vec<Vec<String>> = std::iter::once(head.map(String::from).to_vec()).chain(rows.iter().map(line)).collect();
    table(&rows, &[4, 5, 6, 7])
}
