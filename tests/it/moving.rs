//! Viewers that ask for a rate while they move: smaller frames in motion, the full one at rest.

use std::time::Duration;

use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::{Blend, Component, Gloss};
use wire::render_settings::Representation;

use crate::clients::with_dataset;
use crate::process::Server;
use crate::system::metric;
use crate::tiny::DATASET;
use crate::viewers::{TRANSPORTS, Transport, Viewer, opening};
use crate::wire::{camera_around, code_and_reason, fields, frame_request, output, settings};

const SIZE: (u32, u32) = (320, 240);
/// Poses until a size must have been found: the first frame tells already that it is too slow.
const PATIENT: u64 = 50;
/// Looks at a counter, each a connection: while the other's frame is drawn.
const POLLS: u32 = 200;
/// Longer than a hand takes to come to rest.
const REST: Duration = Duration::from_millis(100);

/// A frame of 76 800 pixels with two hundred directions each, far from 240 a second on any renderer that the tests run on.
fn slow() -> wire::RenderSettings {
    glossy(200)
}

/// As slow as a frame may be: seven times that.
fn slow_frame() -> wire::RenderFrameRequest {
    wire::RenderFrameRequest { camera: Some(around(0)), settings: Some(glossy(1400)), ..frame_request(DATASET) }
}

fn glossy(directions: u32) -> wire::RenderSettings {
    let mut settings = settings(Component::Glossy, Blend::Distance);
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        let brdf = r#"{"model": "ward", "diffuse": [0.1, 0.1, 0.1], "specular": [0.5, 0.5, 0.5], "alpha_x": 0.3, "alpha_y": 0.3}"#;
        field.gloss = Some(Gloss { brdf: brdf.into(), directions, passes: 0, order: 0, integration: 0 });
    }
    settings
}

fn around(step: u64) -> wire::Camera {
    camera_around(0.01 * step as f32, SIZE.0, SIZE.1)
}

async fn open(server: &Server, transport: Transport) -> Viewer {
    let open = wire::OpenInteraction { settings: Some(slow()), moving_frames_per_second: Some(240.0), ..opening(1) };
    Viewer::open_as(server, open, transport).await.unwrap()
}

/// Moves until a frame is smaller; that frame and its pose.
async fn move_until_smaller(viewer: &mut Viewer) -> (u64, wire::Frame) {
    for pose_id in 1..=PATIENT {
        viewer.pose(pose_id, around(pose_id)).await;
        let frame = viewer.frame().await;
        assert_eq!(frame.pose_id, pose_id);
        viewer.acknowledge(frame.frame_id).await;
        if (frame.width_px, frame.height_px) != SIZE {
            return (pose_id, frame);
        }
    }
    panic!("no frame of {PATIENT} was smaller");
}

