//! A recorded trace through caches of its own over this server's data: `Cache.ReplayTrace`.
//!
//! Bounded before it begins: the trace's bytes, events and fetches, the number of caches and the memory of each; one replay at a time.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use lumisphere::textures::{Cache, CacheOptions, DatasetVersion, PageId, StoreError, Trace, TraceEvent, laboratory};
use tokio::sync::mpsc;
use tokio_stream::{Stream, StreamExt};
use tonic::Status;

use crate::errors::{ApiError, Reason};
use crate::wire::proto::{self, replay_trace_request::Message};
use crate::wire::replay::{ReplayPlan, replay_outcome, replay_plan};
use crate::wire::{MAX_CHUNK_BYTES, required};

/// Of the file.
const MAX_TRACE_BYTES: usize = 64 << 20;
/// Of all events together: some ten seconds a cache, if they hit.
const MAX_FETCHES: u64 = 1 << 28;
/// A message must come within this time, and the whole trace within ten of them.
const PATIENCE: Duration = Duration::from_secs(30);
/// All caches together: nobody else replays meanwhile.
const MOST_TIME: Duration = Duration::from_secs(600);

/// A plan and a trace file to try it with.
#[derive(Debug)]
pub struct Replay {
    plan: ReplayPlan,
    file: Vec<u8>,
}

/// Where outcomes go.
pub type Outcomes = mpsc::Sender<Result<proto::ReplayOutcome, Status>>;

impl Replay {
    /// From the client's messages, to their end.
    pub async fn received(messages: impl Stream<Item = Result<proto::ReplayTraceRequest, Status>> + Unpin) -> Result<Self, ApiError> {
        let late = |_| ApiError::new(Reason::DeadlineExceeded, "the whole trace did not come in time");
        tokio::time::timeout(10 * PATIENCE, Self::received_at_last(messages)).await.map_err(late)?
    }

    async fn received_at_last(
        mut messages: impl Stream<Item = Result<proto::ReplayTraceRequest, Status>> + Unpin,
    ) -> Result<Self, ApiError> {
        let late = |_| ApiError::new(Reason::DeadlineExceeded, "the next part of the trace did not come in time");
        let left = |status: Status| ApiError::field("trace", format!("a message could not be read: {}", status.message()));
        let (mut plan, mut file) = (None, Vec::new());
        while let Some(message) = tokio::time::timeout(PATIENCE, messages.next()).await.map_err(late)? {
            match (required(message.map_err(left)?.message, "message")?, &plan) {
                (Message::Settings(settings), None) => plan = Some(replay_plan(&settings)?),
                (Message::Settings(_), Some(_)) => return Err(ApiError::field("settings", "sent twice, once expected")),
                (Message::Trace(_), None) => return Err(ApiError::field("settings", "missing: expected before the trace")),
                (Message::Trace(chunk), Some(_)) => take(&mut file, &chunk)?,
            }
        }
        Ok(Self { plan: plan.ok_or_else(|| ApiError::field("settings", "missing"))?, file })
    }

    /// Every cache in turn, on this thread, until someone `is_unwanted`. `open` finds the dataset and version that the trace was recorded of.
    /// Caches larger than `most_bytes` are refused.
    pub fn run(
        self,
        open: impl FnOnce(&str, u64) -> Result<Arc<DatasetVersion>, StoreError>,
        most_bytes: u64,
        told: &Outcomes,
        is_unwanted: impl Fn() -> bool,
    ) -> Result<(), ApiError> {
        let (begun, plan) = (Instant::now(), self.plan);
        let trace = the_part(&plan, self.file)?;
        let recorded = &trace.versions[0];
        let version = &open(&recorded.dataset, recorded.version)?;
        let page_bytes = recorded.shape.resident_bytes() as u64;
        let too_large = |size: &&u32| u64::from(**size) * page_bytes > most_bytes;
        if let Some(size) = plan.sizes_pages.iter().find(too_large) {
            let problem = format!("{size} pages of {page_bytes} bytes, at most {most_bytes} bytes expected");
            return Err(ApiError::field("settings.sizes_pages", problem));
        }
        check_rows(&trace, version)?;
        let total = plan.cells().count();
        let is_late = || begun.elapsed() > MOST_TIME;
        let ends = || is_unwanted() || is_late();
        for (done, cell) in (1..).zip(plan.cells()) {
            let (strategy, decoded_policy, size_pages) = cell;
            let options = CacheOptions { strategy, decoded_policy, ..CacheOptions::decoded(u64::from(size_pages) * page_bytes) };
            let replayed = laboratory::replay(&trace, std::slice::from_ref(version), options, &ends)?;
            let Some((counted, nanos)) = replayed else {
                if is_late() {
                    let message = format!(
                        "{} of {total} caches were replayed in {} s: fewer or larger caches expected",
                        done - 1,
                        MOST_TIME.as_secs()
                    );
                    return Err(ApiError::new(Reason::DeadlineExceeded, message));
                }
                return Err(ApiError::new(Reason::ShuttingDown, "the replay is not wanted any more"));
            };
            // The client may have left.
            let Ok(()) = told.blocking_send(Ok(replay_outcome(cell, &counted, nanos, [done, total]))) else { return Ok(()) };
        }
        Ok(())
    }
}

