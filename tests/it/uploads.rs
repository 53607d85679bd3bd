//! Blobs: in order, resumed, checked, and never visible before they are whole.

use bytes::Bytes;
use lumisphere_proto::MAX_CHUNK_BYTES;
use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use tonic::transport::Channel;
use tonic_types::StatusExt;
use wire::datasets_client::DatasetsClient;

use crate::process::{Server, temporary_folder};
use crate::wire::code_and_reason;

/// Three and a half chunks, no two equal.
fn content() -> Bytes {
    (0..7 * MAX_CHUNK_BYTES as u32 / 8).flat_map(|i| i.wrapping_mul(2_654_435_761).to_le_bytes()).collect::<Vec<u8>>().into()
}

fn name_of(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

fn chunk(blake3: &str, bytes: &Bytes, offset: usize, length: usize) -> wire::BlobChunk {
    let data = bytes.slice(offset..(offset + length).min(bytes.len()));
    wire::BlobChunk { blake3: blake3.into(), offset: offset as u64, data, total_bytes: 0, is_last: false }
}

async fn begin(client: &mut DatasetsClient<Channel>, blake3: &str, total: usize) -> Result<wire::BlobStatus, tonic::Status> {
    let request = wire::BeginBlobRequest { blake3: blake3.into(), total_bytes: total as u64 };
    client.begin_blob(request).await.map(tonic::Response::into_inner)
}

async fn download(client: &mut DatasetsClient<Channel>, blake3: &str, offset: u64) -> Result<Vec<u8>, tonic::Status> {
    let request = wire::DownloadBlobRequest { blake3: blake3.into(), offset, dataset: String::new(), version: 0 };
    let mut chunks = client.download_blob(request).await?.into_inner();
    let (mut bytes, mut ended) = (Vec::new(), false);
    while let Some(chunk) = chunks.message().await? {
        assert!(!ended && chunk.data.len() <= MAX_CHUNK_BYTES && chunk.offset == offset + bytes.len() as u64);
        bytes.extend_from_slice(&chunk.data);
        ended = chunk.is_last;
    }
    assert!(ended, "no last chunk");
    Ok(bytes)
}

#[tokio::test]
async fn chunks_out_of_order_too_large_or_not_announced_are_refused_and_the_upload_goes_on() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut client = server.datasets().await;
    let bytes = content();
    let name = name_of(&bytes);
    let early = client.put_chunk(chunk(&name, &bytes, 0, 10)).await.unwrap_err();
    assert_eq!(code_and_reason(&early), (Code::FailedPrecondition, "UPLOAD_NOT_BEGUN".into()));
    assert_eq!(begin(&mut client, &name, bytes.len()).await.unwrap().offset, 0);
    client.put_chunk(chunk(&name, &bytes, 0, MAX_CHUNK_BYTES)).await.unwrap();

    let skipped = client.put_chunk(chunk(&name, &bytes, 2 * MAX_CHUNK_BYTES, 10)).await.unwrap_err();
    assert_eq!(code_and_reason(&skipped), (Code::FailedPrecondition, "CHUNK_OUT_OF_ORDER".into()));
    assert_eq!(skipped.get_details_error_info().unwrap().metadata["expected_offset"], MAX_CHUNK_BYTES.to_string());
    let oversized = client.put_chunk(chunk(&name, &bytes, MAX_CHUNK_BYTES, MAX_CHUNK_BYTES + 1)).await.unwrap_err();
    assert_eq!(oversized.code(), Code::InvalidArgument);
    let invisible = download(&mut client, &name, 0).await.unwrap_err();
    assert_eq!(code_and_reason(&invisible), (Code::NotFound, "BLOB_NOT_FOUND".into()));

    let rest: Vec<_> = (1..4).map(|i| chunk(&name, &bytes, i * MAX_CHUNK_BYTES, MAX_CHUNK_BYTES)).collect();
    let status = client.upload_blob(tokio_stream::iter(rest)).await.unwrap().into_inner();
    assert!(status.complete);
    assert_eq!(download(&mut client, &name, 0).await.unwrap(), bytes);
    assert_eq!(download(&mut client, &name, 1_000_000).await.unwrap(), bytes[1_000_000..]);
    assert_eq!(download(&mut client, &name, bytes.len() as u64).await.unwrap(), Vec::<u8>::new());
    assert_eq!(download(&mut client, &name, bytes.len() as u64 + 1).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn bytes_that_do_not_have_their_hash_never_become_a_blob() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut client = server.datasets().await;
    let (promised, sent) = (Bytes::from_static(b"promised"), Bytes::from_static(b"somewhat"));
    let name = name_of(&promised);
    begin(&mut client, &name, promised.len()).await.unwrap();
    let status = client.put_chunk(chunk(&name, &sent, 0, 100)).await.unwrap_err();
    assert_eq!(code_and_reason(&status), (Code::DataLoss, "BLOB_HASH_MISMATCH".into()));
    assert_eq!(download(&mut client, &name, 0).await.unwrap_err().code(), Code::NotFound);
    // Discarded: it can be sent again, rightly.
    assert_eq!(begin(&mut client, &name, promised.len()).await.unwrap().offset, 0);
    assert!(client.put_chunk(chunk(&name, &promised, 0, 100)).await.unwrap().into_inner().complete);
    assert_eq!(download(&mut client, &name, 0).await.unwrap(), promised);
}

#[tokio::test]
async fn a_truncated_upload_waits_for_its_rest_and_bad_announcements_are_refused() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--max-blob-bytes", "5000000"]);
    let mut client = server.datasets().await;
    let bytes = content();
    let name = name_of(&bytes);
    begin(&mut client, &name, bytes.len()).await.unwrap();
    let half = client.upload_blob(tokio_stream::iter([chunk(&name, &bytes, 0, MAX_CHUNK_BYTES)])).await.unwrap().into_inner();
    assert_eq!((half.offset, half.complete), (MAX_CHUNK_BYTES as u64, false));
    assert_eq!(begin(&mut client, &name, bytes.len()).await.unwrap().offset, MAX_CHUNK_BYTES as u64);

    let large = begin(&mut client, &name_of(b"large"), 5_000_001).await.unwrap_err();
    assert_eq!(code_and_reason(&large), (Code::ResourceExhausted, "UPLOAD_TOO_LARGE".into()));
    for bad in ["", "abc", &"G".repeat(64), &"A".repeat(64)] {
        assert_eq!(begin(&mut client, bad, 10).await.unwrap_err().code(), Code::InvalidArgument, "{bad:?}");
    }
    let beyond = client.put_chunk(chunk(&name, &content(), MAX_CHUNK_BYTES, MAX_CHUNK_BYTES)).await;
    assert!(beyond.is_ok());
    let more_than_announced = Bytes::from(vec![0; 20]);
    let small = name_of(&[0; 10]);
    begin(&mut client, &small, 10).await.unwrap();
    let status = client.put_chunk(chunk(&small, &more_than_announced, 0, 20)).await.unwrap_err();
    assert!(matches!(status.code(), Code::InvalidArgument | Code::ResourceExhausted), "{status:?}");
}

