//! The texture cache's messages.

use lumisphere::gpu::GpuCacheStats;
use lumisphere::representations::{Lobe, PixelOrder};
use lumisphere::textures::{CacheSnapshot, CacheStats, CompressedStats, PolicyKind, ReadStrategy};

use super::{proto, within};
use crate::errors::ApiError;

/// More than any machine has; above it a slip of the pen is likelier.
const MAX_BUDGET_BYTES: u64 = 1 << 44;
const INTERVAL_SECONDS: (f64, f64, f64) = (0.05, 1.0, 3600.0);
const MAX_TRAFFIC_SECONDS: f64 = 3600.0;
const MAX_LOBE_SAMPLES: u32 = 64;
const DEFAULT_LOBE_EXPONENT: f32 = 40.0;

/// A checked change; None: unchanged.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CacheChange {
    /// Of decoded pages.
    pub memory_budget_bytes: Option<u64>,
    /// Of compressed blocks.
    pub compressed_budget_bytes: Option<u64>,
    /// Of slots on the adapter.
    pub gpu_budget_bytes: Option<u64>,
    /// Of decoded pages.
    pub memory_policy: Option<PolicyKind>,
    /// Of compressed blocks.
    pub compressed_policy: Option<PolicyKind>,
    /// Of slots on the adapter.
    pub gpu_policy: Option<PolicyKind>,
    /// Of `dataset`, or of all.
    pub strategy: Option<ReadStrategy>,
    /// Whose strategy; None for all.
    pub dataset: Option<String>,
}

impl CacheChange {
    /// The first field that needs a graphics adapter.
    pub fn gpu_field(&self) -> Option<&'static str> {
        match (self.gpu_budget_bytes, self.gpu_policy) {
            (Some(_), _) => Some("gpu_budget_bytes"),
            (None, Some(_)) => Some("gpu_policy"),
            (None, None) => None,
        }
    }
}

/// A checked change.
pub fn cache_change(m: &proto::ConfigureCacheRequest) -> Result<CacheChange, ApiError> {
    let dataset = match m.dataset.is_empty() {
        true => None,
        false => Some(super::dataset_name(&m.dataset, "dataset")?),
    };
    let strategy = read_strategy(m.strategy, "strategy")?;
    if dataset.is_some() && strategy.is_none() {
        return Err(ApiError::field("strategy", "missing: a dataset has nothing else to change"));
    }
    Ok(CacheChange {
        memory_budget_bytes: budget(m.memory_budget_bytes, "memory_budget_bytes")?,
        compressed_budget_bytes: budget(m.compressed_budget_bytes, "compressed_budget_bytes")?,
        gpu_budget_bytes: budget(m.gpu_budget_bytes, "gpu_budget_bytes")?,
        memory_policy: policy(m.memory_policy, "memory_policy")?,
        compressed_policy: policy(m.compressed_policy, "compressed_policy")?,
        gpu_policy: policy(m.gpu_policy, "gpu_policy")?,
        strategy,
        dataset,
    })
}

fn budget(bytes: Option<u64>, field: &str) -> Result<Option<u64>, ApiError> {
    match bytes {
        Some(bytes) if bytes > MAX_BUDGET_BYTES => Err(ApiError::field(field, format!("{bytes}, at most {MAX_BUDGET_BYTES} expected"))),
        other => Ok(other),
    }
}

pub(super) fn policy(value: i32, field: &str) -> Result<Option<PolicyKind>, ApiError> {
    use proto::CachePolicy as P;
    match P::try_from(value) {
        Ok(P::Unspecified) => Ok(None),
        Ok(known) => Ok(PolicyKind::ALL.into_iter().find(|kind| policy_message(*kind) == known)),
        Err(_) => Err(ApiError::field(field, format!("{value}, a policy expected"))),
    }
}

pub(super) fn read_strategy(value: i32, field: &str) -> Result<Option<ReadStrategy>, ApiError> {
    use proto::ReadStrategy as S;
    match S::try_from(value) {
        Ok(S::Unspecified) => Ok(None),
        Ok(known) => Ok(ReadStrategy::ALL.into_iter().find(|strategy| strategy_message(*strategy) == known)),
        Err(_) => Err(ApiError::field(field, format!("{value}, a read strategy expected"))),
    }
}

