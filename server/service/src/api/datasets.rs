//! Datasets and blobs.

use std::sync::Arc;
use std::time::Duration;

use lumisphere::textures::ContentHash;
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{Answers, Api, blocking};
use crate::catalog::{Catalog, Content, DatasetView, Progress};
use crate::errors::{ApiError, Reason};
use crate::wire::datasets::{damaged_version, dataset_files, dataset_version};
use crate::wire::proto::{self, datasets_server::Datasets};
use crate::wire::{self, MAX_CHUNK_BYTES};

/// An upload whose client sends nothing for so long is ended; what arrived is kept.
const CHUNK_PATIENCE: Duration = Duration::from_secs(60);
/// A download whose client takes nothing for so long is ended.
const DOWNLOAD_PATIENCE: Duration = Duration::from_secs(60);

#[tonic::async_trait]
impl Datasets for Api {
    async fn create_dataset(&self, request: Request<proto::CreateDatasetRequest>) -> Result<Response<proto::Dataset>, Status> {
        let name = wire::dataset_name(&request.into_inner().name, "name")?;
        let catalog = self.0.catalog.clone();
        let created = blocking(move || Ok(dataset(catalog.create(&name)?, None))).await?;
        Ok(Response::new(created))
    }

    async fn get_dataset(&self, request: Request<proto::GetDatasetRequest>) -> Result<Response<proto::Dataset>, Status> {
        let name = request.into_inner().name;
        let catalog = self.0.catalog.clone();
        let found = blocking(move || Ok(dataset(catalog.get(&name)?, Some(&catalog)))).await?;
        Ok(Response::new(found))
    }

    async fn list_datasets(&self, request: Request<proto::ListDatasetsRequest>) -> Result<Response<proto::ListDatasetsResponse>, Status> {
        let proto::ListDatasetsRequest { page_size, page_token } = request.into_inner();
        let count = wire::page_size(page_size, "page_size")?;
        if !page_token.is_empty() {
            wire::dataset_name(&page_token, "page_token")?;
        }
        let catalog = self.0.catalog.clone();
        let (page, more) = blocking(move || Ok(catalog.list(count, &page_token))).await?;
        let next_page_token = page.last().filter(|_| more).map(|d| d.name.clone()).unwrap_or_default();
        Ok(Response::new(proto::ListDatasetsResponse { datasets: page.into_iter().map(|d| dataset(d, None)).collect(), next_page_token }))
    }

    async fn delete_dataset(
        &self,
        request: Request<proto::DeleteDatasetRequest>,
    ) -> Result<Response<proto::DeleteDatasetResponse>, Status> {
        let name = request.into_inner().name;
        let app = self.0.clone();
        blocking(move || match app.jobs.is_writing(&name) {
            true => Err(ApiError::new(Reason::DatasetBusy, format!("dataset {name} is being written by a job"))),
            false => app.catalog.delete(&name),
        })
        .await?;
        Ok(Response::new(proto::DeleteDatasetResponse {}))
    }

    async fn list_dataset_files(
        &self,
        request: Request<proto::ListDatasetFilesRequest>,
    ) -> Result<Response<proto::ListDatasetFilesResponse>, Status> {
        let proto::ListDatasetFilesRequest { dataset, version } = request.into_inner();
        let catalog = self.0.catalog.clone();
        let files = blocking(move || Ok(dataset_files(&catalog.manifest(&dataset, version)?))).await?;
        Ok(Response::new(files))
    }

    async fn begin_blob(&self, request: Request<proto::BeginBlobRequest>) -> Result<Response<proto::BlobStatus>, Status> {
        self.0.accepting()?;
        let proto::BeginBlobRequest { blake3, total_bytes } = request.into_inner();
        let hash = wire::hash(&blake3, "blake3")?;
        let catalog = self.0.catalog.clone();
        let progress = blocking(move || catalog.uploads().begin(hash, total_bytes)).await?;
        Ok(Response::new(blob_status(hash, progress)))
    }

    async fn upload_blob(&self, request: Request<Streaming<proto::BlobChunk>>) -> Result<Response<proto::BlobStatus>, Status> {
        let mut chunks = request.into_inner();
        let mut known = None;
        loop {
            let chunk = timeout(CHUNK_PATIENCE, chunks.message()).await;
            let chunk = chunk.map_err(|_| ApiError::new(Reason::DeadlineExceeded, "no chunk came for a minute"))??;
            let Some(chunk) = chunk else { break };
            let hash = same_hash(&chunk, known)?;
            known = Some(hash);
            put(&self.0.catalog, hash, chunk).await?;
        }
        let hash = known.ok_or_else(|| ApiError::field("blake3", "missing: the stream held no chunk"))?;
        let catalog = self.0.catalog.clone();
        Ok(Response::new(blob_status(hash, blocking(move || catalog.uploads().progress(hash)).await?)))
    }

