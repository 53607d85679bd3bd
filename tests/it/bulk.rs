//! Downloads beside frames: on a link that is full of a download a frame waits for little of it.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex};
use std::thread;
use std::time::Duration;

use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::{Channel, Endpoint};
use wire::datasets_client::DatasetsClient;
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::rendering_client::RenderingClient;

use crate::clients::with_dataset;
use crate::process::{PATIENCE, Server};
use crate::system::metric;
use crate::viewers::opening;
use crate::wire::camera_around;

/// Several times what a kernel holds for a connection that does not get on.
const BLOB_BYTES: usize = 24 << 20;
/// What the gate's socket holds: as much as a router does.
const SOCKET_BYTES: usize = 32 << 10;
/// Let through at a time.
const STEP_BYTES: u64 = 16 << 10;
/// Let through before a frame of 14 kB has come: both sockets, the frame, as much of the download in turn with it, and half as much again.
const MOST_BYTES: u64 = 384 << 10;

/// Between a client and a server: what comes down passes as far as the gate is open.
struct Gate {
    address: SocketAddr,
    state: Arc<(Mutex<Option<u64>>, Condvar)>,
}

impl Gate {
    /// Open.
    fn before(server: &Server) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let behind: SocketAddr = server.address().host.parse().unwrap();
        let state = Arc::new((Mutex::new(None), Condvar::new()));
        let gate = state.clone();
        thread::spawn(move || {
            let (near, _) = listener.accept().unwrap();
            let far = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
            // Before the connection: it decides how much the server may send ahead.
            far.set_recv_buffer_size(SOCKET_BYTES).unwrap();
            far.connect(&behind.into()).unwrap();
            let far = TcpStream::from(far);
            near.set_nodelay(true).and_then(|()| far.set_nodelay(true)).unwrap();
            let (mut up, mut to_server) = (near.try_clone().unwrap(), far.try_clone().unwrap());
            thread::spawn(move || std::io::copy(&mut up, &mut to_server));
            pass(far, near, &gate);
        });
        Self { address, state }
    }

    fn set(&self, bytes: Option<u64>) {
        *self.state.0.lock().unwrap() = bytes;
        self.state.1.notify_all();
    }

    /// Lets so many bytes through and waits until they have passed.
    fn let_through(&self, bytes: u64) {
        self.set(Some(bytes));
        let left = self.state.0.lock().unwrap();
        let is_waiting = |left: &mut Option<u64>| *left != Some(0);
        let (_left, waited) = self.state.1.wait_timeout_while(left, PATIENCE, is_waiting).unwrap();
        assert!(!waited.timed_out(), "nothing comes down");
    }
}

fn pass(mut from: TcpStream, mut to: TcpStream, gate: &(Mutex<Option<u64>>, Condvar)) {
    let mut buffer = vec![0; STEP_BYTES as usize];
    loop {
        let open = gate.1.wait_while(gate.0.lock().unwrap(), |left| *left == Some(0)).unwrap().unwrap_or(STEP_BYTES);
        let most = open.min(STEP_BYTES) as usize;
        let Ok(count @ 1..) = from.read(&mut buffer[..most]) else { break };
        if to.write_all(&buffer[..count]).is_err() {
            break;
        }
        let mut left = gate.0.lock().unwrap();
        *left = left.map(|left| left.saturating_sub(count as u64));
        gate.1.notify_all();
    }
    let _ = to.shutdown(Shutdown::Both);
}

/// A viewer on a channel of its own making.
struct Looking {
    up: mpsc::Sender<wire::InteractRequest>,
    down: tonic::Streaming<wire::InteractResponse>,
}

impl Looking {
    async fn open(channel: Channel) -> Self {
        let (up, messages) = mpsc::channel(16);
        up.send(wire::InteractRequest { message: Some(Up::Open(opening(1))) }).await.unwrap();
        let down = RenderingClient::new(channel).interact(ReceiverStream::new(messages)).await.unwrap().into_inner();
        Self { up, down }
    }

    async fn look(&self, pose_id: u64) {
        let camera = Some(camera_around(0.1 * pose_id as f32, 64, 48));
        self.up.send(wire::InteractRequest { message: Some(Up::Pose(wire::PoseUpdate { pose_id, camera })) }).await.unwrap();
    }

    /// None while none comes for so long.
    async fn frame(&mut self, patience: Duration) -> Option<wire::Frame> {
        loop {
            let message = tokio::time::timeout(patience, self.down.message()).await.ok()?;
            if let Some(Down::Frame(frame)) = message.unwrap().expect("the stream goes on").message {
                let acknowledgement = wire::FrameAcknowledgement { frame_id: frame.frame_id };
                self.up.send(wire::InteractRequest { message: Some(Up::Acknowledge(acknowledgement)) }).await.unwrap();
                return Some(frame);
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_waits_for_little_of_a_download_of_the_same_connection() {
    let (folder, server) = with_dataset().await;
    let file = folder.path().join("noise.bin");
    let noise: Vec<u8> = (0..BLOB_BYTES as u64).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8).collect();
    std::fs::write(&file, noise).unwrap();
    let blake3 = server.json(&["blob", "upload", file.to_str().unwrap(), "--quiet"])["blake3"].as_str().unwrap().to_string();
    let gate = Gate::before(&server);
    let channel = Endpoint::from_shared(format!("http://{}", gate.address)).unwrap().connect().await.unwrap();
    let mut looking = Looking::open(channel.clone()).await;
    looking.look(1).await;
    looking.frame(PATIENCE).await.expect("a frame");

    let request = wire::DownloadBlobRequest { blake3, ..Default::default() };
    let mut chunks = DatasetsClient::new(channel).download_blob(request).await.unwrap().into_inner();
    chunks.message().await.unwrap().expect("it has begun");
    gate.set(Some(0));
    let downloading = tokio::spawn(async move { while chunks.message().await.is_ok_and(|chunk| chunk.is_some()) {} });
    // Rendered while the download fills whatever takes it.
    let before = metric(&server, "render_frames_total");
    looking.look(2).await;
    let began = std::time::Instant::now();
    while metric(&server, "render_frames_total") == before {
        assert!(began.elapsed() < PATIENCE, "no frame is rendered");
    }
    let mut passed = 0;
    let frame = loop {
        tokio::task::block_in_place(|| gate.let_through(STEP_BYTES));
        passed += STEP_BYTES;
        // Time to read what has passed.
        if let Some(frame) = looking.frame(Duration::from_millis(20)).await {
            break frame;
        }
        assert!(passed < BLOB_BYTES as u64 / 2, "no frame among {passed} bytes");
    };
    assert_eq!(frame.pose_id, 2);
    assert!(passed <= MOST_BYTES, "{passed} bytes passed before a frame of {}", frame.color.len());
    assert!(!downloading.is_finished(), "the download goes on");
    gate.set(None);
    downloading.await.unwrap();
}