pub(super) fn policy_message(kind: PolicyKind) -> proto::CachePolicy {
    match kind {
        PolicyKind::Lru => proto::CachePolicy::Lru,
        PolicyKind::Clock => proto::CachePolicy::Clock,
        PolicyKind::Arc => proto::CachePolicy::Arc,
        PolicyKind::S3Fifo => proto::CachePolicy::S3Fifo,
        PolicyKind::FrameLru => proto::CachePolicy::FrameLru,
        PolicyKind::Gittins => proto::CachePolicy::Gittins,
    }
}

pub(super) fn strategy_message(strategy: ReadStrategy) -> proto::ReadStrategy {
    match strategy {
        ReadStrategy::OnDemand => proto::ReadStrategy::OnDemand,
        ReadStrategy::OnDemandRestart => proto::ReadStrategy::OnDemandRestart,
        ReadStrategy::HalfThreshold => proto::ReadStrategy::HalfThreshold,
        ReadStrategy::FullImage => proto::ReadStrategy::FullImage,
        ReadStrategy::Block => proto::ReadStrategy::Block,
    }
}

/// Between two messages of WatchCacheStats.
pub fn interval(seconds: f64) -> Result<std::time::Duration, ApiError> {
    let (least, default, most) = INTERVAL_SECONDS;
    match seconds {
        0.0 => Ok(std::time::Duration::from_secs_f64(default)),
        s if (least..=most).contains(&s) => Ok(std::time::Duration::from_secs_f64(s)),
        s => Err(ApiError::field("interval_seconds", format!("{s}, {least} to {most} expected"))),
    }
}

/// How long to record.
pub fn traffic_time(seconds: f64) -> Result<std::time::Duration, ApiError> {
    match seconds > 0.0 && seconds <= MAX_TRAFFIC_SECONDS {
        true => Ok(std::time::Duration::from_secs_f64(seconds)),
        false => Err(ApiError::field("seconds", format!("{seconds}, above 0 and at most {MAX_TRAFFIC_SECONDS} expected"))),
    }
}

/// Order of pixels, and the directions drawn for each.
pub fn recording(m: &proto::RecordTraceRequest) -> Result<(PixelOrder, Option<Lobe>), ApiError> {
    let order = match proto::PixelOrder::try_from(m.order) {
        Ok(proto::PixelOrder::Unspecified | proto::PixelOrder::Buckets) => PixelOrder::Buckets,
        Ok(proto::PixelOrder::Scanlines) => PixelOrder::Scanlines,
        Err(_) => return Err(ApiError::field("order", format!("{}, an order of pixels expected", m.order))),
    };
    if m.lobe_samples > MAX_LOBE_SAMPLES {
        return Err(ApiError::field("lobe_samples", format!("{}, at most {MAX_LOBE_SAMPLES} expected", m.lobe_samples)));
    }
    let exponent = if m.lobe_exponent == 0.0 { DEFAULT_LOBE_EXPONENT } else { within(m.lobe_exponent, 1.0, 1e5, "lobe_exponent")? };
    let lobe = (m.lobe_samples > 0).then_some(Lobe { samples: m.lobe_samples, exponent, seed: m.seed });
    Ok((order, lobe))
}

/// The adapter's tier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuTier {
    /// Counters and sizes.
    pub stats: GpuCacheStats,
    /// The same by version slot.
    pub versions: Vec<(u32, GpuCacheStats)>,
    /// Which page leaves first.
    pub policy: PolicyKind,
}

impl GpuTier {
    fn of_version(&self, slot: u32) -> Option<&GpuCacheStats> {
        self.versions.iter().find(|(version, _)| *version == slot).map(|(_, stats)| stats)
    }
}

