//! Ground truth as frames: traced when asked for, alone, in a viewer's stream and on the command line, behind everyone else.

use std::fs;
use std::time::Instant;

use lumisphere::images::{Image, ReadLimits, decode_image};
use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::interact_request::Message as Up;
use wire::offset_surface_light_field_settings::{Blend, Component};
use wire::render_settings::Representation;

use crate::clients::with_dataset;
use crate::photographs::of_photographs;
use crate::process::{PATIENCE, Server, temporary_folder};
use crate::system::metric;
use crate::tiny::{self, DATASET, QUICK};
use crate::viewers::{TRANSPORTS, Transport, Viewer, opening};
use crate::wire::{camera, code_and_reason, fields, frame_request, raw_pixels, settings};

const SIZE: (u32, u32) = (64, 48);
/// Of what is stored, while paths are traced.
const FRAMES: u64 = 20;

fn truth(passes: u32, paths_per_pixel: u32) -> wire::RenderSettings {
    let ground_truth = Some(wire::GroundTruth { paths_per_pixel, passes });
    wire::RenderSettings { ground_truth, ..settings(Component::Full, Blend::Average) }
}

fn request(settings: wire::RenderSettings) -> wire::RenderFrameRequest {
    wire::RenderFrameRequest { camera: Some(camera(SIZE.0, SIZE.1)), settings: Some(settings), ..frame_request(DATASET) }
}

async fn alone(server: &Server, settings: wire::RenderSettings) -> wire::Frame {
    server.rendering().await.render_frame(request(settings)).await.unwrap().into_inner()
}

/// Root of the mean squared difference.
fn apart(a: &Image, b: &Image) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let squares = a.planes.iter().flatten().zip(b.planes.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
    (squares.sum::<f64>() / (a.planes.len() * a.planes[0].len()) as f64).sqrt()
}

/// The evaluation's own picture of what the frame should be, from paths of another seed.
#[test]
fn the_command_line_shows_what_an_evaluation_compares_with() {
    let (folder, server) = {
        let folder = temporary_folder();
        let server = Server::start(&folder.path().join("data"));
        tiny::capture(&server, folder.path());
        (folder, server)
    };
    let views = ["--dataset", DATASET, "--frames", "1", "--size", "64x48"];
    let out = |name: &str| folder.path().join(name).to_str().unwrap().to_string();
    let evaluate = ["--components", "full", "--blends", "average", "--truth-samples-per-pixel", "256", "--out", &out("errors"), "--quiet"];
    server.succeed(&[&["evaluate"], &views[..], &evaluate].concat());
    let read = |path: std::path::PathBuf| decode_image(&fs::read(path).unwrap(), ReadLimits::SCENE).unwrap();
    let name_ends = |ending: &str| {
        let names = fs::read_dir(out("errors")).unwrap().map(|e| e.unwrap().path());
        names.into_iter().find(|p| p.to_string_lossy().ends_with(ending)).unwrap_or_else(|| panic!("no {ending}"))
    };
    let expected = read(name_ends("one_reflection-truth.exr"));
    let shown = |name: &str, flags: &[&str]| {
        let show = ["--component", "full", "--blend", "average", "--format", "exr", "--out", &out(name), "--quiet"];
        server.succeed(&[&["render"], &views[..], &show, flags].concat());
        read(folder.path().join(name).join("frame-00000.exr"))
    };
    let (stored, traced) = (shown("stored", &[]), shown("traced", &["--truth", "--truth-paths", "4"]));
    let (error, noise) = (apart(&stored, &expected), apart(&traced, &expected));
    // 256 paths a pixel in both, and silhouettes that the evaluation's mask leaves out: a third of what a coarse capture is off at most.
    assert!(noise < 0.3 * error, "traced {noise}, stored {error}");
    assert!(traced != expected, "the same paths");
    assert_eq!(shown("streamed", &["--truth", "--truth-paths", "4", "--stream"]), traced);
}

#[tokio::test]
async fn a_viewer_sees_the_first_pass_and_then_means_that_calls_return_too() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let open = wire::OpenInteraction { settings: Some(truth(6, 2)), ..opening(1) };
        let mut viewer = Viewer::open_as(&server, open, transport).await.unwrap();
        viewer.pose(3, camera(SIZE.0, SIZE.1)).await;
        for passes in [1, 2, 4, 6] {
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            assert_eq!((frame.pose_id, frame.passes_done, frame.is_final), (3, passes, passes == 6), "{transport:?}");
            let unary = alone(&server, truth(passes, 2)).await;
            assert_eq!(frame.color, unary.color, "{transport:?}: {passes} passes");
            assert_eq!((unary.backend(), unary.adapter.as_str(), unary.cache.unwrap_or_default().look_ups), (wire::Backend::Cpu, "", 0));
        }
        // The same viewer, back to what is stored and to the truth again.
        for (settings, passes) in [(settings(Component::Full, Blend::Average), 1), (truth(1, 1), 1)] {
            let update = wire::SettingsUpdate { settings: Some(settings.clone()), output: None };
            viewer.send(Up::Settings(update)).await;
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            assert_eq!((frame.passes_done, frame.color), (passes, alone(&server, settings).await.color), "{transport:?}");
        }
        viewer.leave().await;
    }
    assert_eq!((metric(&server, "stills_held"), metric(&server, "still_bytes")), (0, 0));
}

