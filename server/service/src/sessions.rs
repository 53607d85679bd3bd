//! Interact: poses up, frames down. The latest pose wins, and no frame is rendered without a credit.
//!
//! Two loops per session share a watch value: one reads the client's messages into it, the other renders what it holds whenever there
//! is something new and a credit. A pose that is overtaken before its turn is never seen by the second loop. While there is nothing to
//! draw, pages are brought that a moving viewer's next frame will want.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use lumisphere::geometry::Camera;
use lumisphere::render::Refine;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio_stream::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::api::{App, blocking};
use crate::catalog::OpenedVersion;
use crate::config::{BackendChoice, Prefetch};
use crate::errors::{ApiError, Reason};
use crate::frames::FrameOrder;
use crate::prefetch::{Expected, Motion};
use crate::render_queue::Priority;
use crate::wire::frames::FrameIdentity;
use crate::wire::settings::{Output, RenderSettings, check_kind, output, render_settings};
use crate::wire::{self, proto, reason_name};
use proto::interact_request::Message as Up;
use proto::interact_response::Message as Down;

/// A client that opens a stream must say what it wants within this time.
const OPENING_PATIENCE: Duration = Duration::from_secs(30);
const DEFAULT_CREDITS: u32 = 2;
const MAX_CREDITS: u32 = 16;
/// A wish that found the render queue full tries again after this time.
const QUEUE_RETRY: Duration = Duration::from_millis(20);
/// Messages between the session and the connection: one on its way, one ready. A client that stops reading stops the session.
const OUTBOX: usize = 2;

/// Who may have how many sessions.
#[derive(Clone)]
pub struct Sessions {
    room: Arc<Semaphore>,
    limit: usize,
}

/// What goes down.
pub type Answers = mpsc::Receiver<Result<proto::InteractResponse, Status>>;

type Outbox = mpsc::Sender<Result<proto::InteractResponse, Status>>;

/// What the viewer wants to see, as of the last message.
#[derive(Clone)]
struct Wish {
    pose: Option<(u64, Camera)>,
    settings: RenderSettings,
    output: Output,
    /// Increases with every change that needs a new frame.
    revision: u64,
    /// Poses received.
    poses: u64,
    /// All frames up to this one have arrived.
    acknowledged: u64,
}

struct Session {
    app: Arc<App>,
    version: Arc<OpenedVersion>,
    credits: u64,
    wish: watch::Sender<Wish>,
    sent: AtomicU64,
    down: Outbox,
    _room: OwnedSemaphorePermit,
}

impl Sessions {
    /// At most `limit` at once.
    pub fn new(limit: usize) -> Self {
        Self { room: Arc::new(Semaphore::new(limit)), limit }
    }

    /// Open now.
    pub fn open(&self) -> usize {
        self.limit - self.room.available_permits()
    }

    /// Starts a session that runs until the client leaves or the server stops. What its first message gets wrong ends the stream.
    pub fn interact(
        &self,
        app: Arc<App>,
        up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Send + Unpin + 'static,
    ) -> Result<Answers, ApiError> {
        let full = |_| ApiError::new(Reason::TooManySessions, format!("{} sessions are open, no more are taken", self.limit));
        let room = self.room.clone().try_acquire_owned().map_err(full)?;
        let (down, answers) = mpsc::channel(OUTBOX);
        // Answered at once: a client that waits for the answer's head before it sends its first message is served too.
        tokio::spawn(async move {
            if let Err(error) = open_and_run(app, up, down.clone(), room).await {
                let _ = down.send(Err(error.into())).await;
            }
        });
        Ok(answers)
    }
}

async fn open_and_run(
    app: Arc<App>,
    mut up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Send + Unpin + 'static,
    down: Outbox,
    room: OwnedSemaphorePermit,
) -> Result<(), ApiError> {
    let order = |problem: &str| ApiError::new(Reason::InteractionOrder, problem);
    let first = tokio::select! {
        first = tokio::time::timeout(OPENING_PATIENCE, up.next()) => first.map_err(|_| order("the interaction was not opened in time"))?,
        () = app.stopping.cancelled() => return Err(ApiError::new(Reason::ShuttingDown, "the server is stopping")),
    };
    let Some(Ok(proto::InteractRequest { message: Some(Up::Open(open)) })) = first else {
        return Err(order("the first message must open the interaction"));
    };
    open_session(app, open, down, room).await?.run(up).await;
    Ok(())
}