// The requests for the dataset that the plan is about; the file is let go of.
fn the_part(plan: &ReplayPlan, file: Vec<u8>) -> Result<Trace, ApiError> {
    let whole = Trace::from_bytes(&file).map_err(|error| ApiError::field("trace", error))?;
    let count = whole.versions.len();
    whole.only(plan.part).ok_or_else(|| ApiError::field("settings.part", format!("{}, the trace has {count}", plan.part)))
}

fn take(file: &mut Vec<u8>, chunk: &[u8]) -> Result<(), ApiError> {
    let (size, whole) = (chunk.len(), file.len() + chunk.len());
    if size == 0 || size > MAX_CHUNK_BYTES || whole > MAX_TRACE_BYTES {
        let problem = format!("{size} bytes after {}, chunks of 1 to {MAX_CHUNK_BYTES} and {MAX_TRACE_BYTES} in all expected", file.len());
        return Err(ApiError::field("trace", problem));
    }
    file.extend_from_slice(chunk);
    Ok(())
}

/// That the stored pages have what the trace asks for, and that it does not ask too often.
fn check_rows(trace: &Trace, version: &Arc<DatasetVersion>) -> Result<(), ApiError> {
    let (mut fetched, mut lowest) = (0u64, BTreeMap::new());
    for event in &trace.events {
        let (page, row, fetches) = match *event {
            TraceEvent::Frame => continue,
            TraceEvent::Row { page, row, fetches, .. } => (page, row, fetches),
            TraceEvent::Page { page, .. } => (page, 0, 1),
        };
        fetched += u64::from(fetches);
        let deepest: &mut u32 = lowest.entry(page).or_default();
        *deepest = row.max(*deepest);
    }
    if fetched > MAX_FETCHES {
        return Err(ApiError::field("trace", format!("{fetched} fetches, at most {MAX_FETCHES} expected")));
    }
    let (cache, count) = (Cache::new(CacheOptions::decoded(0)), version.page_count());
    let reader = cache.reader(version);
    for (page, row) in lowest {
        if page >= PageId(count) {
            return Err(ApiError::field("trace", format!("page {page}, but the version has {count}")));
        }
        let height = reader.shape(page)?.height;
        if row >= height {
            return Err(ApiError::field("trace", format!("row {row} of page {page}, which has {height}")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn received(messages: Vec<Message>) -> Result<Replay, String> {
        let messages = messages.into_iter().map(|message| Ok(proto::ReplayTraceRequest { message: Some(message) }));
        Replay::received(tokio_stream::iter(messages)).await.map_err(|error| error.to_string())
    }

    #[tokio::test]
    async fn settings_come_first_and_once_and_the_trace_is_one() {
        let settings = || Message::Settings(proto::ReplaySettings { sizes_pages: vec![4], ..Default::default() });
        let trace = Trace { versions: vec![], events: vec![TraceEvent::Frame], is_truncated: false };
        let bytes = || Message::Trace(trace.to_bytes().into());
        assert!(received(vec![]).await.unwrap_err().starts_with("settings: missing"));
        assert!(received(vec![bytes(), settings()]).await.unwrap_err().contains("before the trace"));
        assert!(received(vec![settings(), settings()]).await.unwrap_err().contains("twice"));
        assert!(received(vec![settings(), Message::Trace(vec![].into())]).await.unwrap_err().starts_with("trace: 0 bytes"));
        assert!(received(vec![settings(), Message::Trace(vec![0; MAX_CHUNK_BYTES + 1].into())]).await.unwrap_err().starts_with("trace"));
        let part_of = |file: Vec<u8>, plan: &ReplayPlan| the_part(plan, file).map_err(|error| error.to_string());
        let plan = received(vec![settings(), bytes()]).await.unwrap().plan;
        assert!(part_of(vec![], &plan).unwrap_err().starts_with("trace: not a trace"));
        // A trace of nothing has no part.
        assert!(part_of(trace.to_bytes(), &plan).unwrap_err().starts_with("settings.part"));
    }

    #[test]
    fn a_trace_is_no_longer_than_the_limit() {
        let (mut file, chunk) = (Vec::new(), vec![0; MAX_CHUNK_BYTES]);
        for _ in 0..MAX_TRACE_BYTES / MAX_CHUNK_BYTES {
            take(&mut file, &chunk).unwrap();
        }
        assert!(take(&mut file, &[0]).unwrap_err().to_string().starts_with("trace"));
        assert_eq!(file.len(), MAX_TRACE_BYTES);
    }
}
