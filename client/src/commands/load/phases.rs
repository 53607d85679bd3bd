//! A phase: how the cache stands at its start, requests on their schedule, what came back and what the cache did meanwhile.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::ValueEnum;
use hdrhistogram::Histogram;
use lumisphere::textures::ReadStrategy;
use lumisphere_proto::v1alpha1 as wire;
use tokio::task::JoinSet;
use tonic::transport::Channel;
use tonic::{Code, Status};
use wire::cache_client::CacheClient;
use wire::rendering_client::RenderingClient;

use crate::cache_names::strategy_to_wire;
use crate::context::{Context, Server};
use crate::exit::Failure;
use crate::viewer_path::{PathKind, ViewerPaths};

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Phase {
    /// From an empty cache
    Cold,
    /// The same once more
    Warm,
    /// The same with a quarter of the memory that the pages take
    LargerThanCache,
    /// An orbit around and around, with half of the memory that it takes: what LRU likes least
    Scan,
}

impl Phase {
    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cold => "cold",
            Self::Warm => "warm",
            Self::LargerThanCache => "larger-than-cache",
            Self::Scan => "scan",
        }
    }
}

/// Who asks when. Requests do not wait for answers: that is what a server meets.
#[derive(Debug, Clone, Copy)]
pub struct Schedule {
    /// At once.
    pub viewers: u32,
    /// Of each viewer, per second.
    pub rate: f64,
    /// Of each viewer.
    pub requests: u32,
}

/// What a phase gave.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Which.
    pub phase: Phase,
    /// The read strategy that was set for it; None: as it was.
    pub strategy: Option<ReadStrategy>,
    /// Microseconds from when a request was due to its answer: one that starts late because the machine is busy counts as late.
    pub latency: Histogram<u64>,
    /// Answers.
    pub frames: u64,
    /// Answers that a better one would have followed.
    pub not_final: u64,
    /// Refused because the server had too much to do.
    pub refused: u64,
    /// From the first request's due time to the last answer.
    pub seconds: f64,
    /// Cache counters at the start and at the end.
    pub before: wire::CacheStats,
    /// See `before`.
    pub after: wire::CacheStats,
}

/// Runs phases against a server.
pub struct Runner<'a> {
    context: &'a Context,
    cache: CacheClient<Channel>,
    rendering: RenderingClient<Channel>,
    schedule: Schedule,
    template: wire::RenderFrameRequest,
    /// As it was found.
    initial: wire::CacheStats,
    /// Most bytes that pages took in the memory tier in an unhurried phase.
    working_set_bytes: u64,
}

/// Where a request stands.
enum Answer {
    Frame { latency: Duration, is_final: bool },
    Refused,
    Failed(Status),
}

// An hour; longer ones count as that.
const LONGEST_MICROS: u64 = 3_600_000_000;
const SIGNIFICANT_DIGITS: u8 = 3;

impl<'a> Runner<'a> {
    /// Remembers how the cache is configured.
    pub async fn new(
        context: &'a Context,
        server: &Server,
        schedule: Schedule,
        template: wire::RenderFrameRequest,
    ) -> anyhow::Result<Self> {
        let mut cache = server.cache();
        let initial = cache.get_cache_stats(context.request(wire::GetCacheStatsRequest {})).await?.into_inner();
        Ok(Self { context, cache, rendering: server.rendering(), schedule, template, initial, working_set_bytes: 0 })
    }

    /// One phase. `show(done, total)` is called as answers come.
    pub async fn run(
        &mut self,
        phase: Phase,
        strategy: Option<ReadStrategy>,
        paths: &ViewerPaths<'_>,
        mut show: impl FnMut(u64, u64),
    ) -> anyhow::Result<Outcome> {
        let before = self.prepare(phase, strategy).await?;
        let motion = if phase == Phase::Scan { PathKind::Orbit } else { paths.kind };
        let paths = ViewerPaths { kind: motion, ..*paths };
        let mut latency = Histogram::new_with_bounds(1, LONGEST_MICROS, SIGNIFICANT_DIGITS).expect("bounds and digits are allowed");
        let (mut frames, mut not_final, mut refused) = (0, 0, 0);
        let total = u64::from(self.schedule.viewers) * u64::from(self.schedule.requests);
        let begin = Instant::now();
        let mut pending = self.start(&paths, begin)?;
        while let Some(answer) = pending.join_next().await {
            match answer.context("a request was lost")? {
                Answer::Frame { latency: took, is_final } => {
                    latency.saturating_record(took.as_micros() as u64);
                    frames += 1;
                    not_final += u64::from(!is_final);
                }
                Answer::Refused => refused += 1,
                Answer::Failed(status) => return Err(status.into()),
            }
            show(frames + refused, total);
        }
        let seconds = begin.elapsed().as_secs_f64();
        let after = self.stats().await?;
        if matches!(phase, Phase::Cold | Phase::Warm) {
            self.working_set_bytes = self.working_set_bytes.max(memory_tier(&after)?.used_bytes);
        }
        Ok(Outcome { phase, strategy, latency, frames, not_final, refused, seconds, before, after })
    }