async fn open_session(app: Arc<App>, open: proto::OpenInteraction, down: Outbox, room: OwnedSemaphorePermit) -> Result<Session, ApiError> {
    let settings = render_settings(open.settings, "open.settings")?;
    let output = output(open.output, "open.output")?;
    let credits = wire::count(open.credits, DEFAULT_CREDITS, 1, MAX_CREDITS, "open.credits")?;
    let dataset = wire::dataset_name(&open.dataset, "open.dataset")?;
    let catalog = app.catalog.clone();
    let version = blocking(move || catalog.open_version(&dataset, open.version)).await?;
    check_kind(&settings.settings, version.representation.kind().name())?;
    let opened = proto::InteractionOpened { dataset_version: version.version, credits };
    let wish = Wish { pose: None, settings, output, revision: 0, poses: 0, acknowledged: 0 };
    let (wish, _) = watch::channel(wish);
    let session = Session { app, version, credits: credits.into(), wish, sent: AtomicU64::new(0), down, _room: room };
    // The outbox is empty, so this does not wait.
    session.send(Down::Opened(opened)).await;
    Ok(session)
}

impl Session {
    async fn run(self, up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Unpin) {
        let stopping = self.app.stopping.clone();
        let half_closed = CancellationToken::new();
        tokio::select! {
            // Ends only after the client has half-closed and its last pose is shown.
            () = async { tokio::join!(self.listen(up, &half_closed), self.show(&half_closed)); } => {}
            () = self.down.closed() => {}
            () = stopping.cancelled() => {
                let error = ApiError::new(Reason::ShuttingDown, "the server is stopping");
                let _ = self.down.try_send(Ok(response(Down::Status(status(&error, 0)))));
                let _ = self.down.try_send(Err(error.into()));
            }
        }
    }

    /// Reads messages into the wish until the client half-closes.
    async fn listen(&self, mut up: impl Stream<Item = Result<proto::InteractRequest, Status>> + Unpin, half_closed: &CancellationToken) {
        while let Some(Ok(request)) = up.next().await {
            let pose_id = match &request.message {
                Some(Up::Pose(pose)) => pose.pose_id,
                _ => 0,
            };
            if let Err(error) = self.take(request.message) {
                // Told if there is room: a client that floods without reading does not fill our memory.
                let _ = self.down.try_send(Ok(response(Down::Status(status(&error, pose_id)))));
            }
        }
        half_closed.cancel();
    }

    /// One message. An error changes nothing.
    fn take(&self, message: Option<Up>) -> Result<(), ApiError> {
        match wire::required(message, "message")? {
            Up::Open(_) => Err(ApiError::new(Reason::InteractionOrder, "the interaction is open already")),
            Up::Pose(pose) => {
                let camera = wire::camera::camera(pose.camera, self.app.config.max_pixels_per_frame, "pose.camera")?;
                self.wish.send_modify(|wish| {
                    wish.pose = Some((pose.pose_id, camera));
                    wish.poses += 1;
                    wish.revision += 1;
                });
                Ok(())
            }
            Up::Settings(update) => self.change_settings(update),
            Up::Acknowledge(proto::FrameAcknowledgement { frame_id }) => {
                let sent = self.sent.load(Ordering::SeqCst);
                if frame_id > sent {
                    return Err(ApiError::field("acknowledge.frame_id", format!("{frame_id}, but only {sent} frames were sent")));
                }
                self.wish.send_modify(|wish| wish.acknowledged = wish.acknowledged.max(frame_id));
                Ok(())
            }
        }
    }

    fn change_settings(&self, update: proto::SettingsUpdate) -> Result<(), ApiError> {
        let settings = update.settings.map(|s| render_settings(Some(s), "settings.settings")).transpose()?;
        let output = update.output.map(|o| output(Some(o), "settings.output")).transpose()?;
        if let Some(settings) = &settings {
            check_kind(&settings.settings, self.version.representation.kind().name())?;
        }
        self.wish.send_modify(|wish| {
            wish.settings = settings.unwrap_or(wish.settings);
            wish.output = output.unwrap_or(wish.output);
            wish.revision += 1;
        });
        Ok(())
    }

