//! One viewer, however its messages travel. A watch value holds what it wants to see: messages change it, and [`Session::show`] renders it
//! whenever there is something new and a credit. A pose that is overtaken before the render thread takes it up is never rendered. While a
//! frame is encoded the next is drawn; while there is nothing to draw, pages are brought that a moving viewer's next frame will want.
//!
//! A viewer with a rate (all but those that ask for 0) is *moving* while poses or settings keep coming: its frames are as large as `pace` says. Once nothing new
//! has come for a moment it is *still*, and is shown the full size; a new pose drops that frame where its rendering has not begun. What several
//! passes make better (`still`) is then refined, a pass at a time after everyone else's work, and shown again after 2, 4, 8, … passes and the
//! last; whatever new comes drops it at once.

use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use lumisphere::geometry::Camera;
use lumisphere::render::Refine;
use tokio::sync::{OwnedSemaphorePermit, watch};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::crowd::Crowd;
use super::link::{Link, Size};
use super::looks::Looks;
use super::pace::{Pace, Took, share, smaller};
use super::seat::Seat;
use super::wish::{Change, Sequences, Wish};
use super::{Outbox, OutboxPlace, Stage, response, status};
use crate::api::blocking;
use crate::catalog::OpenedVersion;
use crate::config::BackendChoice;
use crate::errors::{ApiError, Reason};
use crate::frames::DrawnLate;
use crate::ground_truth::check_truth;
use crate::prefetch::{Expected, Motion};
use crate::render_queue::Priority;
use crate::still::Still;
use crate::wire::frames::{EncodedFrame, FrameIdentity};
use crate::wire::settings::{Delivery, Encoding, check_kind, encoding_number, output, render_settings};
use crate::wire::{self, proto};
use proto::interact_response::Message as Down;

const DEFAULT_CREDITS: u32 = 3;
const MAX_CREDITS: u32 = 16;
/// Of frames per second.
const DEFAULT_MOVING_RATE: f32 = 30.0;
/// A wish that found the render queue full tries again after this time.
const QUEUE_RETRY: Duration = Duration::from_millis(20);
/// Frames per second that a moving viewer may ask for.
const MOVING_RATES: (f32, f32) = (1.0, 240.0);
/// A viewer is still when so many frames' time has passed without anything new, within these bounds: a hand that pauses is not at rest.
const SETTLING_FRAMES: f32 = 5.0;
const SETTLING_SECONDS: (f32, f32) = (0.05, 0.25);
/// The same for a viewer that asked for a rate of 0: before its still is refined.
const SETTLING: Duration = Duration::from_millis(50);

/// A viewer's open interaction.
pub struct Session {
    stage: Arc<Stage>,
    version: Arc<OpenedVersion>,
    credits: u32,
    wish: watch::Sender<Wish>,
    /// Frames that were sent, of all streams.
    sent: AtomicU64,
    /// How the frames come to the viewer.
    link: Mutex<Link>,
    /// Of a viewer that was ever sent H.264.
    seat: Seat,
    /// Held while an update is taken: a place that one wish needs is not given back for another.
    taking: Mutex<()>,
    /// None for a viewer that is always shown the full size.
    moving: Option<Arc<Moving>>,
    _room: OwnedSemaphorePermit,
}

/// Of a viewer with a rate while it moves.
struct Moving {
    /// Between two frames, as asked for.
    interval: Duration,
    settling: Duration,
    pace: Mutex<Pace>,
}

/// What the viewer has not seen yet of the wish that was shown last.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Owed {
    Nothing,
    /// Coarse pages stood in for others: a better frame at once.
    Better,
    /// A frame of full size, if nothing new comes before.
    FullSize(Instant),
    /// Further passes of one, if nothing new comes before.
    Passes(Instant),
}

/// A wish and how it is drawn.
struct Turn {
    wish: Wish,
    pose_id: u64,
    /// As the viewer gave it.
    full: Camera,
    /// The same or a smaller one.
    drawn: Camera,
    /// Whether it was drawn as for a viewer at rest, who has one always.
    is_at_rest: bool,
}

/// A frame to be sent.
struct Shown {
    frame: proto::Frame,
    /// None where it says nothing of what those of a moving viewer will take on their way.
    size: Option<Size>,
    /// In a stream of H.264; 0 for another encoding.
    stream_number: u64,
}

/// What encoding made, and the still that it begins.
type Frame = Result<(EncodedFrame, Option<Still>), ApiError>;

