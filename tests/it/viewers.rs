//! Viewers over each way that poses can go up and frames come down. What holds for one transport holds for all.

use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Status, Streaming};
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::{Blend, Component};
use wire::rendering_client::RenderingClient;

use crate::grpc_web;
use crate::process::{PATIENCE, Server, ServerAddress};
use crate::tiny::DATASET;
use crate::wire::{output, settings};

/// How messages travel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Transport {
    /// One stream each way.
    Interact,
    /// Calls up and a stream down, HTTP/2.
    Session,
    /// The same as a browser makes them: gRPC-Web, HTTP/1.1.
    Web,
}

/// All of them.
pub const TRANSPORTS: [Transport; 3] = [Transport::Interact, Transport::Session, Transport::Web];

/// A client that looks.
pub struct Viewer {
    up: Upward,
    down: Option<Stream>,
}

enum Upward {
    Stream(mpsc::Sender<wire::InteractRequest>),
    Calls { client: RenderingClient<Channel>, session_id: String, sequence: u64 },
    Web { server: ServerAddress, session_id: String, sequence: u64 },
}

/// What comes down.
pub enum Stream {
    /// As tonic reads it.
    Http2(Streaming<wire::InteractResponse>),
    /// As a browser does.
    Web(grpc_web::Answer),
}

impl Stream {
    /// What comes next: a message, the end, or the error that is the end.
    pub async fn answer(&mut self) -> Result<Option<Down>, Status> {
        let next = async {
            match self {
                Self::Http2(down) => down.message().await,
                Self::Web(down) => down.message::<wire::InteractResponse>().await,
            }
        };
        let answer = tokio::time::timeout(PATIENCE, next).await.expect("an answer in time")?;
        Ok(answer.map(|response| response.message.expect("responses have a message")))
    }
}

/// Raw frames of the tiny dataset, both terms.
pub fn opening(credits: u32) -> wire::OpenInteraction {
    wire::OpenInteraction {
        dataset: DATASET.into(),
        version: 0,
        settings: Some(settings(Component::Full, Blend::Average)),
        output: Some(output(wire::Encoding::RawZstd)),
        credits,
        moving_frames_per_second: Some(0.0),
    }
}

impl Viewer {
    /// Over `Interact`.
    pub async fn open(server: &Server, credits: u32) -> Self {
        Self::open_as(server, opening(credits), Transport::Interact).await.unwrap()
    }

    /// The same with other settings.
    pub async fn open_with(server: &Server, credits: u32, settings: wire::RenderSettings) -> Self {
        let open = wire::OpenInteraction { settings: Some(settings), ..opening(credits) };
        Self::open_as(server, open, Transport::Interact).await.unwrap()
    }

    /// Opens and hears that it is open.
    pub async fn open_as(server: &Server, open: wire::OpenInteraction, transport: Transport) -> Result<Self, Status> {
        let credits = open.credits;
        let mut viewer = match transport {
            Transport::Interact => {
                let (up, messages) = mpsc::channel(16);
                up.send(wire::InteractRequest { message: Some(Up::Open(open)) }).await.unwrap();
                let down = server.rendering().await.interact(ReceiverStream::new(messages)).await?.into_inner();
                Self { up: Upward::Stream(up), down: Some(Stream::Http2(down)) }
            }
            Transport::Session => {
                let mut client = server.rendering().await;
                let opened = client.open_session(wire::OpenSessionRequest { open: Some(open) }).await?.into_inner();
                let up = Upward::Calls { client: client.clone(), session_id: opened.session_id.clone(), sequence: 0 };
                let request = wire::StreamFramesRequest { session_id: opened.session_id };
                Self { up, down: Some(Stream::Http2(client.stream_frames(request).await?.into_inner())) }
            }
            Transport::Web => {
                let server = server.address();
                let request = wire::OpenSessionRequest { open: Some(open) };
                let opened: wire::OpenSessionResponse = grpc_web::unary(&server, "Rendering/OpenSession", &request).await?;
                let request = wire::StreamFramesRequest { session_id: opened.session_id.clone() };
                let down = grpc_web::call(&server, "Rendering/StreamFrames", &request).await;
                Self { up: Upward::Web { server, session_id: opened.session_id, sequence: 0 }, down: Some(Stream::Web(down)) }
            }
        };
        match viewer.answer().await? {
            Some(Down::Opened(opened)) => {
                assert_eq!((opened.dataset_version, opened.credits), (1, credits));
                assert_eq!(opened.expires_after_seconds > 0, transport != Transport::Interact, "{opened:?}");
            }
            other => panic!("{transport:?}: opened expected first, not {other:?}"),
        }
        Ok(viewer)
    }

    /// A message that is taken.
    pub async fn send(&mut self, message: Up) {
        self.call(message).await.unwrap();
    }

