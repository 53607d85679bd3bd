//! What a newcomer does: capture, list, render, evaluate, fetch; through the command line.

use std::fs;

use lumisphere::images::{ReadLimits, decode_image, decode_png_codes};
use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::wire::{frame_request, output, raw_pixels};

fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_scene_file_becomes_a_dataset_pictures_and_a_table_of_errors() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let job = tiny::capture(&server, folder.path());
    assert_eq!((job["state"].as_str(), job["result"]["dataset_version"].as_u64()), (Some("SUCCEEDED"), Some(1)), "{job:#}");

    let listed = server.json(&["dataset", "list"]);
    assert_eq!(listed["datasets"][0]["name"], DATASET);
    let version = &server.json(&["dataset", "get", DATASET])["versions"][0];
    // At least one cube map of six faces, and the baseline's.
    assert!(version["page_count"].as_u64().unwrap() >= 12, "{version:#}");
    let bounds = &version["object_bounds"];
    assert_eq!((bounds["min"][1].as_f64(), bounds["max"][1].as_f64()), (Some(0.5), Some(1.5)), "{version:#}");

    let out = folder.path().join("frames");
    let scene = folder.path().join("scene/scene.json");
    let render = |format: &str, more: &[&str]| {
        let base =
            ["render", "--dataset", DATASET, "--cameras", scene.to_str().unwrap(), "--component", "full", "--blend", "average", "--json"];
        lines(&server.succeed(&[&base[..], &["--format", format, "--out", out.to_str().unwrap()], more].concat()))
    };
    for (format, ending) in [("png", "png"), ("jpeg", "jpg"), ("exr", "exr")] {
        let frames = render(format, &["--force"]);
        assert_eq!((frames[0]["width_px"].as_u64(), frames[1]["camera"].as_str()), (Some(48), Some("side")));
        let image = decode_image(&fs::read(out.join(format!("frame-00001.{ending}"))).unwrap(), ReadLimits::SCENE).unwrap();
        assert_eq!((image.width, image.height), (48, 32), "{format}");
    }
    assert!(decode_png_codes(&fs::read(out.join("contact-sheet.png")).unwrap(), ReadLimits::SCENE).unwrap().width >= 96);

    // Raw and EXR are the same numbers, unary and streamed.
    let exr = decode_image(&fs::read(out.join("frame-00000.exr")).unwrap(), ReadLimits::SCENE).unwrap();
    for stream in [&[][..], &["--stream"]] {
        render("raw", &[&["--force"], stream].concat());
        let raw = raw_pixels(&fs::read(out.join("frame-00000.raw.zst")).unwrap());
        let interleaved: Vec<f32> = (0..48 * 32).flat_map(|i| exr.rgb(i)).collect();
        assert_eq!(raw, interleaved, "stream: {stream:?}");
        assert!(raw.iter().all(|v| v.is_finite() && *v >= 0.0) && raw.iter().any(|v| *v > 0.05), "no light in the frame");
    }

    let orbit = ["--frames", "2", "--size", "40x30", "--truth-samples-per-pixel", "4", "--max-bounces", "1"];
    let errors = folder.path().join("errors");
    let evaluated = server.json(&[&["evaluate", "--dataset", DATASET, "--out", errors.to_str().unwrap(), "--quiet"], &orbit[..]].concat());
    let rows = evaluated["summary"]["rows"].as_array().unwrap_or_else(|| panic!("{evaluated:#}"));
    // Reconstruction, by depth, too; and mirror by six blends and the baseline.
    assert_eq!(rows.len(), 9, "{evaluated:#}");
    for row in rows {
        assert!(row["rmse_rgb"][0].as_f64().is_some_and(|e| e.is_finite() && e >= 0.0), "{row:#}");
    }
    let files = evaluated["files"].as_array().unwrap();
    assert!(files.iter().any(|f| f.as_str().unwrap().contains("error")), "no per-pixel error image in {files:?}");
    for file in files {
        assert!(errors.join(file.as_str().unwrap()).metadata().unwrap().len() > 0, "{file}");
    }

    let jobs = server.json(&["job", "list"]);
    let kinds: Vec<&str> = jobs["jobs"].as_array().unwrap().iter().map(|j| j["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["evaluate", "capture"]);
    assert_eq!(server.stop(), Some(0));
}

#[test]
fn a_dataset_outlives_the_server_and_is_downloaded_whole() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    tiny::capture(&server, folder.path());
    assert_eq!(server.stop(), Some(0));

    let server = Server::start(&data);
    let out = folder.path().join("copy");
    let arguments = ["dataset", "download", DATASET, "--out", out.to_str().unwrap(), "--quiet"];
    let document = server.json(&arguments);
    let files = document["files"].as_array().unwrap();
    let role = |role: &str| files.iter().filter(|f| f["role"] == role).count();
    assert!(role("manifest") == 1 && role("segment") >= 1, "{document:#}");
    for file in files {
        let bytes = fs::read(out.join(file["name"].as_str().unwrap())).unwrap();
        assert_eq!(blake3::hash(&bytes).to_hex().as_str(), file["blake3"], "{file}");
    }
    // Again: nothing is fetched twice, nothing is in the way.
    server.json(&arguments);
    server.succeed(&["dataset", "delete", DATASET]);
    assert_eq!(server.json(&["dataset", "list"])["datasets"].as_array().unwrap().len(), 0);
}

