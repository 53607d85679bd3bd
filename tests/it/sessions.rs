//! What a viewer may rely on, however its messages travel; and what holds for sessions that outlive their streams.

use std::time::Instant;

use lumisphere_proto::v1alpha1 as wire;
use tonic::Code;
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::offset_surface_light_field_settings::{Blend, Component};

use crate::clients::{with_dataset, with_dataset_and};
use crate::grpc_web;
use crate::process::{PATIENCE, Server, temporary_folder};
use crate::system::metric;
use crate::tiny::{self, DATASET};
use crate::viewers::{TRANSPORTS, Transport, Viewer, opening};
use crate::wire::{camera, code_and_reason, frame_request, output, settings};

/// Sessions, over both protocols.
const SESSIONS: [Transport; 2] = [Transport::Session, Transport::Web];

/// The unary frame of a camera, both terms.
async fn alone(server: &Server, camera: wire::Camera) -> wire::Frame {
    let request = wire::RenderFrameRequest { camera: Some(camera), ..frame_request(DATASET) };
    server.rendering().await.render_frame(request).await.unwrap().into_inner()
}

fn nowhere() -> wire::Camera {
    let mut camera = camera(32, 24);
    camera.pose.as_mut().unwrap().position.as_mut().unwrap().x = f32::NAN;
    camera
}

/// A viewer that has seen, but not acknowledged, its first frame.
async fn looking(server: &Server, transport: Transport) -> Viewer {
    let mut viewer = Viewer::open_as(server, opening(1), transport).await.unwrap();
    viewer.pose(1, camera(32, 24)).await;
    let first = viewer.frame().await;
    assert_eq!((first.pose_id, first.frame_id, first.is_final), (1, 1, true), "{transport:?}");
    viewer
}

