//! `lumisphere blob …`.

use std::path::PathBuf;

use clap::Subcommand;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;

use super::download::{Wanted, download};
use crate::context::Context;
use crate::files::Existing;
use crate::output::bytes_text;
use crate::progress::Meter;
use crate::upload::{Blob, upload};

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Upload a file; goes on where an interrupted upload stopped, sends nothing that the server has
    Upload {
        /// The file
        file: PathBuf,
    },
    /// How much of a file's bytes the server holds
    Status {
        /// The file
        file: PathBuf,
    },
    /// Fetch bytes by their hash; goes on where an interrupted download stopped
    Download {
        /// 64 lower-case hexadecimal digits
        blake3: String,
        /// Into this file
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
        /// Overwrite the file
        #[arg(long)]
        force: bool,
    },
}

/// Runs one.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::Upload { file } => {
            let blob = Blob::from_file(&file)?;
            let mut client = context.connect().await?.datasets();
            context.on_interrupt(Some("the same command goes on where this one stopped".into()));
            let mut meter = Meter::new(context.output);
            let sent = upload(context, &mut client, &blob, &mut meter, "uploading").await?;
            meter.finish();
            let document = json!({"blake3": blob.blake3, "size_bytes": blob.total_bytes, "resumed_at_bytes": sent.resumed_at_bytes, "sent_bytes": sent.sent_bytes});
            context.output.document(&document, || format!("{}  {} sent", blob.blake3, bytes_text(sent.sent_bytes)))?;
        }
        Command::Status { file } => {
            let blob = Blob::from_file(&file)?;
            let mut client = context.connect().await?.datasets();
            let request = wire::BeginBlobRequest { blake3: blob.blake3, total_bytes: blob.total_bytes };
            let status = client.begin_blob(context.request(request)).await?.into_inner();
            let document =
                json!({"blake3": status.blake3, "size_bytes": blob.total_bytes, "offset": status.offset, "complete": status.complete});
            context.output.document(&document, || format!("{}  {} of {} bytes", status.blake3, status.offset, blob.total_bytes))?;
        }
        Command::Download { blake3, out, force } => {
            let mut client = context.connect().await?.datasets();
            context.on_interrupt(Some("the same command goes on where this one stopped".into()));
            let mut meter = Meter::new(context.output);
            let wanted = Wanted { blake3: &blake3, dataset: None, label: "downloading" };
            let size_bytes = download(context, &mut client, &wanted, &out, Existing::from_force(force), &mut meter).await?;
            meter.finish();
            context.output.document(&json!({"blake3": blake3, "size_bytes": size_bytes, "file": out}), || out.display().to_string())?;
        }
    }
    Ok(())
}
