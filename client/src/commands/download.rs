//! Fetches blobs: hash-checked, resumed where an earlier download stopped, visible only when whole.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::Context as _;
use lumisphere_proto::v1alpha1 as wire;
use tonic::transport::Channel;
use wire::datasets_client::DatasetsClient;

use crate::context::Context;
use crate::exit::Failure;
use crate::files::Existing;
use crate::progress::{Meter, Progress};

/// What to fetch.
pub struct Wanted<'a> {
    /// Of the whole blob.
    pub blake3: &'a str,
    /// Where it belongs to a dataset: its name and version.
    pub dataset: Option<(&'a str, u64)>,
    /// What the meter shows.
    pub label: &'a str,
}

/// Fetches one blob into `path`. Bytes arrive in `path` + ".part", which a later call goes on with.
pub async fn download(
    context: &Context,
    client: &mut DatasetsClient<Channel>,
    wanted: &Wanted<'_>,
    path: &Path,
    existing: Existing,
    meter: &mut Meter,
) -> anyhow::Result<u64> {
    if existing == Existing::Keep && path.exists() {
        return Err(Failure::Precondition(format!("{} exists; --force overwrites", path.display())).into());
    }
    let part = path.with_file_name(format!("{}.part", path.file_name().unwrap_or_default().to_string_lossy()));
    let cannot = || format!("cannot write {}", part.display());
    let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&part).with_context(cannot)?;
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(&mut file).with_context(cannot)?;
    receive(context, client, wanted, &mut file, &mut hasher, meter).await?;
    if hasher.finalize().to_hex().as_str() != wanted.blake3 {
        // Of no use to a later attempt either.
        fs::remove_file(&part).with_context(cannot)?;
        anyhow::bail!("downloaded bytes of {} do not have the hash {}; they were discarded, try again", wanted.label, wanted.blake3);
    }
    file.sync_all().with_context(cannot)?;
    fs::rename(&part, path).with_context(|| format!("cannot rename {} to {}", part.display(), path.display()))?;
    Ok(hasher.count())
}

async fn receive(
    context: &Context,
    client: &mut DatasetsClient<Channel>,
    wanted: &Wanted<'_>,
    file: &mut File,
    hasher: &mut blake3::Hasher,
    meter: &mut Meter,
) -> anyhow::Result<()> {
    let (dataset, version) = wanted.dataset.unwrap_or_default();
    let request = wire::DownloadBlobRequest { blake3: wanted.blake3.into(), offset: hasher.count(), dataset: dataset.into(), version };
    let mut chunks = match client.download_blob(context.patient_request(request)).await {
        Ok(answer) => answer.into_inner(),
        // The part is longer than the blob: something else wrote it.
        Err(status) if status.code() == tonic::Code::InvalidArgument && hasher.count() > 0 => {
            restart(file, hasher)?;
            let request = wire::DownloadBlobRequest { blake3: wanted.blake3.into(), offset: 0, dataset: dataset.into(), version };
            client.download_blob(context.patient_request(request)).await?.into_inner()
        }
        Err(status) => return Err(status.into()),
    };
    loop {
        let chunk = chunks.message().await?.context("the server ended the download before its last chunk")?;
        anyhow::ensure!(chunk.offset == hasher.count(), "chunk at offset {} where {} was expected", chunk.offset, hasher.count());
        file.write_all(&chunk.data).context("cannot write the downloaded bytes")?;
        hasher.update(&chunk.data);
        meter.update(Progress { stage: wanted.label, done: hasher.count(), total: chunk.total_bytes, seconds_left: None, detail: "" });
        if chunk.is_last {
            return Ok(());
        }
    }
}

fn restart(file: &mut File, hasher: &mut blake3::Hasher) -> io::Result<()> {
    hasher.reset();
    file.set_len(0)?;
    file.seek(SeekFrom::Start(0)).map(|_| ())
}
