//! `lumisphere-server`: reads the configuration, puts the parts together, serves until it is asked to stop.
//!
//! Exit codes: 0 stopped as asked · 1 could not start or serve · 2 configuration or usage · 130 second signal.

mod api;
mod catalog;
mod config;
mod depth_plane;
mod errors;
mod frame_use;
mod frames;
mod freed_memory;
mod ground_truth;
mod jobs;
mod looks;
mod normal_maps;
mod prefetch;
mod render_queue;
mod replay;
mod scenes;
mod serve;
mod sessions;
mod shutdown;
mod still;
mod tables;
mod telemetry;
mod used_last;
#[cfg(feature = "h264")]
mod video;
#[cfg(not(feature = "h264"))]
#[path = "no_video.rs"]
mod video;
mod viewer_page;
mod wire;
mod work;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

use anyhow::Context;
use lumisphere::render::Renderer;
use tokio_util::sync::CancellationToken;

use crate::api::{Adapter, App};
use crate::catalog::{Catalog, UploadLimits};
use crate::config::{BackendChoice, Config, Effective, Prefetch};
use crate::frames::Frames;
use crate::ground_truth::Tracers;
use crate::jobs::{JobLimits, Jobs};
use crate::render_queue::{RenderQueue, RenderThreadEnded};
use crate::sessions::{Sessions, Stage};
use crate::shutdown::{Drained, until_drained};
use crate::telemetry::{Metrics, start_logging};
use crate::wire::jobs::SpecLimits;
use crate::work::Work;

const FAILURE: u8 = 1;
const USAGE: u8 = 2;
/// Threads of the runtime that are busy with a blocking call when the process ends get no longer.
const LAST_PATIENCE: Duration = Duration::from_millis(200);
/// For the frame that is being drawn then, and for giving the device back.
const LAST_FRAME_PATIENCE: Duration = Duration::from_secs(5);

fn main() -> ExitCode {
    freed_memory::keep_large_apart();
    let (effective, print) = match Effective::from_process() {
        Ok(Ok(effective)) => effective,
        Ok(Err(error)) => {
            eprintln!("lumisphere-server: {error}");
            return ExitCode::from(USAGE);
        }
        // Help and version too: clap knows which stream and code.
        Err(usage) => usage.exit(),
    };
    if print {
        print!("{effective}");
        return ExitCode::SUCCESS;
    }
    start_logging(&effective.config.log);
    match run(effective) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error:#}");
            ExitCode::from(FAILURE)
        }
    }
}

fn run(effective: Effective) -> anyhow::Result<()> {
    for entry in &effective.entries {
        tracing::info!(key = entry.key, value = entry.value, origin = %entry.origin, "configuration");
    }
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().context("cannot start the runtime")?;
    let grace = effective.config.shutdown_grace;
    let (app, render_thread) = assemble(effective, runtime.handle())?;
    let app = Arc::new(app);
    let served = runtime.block_on(async {
        let serving = async {
            let served = serve::serve(app.clone(), grace).await;
            // Could not serve: then the jobs stop too.
            app.stopping.cancel();
            served
        };
        tokio::join!(serving, stop_jobs(&app, grace)).0
    });
    runtime.shutdown_timeout(LAST_PATIENCE);
    drop(app);
    render_thread.wait(LAST_FRAME_PATIENCE);
    served
}

/// Once asked to stop: running jobs stop between two pieces and go on after the next start. One that takes longer than `grace` is as good
/// as killed.
async fn stop_jobs(app: &App, grace: Duration) {
    app.stopping.cancelled().await;
    let jobs = app.jobs.clone();
    let stopped = tokio::task::spawn_blocking(move || jobs.stop());
    if let (_, Drained::Cut) = until_drained(stopped, &app.stopping, grace).await {
        tracing::warn!("a job did not stop in time; it goes on after the next start from what it has stored");
    }
}

