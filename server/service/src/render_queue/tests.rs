//! Who waits, who is refused, who goes first.

use std::convert::Infallible;
use std::sync::atomic::{AtomicU32, Ordering};

use crossbeam_channel::Sender;

use super::*;

fn queue(length: usize) -> RenderQueue<u32> {
    RenderQueue::start(length, "render", || Ok::<u32, Infallible>(0), |_| ()).unwrap()
}

/// Occupies the thread until the sender is dropped or used.
fn hold(queue: &RenderQueue<u32>) -> (Sender<()>, tokio::task::JoinHandle<()>) {
    let (release, released) = bounded::<()>(1);
    let (begun, has_begun) = bounded::<()>(1);
    let queue = queue.clone();
    let held = tokio::spawn(async move {
        let work = move |_: &mut u32| {
            let _ = begun.send(());
            let _ = released.recv();
        };
        queue.run(Priority::Viewer, None, work).await.unwrap();
    });
    tokio::task::block_in_place(|| has_begun.recv().unwrap());
    (release, held)
}

#[tokio::test(flavor = "multi_thread")]
async fn one_more_than_allowed_is_refused_and_room_comes_back() {
    let queue = queue(1);
    let (release, held) = hold(&queue);
    assert_eq!(queue.run(Priority::Viewer, None, |_| ()).await.unwrap_err(), QueueError::Full { waiting: 1 });
    release.send(()).unwrap();
    held.await.unwrap();
    assert_eq!(queue.run(Priority::Viewer, None, |_| 5).await.unwrap().value, 5);
    assert_eq!(queue.waiting(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn work_whose_deadline_passed_or_whose_caller_left_is_never_begun() {
    let queue = queue(8);
    let begun = Arc::new(AtomicU32::new(0));
    let counted = |begun: &Arc<AtomicU32>| {
        let begun = begun.clone();
        move |_: &mut u32| begun.fetch_add(1, Ordering::SeqCst)
    };
    let (release, held) = hold(&queue);
    let soon = Instant::now() + Duration::from_millis(5);
    let late = tokio::spawn({
        let (queue, work) = (queue.clone(), counted(&begun));
        async move { queue.run(Priority::Viewer, Some(soon), work).await.map(|r| r.value) }
    });
    let left = tokio::time::timeout(Duration::from_millis(5), queue.run(Priority::Viewer, None, counted(&begun))).await;
    assert!(left.is_err());
    tokio::time::sleep_until(soon).await;
    release.send(()).unwrap();
    held.await.unwrap();
    assert_eq!(late.await.unwrap(), Err(QueueError::DeadlineExceeded));
    assert_eq!(queue.run(Priority::Viewer, None, counted(&begun)).await.unwrap().value, 0, "nothing ran before");
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_leaves_the_line_makes_room_at_once() {
    let queue = queue(2);
    let (release, held) = hold(&queue);
    for _ in 0..10 {
        let mut leaving = Box::pin(queue.run(Priority::Still, None, |_| ()));
        assert!(futures_poll_once(leaving.as_mut()).await.is_none());
        assert_eq!(queue.waiting(), 2);
        drop(leaving);
        assert_eq!(queue.waiting(), 1);
    }
    release.send(()).unwrap();
    held.await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn viewers_go_before_jobs() {
    let queue = queue(8);
    let (release, held) = hold(&queue);
    let run = |priority| {
        let queue = queue.clone();
        async move {
            let work = |order: &mut u32| {
                *order += 1;
                *order
            };
            queue.run(priority, None, work).await.unwrap().value
        }
    };
    // Polled once each, in this order, both stand in line.
    let mut job = Box::pin(run(Priority::Batch));
    assert!(futures_poll_once(job.as_mut()).await.is_none());
    let mut viewer = Box::pin(run(Priority::Viewer));
    assert!(futures_poll_once(viewer.as_mut()).await.is_none());
    release.send(()).unwrap();
    held.await.unwrap();
    assert_eq!(tokio::join!(job, viewer), (2, 1));
}

/// What it has done, and what it has put off: a render puts off its own end, and a later one does it beside its own work.
#[derive(Default)]
struct Log {
    done: Arc<Mutex<Vec<String>>>,
    put_off: Vec<String>,
}

impl Log {
    fn settle(&mut self) {
        self.done.lock().unwrap().extend(self.put_off.drain(..).map(|what| format!("{what} settled")));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_render_leaves_is_settled_when_none_follows_at_once() {
    let done = Arc::new(Mutex::new(Vec::new()));
    let make = {
        let done = done.clone();
        move || Ok::<_, Infallible>(Log { done: done.clone(), put_off: Vec::new() })
    };
    let queue = RenderQueue::start(8, "render", make, Log::settle).unwrap();
    let (release, released) = bounded::<()>(1);
    let (begun, has_begun) = bounded::<()>(1);
    let render = |name: &'static str| {
        let queue = queue.clone();
        async move {
            let work = move |log: &mut Log| {
                log.done.lock().unwrap().push(name.into());
                log.put_off.push(name.into());
            };
            queue.run(Priority::Viewer, None, work).await.map(drop).unwrap();
        }
    };
    let holding = queue.clone();
    let held = tokio::spawn(async move {
        let work = move |_: &mut Log| {
            let _ = begun.send(());
            let _ = released.recv();
        };
        holding.run(Priority::Viewer, None, work).await.map(drop).unwrap();
    });
    tokio::task::block_in_place(|| has_begun.recv().unwrap());
    let idle = queue.run_idle(Idle::Ahead, |log| log.done.lock().unwrap().push("idle".into()));
    let (mut a, mut b, mut idle) = (Box::pin(render("a")), Box::pin(render("b")), Box::pin(idle));
    // In line while the thread is held.
    assert!(futures_poll_once(a.as_mut()).await.is_none() && futures_poll_once(b.as_mut()).await.is_none());
    assert!(futures_poll_once(idle.as_mut()).await.is_none());
    release.send(()).unwrap();
    held.await.unwrap();
    let ((), (), idle) = tokio::join!(a, b, idle);
    idle.unwrap();
    assert_eq!(*done.lock().unwrap(), ["a", "b", "a settled", "b settled", "idle"]);
}

async fn futures_poll_once<F: Future>(future: std::pin::Pin<&mut F>) -> Option<F::Output> {
    let mut future = Some(future);
    std::future::poll_fn(move |cx| {
        let polled = future.take().expect("polled once").poll(cx);
        std::task::Poll::Ready(match polled {
            std::task::Poll::Ready(value) => Some(value),
            std::task::Poll::Pending => None,
        })
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_panic_is_told_to_its_caller_and_the_next_frame_has_a_fresh_renderer() {
    let queue = queue(8);
    queue.run(Priority::Viewer, None, |r| *r = 9).await.unwrap();
    let failed = queue.run(Priority::Viewer, None, |_| -> u32 { panic!("on purpose") }).await.unwrap_err();
    assert_eq!(failed, QueueError::Panicked("on purpose".into()));
    assert_eq!(queue.run(Priority::Viewer, None, |r| *r).await.unwrap().value, 0);
}

/// How many stand in line; who is admitted may not have got there yet.
fn in_line(queue: &RenderQueue<u32>) -> usize {
    queue.door.0.state.lock().unwrap().renders.len()
}

/// Eight sessions, each with one wish at a time, and eight jobs. A frame takes until all others stand in line again, so that every turn is a
/// choice among all: who came last must not go first.
#[tokio::test(flavor = "multi_thread")]
async fn sessions_that_share_the_thread_get_equally_many_frames() {
    const SESSIONS: usize = 8;
    const JOBS: usize = 8;
    const FRAMES: u32 = 100 * SESSIONS as u32;
    let queue = queue(64);
    let (release, held) = hold(&queue);
    let mut sessions = Vec::new();
    for _ in 0..SESSIONS {
        let queue = queue.clone();
        sessions.push(tokio::spawn(async move {
            for served in 0.. {
                let line = queue.clone();
                let frame = move |frames: &mut u32| {
                    *frames += 1;
                    while *frames <= FRAMES && in_line(&line) < SESSIONS - 1 + JOBS {
                        thread::yield_now();
                    }
                    *frames
                };
                if queue.run(Priority::Viewer, None, frame).await.unwrap().value > FRAMES {
                    return served;
                }
            }
            unreachable!("the loop has no end");
        }));
    }
    let jobs: Vec<_> = (0..JOBS).map(|_| tokio::spawn(waiting(queue.clone(), Priority::Batch))).collect();
    while in_line(&queue) < SESSIONS + JOBS {
        tokio::task::yield_now().await;
    }
    release.send(()).unwrap();
    held.await.unwrap();
    let mut served: Vec<f64> = Vec::new();
    for session in sessions {
        served.push(f64::from(session.await.unwrap()));
    }
    for job in jobs {
        job.await.unwrap();
    }
    let jain = served.iter().sum::<f64>().powi(2) / (SESSIONS as f64 * served.iter().map(|n| n * n).sum::<f64>());
    assert!(jain >= 0.95, "{jain}: {served:?}");
}

async fn waiting(queue: RenderQueue<u32>, priority: Priority) {
    queue.run(priority, None, |_| ()).await.unwrap();
}

/// The order in which they are taken, whatever order they came in; of equals the first.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn viewers_go_before_stills_for_half_a_second_and_jobs_go_last() {
    let queue = queue(16);
    let (release, held) = hold(&queue);
    let order = |taken: &mut u32| {
        *taken += 1;
        *taken
    };
    // What was rendered is let go at once: it has a slot.
    let stand = |priority| {
        let queue = queue.clone();
        Box::pin(async move { queue.run(priority, None, order).await.unwrap().value })
    };
    let [mut a, mut b, mut c, mut d, mut e, mut f] =
        [Priority::Batch, Priority::Still, Priority::Viewer, Priority::Batch, Priority::Viewer, Priority::Still].map(stand);
    for place in [&mut a, &mut b, &mut c, &mut d, &mut e, &mut f] {
        assert!(futures_poll_once(place.as_mut()).await.is_none());
    }
    // Half a second later than the stills: behind them.
    let late = Instant::now() + STILL_PATIENCE;
    let (tell, told) = bounded(1);
    let render: Render<u32> = Box::new(move |taken, _| tell.send(order(taken)).expect("the test listens"));
    queue.door.0.stand(Priority::Viewer, late, render);
    release.send(()).unwrap();
    held.await.unwrap();
    let taken = tokio::join!(a, b, c, d, e, f);
    assert_eq!((taken, told.recv()), ((6, 3, 1, 7, 2, 4), Ok(5)));
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_work_goes_after_everyone_and_takes_no_place_from_a_render() {
    let queue = queue(SLOTS + 1);
    let (release, held) = hold(&queue);
    let count = |order: &mut u32| {
        *order += 1;
        *order
    };
    // Polled first, it waits for the thread; another waits for it.
    let mut idle = Box::pin(queue.run_idle(Idle::Ahead, count));
    assert!(futures_poll_once(idle.as_mut()).await.is_none());
    let mut next_idle = Box::pin(queue.run_idle(Idle::Ahead, count));
    assert!(futures_poll_once(next_idle.as_mut()).await.is_none());
    assert_eq!(queue.waiting(), 1, "only the render that holds the thread counts");
    let mut job = Box::pin(queue.run(Priority::Batch, None, count));
    assert!(futures_poll_once(job.as_mut()).await.is_none());
    let mut viewer = Box::pin(queue.run(Priority::Viewer, None, count));
    assert!(futures_poll_once(viewer.as_mut()).await.is_none());
    release.send(()).unwrap();
    held.await.unwrap();
    let (viewer, job, idle, next_idle) = tokio::join!(viewer, job, idle, next_idle);
    assert_eq!((viewer.unwrap().value, job.unwrap().value, idle, next_idle), (1, 2, Ok(3), Ok(4)));
}

#[tokio::test(flavor = "multi_thread")]
async fn refining_goes_after_what_is_brought_ahead_and_one_pass_at_a_time() {
    let queue = queue(8);
    let (release, held) = hold(&queue);
    let count = |order: &mut u32| {
        *order += 1;
        *order
    };
    let mut places = [Idle::Refine, Idle::Refine, Idle::Ahead].map(|kind| Box::pin(queue.run_idle(kind, count)));
    for place in &mut places {
        assert!(futures_poll_once(place.as_mut()).await.is_none());
    }
    let mut viewer = Box::pin(queue.run(Priority::Viewer, None, count));
    assert!(futures_poll_once(viewer.as_mut()).await.is_none());
    release.send(()).unwrap();
    held.await.unwrap();
    let [pass, other_pass, ahead] = places;
    let (viewer, pass, other_pass, ahead) = tokio::join!(viewer, pass, other_pass, ahead);
    assert_eq!((viewer.unwrap().value, ahead, pass, other_pass), (1, Ok(2), Ok(3), Ok(4)));
}

/// Of two viewers who are refined without end, one's pass is under way when somebody else's frame comes.
#[tokio::test(flavor = "multi_thread")]
async fn a_frame_waits_for_no_more_than_the_pass_that_is_under_way() {
    let queue = queue(8);
    let pass = |passes: &mut u32| {
        *passes += 1;
        *passes
    };
    let endless = tokio::spawn({
        let queue = queue.clone();
        async move { while queue.run_idle(Idle::Refine, pass).await.is_ok() {} }
    });
    for _ in 0..50 {
        let (release, released) = bounded::<()>(1);
        let (begun, has_begun) = bounded::<()>(1);
        let held = tokio::spawn({
            let queue = queue.clone();
            let held_pass = move |passes: &mut u32| {
                begun.send(()).expect("the test waits");
                released.recv().expect("the test tells");
                pass(passes)
            };
            async move { queue.run_idle(Idle::Refine, held_pass).await }
        });
        tokio::task::block_in_place(|| has_begun.recv().unwrap());
        let mut frame = Box::pin(queue.run(Priority::Viewer, None, |passes| *passes));
        assert!(futures_poll_once(frame.as_mut()).await.is_none());
        release.send(()).unwrap();
        assert_eq!(Ok(frame.await.unwrap().value), held.await.unwrap(), "another pass came before the frame");
    }
    endless.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn who_was_admitted_once_keeps_the_place_from_turn_to_turn() {
    let queue = queue(1);
    let mut admitted = queue.admit().unwrap();
    for turn in 0..3 {
        assert_eq!(queue.run(Priority::Viewer, None, |_| ()).await.unwrap_err(), QueueError::Full { waiting: 1 });
        let rendered = queue.run_admitted(admitted, Priority::Viewer, None, move |_| turn).await.unwrap();
        assert_eq!(rendered.value, turn);
        admitted = rendered.admitted;
    }
    drop(admitted);
    assert_eq!(queue.run(Priority::Viewer, None, |_| 5).await.unwrap().value, 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_work_whose_caller_left_is_never_begun_and_a_panic_of_it_is_told() {
    let queue = queue(8);
    let (release, held) = hold(&queue);
    let mut left = Box::pin(queue.run_idle(Idle::Ahead, |order| *order = 9));
    assert!(futures_poll_once(left.as_mut()).await.is_none());
    drop(left);
    release.send(()).unwrap();
    held.await.unwrap();
    assert_eq!(queue.run_idle(Idle::Ahead, |order| *order).await, Ok(0));
    assert_eq!(queue.run_idle(Idle::Ahead, |_| -> u32 { panic!("on purpose") }).await, Err(QueueError::Panicked("on purpose".into())));
    assert_eq!(queue.run_idle(Idle::Ahead, |order| *order).await, Ok(0));
}
