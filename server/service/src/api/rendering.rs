//! Frames.

use std::time::Instant;

use lumisphere::render::Refine;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{Answers, Api, App, blocking};
use crate::errors::ApiError;
use crate::frames::{Caller, FrameOrder};
use crate::ground_truth::check_truth;
use crate::render_queue::Priority;
use crate::wire::frames::{FrameIdentity, frame};
use crate::wire::proto::{self, rendering_server::Rendering};
use crate::wire::settings::{Delivery, check_kind, output, render_settings};
use crate::wire::{self, camera::camera};

#[tonic::async_trait]
impl Rendering for Api {
    async fn render_frame(&self, request: Request<proto::RenderFrameRequest>) -> Result<Response<proto::Frame>, Status> {
        self.0.accepting()?;
        let deadline = wire::timeout(request.metadata()).map(|t| tokio::time::Instant::now() + t);
        let rendered = render(&self.0, request.into_inner(), deadline).await?;
        Ok(Response::new(rendered))
    }

    type InteractStream = Answers<proto::InteractResponse>;

    async fn interact(&self, request: Request<Streaming<proto::InteractRequest>>) -> Result<Response<Self::InteractStream>, Status> {
        self.0.accepting()?;
        let answers = self.0.sessions.interact(request.into_inner())?;
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    async fn open_session(&self, request: Request<proto::OpenSessionRequest>) -> Result<Response<proto::OpenSessionResponse>, Status> {
        self.0.accepting()?;
        Ok(Response::new(self.0.sessions.open_kept(request.into_inner().open).await?))
    }

    async fn update_session(
        &self,
        request: Request<proto::UpdateSessionRequest>,
    ) -> Result<Response<proto::UpdateSessionResponse>, Status> {
        self.0.sessions.update(request.into_inner())?;
        Ok(Response::new(proto::UpdateSessionResponse {}))
    }

    type StreamFramesStream = Answers<proto::InteractResponse>;

    async fn stream_frames(&self, request: Request<proto::StreamFramesRequest>) -> Result<Response<Self::StreamFramesStream>, Status> {
        self.0.accepting()?;
        let answers = self.0.sessions.stream(&request.into_inner().session_id)?;
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }

    async fn close_session(&self, request: Request<proto::CloseSessionRequest>) -> Result<Response<proto::CloseSessionResponse>, Status> {
        self.0.sessions.close(&request.into_inner().session_id)?;
        Ok(Response::new(proto::CloseSessionResponse {}))
    }
}

async fn render(app: &App, m: proto::RenderFrameRequest, deadline: Option<tokio::time::Instant>) -> Result<proto::Frame, ApiError> {
    let dataset = wire::dataset_name(&m.dataset, "dataset")?;
    let camera = camera(m.camera, app.config.max_pixels_per_frame, "camera")?;
    let settings = render_settings(m.settings, "settings")?;
    let output = output(m.output, Delivery::Alone, "output")?;
    let (catalog, begun) = (app.catalog.clone(), Instant::now());
    let version = blocking(move || catalog.open_version(&dataset, m.version)).await?;
    check_kind(&settings.settings, version.representation.kind().name())?;
    version.looks.check(&settings.settings)?;
    check_truth(&settings, &version)?;
    let opening_micros = begun.elapsed().as_micros() as u64;
    let (version_shown, refine, passes) = (version.clone(), Refine::Whole, settings.passes);
    let order = FrameOrder { version: version_shown, camera, settings, output, opening_micros, refine, passes, video: None };
    let encoded = app.frames.encoded(order, Caller { who: Priority::Viewer, deadline }).await?;
    let (dataset, dataset_version) = (version.dataset.clone(), version.version);
    Ok(frame(encoded, FrameIdentity { frame_id: app.next_frame_id(), pose_id: m.pose_id, dataset, dataset_version }))
}
