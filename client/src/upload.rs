//! Sends blobs: asks how much the server holds, sends the rest in order, begins again where a connection broke.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use anyhow::Context as _;
use bytes::Bytes;
use lumisphere_proto::MAX_CHUNK_BYTES;
use lumisphere_proto::v1alpha1 as wire;
use tonic::{Code, Status};
use wire::datasets_client::DatasetsClient;

use crate::context::Context;
use crate::exit;
use crate::progress::{Meter, Progress};

/// Attempts that may end without a single byte more at the server before we give up.
const FRUITLESS_ATTEMPTS: u32 = 5;
/// Before beginning again.
const PAUSE: Duration = Duration::from_millis(500);

/// Bytes with their name.
#[derive(Debug, Clone)]
pub struct Blob {
    /// 64 lower-case hexadecimal digits.
    pub blake3: String,
    /// Size.
    pub total_bytes: u64,
    source: Source,
}

#[derive(Debug, Clone)]
enum Source {
    Memory(Bytes),
    File(Arc<Mutex<File>>),
}

/// What an upload did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// Held before.
    pub resumed_at_bytes: u64,
    /// Sent now.
    pub sent_bytes: u64,
}

impl Blob {
    /// Of bytes in memory.
    pub fn from_bytes(bytes: Bytes) -> Self {
        Self { blake3: blake3::hash(&bytes).to_hex().to_string(), total_bytes: bytes.len() as u64, source: Source::Memory(bytes) }
    }

    /// Of a file, which is read twice: to name it and to send it. It must not change between.
    pub fn from_file(path: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot read {}", path.display());
        let mut hasher = blake3::Hasher::new();
        let mut file = File::open(path).with_context(cannot)?;
        hasher.update_reader(&mut file).with_context(cannot)?;
        let source = Source::File(Arc::new(Mutex::new(file)));
        Ok(Self { blake3: hasher.finalize().to_hex().to_string(), total_bytes: hasher.count(), source })
    }
}

impl Source {
    fn read(&self, offset: u64, length: usize) -> io::Result<Bytes> {
        match self {
            Self::Memory(bytes) => Ok(bytes.slice(offset as usize..offset as usize + length)),
            Self::File(file) => {
                let mut file = file.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                file.seek(SeekFrom::Start(offset))?;
                let mut data = vec![0; length];
                file.read_exact(&mut data)?;
                Ok(data.into())
            }
        }
    }
}

/// Uploads the blob unless the server has it. `stage` is what the meter shows.
pub async fn upload(
    context: &Context,
    client: &mut DatasetsClient<tonic::transport::Channel>,
    blob: &Blob,
    meter: &mut Meter,
    stage: &str,
) -> anyhow::Result<Sent> {
    let mut status = begin(context, client, blob).await?;
    let resumed_at_bytes = status.offset;
    let mut fruitless = 0;
    while !status.complete {
        meter.update(Progress { stage, done: status.offset, total: blob.total_bytes, seconds_left: None, detail: "" });
        match send_from(context, client, blob, status.offset).await {
            Ok(next) => status = next,
            Err(error) if fruitless < FRUITLESS_ATTEMPTS && is_worth_repeating(&error) => {
                tokio::time::sleep(PAUSE).await;
                let before = status.offset;
                status = begin(context, client, blob).await?;
                fruitless = if status.offset > before { 0 } else { fruitless + 1 };
            }
            Err(error) => return Err(error),
        }
    }
    let sent_bytes = blob.total_bytes.saturating_sub(resumed_at_bytes);
    Ok(Sent { resumed_at_bytes, sent_bytes })
}

async fn begin(context: &Context, client: &mut DatasetsClient<tonic::transport::Channel>, blob: &Blob) -> anyhow::Result<wire::BlobStatus> {
    let request = wire::BeginBlobRequest { blake3: blob.blake3.clone(), total_bytes: blob.total_bytes };
    Ok(client.begin_blob(context.request(request)).await?.into_inner())
}