#[tokio::test]
async fn passes_add_up_and_depth_comes_with_them() {
    let (_folder, server) = with_dataset().await;
    let pixels = |frame: &wire::Frame| raw_pixels(&frame.color);
    let (many, one) = (alone(&server, truth(16, 1)).await, alone(&server, truth(1, 16)).await);
    for (a, b) in pixels(&many).iter().zip(&pixels(&one)) {
        // The same sixteen paths, summed in another order.
        assert!((a - b).abs() <= 1e-5 * b.abs().max(1.0), "{a}, {b}");
    }
    let with_all = |settings| {
        let output = wire::OutputSettings { want_depth: true, want_provenance: true, ..request(truth(1, 1)).output.unwrap() };
        wire::RenderFrameRequest { output: Some(output), ..request(settings) }
    };
    let mut client = server.rendering().await;
    let traced = client.render_frame(with_all(truth(2, 1))).await.unwrap().into_inner();
    let stored = client.render_frame(with_all(settings(Component::Full, Blend::Average))).await.unwrap().into_inner();
    let (traced_depth, stored_depth) = (raw_pixels(&traced.depth), raw_pixels(&stored.depth));
    let near = traced_depth.iter().zip(&stored_depth).filter(|(a, b)| a == b || (*a - *b).abs() < 1e-3).count();
    // A rasterised edge may fall on the next pixel.
    assert!(near > traced_depth.len() * 98 / 100, "{near} of {}", traced_depth.len());
    let provenance = zstd::decode_all(&traced.provenance[..]).unwrap();
    assert!(provenance.chunks_exact(4).all(|p| u32::from_le_bytes(p.try_into().unwrap()) == 0x3fff_ffff));
}

/// A pass of sixteen million paths takes long, frames of what is stored milliseconds: had each waited for a pass, there would be as many of
/// both. Those of a job go on as well.
#[tokio::test(flavor = "multi_thread")]
async fn whoever_looks_at_what_is_stored_does_not_wait_for_paths() {
    let (folder, server) = with_dataset().await;
    // So that the scene is ready.
    alone(&server, truth(1, 1)).await;
    let mut client = server.rendering().await;
    let slow = wire::RenderFrameRequest { camera: Some(camera(512, 512)), ..request(truth(4096, 64)) };
    let traced = tokio::spawn(async move { client.render_frame(slow).await.map(drop) });
    let mut viewer = Viewer::open(&server, 1).await;
    for pose_id in 1..=FRAMES {
        viewer.pose(pose_id, camera(SIZE.0, SIZE.1)).await;
        let frame = viewer.frame().await;
        viewer.acknowledge(frame.frame_id).await;
        alone(&server, settings(Component::Mirror, Blend::Distance)).await;
    }
    let cameras = folder.path().join("scene/scene.json");
    let job = ["job", "submit", "path-render", "--dataset", DATASET, "--cameras", cameras.to_str().unwrap(), "--watch", "--quiet"];
    server.succeed(&job);
    assert!(!traced.is_finished(), "4096 such passes are not traced meanwhile");
    let passes = metric(&server, "still_passes_total");
    assert!(passes < FRAMES, "{passes} passes beside {FRAMES} frames");
    // Whoever has left lets the next one's paths begin.
    traced.abort();
    assert_eq!(alone(&server, truth(2, 1)).await.passes_done, 2);
    server.succeed(&[&job[..], &["--truth", "--truth-passes", "2"]].concat());
}

