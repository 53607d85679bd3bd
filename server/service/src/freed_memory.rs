//! Memory that evicted pages have left goes back to the system, so that the cache takes what its budgets say. What is freed between two
//! blocks that stay, glibc keeps: compressed blocks are made at the same time as the pages that leave before them. Measured with 40 MiB
//! of budgets, over their sum, as the read strategy changes from blocks of 32 KiB to pages of 256: 1.47 with glibc's own ways; up
//! to 1.3 at once and 1.0 within a second with what is here.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::MissedTickBehavior;

use crate::api::App;

/// Between two looks at what was evicted.
const INTERVAL: Duration = Duration::from_secs(1);

/// From this size on memory is the system's own at once: glibc's first threshold, which it would raise to the size of whatever is freed.
/// Pages that large are recycled by the cache, so that a miss does not ask the system.
#[cfg(target_env = "gnu")]
const LARGE_BYTES: libc::c_int = 128 << 10;

/// A heap's free end up to this size stays with it. A frame on lavapipe takes and frees more than 32 MiB in pieces, and each page of those that had gone
/// back to the system comes with a fault: a frame took 1.10 to 1.15 times as long. When pages were evicted the end goes back all the same; while
/// none are, each heap of glibc's (a few for every core) may keep so much that no budget counts.
#[cfg(target_env = "gnu")]
const KEPT_BYTES: libc::c_int = 64 << 20;

/// Call it before there are other threads.
#[cfg(target_env = "gnu")]
#[expect(unsafe_code, reason = "functions of the C library that take two numbers")]
pub fn keep_large_apart() {
    // SAFETY: no pointers; MT-Safe but for the initialisation, which no other thread runs yet.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BYTES);
        libc::mallopt(libc::M_TRIM_THRESHOLD, KEPT_BYTES);
    }
}

/// Until the server stops.
pub async fn give_back(app: Arc<App>) {
    let mut ticks = tokio::time::interval(INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut before = evictions(&app);
    while app.stopping.run_until_cancelled(ticks.tick()).await.is_some() {
        let now = evictions(&app);
        if now != before {
            before = now;
            // A panic there would be a bug of the allocator's.
            tokio::task::spawn_blocking(trim).await.ok();
        }
    }
}

fn evictions(app: &App) -> u64 {
    let (now, _) = app.catalog.cache_stats();
    now.decoded.evictions + now.compressed.evictions
}

#[cfg(target_env = "gnu")]
#[expect(unsafe_code, reason = "a function of the C library that takes no pointer and locks what it touches")]
fn trim() {
    // SAFETY: callable at any time from any thread (MT-Safe); the number only says how much to leave at the heap's end.
    unsafe { libc::malloc_trim(0) };
}

/// Other C libraries have neither.
#[cfg(not(target_env = "gnu"))]
pub fn keep_large_apart() {}

#[cfg(not(target_env = "gnu"))]
fn trim() {}
