//! The one thread that renders, and who may wait for it.
//!
//! The thread owns the renderer (its graphics device is used from no other thread). A render passes three gates: *admission* (as many
//! waiting as configured, one more is refused at once), its *turn*, and a *slot* (a few frames are between start and the end of their
//! encoding, so that finished pixels cannot pile up in memory). Viewers go before jobs, and whoever has waited longest goes first, so that
//! sessions with one wish at a time get equally many frames; a larger frame of a picture that is there already stands half a second behind
//! the others. Work whose caller has gone leaves the line; work whose deadline has passed is dropped before it starts. Idle work, a piece of
//! each kind at a time, goes after everyone: it takes no place from a render, which waits for no more than the piece that has begun. What a render leaves
//! to be done while the next one goes on is settled when none follows at once.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use crossbeam_channel::{Receiver, bounded};
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::time::{Instant, timeout_at};

/// Frames between start and the end of their encoding: one renders while two encode.
const SLOTS: usize = 3;
/// A frame for someone at rest lets others pass that come so much later.
const STILL_PATIENCE: Duration = Duration::from_millis(500);

/// Who waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Priority {
    /// Someone waits: first.
    Viewer,
    /// Someone who has come to rest sees a smaller picture already.
    Still,
    /// A job.
    Batch,
}

/// Work for when no render waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Idle {
    /// Pages for the next frame of someone who moves.
    Ahead,
    /// A pass for a still that is shown already: after all else.
    Refine,
}

/// Kinds of [`Idle`] work.
const IDLE_KINDS: usize = 2;

/// Why there is no frame.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum QueueError {
    /// As many as allowed are waiting.
    #[error("{waiting} renders are waiting, no more are taken")]
    Full {
        /// The limit.
        waiting: usize,
    },
    /// The caller's deadline passed first.
    #[error("the deadline passed before the frame was rendered")]
    DeadlineExceeded,
    /// The render thread has ended.
    #[error("the renderer has stopped")]
    Stopped,
    /// Rendering panicked: a defect of ours. The renderer is made anew for the next frame.
    #[error("rendering failed: {0}")]
    Panicked(String),
}

type Work<R> = Box<dyn FnOnce(&mut R) + Send>;
type Render<R> = Box<dyn FnOnce(&mut R, Slot) + Send>;

/// The render thread's front door; cheap to clone.
pub struct RenderQueue<R> {
    admission: Arc<Semaphore>,
    length: usize,
    // By `Idle`.
    idle_places: [Arc<Semaphore>; IDLE_KINDS],
    door: Arc<Door<R>>,
    // Closed when the thread has ended.
    ended: Receiver<()>,
}

/// Closes the line when the last queue to it is dropped.
struct Door<R>(Arc<Line<R>>);

/// Those who wait for the thread.
struct Line<R> {
    state: Mutex<State<R>>,
    changed: Condvar,
}

struct State<R> {
    renders: BinaryHeap<Reverse<Waiting<R>>>,
    /// How many have come: of two that came in the same moment, the first goes first.
    arrivals: u64,
    /// By `Idle`: the earlier first.
    idle: [Option<Work<R>>; IDLE_KINDS],
    free_slots: usize,
    is_closed: bool,
}

struct Waiting<R> {
    /// Jobs after viewers, then by time, then by number.
    place: (bool, Instant, u64),
    render: Render<R>,
}

/// A caller's place in the line; given up with it.
struct Place<'a, R> {
    line: &'a Line<R>,
    number: u64,
}

/// One of the few places between a frame's start and the end of its encoding; free again when dropped.
pub struct Slot(Arc<dyn TakesBack>);

trait TakesBack: Send + Sync {
    fn take_back(&self);
}

impl<R> Clone for RenderQueue<R> {
    fn clone(&self) -> Self {
        Self {
            admission: self.admission.clone(),
            length: self.length,
            idle_places: self.idle_places.clone(),
            door: self.door.clone(),
            ended: self.ended.clone(),
        }
    }
}

/// See [`RenderQueue::ended`].
pub struct RenderThreadEnded(Receiver<()>);

impl RenderThreadEnded {
    /// Waits no longer than `patience`. A process that ends while the thread gives its device back can crash in the driver.
    pub fn wait(&self, patience: Duration) {
        // Nothing is ever sent: the answer is that nobody can any more.
        let _ = self.0.recv_timeout(patience);
    }
}

/// A finished piece of work that still holds its slot: encode it, then let go.
#[derive(Debug)]
pub struct Rendered<T> {
    /// What the work returned.
    pub value: T,
    /// From the call until the thread began.
    pub queued: Duration,
    /// Kept until the pixels are encoded.
    pub slot: Slot,
    /// Kept as long: what is rendered but not answered still counts as waiting.
    pub admitted: OwnedSemaphorePermit,
}