/// All tiers; events since `baseline`.
pub fn cache_stats(
    now: &CacheSnapshot,
    baseline: &CacheSnapshot,
    gpu: Option<&GpuTier>,
    gpu_baseline: Option<&GpuTier>,
) -> proto::CacheStats {
    let texels = texel_stats(&now.decoded, &baseline.decoded);
    let datasets = now.versions.iter().map(|v| {
        let same = baseline.versions.iter().find(|b| b.slot == v.slot);
        let before = same.map(|b| b.decoded).unwrap_or_default();
        let compressed_before = same.map(|b| b.compressed).unwrap_or_default();
        let texels = texel_stats(&v.decoded, &before);
        let mut tiers = vec![
            compressed_tier(now.compressed_policy, &v.compressed, &compressed_before, texels.bytes_read),
            memory_tier(now.decoded_policy, &v.decoded, &before),
        ];
        tiers.extend(gpu.and_then(|gpu| {
            let before = gpu_baseline.and_then(|b| b.of_version(v.slot)).copied().unwrap_or_default();
            Some(gpu_tier(gpu.policy, gpu.of_version(v.slot)?, &before))
        }));
        proto::DatasetCacheStats {
            dataset: v.dataset.clone(),
            version: v.version,
            strategy: strategy_message(v.strategy).into(),
            texels: Some(texels),
            used_bytes: v.decoded.resident_bytes,
            peak_bytes: v.decoded.peak_bytes,
            entries: v.decoded.resident_pages,
            evictions: v.decoded.evictions.saturating_sub(before.evictions),
            tiers,
        }
    });
    let mut tiers = vec![
        compressed_tier(now.compressed_policy, &now.compressed, &baseline.compressed, texels.bytes_read),
        memory_tier(now.decoded_policy, &now.decoded, &baseline.decoded),
    ];
    tiers.extend(gpu.map(|gpu| gpu_tier(gpu.policy, &gpu.stats, &gpu_baseline.map(|b| b.stats).unwrap_or_default())));
    proto::CacheStats { tiers, texels: Some(texels), datasets: datasets.collect(), strategy: strategy_message(now.strategy).into() }
}

/// Label of a tier.
pub fn tier_name(tier: &proto::CacheTierStats) -> &'static str {
    match tier.tier() {
        proto::CacheTier::Compressed => "compressed",
        proto::CacheTier::Gpu => "gpu",
        proto::CacheTier::Memory | proto::CacheTier::Unspecified => "memory",
    }
}

/// In the order of the tier's instruments.
pub fn tier_counts(t: &proto::CacheTierStats) -> [u64; 12] {
    let (prefetched, used, wasted) = (t.prefetched, t.prefetch_used, t.prefetch_wasted);
    [t.look_ups, t.hits, t.misses, t.evictions, t.bytes_in, t.used_bytes, t.peak_bytes, prefetched, used, wasted, t.uploads, t.budget_bytes]
}

/// In the order of the dataset's instruments.
pub fn dataset_counts(d: &proto::DatasetCacheStats) -> [u64; 20] {
    let t = d.texels.unwrap_or_default();
    [
        t.look_ups,
        t.look_ups.saturating_sub(t.misses),
        t.misses,
        t.texel_fetches,
        t.texel_misses,
        t.page_visits,
        t.visit_misses,
        t.coalesced,
        t.blocks_read,
        t.bytes_read,
        t.rows_decoded,
        t.bytes_decoded,
        t.rows_redundant,
        t.bytes_redundant,
        t.read_micros,
        t.decode_micros,
        t.wait_micros,
        d.used_bytes,
        d.peak_bytes,
        d.evictions,
    ]
}

pub(super) fn texel_stats(now: &CacheStats, before: &CacheStats) -> proto::TexelStats {
    let since = |get: fn(&CacheStats) -> u64| get(now).saturating_sub(get(before));
    proto::TexelStats {
        look_ups: since(|s| s.look_ups),
        misses: since(|s| s.misses),
        texel_fetches: since(|s| s.texel_fetches),
        texel_misses: since(|s| s.texel_misses),
        page_visits: since(|s| s.page_visits),
        visit_misses: since(|s| s.visit_misses),
        coalesced: since(|s| s.coalesced_waits),
        failed_reads: since(|s| s.failed_reads),
        uncached: since(|s| s.uncached),
        prefetches: since(|s| s.prefetches),
        blocks_read: since(|s| s.blocks_read),
        bytes_read: since(|s| s.bytes_read),
        rows_decoded: since(|s| s.rows_decoded),
        bytes_decoded: since(|s| s.bytes_decoded),
        rows_redundant: since(|s| s.rows_redundant),
        bytes_redundant: since(|s| s.bytes_redundant),
        read_micros: since(|s| s.read_nanos) / 1000,
        decode_micros: since(|s| s.decode_nanos) / 1000,
        wait_micros: since(|s| s.wait_nanos) / 1000,
    }
}

