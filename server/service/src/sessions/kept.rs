//! Sessions for clients that cannot stream upward (browsers): calls up, a stream down. Each is known by a name that nobody guesses, and is
//! kept for a while without a stream, so that a viewer whose connection broke goes on where it was.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::session::{Session, ShowEnded, Update};
use super::{Answers, OUTBOX, Outbox, Stage, farewell, farewell_of_the_server, mute, response};
use crate::errors::{ApiError, Reason};
use crate::wire::{self, proto};
use proto::interact_response::Message as Down;

/// Random bytes of a session's name.
const NAME_BYTES: usize = 16;

/// Those that are open, by name.
#[derive(Default)]
pub struct KeptSessions {
    open: Mutex<HashMap<String, Arc<Kept>>>,
}

/// A session and whoever looks at it.
struct Kept {
    session: Session,
    /// Streams that have not ended yet; all but the newest are about to.
    streams: watch::Sender<usize>,
    /// Cancelled when another stream takes over from the newest.
    newest: Mutex<CancellationToken>,
    /// Held by the stream that shows.
    showing: tokio::sync::Mutex<()>,
    closed: CancellationToken,
}

/// A stream of the session, counted while it lives.
struct Attendance(Arc<Kept>);

/// How a stream ended.
enum End {
    /// The client has left, or the session was closed.
    Left,
    TakenOver,
    Mute,
    Stopping,
}

/// Opens a session and gives it a name.
pub async fn open(
    sessions: &Arc<KeptSessions>,
    stage: Arc<Stage>,
    open: Option<proto::OpenInteraction>,
    room: OwnedSemaphorePermit,
) -> Result<proto::OpenSessionResponse, ApiError> {
    let session = Session::open(stage, wire::required(open, "open")?, room).await?;
    let opened = session.opened(session.stage().expiry);
    let name = random_name()?;
    let kept = Arc::new(Kept {
        session,
        streams: watch::Sender::new(0),
        newest: Mutex::default(),
        showing: tokio::sync::Mutex::default(),
        closed: CancellationToken::new(),
    });
    let left = close_when_left(sessions.clone(), name.clone(), &kept);
    sessions.lock().insert(name.clone(), kept);
    tokio::spawn(left);
    Ok(proto::OpenSessionResponse { session_id: name, opened: Some(opened) })
}

fn random_name() -> Result<String, ApiError> {
    let mut bytes = [0; NAME_BYTES];
    getrandom::fill(&mut bytes).map_err(|e| ApiError::internal(format!("no random numbers: {e}")))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Ends the session once no stream of it has been open for its time. It costs nothing while this waits, which does not keep it.
fn close_when_left(sessions: Arc<KeptSessions>, name: String, kept: &Kept) -> impl Future<Output = ()> + Send + 'static {
    let (mut streams, closed) = (kept.streams.subscribe(), kept.closed.clone());
    let (stopping, expiry) = (kept.session.stage().stopping.clone(), kept.session.stage().expiry);
    async move {
        let left = async {
            // An error: the session has gone.
            while streams.wait_for(|streams| *streams == 0).await.is_ok() {
                tokio::select! {
                    _ = streams.wait_for(|streams| *streams > 0) => {}
                    () = tokio::time::sleep(expiry) => if sessions.remove_if_left(&name) { return },
                }
            }
        };
        tokio::select! {
            () = left => tracing::debug!("a session has expired"),
            () = closed.cancelled() => {}
            () = stopping.cancelled() => {}
        }
    }
}

impl KeptSessions {
    /// One call: all or nothing.
    pub fn update(&self, request: proto::UpdateSessionRequest) -> Result<(), ApiError> {
        let proto::UpdateSessionRequest { session_id, sequence, pose, settings, acknowledge } = request;
        self.find(&session_id)?.session.take(Update { sequence, pose, settings, acknowledge })
    }

    /// What comes down from now on. An earlier stream ends.
    pub fn stream(&self, session_id: &str) -> Result<Answers, ApiError> {
        let sessions = self.lock();
        let kept = sessions.get(session_id).cloned().ok_or_else(unknown)?;
        // Counted under the lock: the session cannot expire between.
        let attendance = Attendance::new(kept);
        drop(sessions);
        let taken_over = attendance.0.take_over();
        let (down, answers) = mpsc::channel(OUTBOX);
        tokio::spawn(run(attendance, taken_over, down));
        Ok(answers)
    }

    /// Ends the session and its stream.
    pub fn close(&self, session_id: &str) -> Result<(), ApiError> {
        let kept = self.lock().remove(session_id).ok_or_else(unknown)?;
        kept.closed.cancel();
        Ok(())
    }

    fn remove_if_left(&self, name: &str) -> bool {
        let mut sessions = self.lock();
        let is_left = sessions.get(name).is_none_or(|kept| *kept.streams.borrow() == 0);
        if is_left {
            sessions.remove(name);
        }
        is_left
    }

    fn find(&self, session_id: &str) -> Result<Arc<Kept>, ApiError> {
        self.lock().get(session_id).cloned().ok_or_else(unknown)
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, Arc<Kept>>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The name is not repeated: it is a key, and logs are read by others.
fn unknown() -> ApiError {
    ApiError::new(Reason::SessionNotFound, "no such session: it has expired, was closed, or the server has been restarted")
}

impl Kept {
    /// Ends the newest stream and becomes it; the token says when the same happens to this one.
    fn take_over(&self) -> CancellationToken {
        let fresh = CancellationToken::new();
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *newest, fresh.clone()).cancel();
        fresh
    }
}

impl Attendance {
    fn new(kept: Arc<Kept>) -> Self {
        kept.streams.send_modify(|streams| *streams += 1);
        Self(kept)
    }
}

impl Drop for Attendance {
    fn drop(&mut self) {
        self.0.streams.send_modify(|streams| *streams -= 1);
    }
}

async fn run(attendance: Attendance, taken_over: CancellationToken, down: Outbox) {
    let kept = &attendance.0;
    let stopping = kept.session.stage().stopping.clone();
    let end = tokio::select! {
        biased;
        () = taken_over.cancelled() => End::TakenOver,
        () = kept.closed.cancelled() => End::Left,
        () = stopping.cancelled() => End::Stopping,
        () = down.closed() => End::Left,
        ended = show(kept, &down) => match ended {
            ShowEnded::Left => End::Left,
            ShowEnded::Mute => End::Mute,
        },
    };
    let mute_error = mute(kept.session.stage());
    // Whoever does not read its last message does not keep the session.
    drop(attendance);
    match end {
        End::Left => {}
        End::TakenOver => farewell(down, ApiError::new(Reason::SessionTakenOver, "another stream of this session was opened")).await,
        End::Mute => farewell(down, mute_error).await,
        End::Stopping => farewell_of_the_server(down).await,
    }
}

async fn show(kept: &Kept, down: &Outbox) -> ShowEnded {
    // The stream before has been told to end, and lets go when it has.
    let _showing = kept.showing.lock().await;
    kept.session.forget_frames_on_their_way();
    // The outbox is empty, so this does not wait.
    let _ = down.send(Ok(response(Down::Opened(kept.session.opened(kept.session.stage().expiry))))).await;
    kept.session.show(down, &CancellationToken::new()).await
}
