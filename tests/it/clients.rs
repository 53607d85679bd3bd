//! Clients that come in twos, leave in the middle, or never answer.

use std::time::Instant;

use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Streaming};
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::{Blend, Component};

use crate::process::{PATIENCE, Server, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::wire::{camera, code_and_reason, frame_request, output, settings};

/// A client of `Interact`.
pub struct Viewer {
    up: mpsc::Sender<wire::InteractRequest>,
    down: Streaming<wire::InteractResponse>,
}

impl Viewer {
    async fn open(server: &Server, credits: u32) -> Self {
        Self::open_with(server, credits, settings(Component::Full, Blend::Average)).await
    }

    /// Raw frames of the tiny dataset.
    pub async fn open_with(server: &Server, credits: u32, settings: wire::RenderSettings) -> Self {
        let (up, messages) = mpsc::channel(16);
        let open = wire::OpenInteraction {
            dataset: DATASET.into(),
            version: 0,
            settings: Some(settings),
            output: Some(output(wire::Encoding::RawZstd)),
            credits,
        };
        up.send(wire::InteractRequest { message: Some(Up::Open(open)) }).await.unwrap();
        let down = server.rendering().await.interact(ReceiverStream::new(messages)).await.unwrap().into_inner();
        let mut viewer = Self { up, down };
        match viewer.next().await {
            Some(Down::Opened(opened)) => assert_eq!((opened.dataset_version, opened.credits), (1, credits)),
            other => panic!("{other:?}"),
        }
        viewer
    }

    /// Any message.
    pub async fn send(&self, message: Up) {
        self.up.send(wire::InteractRequest { message: Some(message) }).await.unwrap();
    }

    /// A pose.
    pub async fn pose(&self, pose_id: u64, camera: wire::Camera) {
        self.send(Up::Pose(wire::PoseUpdate { pose_id, camera: Some(camera) })).await;
    }

    async fn next(&mut self) -> Option<Down> {
        tokio::time::timeout(PATIENCE, self.down.message()).await.expect("an answer in time").unwrap()?.message
    }

    /// The next answer, which must be a frame.
    pub async fn frame(&mut self) -> wire::Frame {
        match self.next().await {
            Some(Down::Frame(frame)) => frame,
            other => panic!("a frame expected, not {other:?}"),
        }
    }
}

async fn with_dataset() -> (tempfile::TempDir, Server) {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    (folder, server)
}

#[tokio::test]
async fn a_stream_gives_frames_for_credits_and_the_latest_pose_wins() {
    let (_folder, server) = with_dataset().await;
    let mut viewer = Viewer::open(&server, 1).await;
    viewer.pose(1, camera(32, 24)).await;
    let first = viewer.frame().await;
    assert_eq!((first.pose_id, first.frame_id), (1, 1));
    // Without the credit nothing comes, so of these three only the last can be shown.
    for pose_id in [2, 3, 4] {
        viewer.pose(pose_id, camera(32 + pose_id as u32, 24)).await;
    }
    // A rejected pose is answered at once, after the three: they have all arrived when the credit comes back.
    let mut bad = camera(32, 24);
    bad.pose.as_mut().unwrap().position.as_mut().unwrap().x = f32::NAN;
    viewer.pose(5, bad).await;
    match viewer.next().await {
        Some(Down::Status(status)) => assert_eq!((status.code, status.pose_id), (Code::InvalidArgument as i32, 5), "{status:?}"),
        other => panic!("a status expected, not {other:?}"),
    }
    viewer.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: 1 })).await;
    let latest = viewer.frame().await;
    assert_eq!((latest.pose_id, latest.width_px), (4, 36));
    // Streamed and unary frames are the same pixels.
    let request = wire::RenderFrameRequest { camera: Some(camera(36, 24)), ..frame_request(DATASET) };
    let unary = server.rendering().await.render_frame(request).await.unwrap().into_inner();
    assert_eq!(unary.color, latest.color);
    drop(viewer.up);
    assert_eq!(
        tokio::time::timeout(PATIENCE, viewer.down.message()).await.unwrap().unwrap(),
        None,
        "the stream ends with the client's half"
    );
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
        viewer.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: last.frame_id })).await;
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
            let (up, messages) = mpsc::channel(4);
            let open = wire::OpenInteraction {
                dataset: DATASET.into(),
                version: 0,
                settings: Some(settings(Component::Full, Blend::Average)),
                output: Some(output(wire::Encoding::RawZstd)),
                credits: 2,
            };
            up.send(wire::InteractRequest { message: Some(Up::Open(open)) }).await.unwrap();
            let answer = server.rendering().await.interact(ReceiverStream::new(messages)).await;
            let mut down = match answer {
                Ok(answer) => answer.into_inner(),
                Err(status) => {
                    assert_eq!(code_and_reason(&status).1, "TOO_MANY_SESSIONS", "{status:?}");
                    tokio::task::yield_now().await;
                    continue;
                }
            };
            match down.message().await {
                Ok(Some(_)) => break Viewer { up, down },
                Ok(None) => panic!("the stream ended unopened"),
                Err(status) => assert_eq!(code_and_reason(&status).1, "TOO_MANY_SESSIONS", "{status:?}"),
            }
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
    let _silent = std::net::TcpStream::connect(server.url.trim_start_matches("http://")).unwrap();
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
