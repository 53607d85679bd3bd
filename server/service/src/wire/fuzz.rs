//! Random bytes as every request: decoded and checked as the handlers do, in this process, nothing done. It never panics, and what it takes
//! keeps the bounds that its errors tell of.
//!
//! `FUZZ_INPUTS=10000000 cargo test --release --workspace --features lumisphere-server/h264 --bins wire::fuzz -- --nocapture` checks more;
//! `FUZZ_SEED` begins elsewhere. `tests/it/fuzz` sends to a live server.

// The same spoiler of messages; some of it serves the live one alone.
#[allow(dead_code)]
#[path = "../../../../tests/it/fuzz/messages.rs"]
mod messages;

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::panic::{AssertUnwindSafe, catch_unwind};

use lumisphere::textures::Trace;
use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage, MessageDescriptor};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_pcg::Pcg32;

use self::messages::{Words, any, changed, damaged, dynamic};
use super::camera::camera;
use super::jobs::{SpecLimits, digest, job_spec, recalled, remembered, request_id};
use super::settings::{Delivery, output, render_settings, stored_settings};
use super::{FILE_DESCRIPTOR_SET, MAX_REQUEST_BYTES, cache, dataset_name, hash, job_page_token, page_size, proto, replay};
use crate::errors::ApiError;

/// Checked by the test command.
const INPUTS: u64 = 1_000_000;
const LIMITS: SpecLimits = SpecLimits { max_pixels: 1 << 20, max_cameras: 16 };

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name} is {text:?}: a number expected")))
}

/// What became of an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Outcome {
    NoMessage,
    Refused,
    Taken,
}

fn decoded<M: Message + Default>(bytes: &[u8], check: impl FnOnce(M) -> Result<(), ApiError>) -> Outcome {
    match M::decode(bytes).map(check) {
        Err(_) => Outcome::NoMessage,
        Ok(Err(error)) => {
            // What the client is told: a sentence, and not the whole of a long value. Headers have no room for more.
            let status = tonic::Status::from(error);
            assert!(!status.message().is_empty() && status.message().len() < 2048 && status.details().len() < 4096, "{status:?}");
            Outcome::Refused
        }
        Ok(Ok(())) => Outcome::Taken,
    }
}

fn seen(message: Option<proto::Camera>) -> Result<(), ApiError> {
    let camera = camera(message, LIMITS.max_pixels, "camera")?;
    let size = camera.intrinsics();
    assert!((1..=LIMITS.max_pixels).contains(&(u64::from(size.width_px) * u64::from(size.height_px))), "{size:?}");
    Ok(())
}

fn pose(update: proto::PoseUpdate) -> Result<(), ApiError> {
    seen(update.camera)
}

fn settings(update: proto::SettingsUpdate) -> Result<(), ApiError> {
    update.settings.map(|m| render_settings(Some(m), "settings")).transpose()?;
    update.output.map(|m| output(Some(m), Delivery::Stream, "output")).transpose().map(drop)
}

fn opened(open: Option<proto::OpenInteraction>) -> Result<(), ApiError> {
    let open = super::required(open, "open")?;
    dataset_name(&open.dataset, "open.dataset")?;
    render_settings(open.settings, "open.settings")?;
    output(open.output, Delivery::Stream, "open.output").map(drop)
}

fn job(message: Option<proto::JobSpec>) -> Result<(), ApiError> {
    let spec = job_spec(message.clone(), &LIMITS)?;
    let message = message.expect("it was taken");
    // What a restarted server reads back is the same job.
    let again = recalled(&remembered(message.clone(), None)).expect("what was remembered");
    assert_eq!(digest(&again), digest(&message), "{:?}", spec.kind());
    Ok(())
}

