//! `lumisphere dataset …`.

use std::path::PathBuf;

use clap::Subcommand;
use lumisphere_proto::v1alpha1 as wire;
use serde_json::json;

use super::download::{Wanted, download};
use crate::context::Context;
use crate::files::{Existing, prepare_folder, safe_name};
use crate::output::{bytes_text, table};
use crate::progress::Meter;
use crate::views;

/// Greatest page there is.
pub const PAGE_SIZE: i32 = 1000;

/// Verbs.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// All datasets
    List,
    /// One dataset with its versions
    Get {
        /// Its name
        name: String,
    },
    /// Reserve a name; a capture creates the dataset it names by itself
    Create {
        /// Its name: [a-z0-9][a-z0-9._-]{0,62}
        name: String,
    },
    /// Delete a dataset with all its versions, for good
    Delete {
        /// Its name
        name: String,
    },
    /// The files of one version
    Files {
        /// Its name
        name: String,
        /// Which version [default: the latest]
        #[arg(long, default_value_t = 0, hide_default_value = true)]
        version: u64,
    },
    /// Fetch all files of one version; goes on where an interrupted download stopped
    Download {
        /// Its name
        name: String,
        /// Which version [default: the latest]
        #[arg(long, default_value_t = 0, hide_default_value = true)]
        version: u64,
        /// Into this folder
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Overwrite files
        #[arg(long)]
        force: bool,
    },
}

/// Runs one.
pub async fn run(command: Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::List => list(context).await,
        Command::Get { name } => get(context, name).await,
        Command::Create { name } => create(context, name).await,
        Command::Delete { name } => delete(context, name).await,
        Command::Files { name, version } => files(context, name, version).await,
        Command::Download { name, version, out, force } => download_version(context, name, version, out, Existing::from_force(force)).await,
    }
}

async fn list(context: &Context) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    let mut datasets: Vec<views::Dataset> = Vec::new();
    let mut page_token = String::new();
    loop {
        let request = wire::ListDatasetsRequest { page_size: PAGE_SIZE, page_token };
        let page = client.list_datasets(context.request(request)).await?.into_inner();
        datasets.extend(page.datasets.into_iter().map(views::Dataset::from));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
    }
    context.output.document(&json!({"datasets": datasets}), || {
        let head = ["NAME", "KIND", "VERSION", "SIZE", "CREATED"].map(String::from).to_vec();
        let row = |d: &views::Dataset| {
            let size: u64 = d.versions.iter().map(|v| v.size_bytes).sum();
            vec![d.name.clone(), d.kind.clone(), d.latest_version.to_string(), bytes_text(size), d.create_time.clone().unwrap_or_default()]
        };
        table(&std::iter::once(head).chain(datasets.iter().map(row)).collect::<Vec<_>>(), &[2, 3])
    })?;
    Ok(())
}

async fn get(context: &Context, name: String) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    let dataset = views::Dataset::from(client.get_dataset(context.request(wire::GetDatasetRequest { name })).await?.into_inner());
    context.output.document(&dataset, || dataset_text(&dataset))?;
    Ok(())
}

fn dataset_text(dataset: &views::Dataset) -> String {
    let mut text = format!("{}  {}  latest version {}", dataset.name, dataset.kind, dataset.latest_version);
    for v in &dataset.versions {
        let created = v.create_time.as_deref().unwrap_or("");
        text.push_str(&format!("\nversion {}  {created}  {} pages  {}", v.version, v.page_count, bytes_text(v.size_bytes)));
        if let Some(bounds) = &v.object_bounds {
            text.push_str(&format!("\n  object within {:?} to {:?}", bounds.min, bounds.max));
        }
        text.push_str(&format!("\n  {}", v.parameters));
    }
    text
}

async fn create(context: &Context, name: String) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    let dataset = views::Dataset::from(client.create_dataset(context.request(wire::CreateDatasetRequest { name })).await?.into_inner());
    context.output.document(&dataset, || format!("created {}", dataset.name))?;
    Ok(())
}

async fn delete(context: &Context, name: String) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    client.delete_dataset(context.request(wire::DeleteDatasetRequest { name: name.clone() })).await?;
    context.output.document(&json!({"deleted": name}), || format!("deleted {name}"))?;
    Ok(())
}

async fn files(context: &Context, name: String, version: u64) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    let request = wire::ListDatasetFilesRequest { dataset: name.clone(), version };
    let answer = client.list_dataset_files(context.request(request)).await?.into_inner();
    let version = answer.version;
    let files: Vec<_> = answer.files.into_iter().map(views::DatasetFile::from).collect();
    context.output.document(&json!({"dataset": name, "version": version, "files": files}), || {
        let head = ["ROLE", "NAME", "SIZE", "BLAKE3"].map(String::from).to_vec();
        let row = |f: &views::DatasetFile| vec![f.role.to_string(), f.name.clone(), bytes_text(f.size_bytes), f.blake3.clone()];
        table(&std::iter::once(head).chain(files.iter().map(row)).collect::<Vec<_>>(), &[2])
    })?;
    Ok(())
}

async fn download_version(context: &Context, name: String, version: u64, out: PathBuf, existing: Existing) -> anyhow::Result<()> {
    let mut client = context.connect().await?.datasets();
    let request = wire::ListDatasetFilesRequest { dataset: name.clone(), version };
    let listed = client.list_dataset_files(context.request(request)).await?.into_inner();
    let names = listed.files.iter().map(|f| safe_name(&f.name).map(String::from)).collect::<anyhow::Result<Vec<_>>>()?;
    prepare_folder(&out, [], existing)?;
    let mut meter = Meter::new(context.output);
    let mut files = Vec::new();
    for (file, file_name) in listed.files.into_iter().zip(names) {
        let path = out.join(&file_name);
        // A file that is there and whole needs no second download: its name is its hash, or the hash is checked.
        if existing == Existing::Keep && path.exists() && crate::upload::Blob::from_file(&path)?.blake3 == file.blake3 {
            files.push(views::DatasetFile::from(file));
            continue;
        }
        let wanted = Wanted { blake3: &file.blake3, dataset: Some((&name, listed.version)), label: &file_name };
        download(context, &mut client, &wanted, &path, existing, &mut meter).await?;
        files.push(views::DatasetFile::from(file));
    }
    meter.finish();
    let document = json!({"dataset": name, "version": listed.version, "out": out, "files": files});
    context.output.document(&document, || format!("{name} version {}: {} files in {}", listed.version, files.len(), out.display()))?;
    Ok(())
}