    async fn put_chunk(&self, request: Request<proto::BlobChunk>) -> Result<Response<proto::BlobStatus>, Status> {
        let chunk = request.into_inner();
        let hash = wire::hash(&chunk.blake3, "blake3")?;
        Ok(Response::new(blob_status(hash, put(&self.0.catalog, hash, chunk).await?)))
    }

    type DownloadBlobStream = Answers<proto::BlobChunk>;

    async fn download_blob(&self, request: Request<proto::DownloadBlobRequest>) -> Result<Response<Self::DownloadBlobStream>, Status> {
        let proto::DownloadBlobRequest { blake3, offset, dataset, version } = request.into_inner();
        let hash = wire::hash(&blake3, "blake3")?;
        let catalog = self.0.catalog.clone();
        let content = blocking(move || catalog.content(hash, &dataset, version)).await?;
        if offset > content.len() {
            return Err(ApiError::field("offset", format!("{offset}, at most the blob's {} bytes expected", content.len())).into());
        }
        let (chunks, answers) = mpsc::channel(2);
        tokio::spawn(send_chunks(content, blake3, offset, chunks));
        Ok(Response::new(Box::pin(ReceiverStream::new(answers))))
    }
}

/// The stream's blob: named by its first chunk, not changed by a later one.
fn same_hash(chunk: &proto::BlobChunk, known: Option<ContentHash>) -> Result<ContentHash, ApiError> {
    match (known, chunk.blake3.as_str()) {
        (Some(known), "") => Ok(known),
        (Some(known), text) if known.to_string() == text => Ok(known),
        (Some(_), _) => Err(ApiError::field("blake3", "another than in the stream's first chunk")),
        (None, text) => wire::hash(text, "blake3"),
    }
}

async fn put(catalog: &Arc<Catalog>, hash: ContentHash, chunk: proto::BlobChunk) -> Result<Progress, ApiError> {
    let catalog = catalog.clone();
    blocking(move || catalog.uploads().put(hash, chunk.offset, &chunk.data)).await
}

fn blob_status(hash: ContentHash, progress: Progress) -> proto::BlobStatus {
    proto::BlobStatus { blake3: hash.to_string(), offset: progress.offset, complete: progress.complete }
}

async fn send_chunks(content: Content, blake3: String, mut offset: u64, chunks: mpsc::Sender<Result<proto::BlobChunk, Status>>) {
    let total_bytes = content.len();
    let content = Arc::new(content);
    loop {
        let read = content.clone();
        let data = blocking(move || read.read(offset, MAX_CHUNK_BYTES)).await;
        let chunk = data.map_err(Status::from).map(|data| {
            let end = offset + data.len() as u64;
            // A file that became shorter than it was ends here too.
            let is_last = end >= total_bytes || data.is_empty();
            proto::BlobChunk { blake3: blake3.clone(), offset, data: data.into(), total_bytes, is_last }
        });
        let ended = chunk.as_ref().map_or(true, |c| c.is_last);
        offset += chunk.as_ref().map_or(0, |c| c.data.len() as u64);
        match timeout(DOWNLOAD_PATIENCE, chunks.send(chunk)).await {
            Ok(Ok(())) if !ended => {}
            // Sent all, or the client left, or it takes nothing.
            _ => return,
        }
    }
}

fn dataset(view: DatasetView, origins: Option<&Catalog>) -> proto::Dataset {
    let version = |(number, manifest): &(u64, Option<lumisphere::textures::Manifest>)| match manifest {
        Some(manifest) => dataset_version(manifest, origins.and_then(|c| c.origin(&view.name, *number))),
        None => damaged_version(*number),
    };
    let versions: Vec<_> = view.versions.iter().map(version).collect();
    proto::Dataset {
        kind: view.versions.iter().rev().find_map(|(_, m)| m.as_ref()).map(|m| m.kind.clone()).unwrap_or_default(),
        latest_version: versions.last().map_or(0, |v| v.version),
        create_time: versions.first().and_then(|v| v.create_time),
        versions,
        name: view.name,
    }
}
