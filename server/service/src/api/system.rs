//! What the server is.

use std::sync::LazyLock;

use bytes::Bytes;
use tonic::{Request, Response, Status};

use super::{Api, App};
use crate::errors::ApiError;
use crate::wire::proto::{self, system_server::System};
use crate::wire::{API, MAX_CHUNK_BYTES, MAX_FRAME_MESSAGE_BYTES, MAX_LINK_PAYLOAD_BYTES, MAX_REQUEST_BYTES};

/// Sorted.
const FEATURES: [&str; 30] = [
    "brdf_tables",
    "depth_format",
    "encoding.exr",
    "encoding.jpeg",
    "encoding.png",
    "encoding.raw_zstd",
    "encoding_at_rest",
    "exposure_gamma",
    "ground_truth",
    "grpc-web",
    "health",
    "interact",
    "job.capture",
    "job.evaluate",
    "job.fit",
    "job.import",
    "job.observe",
    "job.path_render",
    "job.suggest",
    "job.thin",
    "measure_link",
    "moving_frames_per_second",
    "normal_maps",
    "reflection",
    "refraction",
    "relighting",
    "representation.offset_surface_light_field",
    "representation.parameter_map",
    "sessions",
    "upload.resumable",
];

/// Sorted, too.
fn features() -> Vec<String> {
    let mut features: Vec<String> = FEATURES.iter().map(|f| f.to_string()).collect();
    if cfg!(feature = "h264") {
        features.push("encoding.h264".into());
    }
    features.sort();
    features
}

/// What `MeasureLink` answers with: nothing on the way makes it shorter.
static NOISE: LazyLock<Bytes> = LazyLock::new(|| {
    let mut noise = vec![0; MAX_LINK_PAYLOAD_BYTES];
    blake3::Hasher::new().finalize_xof().fill(&mut noise);
    noise.into()
});

#[tonic::async_trait]
impl System for Api {
    async fn get_version(&self, _: Request<proto::GetVersionRequest>) -> Result<Response<proto::GetVersionResponse>, Status> {
        Ok(Response::new(proto::GetVersionResponse { version: env!("CARGO_PKG_VERSION").into(), api: API.into(), features: features() }))
    }

    async fn get_server_info(&self, _: Request<proto::GetServerInfoRequest>) -> Result<Response<proto::GetServerInfoResponse>, Status> {
        let app = &self.0;
        let backend = if app.adapter.is_some() { proto::Backend::Gpu } else { proto::Backend::Cpu };
        let (adapter, driver) = app.adapter.clone().map(|a| (a.name, a.driver)).unwrap_or_default();
        Ok(Response::new(proto::GetServerInfoResponse {
            backend: backend as i32,
            adapter,
            driver,
            limits: Some(limits(app)),
            configuration: configuration(app),
            uptime_seconds: app.started.elapsed().as_secs_f64(),
            shutting_down: app.stopping.is_cancelled(),
        }))
    }

    async fn measure_link(&self, request: Request<proto::MeasureLinkRequest>) -> Result<Response<proto::MeasureLinkResponse>, Status> {
        let request = request.into_inner();
        let wanted = usize::try_from(request.answer_bytes).ok().filter(|wanted| *wanted <= MAX_LINK_PAYLOAD_BYTES);
        let problem = || ApiError::field("answer_bytes", format!("{}, at most {MAX_LINK_PAYLOAD_BYTES} expected", request.answer_bytes));
        let payload = NOISE.slice(..wanted.ok_or_else(problem)?);
        if request.payload.len() > MAX_LINK_PAYLOAD_BYTES {
            let problem = format!("{} bytes, at most {MAX_LINK_PAYLOAD_BYTES} expected", request.payload.len());
            return Err(ApiError::field("payload", problem).into());
        }
        Ok(Response::new(proto::MeasureLinkResponse { payload, received_bytes: request.payload.len() as u64 }))
    }
}

fn limits(app: &App) -> proto::Limits {
    let config = &app.config;
    proto::Limits {
        max_pixels_per_frame: config.max_pixels_per_frame,
        max_request_bytes: MAX_REQUEST_BYTES as u64,
        max_frame_message_bytes: MAX_FRAME_MESSAGE_BYTES as u64,
        max_chunk_bytes: MAX_CHUNK_BYTES as u64,
        max_blob_bytes: config.max_blob_bytes,
        max_cameras_per_job: config.max_cameras_per_job as u64,
        render_queue_length: config.render_queue_length as u64,
        max_concurrent_jobs: config.max_concurrent_jobs as u64,
        max_queued_jobs: config.max_queued_jobs as u64,
        max_sessions: config.max_sessions as u64,
    }
}

fn configuration(app: &App) -> Vec<proto::ConfigurationEntry> {
    let entry =
        |e: &crate::config::Entry| proto::ConfigurationEntry { key: e.key.into(), value: e.value.clone(), origin: e.origin.to_string() };
    app.entries.iter().map(entry).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn features_are_sorted() {
        assert!(super::FEATURES.is_sorted());
    }
}