/// A frame that is drawn and being encoded, while the next one may be drawn.
struct InEncoding<'a> {
    slot: OutboxPlace<'a>,
    frame: Pin<Box<dyn Future<Output = Frame> + Send>>,
    frame_id: u64,
    pose_id: u64,
    who: Priority,
    begun: Instant,
    /// What the viewer has not seen yet once it is sent.
    owed: Owed,
    /// Of a moving viewer's frames.
    moving: Encoding,
    /// Of the full size's pixels.
    share: f32,
}

/// What became of it.
struct Delivered {
    /// To be refined; None where that is of no use, or has to wait for room.
    still: Option<Still>,
    owed: Owed,
    /// None if nothing was sent.
    sent_at: Option<Instant>,
}

/// Which means of a still's passes are shown.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Means {
    /// Of 2, 4, 8, … passes, and of all.
    Doubled,
    /// Of all.
    Last,
}

/// What a pass has made of a still.
struct Refined {
    /// None where the first pass still waits for pages.
    still: Option<Still>,
    /// To be sent.
    shown: Option<Shown>,
}

/// Why nothing is shown any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShowEnded {
    /// The client has left, or has seen its last pose.
    Left,
    /// It left a frame unread or unacknowledged for too long.
    Mute,
}

/// What one message or call says.
pub struct Update {
    /// Of two poses, or settings, the one with the higher number stands; of equal ones the one that came later.
    pub sequence: u64,
    /// A new pose.
    pub pose: Option<proto::PoseUpdate>,
    /// Other settings.
    pub settings: Option<proto::SettingsUpdate>,
    /// Credits back.
    pub acknowledge: Option<proto::FrameAcknowledgement>,
}

impl Session {
    /// As the opening message says; it is checked in whole.
    pub async fn open(stage: Arc<Stage>, open: proto::OpenInteraction, room: OwnedSemaphorePermit) -> Result<Self, ApiError> {
        let settings = render_settings(open.settings, "open.settings")?;
        let output = output(open.output, Delivery::Stream, "open.output")?;
        let credits = wire::count(open.credits, DEFAULT_CREDITS, 1, MAX_CREDITS, "open.credits")?;
        let moving = Moving::at(open.moving_frames_per_second.unwrap_or(DEFAULT_MOVING_RATE), "open.moving_frames_per_second")?;
        let dataset = wire::dataset_name(&open.dataset, "open.dataset")?;
        let catalog = stage.catalog.clone();
        let version = blocking(move || catalog.open_version(&dataset, open.version)).await?;
        check_kind(&settings.settings, version.representation.kind().name())?;
        version.looks.check(&settings.settings)?;
        check_truth(&settings, &version)?;
        let sequences = Sequences::default();
        let wish = Wish { pose: None, settings, output, sequences, revision: 0, changed: Instant::now(), poses: 0, acknowledged: 0 };
        let wish = watch::Sender::new(wish);
        let link = Mutex::new(Link::new(credits));
        let (sent, seat) = (AtomicU64::new(0), Seat::default());
        let session = Self { stage, version, credits, wish, sent, link, seat, taking: Mutex::default(), moving, _room: room };
        session.seat.admit(&output, None, &session.stage.video_places)?;
        Ok(session)
    }

    /// What was opened. `expiry`: without a stream; zero for a session that ends with its stream.
    pub fn opened(&self, expiry: Duration) -> proto::InteractionOpened {
        let expires_after_seconds = u32::try_from(expiry.as_secs()).unwrap_or(u32::MAX);
        proto::InteractionOpened { dataset_version: self.version.version, credits: self.credits, expires_after_seconds }
    }

    /// Of the server.
    pub fn stage(&self) -> &Stage {
        &self.stage
    }

    /// All that the update says, or nothing and an error.
    pub fn take(&self, update: Update) -> Result<(), ApiError> {
        let _one_at_a_time = self.taking.lock().unwrap_or_else(PoisonError::into_inner);
        let change = self.check(update)?;
        let overtaken = change.pose.is_some_and(|_| change.sequence < self.wish.borrow().sequences.pose);
        self.stage.metrics.poses_overtaken.inc_by(overtaken.into());
        let arrived = self.link().acknowledged(change.acknowledged, Instant::now().into_std());
        if let (Some((size, seconds)), Some(moving)) = (arrived, &self.moving) {
            moving.pace().arrived(size.share, size.quality, seconds);
        }
        self.wish.send_modify(|wish| wish.apply(change));
        if !self.wish.borrow().output.has_video() {
            self.seat.leave();
        }
        Ok(())
    }