async fn send_from(
    context: &Context,
    client: &mut DatasetsClient<tonic::transport::Channel>,
    blob: &Blob,
    offset: u64,
) -> anyhow::Result<wire::BlobStatus> {
    // An unreadable file ends the stream early; why is told afterwards.
    let unreadable = Arc::new(Mutex::new(None));
    let chunks = Chunks { blob: blob.clone(), offset, is_first: true, unreadable: unreadable.clone() };
    let answer = client.upload_blob(context.patient_request(tokio_stream::iter(chunks))).await;
    if let Some(error) = unreadable.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take() {
        return Err(anyhow::Error::from(error).context("cannot read the file to upload"));
    }
    let status = answer?.into_inner();
    anyhow::ensure!(status.complete || status.offset > offset, "the server took no byte of blob {} at offset {offset}", blob.blake3);
    Ok(status)
}

struct Chunks {
    blob: Blob,
    offset: u64,
    is_first: bool,
    unreadable: Arc<Mutex<Option<io::Error>>>,
}

impl Iterator for Chunks {
    type Item = wire::BlobChunk;

    fn next(&mut self) -> Option<wire::BlobChunk> {
        let left = self.blob.total_bytes - self.offset;
        // An empty blob is one empty chunk.
        if left == 0 && !(self.is_first && self.blob.total_bytes == 0) {
            return None;
        }
        let length = left.min(MAX_CHUNK_BYTES as u64) as usize;
        let data = match self.blob.source.read(self.offset, length) {
            Ok(data) => data,
            Err(error) => {
                *self.unreadable.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(error);
                return None;
            }
        };
        let blake3 = if self.is_first { self.blob.blake3.clone() } else { String::new() };
        let chunk = wire::BlobChunk { blake3, offset: self.offset, data, total_bytes: 0, is_last: false };
        self.offset += length as u64;
        self.is_first = false;
        Some(chunk)
    }
}

/// A connection that broke, or an upload that somebody else moved on or that was forgotten.
fn is_worth_repeating(error: &anyhow::Error) -> bool {
    let Some(status) = error.downcast_ref::<Status>() else { return false };
    match status.code() {
        Code::Unavailable => true,
        Code::FailedPrecondition => matches!(exit::reason(status).as_str(), "CHUNK_OUT_OF_ORDER" | "UPLOAD_NOT_BEGUN"),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chunks(blob: Blob, offset: u64) -> Vec<wire::BlobChunk> {
        Chunks { blob, offset, is_first: true, unreadable: Arc::default() }.collect()
    }

    #[test]
    fn chunks_cover_the_rest_in_order_and_only_the_first_is_named() {
        let bytes = Bytes::from(vec![7u8; 2 * MAX_CHUNK_BYTES + 5]);
        let sent = chunks(Blob::from_bytes(bytes.clone()), 10);
        assert_eq!(
            sent.iter().map(|c| (c.offset, c.data.len())).collect::<Vec<_>>(),
            [(10, MAX_CHUNK_BYTES), (10 + MAX_CHUNK_BYTES as u64, MAX_CHUNK_BYTES - 5)]
        );
        assert_eq!((sent[0].blake3.len(), sent[1].blake3.len()), (64, 0));
    }

    #[test]
    fn an_empty_blob_is_one_empty_chunk() {
        assert_eq!(chunks(Blob::from_bytes(Bytes::new()), 0).len(), 1);
    }

    #[test]
    fn a_file_and_its_bytes_have_one_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("f");
        std::fs::write(&path, b"light").unwrap();
        let (from_file, from_bytes) = (Blob::from_file(&path).unwrap(), Blob::from_bytes(Bytes::from_static(b"light")));
        assert_eq!((&from_file.blake3, from_file.total_bytes), (&from_bytes.blake3, 5));
        assert_eq!(chunks(from_file, 0), chunks(from_bytes, 0));
    }
}