fn assemble(effective: Effective, runtime: &tokio::runtime::Handle) -> anyhow::Result<(App, RenderThreadEnded)> {
    let Effective { config, entries } = effective;
    let metrics = Arc::new(Metrics::new());
    let uploads = UploadLimits { blob_bytes: config.max_blob_bytes, unfinished_bytes: config.max_unfinished_upload_bytes };
    let catalog = Catalog::open(&config.data_dir, config.cache, uploads).context("cannot open the data folder")?;
    let catalog = Arc::new(catalog);
    let (queue, adapter) = start_rendering(&config)?;
    let render_thread = queue.ended();
    let (store, scene_bytes) = (catalog.store().clone(), config.job_scene_bytes);
    let truths = RenderQueue::start(config.render_queue_length, "trace", move || Tracers::new(store.clone(), scene_bytes), |_| ())?;
    let frames = Frames::new(queue, truths, metrics.clone());
    let limits = SpecLimits { max_pixels: config.max_pixels_per_frame, max_cameras: config.max_cameras_per_job };
    let work = Work {
        catalog: catalog.clone(),
        frames: frames.clone(),
        runtime: runtime.clone(),
        limits,
        scene_bytes: config.job_scene_bytes,
        backend: config.backend,
    };
    let job_limits = JobLimits {
        concurrent: config.max_concurrent_jobs,
        queued: config.max_queued_jobs,
        kept: config.jobs_kept,
        threads: config.job_threads,
    };
    let jobs = Jobs::start(&config.data_dir.join("jobs"), job_limits, work).context("cannot read the job records")?;
    let stopping = CancellationToken::new();
    let stage = Stage {
        catalog: catalog.clone(),
        frames: frames.clone(),
        metrics: metrics.clone(),
        stopping: stopping.clone(),
        max_pixels_per_frame: config.max_pixels_per_frame,
        upload_bytes_per_frame: config.gpu_upload_bytes_per_frame,
        looks_ahead: config.prefetch == Prefetch::Motion && adapter.is_some(),
        video_places: Arc::new(tokio::sync::Semaphore::new(config.max_video_sessions)),
        expiry: config.session_expiry,
        mute_patience: config.mute_viewer,
    };
    let app = App {
        catalog,
        frames,
        jobs: Arc::new(jobs),
        sessions: Sessions::new(config.max_sessions, stage),
        metrics,
        adapter,
        gpu_baseline: std::sync::Mutex::default(),
        replays: Arc::new(tokio::sync::Semaphore::new(1)),
        stopping,
        started: Instant::now(),
        frame_ids: AtomicU64::new(0),
        config,
        entries,
    };
    Ok((app, render_thread))
}

/// The render thread, and the adapter it found.
fn start_rendering(config: &Config) -> anyhow::Result<(RenderQueue<Renderer>, Option<Adapter>)> {
    let (choice, budget, policy) = (config.backend, config.gpu_cache_bytes, config.gpu_cache_policy);
    let (told, adapter) = std::sync::mpsc::channel();
    let make = move || {
        let renderer = make_renderer(choice, budget)?;
        renderer.set_gpu_policy(policy);
        // Only the first renderer's adapter is waited for.
        let _ = told.send(adapter_of(&renderer));
        Ok::<_, anyhow::Error>(renderer)
    };
    let queue = RenderQueue::start(config.render_queue_length, "render", make, |renderer| renderer.settle())?;
    let adapter = adapter.recv().context("the render thread ended early")?;
    match &adapter {
        Some(adapter) => tracing::info!(adapter = adapter.name, driver = adapter.driver, "rendering on the GPU"),
        None => tracing::warn!("no graphics adapter is used; rendering on the CPU"),
    }
    Ok((queue, adapter))
}

fn make_renderer(choice: BackendChoice, gpu_cache_bytes: u64) -> anyhow::Result<Renderer> {
    match choice {
        BackendChoice::Cpu => Ok(Renderer::cpu_only()),
        BackendChoice::Gpu => Renderer::with_gpu(gpu_cache_bytes).context("backend = \"gpu\""),
        BackendChoice::Auto => Ok(Renderer::with_gpu(gpu_cache_bytes).unwrap_or_else(|reason| {
            tracing::warn!(%reason, "no GPU");
            Renderer::cpu_only()
        })),
    }
}

fn adapter_of(renderer: &Renderer) -> Option<Adapter> {
    renderer.adapter().map(|name| Adapter { name, driver: renderer.driver().unwrap_or_default() })
}