    fn check(&self, update: Update) -> Result<Change, ApiError> {
        let Update { sequence, pose, settings, acknowledge } = update;
        let camera = |m: proto::PoseUpdate| {
            let camera = wire::camera::camera(m.camera, self.stage.max_pixels_per_frame, "pose.camera")?;
            Ok::<_, ApiError>((m.pose_id, camera))
        };
        let pose = pose.map(camera).transpose()?;
        let proto::SettingsUpdate { settings, output: output_settings } = settings.unwrap_or_default();
        let settings = settings.map(|s| render_settings(Some(s), "settings.settings")).transpose()?;
        let output = output_settings.map(|o| output(Some(o), Delivery::Stream, "settings.output")).transpose()?;
        if let Some(settings) = &settings {
            check_kind(&settings.settings, self.version.representation.kind().name())?;
            self.version.looks.check(&settings.settings)?;
            check_truth(settings, &self.version)?;
        }
        let acknowledged = acknowledge.map_or(0, |a| a.frame_id);
        let sent = self.sent.load(Ordering::SeqCst);
        if acknowledged > sent {
            return Err(ApiError::field("acknowledge.frame_id", format!("{acknowledged}, but only {sent} frames were sent")));
        }
        let (output_then, camera_then) = {
            let wish = self.wish.borrow();
            (output.unwrap_or(wish.output), pose.or(wish.pose).map(|(_, camera)| camera))
        };
        self.seat.admit(&output_then, camera_then.as_ref(), &self.stage.video_places)?;
        Ok(Change { sequence, pose, settings, output, acknowledged })
    }

    /// For a new stream: what was on its way in the old one has arrived or never will.
    pub fn forget_frames_on_their_way(&self) {
        let sent = self.sent.load(Ordering::SeqCst);
        self.wish.send_modify(|wish| wish.acknowledged = sent);
        self.link().forget();
        self.seat.begin_anew();
        if let Some(moving) = &self.moving {
            moving.pace().forget_link();
        }
    }

    fn link(&self) -> MutexGuard<'_, Link> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Until a wish that is due has a place among the frames on their way; once nothing more comes from the viewer (`last`), every credit is
    /// one. False once the client has left.
    async fn until_placed(&self, sent: u64, last: &CancellationToken, is_due: impl Fn(&Wish) -> bool) -> bool {
        let mut wishes = self.wish.subscribe();
        loop {
            let is_last = last.is_cancelled();
            let places = || if is_last { self.credits.into() } else { self.link().places() };
            let has_place = |wish: &Wish| is_due(wish) && sent - wish.acknowledged < places();
            let on_their_way = tokio::select! {
                biased;
                wish = wishes.wait_for(has_place) => match wish {
                    Ok(wish) => sent - wish.acknowledged,
                    Err(_) => return false,
                },
                () = last.cancelled(), if !is_last => continue,
            };
            let held_until = {
                let link = self.link();
                link.until_begun().filter(|until| !is_last && on_their_way + 1 == link.places() && *until > Instant::now().into_std())
            };
            let Some(until) = held_until else { return true };
            tokio::select! {
                () = tokio::time::sleep_until(until.into()) => {}
                // Another acknowledgement may let it begin before.
                _ = wishes.changed() => {}
                () = last.cancelled() => {}
            }
        }
    }

