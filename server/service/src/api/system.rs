//! What the server is.

use tonic::{Request, Response, Status};

use super::{Api, App};
use crate::wire::proto::{self, system_server::System};
use crate::wire::{API, MAX_CHUNK_BYTES, MAX_FRAME_MESSAGE_BYTES, MAX_REQUEST_BYTES};

/// Sorted.
const FEATURES: [&str; 14] = [
    "encoding.exr",
    "encoding.jpeg",
    "encoding.png",
    "encoding.raw_zstd",
    "grpc-web",
    "health",
    "interact",
    "job.capture",
    "job.evaluate",
    "job.path_render",
    "job.thin",
    "reflection",
    "representation.offset_surface_light_field",
    "upload.resumable",
];

#[tonic::async_trait]
impl System for Api {
    async fn get_version(&self, _: Request<proto::GetVersionRequest>) -> Result<Response<proto::GetVersionResponse>, Status> {
        Ok(Response::new(proto::GetVersionResponse {
            version: env!("CARGO_PKG_VERSION").into(),
            api: API.into(),
            features: FEATURES.iter().map(|f| f.to_string()).collect(),
        }))
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
