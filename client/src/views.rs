//! The JSON objects of `--json`: stable, documented in `docs/command-line.md`, independent of the wire's generated types.

use std::collections::BTreeMap;

use lumisphere_proto::v1alpha1 as wire;
use prost_types::Timestamp;
use serde::Serialize;
use serde_json::Value;
use wire::offset_surface_light_field_settings::gloss::Integration;

use crate::exit::code_name;

/// `dataset get`, and the elements of `dataset list`.
#[derive(Debug, Serialize)]
pub struct Dataset {
    /// Unique.
    pub name: String,
    /// What is stored.
    pub kind: String,
    /// 0: none yet.
    pub latest_version: u64,
    /// RFC 3339.
    pub create_time: Option<String>,
    /// Ascending.
    pub versions: Vec<DatasetVersion>,
}

/// One immutable version.
#[derive(Debug, Serialize)]
pub struct DatasetVersion {
    /// From 1.
    pub version: u64,
    /// RFC 3339.
    pub create_time: Option<String>,
    /// On disk.
    pub size_bytes: u64,
    /// Texture pages.
    pub page_count: u64,
    /// As captured; null when the server's JSON is unreadable.
    pub parameters: Value,
    /// World space.
    pub object_bounds: Option<Bounds>,
}

/// World-space box.
#[derive(Debug, Serialize)]
pub struct Bounds {
    /// Least corner.
    pub min: [f32; 3],
    /// Greatest corner.
    pub max: [f32; 3],
}

/// `dataset files`.
#[derive(Debug, Serialize)]
pub struct DatasetFile {
    /// "manifest", "segment" or "blob".
    pub role: &'static str,
    /// Within the version.
    pub name: String,
    /// Of its bytes.
    pub blake3: String,
    /// Bytes.
    pub size_bytes: u64,
}

/// `job get`, and the elements of `job list`.
#[derive(Debug, Serialize)]
pub struct Job {
    /// Given by the server.
    pub name: String,
    /// "capture", "evaluate", "path_render", "thin", "observe", "fit" or "suggest".
    pub kind: &'static str,
    /// Which dataset it writes or reads.
    pub dataset: String,
    /// "PENDING", "RUNNING", …
    pub state: String,
    /// RFC 3339.
    pub create_time: Option<String>,
    /// RFC 3339.
    pub start_time: Option<String>,
    /// RFC 3339.
    pub end_time: Option<String>,
    /// How often it was started.
    pub attempt: u32,
    /// How a fit was asked for; absent for other jobs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<FitSettings>,
    /// Null before it runs.
    pub progress: Option<JobProgress>,
    /// Null unless it failed or was cancelled.
    pub error: Option<JobError>,
    /// Null unless it succeeded.
    pub result: Option<JobResult>,
}

/// How far a job is.
#[derive(Debug, Serialize)]
pub struct JobProgress {
    /// What it does now.
    pub stage: String,
    /// Pieces.
    pub done: u64,
    /// Pieces.
    pub total: u64,
    /// 0 to 1.
    pub fraction: f64,
    /// Of this stage.
    pub seconds_left: Option<f64>,
    /// What has come of a fit; absent for other jobs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fit: Option<FitProgress>,
}

/// How a fit was asked for.
#[derive(Debug, Serialize)]
pub struct FitSettings {
    /// "auto", "phong:2", …
    pub models: String,
    /// Observations that stand alone are left out.
    pub reject_outliers: bool,
    /// The last steps are double.
    pub polish: bool,
    /// Null: no bound.
    pub max_bytes: Option<u64>,
    /// "cpu" or "gpu": what fits single lobes.
    pub backend: &'static str,
}

/// What has come of a fit so far. Fields are the wire's.
#[derive(Debug, Serialize)]
pub struct FitProgress {
    texels: u64,
    texels_per_second: f64,
    histogram: BTreeMap<String, u64>,
    flags: BTreeMap<String, u64>,
    median_residual: f64,
    /// Null where nothing is published.
    partial_dataset: Option<String>,
}

