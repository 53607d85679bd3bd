//! Random requests to every rpc of a live server. It answers each, with an error that says whose fault it is; nothing panics, memory stays
//! bounded, and afterwards the same frame has the same pixels.
//!
//! `FUZZ_REQUESTS=1000000 cargo test --release --workspace --test it fuzz -- --nocapture` sends more; `FUZZ_SEED` begins elsewhere.

mod messages;
mod raw;

use std::collections::BTreeMap;

use lumisphere_proto::{FILE_DESCRIPTOR_SET, v1alpha1 as wire};
use prost::Message;
use prost_reflect::{DescriptorPool, DynamicMessage, MethodDescriptor};
use rand::RngExt;
use rand::seq::IndexedRandom;
use rand_pcg::Pcg32;
use tonic::{Code, Status};
use wire::interact_request::Message as Up;

use self::messages::{Words, any, changed, damaged, dynamic};
use crate::process::{PATIENCE, Server, temporary_folder};
use crate::tiny::{self, DATASET};
use crate::wire::{camera, code_and_reason, frame_request, output, settings};

/// Sent by the test command.
const REQUESTS: u64 = 4000;

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name} is {text:?}: a number expected")))
}

fn open() -> wire::OpenInteraction {
    use wire::offset_surface_light_field_settings::{Blend, Component};
    wire::OpenInteraction {
        dataset: DATASET.into(),
        version: 0,
        settings: Some(settings(Component::Full, Blend::Corrected)),
        output: Some(output(wire::Encoding::Jpeg)),
        credits: 2,
        moving_frames_per_second: Some(30.0),
    }
}

fn pose() -> wire::PoseUpdate {
    wire::PoseUpdate { pose_id: 1, camera: Some(camera(32, 24)) }
}

/// Requests that the server takes, to be spoiled. None: nothing has to be right.
fn right(method: &MethodDescriptor, session_id: &str, rng: &mut Pcg32) -> Vec<DynamicMessage> {
    let session_id = session_id.to_string();
    let of = |message: &dyn Fn() -> Vec<u8>| DynamicMessage::decode(method.input(), &message()[..]).expect("of that kind");
    let interact = |message: Up| dynamic(&method.input(), &wire::InteractRequest { message: Some(message) });
    match method.name() {
        "RenderFrame" => vec![of(&|| frame_request(DATASET).encode_to_vec())],
        "OpenSession" => vec![of(&|| wire::OpenSessionRequest { open: Some(open()) }.encode_to_vec())],
        "UpdateSession" => {
            let request = wire::UpdateSessionRequest {
                session_id,
                sequence: rng.random_range(1..100),
                pose: Some(pose()),
                settings: None,
                acknowledge: None,
            };
            vec![dynamic(&method.input(), &request)]
        }
        "StreamFrames" => vec![of(&|| wire::StreamFramesRequest { session_id: session_id.clone() }.encode_to_vec())],
        "Interact" => vec![
            interact(Up::Open(open())),
            interact(Up::Pose(pose())),
            interact(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: rng.random_range(0..50) })),
            interact(Up::Settings(wire::SettingsUpdate { settings: open().settings, output: open().output })),
            interact(Up::Pose(pose())),
        ],
        _ => vec![],
    }
}

/// The messages of one call.
fn request(method: &MethodDescriptor, words: &Words, session_id: &str, rng: &mut Pcg32) -> (Vec<Vec<u8>>, bool) {
    let mut messages = right(method, session_id, rng);
    if messages.is_empty() || rng.random_bool(0.3) {
        let count = if method.is_client_streaming() { rng.random_range(0..4) } else { 1 };
        messages = (0..count).map(|_| any(&method.input(), words, rng)).collect();
    }
    for _ in 0..rng.random_range(0..3) {
        let many = messages.len();
        if many > 0 {
            changed(&mut messages[rng.random_range(0..many)], words, rng);
        }
        // Out of order, or twice.
        if method.is_client_streaming() && many > 1 && rng.random_bool(0.3) {
            messages.swap(rng.random_range(0..many), rng.random_range(0..many));
        }
    }
    let is_damaged = rng.random_bool(0.1);
    let bytes = |message: DynamicMessage, rng: &mut Pcg32| {
        let bytes = message.encode_to_vec();
        if is_damaged { damaged(bytes, rng) } else { bytes }
    };
    (messages.into_iter().map(|message| bytes(message, rng)).collect(), is_damaged)
}

