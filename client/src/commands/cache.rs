//! `lumisphere cache …`.

use clap::Subcommand;
use lumisphere_proto::v1alpha1 as wire;

use crate::context::Context;
use crate::output::bytes_text;
use crate::views::CacheStats;

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Sizes and counters
    Stats,
    /// Change the budget at once; not written to the server's configuration file
    Configure {
        /// Bytes of decoded pages held in memory; 0 holds none
        #[arg(long, value_name = "BYTES")]
        memory_budget_bytes: u64,
    },
    /// Drop every page that no frame in flight holds; nothing stored is touched
    Clear {
        /// Also set every counter to zero
        #[arg(long)]
        reset_counters: bool,
    },
}

/// Runs one; each answers with the statistics.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    let mut client = context.connect().await?.cache();
    let answer = match command {
        Command::Stats => client.get_cache_stats(context.request(wire::GetCacheStatsRequest {})).await?,
        Command::Configure { memory_budget_bytes } => {
            let request = wire::ConfigureCacheRequest { memory_budget_bytes: Some(memory_budget_bytes) };
            client.configure_cache(context.request(request)).await?
        }
        Command::Clear { reset_counters } => client.clear_cache(context.request(wire::ClearCacheRequest { reset_counters })).await?,
    };
    let stats = answer.into_inner();
    context.output.document(&CacheStats::from(stats), || stats_text(&stats))?;
    Ok(())
}

fn stats_text(s: &wire::CacheStats) -> String {
    let rate = 100.0 * s.misses as f64 / s.look_ups.max(1) as f64;
    format!(
        "memory     {} of {} in {} pages\nlook-ups   {}: {} hits, {} misses ({rate:.2} %, {} coalesced)\nevictions  {}\nread       {}, decoded to {}",
        bytes_text(s.memory_used_bytes),
        bytes_text(s.memory_budget_bytes),
        s.memory_pages,
        s.look_ups,
        s.hits,
        s.misses,
        s.coalesced,
        s.evictions,
        bytes_text(s.read_bytes),
        bytes_text(s.decoded_bytes),
    )
}
