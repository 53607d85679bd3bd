//! What the operator sees: logs on standard error, Prometheus metrics, and the HTTP port that serves them beside liveness and readiness.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use axum::Router;
use axum::extract::State;
use axum::http::StatusCode;
use axum::routing::get;
use http_body::{Frame, SizeHint};
use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;
use tokio_util::sync::CancellationToken;
use tonic::body::Body;
use tower_layer::Layer;
use tower_service::Service;
use tracing_subscriber::EnvFilter;

/// Seconds; from a cached tile to a long render.
const BUCKETS: [f64; 14] = [0.001, 0.002, 0.005, 0.01, 0.02, 0.033, 0.06, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 30.0];

/// Logs as `filter` says, on standard error.
pub fn start_logging(filter: &str) {
    let filter = filter.parse::<EnvFilter>().unwrap_or_default();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false).init();
}

/// Labels of an rpc: "lumisphere.v1alpha1.Rendering/RenderFrame" and the status code's number.
#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct RpcLabels {
    method: String,
    code: String,
}

/// Label of a frame's stage: "queue", "pages", "render" or "encode".
#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct StageLabels {
    stage: &'static str,
}

/// Label of a tier of the texture cache: "compressed", "memory" or "gpu".
#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct TierLabels {
    tier: &'static str,
}

/// Labels of a dataset version's part of a tier.
#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct DatasetTierLabels {
    tier: &'static str,
    dataset: String,
    version: u64,
}

/// Labels of a dataset version that was asked for.
#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct DatasetLabels {
    dataset: String,
    version: u64,
}

/// Instruments of a tier; events since start or the last reset. All but the last are told of every dataset, too, as "dataset_" and the name.
const TIER_COUNTS: [(&str, &str); 12] = [
    ("cache_look_ups", "Texture pages or blocks asked for"),
    ("cache_hits", "Of those, found in the tier"),
    ("cache_misses", "Of those, not in the tier"),
    ("cache_evictions", "Dropped to keep the budget"),
    ("cache_bytes_in", "Bytes brought into the tier"),
    ("cache_bytes", "Bytes held"),
    ("cache_peak_bytes", "Most bytes held at once"),
    ("cache_prefetched", "Pages brought ahead of need"),
    ("cache_prefetch_used", "Of those, wanted before they left; gpu only"),
    ("cache_prefetch_wasted", "Of those, dropped before anyone wanted them; gpu only"),
    ("cache_uploads", "Times a page was copied to the adapter, whole or in part; gpu only"),
    ("cache_budget_bytes", "Bytes that may be held"),
];

/// The budget is everyone's.
const DATASET_TIER_COUNTS: usize = TIER_COUNTS.len() - 1;

/// Instruments of a dataset version; events since start or the last reset.
const DATASET_COUNTS: [(&str, &str); 20] = [
    ("texture_look_ups", "Requests for whole pages or for texels"),
    ("texture_hits", "Of those, found in memory"),
    ("texture_misses", "Of those, in which something was missing"),
    ("texture_texel_fetches", "Texels fetched"),
    ("texture_texel_misses", "Of those, that had to read or wait"),
    ("texture_page_visits", "Times a reader turned to another page"),
    ("texture_visit_misses", "Of those, in which something was missing"),
    ("texture_coalesced", "Misses answered by the read of another"),
    ("texture_blocks_read", "Compressed blocks read"),
    ("texture_bytes_read", "Bytes read from disk"),
    ("texture_rows_decoded", "Rows decoded"),
    ("texture_bytes_decoded", "Bytes of those rows"),
    ("texture_rows_redundant", "Rows decoded that had been decoded before"),
    ("texture_bytes_redundant", "Bytes of those rows"),
    ("texture_read_micros", "Reading, microseconds summed over readers"),
    ("texture_decode_micros", "Checking and unpacking, microseconds summed over readers"),
    ("texture_wait_micros", "Waiting for another's read, microseconds summed over readers"),
    ("texture_bytes", "Bytes held in memory"),
    ("texture_peak_bytes", "Most bytes held in memory at once"),
    ("texture_evictions", "Pages and blocks dropped from memory"),
];