/// The method's request, checked as its handler does. None for a method that nobody has thought of.
fn check(method: &str, bytes: &[u8]) -> Option<Outcome> {
    Some(match method {
        "RenderFrame" => decoded::<proto::RenderFrameRequest>(bytes, |m| {
            dataset_name(&m.dataset, "dataset")?;
            seen(m.camera)?;
            render_settings(m.settings, "settings")?;
            output(m.output, Delivery::Alone, "output").map(drop)
        }),
        "Interact" => decoded::<proto::InteractRequest>(bytes, |m| match m.message {
            Some(proto::interact_request::Message::Open(m)) => opened(Some(m)),
            Some(proto::interact_request::Message::Pose(m)) => pose(m),
            Some(proto::interact_request::Message::Settings(m)) => settings(m),
            Some(proto::interact_request::Message::Acknowledge(_)) => Ok(()),
            None => super::required(None, "message"),
        }),
        "OpenSession" => decoded::<proto::OpenSessionRequest>(bytes, |m| opened(m.open)),
        "UpdateSession" => decoded::<proto::UpdateSessionRequest>(bytes, |m| {
            m.pose.map(pose).transpose()?;
            m.settings.map(settings).transpose().map(drop)
        }),
        "StreamFrames" => decoded::<proto::StreamFramesRequest>(bytes, |_| Ok(())),
        "CloseSession" => decoded::<proto::CloseSessionRequest>(bytes, |_| Ok(())),
        "SubmitJob" => decoded::<proto::SubmitJobRequest>(bytes, |m| {
            request_id(m.request_id)?;
            job(m.spec)
        }),
        "GetJob" => decoded::<proto::GetJobRequest>(bytes, |_| Ok(())),
        "CancelJob" => decoded::<proto::CancelJobRequest>(bytes, |_| Ok(())),
        "WatchJob" => decoded::<proto::WatchJobRequest>(bytes, |_| Ok(())),
        "ListJobs" => decoded::<proto::ListJobsRequest>(bytes, |m| {
            page_size(m.page_size, "page_size")?;
            job_page_token(&m.page_token, "page_token").map(drop)
        }),
        "GetCacheStats" => decoded::<proto::GetCacheStatsRequest>(bytes, |_| Ok(())),
        "ClearCache" => decoded::<proto::ClearCacheRequest>(bytes, |_| Ok(())),
        "WatchCacheStats" => decoded::<proto::WatchCacheStatsRequest>(bytes, |m| cache::interval(m.interval_seconds).map(drop)),
        "ConfigureCache" => decoded::<proto::ConfigureCacheRequest>(bytes, |m| cache::cache_change(&m).map(drop)),
        "RecordTraffic" => decoded::<proto::RecordTrafficRequest>(bytes, |m| cache::traffic_time(m.seconds).map(drop)),
        "RecordTrace" => decoded::<proto::RecordTraceRequest>(bytes, |m| {
            cache::recording(&m)?;
            m.cameras.into_iter().take(LIMITS.max_cameras).try_for_each(|camera| seen(Some(camera)))?;
            stored_settings(m.settings, "settings").map(drop)
        }),
        "ReplayTrace" => decoded::<proto::ReplayTraceRequest>(bytes, |m| match m.message {
            Some(proto::replay_trace_request::Message::Settings(m)) => {
                let cells = replay::replay_plan(&m)?.cells().count();
                assert!((1..=256).contains(&cells), "{cells} outcomes");
                Ok(())
            }
            Some(proto::replay_trace_request::Message::Trace(bytes)) => {
                Trace::from_bytes(&bytes).map(drop).map_err(|error| ApiError::field("trace", error))
            }
            None => Ok(()),
        }),
        "CreateDataset" => decoded::<proto::CreateDatasetRequest>(bytes, |m| dataset_name(&m.name, "name").map(drop)),
        "GetDataset" => decoded::<proto::GetDatasetRequest>(bytes, |m| dataset_name(&m.name, "name").map(drop)),
        "DeleteDataset" => decoded::<proto::DeleteDatasetRequest>(bytes, |m| dataset_name(&m.name, "name").map(drop)),
        "ListDatasets" => decoded::<proto::ListDatasetsRequest>(bytes, |m| page_size(m.page_size, "page_size").map(drop)),
        "ListDatasetFiles" => decoded::<proto::ListDatasetFilesRequest>(bytes, |m| dataset_name(&m.dataset, "dataset").map(drop)),
        "BeginBlob" => decoded::<proto::BeginBlobRequest>(bytes, |m| hash(&m.blake3, "blake3").map(drop)),
        "UploadBlob" | "PutChunk" => decoded::<proto::BlobChunk>(bytes, |m| hash(&m.blake3, "blake3").map(drop)),
        "DownloadBlob" => decoded::<proto::DownloadBlobRequest>(bytes, |m| hash(&m.blake3, "blake3").map(drop)),
        "GetVersion" => decoded::<proto::GetVersionRequest>(bytes, |_| Ok(())),
        "GetServerInfo" => decoded::<proto::GetServerInfoRequest>(bytes, |_| Ok(())),
        "MeasureLink" => decoded::<proto::MeasureLinkRequest>(bytes, |_| Ok(())),
        _ => return None,
    })
}

/// A message, of its own kind.
type Make = dyn Fn(&MessageDescriptor) -> DynamicMessage;

