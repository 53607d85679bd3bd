//! `kill -9` in the middle of a capture, and a disk that is full or damaged: nothing published is lost, nothing half-written is seen.

use std::fs;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::JobState;

use crate::process::{Server, binary, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::wire::{code_and_reason, frame_request};

/// Long enough to be killed in the middle, short enough for a test.
pub const SLOW: [&str; 10] =
    ["--points", "120", "--face-size-texels", "32", "--samples-per-texel", "16", "--max-bounces", "2", "--sample-map-size-texels", "32"];

/// Hashes of all that a version stores but what tells times.
pub fn content_hashes(server: &Server, dataset: &str) -> Vec<String> {
    let files = server.json(&["dataset", "files", dataset]);
    let content = files["files"].as_array().unwrap().iter().filter(|f| f["role"] != "manifest" && f["name"] != "fit.json");
    content.map(|f| f["blake3"].as_str().unwrap().to_string()).collect()
}

/// Follows the job until the predicate holds or it ends; the job as it was then.
pub async fn follow_until(server: &Server, name: &str, reached: impl Fn(&wire::Job) -> bool) -> wire::Job {
    let request = wire::WatchJobRequest { name: name.into(), after_sequence: 0 };
    let mut events = server.jobs().await.watch_job(request).await.unwrap().into_inner();
    let mut last = None;
    while let Some(event) = events.message().await.unwrap() {
        let job = event.job.unwrap();
        if reached(&job) {
            return job;
        }
        last = Some(job);
    }
    last.expect("a watch begins with the present state")
}

fn submit_slow(server: &Server, folder: &Path) -> String {
    let scene = tiny::write_scene(&folder.join("scene"));
    let base = ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", DATASET];
    server.json(&[&base[..], &SLOW].concat())["name"].as_str().unwrap().to_string()
}

#[tokio::test]
async fn a_capture_that_is_killed_at_every_stage_publishes_the_same_bytes_once() {
    let folder = temporary_folder();
    let whole = Server::start(&folder.path().join("whole"));
    let name = submit_slow(&whole, folder.path());
    assert_eq!(follow_until(&whole, &name, |_| false).await.state(), JobState::Succeeded);
    let expected = content_hashes(&whole, DATASET);
    drop(whole);

    // Publishing is over in a moment, which a watcher may miss: then the capture is made once more.
    let mut seen = Vec::new();
    for round in 0..5 {
        seen = killed_at_every_stage(folder.path(), &folder.path().join(format!("killed{round}")), &expected).await;
        assert!(seen.iter().any(|stage| stage == "tracing cube maps half"), "killed only at {seen:?}");
        if seen.iter().any(|stage| stage == "publishing") {
            return;
        }
    }
    panic!("never killed while it published, only at {seen:?}");
}

/// Captures into `data`, killing the server at each stage when it is first seen, and at a long one once more in its middle. The stages.
async fn killed_at_every_stage(folder: &Path, data: &Path, expected: &[String]) -> Vec<String> {
    let mut server = Server::start(data);
    let name = submit_slow(&server, folder);
    let mut seen: Vec<String> = Vec::new();
    loop {
        let is_new = |job: &wire::Job| {
            let progress = job.progress.clone().unwrap_or_default();
            let half = format!("{} half", progress.stage);
            let is_half = 2 * progress.done > progress.total && progress.total > 50;
            !progress.stage.is_empty() && (!seen.contains(&progress.stage) || (is_half && !seen.contains(&half)))
        };
        let job = follow_until(&server, &name, is_new).await;
        if job.state() != JobState::Running {
            assert_eq!(job.state(), JobState::Succeeded, "{job:?}");
            assert_eq!(job.attempt as usize, seen.len() + 1);
            break;
        }
        let stage = job.progress.unwrap().stage;
        let label = if seen.contains(&stage) { format!("{stage} half") } else { stage };
        seen.push(label);
        server.kill();
        server = Server::start(data);
        let listed = server.json(&["dataset", "list"]);
        for dataset in listed["datasets"].as_array().unwrap() {
            let version = dataset["latest_version"].as_u64().unwrap();
            assert!(version == 0 || content_hashes(&server, DATASET) == expected, "a half-written version is visible: {listed:#}");
        }
    }
    let dataset = server.json(&["dataset", "get", DATASET]);
    assert_eq!(dataset["versions"].as_array().unwrap().len(), 1, "{dataset:#}");
    assert_eq!(content_hashes(&server, DATASET), expected, "killed at {seen:?}");
    server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap();
    seen
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|e| e.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

fn flip_a_byte(path: &Path, offset: u64) {
    let file = fs::File::options().read(true).write(true).open(path).unwrap();
    let mut byte = [0];
    file.read_exact_at(&mut byte, offset).unwrap();
    file.write_all_at(&[byte[0] ^ 0x55], offset).unwrap();
}

#[tokio::test]
async fn a_damaged_page_is_named_and_other_datasets_are_served() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    tiny::capture_with(&server, folder.path(), "first", &tiny::QUICK);
    let before: Vec<PathBuf> = files_below(&data.join("segments"));
    tiny::capture_with(&server, folder.path(), "second", &[&tiny::QUICK[..], &["--seed", "5"]].concat());
    assert_eq!(server.stop(), Some(0));

    let segment = files_below(&data.join("segments")).into_iter().find(|path| !before.contains(path)).expect("a second segment");
    // Everywhere but in the first record's head: whichever page is read first, a block of it is hit.
    let length = segment.metadata().unwrap().len();
    for offset in (length / 20..length).step_by((length / 400).max(1) as usize) {
        flip_a_byte(&segment, offset);
    }
    let server = Server::start(&data);
    let mut rendering = server.rendering().await;
    let status = rendering.render_frame(frame_request("second")).await.unwrap_err();
    assert_eq!(code_and_reason(&status), (Code::DataLoss, "DATA_CORRUPT".into()), "{status:?}");
    let file = segment.file_name().unwrap().to_str().unwrap();
    assert!(status.message().contains("page") || status.message().contains(file), "{status:?}");
    rendering.render_frame(frame_request("first")).await.unwrap();
    assert_eq!(server.stop(), Some(0));
}

#[tokio::test]
async fn a_damaged_index_is_rebuilt_and_everything_is_still_there() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    tiny::capture(&server, folder.path());
    let expected = server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap().into_inner().color;
    assert_eq!(server.stop(), Some(0));
    let files: Vec<PathBuf> = files_below(&data.join("index")).into_iter().filter(|p| p.metadata().unwrap().len() > 0).collect();
    assert!(!files.is_empty(), "the index has no file");
    for file in files {
        let length = file.metadata().unwrap().len();
        (0..length).step_by((length / 64).max(1) as usize).for_each(|offset| flip_a_byte(&file, offset));
    }
    let server = Server::start(&data);
    let frame = server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap().into_inner();
    assert_eq!(frame.color, expected);
    assert!(server.log_text().contains("the index was not as expected"), "the operator is not told:\n{}", server.log_text());
}