/// Their frame would be shown, had they been finished, and the processors would have worked for it.
#[tokio::test(flavor = "multi_thread")]
async fn paths_that_a_viewer_has_moved_on_from_are_given_up_in_the_midst_of_a_pass() {
    let (_folder, server) = with_dataset().await;
    // So that the scene is ready.
    alone(&server, truth(1, 1)).await;
    let idle = server.cpu_seconds();
    let whole = wire::RenderFrameRequest { camera: Some(camera(256, 256)), ..request(truth(1, 64)) };
    server.rendering().await.render_frame(whole).await.unwrap();
    let pass = server.cpu_seconds() - idle;
    for (passes, moving_frames_per_second) in [(2, Some(0.0)), (1, Some(30.0))] {
        let open = wire::OpenInteraction { settings: Some(truth(passes, 64)), moving_frames_per_second, ..opening(1) };
        let mut viewer = Viewer::open_as(&server, open, Transport::Interact).await.unwrap();
        let mut pose_id = 0;
        // The first pass, or a frame of fewer pixels as soon as it is known what paths cost.
        loop {
            pose_id += 1;
            viewer.pose(pose_id, camera(256, 256)).await;
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            if !frame.is_final {
                break;
            }
            assert!(pose_id < 10, "nothing is left to do in {passes} passes");
        }
        // Nothing else has work: paths are traced.
        let (begun, idle) = (Instant::now(), server.cpu_seconds());
        while server.cpu_seconds() < idle + 0.1 * pass {
            assert!(begun.elapsed() < PATIENCE, "nothing is traced");
            tokio::task::yield_now().await;
        }
        viewer.pose(pose_id + 1, camera(SIZE.0, SIZE.1)).await;
        assert_eq!(viewer.frame().await.pose_id, pose_id + 1, "{passes} passes");
        let spent = server.cpu_seconds() - idle;
        assert!(spent < 0.6 * pass, "{spent} s of processor time for the beginning of a pass of {pass} s, {passes} passes");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn what_was_photographed_has_no_truth_and_says_so() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    of_photographs(&server, folder.path(), "photographed");
    tiny::capture_with(&server, folder.path(), DATASET, &QUICK);
    let map = Representation::ParameterMap(wire::ParameterMapSettings::default());
    let stored = wire::RenderSettings { representation: Some(map), ..Default::default() };
    let traced = wire::RenderSettings { ground_truth: Some(wire::GroundTruth::default()), ..stored.clone() };
    let of = |settings: &wire::RenderSettings| wire::RenderFrameRequest { dataset: "photographed".into(), ..request(settings.clone()) };
    let mut client = server.rendering().await;
    client.render_frame(of(&stored)).await.unwrap();
    let unknown = (Code::FailedPrecondition, "SCENE_UNKNOWN".to_string());
    let status = client.render_frame(of(&traced)).await.unwrap_err();
    assert_eq!(code_and_reason(&status), unknown);
    assert!(status.message().contains("photographed version 1 does not say from which scene"), "{status:?}");
    for transport in [Transport::Interact, Transport::Session] {
        let open = |settings: &wire::RenderSettings| wire::OpenInteraction {
            dataset: "photographed".into(),
            settings: Some(settings.clone()),
            ..opening(1)
        };
        let Err(status) = Viewer::open_as(&server, open(&traced), transport).await else { panic!("{transport:?} is open") };
        assert_eq!(code_and_reason(&status), unknown, "{transport:?}");
        let mut viewer = Viewer::open_as(&server, open(&stored), transport).await.unwrap();
        let update = wire::SettingsUpdate { settings: Some(traced.clone()), output: None };
        assert_eq!(viewer.refused(Up::Settings(update)).await.reason, "SCENE_UNKNOWN", "{transport:?}");
        viewer.pose(1, camera(SIZE.0, SIZE.1)).await;
        assert!(viewer.frame().await.is_final, "{transport:?}: it goes on with what is stored");
    }
}

#[tokio::test]
async fn a_truth_that_is_too_much_or_of_nothing_is_refused_by_field() {
    let (_folder, server) = with_dataset().await;
    let mut client = server.rendering().await;
    for (settings, field) in [(truth(4097, 1), "settings.ground_truth.passes"), (truth(1, 65), "settings.ground_truth.paths_per_pixel")] {
        let status = client.render_frame(request(settings)).await.unwrap_err();
        assert_eq!((status.code(), fields(&status)), (Code::InvalidArgument, vec![field.to_string()]));
    }
    // 2048 · 2048 pixels of five paths.
    let large = wire::RenderFrameRequest { camera: Some(camera(2048, 2048)), ..request(truth(1, 5)) };
    let status = client.render_frame(large).await.unwrap_err();
    assert_eq!(fields(&status), ["settings.ground_truth.paths_per_pixel"]);
    assert!(status.message().contains("4194304 pixels of 5 paths each, at most 16777216 paths a pass expected"), "{status:?}");
    let views = wire::evaluate_spec::Views::Cameras(wire::CameraList { cameras: vec![camera(8, 8)] });
    let evaluate = wire::EvaluateSpec {
        dataset: DATASET.into(),
        settings: vec![settings(Component::Full, Blend::Average), truth(1, 1)],
        views: Some(views),
        ..Default::default()
    };
    let spec = wire::JobSpec { spec: Some(wire::job_spec::Spec::Evaluate(evaluate)) };
    let status = server.jobs().await.submit_job(wire::SubmitJobRequest { spec: Some(spec), ..Default::default() }).await.unwrap_err();
    assert!(fields(&status)[0].ends_with("settings[1].ground_truth"), "{status:?}");
}
