//! Stills: glossy frames that are the mean of several passes, alone and in a viewer's stream.

use std::time::{Duration, Instant};

use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::offset_surface_light_field_settings::gloss::Integration;
use wire::offset_surface_light_field_settings::{Blend, Component, Gloss};
use wire::render_settings::Representation;

use crate::clients::with_dataset;
use crate::process::{PATIENCE, Server, temporary_folder};
use crate::system::metric;
use crate::tiny::{self, DATASET};
use crate::viewers::{TRANSPORTS, Transport, Viewer, opening};
use crate::wire::{camera, camera_around, code_and_reason, fields, frame_request, raw_pixels, settings};

const SIZE: (u32, u32) = (64, 48);
/// More than any test renders: one that ends has not waited for them.
const ENDLESS: u32 = 256;
/// Frames until something must have come.
const PATIENT: usize = 40;

fn glossy_of(component: Component, directions: u32, passes: u32) -> wire::RenderSettings {
    let mut settings = settings(component, Blend::Average);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        let brdf = r#"{"model": "ward", "diffuse": [0.1, 0.1, 0.1], "specular": [0.5, 0.5, 0.5], "alpha_x": 0.3, "alpha_y": 0.3}"#;
        field.gloss = Some(Gloss { brdf: brdf.into(), directions, passes, order: 0, integration: 0 });
    }
    settings
}

fn glossy(passes: u32) -> wire::RenderSettings {
    glossy_of(Component::Glossy, 8, passes)
}

/// So slow that nobody renders all of it: 19 200 pixels of 1700 directions, 256 times.
fn endless() -> (wire::Camera, wire::RenderSettings) {
    (camera(160, 120), glossy_of(Component::Glossy, 1700, ENDLESS))
}

async fn alone(server: &Server, camera: wire::Camera, settings: wire::RenderSettings) -> wire::Frame {
    let request = wire::RenderFrameRequest { camera: Some(camera), settings: Some(settings), ..frame_request(DATASET) };
    server.rendering().await.render_frame(request).await.unwrap().into_inner()
}

async fn open(server: &Server, credits: u32, rate: f32, settings: wire::RenderSettings, transport: Transport) -> Viewer {
    let open = wire::OpenInteraction { settings: Some(settings), moving_frames_per_second: Some(rate), ..opening(credits) };
    Viewer::open_as(server, open, transport).await.unwrap()
}

/// Frames up to the final one, each acknowledged.
async fn until_final(viewer: &mut Viewer) -> Vec<wire::Frame> {
    let mut frames = Vec::new();
    while frames.last().is_none_or(|frame: &wire::Frame| !frame.is_final) {
        assert!(frames.len() < PATIENT, "no final frame");
        let frame = viewer.frame().await;
        viewer.acknowledge(frame.frame_id).await;
        frames.push(frame);
    }
    frames
}

/// Waits until a counter has this value: it follows what the test has done.
async fn metric_becomes(server: &Server, name: &str, value: u64) {
    let begun = Instant::now();
    while metric(server, name) != value {
        assert!(begun.elapsed() < PATIENCE, "{name} is {}, {value} expected", metric(server, name));
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn a_still_view_ends_with_the_frame_that_a_call_with_the_same_passes_renders() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        for (passes, shown) in [(6, vec![1, 2, 4, 6]), (8, vec![1, 2, 4, 8]), (1, vec![1])] {
            let mut viewer = open(&server, 1, 0.0, glossy(passes), transport).await;
            viewer.pose(7, camera(SIZE.0, SIZE.1)).await;
            let frames = until_final(&mut viewer).await;
            assert_eq!(frames.iter().map(|f| f.passes_done).collect::<Vec<_>>(), shown, "{transport:?}");
            assert!(frames.iter().all(|f| f.pose_id == 7), "{transport:?}");
            for frame in &frames {
                let unary = alone(&server, camera(SIZE.0, SIZE.1), glossy(frame.passes_done)).await;
                assert_eq!((unary.passes_done, unary.is_final), (frame.passes_done, true));
                assert_eq!(frame.color, unary.color, "{transport:?}: {} of {passes} passes", frame.passes_done);
            }
            viewer.leave().await;
        }
    }
    assert_eq!((metric(&server, "stills_held"), metric(&server, "still_bytes")), (0, 0));
    let [one, six] = [1, 6].map(|passes| alone(&server, camera(SIZE.0, SIZE.1), glossy(passes)));
    assert_ne!(one.await.color, six.await.color, "passes change what is shown");
}

