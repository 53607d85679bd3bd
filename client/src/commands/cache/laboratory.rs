//! `lumisphere cache replay` and `cache report`: other caches' fate under a recorded trace.

pub mod on_server;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use lumisphere::charts::{Axes, Line, LineChart, svg};
use lumisphere::textures::laboratory::{self, Order, Outcome, compare};
use lumisphere::textures::{CacheOptions, Codec, PolicyKind, ReadStrategy, Store, StoreOptions, Trace};
use serde::Serialize;

use crate::context::Context;
use crate::exit::Failure;
use crate::files::{Existing, write_atomically};
use crate::output::table;

/// Flags of `cache replay`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The trace, as `cache record` wrote it
    #[arg(value_name = "TRACE")]
    trace: PathBuf,
    /// Policies: lru, clock, arc, s3_fifo, frame_lru, gittins; Belady's optimum (1966) is always beside them [default: all]
    #[arg(long, value_name = "POLICY", value_delimiter = ',')]
    policies: Vec<PolicyKind>,
    /// Read strategies: on_demand, on_demand_restart, half_threshold, full_image, block [default: all]
    #[arg(long, value_name = "STRATEGY", value_delimiter = ',')]
    strategies: Vec<ReadStrategy>,
    /// How pages are stored: bits-chunk, zstd-chunk, zstd-seq or lzw-seq
    #[arg(long, value_name = "CODEC", default_value_t = Codec::DEFAULT)]
    codec: Codec,
    /// Sizes in pages
    #[arg(long, value_name = "PAGES", value_delimiter = ',', default_value = "2,4,8,16,32,64,128,256")]
    sizes: Vec<u32>,
    /// Which of the trace's parts: 0 the first dataset's pages (a recorded path's faces); of a recorded path, 1 the sample maps, 2 and on the
    /// coarser levels
    #[arg(long, value_name = "INDEX", default_value_t = 0)]
    part: u32,
    /// Also send the trace through a real cache over this data folder of a server, which must not be running, and say how long it took;
    /// pages then unpack as they are stored, whatever --codec says
    #[arg(long, value_name = "FOLDER")]
    data_dir: Option<PathBuf>,
    /// Also send the trace through real caches on the server, over its data, while it serves: bytes read and the time that it took
    #[arg(long, conflicts_with = "data_dir")]
    on_server: bool,
    /// Write the table as CSV to this file
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the file
    #[arg(long)]
    force: bool,
}

/// Flags of `cache report`.
#[derive(Debug, Args)]
pub struct ReportArguments {
    /// What `cache replay --out` wrote
    #[arg(value_name = "CSV")]
    table: PathBuf,
    /// The chart to write, SVG
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// What to draw against the size
    #[arg(long, value_enum, default_value = "misses")]
    value: Value,
    /// Draw this strategy's lines
    #[arg(long, value_name = "STRATEGY", default_value = "block")]
    strategy: ReadStrategy,
    /// Overwrite the file
    #[arg(long)]
    force: bool,
}

/// A line of the table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    strategy: &'static str,
    policy: &'static str,
    size_pages: u32,
    texel_fetches: u64,
    misses: u64,
    miss_percent: f64,
    visits: u64,
    loads: u64,
    rows_decoded: u64,
    bytes_decoded: u64,
    /// (loads − Belady's) / (LRU's − Belady's); none where LRU is optimal.
    excess: Option<f64>,
    /// All requests through a real cache on one thread; none where no data are at hand and for Belady's order, which no cache can have.
    millis: Option<f64>,
    /// Of those, reading and unpacking.
    decode_millis: Option<f64>,
    /// From disk, by the real cache.
    bytes_read: Option<u64>,
}

const HEAD: &str = "strategy,policy,size_pages,texel_fetches,misses,miss_percent,visits,loads,rows_decoded,bytes_decoded,excess,millis,\
                    decode_millis,bytes_read";

/// What a chart shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Value {
    /// Misses, percent of texel fetches
    Misses,
    /// (loads − Belady's) / (LRU's − Belady's): 0 is perfect, 1 is LRU; sizes where LRU is perfect are left out
    Excess,
    /// Decoded, MB
    Decoded,
    /// Time of all requests through a real cache, ms: of tables with --on-server or --data-dir
    Time,
}

impl Value {
    // Its column, a factor, and the axis.
    fn column(self) -> (&'static str, f64, &'static str) {
        match self {
            Self::Misses => ("miss_percent", 1.0, "misses, % of texel fetches"),
            Self::Excess => ("excess", 1.0, "(misses - Belady's) / (LRU's - Belady's)"),
            Self::Decoded => ("bytes_decoded", 1e-6, "decoded, MB"),
            Self::Time => ("millis", 1.0, "time of all requests, ms"),
        }
    }
}

