//! `lumisphere load --paper`: the paper's cache tables (6.3 to 6.7) from one frame's own requests, replayed through an LRU cache of
//! faces, pixels in the paper's order (scanlines) and in ours (buckets).

use lumisphere::textures::laboratory::{Order, compare};
use lumisphere::textures::{Codec, PolicyKind, ReadStrategy, Trace};
use lumisphere_proto::v1alpha1 as wire;
use serde::Serialize;

use crate::cache_names::{policy_to_wire, strategy_to_wire};
use crate::commands::cache::laboratory::on_server;
use crate::commands::cache::recording::collected;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::output::table;
use crate::progress::{Meter, Progress};
use crate::render_settings::{Backend, Blend, Component, Filter, Looks, settings};

/// Directions a pixel of the glossy reflection; the paper has 100.
const LOBE_SAMPLES: u32 = 16;

/// What a table is about.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Requests {
    SampleMaps,
    Reconstruction,
    Mirror,
    /// Directions about the mirror's, of density cosine to this power: a quarter of the exponents of Ashikhmin & Shirley's half vectors.
    Glossy(f32),
}

/// A line of a table of the paper: rows of sample maps in 6.3, faces in the others.
struct Line {
    strategy: ReadStrategy,
    size: u32,
    /// Misses in % of texel fetches, and seconds of a processor; none where the paper has no line.
    paper: Option<(f64, u32)>,
}

struct PaperTable {
    name: &'static str,
    requests: Requests,
    lines: &'static [Line],
}

const fn line(strategy: ReadStrategy, size: u32, percent: f64, [hours, minutes, seconds]: [u32; 3]) -> Line {
    Line { strategy, size, paper: Some((percent, 3600 * hours + 60 * minutes + seconds)) }
}

const fn ours(strategy: ReadStrategy, size: u32) -> Line {
    Line { strategy, size, paper: None }
}

const TABLES: [PaperTable; 7] = {
    use ReadStrategy::{FullImage, HalfThreshold, OnDemand};
    use Requests::{Glossy, Mirror, Reconstruction, SampleMaps};
    [
        PaperTable {
            name: "6.3 sample-map rows",
            requests: SampleMaps,
            lines: &[
                line(FullImage, 2, 71.80, [0, 0, 28]),
                line(FullImage, 4, 59.41, [0, 0, 28]),
                line(FullImage, 8, 44.03, [0, 0, 27]),
                line(FullImage, 16, 31.65, [0, 0, 27]),
                line(FullImage, 32, 22.20, [0, 0, 27]),
                line(FullImage, 64, 15.60, [0, 0, 27]),
            ],
        },
        PaperTable {
            name: "6.4 reconstruction",
            requests: Reconstruction,
            lines: &[
                line(OnDemand, 0, 100.0, [0, 7, 26]),
                line(OnDemand, 2, 24.92, [0, 1, 51]),
                line(OnDemand, 4, 18.67, [0, 1, 30]),
                line(OnDemand, 6, 16.43, [0, 1, 22]),
                line(OnDemand, 8, 15.51, [0, 1, 19]),
                line(OnDemand, 16, 13.99, [0, 1, 14]),
                line(OnDemand, 32, 13.15, [0, 1, 11]),
            ],
        },
        PaperTable {
            name: "6.5 mirror",
            requests: Mirror,
            lines: &[
                line(OnDemand, 0, 100.0, [0, 27, 19]),
                ours(OnDemand, 2),
                line(OnDemand, 4, 16.71, [0, 4, 4]),
                line(OnDemand, 8, 8.32, [0, 2, 13]),
                line(OnDemand, 16, 5.19, [0, 1, 34]),
                line(OnDemand, 32, 4.08, [0, 1, 19]),
            ],
        },
        PaperTable {
            name: "6.6 glossy (10, 10)",
            requests: Glossy(2.5),
            lines: &[
                line(OnDemand, 0, 100.0, [7, 36, 10]),
                ours(OnDemand, 2),
                ours(OnDemand, 4),
                line(OnDemand, 8, 0.95, [0, 7, 27]),
                line(OnDemand, 16, 0.46, [0, 4, 45]),
                line(OnDemand, 32, 0.32, [0, 4, 0]),
            ],
        },
        PaperTable {
            name: "6.6 glossy (100, 100)",
            requests: Glossy(25.0),
            lines: &[
                line(OnDemand, 0, 100.0, [8, 58, 10]),
                ours(OnDemand, 2),
                ours(OnDemand, 4),
                line(OnDemand, 8, 0.30, [0, 4, 3]),
                line(OnDemand, 16, 0.21, [0, 3, 30]),
                line(OnDemand, 32, 0.17, [0, 3, 21]),
            ],
        },
        PaperTable {
            name: "6.6 glossy (1000, 1000)",
            requests: Glossy(250.0),
            lines: &[
                line(OnDemand, 0, 100.0, [9, 18, 11]),
                ours(OnDemand, 2),
                ours(OnDemand, 4),
                line(OnDemand, 8, 0.20, [0, 3, 21]),
                line(OnDemand, 16, 0.16, [0, 3, 8]),
                line(OnDemand, 32, 0.14, [0, 3, 5]),
            ],
        },
        // The paper does not say of which lobe.
        PaperTable {
            name: "6.7 glossy (10, 10), strategies",
            requests: Glossy(2.5),
            lines: &[
                line(OnDemand, 0, 100.0, [9, 19, 59]),
                line(OnDemand, 8, 0.59, [0, 5, 19]),
                line(OnDemand, 16, 0.35, [0, 4, 26]),
                line(OnDemand, 32, 0.29, [0, 4, 8]),
                line(HalfThreshold, 32, 0.14, [0, 3, 0]),
                line(FullImage, 32, 0.05, [0, 2, 45]),
            ],
        },
    ]
};