    /// Renders the wish whenever it is new and there is a credit, until the client has left or, once `last` is cancelled, the last wish is
    /// shown. The wish of the beginning counts as new. One caller at a time.
    pub async fn show(&self, down: &Outbox, last: &CancellationToken) -> ShowEnded {
        let mut wishes = self.wish.subscribe();
        // What an earlier stream showed is shown again.
        let (mut shown, mut owed, mut poses_shown) = (0, Owed::Nothing, self.wish.borrow().poses.saturating_sub(1));
        let (mut motion, mut expected, mut crowd) = (Motion::default(), None, Crowd::default());
        let mut looks = Looks::default();
        // The wish whose next frame waits for all its pages: more of those that do not would never have them.
        let mut hopeless = 0;
        let mut sent_at = Instant::now();
        // Of the wish that was shown last; None also while there is no room for it.
        let mut still: Option<Still> = None;
        // Drawn before, and not encoded yet.
        let mut behind: Option<InEncoding<'_>> = None;
        loop {
            // With the one that is being encoded.
            let sent = self.sent.load(Ordering::SeqCst) + u64::from(behind.is_some());
            let is_new = |wish: &Wish| wish.pose.is_some() && wish.revision > shown;
            if let Some(encoding) = &mut behind {
                tokio::select! {
                    biased;
                    frame = &mut encoding.frame => {
                        let delivered = self.deliver(behind.take(), frame, last);
                        (still, owed, sent_at) = (delivered.still, delivered.owed, delivered.sent_at.unwrap_or(sent_at));
                        continue;
                    }
                    is_there = self.until_placed(sent, last, is_new) => if !is_there { return ShowEnded::Left },
                }
            } else {
                tokio::select! {
                    biased;
                    // Memory is not kept for what no one wants, credit or not.
                    () = self.until_changed(shown), if still.is_some() => {
                        (still, owed) = self.abandon();
                        continue;
                    }
                    is_there = self.until_placed(sent, last, is_new) => if !is_there { return ShowEnded::Left },
                    () = self.until_due(owed, sent, last) => {}
                    () = last.cancelled() => return ShowEnded::Left,
                    () = self.until_mute(sent, sent_at) => return ShowEnded::Mute,
                    // Dropped as soon as there is something to draw.
                    () = self.prefetch(&mut expected, &mut looks) => {}
                }
            }
            // Room in the outbox first: what is rendered can then be sent.
            let reserved = tokio::time::timeout(self.stage.mute_patience, down.reserve());
            let slot = match self.beside(&mut behind, &mut sent_at, last, reserved).await {
                Ok(Ok(slot)) => slot,
                Ok(Err(_)) => return ShowEnded::Left,
                Err(_) => return ShowEnded::Mute,
            };
            let asked = wishes.borrow_and_update().clone();
            let Some((pose_id, _)) = asked.pose else { continue };
            if let Owed::Passes(_) = owed
                && asked.revision == shown
            {
                // Nobody gives credits back any more once the stream is half-closed: the last one is for the last frame.
                let is_due = self.moving.as_ref().is_none_or(|m| sent_at.elapsed() >= m.interval);
                let shown_now = if is_due && !last.is_cancelled() { Means::Doubled } else { Means::Last };
                let refined = tokio::select! {
                    biased;
                    () = self.until_changed(shown) => None,
                    refined = self.refine(still.take(), &asked, sent + 1, shown_now) => Some(refined),
                };
                match refined {
                    Some(Ok(refined)) => {
                        let is_last = refined.still.as_ref().is_some_and(Still::is_done);
                        (still, owed) = if is_last { (None, Owed::Nothing) } else { (refined.still, owed) };
                        if let Some(shown) = refined.shown {
                            sent_at = self.send(slot, shown);
                        }
                    }
                    Some(Err(error)) => {
                        slot.send(Ok(response(status(&error, pose_id))));
                        owed = Owed::Nothing;
                    }
                    None => (still, owed) = self.abandon(),
                }
                continue;
            }
            if still.is_some() {
                (still, owed) = self.abandon();
            }
            let who = match &self.moving {
                Some(moving) if last.is_cancelled() || asked.changed.elapsed() >= moving.settling => Priority::Still,
                _ => Priority::Viewer,
            };
            let begun = CancellationToken::new();
            let moved_on = async {
                let _ = wishes.wait_for(|now| now.revision > asked.revision).await;
                // Paths can be given up half-way, and may take long.
                if begun.is_cancelled() && asked.settings.ground_truth.is_none() {
                    std::future::pending().await
                }
            };
            let drawing = async {
                tokio::select! {
                    biased;
                    // A frame of full size is not begun for a viewer who has moved on; one that was begun is shown, if it is rendered.
                    () = moved_on, if who == Priority::Still => None,
                    drawn = self.draw(&asked, who, hopeless, begun.clone()) => Some(drawn),
                }
            };
            let begun_at = Instant::now();
            let drawn = self.beside(&mut behind, &mut sent_at, last, drawing).await;
            // In the order of their drawing.
            if let Some(encoding) = &mut behind {
                let frame = (&mut encoding.frame).await;
                self.deliver_overtaken(&mut behind, frame, &mut sent_at, last);
            }
            let (turn, wanted_more) = match drawn {
                None => {
                    self.stage.metrics.stills_abandoned.inc();
                    continue;
                }
                Some(Ok((drawn, turn))) => {
                    let settled = turn.wish.changed + self.moving.as_ref().map_or(SETTLING, |moving| moving.settling);
                    let (all_pages, is_full, adapter) = (drawn.all_pages(), turn.is_full(drawn.encoding()), drawn.adapter_use());
                    if !all_pages && !crowd.has_hope(turn.wish.revision, adapter.misses, adapter.evictions) {
                        hopeless = turn.wish.revision;
                    }
                    owed = match (is_full, all_pages, &self.moving) {
                        (true, true, _) if turn.wish.settings.passes > 1 => Owed::Passes(settled),
                        (true, true, _) => Owed::Nothing,
                        (false, _, Some(_)) => Owed::FullSize(settled),
                        _ => Owed::Better,
                    };
                    behind = Some(InEncoding {
                        slot,
                        frame: Box::pin(self.stage.frames.encoded_late(drawn)),
                        frame_id: self.sent.load(Ordering::SeqCst) + 1,
                        pose_id: turn.pose_id,
                        who,
                        begun: begun_at,
                        owed,
                        moving: turn.wish.output.encoding,
                        share: share(&turn.drawn, &turn.full),
                    });
                    (turn, adapter.misses + adapter.prefetch_used > 0)
                }
                // The wish stays due: a viewer at rest sends nothing that would ask again.
                Some(Err(error)) if error.reason() == Reason::RenderQueueFull => {
                    drop(slot);
                    tokio::time::sleep(QUEUE_RETRY).await;
                    continue;
                }
                Some(Err(error)) => {
                    slot.send(Ok(response(status(&error, pose_id))));
                    (shown, owed) = (asked.revision, Owed::Nothing);
                    continue;
                }
            };
            let Turn { wish, drawn, .. } = turn;
            shown = wish.revision;
            if wish.poses > poses_shown {
                motion.moved_to(drawn);
            }
            // Where a frame found all of its pages the next one will, mostly, and while the renderer looks ahead that one waits.
            let next = motion.next().filter(|_| wanted_more);
            expected = next.map(|camera| Expected { version: self.version.clone(), camera, settings: wish.settings });
            self.stage.metrics.poses_overtaken.inc_by((wish.poses - poses_shown).saturating_sub(1));
            poses_shown = wish.poses;
        }
    }