/// Every instrument of the server. Counts of others (cache, jobs) are copied in when scraped.
pub struct Metrics {
    registry: Registry,
    rpc_seconds: Family<RpcLabels, Histogram, fn() -> Histogram>,
    frame_seconds: Family<StageLabels, Histogram, fn() -> Histogram>,
    /// Frames rendered and encoded.
    pub frames: Counter,
    /// Poses that a newer one overtook.
    pub poses_overtaken: Counter,
    /// Frames of full size that were dropped because the viewer moved on.
    pub stills_abandoned: Counter,
    /// Stills whose further passes were dropped because the viewer moved on.
    pub refinements_abandoned: Counter,
    /// Passes of stills after the first.
    pub passes: Counter,
    /// Stills of which more passes are being rendered.
    pub stills_held: Gauge,
    /// Bytes of their pixels.
    pub still_bytes: Gauge,
    /// Times that pages were looked for, and brought, ahead of a moving viewer's next frame.
    pub looks_ahead: Counter,
    /// Renders refused because the queue was full.
    pub renders_refused: Counter,
    /// Viewers: Interact streams and sessions.
    pub sessions: Gauge,
    /// Jobs waiting.
    pub jobs_pending: Gauge,
    /// Jobs running.
    pub jobs_running: Gauge,
    /// Renders waiting or in work.
    pub renders_waiting: Gauge,
    cache_tiers: [Family<TierLabels, Gauge>; TIER_COUNTS.len()],
    cache_datasets: [Family<DatasetLabels, Gauge>; DATASET_COUNTS.len()],
    cache_dataset_tiers: [Family<DatasetTierLabels, Gauge>; DATASET_TIER_COUNTS],
}

impl Metrics {
    /// Everything at zero.
    pub fn new() -> Self {
        let histogram: fn() -> Histogram = || Histogram::new(BUCKETS);
        let mut m = Self {
            registry: Registry::with_prefix("lumisphere"),
            rpc_seconds: Family::new_with_constructor(histogram),
            frame_seconds: Family::new_with_constructor(histogram),
            frames: Counter::default(),
            poses_overtaken: Counter::default(),
            stills_abandoned: Counter::default(),
            refinements_abandoned: Counter::default(),
            passes: Counter::default(),
            stills_held: Gauge::default(),
            still_bytes: Gauge::default(),
            looks_ahead: Counter::default(),
            renders_refused: Counter::default(),
            sessions: Gauge::default(),
            jobs_pending: Gauge::default(),
            jobs_running: Gauge::default(),
            renders_waiting: Gauge::default(),
            cache_tiers: Default::default(),
            cache_datasets: Default::default(),
            cache_dataset_tiers: Default::default(),
        };
        let r = &mut m.registry;
        r.register("rpc_server_call_duration_seconds", "Rpcs until their last byte, by method and status code", m.rpc_seconds.clone());
        r.register("render_frame_seconds", "Frames by stage", m.frame_seconds.clone());
        r.register("render_frames", "Frames rendered and encoded", m.frames.clone());
        r.register("poses_overtaken", "Poses that a newer one overtook", m.poses_overtaken.clone());
        r.register("stills_abandoned", "Frames of full size dropped because the viewer moved on", m.stills_abandoned.clone());
        r.register(
            "refinements_abandoned",
            "Stills whose further passes were dropped because the viewer moved on",
            m.refinements_abandoned.clone(),
        );
        r.register("still_passes", "Passes of stills after the first", m.passes.clone());
        r.register("stills_held", "Stills of which more passes are being rendered", m.stills_held.clone());
        r.register("still_bytes", "Bytes of their pixels", m.still_bytes.clone());
        r.register("looks_ahead", "Times that pages were brought ahead of a moving viewer's next frame", m.looks_ahead.clone());
        r.register("renders_refused", "Renders refused because the queue was full", m.renders_refused.clone());
        r.register("sessions_active", "Viewers: Interact streams and sessions", m.sessions.clone());
        r.register("jobs_pending", "Jobs waiting", m.jobs_pending.clone());
        r.register("jobs_running", "Jobs running", m.jobs_running.clone());
        r.register("renders_waiting", "Renders waiting or in work", m.renders_waiting.clone());
        for ((name, about), family) in TIER_COUNTS.iter().zip(&m.cache_tiers) {
            r.register(*name, *about, family.clone());
        }
        for ((name, about), family) in DATASET_COUNTS.iter().zip(&m.cache_datasets) {
            r.register(*name, *about, family.clone());
        }
        for ((name, about), family) in TIER_COUNTS.iter().zip(&m.cache_dataset_tiers) {
            r.register(format!("dataset_{name}"), format!("Of a dataset. {about}"), family.clone());
        }
        m
    }

