//! The server's memory under load: what the budgets allow, and little more.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use lumisphere_proto::v1alpha1 as wire;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};
use crate::wire::{camera_around, frame_request};

const MEMORY_BUDGET: u64 = 80 << 20;
const GPU_BUDGET: u64 = 80 << 20;

/// 400 points of 64² faces: 160 MB of f32 texels, twice each budget.
const LARGE: [&str; 14] = [
    "--points",
    "400",
    "--epsilon",
    "0.1",
    "--face-size-texels",
    "64",
    "--samples-per-texel",
    "1",
    "--max-bounces",
    "1",
    "--sample-map-size-texels",
    "16",
    "--pixel-format",
    "f32",
];

/// A camera on a circle around the box, looking at it.
fn around(step: usize) -> wire::Camera {
    camera_around(0.37 * step as f32, 160, 120)
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_keeps_its_budgets_while_a_capture_and_four_clients_run() {
    let folder = temporary_folder();
    let (memory, gpu) = (MEMORY_BUDGET.to_string(), GPU_BUDGET.to_string());
    let server = Server::start_with(&folder.path().join("data"), &["--memory-cache-bytes", &memory, "--gpu-cache-bytes", &gpu]);
    // The program itself: everything it needs was used once, on something small.
    tiny::capture_with(&server, folder.path(), "small", &QUICK);
    server.rendering().await.render_frame(frame_request("small")).await.unwrap();
    let program = server.resident_bytes();
    tiny::capture_with(&server, folder.path(), DATASET, &LARGE);

    server.forget_peak();
    let (done, frames) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let mut clients = Vec::new();
    for client in 0..4 {
        let (mut rendering, done, frames) = (server.rendering().await, done.clone(), frames.clone());
        clients.push(tokio::spawn(async move {
            // Each goes its own way around once, however fast the capture is.
            for step in 0.. {
                if step >= 20 && done.load(Ordering::SeqCst) {
                    return;
                }
                let request = wire::RenderFrameRequest { camera: Some(around(step + 4 * client)), ..frame_request(DATASET) };
                rendering.render_frame(request).await.unwrap();
                frames.fetch_add(1, Ordering::SeqCst);
            }
        }));
    }
    let again = tokio::task::block_in_place(|| tiny::capture_with(&server, folder.path(), "other", &LARGE));
    assert_eq!(again["state"], "SUCCEEDED");
    done.store(true, Ordering::SeqCst);
    for client in clients {
        client.await.unwrap();
    }
    let (peak, allowed) = (server.peak_bytes() - program, (MEMORY_BUDGET + GPU_BUDGET) * 6 / 5);
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    println!("{} frames; {:.0} MiB above the program's {:.0}", frames.load(Ordering::SeqCst), mib(peak), mib(program));
    assert!(peak <= allowed, "{:.0} MiB above the program's {:.0}, at most {:.0} expected", mib(peak), mib(program), mib(allowed));
}