/// A server whose data folder is a file system of its own, of so many bytes, that ends with it; None where the kernel forbids it.
fn on_small_disk(mount: &Path, size: &str) -> Option<Server> {
    fs::create_dir_all(mount).unwrap();
    let unshare = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "--user", "--map-root-user", "sh", "-ec", script, "sh"]).arg(mount).arg(size);
        command
    };
    let allowed = unshare("mount -t tmpfs -o size=\"$2\" tmpfs \"$1\"").output().is_ok_and(|o| o.status.success());
    if !allowed {
        eprintln!("no mount namespaces here; the store's own tests fill a simulated disk");
        return None;
    }
    let script = format!("mount -t tmpfs -o size=\"$2\" tmpfs \"$1\"; shift 2; exec {:?} \"$@\"", binary("lumisphere-server"));
    Some(Server::spawn(&mut unshare(&script), &mount.join("data")))
}

#[tokio::test]
async fn a_full_disk_fails_the_capture_and_loses_nothing() {
    let folder = temporary_folder();
    let Some(server) = on_small_disk(&folder.path().join("mount"), "6m") else { return };
    tiny::capture(&server, folder.path());
    let large = ["--points", "600", "--face-size-texels", "64", "--samples-per-texel", "1", "--max-bounces", "1", "--pixel-format", "f32"];
    let scene = folder.path().join("scene/scene.json");
    let base = [
        "job",
        "submit",
        "capture",
        "--scene",
        scene.to_str().unwrap(),
        "--object",
        "box",
        "--dataset",
        "large",
        "--watch",
        "--json",
        "--quiet",
    ];
    let output = server.lumisphere(&[&base[..], &large].concat());
    assert_eq!(output.status.code(), Some(6), "{}", String::from_utf8_lossy(&output.stderr));
    let error: serde_json::Value = serde_json::from_slice(&output.stderr).unwrap();
    assert_eq!(error["error"]["reason"], "DISK_FULL", "{error:#}");
    server.rendering().await.render_frame(frame_request(DATASET)).await.unwrap();
    let versions = server.json(&["dataset", "list"]);
    let large = versions["datasets"].as_array().unwrap().iter().find(|d| d["name"] == "large");
    assert!(large.is_none_or(|d| d["latest_version"] == 0), "{versions:#}");
}
