//! A trace through real caches on the server: `cache replay --on-server`.

use lumisphere::textures::Trace;
use lumisphere_proto::MAX_CHUNK_BYTES;
use lumisphere_proto::v1alpha1 as wire;
use wire::replay_trace_request::Message;

use super::Row;
use crate::cache_names::{policy_name, policy_to_wire, strategy_name, strategy_to_wire};
use crate::context::Context;
use crate::progress::{Meter, Progress};

/// Adds what the server's caches took to the rows of policies, as the answers come.
pub async fn measure(context: &Context, trace: &Trace, sizes_pages: &[u32], rows: &mut [Row]) -> anyhow::Result<()> {
    let mut settings = wire::ReplaySettings { sizes_pages: sizes_pages.to_vec(), ..Default::default() };
    for row in rows.iter() {
        let strategy = strategy_to_wire(row.strategy.parse().expect("a row has the name of a strategy")).into();
        if !settings.strategies.contains(&strategy) {
            settings.strategies.push(strategy);
        }
        // Belady's is no policy.
        let Ok(policy) = row.policy.parse().map(|policy| policy_to_wire(policy).into()) else { continue };
        if !settings.policies.contains(&policy) {
            settings.policies.push(policy);
        }
    }
    replay(context, trace, settings, |outcome| {
        let cell = (strategy_name(outcome.strategy()), policy_name(outcome.policy()), outcome.size_pages);
        let texels = outcome.texels.unwrap_or_default();
        for row in rows.iter_mut().filter(|row| (row.strategy, row.policy, row.size_pages) == cell) {
            row.millis = Some(1e-3 * outcome.micros as f64);
            row.decode_millis = Some(1e-3 * (texels.read_micros + texels.decode_micros) as f64);
            row.bytes_read = Some(texels.bytes_read);
        }
    })
    .await
}

/// Replays what `settings` ask for, and says every outcome as it comes.
pub async fn replay(
    context: &Context,
    trace: &Trace,
    settings: wire::ReplaySettings,
    mut tell: impl FnMut(&wire::ReplayOutcome),
) -> anyhow::Result<()> {
    let bytes = trace.to_bytes();
    let chunks = bytes.chunks(MAX_CHUNK_BYTES).map(|chunk| Message::Trace(chunk.to_vec().into()));
    let messages: Vec<_> = [Message::Settings(settings)].into_iter().chain(chunks).collect();
    let messages = messages.into_iter().map(|message| wire::ReplayTraceRequest { message: Some(message) });
    let request = context.patient_request(tokio_stream::iter(messages));
    let mut outcomes = context.connect().await?.cache().replay_trace(request).await?.into_inner();
    let mut meter = Meter::new(context.output);
    while let Some(outcome) = outcomes.message().await? {
        meter.update(Progress {
            stage: "replaying",
            done: outcome.done.into(),
            total: outcome.total.into(),
            seconds_left: None,
            detail: "",
        });
        tell(&outcome);
    }
    meter.finish();
    Ok(())
}