/// A line of the tables: misses in % of texel fetches, all requests in seconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Row {
    table: &'static str,
    strategy: &'static str,
    size: u32,
    paper_percent: Option<f64>,
    paper_seconds: Option<u32>,
    scanlines_percent: f64,
    buckets_percent: f64,
    /// Of the scanlines' requests through a real cache on the server, as the dataset is stored; none unless asked for, where the paper has
    /// none, and without a cache where there are many directions.
    scanlines_seconds: Option<f64>,
}

/// What is recorded: sample maps come with the reconstruction.
const RECORDED: [Requests; 5] =
    [Requests::Reconstruction, Requests::Mirror, Requests::Glossy(2.5), Requests::Glossy(25.0), Requests::Glossy(250.0)];

/// Records a frame of every kind in both orders, replays them, prints the tables; with `--times`, replays them on the server, too.
pub async fn run(
    context: &Context,
    server: &Server,
    dataset: &str,
    version: &wire::DatasetVersion,
    orbit: &crate::cameras::OrbitFlags,
    with_times: bool,
) -> anyhow::Result<()> {
    let bounds = version.object_bounds.ok_or_else(|| Failure::Precondition("the dataset tells no object's box".into()))?;
    let camera = orbit.cameras(&bounds)?[0].1;
    let mut meter = Meter::new(context.output);
    let mut rows = Vec::new();
    for (done, requests) in RECORDED.into_iter().enumerate() {
        meter.update(Progress { stage: "recording", done: done as u64, total: RECORDED.len() as u64, seconds_left: None, detail: "" });
        let record = async |order: wire::PixelOrder| {
            let request = wire::RecordTraceRequest {
                dataset: dataset.into(),
                version: version.version,
                cameras: vec![camera],
                settings: Some(requests.settings()),
                order: order.into(),
                lobe_samples: requests.lobe_exponent().map_or(0, |_| LOBE_SAMPLES),
                lobe_exponent: requests.lobe_exponent().unwrap_or(0.0),
                seed: 1,
            };
            let bytes = collected(server.cache().record_trace(context.patient_request(request)).await?.into_inner()).await?;
            Trace::from_bytes(&bytes).map_err(|e| anyhow::anyhow!("the server's trace: {e}"))
        };
        let (scanlines, buckets) = (record(wire::PixelOrder::Scanlines).await?, record(wire::PixelOrder::Buckets).await?);
        for (number, table) in TABLES.iter().enumerate().filter(|(_, table)| table.requests.recorded() == requests) {
            let (scanlines, buckets) = (table.part(&scanlines), table.part(&buckets));
            let mut of_table: Vec<Row> = table.lines.iter().map(|line| table.row(line, &scanlines, &buckets)).collect();
            if with_times && table.requests != Requests::SampleMaps {
                table.measure(context, &scanlines, &mut of_table).await?;
            }
            rows.push((number, of_table));
        }
    }
    meter.finish();
    rows.sort_by_key(|(number, _)| *number);
    let rows: Vec<Row> = rows.into_iter().flat_map(|(_, rows)| rows).collect();
    context.output.document(&rows, || text(&rows))?;
    Ok(())
}

