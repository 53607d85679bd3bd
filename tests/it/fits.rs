//! `job submit fit` while it works: killed and gone on with, seen half-way, cancelled, bounded in bytes, on the GPU.

use std::fs;
use std::path::Path;

use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;
use wire::JobState;

use crate::killed::{content_hashes, follow_until};
use crate::prefetch::has_adapter;
use crate::process::{Server, temporary_folder};
use crate::wire::{camera_around, output};

/// A square with a highlight under one lamp.
const SCENE: &str = r#"{"format": "neutral-scene/1",
    "materials": {"red": {"type": "phong", "diffuse": [0.5, 0.06, 0.06], "specular": [0.3, 0.3, 0.3], "exponent": 20}},
    "objects": [
        {"name": "plane", "shape": {"type": "rect", "corner": [-0.5, 0, 0.5], "edge_u": [1, 0, 0], "edge_v": [0, 0, -1]}, "material": "red"}],
    "lights": [{"type": "disc", "center": [1.5, 2, -1.5], "normal": [-1.5, -2, 1.5], "radius": 0.1, "radiance": [600, 600, 600]}],
    "environment": {"radiance": [0.05, 0.05, 0.05]},
    "cameras": [{"name": "a", "origin": [0, 1, 3], "target": [0, 0, 0], "vfov_deg": 40, "width": 64, "height": 48}]}"#;

/// Five batches of texels: some are fitted, some are not.
pub const TEXELS: u64 = 96 * 96;

pub fn observe(server: &Server, folder: &Path) {
    let scene = folder.join("scene.json");
    fs::write(&scene, SCENE).unwrap();
    let submit = ["job", "submit", "observe", "--scene", scene.to_str().unwrap(), "--object", "plane", "--dataset", "seen"];
    let quick = ["--size-texels", "96", "--samples-per-observation", "4", "--max-bounces", "1", "--directions", "icosahedron:73"];
    server.json(&[&submit[..], &quick, &["--watch", "--quiet"]].concat());
}

pub fn submit(server: &Server, into: &str, flags: &[&str]) -> String {
    let fit = ["job", "submit", "fit", "--observations", "seen", "--dataset", into];
    server.json(&[&fit[..], flags].concat())["name"].as_str().unwrap().to_string()
}

pub fn fit_of(job: &wire::Job) -> wire::FitProgress {
    job.progress.clone().and_then(|p| p.fit).unwrap_or_default()
}

pub fn latest(server: &Server, dataset: &str) -> Option<u64> {
    let listed = server.json(&["dataset", "list"]);
    let found = listed["datasets"].as_array().unwrap().iter().find(|d| d["name"] == dataset)?;
    found["latest_version"].as_u64()
}

fn report(server: &Server, job: &str) -> Value {
    server.json(&["job", "get", job])["result"]["summary"].clone()
}