impl FitProgress {
    /// "5312 texels/s; constant 3000, phong:1 1096; unresolved 12".
    pub fn text(&self) -> String {
        let counts = |of: &BTreeMap<String, u64>| {
            let counted = of.iter().filter(|(_, count)| **count > 0);
            counted.map(|(name, count)| format!("{name} {count}")).collect::<Vec<_>>().join(", ")
        };
        let parts = [format!("{:.0} texels/s", self.texels_per_second), counts(&self.histogram), counts(&self.flags)];
        parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("; ")
    }
}

/// Why a job did not succeed.
#[derive(Debug, Serialize)]
pub struct JobError {
    /// "DATA_LOSS", …
    pub code: &'static str,
    /// "DISK_FULL", …
    pub reason: String,
    /// For people.
    pub message: String,
}

/// What a job made.
#[derive(Debug, Serialize)]
pub struct JobResult {
    /// Of a capture.
    pub dataset: String,
    /// Of a capture; 0 otherwise.
    pub dataset_version: u64,
    /// Named bytes.
    pub blobs: Vec<ResultBlob>,
    /// The job's figures.
    pub summary: Value,
}

/// Named bytes.
#[derive(Debug, Serialize)]
pub struct ResultBlob {
    /// Unique within the job.
    pub name: String,
    /// "image/png", …
    pub media_type: String,
    /// Of its bytes.
    pub blake3: String,
    /// Bytes.
    pub size_bytes: u64,
}

/// One event of `job watch`.
#[derive(Debug, Serialize)]
pub struct JobEvent {
    /// Increases.
    pub sequence: u64,
    /// RFC 3339.
    pub time: Option<String>,
    /// The whole job.
    pub job: Job,
}

/// One frame of `render`.
#[derive(Debug, Serialize)]
pub struct Frame {
    /// Position in the sequence.
    pub index: usize,
    /// The camera's name.
    pub camera: String,
    /// Where the picture is.
    pub file: String,
    /// The version shown.
    pub dataset_version: u64,
    /// Along a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// Of the picture.
    pub size_bytes: usize,
    /// "gpu" or "cpu".
    pub backend: &'static str,
    /// Its name; empty on the CPU.
    pub adapter: String,
    /// No better frame follows.
    pub is_final: bool,
    /// That the picture is the mean of.
    pub passes_done: u32,
    /// "monte-carlo" or "prefiltered": of a glossy picture, how light was gathered.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub integration: Option<&'static str>,
    /// Of the first: directions of each pixel and pass.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub directions: Option<u32>,
    /// From request to answer, as seen here.
    pub round_trip_millis: f64,
    /// Inside the server.
    pub timings_micros: Timings,
    /// What the texture cache did.
    pub cache: CacheUse,
}

/// Where the time went.
#[derive(Debug, Serialize)]
pub struct Timings {
    /// Waiting.
    pub queue: u64,
    /// Loading pages.
    pub pages: u64,
    /// Computing.
    pub render: u64,
    /// Encoding.
    pub encode: u64,
}

/// What the texture cache did for a frame. Fields are the wire's.
#[derive(Debug, Serialize)]
pub struct CacheUse {
    /// Pages or texels asked for.
    pub look_ups: u64,
    /// Found in memory.
    pub hits: u64,
    /// Not in memory.
    pub misses: u64,
    /// From disk.
    pub read_bytes: u64,
    texel_fetches: u64,
    texel_misses: u64,
    page_visits: u64,
    visit_misses: u64,
    coalesced: u64,
    blocks_read: u64,
    rows_decoded: u64,
    bytes_decoded: u64,
    rows_redundant: u64,
    bytes_redundant: u64,
    read_micros: u64,
    decode_micros: u64,
    wait_micros: u64,
    /// null on the CPU.
    adapter: Option<AdapterCacheUse>,
}