    /// Renders the wish whenever it is new and there is a credit.
    async fn show(&self, half_closed: &CancellationToken) {
        let mut wishes = self.wish.subscribe();
        let (mut shown, mut poses_shown) = (0, 0);
        let (mut motion, mut expected) = (Motion::default(), None);
        loop {
            let sent = self.sent.load(Ordering::SeqCst);
            let is_due = |wish: &Wish| wish.pose.is_some() && wish.revision > shown && sent - wish.acknowledged < self.credits;
            tokio::select! {
                biased;
                wish = wishes.wait_for(is_due) => if wish.is_err() { return },
                () = half_closed.cancelled() => return,
                // Dropped as soon as there is something to draw.
                () = self.prefetch(&mut expected) => {}
            }
            // Room in the outbox first: what is rendered is then the latest wish of the moment when it can be sent.
            let Ok(slot) = self.down.reserve().await else { return };
            let wish = wishes.borrow_and_update().clone();
            let Some((pose_id, camera)) = wish.pose else { continue };
            match self.render(camera, &wish, pose_id, sent + 1).await {
                Ok(frame) => {
                    let is_final = frame.is_final;
                    // Before it can be acknowledged.
                    self.sent.store(sent + 1, Ordering::SeqCst);
                    slot.send(Ok(response(Down::Frame(frame))));
                    // Else the wish stays due: a better frame of it follows, if no newer wish comes before.
                    if is_final {
                        shown = wish.revision;
                    }
                }
                // The wish stays due: a viewer at rest sends nothing that would ask again.
                Err(error) if error.reason() == Reason::RenderQueueFull => {
                    drop(slot);
                    tokio::time::sleep(QUEUE_RETRY).await;
                    continue;
                }
                Err(error) => {
                    slot.send(Ok(response(Down::Status(status(&error, pose_id)))));
                    shown = wish.revision;
                }
            }
            if wish.poses > poses_shown {
                motion.moved_to(camera);
            }
            expected = motion.next().map(|camera| Expected { version: self.version.clone(), camera, settings: wish.settings });
            self.app.metrics.poses_overtaken.inc_by((wish.poses - poses_shown).saturating_sub(1));
            poses_shown = wish.poses;
        }
    }

    /// Brings what the expected frame would miss, once, and never returns.
    async fn prefetch(&self, expected: &mut Option<Expected>) {
        let is_wanted = self.app.config.prefetch == Prefetch::Motion && self.app.adapter.is_some();
        if let Some(expected) = expected.take().filter(|e| is_wanted && e.settings.backend != BackendChoice::Cpu) {
            match expected.bring(&self.app.frames, self.app.config.gpu_upload_bytes_per_frame).await {
                Ok(pages) => tracing::trace!(pages, "brought ahead"),
                // The frame itself will tell the viewer.
                Err(error) => tracing::debug!(%error, "nothing brought ahead"),
            }
            self.app.metrics.looks_ahead.inc();
        }
        std::future::pending().await
    }

    async fn render(&self, camera: Camera, wish: &Wish, pose_id: u64, frame_id: u64) -> Result<proto::Frame, ApiError> {
        let refine = Refine::UpTo { upload_bytes: self.app.config.gpu_upload_bytes_per_frame };
        let (version, settings, output) = (self.version.clone(), wish.settings, wish.output);
        let order = FrameOrder { version, camera, settings, output, opening_micros: 0, refine };
        let begun = Instant::now();
        let frame = self.app.frames.encoded(order, Priority::Viewer, None).await?;
        tracing::debug!(frame_id, pose_id, micros = begun.elapsed().as_micros() as u64, "frame");
        let identity = FrameIdentity { frame_id, pose_id, dataset: self.version.dataset.clone(), dataset_version: self.version.version };
        Ok(wire::frames::frame(frame, identity))
    }

    async fn send(&self, message: Down) {
        let _ = self.down.send(Ok(response(message))).await;
    }
}

fn response(message: Down) -> proto::InteractResponse {
    proto::InteractResponse { message: Some(message) }
}

fn status(error: &ApiError, pose_id: u64) -> proto::InteractStatus {
    let (code, reason) = (error.code() as i32, reason_name(error.reason()).into());
    proto::InteractStatus { code, reason, message: error.message().into(), pose_id }
}
