//! Stopping: who is told first, who gets grace, and that nobody can hold the server.

use std::io::Read;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

use crate::process::{PATIENCE, Server, temporary_folder};
use crate::system::get;

/// A stream that has no end of its own; its first message is read.
async fn watched(server: &Server) -> Streaming<HealthCheckResponse> {
    let mut health = HealthClient::new(server.channel().await);
    let mut changes = health.watch(HealthCheckRequest { service: String::new() }).await.unwrap().into_inner();
    assert_eq!(changes.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    changes
}

#[tokio::test(flavor = "multi_thread")]
async fn load_balancers_are_told_first_then_streams_have_their_grace_then_they_are_cut() {
    let folder = temporary_folder();
    let mut server = Server::start_with(&folder.path().join("data"), &["--shutdown-grace-seconds", "1"]);
    let mut changes = watched(&server).await;
    let mut silent = TcpStream::connect(&server.address().host).unwrap();
    // In the middle of an upload, and mute.
    let (_chunks, upload) = tokio::sync::mpsc::channel(1);
    let mut datasets = server.datasets().await;
    let upload = tokio::spawn(async move { datasets.upload_blob(ReceiverStream::new(upload)).await });

    let asked = Instant::now();
    server.terminate();
    assert_eq!(changes.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    // It takes no new work, and lives: whoever asks does not restart it.
    for (path, code) in [("/readyz", " 503 "), ("/healthz", " 200 ")] {
        let status = tokio::task::block_in_place(|| get(&server.http, path)).0;
        assert!(status.contains(code), "{path}: {status}");
    }
    let status = tokio::task::block_in_place(|| server.ended());
    assert_eq!(status.code(), Some(0), "{}", server.log_text());
    assert!(asked.elapsed() >= Duration::from_secs(1), "clients had no grace");
    assert!(upload.await.unwrap().is_err());
    // A connection that was never used is closed, not left hanging.
    silent.set_read_timeout(Some(PATIENCE)).unwrap();
    let last = silent.read(&mut [0; 64]);
    assert!(!last.is_err_and(|e| e.kind() == std::io::ErrorKind::WouldBlock));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_signal_ends_it_at_once() {
    let folder = temporary_folder();
    let mut server = Server::start_with(&folder.path().join("data"), &["--shutdown-grace-seconds", "3600"]);
    let mut changes = watched(&server).await;
    server.terminate();
    assert_eq!(changes.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    server.terminate();
    let status = tokio::task::block_in_place(|| server.ended());
    assert_eq!(status.code(), Some(130), "{}", server.log_text());
}

#[test]
fn an_idle_server_needs_no_grace() {
    let folder = temporary_folder();
    // Longer than `stop` waits.
    let server = Server::start_with(&folder.path().join("data"), &["--shutdown-grace-seconds", "3600"]);
    assert_eq!(server.stop(), Some(0));
}