    /// One frame's stage took so long.
    pub fn frame_stage(&self, stage: &'static str, micros: u64) {
        self.frame_seconds.get_or_create(&StageLabels { stage }).observe(micros as f64 * 1e-6);
    }

    /// Counts of a tier, as `TIER_COUNTS` lists them.
    pub fn cache_tier(&self, tier: &'static str, counts: [u64; TIER_COUNTS.len()]) {
        for (family, count) in self.cache_tiers.iter().zip(counts) {
            family.get_or_create(&TierLabels { tier }).set(count as i64);
        }
    }

    /// Counts of a dataset version, as `DATASET_COUNTS` lists them.
    pub fn cache_dataset(&self, dataset: &str, version: u64, counts: [u64; DATASET_COUNTS.len()]) {
        for (family, count) in self.cache_datasets.iter().zip(counts) {
            family.get_or_create(&DatasetLabels { dataset: dataset.into(), version }).set(count as i64);
        }
    }

    /// Counts of a dataset version's part of a tier, as `TIER_COUNTS` lists them, without the last.
    pub fn cache_dataset_tier(&self, tier: &'static str, dataset: &str, version: u64, counts: [u64; TIER_COUNTS.len()]) {
        for (family, count) in self.cache_dataset_tiers.iter().zip(counts) {
            family.get_or_create(&DatasetTierLabels { tier, dataset: dataset.into(), version }).set(count as i64);
        }
    }

    fn encode(&self) -> Result<String, std::fmt::Error> {
        let mut text = String::new();
        prometheus_client::encoding::text::encode(&mut text, &self.registry)?;
        Ok(text)
    }
}

/// What the second port needs to answer.
pub struct Observed {
    /// All instruments.
    pub metrics: Arc<Metrics>,
    /// Copies counts of others into the instruments.
    pub refresh: Box<dyn Fn(&Metrics) + Send + Sync>,
    /// Cancelled once the server stops.
    pub stopping: CancellationToken,
}

/// `/metrics`, `/healthz` (the process answers) and `/readyz` (it takes new work).
pub fn http_routes(observed: Arc<Observed>) -> Router {
    let metrics = async |State(o): State<Arc<Observed>>| {
        (o.refresh)(&o.metrics);
        let text = o.metrics.encode().map_err(|_| StatusCode::INTERNAL_SERVER_ERROR)?;
        Ok::<_, StatusCode>(([("content-type", "application/openmetrics-text; version=1.0.0; charset=utf-8")], text))
    };
    let ready = async |State(o): State<Arc<Observed>>| match o.stopping.is_cancelled() {
        false => (StatusCode::OK, "ready\n"),
        true => (StatusCode::SERVICE_UNAVAILABLE, "stopping\n"),
    };
    Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(async || "alive\n"))
        .route("/readyz", get(ready))
        .with_state(observed)
}

/// Measures every rpc from its first byte to its trailers.
#[derive(Clone)]
pub struct RpcMetrics {
    /// Where to.
    pub metrics: Arc<Metrics>,
}

