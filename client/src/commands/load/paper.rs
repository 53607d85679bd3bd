//! `lumisphere load --paper`: the miss rates of the paper's cache tables (6.3 to 6.7) from one frame's own requests, replayed through an
//! LRU cache of faces, pixels in the paper's order (scanlines) and in ours (buckets).

use lumisphere::textures::laboratory::{Order, compare};
use lumisphere::textures::{Codec, PolicyKind, ReadStrategy, Trace};
use lumisphere_proto::v1alpha1 as wire;
use serde::Serialize;

use crate::commands::cache::recording::collected;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::output::table;
use crate::progress::{Meter, Progress};
use crate::render_settings::{Backend, Blend, Component, Filter, GlossFlags, settings};

/// Directions a pixel of the glossy reflection.
const LOBE_SAMPLES: u32 = 16;
const LOBE_EXPONENT: f32 = 40.0;

/// What a table is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Requests {
    SampleMaps,
    Reconstruction,
    Mirror,
    Glossy,
}

/// One figure of the paper and what it belongs to.
struct Figure {
    table: &'static str,
    requests: Requests,
    strategy: ReadStrategy,
    size: u32,
    paper_percent: f64,
}

const fn figure(table: &'static str, requests: Requests, strategy: ReadStrategy, size: u32, paper_percent: f64) -> Figure {
    Figure { table, requests, strategy, size, paper_percent }
}

/// Tables 6.3 to 6.7. Sizes are rows of sample maps in 6.3, faces in the others.
const FIGURES: [Figure; 22] = {
    use ReadStrategy::{FullImage, HalfThreshold, OnDemand};
    use Requests::{Glossy, Mirror, Reconstruction, SampleMaps};
    [
        figure("6.3 sample-map rows", SampleMaps, FullImage, 2, 71.8),
        figure("6.3 sample-map rows", SampleMaps, FullImage, 4, 59.4),
        figure("6.3 sample-map rows", SampleMaps, FullImage, 8, 44.0),
        figure("6.3 sample-map rows", SampleMaps, FullImage, 16, 31.7),
        figure("6.3 sample-map rows", SampleMaps, FullImage, 32, 22.2),
        figure("6.3 sample-map rows", SampleMaps, FullImage, 64, 15.6),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 2, 24.92),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 4, 18.67),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 6, 16.43),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 8, 15.51),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 16, 13.99),
        figure("6.4 reconstruction", Reconstruction, OnDemand, 32, 13.15),
        figure("6.5 mirror", Mirror, OnDemand, 4, 16.71),
        figure("6.5 mirror", Mirror, OnDemand, 8, 8.32),
        figure("6.5 mirror", Mirror, OnDemand, 16, 5.19),
        figure("6.5 mirror", Mirror, OnDemand, 32, 4.08),
        figure("6.6 glossy", Glossy, OnDemand, 8, 0.95),
        figure("6.6 glossy", Glossy, OnDemand, 16, 0.46),
        figure("6.6 glossy", Glossy, OnDemand, 32, 0.32),
        figure("6.7 glossy, strategies", Glossy, OnDemand, 32, 0.29),
        figure("6.7 glossy, strategies", Glossy, HalfThreshold, 32, 0.14),
        figure("6.7 glossy, strategies", Glossy, FullImage, 32, 0.05),
    ]
};

/// A line of the tables: misses in % of texel fetches.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Row {
    table: &'static str,
    strategy: &'static str,
    size: u32,
    paper_percent: f64,
    scanlines_percent: f64,
    buckets_percent: f64,
}

/// Records six traces, replays them, prints the tables.
pub async fn run(
    context: &Context,
    server: &Server,
    dataset: &str,
    version: &wire::DatasetVersion,
    orbit: &crate::cameras::OrbitFlags,
) -> anyhow::Result<()> {
    let bounds = version.object_bounds.ok_or_else(|| Failure::Precondition("the dataset tells no object's box".into()))?;
    let camera = orbit.cameras(&bounds)?[0].1;
    let mut meter = Meter::new(context.output);
    let mut traces = Vec::new();
    let kinds = [Requests::Reconstruction, Requests::Mirror, Requests::Glossy];
    let orders = [wire::PixelOrder::Scanlines, wire::PixelOrder::Buckets];
    for (done, (requests, order)) in kinds.into_iter().flat_map(|k| orders.map(|o| (k, o))).enumerate() {
        meter.update(Progress { stage: "recording", done: done as u64, total: 6, seconds_left: None });
        let request = wire::RecordTraceRequest {
            dataset: dataset.into(),
            version: version.version,
            cameras: vec![camera],
            settings: Some(requests.settings()),
            order: order.into(),
            lobe_samples: if requests == Requests::Glossy { LOBE_SAMPLES } else { 0 },
            lobe_exponent: LOBE_EXPONENT,
            seed: 1,
        };
        let bytes = collected(server.cache().record_trace(context.patient_request(request)).await?.into_inner()).await?;
        traces.push((requests, order, Trace::from_bytes(&bytes).map_err(|e| anyhow::anyhow!("the server's trace: {e}"))?));
    }
    meter.finish();
    let find = |requests: Requests, order: wire::PixelOrder| {
        let recorded = if requests == Requests::SampleMaps { Requests::Reconstruction } else { requests };
        traces.iter().find(|t| (t.0, t.1) == (recorded, order)).map(|t| &t.2).expect("all were recorded")
    };
    let rows: Vec<Row> = FIGURES
        .iter()
        .map(|figure| Row {
            table: figure.table,
            strategy: figure.strategy.name(),
            size: figure.size,
            paper_percent: figure.paper_percent,
            scanlines_percent: figure.percent(find(figure.requests, orders[0])),
            buckets_percent: figure.percent(find(figure.requests, orders[1])),
        })
        .collect();
    context.output.document(&rows, || text(&rows))?;
    Ok(())
}

impl Requests {
    fn settings(self) -> wire::RenderSettings {
        let component = match self {
            Self::SampleMaps | Self::Reconstruction => Component::Reconstruction,
            Self::Mirror | Self::Glossy => Component::Mirror,
        };
        settings(component, Blend::Normal(4.0), [1.0; 3], Filter::Bilinear, Backend::Cpu, &GlossFlags::default())
    }
}

impl Figure {
    /// Replayed with the paper's codec: LZW, decoded from the page's start.
    fn percent(&self, trace: &Trace) -> f64 {
        let part = if self.requests == Requests::SampleMaps { 1 } else { 0 };
        let trace = trace.clone().only(part).expect("a recorded frame has both parts");
        let bytes = u64::from(self.size) * trace.versions[0].shape.resident_bytes() as u64;
        let outcomes = compare(&trace, Codec::LzwSeq, &[self.strategy], &[Order::Policy(PolicyKind::Lru)], &[bytes]);
        100.0 * outcomes[0].misses as f64 / outcomes[0].texel_fetches.max(1) as f64
    }
}

fn text(rows: &[Row]) -> String {
    let head = ["table", "strategy", "size", "paper %", "scanlines %", "buckets %"];
    let mut cells = vec![head.map(str::to_string).to_vec()];
    cells.extend(rows.iter().map(|r| {
        let percent = |p: f64| format!("{p:.3}");
        let ours = [percent(r.paper_percent), percent(r.scanlines_percent), percent(r.buckets_percent)];
        [vec![r.table.into(), r.strategy.into(), r.size.to_string()], ours.to_vec()].concat()
    }));
    table(&cells, &[2, 3, 4, 5])
}
