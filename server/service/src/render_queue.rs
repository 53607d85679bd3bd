//! The one thread that renders, and who may wait for it.
//!
//! The thread owns the renderer (its graphics device is used from no other thread). A render passes three gates: *admission* (as many
//! waiting as configured, one more is refused at once), a *slot* (a few frames are between start and the end of their encoding, so that
//! finished pixels cannot pile up in memory), and the thread itself. Viewers go before jobs. Work whose caller has gone, or whose
//! deadline has passed, is dropped before it starts. Idle work, a piece at a time, has a door of its own and goes after everyone: it takes
//! no place from a render, which waits for no more than the piece that has begun.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, bounded, select_biased};
use thiserror::Error;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::time::{Instant, timeout_at};

/// Frames between start and the end of their encoding: one renders while two encode.
const SLOTS: usize = 3;

/// Who waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Priority {
    /// Someone looks: first.
    Viewer,
    /// A job.
    Batch,
}

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

/// The render thread's front door; cheap to clone.
pub struct RenderQueue<R> {
    admission: Arc<Semaphore>,
    length: usize,
    slots: Arc<Semaphore>,
    viewers: Sender<Work<R>>,
    jobs: Sender<Work<R>>,
    idle_slot: Arc<Semaphore>,
    idle: Sender<Work<R>>,
    // Closed when the thread has ended.
    ended: Receiver<()>,
}

impl<R> Clone for RenderQueue<R> {
    fn clone(&self) -> Self {
        Self {
            admission: self.admission.clone(),
            length: self.length,
            slots: self.slots.clone(),
            viewers: self.viewers.clone(),
            jobs: self.jobs.clone(),
            idle_slot: self.idle_slot.clone(),
            idle: self.idle.clone(),
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
    pub slot: OwnedSemaphorePermit,
    /// Kept as long: what is rendered but not answered still counts as waiting.
    pub admitted: OwnedSemaphorePermit,
}

impl<R: 'static> RenderQueue<R> {
    /// Starts the thread; `make` makes the renderer on it, and again after a panic. `length` renders may wait.
    /// Returns once the first renderer is made, with its error if it cannot be.
    pub fn start<E: Send + 'static>(length: usize, make: impl Fn() -> Result<R, E> + Send + 'static) -> Result<Self, E> {
        // Only admitted work with a slot is sent, so a channel of SLOTS never blocks its sender.
        let (viewers, viewer_work) = bounded::<Work<R>>(SLOTS);
        let (jobs, job_work) = bounded::<Work<R>>(SLOTS);
        let (idle, idle_work) = bounded::<Work<R>>(1);
        let (ready, made) = bounded(1);
        let (alive, ended) = bounded(0);
        thread::Builder::new()
            .name("render".into())
            .spawn(move || {
                match make() {
                    Ok(renderer) => {
                        let _ = ready.send(Ok(()));
                        render_until_closed(renderer, make, [viewer_work, job_work, idle_work]);
                    }
                    Err(error) => drop(ready.send(Err(error))),
                }
                // The renderer is gone by now.
                drop(alive);
            })
            .expect("a thread can be started while the server starts");
        made.recv().expect("the render thread answers before it ends")?;
        let (admission, slots, idle_slot) = (Semaphore::new(length), Semaphore::new(SLOTS), Semaphore::new(1));
        let (admission, slots, idle_slot) = (Arc::new(admission), Arc::new(slots), Arc::new(idle_slot));
        Ok(Self { admission, length, slots, viewers, jobs, idle_slot, idle, ended })
    }

    /// To wait for the thread's end, which comes when every queue to it is dropped and its last work done.
    pub fn ended(&self) -> RenderThreadEnded {
        RenderThreadEnded(self.ended.clone())
    }

    /// Runs `work` on the render thread. Dropping the future before it starts drops the work.
    pub async fn run<T: Send + 'static>(
        &self,
        priority: Priority,
        deadline: Option<Instant>,
        work: impl FnOnce(&mut R) -> T + Send + 'static,
    ) -> Result<Rendered<T>, QueueError> {
        let called = Instant::now();
        let admitted = self.admission.clone().try_acquire_owned().map_err(|_| QueueError::Full { waiting: self.length })?;
        // Far enough away to mean never, near enough not to overflow.
        let deadline = deadline.unwrap_or_else(|| called + Duration::from_secs(86_400));
        let slot = self.slots.clone().acquire_owned();
        let slot = timeout_at(deadline, slot).await.map_err(|_| QueueError::DeadlineExceeded)?.map_err(|_| QueueError::Stopped)?;
        let (answer, answered) = oneshot::channel();
        // The permits travel with the work: a caller that leaves does not make room for more before its work is off the channel.
        let boxed: Work<R> = Box::new(move |renderer| {
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
        let sender = if priority == Priority::Viewer { &self.viewers } else { &self.jobs };
        sender.try_send(boxed).map_err(|_| QueueError::Stopped)?;
        answered.await.map_err(|_| QueueError::Stopped)?
    }

    /// Runs a piece of work, no longer than a frame, when no render waits for the thread. Dropping the future before it starts drops the work.
    pub async fn run_idle<T: Send + 'static>(&self, work: impl FnOnce(&mut R) -> T + Send + 'static) -> Result<T, QueueError> {
        let slot = self.idle_slot.clone().acquire_owned().await.map_err(|_| QueueError::Stopped)?;
        let (answer, answered) = oneshot::channel();
        let boxed: Work<R> = Box::new(move |renderer| {
            let _slot = slot;
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
        self.idle.try_send(boxed).map_err(|_| QueueError::Stopped)?;
        answered.await.map_err(|_| QueueError::Stopped)?
    }

    /// How many are waiting, rendering or being encoded.
    pub fn waiting(&self) -> usize {
        self.length - self.admission.available_permits()
    }
}

/// Whose work comes first stands first.
fn render_until_closed<R, E>(mut renderer: R, make: impl Fn() -> Result<R, E>, [viewers, jobs, idle]: [Receiver<Work<R>>; 3]) {
    loop {
        let work = select_biased! {
            recv(viewers) -> work => work,
            recv(jobs) -> work => work,
            recv(idle) -> work => work,
        };
        let Ok(work) = work else { return };
        if catch_unwind(AssertUnwindSafe(|| work(&mut renderer))).is_ok() {
            continue;
        }
        tracing::error!("rendering panicked; the renderer is made anew");
        let Ok(fresh) = make() else {
            tracing::error!("the renderer cannot be made anew; no more frames are rendered");
            return;
        };
        renderer = fresh;
    }
}

/// What a panic says.
pub fn panic_message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|s| s.to_string());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panic without a message".into())
}

#[cfg(test)]
mod tests;
