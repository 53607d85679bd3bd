//! One file a noun: its flags, what it asks of the server, how it prints the answer.

pub mod blob;
pub mod cache;
pub mod calibrate;
pub mod dataset;
mod download;
pub mod evaluate;
pub mod job;
pub mod load;
pub mod render;
pub mod stream;
pub mod system;
pub mod terminal;
mod watch;

use clap::CommandFactory;

use crate::cli::{Cli, Command};
use crate::context::Context;

/// Runs what the command line says.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::Dataset(command) => dataset::run(command, context).await,
        Command::Blob(command) => blob::run(command, context).await,
        Command::Job(command) => job::run(command, context).await,
        Command::Render(arguments) => render::run(&arguments, context).await,
        Command::Stream(arguments) => stream::run(&arguments, context).await,
        Command::Watch(arguments) => terminal::run(&arguments, context).await,
        Command::Evaluate(arguments) => evaluate::run(&arguments, context).await,
        Command::Calibrate(command) => calibrate::run(&command, context),
        Command::Load(arguments) => load::run(&arguments, context).await,
        Command::Cache(command) => cache::run(command, context).await,
        Command::System(command) => system::run(command, context).await,
        Command::Completions { shell } => {
            // Into memory first: the generator panics where standard output is closed.
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "lumisphere", &mut script);
            std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
            Ok(())
        }
    }
}
