//! Downloads beside frames: on a link that is full of a download a frame waits for little of it.

use std::time::Duration;

use lumisphere_proto::v1alpha1 as wire;
use wire::datasets_client::DatasetsClient;

use crate::clients::with_dataset;
use crate::gate::{Gate, Looking, STEP_BYTES};
use crate::process::PATIENCE;
use crate::system::metric;

/// Several times what a kernel holds for a connection that does not get on.
const BLOB_BYTES: usize = 24 << 20;
/// Let through before a frame of 14 kB has come: both sockets, the frame, as much of the download in turn with it, and half as much again.
const MOST_BYTES: u64 = 384 << 10;

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_waits_for_little_of_a_download_of_the_same_connection() {
    let (folder, server) = with_dataset().await;
    let file = folder.path().join("noise.bin");
    let noise: Vec<u8> = (0..BLOB_BYTES as u64).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8).collect();
    std::fs::write(&file, noise).unwrap();
    let blake3 = server.json(&["blob", "upload", file.to_str().unwrap(), "--quiet"])["blake3"].as_str().unwrap().to_string();
    let gate = Gate::before(&server);
    let channel = gate.channel().await;
    let mut looking = Looking::open(channel.clone()).await;
    looking.look(1).await;
    looking.frame(PATIENCE).await.expect("a frame");

    let request = wire::DownloadBlobRequest { blake3, ..Default::default() };
    let mut chunks = DatasetsClient::new(channel).download_blob(request).await.unwrap().into_inner();
    chunks.message().await.unwrap().expect("it has begun");
    gate.set(Some(0));
    let downloading = tokio::spawn(async move { while chunks.message().await.is_ok_and(|chunk| chunk.is_some()) {} });
    // Rendered while the download fills whatever takes it.
    let before = metric(&server, "render_frames_total");
    looking.look(2).await;
    let began = std::time::Instant::now();
    while metric(&server, "render_frames_total") == before {
        assert!(began.elapsed() < PATIENCE, "no frame is rendered");
    }
    let mut passed = 0;
    let frame = loop {
        tokio::task::block_in_place(|| gate.let_through(STEP_BYTES));
        passed += STEP_BYTES;
        // Time to read what has passed.
        if let Some(frame) = looking.frame(Duration::from_millis(20)).await {
            break frame;
        }
        assert!(passed < BLOB_BYTES as u64 / 2, "no frame among {passed} bytes");
    };
    assert_eq!(frame.pose_id, 2);
    assert!(passed <= MOST_BYTES, "{passed} bytes passed before a frame of {}", frame.color.len());
    assert!(!downloading.is_finished(), "the download goes on");
    gate.set(None);
    downloading.await.unwrap();
}