/// Replays and prints.
pub async fn replay(arguments: &Arguments, context: &Context) -> anyhow::Result<()> {
    let whole = read_trace(&arguments.trace)?;
    let names: Vec<_> = whole.versions.iter().map(|v| format!("{} of {}x{}", v.dataset, v.shape.width, v.shape.height)).collect();
    let trace = whole
        .only(arguments.part)
        .ok_or_else(|| Failure::Usage(format!("--part is {}, the trace has {}: {}", arguments.part, names.len(), names.join(", "))))?;
    if trace.is_truncated {
        context.output.say("the recording reached its limit: the end of what was rendered is missing");
    }
    let part = &trace.versions[0];
    context.output.say(&format!("{} version {}: {} events", part.dataset, part.version, trace.events.len()));
    let mut rows = rows(arguments, &trace);
    if let Some(folder) = &arguments.data_dir {
        measure(folder, &trace, &mut rows)?;
    }
    if arguments.on_server {
        on_server::measure(context, &trace, &arguments.sizes, &mut rows).await?;
    }
    if let Some(out) = &arguments.out {
        write_atomically(out, csv(&rows).as_bytes(), Existing::from_force(arguments.force))?;
    }
    context.output.document(&rows, || text(&rows))?;
    Ok(())
}

/// A trace file.
pub fn read_trace(path: &Path) -> anyhow::Result<Trace> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Trace::from_bytes(&bytes).map_err(|e| Failure::Usage(format!("{}: {e}", path.display())).into())
}

fn rows(arguments: &Arguments, trace: &Trace) -> Vec<Row> {
    let strategies = if arguments.strategies.is_empty() { ReadStrategy::ALL.to_vec() } else { arguments.strategies.clone() };
    let policies = if arguments.policies.is_empty() { PolicyKind::ALL.to_vec() } else { arguments.policies.clone() };
    let orders: Vec<Order> = policies.into_iter().map(Order::Policy).chain([Order::Belady]).collect();
    // A cache of so many pages, as it charges them.
    let page_bytes = trace.versions[0].shape.resident_bytes() as u64;
    let sizes: Vec<u64> = arguments.sizes.iter().map(|pages| u64::from(*pages) * page_bytes).collect();
    let outcomes = compare(trace, arguments.codec, &strategies, &orders, &sizes);
    outcomes.iter().map(|outcome| row(outcome, (outcome.setting.capacity_bytes / page_bytes) as u32)).collect()
}

/// Adds what a real cache takes.
fn measure(folder: &Path, trace: &Trace, rows: &mut [Row]) -> anyhow::Result<()> {
    if !folder.join("datasets").is_dir() {
        return Err(Failure::Usage(format!("{} is no data folder of a server", folder.display())).into());
    }
    let (store, _) = Store::open(folder, StoreOptions::local())?;
    let part = &trace.versions[0];
    let version = store.open_version(&part.dataset, Some(part.version))?;
    for row in rows.iter_mut() {
        // Belady's is no policy.
        let Ok(policy) = row.policy.parse() else { continue };
        let strategy = row.strategy.parse().expect("a row has the name of a strategy");
        let decoded_bytes = u64::from(row.size_pages) * part.shape.resident_bytes() as u64;
        let options = CacheOptions { strategy, decoded_policy: policy, ..CacheOptions::decoded(decoded_bytes) };
        let replayed = laboratory::replay(trace, std::slice::from_ref(&version), options, &|| false)?;
        let (counted, nanos) = replayed.expect("nobody stops it");
        row.millis = Some(1e-6 * nanos as f64);
        row.decode_millis = Some(1e-6 * (counted.decoded.read_nanos + counted.decoded.decode_nanos) as f64);
        row.bytes_read = Some(counted.decoded.bytes_read);
    }
    Ok(())
}

fn row(outcome: &Outcome, size_pages: u32) -> Row {
    Row {
        strategy: outcome.setting.strategy.name(),
        policy: outcome.setting.order.name(),
        size_pages,
        texel_fetches: outcome.texel_fetches,
        misses: outcome.misses,
        miss_percent: 100.0 * outcome.misses as f64 / outcome.texel_fetches.max(1) as f64,
        visits: outcome.visits,
        loads: outcome.loads,
        rows_decoded: outcome.rows_decoded,
        bytes_decoded: outcome.bytes_decoded,
        excess: outcome.excess,
        millis: None,
        decode_millis: None,
        bytes_read: None,
    }
}

fn csv(rows: &[Row]) -> String {
    let mut text = format!("{HEAD}\n");
    for r in rows {
        let Row { strategy, policy, size_pages, texel_fetches, misses, miss_percent, visits, loads, rows_decoded, bytes_decoded, .. } = r;
        let measured = [r.excess, r.millis, r.decode_millis, r.bytes_read.map(|bytes| bytes as f64)];
        let [excess, millis, decode, read] = measured.map(|number| number.map(|n| n.to_string()).unwrap_or_default());
        let counts = format!("{texel_fetches},{misses},{miss_percent},{visits},{loads},{rows_decoded},{bytes_decoded}");
        writeln!(text, "{strategy},{policy},{size_pages},{counts},{excess},{millis},{decode},{read}").expect("a string takes every line");
    }
    text
}

