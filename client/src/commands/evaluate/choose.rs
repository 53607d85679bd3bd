//! `lumisphere evaluate choose`: which setting of a sweep follows from a bound. Asks no server.

use std::path::PathBuf;

use clap::Args;
use lumisphere::evaluate::bytes_text;
use serde_json::json;

use crate::choose_flags::{BoundFlags, Chosen};
use crate::context::Context;

/// Flags of `evaluate choose`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// What `evaluate sweep --out` wrote
    #[arg(value_name = "SWEEP.JSON")]
    sweep: PathBuf,
    #[command(flatten)]
    bounds: BoundFlags,
}

/// Chooses and prints.
pub fn run(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let chosen = arguments.bounds.choose_from(&arguments.sweep)?;
    let metric = arguments.bounds.metric;
    let error = metric.error(&chosen.row.error);
    let document = json!({"label": chosen.label, "group": chosen.group, "metric": metric.name(), "error": error, "row": chosen.row});
    context.output.document(&document, || text(&chosen, metric.label(), error))?;
    Ok(())
}

fn text(chosen: &Chosen, metric: &str, error: f64) -> String {
    let row = &chosen.row;
    let (median, p95, bytes) = (row.millis_per_frame, row.millis_per_frame_p95, bytes_text(row.dataset_bytes));
    format!(
        "{}\n{}\ndataset {} version {}, {bytes}\n{metric} {error:.4}\n{median:.2} ms a frame (95 %: {p95:.2} ms)",
        chosen.label, chosen.group, row.dataset, row.version
    )
}