/// What the cache's tier on the adapter did for a frame. Fields are the wire's.
#[derive(Debug, Serialize)]
struct AdapterCacheUse {
    look_ups: u64,
    hits: u64,
    misses: u64,
    uploads: u64,
    bytes_uploaded: u64,
    evictions: u64,
    prefetch_used: u64,
    prefetch_wasted: u64,
    passes: u32,
    upload_micros: u64,
}

fn time(timestamp: Option<Timestamp>) -> Option<String> {
    timestamp.map(|t| t.to_string())
}

fn parsed(json: &str) -> Value {
    serde_json::from_str(json).unwrap_or(Value::Null)
}

fn corner(v: Option<wire::Vector3>) -> [f32; 3] {
    let v = v.unwrap_or_default();
    [v.x, v.y, v.z]
}

impl From<wire::FrameCacheUse> for CacheUse {
    fn from(c: wire::FrameCacheUse) -> Self {
        Self {
            look_ups: c.look_ups,
            hits: c.hits,
            misses: c.misses,
            read_bytes: c.read_bytes,
            texel_fetches: c.texel_fetches,
            texel_misses: c.texel_misses,
            page_visits: c.page_visits,
            visit_misses: c.visit_misses,
            coalesced: c.coalesced,
            blocks_read: c.blocks_read,
            rows_decoded: c.rows_decoded,
            bytes_decoded: c.bytes_decoded,
            rows_redundant: c.rows_redundant,
            bytes_redundant: c.bytes_redundant,
            read_micros: c.read_micros,
            decode_micros: c.decode_micros,
            wait_micros: c.wait_micros,
            adapter: c.adapter.map(AdapterCacheUse::from),
        }
    }
}

impl From<wire::AdapterCacheUse> for AdapterCacheUse {
    fn from(a: wire::AdapterCacheUse) -> Self {
        Self {
            look_ups: a.look_ups,
            hits: a.hits,
            misses: a.misses,
            uploads: a.uploads,
            bytes_uploaded: a.bytes_uploaded,
            evictions: a.evictions,
            prefetch_used: a.prefetch_used,
            prefetch_wasted: a.prefetch_wasted,
            passes: a.passes,
            upload_micros: a.upload_micros,
        }
    }
}

impl From<wire::Dataset> for Dataset {
    fn from(d: wire::Dataset) -> Self {
        let versions = d.versions.into_iter().map(DatasetVersion::from).collect();
        Self { name: d.name, kind: d.kind, latest_version: d.latest_version, create_time: time(d.create_time), versions }
    }
}

impl From<wire::DatasetVersion> for DatasetVersion {
    fn from(v: wire::DatasetVersion) -> Self {
        Self {
            version: v.version,
            create_time: time(v.create_time),
            size_bytes: v.size_bytes,
            page_count: v.page_count,
            parameters: parsed(&v.parameters_json),
            object_bounds: v.object_bounds.map(|b| Bounds { min: corner(b.min), max: corner(b.max) }),
        }
    }
}

impl From<wire::DatasetFile> for DatasetFile {
    fn from(f: wire::DatasetFile) -> Self {
        let role = match f.role() {
            wire::DatasetFileRole::Manifest => "manifest",
            wire::DatasetFileRole::Segment => "segment",
            wire::DatasetFileRole::Blob => "blob",
            wire::DatasetFileRole::Unspecified => "unknown",
        };
        Self { role, name: f.name, blake3: f.blake3, size_bytes: f.size_bytes }
    }
}

/// "SUCCEEDED".
pub fn state_name(state: wire::JobState) -> String {
    state.as_str_name().trim_start_matches("JOB_STATE_").to_string()
}