    /// A message that is refused; why.
    pub async fn refused(&mut self, message: Up) -> wire::InteractStatus {
        match (self.call(message).await, &self.up) {
            (Ok(()), Upward::Stream(_)) => match self.next().await {
                Some(Down::Status(status)) => status,
                other => panic!("a status expected, not {other:?}"),
            },
            (Ok(()), _) => panic!("a refusal expected"),
            (Err(status), _) => {
                let (code, reason) = crate::wire::code_and_reason(&status);
                wire::InteractStatus { code: code as i32, reason, message: status.message().into(), pose_id: 0 }
            }
        }
    }

    async fn call(&mut self, message: Up) -> Result<(), Status> {
        match &mut self.up {
            Upward::Stream(up) => up.send(wire::InteractRequest { message: Some(message) }).await.unwrap(),
            Upward::Calls { client, session_id, sequence } => {
                *sequence += 1;
                client.update_session(update(session_id, *sequence, message)).await?;
            }
            Upward::Web { server, session_id, sequence } => {
                *sequence += 1;
                let update = update(session_id, *sequence, message);
                grpc_web::unary::<wire::UpdateSessionResponse>(server, "Rendering/UpdateSession", &update).await?;
            }
        }
        Ok(())
    }

    /// A pose.
    pub async fn pose(&mut self, pose_id: u64, camera: wire::Camera) {
        self.send(Up::Pose(wire::PoseUpdate { pose_id, camera: Some(camera) })).await;
    }

    /// This frame and all before it have arrived.
    pub async fn acknowledge(&mut self, frame_id: u64) {
        self.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id })).await;
    }

    /// What comes next: a message, the end, or the error that is the end.
    pub async fn answer(&mut self) -> Result<Option<Down>, Status> {
        self.down.as_mut().expect("a stream is open").answer().await
    }

    /// The next message, if the stream does not end.
    pub async fn next(&mut self) -> Option<Down> {
        self.answer().await.unwrap()
    }

    /// The next message, which must be a frame.
    pub async fn frame(&mut self) -> wire::Frame {
        match self.next().await {
            Some(Down::Frame(frame)) => frame,
            other => panic!("a frame expected, not {other:?}"),
        }
    }

    /// Sends no more.
    pub fn half_close(&mut self) {
        match &mut self.up {
            Upward::Stream(up) => *up = mpsc::channel(1).0,
            Upward::Calls { .. } | Upward::Web { .. } => panic!("only a stream is half-closed"),
        }
    }

    /// Half-closes a stream, or closes a session, and hears the end.
    pub async fn leave(mut self) {
        let close = |session_id: &str| wire::CloseSessionRequest { session_id: session_id.into() };
        match &mut self.up {
            Upward::Stream(_) => self.half_close(),
            Upward::Calls { client, session_id, .. } => drop(client.close_session(close(session_id)).await.unwrap()),
            Upward::Web { server, session_id, .. } => {
                grpc_web::unary::<wire::CloseSessionResponse>(server, "Rendering/CloseSession", &close(session_id)).await.unwrap();
            }
        }
        assert_eq!(self.next().await, None, "the end");
    }

    /// Names the session in calls beside this viewer's.
    pub fn session_id(&self) -> &str {
        match &self.up {
            Upward::Stream(_) => panic!("Interact has no session"),
            Upward::Calls { session_id, .. } | Upward::Web { session_id, .. } => session_id,
        }
    }

    /// Breaks the stream.
    pub fn hang_up(&mut self) {
        self.down = None;
    }

    /// Another stream of the same session; the one before, if it was not broken, is returned.
    pub async fn stream_again(&mut self) -> Option<Stream> {
        let request = wire::StreamFramesRequest { session_id: self.session_id().into() };
        let down = match &mut self.up {
            Upward::Stream(_) => panic!("Interact has one stream"),
            Upward::Calls { client, .. } => Stream::Http2(client.stream_frames(request).await.unwrap().into_inner()),
            Upward::Web { server, .. } => Stream::Web(grpc_web::call(server, "Rendering/StreamFrames", &request).await),
        };
        self.down.replace(down)
    }
}

fn update(session_id: &str, sequence: u64, message: Up) -> wire::UpdateSessionRequest {
    let nothing = wire::UpdateSessionRequest { session_id: session_id.into(), sequence, ..Default::default() };
    match message {
        Up::Open(_) => panic!("a session is opened by a call of its own"),
        Up::Pose(pose) => wire::UpdateSessionRequest { pose: Some(pose), ..nothing },
        Up::Settings(settings) => wire::UpdateSessionRequest { settings: Some(settings), ..nothing },
        Up::Acknowledge(acknowledge) => wire::UpdateSessionRequest { acknowledge: Some(acknowledge), ..nothing },
    }
}