#[tokio::test]
async fn an_upload_goes_on_after_the_server_was_killed() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let bytes = content();
    let name = name_of(&bytes);
    let server = Server::start(&data);
    let mut client = server.datasets().await;
    begin(&mut client, &name, bytes.len()).await.unwrap();
    for i in 0..2 {
        client.put_chunk(chunk(&name, &bytes, i * MAX_CHUNK_BYTES, MAX_CHUNK_BYTES)).await.unwrap();
    }
    server.kill();

    let server = Server::start(&data);
    let mut client = server.datasets().await;
    assert_eq!(download(&mut client, &name, 0).await.unwrap_err().code(), Code::NotFound, "half a blob is visible");
    let offset = begin(&mut client, &name, bytes.len()).await.unwrap().offset as usize;
    assert!(offset <= 2 * MAX_CHUNK_BYTES, "{offset}");
    let rest: Vec<_> = (offset..bytes.len()).step_by(MAX_CHUNK_BYTES).map(|at| chunk(&name, &bytes, at, MAX_CHUNK_BYTES)).collect();
    assert!(client.upload_blob(tokio_stream::iter(rest)).await.unwrap().into_inner().complete);
    assert_eq!(download(&mut client, &name, 0).await.unwrap(), bytes);
    assert_eq!(server.stop(), Some(0));
}