impl<R: 'static> RenderQueue<R> {
    /// Starts the thread of that name; `make` makes the renderer on it, and again after a panic; `settle` ends what renders have left to be
    /// done beside the next one. `length` renders may wait. Returns once the first renderer is made, with its error if it cannot be.
    pub fn start<E: Send + 'static>(
        length: usize,
        name: &str,
        make: impl Fn() -> Result<R, E> + Send + 'static,
        settle: impl Fn(&mut R) + Send + 'static,
    ) -> Result<Self, E> {
        let state = State { renders: BinaryHeap::new(), arrivals: 0, idle: Default::default(), free_slots: SLOTS, is_closed: false };
        let line = Arc::new(Line { state: Mutex::new(state), changed: Condvar::new() });
        let door = Arc::new(Door(line.clone()));
        let (ready, made) = bounded(1);
        let (alive, ended) = bounded(0);
        thread::Builder::new()
            .name(name.into())
            .spawn(move || {
                match make() {
                    Ok(renderer) => {
                        let _ = ready.send(Ok(()));
                        render_until_closed(renderer, &make, &settle, &line);
                    }
                    Err(error) => drop(ready.send(Err(error))),
                }
                // The renderer is gone by now.
                drop(alive);
            })
            .expect("a thread can be started while the server starts");
        made.recv().expect("the render thread answers before it ends")?;
        let (admission, idle_places) = (Arc::new(Semaphore::new(length)), std::array::from_fn(|_| Arc::new(Semaphore::new(1))));
        Ok(Self { admission, length, idle_places, door, ended })
    }

    /// To wait for the thread's end, which comes when every queue to it is dropped and its last work done.
    pub fn ended(&self) -> RenderThreadEnded {
        RenderThreadEnded(self.ended.clone())
    }

    /// A place among those that may wait, given back when dropped.
    pub fn admit(&self) -> Result<OwnedSemaphorePermit, QueueError> {
        self.admission.clone().try_acquire_owned().map_err(|_| QueueError::Full { waiting: self.length })
    }

    /// Runs `work` on the render thread. Dropping the future before it starts drops the work.
    pub async fn run<T: Send + 'static>(
        &self,
        priority: Priority,
        deadline: Option<Instant>,
        work: impl FnOnce(&mut R) -> T + Send + 'static,
    ) -> Result<Rendered<T>, QueueError> {
        self.run_admitted(self.admit()?, priority, deadline, work).await
    }

    /// The same for who has a place.
    pub async fn run_admitted<T: Send + 'static>(
        &self,
        admitted: OwnedSemaphorePermit,
        priority: Priority,
        deadline: Option<Instant>,
        work: impl FnOnce(&mut R) -> T + Send + 'static,
    ) -> Result<Rendered<T>, QueueError> {
        let called = Instant::now();
        // Far enough away to mean never, near enough not to overflow.
        let deadline = deadline.unwrap_or_else(|| called + Duration::from_secs(86_400));
        let (answer, answered) = oneshot::channel();
        // The permit travels with the work: it is free again when the work is out of the line, with its caller or after its turn.
        let render: Render<R> = Box::new(move |renderer, slot| {
            if answer.is_closed() {
                return;
            }
            let begun = Instant::now();
            if begun >= deadline {
                let _ = answer.send(Err(QueueError::DeadlineExceeded));
                return;
            }
            // The panic is carried to the caller, then on: the thread makes a new renderer.
            match catch_unwind(AssertUnwindSafe(|| work(renderer))) {
                Ok(value) => drop(answer.send(Ok(Rendered { value, queued: begun - called, slot, admitted }))),
                Err(panic) => {
                    let _ = answer.send(Err(QueueError::Panicked(panic_message(panic.as_ref()))));
                    std::panic::resume_unwind(panic);
                }
            }
        });
        let _place = Place { line: &self.door.0, number: self.door.0.stand(priority, called, render) };
        let answer = timeout_at(deadline, answered).await.map_err(|_| QueueError::DeadlineExceeded)?;
        answer.map_err(|_| QueueError::Stopped)?
    }

    /// Runs a piece of work, no longer than a frame, when no render waits for the thread. Dropping the future before it starts drops the
    /// work.
    pub async fn run_idle<T: Send + 'static>(&self, kind: Idle, work: impl FnOnce(&mut R) -> T + Send + 'static) -> Result<T, QueueError> {
        let place = self.idle_places[kind as usize].clone().acquire_owned().await.map_err(|_| QueueError::Stopped)?;
        let (answer, answered) = oneshot::channel();
        let boxed: Work<R> = Box::new(move |renderer| {
            let _place = place;
            if answer.is_closed() {
                return;
            }
            match catch_unwind(AssertUnwindSafe(|| work(renderer))) {
                Ok(value) => drop(answer.send(Ok(value))),
                Err(panic) => {
                    let _ = answer.send(Err(QueueError::Panicked(panic_message(panic.as_ref()))));
                    std::panic::resume_unwind(panic);
                }
            }
        });
        self.door.0.stand_idle(kind, boxed);
        answered.await.map_err(|_| QueueError::Stopped)?
    }

    /// How many are waiting, rendering or being encoded.
    pub fn waiting(&self) -> usize {
        self.length - self.admission.available_permits()
    }
}

