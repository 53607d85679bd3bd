//! `--environment FILE`: other light from infinity than the scene's, from the file to the pixel.

use std::fs;
use std::path::Path;
use std::process::Output;

use lumisphere::images::{ExrStorage, Image, encode_exr_rgb};
use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};
use crate::wire::{camera, frame_request, raw_pixels};

/// W·sr⁻¹·m⁻², numbers that f16 has exactly.
const ABOVE: [f32; 3] = [4.0, 0.25, 1.5];
const BELOW: [f32; 3] = [0.5, 3.0, 0.125];

/// Latitude–longitude, 4 × 2 texels: one radiance above the horizon, another below.
fn sky() -> Vec<u8> {
    let mut image = Image::zeros(4, 2, 3);
    (0..8).for_each(|texel| image.set_rgb(texel, if texel < 4 { ABOVE } else { BELOW }));
    encode_exr_rgb(&image, ExrStorage::Float).unwrap()
}

/// Captures the tiny scene in the light of `environment` and waits for the end.
fn capture(server: &Server, folder: &Path, environment: &Path, more: &[&str]) -> Output {
    let scene = tiny::write_scene(&folder.join("scene"));
    let (scene, environment) = (scene.to_str().unwrap(), environment.to_str().unwrap());
    let base = ["job", "submit", "capture", "--scene", scene, "--environment", environment, "--object", "box", "--dataset", DATASET];
    server.lumisphere(&[&base[..], &["--watch", "--quiet", "--json"], more, &QUICK].concat())
}

#[tokio::test]
async fn a_captures_background_is_the_given_environment_times_its_scale() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let file = folder.path().join("sky.exr");
    fs::write(&file, sky()).unwrap();
    let output = capture(&server, folder.path(), &file, &["--environment-scale", "2"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    // Straight up, beside the box: nothing but sky, and of it only the row of texels around the pole.
    let vector = |x, y, z| Some(wire::Vector3 { x, y, z });
    let up = wire::Pose {
        position: vector(0.0, 1.0, 3.0),
        right: vector(1.0, 0.0, 0.0),
        up: vector(0.0, 0.0, 1.0),
        backward: vector(0.0, -1.0, 0.0),
    };
    let mut request = frame_request(DATASET);
    request.camera = Some(wire::Camera { pose: Some(up), ..camera(8, 8) });
    let frame = server.rendering().await.render_frame(request).await.unwrap().into_inner();
    for pixel in raw_pixels(&frame.color).chunks_exact(3) {
        assert_eq!(pixel, ABOVE.map(|v| 2.0 * v));
    }
    // Straight down, beside the floor: the other row.
    let down = wire::Pose {
        position: vector(0.0, -1.0, 5.0),
        right: vector(1.0, 0.0, 0.0),
        up: vector(0.0, 0.0, -1.0),
        backward: vector(0.0, 1.0, 0.0),
    };
    let mut request = frame_request(DATASET);
    request.camera = Some(wire::Camera { pose: Some(down), ..camera(8, 8) });
    let frame = server.rendering().await.render_frame(request).await.unwrap().into_inner();
    for pixel in raw_pixels(&frame.color).chunks_exact(3) {
        assert_eq!(pixel, BELOW.map(|v| 2.0 * v));
    }
}

#[test]
fn a_truncated_environment_fails_the_job_with_the_files_name() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let (file, whole) = (folder.path().join("half-a-sky.exr"), sky());
    fs::write(&file, &whole[..whole.len() / 2]).unwrap();
    let output = capture(&server, folder.path(), &file, &[]);
    assert_eq!(output.status.code(), Some(6));
    let error: Value = serde_json::from_slice(&output.stderr).unwrap();
    assert_eq!(error["error"]["reason"], "SCENE_INVALID", "{error:#}");
    assert!(error["error"]["message"].as_str().unwrap().contains("half-a-sky.exr"), "{error:#}");
    let listed = server.json(&["dataset", "get", DATASET]);
    assert_eq!(listed["latest_version"], 0, "{listed:#}");
}