/// Whether the answer says whose fault it is. tonic calls bytes that are no message INTERNAL.
fn is_clear(status: &Status, is_damaged: bool) -> bool {
    let (code, reason) = code_and_reason(status);
    match code {
        Code::Unknown | Code::Unimplemented => false,
        Code::Internal => is_damaged && reason.is_empty(),
        Code::DataLoss => reason == "BLOB_HASH_MISMATCH",
        _ => !status.message().is_empty(),
    }
}

async fn send_many(server: &Server, methods: &[MethodDescriptor], requests: u64, mut rng: Pcg32) -> BTreeMap<(String, i32), u64> {
    let channel = server.channel().await;
    let mut words =
        Words([DATASET, "other", "gazebo", "jobs/1", "mirror", "none", "latest", "auto", "phong:2", "sh:16"].map(String::from).into());
    let (mut told, mut session_id) = (BTreeMap::new(), String::new());
    for at in 0..requests {
        let method = methods.choose(&mut rng).expect("rpcs");
        let (messages, is_damaged) = request(method, &words, &session_id, &mut rng);
        // The dataset is needed to the end.
        if method.name() == "DeleteDataset" && messages.iter().any(|m| m.windows(DATASET.len()).any(|w| w == DATASET.as_bytes())) {
            continue;
        }
        let shown = || format!("request {at}, {}: {messages:02x?}", method.full_name());
        let call = raw::call(channel.clone(), method, messages.clone());
        let answered = tokio::time::timeout(PATIENCE, call).await.unwrap_or_else(|_| panic!("no answer to {}", shown()));
        let code = answered.as_ref().err().map_or(Code::Ok, Status::code);
        if let Err(status) = &answered {
            assert!(is_clear(status, is_damaged), "{status:?} to {}", shown());
        }
        *told.entry((method.name().to_string(), code as i32)).or_default() += 1;
        let Some(first) = answered.ok().and_then(|answers| answers.into_iter().next()) else { continue };
        match method.name() {
            "OpenSession" => session_id = wire::OpenSessionResponse::decode(&first[..]).expect("an answer").session_id,
            "SubmitJob" => {
                let name = wire::Job::decode(&first[..]).expect("an answer").name;
                server.jobs().await.cancel_job(wire::CancelJobRequest { name: name.clone() }).await.expect("it was submitted");
                words.0.push(name);
            }
            _ => {}
        }
    }
    told
}

#[tokio::test(flavor = "multi_thread")]
async fn random_requests_to_every_rpc_get_clear_answers_and_change_no_pixel() {
    let folder = temporary_folder();
    // Frames small, so that many can be asked for; on the processor, whose arithmetic panics where it is wrong.
    let flags = ["--backend", "cpu", "--max-pixels-per-frame", "4096"];
    let server = Server::start_with(&folder.path().join("data"), &flags);
    tokio::task::block_in_place(|| tiny::capture(&server, folder.path()));
    let mut rendering = server.rendering().await;
    let before = rendering.render_frame(frame_request(DATASET)).await.unwrap().into_inner().color;
    server.forget_peak();
    let idle = server.resident_bytes();

    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("our descriptors");
    let methods: Vec<MethodDescriptor> = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()).collect();
    let (requests, seed) = (number("FUZZ_REQUESTS", REQUESTS), number("FUZZ_SEED", 1));
    let client = |sequence: u64| send_many(&server, &methods, requests / 4, Pcg32::new(seed, sequence));
    let (a, b, c, d) = tokio::join!(client(0), client(1), client(2), client(3));
    let mut all: BTreeMap<(String, i32), u64> = BTreeMap::new();
    [a, b, c, d].into_iter().flatten().for_each(|(key, count)| *all.entry(key).or_default() += count);
    println!("{all:?}");
    let rpcs: Vec<&str> = methods.iter().map(|method| method.name()).filter(|name| !all.keys().any(|(rpc, _)| rpc == name)).collect();
    assert!(rpcs.is_empty(), "never asked: {rpcs:?}");
    for rpc in ["RenderFrame", "Interact", "OpenSession", "UpdateSession", "ConfigureCache"] {
        assert!([Code::Ok, Code::InvalidArgument].iter().all(|code| all.contains_key(&(rpc.to_string(), *code as i32))), "{rpc}: {all:?}");
    }
    let log = server.log_text();
    assert!(!log.contains("panicked"), "{log}");
    let grown = server.peak_bytes().saturating_sub(idle);
    assert!(grown < 512 << 20, "{grown} bytes more than the idle server's {idle}");
    let after = rendering.render_frame(frame_request(DATASET)).await.unwrap().into_inner().color;
    assert!(before == after, "another picture");
    assert_eq!(server.stop(), Some(0));
}