/// Of a viewer that asked for a rate: frames in motion are of one pass, whatever their size, and only the rest is refined.
#[tokio::test]
async fn a_moving_viewer_is_refined_once_it_rests() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let mut viewer = open(&server, 2, 60.0, glossy(16), transport).await;
        for pose_id in 1..=5 {
            viewer.pose(pose_id, camera_around(0.1 * pose_id as f32, SIZE.0, SIZE.1)).await;
        }
        // Where a pose comes late the one before is at rest, and rightly refined.
        let mut frames = until_final(&mut viewer).await;
        while frames.last().unwrap().pose_id < 5 {
            frames.extend(until_final(&mut viewer).await);
        }
        let last = frames.last().unwrap();
        assert_eq!((last.pose_id, last.passes_done, last.width_px), (5, 16, SIZE.0), "{transport:?}");
        assert!(frames.is_sorted_by_key(|f| f.pose_id), "{transport:?}");
        assert!(frames.iter().all(|f| f.width_px == SIZE.0 || f.passes_done == 1), "{transport:?}");
        assert_eq!(last.color, alone(&server, camera_around(0.5, SIZE.0, SIZE.1), glossy(16)).await.color, "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pose_in_the_middle_abandons_the_rest_and_frees_it() {
    let (_folder, server) = with_dataset().await;
    let (from, slow) = endless();
    for transport in TRANSPORTS {
        let abandoned = metric(&server, "refinements_abandoned_total");
        let mut viewer = open(&server, 1, 0.0, slow.clone(), transport).await;
        viewer.pose(1, from).await;
        let first = viewer.frame().await;
        viewer.acknowledge(first.frame_id).await;
        let second = viewer.frame().await;
        assert_eq!((first.passes_done, second.passes_done, second.is_final), (1, 2, false), "{transport:?}");
        // Its pixels: 3 · 4 bytes each.
        assert_eq!((metric(&server, "stills_held"), metric(&server, "still_bytes")), (1, 160 * 120 * 12));
        // Without a credit it is not refined, and the new pose cannot be shown; memory is given back all the same.
        viewer.pose(2, camera(SIZE.0, SIZE.1)).await;
        metric_becomes(&server, "still_bytes", 0).await;
        assert_eq!(metric(&server, "refinements_abandoned_total"), abandoned + 1);
        viewer.acknowledge(second.frame_id).await;
        let next = viewer.frame().await;
        assert_eq!((next.pose_id, next.passes_done), (2, 1), "{transport:?}");
        // While a pass is being rendered: what comes then is thrown away.
        viewer.acknowledge(next.frame_id).await;
        viewer.pose(3, from).await;
        let mut poses = Vec::new();
        for pose_id in 4..=6 {
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            poses.push(frame.pose_id);
            viewer.pose(pose_id, camera_around(0.1 * pose_id as f32, SIZE.0, SIZE.1)).await;
        }
        while *poses.last().unwrap() < 6 {
            let frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
            poses.push(frame.pose_id);
        }
        assert!(poses.is_sorted(), "{transport:?}: an old pose came after a new one: {poses:?}");
        // Half-closed, it would be owed all passes.
        drop(viewer);
        metric_becomes(&server, "stills_held", 0).await;
    }
    assert!(metric(&server, "still_passes_total") < u64::from(ENDLESS) - 1, "nobody rendered all passes");
}