#[test]
fn the_same_capture_has_the_same_bytes_for_one_and_two_threads() {
    let folder = temporary_folder();
    let segments = |threads: &str| {
        let server = Server::start_with(&folder.path().join(format!("data{threads}")), &["--job-threads", threads]);
        tiny::capture(&server, folder.path());
        let files = server.json(&["dataset", "files", DATASET]);
        let content = files["files"].as_array().unwrap().iter().filter(|f| f["role"] != "manifest");
        content.map(|f| f["blake3"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    let (one, two) = (segments("1"), segments("2"));
    assert!(!one.is_empty());
    assert_eq!(one, two);
}

#[tokio::test]
async fn a_frame_says_what_it_shows_and_where_the_time_went() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let mut rendering = server.rendering().await;
    let mut request = frame_request(DATASET);
    request.pose_id = 17;
    request.output = Some(wire::OutputSettings { want_depth: true, want_provenance: true, ..output(wire::Encoding::RawZstd) });
    let frame = rendering.render_frame(request.clone()).await.unwrap().into_inner();
    assert_eq!((frame.pose_id, frame.dataset.as_str(), frame.dataset_version, frame.is_final), (17, DATASET, 1, true));
    assert_eq!((frame.width_px, frame.height_px), (32, 24));
    assert_eq!(raw_pixels(&frame.color).len(), 3 * 32 * 24);
    let depth = raw_pixels(&frame.depth);
    // The box's front face is at z = 0.5, the camera at z = 3; the ray through the middle is half a pixel off the axis.
    assert!((depth[12 * 32 + 16] - 2.5).abs() < 0.01, "{}", depth[12 * 32 + 16]);
    assert!(depth[0].is_infinite() || depth[0] > 2.5, "{}", depth[0]);
    let provenance = zstd::decode_all(&frame.provenance[..]).unwrap();
    let middle = u32::from_le_bytes(provenance[4 * (12 * 32 + 16)..][..4].try_into().unwrap());
    assert_eq!(middle >> 30, 1, "the middle of the box is not a hit: {middle:#x}");
    let used = frame.camera.unwrap().intrinsics.unwrap();
    assert_eq!((used.focal_y_px, used.center_x_px), (24.0, Some(16.0)), "defaults are filled in");
    assert!(frame.timings.unwrap().render_micros > 0);

    // The second look at the same pages finds them.
    let again = rendering.render_frame(request).await.unwrap().into_inner();
    let cache = again.cache.unwrap();
    assert_eq!((cache.hits + cache.misses, cache.misses), (cache.look_ups, 0));
    assert_eq!(again.color, frame.color);
}