impl From<wire::Job> for Job {
    fn from(job: wire::Job) -> Self {
        let state = state_name(job.state());
        let spec = job.spec.and_then(|s| s.spec);
        let fit = match &spec {
            Some(wire::job_spec::Spec::Fit(s)) => Some(FitSettings {
                models: if s.models.is_empty() { "auto".into() } else { s.models.clone() },
                reject_outliers: s.reject_outliers,
                polish: s.polish,
                max_bytes: (s.max_bytes != 0).then_some(s.max_bytes),
                backend: if s.backend() == wire::Backend::Gpu { "gpu" } else { "cpu" },
            }),
            _ => None,
        };
        let (kind, dataset) = match spec {
            Some(wire::job_spec::Spec::Capture(s)) => ("capture", s.dataset),
            Some(wire::job_spec::Spec::Evaluate(s)) => ("evaluate", s.dataset),
            Some(wire::job_spec::Spec::PathRender(s)) => ("path_render", s.dataset),
            Some(wire::job_spec::Spec::Thin(s)) => ("thin", s.dataset),
            Some(wire::job_spec::Spec::Observe(s)) => ("observe", s.dataset),
            Some(wire::job_spec::Spec::Fit(s)) => ("fit", s.dataset),
            Some(wire::job_spec::Spec::Suggest(s)) => ("suggest", s.dataset),
            Some(wire::job_spec::Spec::Replace(s)) => ("replace", s.dataset),
            None => ("unknown", String::new()),
        };
        Self {
            name: job.name,
            kind,
            dataset,
            state,
            create_time: time(job.create_time),
            start_time: time(job.start_time),
            end_time: time(job.end_time),
            attempt: job.attempt,
            fit,
            progress: job.progress.map(JobProgress::from),
            error: job.error.map(JobError::from),
            result: job.result.map(JobResult::from),
        }
    }
}

impl From<wire::JobProgress> for JobProgress {
    fn from(p: wire::JobProgress) -> Self {
        let fit = p.fit.map(FitProgress::from);
        Self { stage: p.stage, done: p.done, total: p.total, fraction: p.fraction, seconds_left: p.seconds_left, fit }
    }
}

impl From<wire::FitProgress> for FitProgress {
    fn from(p: wire::FitProgress) -> Self {
        Self {
            texels: p.texels,
            texels_per_second: p.texels_per_second,
            histogram: p.histogram,
            flags: p.flags,
            median_residual: p.median_residual,
            partial_dataset: Some(p.partial_dataset).filter(|name| !name.is_empty()),
        }
    }
}

impl From<wire::JobError> for JobError {
    fn from(e: wire::JobError) -> Self {
        Self { code: code_name(tonic::Code::from_i32(e.code)), reason: e.reason, message: e.message }
    }
}

impl From<wire::JobResult> for JobResult {
    fn from(r: wire::JobResult) -> Self {
        let blob = |b: wire::ResultBlob| ResultBlob { name: b.name, media_type: b.media_type, blake3: b.blake3, size_bytes: b.size_bytes };
        Self {
            dataset: r.dataset,
            dataset_version: r.dataset_version,
            blobs: r.blobs.into_iter().map(blob).collect(),
            summary: parsed(&r.summary_json),
        }
    }
}

impl From<wire::JobEvent> for JobEvent {
    fn from(e: wire::JobEvent) -> Self {
        Self { sequence: e.sequence, time: time(e.time), job: e.job.unwrap_or_default().into() }
    }
}

/// "monte-carlo" or "prefiltered"; None of a frame that has nothing to integrate.
pub fn integration_name(integration: Integration) -> Option<&'static str> {
    match integration {
        Integration::Unspecified => None,
        Integration::MonteCarlo => Some("monte-carlo"),
        Integration::Prefiltered => Some("prefiltered"),
    }
}

/// "gpu" or "cpu".
pub fn backend_name(backend: wire::Backend) -> &'static str {
    match backend {
        wire::Backend::Gpu => "gpu",
        wire::Backend::Cpu => "cpu",
        wire::Backend::Unspecified => "unknown",
    }
}