#[tokio::test(flavor = "multi_thread")]
async fn other_settings_abandon_it_too() {
    let (_folder, server) = with_dataset().await;
    let (from, slow) = endless();
    let mut viewer = open(&server, 2, 0.0, slow, Transport::Session).await;
    viewer.pose(1, from).await;
    assert_eq!(viewer.frame().await.passes_done, 1);
    let update = wire::SettingsUpdate { settings: Some(glossy(3)), output: None };
    viewer.send(wire::interact_request::Message::Settings(update)).await;
    viewer.acknowledge(1).await;
    let last = until_final(&mut viewer).await.pop().unwrap();
    assert_eq!(last.passes_done, 3);
    assert_eq!(last.color, alone(&server, from, glossy(3)).await.color);
}

#[tokio::test]
async fn what_has_no_directions_is_shown_once() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let mut viewer = open(&server, 2, 0.0, glossy_of(Component::Full, 8, 16), transport).await;
        for pose_id in 1..=2 {
            viewer.pose(pose_id, camera(SIZE.0, SIZE.1)).await;
            let frame = viewer.frame().await;
            assert_eq!((frame.pose_id, frame.frame_id, frame.passes_done, frame.is_final), (pose_id, pose_id, 1, true), "{transport:?}");
        }
        viewer.acknowledge(2).await;
        viewer.leave().await;
    }
    assert_eq!(metric(&server, "still_passes_total"), 0);
}

/// Two pages of 16² texels of four f32 a frame. Shares of the first passes are wider than texels; those of later ones read the full size, whose
/// pages have to come first: what stands in for them is in no mean.
#[tokio::test]
async fn passes_wait_for_their_pages() {
    const PASSES: u32 = 100;
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--gpu-upload-bytes-per-frame", "8192"]);
    tiny::capture(&server, folder.path());
    let mut viewer = open(&server, 2, 0.0, glossy(PASSES), Transport::Interact).await;
    viewer.pose(1, camera(160, 120)).await;
    let last = until_final(&mut viewer).await.pop().unwrap();
    assert_eq!(last.passes_done, PASSES);
    assert_eq!(last.color, alone(&server, camera(160, 120), glossy(PASSES)).await.color);
}