impl<R> Line<R> {
    /// If the thread has ended the work is dropped, and its caller told so. Returns the place's number.
    fn stand(&self, priority: Priority, called: Instant, render: Render<R>) -> u64 {
        let since = if priority == Priority::Still { called + STILL_PATIENCE } else { called };
        let mut state = self.lock();
        if !state.is_closed {
            state.arrivals += 1;
            let place = (priority == Priority::Batch, since, state.arrivals);
            state.renders.push(Reverse(Waiting { place, render }));
            self.changed.notify_one();
        }
        state.arrivals
    }

    /// Gives up a place, and with it what the work holds, if its turn has not come yet.
    fn leave(&self, number: u64) {
        let mut left = Vec::new();
        let mut state = self.lock();
        if state.renders.iter().any(|Reverse(waiting)| waiting.place.2 == number) {
            let (others, gone): (Vec<_>, _) = state.renders.drain().partition(|Reverse(waiting)| waiting.place.2 != number);
            (state.renders, left) = (others.into(), gone);
        }
        drop(state);
        // Outside the lock: it holds whatever the caller gave it.
        drop(left);
    }

    /// One of a kind at a time: the caller holds the only place.
    fn stand_idle(&self, kind: Idle, work: Work<R>) {
        let mut state = self.lock();
        if !state.is_closed {
            state.idle[kind as usize] = Some(work);
            self.changed.notify_one();
        }
    }

    /// The next render, if one waits and may begin.
    fn next_render(self: &Arc<Self>) -> Option<Work<R>>
    where
        R: 'static,
    {
        let mut state = self.lock();
        if state.is_closed { None } else { self.take_render(&mut state) }
    }

    fn take_render(self: &Arc<Self>, state: &mut State<R>) -> Option<Work<R>>
    where
        R: 'static,
    {
        if state.free_slots == 0 {
            return None;
        }
        let Reverse(first) = state.renders.pop()?;
        state.free_slots -= 1;
        let slot = Slot(self.clone());
        Some(Box::new(move |renderer| (first.render)(renderer, slot)))
    }

    /// Waits for the next piece of work; None once nobody can bring any.
    fn next(self: &Arc<Self>) -> Option<Work<R>>
    where
        R: 'static,
    {
        let mut state = self.lock();
        loop {
            if state.is_closed {
                return None;
            }
            if let Some(render) = self.take_render(&mut state) {
                return Some(render);
            }
            // Renders that wait for a slot go before what nobody waits for.
            if state.renders.is_empty()
                && let Some(work) = state.idle.iter_mut().find_map(Option::take)
            {
                return Some(work);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Whoever still waits is told that the thread has ended.
    fn close(&self) {
        let mut state = self.lock();
        state.is_closed = true;
        let waiting = (std::mem::take(&mut state.renders), std::mem::take(&mut state.idle));
        drop(state);
        self.changed.notify_one();
        drop(waiting);
    }

    fn lock(&self) -> MutexGuard<'_, State<R>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<R> Drop for Place<'_, R> {
    fn drop(&mut self) {
        self.line.leave(self.number);
    }
}

impl<R> Drop for Door<R> {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl<R> TakesBack for Line<R> {
    fn take_back(&self) {
        self.lock().free_slots += 1;
        self.changed.notify_one();
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.0.take_back();
    }
}

impl fmt::Debug for Slot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Slot")
    }
}

impl<R> PartialEq for Waiting<R> {
    fn eq(&self, other: &Self) -> bool {
        self.place == other.place
    }
}

impl<R> Eq for Waiting<R> {}

impl<R> PartialOrd for Waiting<R> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl<R> Ord for Waiting<R> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.place.cmp(&other.place)
    }
}

/// Ends when every queue to the line is dropped, or no renderer can be made any more.
fn render_until_closed<R: 'static, E>(mut renderer: R, make: &dyn Fn() -> Result<R, E>, settle: &dyn Fn(&mut R), line: &Arc<Line<R>>) {
    let survives = |renderer: &mut R, work: &mut dyn FnMut(&mut R)| {
        if catch_unwind(AssertUnwindSafe(|| work(renderer))).is_ok() {
            return true;
        }
        tracing::error!("rendering panicked; the renderer is made anew");
        match make() {
            Ok(fresh) => *renderer = fresh,
            Err(_) => {
                tracing::error!("the renderer cannot be made anew; no more frames are rendered");
                line.close();
                return false;
            }
        }
        true
    };
    loop {
        let mut next = line.next_render();
        if next.is_none() {
            if !survives(&mut renderer, &mut |renderer| settle(renderer)) {
                return;
            }
            next = line.next();
        }
        let Some(work) = next else { return };
        let mut work = Some(work);
        if !survives(&mut renderer, &mut |renderer| work.take().map_or((), |work| work(renderer))) {
            return;
        }
    }
}

/// What a panic says.
pub fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|s| s.to_string());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panic without a message".into())
}

#[cfg(test)]
mod tests;
