//! Viewers: poses up, frames down. The latest pose wins, and no frame is rendered without a credit.
//!
//! A [`Session`] takes messages and shows frames into an outbox; it does not know how either travels. Two transports carry it: `interact`,
//! one stream each way, ends with its stream; `kept`, calls up and a stream down, is named and outlives its streams for a while.

mod crowd;
mod interact;
mod kept;
mod link;
mod looks;
mod pace;
mod seat;
mod session;
mod wish;

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::catalog::Catalog;
use crate::errors::{ApiError, Reason};
use crate::frames::Frames;
use crate::telemetry::Metrics;
use crate::wire::{proto, reason_name};
use kept::KeptSessions;
use proto::interact_response::Message as Down;

/// Messages between the session and the connection: one on its way, one ready. A client that stops reading stops the session.
const OUTBOX: usize = 2;
/// For the last message to a client whose outbox is full.
const FAREWELL_PATIENCE: Duration = Duration::from_secs(2);

/// What goes down.
pub type Answers = mpsc::Receiver<Result<proto::InteractResponse, Status>>;

type Outbox = mpsc::Sender<Result<proto::InteractResponse, Status>>;
type OutboxPlace<'a> = mpsc::Permit<'a, Result<proto::InteractResponse, Status>>;

/// What sessions need of the server.
pub struct Stage {
    /// To open versions.
    pub catalog: Arc<Catalog>,
    /// To render.
    pub frames: Frames,
    /// To count.
    pub metrics: Arc<Metrics>,
    /// Cancelled once the server stops.
    pub stopping: CancellationToken,
    /// Width · height.
    pub max_pixels_per_frame: u64,
    /// Texels that a frame waits for; coarse ones stand in for the rest.
    pub upload_bytes_per_frame: u64,
    /// Whether pages are brought before a moving viewer's frame wants them.
    pub looks_ahead: bool,
    /// For those that are sent H.264.
    pub video_places: Arc<Semaphore>,
    /// How long a session is kept while no stream of it is open.
    pub expiry: Duration,
    /// How long a viewer may leave a frame unread or unacknowledged.
    pub mute_patience: Duration,
}

/// Who may have how many sessions, and those that outlive their streams.
pub struct Sessions {
    stage: Arc<Stage>,
    room: Arc<Semaphore>,
    limit: usize,
    kept: Arc<KeptSessions>,
}

impl Sessions {
    /// At most `limit` at once, of both transports together.
    pub fn new(limit: usize, stage: Stage) -> Self {
        Self { stage: Arc::new(stage), room: Arc::new(Semaphore::new(limit)), limit, kept: Arc::default() }
    }

    /// Open now, those without a stream included.
    pub fn open(&self) -> usize {
        self.limit - self.room.available_permits()
    }

    /// Starts a session that runs until the client leaves or the server stops. What its first message gets wrong ends the stream.
    pub fn interact(
        &self,
        up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Send + Unpin + 'static,
    ) -> Result<Answers, ApiError> {
        Ok(interact::start(self.stage.clone(), up, self.admit()?))
    }

    /// Opens a session that is kept between streams.
    pub async fn open_kept(&self, open: Option<proto::OpenInteraction>) -> Result<proto::OpenSessionResponse, ApiError> {
        kept::open(&self.kept, self.stage.clone(), open, self.admit()?).await
    }

    /// Takes what goes up in a kept session; an error changes nothing.
    pub fn update(&self, request: proto::UpdateSessionRequest) -> Result<(), ApiError> {
        self.kept.update(request)
    }

    /// What comes down in a kept session, from now on on this stream alone.
    pub fn stream(&self, session_id: &str) -> Result<Answers, ApiError> {
        self.kept.stream(session_id)
    }

    /// Ends a kept session.
    pub fn close(&self, session_id: &str) -> Result<(), ApiError> {
        self.kept.close(session_id)
    }

    fn admit(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        let full = |_| ApiError::new(Reason::TooManySessions, format!("{} sessions are open, no more are taken", self.limit));
        self.room.clone().try_acquire_owned().map_err(full)
    }
}

fn response(message: Down) -> proto::InteractResponse {
    proto::InteractResponse { message: Some(message) }
}

fn status(error: &ApiError, pose_id: u64) -> Down {
    let (code, reason) = (error.code() as i32, reason_name(error.reason()).into());
    Down::Status(proto::InteractStatus { code, reason, message: error.message().into(), pose_id })
}

/// For a viewer that left a frame unread or unacknowledged for too long.
fn mute(stage: &Stage) -> ApiError {
    let seconds = stage.mute_patience.as_secs();
    ApiError::new(Reason::ViewerMute, format!("no frame was read or acknowledged for {seconds} s"))
}

/// Ends the stream with an error. A client that does not read gets none, after a while.
async fn farewell(down: Outbox, error: ApiError) {
    let _ = tokio::time::timeout(FAREWELL_PATIENCE, down.send(Err(error.into()))).await;
}

/// Tells the viewer that the server stops, then ends the stream.
async fn farewell_of_the_server(down: Outbox) {
    let error = ApiError::new(Reason::ShuttingDown, "the server is stopping");
    let _ = tokio::time::timeout(FAREWELL_PATIENCE, down.send(Ok(response(status(&error, 0))))).await;
    farewell(down, error).await;
}