/// With a credit for each of its frames: none comes back.
#[tokio::test]
async fn a_half_closed_stream_is_owed_the_mean_of_all_passes() {
    let (_folder, server) = with_dataset().await;
    let mut viewer = open(&server, 4, 0.0, glossy(8), Transport::Interact).await;
    viewer.pose(1, camera(SIZE.0, SIZE.1)).await;
    viewer.half_close();
    let mut last = viewer.frame().await;
    while let Some(wire::interact_response::Message::Frame(frame)) = viewer.next().await {
        last = frame;
    }
    assert_eq!((last.passes_done, last.is_final), (8, true));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_renders_no_pass_after_its_deadline() {
    let (_folder, server) = with_dataset().await;
    let (from, slow) = endless();
    let request = wire::RenderFrameRequest { camera: Some(from), settings: Some(slow), ..frame_request(DATASET) };
    let mut request = tonic::Request::new(request);
    request.set_timeout(Duration::from_millis(1500));
    let status = server.rendering().await.render_frame(request).await.unwrap_err();
    // The client's own clock may end the call first.
    assert!([Code::DeadlineExceeded, Code::Cancelled].contains(&status.code()), "{status:?}");
    metric_becomes(&server, "stills_held", 0).await;
    let passes = metric(&server, "still_passes_total");
    assert!(passes < u64::from(ENDLESS) - 1, "{passes} passes");
    // One may have been under way; after another frame nothing is.
    alone(&server, camera(SIZE.0, SIZE.1), glossy(1)).await;
    assert!(metric(&server, "still_passes_total") <= passes + 1);
}

#[tokio::test]
async fn more_passes_than_a_still_may_have_are_refused_by_field() {
    let (_folder, server) = with_dataset().await;
    let request = wire::RenderFrameRequest { settings: Some(glossy(ENDLESS + 1)), ..frame_request(DATASET) };
    let status = server.rendering().await.render_frame(request).await.unwrap_err();
    assert_eq!(code_and_reason(&status), (Code::InvalidArgument, "FIELD_INVALID".into()));
    assert_eq!(fields(&status), ["settings.offset_surface_light_field.gloss.passes"]);
    assert!(status.message().ends_with("257, 1 to 256 expected"), "{status:?}");
}

/// Both see the same light; what passes differ in is averaged away: a mean lies nearer to the mean of many.
#[tokio::test]
async fn passes_come_nearer_to_the_integral() {
    let (_folder, server) = with_dataset().await;
    let from = camera_around(0.7, SIZE.0, SIZE.1);
    let pixels = async |passes| raw_pixels(&alone(&server, from, glossy(passes)).await.color);
    let (truth, first, mean) = (pixels(ENDLESS).await, pixels(1).await, pixels(16).await);
    let error = |a: &[f32]| a.iter().zip(&truth).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt();
    assert!(error(&mean) < 0.5 * error(&first), "{} of 16 passes, {} of one", error(&mean), error(&first));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_command_line_renders_stills_alone_and_in_a_stream() {
    let (folder, server) = with_dataset().await;
    let brdf = r#"{"model": "lambert", "albedo": [0.5, 0.5, 0.5]}"#;
    let shown = |out: &str, flags: &[&str]| {
        let out = folder.path().join(out);
        let base = ["render", "--dataset", DATASET, "--component", "glossy", "--blend", "average", "--brdf", brdf, "--directions", "8"];
        let views = ["--frames", "2", "--size", "64x48", "--format", "raw", "--out", out.to_str().unwrap()];
        server.succeed(&[&base[..], &views, flags].concat());
        ["frame-00000.raw.zst", "frame-00001.raw.zst"].map(|name| std::fs::read(out.join(name)).unwrap())
    };
    let [one, many, streamed] = [("one", &[][..]), ("many", &["--passes", "5"]), ("streamed", &["--passes", "5", "--stream"])]
        .map(|(out, flags)| shown(out, flags));
    assert_eq!(many, streamed);
    assert_ne!(one, many);
}

/// A narrow highlight is one look unless directions are asked for, a wider one 32 or 64 directions; a look is one pass, whatever is asked.
#[tokio::test]
async fn a_frame_tells_how_its_highlight_was_gathered() {
    let (_folder, server) = with_dataset().await;
    let of = |alpha: f32, directions, integration: Integration| {
        let mut settings = glossy_of(Component::Glossy, directions, 4);
        if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
            let brdf = format!(r#"{{"model": "cook_torrance", "alpha_x": {alpha}, "alpha_y": {alpha}, "f0": [0.9, 0.7, 0.3]}}"#);
            field.gloss = Some(Gloss { brdf, directions, passes: 4, order: 0, integration: integration.into() });
        }
        settings
    };
    for (asked, expected) in [
        (of(0.005, 0, Integration::Unspecified), (Integration::Prefiltered, 0, 1)),
        (of(0.05, 0, Integration::Unspecified), (Integration::MonteCarlo, 32, 4)),
        (of(0.3, 0, Integration::Unspecified), (Integration::MonteCarlo, 64, 4)),
        (of(0.005, 6, Integration::Unspecified), (Integration::MonteCarlo, 6, 4)),
        (of(0.3, 6, Integration::Prefiltered), (Integration::Prefiltered, 0, 1)),
        (settings(Component::Mirror, Blend::Average), (Integration::Unspecified, 0, 1)),
    ] {
        let frame = alone(&server, camera(SIZE.0, SIZE.1), asked.clone()).await;
        assert_eq!((frame.integration(), frame.directions, frame.passes_done), expected, "{asked:?}");
    }
    let bilinear = 2;
    let mut refused = of(0.3, 0, Integration::Prefiltered);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut refused.representation {
        field.filter = bilinear;
    }
    let request = wire::RenderFrameRequest { camera: Some(camera(8, 8)), settings: Some(refused), ..frame_request(DATASET) };
    let refused = server.rendering().await.render_frame(request).await.unwrap_err();
    assert_eq!(fields(&refused), ["settings.offset_surface_light_field.gloss.integration"]);
}
