//! The texture cache.

use std::sync::Arc;

use lumisphere::geometry::Camera;
use lumisphere::render::Renderer;
use lumisphere::representations::{Lobe, PixelOrder, Recording, RequestTrace, Settings};
use lumisphere::textures::Trace;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{Answers, Api, App, blocking};
use crate::errors::{ApiError, Reason};
use crate::replay::{Outcomes, Replay};
use crate::wire::cache::{CacheChange, cache_change, interval, recording, traffic_time};
use crate::wire::camera::camera;
use crate::wire::proto::{self, cache_server::Cache};
use crate::wire::settings::{check_kind, stored_settings};
use crate::wire::{self, MAX_CHUNK_BYTES};

/// Of one recording in memory; its file is smaller.
const MAX_RECORDING_BYTES: usize = 256 << 20;

#[tonic::async_trait]
impl Cache for Api {
    async fn get_cache_stats(&self, _: Request<proto::GetCacheStatsRequest>) -> Result<Response<proto::CacheStats>, Status> {
        Ok(Response::new(self.0.cache_stats()))
    }

    type WatchCacheStatsStream = Answers<proto::CacheStats>;

    async fn watch_cache_stats(
        &self,
        request: Request<proto::WatchCacheStatsRequest>,
    ) -> Result<Response<Self::WatchCacheStatsStream>, Status> {
        let (app, every) = (self.0.clone(), interval(request.into_inner().interval_seconds)?);
        let (told, answers) = mpsc::channel(1);
        tokio::spawn(async move {
            let mut ticks = tokio::time::interval(every);
            ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
            loop {
                tokio::select! {
                    () = app.stopping.cancelled() => return,
                    () = told.closed() => return,
                    _ = ticks.tick() => if told.send(Ok(app.cache_stats())).await.is_err() { return },
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    async fn configure_cache(&self, request: Request<proto::ConfigureCacheRequest>) -> Result<Response<proto::CacheStats>, Status> {
        configure(&self.0, cache_change(request.get_ref())?).await?;
        Ok(Response::new(self.0.cache_stats()))
    }

    async fn clear_cache(&self, request: Request<proto::ClearCacheRequest>) -> Result<Response<proto::CacheStats>, Status> {
        let app = self.0.clone();
        let catalog = app.catalog.clone();
        blocking(move || {
            catalog.clear_cache();
            Ok(())
        })
        .await?;
        let resets = request.into_inner().reset_counters;
        if app.adapter.is_some() {
            let empty = move |renderer: &Renderer| {
                empty_gpu_tier(renderer);
                if resets {
                    renderer.forget_gpu_peaks();
                }
            };
            app.frames.with_gpu_tier(empty).await?;
        }
        if resets {
            app.reset_cache_counters();
        }
        Ok(Response::new(app.cache_stats()))
    }

    type RecordTraceStream = Answers<proto::TraceChunk>;

    async fn record_trace(&self, request: Request<proto::RecordTraceRequest>) -> Result<Response<Self::RecordTraceStream>, Status> {
        self.0.accepting()?;
        let wish = Wish::checked(&self.0, request.into_inner())?;
        let app = self.0.clone();
        let (chunks, answers) = mpsc::channel(2);
        tokio::spawn(async move {
            let gone = chunks.clone();
            let recorded = blocking(move || wish.record(&app, || gone.is_closed() || app.stopping.is_cancelled())).await;
            send_trace(recorded, chunks).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    type RecordTrafficStream = Answers<proto::TraceChunk>;

    async fn record_traffic(&self, request: Request<proto::RecordTrafficRequest>) -> Result<Response<Self::RecordTrafficStream>, Status> {
        self.0.accepting()?;
        let time = traffic_time(request.into_inner().seconds)?;
        let app = self.0.clone();
        let lease = app.catalog.start_recording(MAX_RECORDING_BYTES)?;
        let (chunks, answers) = mpsc::channel(2);
        tokio::spawn(async move {
            tokio::select! {
                () = tokio::time::sleep(time) => {}
                () = app.stopping.cancelled() => {}
                // Dropping the lease ends the recording.
                () = chunks.closed() => return,
            }
            send_trace(blocking(move || Ok(lease.finish())).await, chunks).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    type ReplayTraceStream = Answers<proto::ReplayOutcome>;

    async fn replay_trace(
        &self,
        request: Request<Streaming<proto::ReplayTraceRequest>>,
    ) -> Result<Response<Self::ReplayTraceStream>, Status> {
        self.0.accepting()?;
        let app = self.0.clone();
        let busy = |_| ApiError::new(Reason::ReplayBusy, "another replay is under way; try again when it has ended");
        let place = app.replays.clone().try_acquire_owned().map_err(busy)?;
        let (told, answers) = mpsc::channel(2);
        tokio::spawn(async move {
            let outcome = tokio::select! {
                outcome = replayed(&app, request.into_inner(), told.clone()) => outcome,
                () = app.stopping.cancelled() => Err(ApiError::new(Reason::ShuttingDown, "the server is stopping")),
            };
            drop(place);
            if let Err(error) = outcome {
                let _ = told.send(Err(error.into())).await;
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }
}

async fn replayed(app: &Arc<App>, messages: Streaming<proto::ReplayTraceRequest>, told: Outcomes) -> Result<(), ApiError> {
    let replay = Replay::received(messages).await?;
    let (app, most_bytes) = (app.clone(), app.config.cache.decoded_bytes);
    blocking(move || {
        let open = |dataset: &str, version| app.catalog.store().open_version(dataset, Some(version));
        replay.run(open, most_bytes, &told, || told.is_closed() || app.stopping.is_cancelled())
    })
    .await
}

/// All or nothing: what can fail comes first.
async fn configure(app: &Arc<App>, change: CacheChange) -> Result<(), ApiError> {
    if let (Some(field), None) = (change.gpu_field(), &app.adapter) {
        return Err(ApiError::new(Reason::NoGpu, format!("{field}: there is no graphics adapter")));
    }
    if let Some(dataset) = change.dataset.clone() {
        let catalog = app.catalog.clone();
        blocking(move || catalog.check_exists(&dataset)).await?;
    }
    if change.gpu_field().is_some() {
        let (policy, budget) = (change.gpu_policy, change.gpu_budget_bytes);
        let change = move |renderer: &Renderer| {
            policy.into_iter().for_each(|policy| renderer.set_gpu_policy(policy));
            budget.into_iter().for_each(|bytes| renderer.set_gpu_budget(bytes));
        };
        app.frames.with_gpu_tier(change).await?;
    }
    let catalog = app.catalog.clone();
    blocking(move || {
        catalog.configure_cache(&change);
        Ok(())
    })
    .await
}

/// Without room nothing stays; then there is room again.
fn empty_gpu_tier(renderer: &Renderer) {
    let budget = renderer.gpu_stats().map_or(0, |stats| stats.budget_bytes);
    renderer.set_gpu_budget(0);
    renderer.set_gpu_budget(budget);
}

/// A checked request for a recording.
struct Wish {
    dataset: String,
    version: u64,
    cameras: Vec<Camera>,
    settings: Settings,
    order: PixelOrder,
    lobe: Option<Lobe>,
}

impl Wish {
    fn checked(app: &App, m: proto::RecordTraceRequest) -> Result<Self, ApiError> {
        let (order, lobe) = recording(&m)?;
        let limits = app.spec_limits();
        if m.cameras.is_empty() || m.cameras.len() > limits.max_cameras {
            let problem = format!("{} cameras, 1 to {} expected", m.cameras.len(), limits.max_cameras);
            return Err(ApiError::field("cameras", problem));
        }
        let cameras = m.cameras.into_iter().enumerate().map(|(i, c)| camera(Some(c), limits.max_pixels, &format!("cameras[{i}]")));
        let settings = stored_settings(m.settings, "settings")?.settings;
        if settings.brdf().is_some() {
            let problem = "GLOSSY, another component expected: a recording's own lobe draws directions";
            return Err(ApiError::field("settings.offset_surface_light_field.component", problem));
        }
        if settings.bumps().is_some() {
            return Err(ApiError::field("settings.offset_surface_light_field.normal_map", "given, none expected in a recording"));
        }
        Ok(Self {
            dataset: wire::dataset_name(&m.dataset, "dataset")?,
            version: m.version,
            cameras: cameras.collect::<Result<_, _>>()?,
            settings,
            order,
            lobe,
        })
    }

    fn record(&self, app: &App, is_unwanted: impl Fn() -> bool) -> Result<Trace, ApiError> {
        let version = app.catalog.open_version(&self.dataset, self.version)?;
        check_kind(&self.settings, version.representation.kind().name())?;
        let kernel = version.representation.clone().cpu_kernel();
        let mut trace = RequestTrace::new(&version.pages.version, version.representation.as_ref(), MAX_RECORDING_BYTES)?;
        for camera in &self.cameras {
            if is_unwanted() {
                return Err(ApiError::new(Reason::ShuttingDown, "the recording is not wanted any more"));
            }
            trace.begin_frame();
            let recording = Recording { camera, settings: &self.settings, order: self.order, lobe: self.lobe };
            kernel.record(&recording, &mut |request| trace.push(request))?;
            if trace.is_full() {
                let problem = "the recording is too large: fewer cameras, pixels or lobe samples expected";
                return Err(ApiError::new(Reason::TraceTooLarge, problem));
            }
        }
        Ok(trace.finish())
    }
}

/// The trace's file in chunks, or why there is none.
async fn send_trace(recorded: Result<Trace, ApiError>, chunks: mpsc::Sender<Result<proto::TraceChunk, Status>>) {
    let bytes = match recorded {
        Ok(trace) => trace.to_bytes(),
        Err(error) => {
            let _ = chunks.send(Err(error.into())).await;
            return;
        }
    };
    for chunk in bytes.chunks(MAX_CHUNK_BYTES) {
        if chunks.send(Ok(proto::TraceChunk { data: chunk.to_vec().into() })).await.is_err() {
            return;
        }
    }
}