/// With a bound on bytes, so that there is a choice to make behind the fits.
#[tokio::test]
async fn a_fit_that_is_killed_at_every_stage_goes_on_and_publishes_the_same_bytes_once() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let mut server = Server::start(&data);
    observe(&server, folder.path());
    let flags = ["--model", "phong:2", "--robust", "--polish", "--max-bytes", "300kB"];
    let undisturbed = submit(&server, "map", &flags);
    assert_eq!(follow_until(&server, &undisturbed, |_| false).await.state(), JobState::Succeeded);
    let expected = content_hashes(&server, "map");

    let name = submit(&server, "again", &flags);
    let mut seen: Vec<String> = Vec::new();
    let label = |job: &wire::Job| {
        let progress = job.progress.clone().unwrap_or_default();
        let is_half = 2 * progress.done > progress.total && progress.done < progress.total;
        format!("{}{}", progress.stage, if is_half { " half" } else { "" })
    };
    loop {
        let job = follow_until(&server, &name, |job| !label(job).is_empty() && !seen.contains(&label(job))).await;
        if job.state() != JobState::Running {
            assert_eq!(job.state(), JobState::Succeeded, "{job:?}");
            assert_eq!(job.attempt as usize, seen.len() + 1);
            break;
        }
        seen.push(label(&job));
        server.kill();
        server = Server::start(&data);
        let version = latest(&server, "again").unwrap_or_default();
        assert!(version == 0 || content_hashes(&server, "again") == expected, "a half-written version is visible");
    }
    assert!(seen.contains(&"fitting half".to_string()), "killed only at {seen:?}");
    assert_eq!((latest(&server, "again"), content_hashes(&server, "again")), (Some(1), expected), "killed at {seen:?}");
    // The last attempt fitted what none before it had, and all switches are as they were asked for.
    let (whole, resumed) = (report(&server, &undisturbed), report(&server, &name));
    assert_eq!((&whole["fit"]["texels_of_this_run"], &whole["fit"]["texels"]), (&TEXELS.into(), &TEXELS.into()));
    assert!(resumed["fit"]["texels_of_this_run"].as_u64().unwrap() < TEXELS, "{resumed:#}");
    assert_eq!((&resumed["parameters"], &resumed["fit"]["histogram"]), (&whole["parameters"], &whole["fit"]["histogram"]));
    assert_eq!((&resumed["parameters"]["outliers"], &resumed["parameters"]["precision"]), (&"reject".into(), &"polished".into()));
    let shown = server.succeed(&["job", "get", &name]);
    assert!(shown.contains("models phong:2, outliers rejected, polished, at most"), "{shown}");
}

#[tokio::test]
async fn a_bound_on_bytes_holds_through_the_command_line_and_says_what_it_did() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    observe(&server, folder.path());
    let sized = |into: &str, bytes: &str| {
        let fit = ["job", "submit", "fit", "--observations", "seen", "--dataset", into, "--model", "phong:2", "--max-bytes", bytes];
        server.json(&[&fit[..], &["--watch", "--quiet"]].concat())["result"]["summary"].clone()
    };
    let (small, large) = (sized("small", "150kB"), sized("large", "10MB"));
    for (summary, asked) in [(&small, 150_000), (&large, 10_000_000)] {
        let stored = summary["stored_bytes"].as_u64().unwrap();
        let told = summary["fit"]["budget"]["bytes"].as_u64().unwrap();
        assert!(stored <= told && told <= asked, "{stored} stored, {told} told, {asked} asked");
        assert_eq!(summary["parameters"]["max_bytes"], asked);
    }
    assert!(small["fit"]["rms_residual"].as_f64() > large["fit"]["rms_residual"].as_f64(), "{small:#}");
    assert_eq!(large["fit"]["budget"]["texels_reduced"], 0);
    let refused =
        server.lumisphere(&["job", "submit", "fit", "--observations", "seen", "--dataset", "none", "--max-bytes", "1kB", "--watch"]);
    let text = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && text.contains("1000 bytes for a map that takes"), "{text}");
    assert_eq!(latest(&server, "none"), Some(0));
    assert!(fs::read_dir(folder.path().join("data/staging")).unwrap().next().is_none(), "a failed fit leaves something behind");
}

fn frame(dataset: &str) -> wire::RenderFrameRequest {
    let map = wire::ParameterMapSettings::default();
    let settings =
        wire::RenderSettings { representation: Some(wire::render_settings::Representation::ParameterMap(map)), ..Default::default() };
    let output = wire::OutputSettings { want_provenance: true, ..output(wire::Encoding::RawZstd) };
    wire::RenderFrameRequest {
        dataset: dataset.into(),
        version: 0,
        camera: Some(camera_around(0.3, 64, 48)),
        settings: Some(settings),
        output: Some(output),
        pose_id: 0,
    }
}