impl Requests {
    fn recorded(self) -> Self {
        if self == Self::SampleMaps { Self::Reconstruction } else { self }
    }

    fn lobe_exponent(self) -> Option<f32> {
        if let Self::Glossy(exponent) = self { Some(exponent) } else { None }
    }

    fn settings(self) -> wire::RenderSettings {
        let component = match self {
            Self::SampleMaps | Self::Reconstruction => Component::Reconstruction,
            Self::Mirror | Self::Glossy(_) => Component::Mirror,
        };
        settings(component, Blend::Normal(4.0), [1.0; 3], Filter::Bilinear, Backend::Cpu, Looks::plain())
    }
}

impl PaperTable {
    fn part(&self, trace: &Trace) -> Trace {
        let part = if self.requests == Requests::SampleMaps { 1 } else { 0 };
        trace.clone().only(part).expect("a recorded frame has both parts")
    }

    fn row(&self, line: &Line, scanlines: &Trace, buckets: &Trace) -> Row {
        Row {
            table: self.name,
            strategy: line.strategy.name(),
            size: line.size,
            paper_percent: line.paper.map(|(percent, _)| percent),
            paper_seconds: line.paper.map(|(_, seconds)| seconds),
            scanlines_percent: line.percent(scanlines),
            buckets_percent: line.percent(buckets),
            scanlines_seconds: None,
        }
    }

    /// As the paper did; but every fetch of a lobe from disk would take the server longer than it replays.
    fn is_measured(&self, row: &Row) -> bool {
        row.paper_seconds.is_some() && (row.size > 0 || self.requests.lobe_exponent().is_none())
    }

    async fn measure(&self, context: &Context, trace: &Trace, rows: &mut [Row]) -> anyhow::Result<()> {
        for strategy in [ReadStrategy::OnDemand, ReadStrategy::HalfThreshold, ReadStrategy::FullImage] {
            let is_asked = |row: &&Row| row.strategy == strategy.name() && self.is_measured(row);
            let sizes_pages: Vec<u32> = rows.iter().filter(is_asked).map(|row| row.size).collect();
            if sizes_pages.is_empty() {
                continue;
            }
            let settings = wire::ReplaySettings {
                strategies: vec![strategy_to_wire(strategy).into()],
                policies: vec![policy_to_wire(PolicyKind::Lru).into()],
                sizes_pages,
                part: 0,
            };
            on_server::replay(context, trace, settings, |outcome| {
                let of_size = |row: &&mut Row| (row.strategy, row.size) == (strategy.name(), outcome.size_pages);
                for row in rows.iter_mut().filter(of_size) {
                    row.scanlines_seconds = Some(1e-6 * outcome.micros as f64);
                }
            })
            .await?;
        }
        Ok(())
    }
}

impl Line {
    /// Replayed with the paper's codec: LZW, decoded from the page's start.
    fn percent(&self, trace: &Trace) -> f64 {
        let bytes = u64::from(self.size) * trace.versions[0].shape.resident_bytes() as u64;
        let outcomes = compare(trace, Codec::LzwSeq, &[self.strategy], &[Order::Policy(PolicyKind::Lru)], &[bytes]);
        100.0 * outcomes[0].misses as f64 / outcomes[0].texel_fetches.max(1) as f64
    }
}

fn text(rows: &[Row]) -> String {
    let head = ["table", "strategy", "size", "paper %", "scanlines %", "buckets %", "paper s", "scanlines s"];
    let mut cells = vec![head.map(str::to_string).to_vec()];
    cells.extend(rows.iter().map(|r| {
        vec![
            r.table.into(),
            r.strategy.into(),
            r.size.to_string(),
            r.paper_percent.map_or("-".into(), |p| format!("{p:.2}")),
            format!("{:.3}", r.scanlines_percent),
            format!("{:.3}", r.buckets_percent),
            r.paper_seconds.map_or("-".into(), |s| s.to_string()),
            r.scanlines_seconds.map_or("-".into(), |s| format!("{s:.3}")),
        ]
    }));
    table(&cells, &[2, 3, 4, 5, 6, 7])
}
