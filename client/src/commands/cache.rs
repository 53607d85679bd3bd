//! `lumisphere cache …`.

pub mod laboratory;
pub mod recording;
mod stats;

use clap::Subcommand;
use lumisphere::textures::{PolicyKind, ReadStrategy};
use lumisphere_proto::v1alpha1 as wire;

use crate::cache_names::{policy_to_wire, strategy_to_wire};
use crate::context::Context;
use crate::exit::Failure;
use stats::{json, text};

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Sizes and counters of every tier and dataset
    Stats,
    /// The same again and again, until Ctrl-C
    Watch {
        /// Between two of them
        #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
        interval_seconds: f64,
    },
    /// Change budgets, policies and read strategies at once; not written to the server's configuration file
    Configure(ConfigureFlags),
    /// Drop every page that no frame in flight holds; nothing stored is touched
    Clear {
        /// Also set every counter to zero
        #[arg(long)]
        reset_counters: bool,
    },
    /// Record which texels frames ask for: of a camera path, or of all that is rendered for some seconds
    Record(Box<recording::Arguments>),
    /// Replay a recording under policies, read strategies and sizes, Belady's optimum among them
    Replay(laboratory::Arguments),
    /// Chart what `replay` wrote: misses against size, a line a policy
    Report(laboratory::ReportArguments),
}

/// Changes what is given.
#[derive(Debug, clap::Args)]
pub struct ConfigureFlags {
    /// Bytes of decoded pages held in memory; 0 holds none
    #[arg(long, value_name = "BYTES")]
    memory_budget_bytes: Option<u64>,
    /// Bytes of compressed blocks held in memory; 0 turns the tier off
    #[arg(long, value_name = "BYTES")]
    compressed_budget_bytes: Option<u64>,
    /// Bytes of the graphics adapter's memory
    #[arg(long, value_name = "BYTES")]
    gpu_budget_bytes: Option<u64>,
    /// Which decoded page leaves first: lru, clock, arc, s3_fifo, frame_lru or gittins
    #[arg(long, value_name = "POLICY")]
    memory_policy: Option<PolicyKind>,
    /// Which compressed block leaves first
    #[arg(long, value_name = "POLICY")]
    compressed_policy: Option<PolicyKind>,
    /// Which page leaves the adapter first
    #[arg(long, value_name = "POLICY")]
    gpu_policy: Option<PolicyKind>,
    /// What a miss decodes: on_demand, on_demand_restart, half_threshold, full_image or block
    #[arg(long, value_name = "STRATEGY")]
    strategy: Option<ReadStrategy>,
    /// Only of this dataset
    #[arg(long, value_name = "NAME", requires = "strategy")]
    dataset: Option<String>,
}

impl ConfigureFlags {
    fn to_wire(&self) -> anyhow::Result<wire::ConfigureCacheRequest> {
        let request = wire::ConfigureCacheRequest {
            memory_budget_bytes: self.memory_budget_bytes,
            compressed_budget_bytes: self.compressed_budget_bytes,
            gpu_budget_bytes: self.gpu_budget_bytes,
            memory_policy: self.memory_policy.map(policy_to_wire).unwrap_or_default().into(),
            compressed_policy: self.compressed_policy.map(policy_to_wire).unwrap_or_default().into(),
            gpu_policy: self.gpu_policy.map(policy_to_wire).unwrap_or_default().into(),
            strategy: self.strategy.map(strategy_to_wire).unwrap_or_default().into(),
            dataset: self.dataset.clone().unwrap_or_default(),
        };
        match request == wire::ConfigureCacheRequest::default() {
            true => Err(Failure::Usage("nothing to change: give at least one flag; see --help".into()).into()),
            false => Ok(request),
        }
    }
}

/// Runs one.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    let answer = match command {
        Command::Replay(arguments) => return laboratory::replay(&arguments, context).await,
        Command::Report(arguments) => return laboratory::report(&arguments, context),
        Command::Record(arguments) => return recording::run(&arguments, context).await,
        Command::Watch { interval_seconds } => return watch(interval_seconds, context).await,
        Command::Stats => context.connect().await?.cache().get_cache_stats(context.request(wire::GetCacheStatsRequest {})).await?,
        Command::Configure(flags) => {
            let request = flags.to_wire()?;
            context.connect().await?.cache().configure_cache(context.request(request)).await?
        }
        Command::Clear { reset_counters } => {
            let request = context.request(wire::ClearCacheRequest { reset_counters });
            context.connect().await?.cache().clear_cache(request).await?
        }
    };
    let now = answer.into_inner();
    context.output.document(&json(&now), || text(&now))?;
    Ok(())
}

async fn watch(interval_seconds: f64, context: &Context) -> anyhow::Result<()> {
    let request = context.patient_request(wire::WatchCacheStatsRequest { interval_seconds });
    let mut stream = context.connect().await?.cache().watch_cache_stats(request).await?.into_inner();
    while let Some(now) = stream.message().await? {
        context.output.line(&json(&now), || text(&now) + "\n")?;
    }
    Ok(())
}
