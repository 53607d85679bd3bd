//! What a load test says: a table, a JSON document, a chart.

use lumisphere::charts::{Axes, Line, LineChart, svg};
use lumisphere::textures::ReadStrategy;
use serde_json::{Value, json};

use super::Arguments;
use super::phases::Outcome;
use crate::output::table;

const PERCENTILES: [f64; 5] = [50.0, 90.0, 95.0, 99.0, 99.9];

/// Cache work of one phase.
struct Work {
    look_ups: u64,
    misses: u64,
    texel_fetches: u64,
    texel_misses: u64,
    bytes_read: u64,
    bytes_decoded: u64,
    rows_redundant: u64,
}

/// Counters of the whole server: another client's work is among them.
fn work(outcome: &Outcome) -> Work {
    let (before, after) = (outcome.before.texels.unwrap_or_default(), outcome.after.texels.unwrap_or_default());
    // Someone else may have reset the counters meanwhile.
    let since = |get: fn(&lumisphere_proto::v1alpha1::TexelStats) -> u64| get(&after).saturating_sub(get(&before));
    Work {
        look_ups: since(|t| t.look_ups),
        misses: since(|t| t.misses),
        texel_fetches: since(|t| t.texel_fetches),
        texel_misses: since(|t| t.texel_misses),
        bytes_read: since(|t| t.bytes_read),
        bytes_decoded: since(|t| t.bytes_decoded),
        rows_redundant: since(|t| t.rows_redundant),
    }
}

fn percent(part: u64, whole: u64) -> f64 {
    100.0 * part as f64 / whole.max(1) as f64
}

/// Everything, for programs.
pub fn document(arguments: &Arguments, version: u64, results: &[Outcome]) -> Value {
    let phases: Vec<Value> = results.iter().map(phase).collect();
    json!({
        "dataset": arguments.dataset,
        "version": version,
        "viewers": arguments.viewers,
        "rate_hz": arguments.rate,
        "requests_per_viewer": arguments.requests,
        "seed": arguments.seed,
        "phases": phases,
    })
}

fn phase(outcome: &Outcome) -> Value {
    let w = work(outcome);
    let latency: serde_json::Map<String, Value> = PERCENTILES
        .iter()
        .map(|p| (format!("p{p}"), millis(outcome.latency.value_at_percentile(*p)).into()))
        .chain([("max".to_string(), millis(outcome.latency.max()).into()), ("mean".to_string(), (outcome.latency.mean() / 1e3).into())])
        .collect();
    json!({
        "phase": outcome.phase.name(),
        "strategy": outcome.strategy.map(ReadStrategy::name),
        "frames": outcome.frames,
        "frames_not_final": outcome.not_final,
        "refused": outcome.refused,
        "seconds": outcome.seconds,
        "frames_per_second": outcome.frames as f64 / outcome.seconds,
        "latency_millis": latency,
        "look_ups": w.look_ups,
        "misses": w.misses,
        "miss_percent": percent(w.misses, w.look_ups),
        "texel_fetches": w.texel_fetches,
        "texel_misses": w.texel_misses,
        "texel_miss_percent": percent(w.texel_misses, w.texel_fetches),
        "bytes_read": w.bytes_read,
        "bytes_decoded": w.bytes_decoded,
        "rows_redundant": w.rows_redundant,
    })
}

fn millis(micros: u64) -> f64 {
    micros as f64 / 1e3
}

/// For people.
pub fn text(results: &[Outcome]) -> String {
    let head = [
        "phase",
        "strategy",
        "frames",
        "refused",
        "frames/s",
        "p50 ms",
        "p95 ms",
        "p99 ms",
        "max ms",
        "miss %",
        "texel miss %",
        "MB read",
        "MB decoded",
    ];
    let mut rows = vec![head.map(str::to_string).to_vec()];
    for outcome in results {
        let w = work(outcome);
        let at = |p: f64| format!("{:.1}", millis(outcome.latency.value_at_percentile(p)));
        rows.push(vec![
            outcome.phase.name().into(),
            outcome.strategy.map_or("-", ReadStrategy::name).into(),
            outcome.frames.to_string(),
            outcome.refused.to_string(),
            format!("{:.1}", outcome.frames as f64 / outcome.seconds),
            at(50.0),
            at(95.0),
            at(99.0),
            format!("{:.1}", millis(outcome.latency.max())),
            format!("{:.3}", percent(w.misses, w.look_ups)),
            format!("{:.3}", percent(w.texel_misses, w.texel_fetches)),
            format!("{:.1}", w.bytes_read as f64 / 1e6),
            format!("{:.1}", w.bytes_decoded as f64 / 1e6),
        ]);
    }
    table(&rows, &[2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12])
}

/// Latency against the share of requests that took longer: a line a phase.
pub fn chart(results: &[Outcome]) -> anyhow::Result<String> {
    let line = |outcome: &Outcome| {
        let strategy = outcome.strategy.map(|s| format!(", {s}")).unwrap_or_default();
        // From half of the requests to the slowest one.
        let shares = (0..).map(|k| 0.5f64.powi(k + 1)).take_while(|share| share * outcome.frames as f64 >= 1.0);
        let points = shares.map(|share| (1.0 / share, millis(outcome.latency.value_at_quantile(1.0 - share))));
        Line { name: format!("{}{strategy}", outcome.phase.name()), points: points.collect() }
    };
    Ok(svg(&LineChart {
        axes: Axes::Logarithmic,
        title: "Frame latency",
        x_label: "one frame in so many takes longer",
        y_label: "milliseconds from when it was due",
        lines: results.iter().map(line).collect(),
    })?)
}
