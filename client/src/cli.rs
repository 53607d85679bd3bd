//! The command line's grammar: noun, then verb. Each command's own flags are beside its code in `commands`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::commands;

/// Look at captured light from anywhere: datasets, jobs, frames and measurements of a Lumisphere server.
///
/// Results go to standard output, talk and progress to standard error.
/// Exit codes: 0 ok, 1 failure, 2 usage, 3 not found, 4 denied, 5 unavailable, 6 job failed, 7 precondition, 130 interrupted.
#[derive(Debug, Parser)]
#[command(name = "lumisphere", version, max_term_width = 120)]
pub struct Cli {
    #[command(flatten)]
    pub global: Global,
    #[command(subcommand)]
    pub command: Command,
}

/// Flags that every command takes.
#[derive(Debug, Clone, Args)]
pub struct Global {
    /// Server's address [default: `server` of the configuration file, else http://127.0.0.1:7443]
    #[arg(long, global = true, value_name = "URL", env = "LUMISPHERE_SERVER")]
    pub server: Option<String>,
    /// Whom to trust for an https:// server, PEM [default: `ca_certificate` of the configuration file, else whom the system trusts]
    #[arg(long, global = true, value_name = "FILE", env = "LUMISPHERE_CA_CERTIFICATE")]
    pub ca_certificate: Option<PathBuf>,
    /// Print JSON: one document, or one object a line where results come one by one; errors too
    #[arg(long, global = true)]
    pub json: bool,
    /// Longest time for one request; for watching, downloading and uploading, for the whole [default: 120 for a request, else none]
    #[arg(long, global = true, value_name = "SECONDS", env = "LUMISPHERE_TIMEOUT_SECONDS")]
    pub timeout_seconds: Option<f64>,
    /// No progress and no talk
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// Configuration file (TOML: server, ca_certificate, timeout_seconds) [default: ~/.config/lumisphere/client.toml, if there]
    #[arg(long, global = true, value_name = "FILE", env = "LUMISPHERE_CLIENT_CONFIG")]
    pub config: Option<PathBuf>,
}

/// Nouns.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Stored, versioned light
    #[command(subcommand)]
    Dataset(commands::dataset::Command),
    /// Bytes named by their BLAKE3: what scenes are uploaded as and job results are
    #[command(subcommand)]
    Blob(commands::blob::Command),
    /// Long work: capture, evaluate, render a path
    #[command(subcommand)]
    Job(commands::job::Command),
    /// Render frames into a folder
    Render(Box<commands::render::Arguments>),
    /// Film a path: frames in order into a folder, a video file or a pipe
    Stream(Box<commands::stream::Arguments>),
    /// Look at a dataset live, in this terminal
    Watch(Box<commands::terminal::Arguments>),
    /// Compare frames with path-traced truth at held-out poses and print the errors
    Evaluate(Box<commands::evaluate::Arguments>),
    /// Lens and poses of photographs of a flat surface, for `job submit import`
    #[command(subcommand)]
    Calibrate(commands::calibrate::Command),
    /// Let viewers ask for frames on a schedule and measure latency and cache misses
    Load(Box<commands::load::Arguments>),
    /// The server's texture cache
    #[command(subcommand)]
    Cache(commands::cache::Command),
    /// The server itself
    #[command(subcommand)]
    System(commands::system::Command),
    /// Print a completion script for a shell
    Completions {
        /// Which shell
        shell: clap_complete::Shell,
    },
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};

    #[test]
    fn the_grammar_is_consistent() {
        super::Cli::command().debug_assert();
    }

    #[test]
    fn evaluate_takes_a_dataset_or_a_verb_and_render_a_dataset_or_a_choice() {
        let exit_code = |line: &str| super::Cli::try_parse_from(line.split(' ')).map_or_else(|e| e.exit_code(), |_| 0);
        for good in ["evaluate --dataset d", "evaluate --dataset d --out o", "evaluate sweep f", "evaluate choose s --max-error 1"] {
            assert_eq!(exit_code(&format!("lumisphere {good}")), 0, "{good}");
        }
        for bad in ["evaluate", "evaluate --out o", "evaluate --dataset d sweep f", "evaluate sweep"] {
            assert_eq!(exit_code(&format!("lumisphere {bad}")), 2, "{bad}");
        }
        for (line, code) in
            [("--dataset d", 0), ("--choose s --max-error 1", 0), ("", 2), ("--dataset d --choose s", 2), ("--choose s --blend angle", 2)]
        {
            for command in ["render", "stream"] {
                assert_eq!(exit_code(format!("lumisphere {command} --out o {line}").trim_end()), code, "{command} {line}");
            }
        }
    }
}