fn text(rows: &[Row]) -> String {
    let head = ["strategy", "policy", "pages", "miss % of fetches", "visits", "loads", "decoded MB", "excess over Belady", "ms"];
    let mut cells = vec![head.map(str::to_string).to_vec()];
    cells.extend(rows.iter().map(|r| {
        vec![
            r.strategy.into(),
            r.policy.into(),
            r.size_pages.to_string(),
            format!("{:.3}", r.miss_percent),
            r.visits.to_string(),
            r.loads.to_string(),
            format!("{:.1}", r.bytes_decoded as f64 / 1e6),
            r.excess.map_or("-".into(), |e| format!("{e:.2}")),
            r.millis.map_or("-".into(), |millis| format!("{millis:.1}")),
        ]
    }));
    table(&cells, &[2, 3, 4, 5, 6, 7, 8])
}

/// Draws and says where.
pub fn report(arguments: &ReportArguments, context: &Context) -> anyhow::Result<()> {
    let text = std::fs::read_to_string(&arguments.table).with_context(|| format!("cannot read {}", arguments.table.display()))?;
    let (column, factor, y_label) = arguments.value.column();
    let points =
        points(&text, arguments.strategy, column, factor).map_err(|e| Failure::Usage(format!("{}: {e}", arguments.table.display())))?;
    let title = format!("Recorded requests, strategy {}", arguments.strategy);
    let lines = points.into_iter().map(|(name, points)| Line { name, points }).collect();
    let chart = svg(&LineChart { axes: Axes::Logarithmic, title: &title, x_label: "cache size in pages", y_label, lines })?;
    write_atomically(&arguments.out, chart.as_bytes(), Existing::from_force(arguments.force))?;
    context.output.document(&serde_json::json!({"chart": arguments.out}), || arguments.out.display().to_string())?;
    Ok(())
}

type Points = Vec<(f64, f64)>;

/// For each policy: size and `factor` times the column's value, where there is one.
fn points(csv: &str, strategy: ReadStrategy, column: &str, factor: f64) -> Result<Vec<(String, Points)>, String> {
    let mut lines = csv.lines();
    if lines.next() != Some(HEAD) {
        return Err("no table of `cache replay`: another first line".into());
    }
    let at = HEAD.split(',').position(|name| name == column).expect("a chart shows one of the columns");
    let mut points: Vec<(String, Points)> = Vec::new();
    for (number, line) in lines.enumerate() {
        let cells: Vec<&str> = line.split(',').collect();
        let bad = || format!("line {}: {line:?} is no line of the table", number + 2);
        let [of, policy, size, ..] = cells[..] else { return Err(bad()) };
        let (size, value) = (size.parse().map_err(|_| bad())?, *cells.get(at).ok_or_else(bad)?);
        if of != strategy.name() || value.is_empty() {
            continue;
        }
        let point = (size, factor * value.parse::<f64>().map_err(|_| bad())?);
        match points.iter_mut().find(|(name, _)| name == policy) {
            Some((_, line)) => line.push(point),
            None => points.push((policy.into(), vec![point])),
        }
    }
    match points.is_empty() {
        true => Err(format!("no {column} of strategy {strategy}")),
        false => Ok(points),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(policy: &'static str, size_pages: u32, miss_percent: f64) -> Row {
        let counts = (1000, 10, 5, 4, 64, 1 << 20);
        let (texel_fetches, misses, visits, loads, rows_decoded, bytes_decoded) = counts;
        let strategy = "block";
        Row {
            strategy,
            policy,
            size_pages,
            texel_fetches,
            misses,
            miss_percent,
            visits,
            loads,
            rows_decoded,
            bytes_decoded,
            excess: Some(0.5),
            millis: None,
            decode_millis: None,
            bytes_read: None,
        }
    }

    #[test]
    fn a_report_reads_what_replay_wrote() {
        let table = csv(&[row("lru", 2, 20.0), row("belady", 2, 10.0), row("lru", 4, 5.5)]);
        let read = |value: Value| points(&table, ReadStrategy::Block, value.column().0, value.column().1);
        let misses = read(Value::Misses).unwrap();
        assert_eq!(misses, [("lru".to_string(), vec![(2.0, 20.0), (4.0, 5.5)]), ("belady".to_string(), vec![(2.0, 10.0)])]);
        assert_eq!(read(Value::Decoded).unwrap()[1].1, [(2.0, 1e-6 * f64::from(1 << 20))]);
        assert_eq!(read(Value::Excess).unwrap()[0].1, [(2.0, 0.5), (4.0, 0.5)]);
        assert!(read(Value::Time).unwrap_err().contains("millis"), "nothing was measured");
        assert!(points(&table, ReadStrategy::FullImage, "excess", 1.0).unwrap_err().contains("full_image"));
        for broken in ["", "a,b\n1,2", &table.replace("lru,4", "lru,four")] {
            assert!(points(broken, ReadStrategy::Block, "misses", 1.0).is_err(), "{broken}");
        }
    }
}
