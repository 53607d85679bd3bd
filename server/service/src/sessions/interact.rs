//! `Interact`: messages up and frames down on one stream, with which the session ends.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::session::{Session, ShowEnded, Update};
use super::{Answers, OUTBOX, Outbox, Stage, farewell, farewell_of_the_server, mute, response, status};
use crate::errors::{ApiError, Reason};
use crate::wire::{self, proto};
use proto::interact_request::Message as Up;
use proto::interact_response::Message as Down;

/// A client that opens a stream must say what it wants within this time.
const OPENING_PATIENCE: Duration = Duration::from_secs(30);

/// Runs until the client leaves or the server stops.
pub fn start(
    stage: Arc<Stage>,
    up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Send + Unpin + 'static,
    room: OwnedSemaphorePermit,
) -> Answers {
    let (down, answers) = mpsc::channel(OUTBOX);
    // Answered at once: a client that waits for the answer's head before it sends its first message is served too.
    tokio::spawn(async move {
        if let Err(error) = open_and_run(stage, up, down.clone(), room).await {
            let _ = down.send(Err(error.into())).await;
        }
    });
    answers
}

async fn open_and_run(
    stage: Arc<Stage>,
    mut up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Send + Unpin + 'static,
    down: Outbox,
    room: OwnedSemaphorePermit,
) -> Result<(), ApiError> {
    let order = |problem: &str| ApiError::new(Reason::InteractionOrder, problem);
    let first = tokio::select! {
        first = tokio::time::timeout(OPENING_PATIENCE, up.next()) => first.map_err(|_| order("the interaction was not opened in time"))?,
        () = stage.stopping.cancelled() => return Err(ApiError::new(Reason::ShuttingDown, "the server is stopping")),
    };
    let Some(Ok(proto::InteractRequest { message: Some(Up::Open(open)) })) = first else {
        return Err(order("the first message must open the interaction"));
    };
    let session = Session::open(stage, open, room).await?;
    // The outbox is empty, so this does not wait.
    let _ = down.send(Ok(response(Down::Opened(session.opened(Duration::ZERO))))).await;
    run(session, up, down).await;
    Ok(())
}

async fn run(session: Session, up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Unpin, down: Outbox) {
    let half_closed = CancellationToken::new();
    let stopping = session.stage().stopping.clone();
    // Messages are taken for as long as frames are shown: until the client has half-closed and its last pose is shown.
    let shown = async {
        tokio::select! {
            ended = session.show(&down, &half_closed) => ended,
            () = async { listen(&session, up, &down, &half_closed).await; std::future::pending().await } => ShowEnded::Left,
        }
    };
    let ended = tokio::select! {
        ended = shown => Some(ended),
        () = down.closed() => Some(ShowEnded::Left),
        () = stopping.cancelled() => None,
    };
    match ended {
        Some(ShowEnded::Left) => {}
        Some(ShowEnded::Mute) => {
            let error = mute(session.stage());
            // Its place is free before it has read why.
            drop(session);
            farewell(down, error).await;
        }
        None => farewell_of_the_server(down).await,
    }
}

/// Gives the session what comes up until the client half-closes.
async fn listen(
    session: &Session,
    mut up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Unpin,
    down: &Outbox,
    half_closed: &CancellationToken,
) {
    let mut sequence = 0;
    while let Some(Ok(request)) = up.next().await {
        sequence += 1;
        let pose_id = match &request.message {
            Some(Up::Pose(pose)) => pose.pose_id,
            _ => 0,
        };
        if let Err(error) = update(request, sequence).and_then(|update| session.take(update)) {
            // Told if there is room: a client that floods without reading does not fill our memory.
            let _ = down.try_send(Ok(response(status(&error, pose_id))));
        }
    }
    half_closed.cancel();
}

fn update(request: proto::InteractRequest, sequence: u64) -> Result<Update, ApiError> {
    let nothing = Update { sequence, pose: None, settings: None, acknowledge: None };
    match wire::required(request.message, "message")? {
        Up::Open(_) => Err(ApiError::new(Reason::InteractionOrder, "the interaction is open already")),
        Up::Pose(pose) => Ok(Update { pose: Some(pose), ..nothing }),
        Up::Settings(settings) => Ok(Update { settings: Some(settings), ..nothing }),
        Up::Acknowledge(acknowledge) => Ok(Update { acknowledge: Some(acknowledge), ..nothing }),
    }
}
