//! The cache's counters as JSON and as text.

use lumisphere_proto::v1alpha1 as wire;
use serde_json::{Value, json};

use crate::cache_names::{policy_name, strategy_name, tier_name};
use crate::output::{bytes_text, table};

/// For programs.
pub fn json(now: &wire::CacheStats) -> Value {
    json!({
        "tiers": now.tiers.iter().map(tier).collect::<Vec<_>>(),
        "texels": texels(&now.texels.unwrap_or_default()),
        "datasets": now.datasets.iter().map(dataset).collect::<Vec<_>>(),
        "strategy": strategy_name(now.strategy()),
    })
}

fn tier(t: &wire::CacheTierStats) -> Value {
    json!({
        "tier": tier_name(t.tier()),
        "policy": policy_name(t.policy()),
        "budget_bytes": t.budget_bytes,
        "used_bytes": t.used_bytes,
        "peak_bytes": t.peak_bytes,
        "entries": t.entries,
        "look_ups": t.look_ups,
        "hits": t.hits,
        "misses": t.misses,
        "evictions": t.evictions,
        "bytes_in": t.bytes_in,
        "prefetched": t.prefetched,
        "prefetch_used": t.prefetch_used,
        "prefetch_wasted": t.prefetch_wasted,
        "uploads": t.uploads,
    })
}

fn texels(t: &wire::TexelStats) -> Value {
    json!({
        "look_ups": t.look_ups,
        "misses": t.misses,
        "texel_fetches": t.texel_fetches,
        "texel_misses": t.texel_misses,
        "page_visits": t.page_visits,
        "visit_misses": t.visit_misses,
        "coalesced": t.coalesced,
        "failed_reads": t.failed_reads,
        "uncached": t.uncached,
        "prefetches": t.prefetches,
        "blocks_read": t.blocks_read,
        "bytes_read": t.bytes_read,
        "rows_decoded": t.rows_decoded,
        "bytes_decoded": t.bytes_decoded,
        "rows_redundant": t.rows_redundant,
        "bytes_redundant": t.bytes_redundant,
        "read_micros": t.read_micros,
        "decode_micros": t.decode_micros,
        "wait_micros": t.wait_micros,
    })
}

fn dataset(d: &wire::DatasetCacheStats) -> Value {
    json!({
        "dataset": d.dataset,
        "version": d.version,
        "strategy": strategy_name(d.strategy()),
        "used_bytes": d.used_bytes,
        "peak_bytes": d.peak_bytes,
        "entries": d.entries,
        "evictions": d.evictions,
        "texels": texels(&d.texels.unwrap_or_default()),
        "tiers": d.tiers.iter().map(tier).collect::<Vec<_>>(),
    })
}

fn percent(part: u64, whole: u64) -> String {
    format!("{:.3} %", 100.0 * part as f64 / whole.max(1) as f64)
}

/// Of the pages that came ahead; the other tiers do not tell.
fn of_use(t: &wire::CacheTierStats) -> String {
    if t.tier() == wire::CacheTier::Gpu { t.prefetch_used.to_string() } else { "-".into() }
}

/// For people.
pub fn text(now: &wire::CacheStats) -> String {
    let row = |cells: &[&str]| cells.iter().map(|c| c.to_string()).collect::<Vec<_>>();
    let mut tiers =
        vec![row(&["tier", "policy", "used", "of", "peak", "entries", "look-ups", "misses", "miss rate", "evictions", "ahead", "of use"])];
    tiers.extend(now.tiers.iter().map(|t| {
        vec![
            tier_name(t.tier()).into(),
            policy_name(t.policy()).into(),
            bytes_text(t.used_bytes),
            bytes_text(t.budget_bytes),
            bytes_text(t.peak_bytes),
            t.entries.to_string(),
            t.look_ups.to_string(),
            t.misses.to_string(),
            percent(t.misses, t.look_ups),
            t.evictions.to_string(),
            t.prefetched.to_string(),
            of_use(t),
        ]
    }));
    let mut datasets =
        vec![row(&["dataset", "strategy", "used", "peak", "texel fetches", "missed", "page visits", "missed", "read", "decoded", "again"])];
    datasets.extend(now.datasets.iter().map(|d| {
        let t = d.texels.unwrap_or_default();
        vec![
            format!("{}@{}", d.dataset, d.version),
            strategy_name(d.strategy()).into(),
            bytes_text(d.used_bytes),
            bytes_text(d.peak_bytes),
            t.texel_fetches.to_string(),
            percent(t.texel_misses, t.texel_fetches),
            t.page_visits.to_string(),
            percent(t.visit_misses, t.page_visits),
            bytes_text(t.bytes_read),
            bytes_text(t.bytes_decoded),
            bytes_text(t.bytes_redundant),
        ]
    }));
    let mut shares =
        vec![row(&["dataset", "tier", "used", "peak", "entries", "look-ups", "misses", "miss rate", "evictions", "in", "ahead", "of use"])];
    let told = now.datasets.iter().flat_map(|d| d.tiers.iter().map(move |t| (d, t)));
    shares.extend(told.map(|(d, t)| {
        vec![
            format!("{}@{}", d.dataset, d.version),
            tier_name(t.tier()).into(),
            bytes_text(t.used_bytes),
            bytes_text(t.peak_bytes),
            t.entries.to_string(),
            t.look_ups.to_string(),
            t.misses.to_string(),
            percent(t.misses, t.look_ups),
            t.evictions.to_string(),
            bytes_text(t.bytes_in),
            t.prefetched.to_string(),
            of_use(t),
        ]
    }));
    let mut text = table(&tiers, &[2, 3, 4, 5, 6, 7, 8, 9, 10, 11]);
    if datasets.len() > 1 {
        text += &format!("\n\n{}", table(&datasets, &[2, 3, 4, 5, 6, 7, 8, 9, 10]));
        text += &format!("\n\n{}", table(&shares, &[2, 3, 4, 5, 6, 7, 8, 9, 10, 11]));
    }
    text
}
