//! Names of policies, strategies and tiers on the command line, and the wire's numbers for them.

use lumisphere::textures::{PolicyKind, ReadStrategy};
use lumisphere_proto::v1alpha1 as wire;

/// The wire's number.
pub fn strategy_to_wire(strategy: ReadStrategy) -> wire::ReadStrategy {
    match strategy {
        ReadStrategy::OnDemand => wire::ReadStrategy::OnDemand,
        ReadStrategy::OnDemandRestart => wire::ReadStrategy::OnDemandRestart,
        ReadStrategy::HalfThreshold => wire::ReadStrategy::HalfThreshold,
        ReadStrategy::FullImage => wire::ReadStrategy::FullImage,
        ReadStrategy::Block => wire::ReadStrategy::Block,
    }
}

/// The wire's number.
pub fn policy_to_wire(policy: PolicyKind) -> wire::CachePolicy {
    match policy {
        PolicyKind::Lru => wire::CachePolicy::Lru,
        PolicyKind::Clock => wire::CachePolicy::Clock,
        PolicyKind::Arc => wire::CachePolicy::Arc,
        PolicyKind::S3Fifo => wire::CachePolicy::S3Fifo,
        PolicyKind::FrameLru => wire::CachePolicy::FrameLru,
        PolicyKind::Gittins => wire::CachePolicy::Gittins,
    }
}

/// As the command line takes it; "unknown" for what this client does not know.
pub fn strategy_name(strategy: wire::ReadStrategy) -> &'static str {
    ReadStrategy::ALL.into_iter().find(|s| strategy_to_wire(*s) == strategy).map_or("unknown", ReadStrategy::name)
}

/// See `strategy_name`.
pub fn policy_name(policy: wire::CachePolicy) -> &'static str {
    PolicyKind::ALL.into_iter().find(|p| policy_to_wire(*p) == policy).map_or("unknown", PolicyKind::name)
}

/// See `strategy_name`.
pub fn tier_name(tier: wire::CacheTier) -> &'static str {
    match tier {
        wire::CacheTier::Compressed => "compressed",
        wire::CacheTier::Memory => "memory",
        wire::CacheTier::Gpu => "gpu",
        wire::CacheTier::Unspecified => "unknown",
    }
}