    /// Waits for `work`; a frame that is encoded meanwhile is sent.
    async fn beside<T>(
        &self,
        behind: &mut Option<InEncoding<'_>>,
        sent_at: &mut Instant,
        last: &CancellationToken,
        work: impl Future<Output = T>,
    ) -> T {
        tokio::pin!(work);
        if let Some(encoding) = behind {
            tokio::select! {
                biased;
                frame = &mut encoding.frame => self.deliver_overtaken(behind, frame, sent_at, last),
                done = &mut work => return done,
            }
        }
        work.await
    }

    /// Sends a frame that is encoded, or says why it is not.
    fn deliver(&self, encoding: Option<InEncoding<'_>>, frame: Frame, last: &CancellationToken) -> Delivered {
        let InEncoding { slot, frame_id, pose_id, who, begun, owed, moving, share, .. } = encoding.expect("it has just been polled");
        match frame {
            Ok((frame, still)) => {
                let mut shown = self.shown(frame, frame_id, pose_id, moving, share);
                shown.frame.is_final = owed == Owed::Nothing;
                tracing::debug!(frame_id, pose_id, micros = begun.elapsed().as_micros() as u64, "frame");
                self.measure(&shown, who);
                let is_held_back = last.is_cancelled() && matches!(owed, Owed::Passes(_));
                let sent_at = (!is_held_back).then(|| self.send(slot, shown));
                Delivered { still, owed, sent_at }
            }
            Err(error) => {
                slot.send(Ok(response(status(&error, pose_id))));
                Delivered { still: None, owed: Owed::Nothing, sent_at: None }
            }
        }
    }

    /// The same of a frame after which another is drawn already: what would make it better is of no use any more.
    fn deliver_overtaken(&self, behind: &mut Option<InEncoding<'_>>, frame: Frame, sent_at: &mut Instant, last: &CancellationToken) {
        let delivered = self.deliver(behind.take(), frame, last);
        *sent_at = delivered.sent_at.unwrap_or(*sent_at);
        if delivered.still.is_some() {
            self.stage.metrics.refinements_abandoned.inc();
        }
    }