#[tokio::test]
async fn frames_come_for_credits_and_the_latest_pose_wins() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let mut viewer = looking(&server, transport).await;
        // Without the credit nothing comes, so of these three only the last can be shown.
        for pose_id in [2, 3, 4] {
            viewer.pose(pose_id, camera(32 + pose_id as u32, 24)).await;
        }
        // Answered at once, after the three: they have all arrived when the credit comes back.
        let refusal = viewer.refused(Up::Pose(wire::PoseUpdate { pose_id: 5, camera: Some(nowhere()) })).await;
        assert_eq!(refusal.code, Code::InvalidArgument as i32, "{transport:?}: {refusal:?}");
        viewer.acknowledge(1).await;
        let latest = viewer.frame().await;
        assert_eq!((latest.pose_id, latest.frame_id, latest.width_px), (4, 2, 36), "{transport:?}");
        // Streamed and unary frames are the same pixels.
        assert_eq!(alone(&server, camera(36, 24)).await.color, latest.color, "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn a_refused_message_changes_nothing_and_says_why() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        let mut viewer = looking(&server, transport).await;
        let refused = [
            (Up::Pose(wire::PoseUpdate { pose_id: 9, camera: Some(nowhere()) }), "pose.camera.pose"),
            (Up::Pose(wire::PoseUpdate { pose_id: 9, camera: None }), "pose.camera"),
            // Good settings beside a bad output: all or nothing.
            (
                Up::Settings(wire::SettingsUpdate {
                    settings: Some(settings(Component::Reconstruction, Blend::Average)),
                    output: Some(output(wire::Encoding::Unspecified)),
                }),
                "settings.output.encoding",
            ),
            (
                Up::Settings(wire::SettingsUpdate { settings: Some(settings(Component::Full, Blend::Unspecified)), output: None }),
                "settings.settings.offset_surface_light_field.blend",
            ),
            // One frame was sent.
            (Up::Acknowledge(wire::FrameAcknowledgement { frame_id: 2 }), "acknowledge.frame_id"),
        ];
        for (message, field) in refused {
            let refusal = viewer.refused(message).await;
            assert_eq!((refusal.code, refusal.reason.as_str()), (Code::InvalidArgument as i32, "FIELD_INVALID"), "{refusal:?}");
            assert!(refusal.message.starts_with(&format!("{field}: ")), "{transport:?}: {field} expected in {refusal:?}");
        }
        // Without the credit that the false acknowledgement asked for, pose 2 cannot be shown before pose 3 has come.
        viewer.pose(2, camera(34, 24)).await;
        viewer.pose(3, camera(36, 24)).await;
        viewer.acknowledge(1).await;
        let next = viewer.frame().await;
        assert_eq!((next.frame_id, next.pose_id), (2, 3), "{transport:?}");
        assert_eq!(alone(&server, camera(36, 24)).await.color, next.color, "{transport:?}: the settings are those of the beginning");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn other_settings_show_the_latest_pose_again() {
    let (_folder, server) = with_dataset().await;
    let other = wire::RenderFrameRequest {
        settings: Some(settings(Component::Reconstruction, Blend::Distance)),
        camera: Some(camera(32, 24)),
        ..frame_request(DATASET)
    };
    let expected = server.rendering().await.render_frame(other.clone()).await.unwrap().into_inner().color;
    for transport in TRANSPORTS {
        let mut viewer = looking(&server, transport).await;
        viewer.send(Up::Settings(wire::SettingsUpdate { settings: other.settings.clone(), output: None })).await;
        viewer.acknowledge(1).await;
        let again = viewer.frame().await;
        assert_eq!((again.pose_id, again.frame_id), (1, 2), "{transport:?}");
        assert_eq!(again.color, expected, "{transport:?}");
        viewer.send(Up::Settings(wire::SettingsUpdate { settings: None, output: Some(output(wire::Encoding::Png)) })).await;
        viewer.acknowledge(2).await;
        let png = viewer.frame().await;
        assert_eq!((png.pose_id, png.encoding()), (1, wire::Encoding::Png), "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn what_cannot_be_opened_says_why_over_every_transport() {
    let (_folder, server) = with_dataset().await;
    for transport in TRANSPORTS {
        for (open, code, reason) in [
            (wire::OpenInteraction { dataset: "other".into(), ..opening(1) }, Code::NotFound, "DATASET_NOT_FOUND"),
            (wire::OpenInteraction { version: 7, ..opening(1) }, Code::NotFound, "VERSION_NOT_FOUND"),
            (opening(17), Code::InvalidArgument, "FIELD_INVALID"),
            (wire::OpenInteraction { settings: None, ..opening(1) }, Code::InvalidArgument, "FIELD_INVALID"),
        ] {
            let status = Viewer::open_as(&server, open, transport).await.err().expect("a refusal");
            assert_eq!(code_and_reason(&status), (code, reason.into()), "{transport:?}: {status:?}");
        }
    }
}

#[tokio::test]
async fn a_second_stream_takes_the_session_over_and_goes_on_with_its_pose() {
    let (_folder, server) = with_dataset().await;
    for transport in SESSIONS {
        let mut viewer = looking(&server, transport).await;
        let mut first = viewer.stream_again().await.expect("it was open");
        let status = first.answer().await.expect_err("the first stream ends");
        assert_eq!(code_and_reason(&status), (Code::Aborted, "SESSION_TAKEN_OVER".into()), "{transport:?}");
        assert!(matches!(viewer.next().await, Some(Down::Opened(_))), "{transport:?}");
        // The only credit was with a frame that was never acknowledged.
        let again = viewer.frame().await;
        assert_eq!((again.pose_id, again.frame_id), (1, 2), "{transport:?}");
        viewer.pose(2, camera(40, 24)).await;
        viewer.acknowledge(2).await;
        assert_eq!(viewer.frame().await.pose_id, 2, "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn a_broken_stream_is_taken_up_with_pose_and_settings_of_meanwhile() {
    let (_folder, server) = with_dataset().await;
    for transport in SESSIONS {
        let mut viewer = looking(&server, transport).await;
        viewer.hang_up();
        // Sent while nobody looks down: only the last of each is shown.
        for (pose_id, width) in [(2, 34), (3, 36)] {
            viewer.pose(pose_id, camera(width, 24)).await;
        }
        viewer.send(Up::Settings(wire::SettingsUpdate { settings: None, output: Some(output(wire::Encoding::Png)) })).await;
        assert!(viewer.stream_again().await.is_none());
        assert!(matches!(viewer.next().await, Some(Down::Opened(_))), "{transport:?}");
        let frame = viewer.frame().await;
        assert_eq!((frame.pose_id, frame.width_px, frame.encoding()), (3, 36, wire::Encoding::Png), "{transport:?}");
        viewer.leave().await;
    }
}

#[tokio::test]
async fn calls_that_overtake_each_other_are_put_right() {
    let (_folder, server) = with_dataset().await;
    let mut rendering = server.rendering().await;
    let opened = rendering.open_session(wire::OpenSessionRequest { open: Some(opening(1)) }).await.unwrap().into_inner();
    let session_id = opened.session_id;
    let update = |sequence, pose_id| wire::UpdateSessionRequest {
        session_id: session_id.clone(),
        sequence,
        pose: Some(wire::PoseUpdate { pose_id, camera: Some(camera(30 + pose_id as u32, 24)) }),
        settings: Some(wire::SettingsUpdate {
            settings: None,
            output: Some(output(if sequence == 5 { wire::Encoding::Png } else { wire::Encoding::RawZstd })),
        }),
        acknowledge: None,
    };
    for (sequence, pose_id) in [(5, 2), (4, 3), (1, 1)] {
        rendering.update_session(update(sequence, pose_id)).await.unwrap();
    }
    let request = wire::StreamFramesRequest { session_id: session_id.clone() };
    let mut down = rendering.stream_frames(request).await.unwrap().into_inner();
    assert!(matches!(down.message().await.unwrap().unwrap().message, Some(Down::Opened(_))));
    match down.message().await.unwrap().unwrap().message {
        Some(Down::Frame(frame)) => assert_eq!((frame.pose_id, frame.encoding()), (2, wire::Encoding::Png)),
        other => panic!("a frame expected, not {other:?}"),
    }
}

#[tokio::test]
async fn a_session_that_nobody_looks_at_renders_nothing_and_expires() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--session-expiry-seconds", "1"]);
    tiny::capture(&server, folder.path());
    let mut watched = looking(&server, Transport::Web).await;
    let rendered = metric(&server, "render_frames_total");
    let mut rendering = server.rendering().await;
    let opened = rendering.open_session(wire::OpenSessionRequest { open: Some(opening(1)) }).await.unwrap().into_inner();
    assert_eq!(opened.opened.unwrap().expires_after_seconds, 1);
    let update = |pose_id| wire::UpdateSessionRequest {
        session_id: opened.session_id.clone(),
        sequence: pose_id,
        pose: Some(wire::PoseUpdate { pose_id, camera: Some(camera(32, 24)) }),
        ..Default::default()
    };
    let mut pose_id = 0;
    let begun = Instant::now();
    let gone = loop {
        pose_id += 1;
        assert!(begun.elapsed() < PATIENCE, "not expired");
        if let Err(status) = rendering.update_session(update(pose_id)).await {
            break status;
        }
    };
    assert_eq!(code_and_reason(&gone), (Code::NotFound, "SESSION_NOT_FOUND".into()));
    assert_eq!(metric(&server, "render_frames_total"), rendered, "{pose_id} poses that nobody looks at");
    // As old, but looked at all the time.
    watched.pose(2, camera(40, 24)).await;
    watched.acknowledge(1).await;
    assert_eq!(watched.frame().await.pose_id, 2);
}

#[tokio::test]
async fn a_viewer_that_acknowledges_nothing_is_ended_and_one_at_rest_is_not() {
    let folder = temporary_folder();
    let server = Server::start_with(&folder.path().join("data"), &["--mute-viewer-seconds", "4"]);
    tiny::capture(&server, folder.path());
    for transport in TRANSPORTS {
        let mut rests = looking(&server, transport).await;
        rests.acknowledge(1).await;
        let mut is_mute = looking(&server, transport).await;
        let status = is_mute.answer().await.expect_err("the stream ends");
        assert_eq!(code_and_reason(&status), (Code::DeadlineExceeded, "VIEWER_MUTE".into()), "{transport:?}");
        rests.pose(2, camera(40, 24)).await;
        assert_eq!(rests.frame().await.pose_id, 2, "{transport:?}");
    }
}

#[tokio::test]
async fn no_more_sessions_are_opened_than_allowed_and_their_names_are_no_ones_guess() {
    const LIMIT: usize = 8;
    let folder = temporary_folder();
    let server =
        Server::start_with(&folder.path().join("data"), &["--max-sessions", &LIMIT.to_string(), "--session-expiry-seconds", "3600"]);
    tiny::capture(&server, folder.path());
    let mut rendering = server.rendering().await;
    let mut names = std::collections::BTreeSet::new();
    for _ in 0..2000 {
        match rendering.open_session(wire::OpenSessionRequest { open: Some(opening(1)) }).await {
            Ok(opened) => assert!(names.insert(opened.into_inner().session_id)),
            Err(status) => assert_eq!(code_and_reason(&status), (Code::ResourceExhausted, "TOO_MANY_SESSIONS".into())),
        }
    }
    assert_eq!(names.len(), LIMIT);
    assert!(names.iter().all(|name| name.len() == 32 && name.bytes().all(|b| b.is_ascii_hexdigit())), "{names:?}");
    // Of both transports together.
    let status = Viewer::open_as(&server, opening(1), Transport::Interact).await.err().expect("a refusal");
    assert_eq!(code_and_reason(&status).1, "TOO_MANY_SESSIONS");
    // Others still get their frames, and a place that is given back is free at once.
    alone(&server, camera(32, 24)).await;
    let session_id = names.pop_first().unwrap();
    rendering.close_session(wire::CloseSessionRequest { session_id }).await.unwrap();
    rendering.open_session(wire::OpenSessionRequest { open: Some(opening(1)) }).await.unwrap();
}

#[tokio::test]
async fn sessions_that_are_not_there_are_not_found() {
    let (_folder, server) = with_dataset().await;
    let closed = looking(&server, Transport::Web).await;
    let closed_id = closed.session_id().to_string();
    closed.leave().await;
    for session_id in ["", "0", &"0".repeat(32), &"x".repeat(100_000), &closed_id] {
        let session_id = session_id.to_string();
        let update = wire::UpdateSessionRequest { session_id: session_id.clone(), sequence: 1, ..Default::default() };
        let updated: Result<wire::UpdateSessionResponse, _> = grpc_web::unary(&server.address(), "Rendering/UpdateSession", &update).await;
        let stream = wire::StreamFramesRequest { session_id: session_id.clone() };
        let mut streamed = grpc_web::call(&server.address(), "Rendering/StreamFrames", &stream).await;
        let close = wire::CloseSessionRequest { session_id };
        let closed: Result<wire::CloseSessionResponse, _> = grpc_web::unary(&server.address(), "Rendering/CloseSession", &close).await;
        let streamed = streamed.message::<wire::InteractResponse>().await;
        for refusal in [updated.unwrap_err(), streamed.unwrap_err(), closed.unwrap_err()] {
            assert_eq!(code_and_reason(&refusal), (Code::NotFound, "SESSION_NOT_FOUND".into()), "{refusal:?}");
        }
    }
}

#[tokio::test]
async fn a_server_that_stops_tells_every_viewer_and_ends() {
    let (_folder, mut server) = with_dataset().await;
    let mut viewers = Vec::new();
    for transport in TRANSPORTS {
        viewers.push((transport, looking(&server, transport).await));
    }
    // One without a stream.
    server.rendering().await.open_session(wire::OpenSessionRequest { open: Some(opening(1)) }).await.unwrap();
    server.terminate();
    for (transport, viewer) in &mut viewers {
        match viewer.next().await {
            Some(Down::Status(status)) => assert_eq!(status.reason, "SHUTTING_DOWN", "{transport:?}"),
            other => panic!("{transport:?}: a status expected, not {other:?}"),
        }
        let status = viewer.answer().await.expect_err("the stream ends");
        assert_eq!(code_and_reason(&status), (Code::Unavailable, "SHUTTING_DOWN".into()), "{transport:?}");
    }
    drop(viewers);
    let status = tokio::task::spawn_blocking(move || server.ended()).await.unwrap();
    assert_eq!(status.code(), Some(0));
}

/// A server that is built without H.264 says so; `tests/run` builds it with.
#[tokio::test]
async fn video_is_one_stream_of_frames_that_build_on_each_other() {
    let (folder, server) = with_dataset().await;
    let version = server.system().await.get_version(wire::GetVersionRequest {}).await.unwrap().into_inner();
    let video = output(wire::Encoding::H264);
    let unary = wire::RenderFrameRequest { camera: Some(camera(32, 24)), output: Some(video), ..frame_request(DATASET) };
    let refused = server.rendering().await.render_frame(unary).await.unwrap_err();
    assert_eq!(code_and_reason(&refused), (Code::InvalidArgument, "FIELD_INVALID".into()));
    let open = || wire::OpenInteraction { output: Some(video), ..opening(1) };
    if !version.features.contains(&"encoding.h264".into()) {
        let refused = Viewer::open_as(&server, open(), Transport::Interact).await.err().expect("a refusal");
        assert!(refused.message().contains("built without"), "{refused:?}");
        return;
    }
    for transport in TRANSPORTS {
        let mut viewer = Viewer::open_as(&server, open(), transport).await.unwrap();
        let mut shown = async |pose_id: u64, width: u32| {
            viewer.pose(pose_id, camera(width, 24)).await;
            let frame = viewer.frame().await;
            assert_eq!((frame.pose_id, frame.encoding(), frame.width_px), (pose_id, wire::Encoding::H264, width), "{transport:?}");
            // Annex B: a start code.
            assert!(frame.color.starts_with(&[0, 0, 0, 1]), "{transport:?}");
            viewer.acknowledge(frame.frame_id).await;
            frame.is_key
        };
        let keys = [shown(1, 32).await, shown(2, 32).await, shown(3, 33).await, shown(4, 40).await, shown(5, 40).await];
        // 33 columns are coded as 34.
        assert_eq!(keys, [true, false, true, true, false], "{transport:?}");
        let too_large = wire::PoseUpdate { pose_id: 6, camera: Some(camera(3842, 24)) };
        let refusal = viewer.refused(Up::Pose(too_large)).await;
        assert!(refusal.message.contains("3842 x 24 pixels, as H264 at most 3840 x 2160"), "{refusal:?}");
        viewer.leave().await;
    }
    // A new stream of a session has seen nothing.
    let mut viewer = Viewer::open_as(&server, open(), Transport::Session).await.unwrap();
    viewer.pose(1, camera(32, 24)).await;
    assert!(viewer.frame().await.is_key);
    assert!(viewer.stream_again().await.is_some());
    assert!(matches!(viewer.next().await, Some(Down::Opened(_))));
    assert!(viewer.frame().await.is_key);
    viewer.leave().await;
    drop((server, folder));
    // No more encoders than allowed, those of viewers who have left not counted.
    let (_folder, server) = with_dataset_and(&["--max-video-sessions", "1"]).await;
    let mut first = Viewer::open_as(&server, open(), Transport::Interact).await.unwrap();
    let refused = Viewer::open_as(&server, open(), Transport::Session).await.err().expect("a refusal");
    assert_eq!(code_and_reason(&refused), (Code::FailedPrecondition, "TOO_MANY_VIDEOS".into()));
    let mut other = Viewer::open_as(&server, opening(1), Transport::Interact).await.unwrap();
    let refusal = other.refused(Up::Settings(wire::SettingsUpdate { settings: None, output: Some(video) })).await;
    assert_eq!(refusal.reason, "TOO_MANY_VIDEOS", "{refusal:?}");
    // Who asks for something else, or leaves, gives the place back.
    let change = |to| Up::Settings(wire::SettingsUpdate { settings: None, output: Some(to) });
    first.send(change(output(wire::Encoding::Jpeg))).await;
    let wrong = wire::OutputSettings { jpeg_quality: 101, ..video };
    // Answered, so that what was sent before has been taken.
    assert_eq!(first.refused(change(wrong)).await.code, Code::InvalidArgument as i32);
    let second = Viewer::open_as(&server, open(), Transport::Session).await.unwrap();
    second.leave().await;
    let third = Viewer::open_as(&server, open(), Transport::Interact).await.unwrap();
    third.leave().await;
    first.leave().await;
    other.leave().await;
}