/// How many pixels are hits or filled, and how many are unknown.
async fn answers(server: &Server, dataset: &str) -> (usize, usize) {
    let frame = server.rendering().await.render_frame(frame(dataset)).await.unwrap().into_inner();
    let provenance = zstd::decode_all(&frame.provenance[..]).unwrap();
    let answers: Vec<u8> = provenance.chunks_exact(4).map(|p| p[3] >> 6).collect();
    (answers.iter().filter(|a| matches!(a, 1 | 2)).count(), answers.iter().filter(|a| **a == 3).count())
}

#[tokio::test]
async fn what_is_fitted_so_far_can_be_rendered_survives_a_kill_and_goes_with_the_job() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    observe(&server, folder.path());
    let eager = ["--model", "sh:36", "--publish-every", "0.001"];
    let name = submit(&server, "map", &eager);
    let job = follow_until(&server, &name, |job| !fit_of(job).partial_dataset.is_empty()).await;
    let so_far = fit_of(&job);
    assert_eq!((job.state(), so_far.partial_dataset.as_str()), (JobState::Running, "map-partial"));
    assert!(so_far.texels > 0 && so_far.texels < TEXELS && so_far.texels_per_second > 0.0, "{so_far:?}");
    assert_eq!(so_far.histogram.get("sh:36"), Some(&so_far.texels));
    server.kill();

    // Without its record nobody goes on with the job: what was published can be looked at in peace.
    let (record, aside) = (data.join("jobs").join(&name).with_extension("json"), folder.path().join("record"));
    fs::rename(&record, &aside).unwrap();
    let server = Server::start(&data);
    assert_eq!(latest(&server, "map"), Some(0));
    let versions = server.json(&["dataset", "get", "map-partial"])["versions"].clone();
    assert_eq!(versions.as_array().unwrap().len(), 1, "{versions:#}");
    let partial = &versions[0]["parameters"]["partial"];
    assert!(partial["texels_fitted"].as_u64().unwrap() < TEXELS && partial["texels"] == TEXELS, "{versions:#}");
    let (known, unknown) = answers(&server, "map-partial").await;
    assert!(known > 20 && unknown > 20, "{known} pixels are known, {unknown} unknown");
    server.kill();

    fs::rename(&aside, &record).unwrap();
    let server = Server::start(&data);
    assert_eq!(follow_until(&server, &name, |_| false).await.state(), JobState::Succeeded);
    assert_eq!((latest(&server, "map"), latest(&server, "map-partial")), (Some(1), None));
    let (all, none) = answers(&server, "map").await;
    assert!(all > known && none == 0, "{all} pixels are known at the end, {known} before, {none} unknown");

    // A fit that is cancelled leaves nothing either.
    let name = submit(&server, "other", &eager);
    follow_until(&server, &name, |job| !fit_of(job).partial_dataset.is_empty()).await;
    server.succeed(&["job", "cancel", &name]);
    assert_eq!(follow_until(&server, &name, |_| false).await.state(), JobState::Cancelled);
    assert_eq!((latest(&server, "other"), latest(&server, "other-partial")), (Some(0), None));
    assert!(fs::read_dir(data.join("staging")).unwrap().next().is_none(), "a cancelled fit leaves something behind");

    // Someone else's dataset of that name stays as it is.
    submit_and_wait(&server, "mine-partial", &["--model", "constant"]).await;
    let name = submit(&server, "mine", &eager);
    let refused = follow_until(&server, &name, |_| false).await;
    assert!(refused.state() == JobState::Failed && refused.error.as_ref().unwrap().message.contains("mine-partial holds"), "{refused:?}");
    assert_eq!(latest(&server, "mine-partial"), Some(1));
}

async fn submit_and_wait(server: &Server, into: &str, flags: &[&str]) {
    let name = submit(server, into, flags);
    assert_eq!(follow_until(server, &name, |_| false).await.state(), JobState::Succeeded);
}