    /// Puts a frame into its place in the outbox; when.
    fn send(&self, slot: OutboxPlace<'_>, Shown { frame, size, stream_number }: Shown) -> Instant {
        let now = Instant::now();
        if stream_number > 0 {
            self.seat.sent(stream_number);
        }
        self.link().sent(frame.frame_id, size, now.into_std());
        // Before it can be acknowledged.
        self.sent.store(frame.frame_id, Ordering::SeqCst);
        slot.send(Ok(response(Down::Frame(frame))));
        now
    }

    /// Of a still that the viewer has moved on from: what is left, and what is owed of it.
    fn abandon(&self) -> (Option<Still>, Owed) {
        self.stage.metrics.refinements_abandoned.inc();
        (None, Owed::Nothing)
    }

    /// Until there is another wish than this one.
    async fn until_changed(&self, shown: u64) {
        let _ = self.wish.subscribe().wait_for(|wish| wish.revision > shown).await;
    }

    /// Until the frame that is owed is due and has a credit; for ever if none is. One that waits for rest is due when no more messages come.
    async fn until_due(&self, owed: Owed, sent: u64, last: &CancellationToken) {
        match owed {
            Owed::Nothing => std::future::pending().await,
            Owed::Better => {}
            Owed::FullSize(at) | Owed::Passes(at) => tokio::select! {
                () = tokio::time::sleep_until(at) => {}
                () = last.cancelled() => {}
            },
        }
        self.until_placed(sent, last, |_| true).await;
    }

    /// Until a frame has waited too long for its acknowledgement; for ever once all have theirs.
    async fn until_mute(&self, sent: u64, sent_at: Instant) {
        let mut wishes = self.wish.subscribe();
        let all_acknowledged = async { drop(wishes.wait_for(|wish| wish.acknowledged >= sent).await) };
        tokio::select! {
            () = all_acknowledged => {}
            () = tokio::time::sleep_until(sent_at + self.stage.mute_patience) => return,
        }
        std::future::pending().await
    }

    /// For the size of the frames to come.
    fn measure(&self, shown: &Shown, who: Priority) {
        let (Some(moving), Some(t), Some(size)) = (&self.moving, &shown.frame.timings, shown.size) else { return };
        let seconds = |micros: u64| micros as f32 / 1e6;
        // Who rests stands back, which says nothing of the wait of one who moves.
        let waiting = (who == Priority::Viewer).then(|| seconds(t.queue_micros));
        let took = Took { waiting, own: seconds(t.pages_micros + t.render_micros + t.encode_micros) };
        moving.pace().drawn(size.share, took);
    }

    /// Brings what the expected frame would miss, once, where the viewer leaves time for it, and never returns.
    async fn prefetch(&self, expected: &mut Option<Expected>, looks: &mut Looks) {
        let reads_pages = |e: &Expected| e.settings.ground_truth.is_none() && e.settings.backend != BackendChoice::Cpu;
        let expected = expected.take().filter(|e| self.stage.looks_ahead && reads_pages(e));
        if let Some(expected) = expected.filter(|_| looks.begin()) {
            let missing = expected.missing(&self.stage.frames, self.stage.upload_bytes_per_frame).await;
            looks.end();
            let brought = match missing {
                Ok(missing) => expected.bring(&self.stage.frames, &missing).await,
                Err(error) => Err(error),
            };
            match brought {
                Ok(pages) => tracing::trace!(pages, "brought ahead"),
                // The frame itself will tell the viewer.
                Err(error) => tracing::debug!(%error, "nothing brought ahead"),
            }
            self.stage.metrics.looks_ahead.inc();
        }
        std::future::pending().await
    }