fn memory_tier(policy: PolicyKind, now: &CacheStats, before: &CacheStats) -> proto::CacheTierStats {
    let since = |get: fn(&CacheStats) -> u64| get(now).saturating_sub(get(before));
    proto::CacheTierStats {
        tier: proto::CacheTier::Memory.into(),
        policy: policy_message(policy).into(),
        budget_bytes: now.budget_bytes,
        used_bytes: now.resident_bytes,
        peak_bytes: now.peak_bytes,
        entries: now.resident_pages,
        look_ups: since(|s| s.look_ups),
        hits: since(|s| s.hits),
        misses: since(|s| s.misses),
        evictions: since(|s| s.evictions),
        bytes_in: since(|s| s.bytes_decoded),
        prefetched: since(|s| s.prefetches),
        prefetch_used: 0,
        prefetch_wasted: 0,
        uploads: 0,
    }
}

fn compressed_tier(policy: PolicyKind, now: &CompressedStats, before: &CompressedStats, bytes_read: u64) -> proto::CacheTierStats {
    let since = |get: fn(&CompressedStats) -> u64| get(now).saturating_sub(get(before));
    proto::CacheTierStats {
        tier: proto::CacheTier::Compressed.into(),
        policy: policy_message(policy).into(),
        budget_bytes: now.budget_bytes,
        used_bytes: now.resident_bytes,
        peak_bytes: now.peak_bytes,
        entries: now.resident_blocks,
        look_ups: since(|s| s.look_ups),
        hits: since(|s| s.hits),
        misses: since(|s| s.misses),
        evictions: since(|s| s.evictions),
        bytes_in: bytes_read,
        prefetched: 0,
        prefetch_used: 0,
        prefetch_wasted: 0,
        uploads: 0,
    }
}

fn gpu_tier(policy: PolicyKind, now: &GpuCacheStats, before: &GpuCacheStats) -> proto::CacheTierStats {
    let since = |get: fn(&GpuCacheStats) -> u64| get(now).saturating_sub(get(before));
    proto::CacheTierStats {
        tier: proto::CacheTier::Gpu.into(),
        policy: policy_message(policy).into(),
        budget_bytes: now.budget_bytes,
        used_bytes: now.device_bytes,
        peak_bytes: now.peak_device_bytes,
        entries: now.resident_pages,
        look_ups: since(|s| s.look_ups),
        hits: since(|s| s.hits),
        misses: since(|s| s.misses),
        evictions: since(|s| s.evictions),
        bytes_in: since(|s| s.bytes_uploaded),
        prefetched: since(|s| s.prefetched),
        prefetch_used: since(|s| s.prefetch_used),
        prefetch_wasted: since(|s| s.prefetch_wasted),
        uploads: since(|s| s.uploads),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_policy_and_strategy_goes_over_the_wire_and_back() {
        for kind in PolicyKind::ALL {
            assert_eq!(policy(policy_message(kind).into(), "p").unwrap(), Some(kind));
        }
        for strategy in ReadStrategy::ALL {
            assert_eq!(read_strategy(strategy_message(strategy).into(), "s").unwrap(), Some(strategy));
        }
        assert!(policy(99, "memory_policy").unwrap_err().to_string().starts_with("memory_policy"));
        assert!(read_strategy(99, "strategy").is_err());
    }

    #[test]
    fn a_change_is_checked_field_by_field() {
        let nothing = cache_change(&proto::ConfigureCacheRequest::default()).unwrap();
        assert_eq!(nothing, CacheChange::default());
        let too_much = proto::ConfigureCacheRequest { compressed_budget_bytes: Some(1 << 45), ..Default::default() };
        assert!(cache_change(&too_much).unwrap_err().to_string().starts_with("compressed_budget_bytes"));
        let aimless = proto::ConfigureCacheRequest { dataset: "teapot".into(), ..Default::default() };
        assert!(cache_change(&aimless).unwrap_err().to_string().starts_with("strategy"));
    }

    #[test]
    fn intervals_have_a_default_and_bounds() {
        assert_eq!(interval(0.0).unwrap().as_secs(), 1);
        for bad in [f64::NAN, -1.0, 0.01, 1e9, f64::INFINITY] {
            assert!(interval(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_lobe_is_bounded() {
        let request = |lobe_samples, lobe_exponent| proto::RecordTraceRequest { lobe_samples, lobe_exponent, ..Default::default() };
        assert_eq!(recording(&request(0, 0.0)).unwrap(), (PixelOrder::Buckets, None));
        assert_eq!(recording(&request(16, 0.0)).unwrap().1.map(|l| l.exponent), Some(DEFAULT_LOBE_EXPONENT));
        assert!(recording(&request(65, 0.0)).is_err() && recording(&request(1, f32::NAN)).is_err());
    }
}