    /// All requests of the phase, each asleep until it is due. Viewers begin one after the other within the first interval.
    fn start(&self, paths: &ViewerPaths<'_>, begin: Instant) -> anyhow::Result<JoinSet<Answer>> {
        let Schedule { viewers, rate, requests } = self.schedule;
        let mut pending = JoinSet::new();
        for viewer in 0..viewers {
            for step in 0..requests {
                let since = (f64::from(step) + f64::from(viewer) / f64::from(viewers)) / rate;
                let due = begin + Duration::from_secs_f64(since);
                let camera = Some(paths.camera(viewer, step.into())?);
                let request = wire::RenderFrameRequest { camera, pose_id: u64::from(step) + 1, ..self.template.clone() };
                let (mut client, patient) = (self.rendering.clone(), self.context.patient_request(request));
                pending.spawn(async move {
                    tokio::time::sleep_until(due.into()).await;
                    match client.render_frame(patient).await {
                        Ok(frame) => Answer::Frame { latency: due.elapsed(), is_final: frame.into_inner().is_final },
                        Err(status) if status.code() == Code::ResourceExhausted => Answer::Refused,
                        Err(status) => Answer::Failed(status),
                    }
                });
            }
        }
        Ok(pending)
    }

    /// Puts the cache as the phase wants it and returns its counters.
    async fn prepare(&mut self, phase: Phase, strategy: Option<ReadStrategy>) -> anyhow::Result<wire::CacheStats> {
        let initial = memory_tier(&self.initial)?.budget_bytes;
        let budget = match phase {
            Phase::Cold | Phase::Warm => initial,
            Phase::LargerThanCache => self.working_set()? / 4,
            Phase::Scan => self.working_set()? / 2,
        };
        let strategy = strategy.map(strategy_to_wire).unwrap_or_default();
        let change =
            wire::ConfigureCacheRequest { memory_budget_bytes: Some(budget.min(initial)), strategy: strategy.into(), ..Default::default() };
        self.cache.configure_cache(self.context.request(change)).await?;
        if phase == Phase::Cold {
            self.cache.clear_cache(self.context.request(wire::ClearCacheRequest { reset_counters: false })).await?;
        }
        self.stats().await
    }

    fn working_set(&self) -> anyhow::Result<u64> {
        if self.working_set_bytes == 0 {
            let why = "nothing was read into memory before: run `cold` or `warm` first (with --backend cpu where a GPU holds all pages)";
            return Err(Failure::Precondition(why.into()).into());
        }
        Ok(self.working_set_bytes)
    }

    async fn stats(&mut self) -> anyhow::Result<wire::CacheStats> {
        Ok(self.cache.get_cache_stats(self.context.request(wire::GetCacheStatsRequest {})).await?.into_inner())
    }

    /// The cache as it was found.
    pub async fn restore(&mut self) -> anyhow::Result<()> {
        let change = wire::ConfigureCacheRequest {
            memory_budget_bytes: Some(memory_tier(&self.initial)?.budget_bytes),
            strategy: self.initial.strategy,
            ..Default::default()
        };
        self.cache.configure_cache(self.context.request(change)).await.context("the cache keeps the load test's budget")?;
        Ok(())
    }
}

/// The tier of decoded pages.
pub fn memory_tier(stats: &wire::CacheStats) -> anyhow::Result<&wire::CacheTierStats> {
    stats.tiers.iter().find(|t| t.tier() == wire::CacheTier::Memory).context("the server tells no memory tier")
}