/// Requests that are taken, to be spoiled.
fn right(method: &str) -> Vec<Box<Make>> {
    use proto::interact_request::Message as Up;
    use proto::offset_surface_light_field_settings::{Blend, Component};
    fn as_is<M: Message + 'static>(message: M) -> Box<Make> {
        Box::new(move |kind| dynamic(kind, &message))
    }
    let oslf =
        proto::OffsetSurfaceLightFieldSettings { component: Component::Full.into(), blend: Blend::Corrected.into(), ..Default::default() };
    let settings = proto::RenderSettings {
        representation: Some(proto::render_settings::Representation::OffsetSurfaceLightField(oslf)),
        ..Default::default()
    };
    let output = proto::OutputSettings { encoding: proto::Encoding::Jpeg.into(), ..Default::default() };
    let vector = |x, y, z| Some(proto::Vector3 { x, y, z });
    let camera = proto::Camera {
        pose: Some(proto::Pose {
            position: vector(0.0, 0.0, 3.0),
            right: vector(1.0, 0.0, 0.0),
            up: vector(0.0, 1.0, 0.0),
            backward: vector(0.0, 0.0, 1.0),
        }),
        intrinsics: Some(proto::Intrinsics { width_px: 32, height_px: 24, focal_x_px: 30.0, ..Default::default() }),
    };
    let pose = proto::PoseUpdate { pose_id: 1, camera: Some(camera) };
    let open = proto::OpenInteraction {
        dataset: "tea".into(),
        settings: Some(settings.clone()),
        output: Some(output),
        credits: 2,
        ..Default::default()
    };
    let scene = proto::SceneSource {
        source: Some(proto::scene_source::Source::Builtin(proto::BuiltinScene { name: "gazebo".into(), ..Default::default() })),
        environment: None,
    };
    let spec = |spec| as_is(proto::SubmitJobRequest { spec: Some(proto::JobSpec { spec: Some(spec) }), ..Default::default() });
    match method {
        "RenderFrame" => vec![as_is(proto::RenderFrameRequest {
            dataset: "tea".into(),
            camera: Some(camera),
            settings: Some(settings),
            output: Some(output),
            ..Default::default()
        })],
        "Interact" => [
            Up::Open(open),
            Up::Pose(pose),
            Up::Settings(proto::SettingsUpdate { settings: Some(settings), output: Some(output) }),
            Up::Acknowledge(proto::FrameAcknowledgement { frame_id: 1 }),
        ]
        .map(|message| as_is(proto::InteractRequest { message: Some(message) }))
        .into(),
        "OpenSession" => vec![as_is(proto::OpenSessionRequest { open: Some(open) })],
        "UpdateSession" => vec![as_is(proto::UpdateSessionRequest {
            session_id: "1".into(),
            sequence: 1,
            pose: Some(pose),
            settings: Some(proto::SettingsUpdate { settings: Some(settings), output: Some(output) }),
            acknowledge: None,
        })],
        "RecordTrace" => vec![as_is(proto::RecordTraceRequest {
            dataset: "tea".into(),
            cameras: vec![camera],
            settings: Some(settings),
            ..Default::default()
        })],
        "SubmitJob" => vec![
            spec(proto::job_spec::Spec::Capture(proto::CaptureSpec {
                scene: Some(scene.clone()),
                object: "teapot".into(),
                dataset: "tea".into(),
                ..Default::default()
            })),
            spec(proto::job_spec::Spec::Thin(proto::ThinSpec {
                dataset: "tea".into(),
                into: "cup".into(),
                max_error: 2.0,
                settings: Some(settings),
                ..Default::default()
            })),
            spec(proto::job_spec::Spec::Replace(proto::ReplaceSpec {
                dataset: "tea".into(),
                into: "cup".into(),
                scene: Some(scene),
                object: "cup".into(),
                ..Default::default()
            })),
        ],
        _ => vec![],
    }
}

#[test]
fn no_bytes_of_any_request_panic_or_are_taken_beyond_the_bounds() {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("our descriptors");
    let methods: Vec<_> = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()).collect();
    let right: Vec<_> = methods.iter().map(|method| right(method.name())).collect();
    let words = Words(["tea", "other", "gazebo", "teapot", "jobs/1", "none", "auto", "phong:2", "sh:16"].map(String::from).into());
    let (inputs, seed) = (number("FUZZ_INPUTS", INPUTS), number("FUZZ_SEED", 1));
    let mut rng = Pcg32::new(seed, 0);
    let mut told: BTreeMap<(&str, Outcome), u64> = BTreeMap::new();
    for at in 0..inputs {
        let number = (at % methods.len() as u64) as usize;
        let (method, kind) = (&methods[number], methods[number].input());
        let mut message = match right[number].choose(&mut rng) {
            Some(right) if rng.random_bool(0.8) => right(&kind),
            _ => any(&kind, &words, &mut rng),
        };
        (0..rng.random_range(0..4)).for_each(|_| changed(&mut message, &words, &mut rng));
        let mut bytes = message.encode_to_vec();
        if rng.random_bool(0.3) {
            bytes = damaged(bytes, &mut rng);
        }
        // Longer ones are refused before they are decoded.
        bytes.truncate(MAX_REQUEST_BYTES);
        let outcome = catch_unwind(AssertUnwindSafe(|| check(method.name(), &bytes)));
        let outcome = outcome.unwrap_or_else(|_| panic!("input {at} of seed {seed}, {}: {bytes:02x?}", method.full_name()));
        *told.entry((method.name(), outcome.unwrap_or_else(|| panic!("{} is checked by nobody", method.name())))).or_default() += 1;
    }
    println!("{told:?}");
    for (method, right) in methods.iter().zip(&right).filter(|(_, right)| !right.is_empty()) {
        for outcome in [Outcome::NoMessage, Outcome::Refused, Outcome::Taken] {
            assert!(told.contains_key(&(method.name(), outcome)), "{}, {} kinds: never {outcome:?}", method.name(), right.len());
        }
    }
}
