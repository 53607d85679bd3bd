//! A link that is opened by hand, and a viewer behind it.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex};
use std::thread;
use std::time::Duration;

use lumisphere_proto::v1alpha1 as wire;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::{Channel, Endpoint};
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::rendering_client::RenderingClient;

use crate::process::{PATIENCE, Server};
use crate::viewers::opening;
use crate::wire::camera_around;

/// What the gate's socket holds: as much as a router does.
const SOCKET_BYTES: usize = 32 << 10;
/// Let through at a time.
pub const STEP_BYTES: u64 = 16 << 10;

/// Between a client and a server: what comes down passes as far as the gate is open.
pub struct Gate {
    address: SocketAddr,
    state: Arc<(Mutex<Option<u64>>, Condvar)>,
}

impl Gate {
    /// Open.
    pub fn before(server: &Server) -> Self {
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

    /// A connection through it; the only one.
    pub async fn channel(&self) -> Channel {
        Endpoint::from_shared(format!("http://{}", self.address)).unwrap().connect().await.unwrap()
    }

    /// So many bytes from now on; None: all.
    pub fn set(&self, bytes: Option<u64>) {
        *self.state.0.lock().unwrap() = bytes;
        self.state.1.notify_all();
    }

    /// Lets so many bytes through and waits until they have passed.
    pub fn let_through(&self, bytes: u64) {
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
pub struct Looking {
    up: mpsc::Sender<wire::InteractRequest>,
    down: tonic::Streaming<wire::InteractResponse>,
}

impl Looking {
    /// With one credit.
    pub async fn open(channel: Channel) -> Self {
        let (up, messages) = mpsc::channel(16);
        up.send(wire::InteractRequest { message: Some(Up::Open(opening(1))) }).await.unwrap();
        let down = RenderingClient::new(channel).interact(ReceiverStream::new(messages)).await.unwrap().into_inner();
        Self { up, down }
    }

    /// From there.
    pub async fn look(&self, pose_id: u64) {
        let camera = Some(camera_around(0.1 * pose_id as f32, 64, 48));
        self.up.send(wire::InteractRequest { message: Some(Up::Pose(wire::PoseUpdate { pose_id, camera })) }).await.unwrap();
    }

    /// Acknowledged; None while none comes for so long.
    pub async fn frame(&mut self, patience: Duration) -> Option<wire::Frame> {
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