    /// The latest wish of the moment when the render thread takes it up, drawn: of full size where it is still the one that was asked for at
    /// rest, however long it waited. `begun` is cancelled then. The wish with the revision `hopeless` waits for all its pages.
    async fn draw(&self, asked: &Wish, who: Priority, hopeless: u64, begun: CancellationToken) -> Result<(DrawnLate, Turn), ApiError> {
        let (version, moving, upload_bytes) = (self.version.clone(), self.moving.clone(), self.stage.upload_bytes_per_frame);
        let (wishes, asked, seat, settings) = (self.wish.subscribe(), asked.clone(), self.seat.clone(), asked.settings);
        let order = move || {
            begun.cancel();
            let latest = wishes.borrow().clone();
            let rests = who == Priority::Still && latest.revision == asked.revision;
            let moving = moving.as_deref().filter(|_| !rests);
            let turn = Turn::of(latest, moving);
            let turn = turn.expect("a wish that is asked for has a pose, and keeps one");
            let mut order = turn.wish.order(version, turn.drawn, seat.stream(), upload_bytes);
            if turn.wish.revision == hopeless {
                order.refine = Refine::Whole;
            }
            if let Some(moving) = moving {
                (order.passes, order.output.encoding_at_rest) = (1, None);
                let quality = moving.pace().quality(order.output.encoding.quality());
                order.output.encoding = order.output.encoding.at_most(quality);
            }
            (order, turn)
        };
        self.stage.frames.drawn_late(order, &settings, who).await
    }

    /// One more pass of the wish that was shown, which still stands; its frame where it is one that is shown.
    async fn refine(&self, still: Option<Still>, asked: &Wish, frame_id: u64, shown_now: Means) -> Result<Refined, ApiError> {
        let (pose_id, camera) = asked.pose.expect("a wish that was shown has a pose");
        let before = still.as_ref().map_or(0, Still::passes);
        let order = asked.order(self.version.clone(), camera, self.seat.stream(), self.stage.upload_bytes_per_frame);
        let still = self.stage.frames.refined(still, order).await?;
        let is_shown = |passes: u32| passes > before.max(1) && passes.is_power_of_two() && shown_now == Means::Doubled;
        match still {
            Some(still) if still.is_done() || is_shown(still.passes()) => {
                let (frame, still) = self.stage.frames.encoded_still(still).await?;
                tracing::debug!(frame_id, pose_id, passes = still.passes(), "frame refined");
                let shown = self.shown(frame, frame_id, pose_id, asked.output.encoding, 1.0);
                Ok(Refined { still: Some(still), shown: Some(shown) })
            }
            still => Ok(Refined { still, shown: None }),
        }
    }

    /// `moving`: the encoding of a moving viewer's frames; `share`: of the full size's pixels.
    fn shown(&self, frame: EncodedFrame, frame_id: u64, pose_id: u64, moving: Encoding, share: f32) -> Shown {
        // Key frames are rare, and several times as large as the others.
        let is_alike = encoding_number(frame.encoding) == encoding_number(moving) && (frame.stream_number == 0 || !frame.is_key);
        let size = is_alike.then(|| Size { share, quality: frame.encoding.quality() });
        let stream_number = frame.stream_number;
        Shown { frame: wire::frames::frame(frame, self.identity(frame_id, pose_id)), size, stream_number }
    }

    fn identity(&self, frame_id: u64, pose_id: u64) -> FrameIdentity {
        FrameIdentity { frame_id, pose_id, dataset: self.version.dataset.clone(), dataset_version: self.version.version }
    }
}

impl Turn {
    /// As large as the pace says of a viewer who moves. None before the first pose.
    fn of(wish: Wish, moving: Option<&Moving>) -> Option<Self> {
        let (pose_id, full) = wish.pose?;
        let drawn = moving.map_or(full, |m| smaller(&full, m.pace().rung()));
        Some(Self { wish, pose_id, full, drawn, is_at_rest: moving.is_none() })
    }

    /// Whether its frame in that encoding is what a viewer at rest would be shown, as far as one pass goes.
    fn is_full(&self, encoding: Encoding) -> bool {
        let at_rest = self.wish.output.encoding_at_rest.unwrap_or(self.wish.output.encoding);
        self.drawn == self.full && (self.is_at_rest || encoding == at_rest)
    }
}

impl Moving {
    /// None for rate 0.
    fn at(frames_per_second: f32, field: &str) -> Result<Option<Arc<Self>>, ApiError> {
        if frames_per_second == 0.0 {
            return Ok(None);
        }
        let rate = wire::within(frames_per_second, MOVING_RATES.0, MOVING_RATES.1, field)?;
        let settling = (SETTLING_FRAMES / rate).clamp(SETTLING_SECONDS.0, SETTLING_SECONDS.1);
        let pace = Mutex::new(Pace::new(rate));
        let [interval, settling] = [1.0 / rate, settling].map(Duration::from_secs_f32);
        Ok(Some(Arc::new(Self { interval, settling, pace })))
    }

    fn pace(&self) -> MutexGuard<'_, Pace> {
        self.pace.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
