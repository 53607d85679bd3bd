//! Clients that come in twos, leave in the middle, or never answer.

use std::time::Instant;

use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::interact_request::Message as Up;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::viewers::{Transport, Viewer, opening};
use crate::wire::{camera, code_and_reason, frame_request};

/// A server that holds the tiny dataset.
pub async fn with_dataset() -> (tempfile::TempDir, Server) {
    with_dataset_and(&[]).await
}

/// The same with flags of the server's.
pub async fn with_dataset_and(flags: &[&str]) -> (tempfile::TempDir, Server) {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), flags);
    tiny::capture(&server, folder.path());
    (folder, server)
}

/// More pages than a viewer's frame waits for: the first one comes at once with coarse texels, the last one is the unary frame's equal.
#[tokio::test]
async fn a_viewer_sees_a_coarse_frame_first_and_then_the_whole_one() {
    let folder = temporary_folder();
    // Two pages of 16² texels of four f32.
    let server = Server::start_with(&folder.path().join("data"), &["--gpu-upload-bytes-per-frame", "8192"]);
    tiny::capture(&server, folder.path());
    if server.json(&["system", "info"])["adapter"] == "" {
        assert!(std::env::var_os("REQUIRE_GPU").is_none(), "no adapter");
        return;
    }
    let mut viewer = Viewer::open(&server, 16).await;
    viewer.pose(1, camera(320, 240)).await;
    let first = viewer.frame().await;
    assert!(!first.is_final, "the test needs a dataset whose frame exceeds the cap");
    let mut last = first.clone();
    while !last.is_final {
        viewer.acknowledge(last.frame_id).await;
        last = viewer.frame().await;
        assert_eq!(last.pose_id, 1);
    }
    let request = wire::RenderFrameRequest { camera: Some(camera(320, 240)), ..frame_request(DATASET) };
    let unary = server.rendering().await.render_frame(request).await.unwrap().into_inner();
    assert!(unary.is_final);
    assert_ne!(first.color, last.color, "the coarse frame shows what the whole one does");
    assert_eq!(unary.color, last.color);
    let stats = server.json(&["cache", "stats"]);
    let gpu = stats["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == "gpu").unwrap();
    let count = |key: &str| gpu[key].as_u64().unwrap();
    assert!(count("look_ups") > 0 && count("look_ups") == count("hits") + count("misses"), "{gpu:#}");
    assert!(count("used_bytes") <= count("budget_bytes") && count("bytes_in") > 0, "{gpu:#}");
    let changed = server.json(&["cache", "configure", "--gpu-policy", "clock", "--gpu-budget-bytes", "200000000"]);
    let gpu = changed["tiers"].as_array().unwrap().iter().find(|t| t["tier"] == "gpu").unwrap();
    assert_eq!((gpu["policy"].as_str(), gpu["budget_bytes"].as_u64()), (Some("clock"), Some(200_000_000)));
}

#[tokio::test]
async fn a_stream_that_is_not_opened_first_is_refused() {
    let (_folder, server) = with_dataset().await;
    let pose = wire::PoseUpdate { pose_id: 1, camera: Some(camera(8, 8)) };
    let messages = tokio_stream::iter([wire::InteractRequest { message: Some(Up::Pose(pose)) }]);
    let status = match server.rendering().await.interact(messages).await {
        Err(status) => status,
        Ok(stream) => stream.into_inner().message().await.unwrap_err(),
    };
    assert_eq!(code_and_reason(&status), (Code::FailedPrecondition, "INTERACTION_ORDER".into()));
}

#[tokio::test]
async fn clients_that_leave_in_the_middle_take_nothing_with_them() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--max-sessions", "2"]);
    tiny::capture(&server, folder.path());
    for round in 0..6 {
        let mut viewer = loop {
            // The place of one who left is free as soon as the server notices.
            match Viewer::open_as(&server, opening(2), Transport::Interact).await {
                Ok(viewer) => break viewer,
                Err(status) => assert_eq!(code_and_reason(&status).1, "TOO_MANY_SESSIONS", "{status:?}"),
            }
            tokio::task::yield_now().await;
        };
        viewer.pose(1, camera(320, 240)).await;
        if round % 2 == 0 {
            viewer.frame().await;
        }
        // Dropped: a reset in mid-stream.
        drop(viewer);
    }
    // A download and a watch that are dropped after their first message.
    let files = server.json(&["dataset", "files", DATASET]);
    let request = wire::DownloadBlobRequest {
        blake3: files["files"][1]["blake3"].as_str().unwrap().into(),
        offset: 0,
        dataset: DATASET.into(),
        version: 1,
    };
    let mut datasets = server.datasets().await;
    datasets.download_blob(request).await.unwrap().into_inner().message().await.unwrap();
    server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap();
    assert_eq!(server.stop(), Some(0));
}

#[tokio::test]
async fn a_mute_client_cannot_prolong_the_shutdown() {
    let (_folder, mut server) = with_dataset().await;
    let mut viewer = Viewer::open(&server, 1).await;
    viewer.pose(1, camera(32, 24)).await;
    viewer.frame().await;
    // From here on it says nothing and keeps the stream open. A bare connection says nothing at all.
    let _silent = std::net::TcpStream::connect(&server.address().host).unwrap();
    let asked = Instant::now();
    server.terminate();
    let status = tokio::task::spawn_blocking(move || server.ended()).await.unwrap();
    assert_eq!(status.code(), Some(0));
    // Two seconds of grace for streams, as much for jobs, and room for a slow machine.
    assert!(asked.elapsed().as_secs() < 30, "{:?}", asked.elapsed());
    drop(viewer);
}

#[tokio::test]
async fn two_clients_at_once_get_the_frames_that_each_asked_for() {
    let (_folder, server) = with_dataset().await;
    let alone = |width: u32| {
        let request = wire::RenderFrameRequest { camera: Some(camera(width, 24)), ..frame_request(DATASET) };
        let client = server.rendering();
        async move { client.await.render_frame(request).await.unwrap().into_inner().color }
    };
    let expected = [alone(40).await, alone(50).await];
    let client = |width: u32, expected: bytes::Bytes| {
        let connected = server.rendering();
        async move {
            let mut rendering = connected.await;
            for pose_id in 1..=20 {
                let request = wire::RenderFrameRequest { camera: Some(camera(width, 24)), pose_id, ..frame_request(DATASET) };
                let frame = rendering.render_frame(request).await.unwrap().into_inner();
                assert_eq!((frame.pose_id, frame.width_px), (pose_id, width));
                assert_eq!(frame.color, expected);
            }
        }
    };
    let [first, second] = expected;
    tokio::join!(client(40, first), client(50, second));
}

#[tokio::test]
async fn a_deadline_that_has_passed_costs_no_rendering() {
    let (_folder, server) = with_dataset().await;
    let mut request = tonic::Request::new(frame_request(DATASET));
    request.set_timeout(std::time::Duration::from_micros(1));
    let status = server.rendering().await.render_frame(request).await.unwrap_err();
    assert!(matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled), "{status:?}");
    server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap();
}
