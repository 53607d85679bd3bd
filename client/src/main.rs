//! `lumisphere`, the command line: datasets, jobs, frames and measurements of a Lumisphere server.
//!
//! Results go to standard output, talk and progress to standard error; `docs/command-line.md` has the JSON objects and exit codes.

mod byte_sizes;
mod cache_names;
mod cameras;
mod choose_flags;
mod cli;
mod commands;
mod contact_sheet;
mod context;
mod exit;
mod files;
mod interaction;
mod normal_map_flags;
mod output;
mod photographs;
mod progress;
mod render_settings;
mod scene_source;
mod sections;
mod sweep_file;
mod target;
mod upload;
mod video;
mod viewer_path;
mod views;

use std::io;
use std::process::ExitCode;

use clap::Parser;

use crate::cli::Cli;
use crate::context::Context;
use crate::exit::Failure;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let json = cli.global.json;
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        // The reader of a pipe has what it wanted (`… | head`).
        Err(error) if error.downcast_ref::<io::Error>().is_some_and(|e| e.kind() == io::ErrorKind::BrokenPipe) => ExitCode::SUCCESS,
        Err(error) => exit::report(&error, json),
    }
}

fn run(cli: Cli) -> anyhow::Result<()> {
    let context = Context::new(cli.global)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        tokio::select! {
            // What asks no server is done in one go: Ctrl-C then ends the process as it does by default, until someone waits for it here.
            biased;
            result = commands::run(cli.command, &context) => result,
            _ = tokio::signal::ctrl_c() => Err(Failure::Interrupted { note: context.interrupt_note() }.into()),
        }
    })
}
