//! A replay's messages.

use lumisphere::textures::{CacheSnapshot, CacheStats, PolicyKind, ReadStrategy};

use super::cache::{policy, policy_message, read_strategy, strategy_message, texel_stats};
use super::proto;
use crate::errors::ApiError;

const MOST_OUTCOMES: usize = 256;

/// What to try, checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReplayPlan {
    /// How misses are read.
    pub strategies: Vec<ReadStrategy>,
    /// Which page leaves first.
    pub policies: Vec<PolicyKind>,
    /// Of the caches, in pages; 0 keeps nothing.
    pub sizes_pages: Vec<u32>,
    /// Of the trace.
    pub part: u32,
}

impl ReplayPlan {
    /// Every combination, strategies outermost.
    pub fn cells(&self) -> impl Iterator<Item = (ReadStrategy, PolicyKind, u32)> + '_ {
        let sizes = |strategy, policy| self.sizes_pages.iter().map(move |size| (strategy, policy, *size));
        self.strategies.iter().flat_map(move |strategy| self.policies.iter().flat_map(move |policy| sizes(*strategy, *policy)))
    }
}

/// Checked settings.
pub fn replay_plan(m: &proto::ReplaySettings) -> Result<ReplayPlan, ApiError> {
    let named = |field: &str, k: usize| format!("settings.{field}[{k}]");
    let missing = |field: String| ApiError::field(field, "unspecified, a known value expected");
    let mut strategies = Vec::new();
    for (k, value) in m.strategies.iter().enumerate() {
        let field = named("strategies", k);
        strategies.push(read_strategy(*value, &field)?.ok_or_else(|| missing(field))?);
    }
    let mut policies = Vec::new();
    for (k, value) in m.policies.iter().enumerate() {
        let field = named("policies", k);
        policies.push(policy(*value, &field)?.ok_or_else(|| missing(field))?);
    }
    let strategies = if strategies.is_empty() { ReadStrategy::ALL.to_vec() } else { strategies };
    let policies = if policies.is_empty() { PolicyKind::ALL.to_vec() } else { policies };
    let outcomes = [strategies.len(), policies.len(), m.sizes_pages.len()].into_iter().fold(1usize, usize::saturating_mul);
    if !(1..=MOST_OUTCOMES).contains(&outcomes) {
        return Err(ApiError::field("settings.sizes_pages", format!("{outcomes} outcomes, 1 to {MOST_OUTCOMES} expected")));
    }
    Ok(ReplayPlan { strategies, policies, sizes_pages: m.sizes_pages.clone(), part: m.part })
}

/// What a cache did, as outcome `done` of `total`.
pub fn replay_outcome(
    (strategy, policy, size_pages): (ReadStrategy, PolicyKind, u32),
    counted: &CacheSnapshot,
    nanos: u64,
    [done, total]: [usize; 2],
) -> proto::ReplayOutcome {
    proto::ReplayOutcome {
        strategy: strategy_message(strategy).into(),
        policy: policy_message(policy).into(),
        size_pages,
        texels: Some(texel_stats(&counted.decoded, &CacheStats::default())),
        micros: nanos / 1000,
        done: done as u32,
        total: total as u32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_bounded_and_nothing_stands_for_all() {
        let settings = |sizes_pages: Vec<u32>| proto::ReplaySettings { sizes_pages, ..Default::default() };
        let plan = replay_plan(&settings(vec![4, 8])).unwrap();
        assert_eq!(plan.cells().count(), ReadStrategy::ALL.len() * PolicyKind::ALL.len() * 2);
        let refused = |m: proto::ReplaySettings| replay_plan(&m).unwrap_err().to_string();
        assert!(refused(settings(vec![])).starts_with("settings.sizes_pages"));
        assert!(refused(settings(vec![1; 11])).contains("1 to 256"));
        assert!(refused(proto::ReplaySettings { policies: vec![1, 0], ..settings(vec![1]) }).starts_with("settings.policies[1]"));
        assert!(refused(proto::ReplaySettings { strategies: vec![99], ..settings(vec![1]) }).starts_with("settings.strategies[0]"));
    }
}