#[tokio::test]
async fn a_moving_viewer_sees_smaller_frames_of_the_same_view_and_the_full_one_at_rest() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let mut viewer = open(&server, transport).await;
        let (pose_id, small) = move_until_smaller(&mut viewer).await;
        assert!(!small.is_final && small.width_px < SIZE.0 && 8 * small.width_px >= SIZE.0, "{} px", small.width_px);
        // It says what it is: the pose that was asked for, through the same frustum.
        let (asked, drawn) = (around(pose_id), small.camera.unwrap());
        let (asked_by, drawn_by) = (asked.intrinsics.unwrap(), drawn.intrinsics.unwrap());
        assert_eq!((drawn_by.width_px, drawn_by.height_px), (small.width_px, small.height_px));
        let [x, y] = [(SIZE.0, small.width_px), (SIZE.1, small.height_px)].map(|(full, left)| left as f32 / full as f32);
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-4 * b;
        assert!(near(drawn_by.focal_x_px, asked_by.focal_x_px * x) && near(drawn_by.focal_y_px, asked_by.focal_x_px * y), "{drawn_by:?}");
        assert!(near(drawn_by.center_x_px(), 0.5 * small.width_px as f32) && near(drawn_by.center_y_px(), 0.5 * small.height_px as f32));
        let position = |camera: wire::Camera| camera.pose.unwrap().position.unwrap();
        assert_eq!(position(drawn), position(asked));
        assert_eq!(crate::wire::raw_pixels(&small.color).len(), 3 * (small.width_px * small.height_px) as usize);
        // Nothing more is sent: the full frame of that pose follows, the same as a unary one, and is the last.
        let mut still = viewer.frame().await;
        while !still.is_final {
            assert!(still.frame_id < small.frame_id + PATIENT, "no last frame");
            viewer.acknowledge(still.frame_id).await;
            still = viewer.frame().await;
        }
        assert_eq!((still.pose_id, still.width_px, still.height_px), (pose_id, SIZE.0, SIZE.1), "{transport:?}");
        let request = wire::RenderFrameRequest { camera: Some(asked), settings: Some(slow()), ..frame_request(DATASET) };
        let unary = server.rendering().await.render_frame(request).await.unwrap().into_inner();
        assert_eq!(still.color, unary.color, "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn what_comes_to_rest_is_shown_in_the_encoding_for_rest() {
    let (_folder, server) = with_dataset().await;
    let png = wire::RenderFrameRequest { camera: Some(around(1)), output: Some(output(wire::Encoding::Png)), ..frame_request(DATASET) };
    let expected = server.rendering().await.render_frame(png).await.unwrap().into_inner();
    let at_rest = wire::OutputSettings { encoding_at_rest: wire::Encoding::Png.into(), ..output(wire::Encoding::Jpeg) };
    // A viewer that would get 1 frame a second is shown the full size in motion, too: but not the encoding.
    for (transport, rate) in TRANSPORTS.into_iter().flat_map(|transport| [0.0, 1.0, 240.0].map(|rate| (transport, rate))) {
        let settings = frame_request(DATASET).settings;
        let open = wire::OpenInteraction { settings, output: Some(at_rest), moving_frames_per_second: Some(rate), ..opening(1) };
        let mut viewer = Viewer::open_as(&server, open, transport).await.unwrap();
        viewer.pose(1, around(1)).await;
        let mut frames = vec![viewer.frame().await];
        while frames.last().is_some_and(|frame| !frame.is_final) {
            viewer.acknowledge(frames.last().unwrap().frame_id).await;
            frames.push(viewer.frame().await);
        }
        let last = frames.pop().unwrap();
        assert_eq!(last.encoding(), wire::Encoding::Png, "{transport:?}, {rate}");
        assert!(last.color == expected.color, "{transport:?}, {rate}: not the pixels of a unary frame");
        assert!(frames.iter().all(|frame| frame.encoding() == wire::Encoding::Jpeg), "{transport:?}, {rate}");
        // With a rate, a slow machine may have seen the viewer at rest before its first frame.
        assert!(frames.is_empty() || rate > 0.0, "{transport:?}, {rate}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn in_motion_frames_are_not_in_the_encoding_for_rest() {
    let (_folder, server) = with_dataset().await;
    let at_rest = wire::OutputSettings { encoding_at_rest: wire::Encoding::Png.into(), ..output(wire::Encoding::Jpeg) };
    for transport in TRANSPORTS {
        let settings = frame_request(DATASET).settings;
        let open = wire::OpenInteraction { settings, output: Some(at_rest), moving_frames_per_second: Some(240.0), ..opening(1) };
        let mut viewer = Viewer::open_as(&server, open, transport).await.unwrap();
        let (_, smaller) = move_until_smaller(&mut viewer).await;
        assert_eq!(smaller.encoding(), wire::Encoding::Jpeg, "{transport:?}");
    }
}

/// Its stream is served by other threads while this one waits for the server's counters.
#[tokio::test(flavor = "multi_thread")]
async fn a_full_frame_is_dropped_when_the_viewer_moves_on() {
    let (_folder, server) = with_dataset().await;
    let mut viewer = open(&server, Transport::Interact).await;
    let (mut pose_id, mut frame) = move_until_smaller(&mut viewer).await;
    while metric(&server, "stills_abandoned_total") == 0 {
        assert!(pose_id < PATIENT, "no full frame was dropped");
        // Somebody else's frame is drawn for a while: it comes to rest, and its full frame has to wait.
        let mut rendering = server.rendering().await;
        let other = tokio::spawn(async move { rendering.render_frame(slow_frame()).await.map(drop) });
        tokio::time::sleep(REST).await;
        for _ in 0..POLLS {
            if metric(&server, "renders_waiting") > 0 {
                break;
            }
        }
        pose_id += 1;
        viewer.pose(pose_id, around(pose_id)).await;
        // One that was ready already may come before.
        while frame.pose_id < pose_id {
            frame = viewer.frame().await;
            viewer.acknowledge(frame.frame_id).await;
        }
        other.await.unwrap().unwrap();
    }
    // What it rests at is shown in the end.
    while !frame.is_final {
        frame = viewer.frame().await;
        viewer.acknowledge(frame.frame_id).await;
    }
    assert_eq!((frame.pose_id, frame.width_px), (pose_id, SIZE.0));
}

#[tokio::test]
async fn a_half_closed_stream_is_owed_the_full_frame_of_its_last_pose() {
    let (_folder, server) = with_dataset().await;
    let mut viewer = open(&server, Transport::Interact).await;
    let (pose_id, _) = move_until_smaller(&mut viewer).await;
    viewer.half_close();
    match viewer.next().await {
        Some(Down::Frame(frame)) => assert_eq!((frame.pose_id, frame.width_px, frame.is_final), (pose_id, SIZE.0, true)),
        other => panic!("a frame expected, not {other:?}"),
    }
    assert_eq!(viewer.next().await, None);
}

#[tokio::test]
async fn rates_that_are_none_are_refused() {
    let (_folder, server) = with_dataset().await;
    for rate in [f32::NAN, f32::INFINITY, -1.0, 0.5, 241.0] {
        let open = wire::OpenInteraction { moving_frames_per_second: Some(rate), ..opening(1) };
        let status = Viewer::open_as(&server, open, Transport::Session).await.err().expect("a refusal");
        assert_eq!(code_and_reason(&status), (Code::InvalidArgument, "FIELD_INVALID".into()));
        assert_eq!(fields(&status), ["open.moving_frames_per_second"], "{rate}");
    }
}