#[test]
fn watching_a_fit_tells_its_rate_models_and_flags() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    observe(&server, folder.path());
    let name = submit(&server, "map", &["--model", "phong:1"]);
    let lines = server.succeed(&["job", "watch", &name, "--json"]);
    let events: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let fits = events.iter().map(|e| &e["job"]["progress"]["fit"]).filter(|fit| fit.is_object()).collect::<Vec<_>>();
    let last = fits.last().expect("an event with figures");
    assert_eq!((&last["texels"], &last["histogram"]["phong:1"]), (&TEXELS.into(), &TEXELS.into()), "{last:#}");
    assert!(last["texels_per_second"].as_f64().unwrap() > 0.0 && last["flags"]["misfit"].is_u64(), "{last:#}");
    let texels: Vec<u64> = fits.iter().map(|fit| fit["texels"].as_u64().unwrap()).collect();
    assert!(texels.is_sorted(), "{texels:?}");
    let fit = &report(&server, &name)["fit"];
    for key in ["texels_per_second", "rms_residual", "median_residual", "p95_residual"] {
        assert!(fit[key].as_f64().is_some_and(|n| n > 0.0), "{key}: {fit:#}");
    }
    assert!(fit["median_residual"].as_f64() <= fit["p95_residual"].as_f64());
    let shown = server.succeed(&["job", "get", &name]);
    assert!(shown.contains("texels/s") && shown.contains("residual: rms"), "{shown}");
}

/// On the GPU; killed half-way, it goes on; where the server no longer uses an adapter it says so and leaves nothing.
#[tokio::test]
async fn a_fit_on_the_gpu_finds_the_cpus_models_goes_on_when_killed_and_is_never_the_cpus_instead() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    observe(&server, folder.path());
    if !has_adapter(&server) {
        return;
    }
    let gpu = ["--model", "phong:1", "--backend", "gpu"];
    let (on_cpu, on_gpu) = (submit(&server, "cpu", &gpu[..2]), submit(&server, "gpu", &gpu));
    for (name, backend) in [(&on_cpu, "cpu"), (&on_gpu, "gpu")] {
        assert_eq!(follow_until(&server, name, |_| false).await.state(), JobState::Succeeded);
        assert_eq!(server.json(&["job", "get", name])["fit"]["backend"], backend);
    }
    let (expected, found) = (report(&server, &on_cpu)["fit"].clone(), report(&server, &on_gpu)["fit"].clone());
    assert_eq!(found["histogram"], expected["histogram"]);
    let (found, expected) = (found["rms_residual"].as_f64().unwrap(), expected["rms_residual"].as_f64().unwrap());
    // Both end where a step would gain a millionth.
    assert!((found / expected - 1.0).abs() < 1e-4, "{found} on the GPU, {expected} on the CPU");

    let name = submit(&server, "killed", &gpu);
    let job = follow_until(&server, &name, |job| fit_of(job).texels > 0).await;
    assert!(fit_of(&job).texels < TEXELS, "not killed half-way: {job:?}");
    server.kill();
    let server = Server::start(&data);
    assert_eq!(follow_until(&server, &name, |_| false).await.state(), JobState::Succeeded);
    assert_eq!(content_hashes(&server, "killed"), content_hashes(&server, "gpu"));

    // With all models there is more to do.
    let name = submit(&server, "moved", &gpu[2..]);
    follow_until(&server, &name, |job| fit_of(job).texels > 0).await;
    server.kill();
    let server = Server::start_with(&data, &["--backend", "cpu"]);
    let job = follow_until(&server, &name, |_| false).await;
    let error = job.error.clone().unwrap_or_default();
    assert!(job.state() == JobState::Failed && error.message.contains("spec.fit.backend: GPU, CPU expected"), "{job:?}");
    assert_eq!(latest(&server, "moved"), Some(0));
    assert!(fs::read_dir(data.join("staging")).unwrap().next().is_none(), "a failed fit leaves something behind");
    let fit = ["job", "submit", "fit", "--observations", "seen", "--dataset", "none", "--backend", "gpu"];
    let refused = server.lumisphere(&fit);
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && text.contains("spec.fit.backend: GPU, CPU expected"), "{text}");
}