impl<S> Layer<S> for RpcMetrics {
    type Service = Measured<S>;

    fn layer(&self, inner: S) -> Measured<S> {
        Measured { inner, metrics: self.metrics.clone() }
    }
}

/// A service whose rpcs are measured.
#[derive(Clone)]
pub struct Measured<S> {
    inner: S,
    metrics: Arc<Metrics>,
}

impl<S> Service<http::Request<Body>> for Measured<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let measure = Measure { metrics: self.metrics.clone(), path: request.uri().path().into(), begun: Instant::now(), code: None };
        let answer = self.inner.call(request);
        Box::pin(async move {
            let mut measure = measure;
            let response = answer.await?;
            measure.code = status_of(response.headers());
            Ok(response.map(|body| Body::new(MeasuredBody { body, measure })))
        })
    }
}

/// Observes once, when dropped: at the trailers, or when the client has left.
struct Measure {
    metrics: Arc<Metrics>,
    path: String,
    begun: Instant,
    code: Option<String>,
}

impl Drop for Measure {
    fn drop(&mut self) {
        let method = self.path.trim_start_matches('/');
        // A label value for every path that anyone may try would fill the memory; code 12 is UNIMPLEMENTED.
        let known = self.code.as_deref() != Some("12") && method.len() < 128;
        let method = if known { method.to_string() } else { "unknown".to_string() };
        // No status: the client left first, which gRPC calls CANCELLED (1).
        let code = self.code.take().unwrap_or_else(|| "1".into());
        self.metrics.rpc_seconds.get_or_create(&RpcLabels { method, code }).observe(self.begun.elapsed().as_secs_f64());
    }
}

fn status_of(headers: &http::HeaderMap) -> Option<String> {
    headers.get("grpc-status").and_then(|v| v.to_str().ok()).map(String::from)
}

struct MeasuredBody {
    body: Body,
    measure: Measure,
}

impl http_body::Body for MeasuredBody {
    type Data = bytes::Bytes;
    type Error = tonic::Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(cx));
        if let Some(Ok(frame)) = &frame
            && let Some(trailers) = frame.trailers_ref()
        {
            self.measure.code = status_of(trailers);
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instrument_is_scraped_and_paths_that_nobody_serves_share_a_label() {
        let metrics = Arc::new(Metrics::new());
        metrics.frame_stage("render", 12_000);
        metrics.frames.inc();
        metrics.cache_tier("memory", [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        metrics.cache_dataset_tier("gpu", "teapot", 3, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        metrics.cache_dataset("teapot", 3, std::array::from_fn(|i| i as u64 + 1));
        let measure = |path: &str, code: Option<&str>| {
            drop(Measure { metrics: metrics.clone(), path: path.into(), begun: Instant::now(), code: code.map(String::from) });
        };
        measure("/lumisphere.v1alpha1.Jobs/GetJob", Some("5"));
        measure("/wp-login.php", Some("12"));
        measure("/x.Y/Z", Some("12"));
        let text = metrics.encode().unwrap();
        assert!(text.contains("lumisphere_render_frames_total 1"), "{text}");
        assert!(text.contains("lumisphere_cache_hits{tier=\"memory\"} 2"), "{text}");
        assert!(text.contains("lumisphere_dataset_cache_misses{tier=\"gpu\",dataset=\"teapot\",version=\"3\"} 3"), "{text}");
        assert!(text.contains("lumisphere_texture_texel_misses{dataset=\"teapot\",version=\"3\"} 5"), "{text}");
        assert!(text.contains("lumisphere_render_frame_seconds_bucket{le=\"0.02\",stage=\"render\"} 1"), "{text}");
        assert!(
            text.contains("lumisphere_rpc_server_call_duration_seconds_count{method=\"lumisphere.v1alpha1.Jobs/GetJob\",code=\"5\"} 1"),
            "{text}"
        );
        assert!(text.contains("_count{method=\"unknown\",code=\"12\"} 2") && !text.contains("wp-login"), "{text}");
    }
}
