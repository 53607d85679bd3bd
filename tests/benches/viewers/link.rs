//! Frames over a link that is slow and long: how long they wait, at which rate they come, and what a download beside them leaves them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use lumisphere_proto::v1alpha1 as wire;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::sync::mpsc;
use tonic::transport::{Channel, Endpoint};
use wire::datasets_client::DatasetsClient;
use wire::interact_request::Message as Up;
use wire::interact_response::Message as Down;
use wire::rendering_client::RenderingClient;

use super::{POSE, SECONDS, Server, Stand, Viewer, bound, own_millis, quantile};

/// Of the figures of "How good" in the interface's own words.
const SLOW: Way = Way { bits_per_second: 5e6, round_trip: Duration::from_millis(100) };
/// How late timers may fire.
const TIMER: Duration = Duration::from_millis(5);
/// What a socket of the proxy holds: as much as a router does.
const SOCKET_BYTES: u32 = 32 << 10;
const PACKET_BYTES: usize = 1400;
const DOWNLOAD_BYTES: usize = 64 << 20;
/// Of a moving viewer who does not say.
const USUAL_RATE: f64 = 30.0;

/// What a link is like, each direction by itself.
#[derive(Debug, Clone, Copy)]
struct Way {
    bits_per_second: f64,
    round_trip: Duration,
}

/// A proxy whose connections share one link.
struct Link {
    url: String,
    way: Way,
    /// Bytes that came down.
    carried: Arc<AtomicU64>,
}

/// One direction: when it has sent what is on it.
type Free = Arc<Mutex<Instant>>;

impl Link {
    async fn before(server: &Server, way: Way) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("an address"));
        let behind = server.url.trim_start_matches("http://").parse().expect("an address");
        let carried = Arc::new(AtomicU64::new(0));
        let downward = carried.clone();
        tokio::spawn(async move {
            let [up, down]: [Free; 2] = [(); 2].map(|()| Arc::new(Mutex::new(Instant::now())));
            while let Ok((client, _)) = listener.accept().await {
                let socket = TcpSocket::new_v4().expect("a socket");
                socket.set_recv_buffer_size(SOCKET_BYTES).expect("a small buffer");
                let server: TcpStream = socket.connect(behind).await.expect("the server listens");
                client.set_nodelay(true).and_then(|()| server.set_nodelay(true)).expect("sockets");
                let (near, far) = client.into_split();
                let (back, forth) = server.into_split();
                tokio::spawn(carry(near, forth, way, up.clone(), Arc::default()));
                tokio::spawn(carry(back, far, way, down.clone(), downward.clone()));
            }
        });
        Self { url, way, carried }
    }

    async fn channel(&self) -> Channel {
        Endpoint::from_shared(self.url.clone()).expect("an address").tcp_nodelay(true).connect().await.expect("the proxy listens")
    }

    fn seconds(&self, bytes: usize) -> f64 {
        8.0 * bytes as f64 / self.way.bits_per_second
    }
}

/// Carries bytes from one socket to the other, each so long after it came, no more of them than the link takes.
async fn carry(
    mut from: impl AsyncReadExt + Unpin,
    mut to: impl AsyncWriteExt + Unpin + Send + 'static,
    way: Way,
    free: Free,
    carried: Arc<AtomicU64>,
) {
    let (pieces, mut waiting) = mpsc::channel::<(Instant, Vec<u8>)>(1 << 12);
    tokio::spawn(async move {
        while let Some((at, piece)) = waiting.recv().await {
            tokio::time::sleep_until((at + way.round_trip / 2).into()).await;
            carried.fetch_add(piece.len() as u64, Ordering::Relaxed);
            if to.write_all(&piece).await.is_err() {
                return;
            }
        }
    });
    let mut buffer = vec![0; PACKET_BYTES];
    while let Ok(count) = from.read(&mut buffer).await
        && count > 0
    {
        // A router's queue: what comes waits until the link has sent what came before. A timer that fires late takes nothing off the link.
        let sent = {
            let (now, mut free) = (Instant::now(), free.lock().expect("no panic"));
            *free = if *free + TIMER < now { now } else { *free } + Duration::from_secs_f64(8.0 * count as f64 / way.bits_per_second);
            *free
        };
        tokio::time::sleep_until(sent.into()).await;
        if pieces.send((sent, buffer[..count].to_vec())).await.is_err() {
            return;
        }
    }
}

/// What a viewer who always moves gets.
#[derive(Default)]
struct Received {
    /// Milliseconds.
    waits: Vec<f64>,
    on_the_link: Vec<f64>,
    ages: Vec<f64>,
    intervals: Vec<f64>,
    widths: Vec<f64>,
    kilobytes: Vec<f64>,
    /// Of the link, by everything that it carried.
    used: f64,
}

impl Received {
    fn rate(&self) -> f64 {
        1e3 * self.intervals.len() as f64 / self.intervals.iter().sum::<f64>()
    }
}

/// A pose every 16 ms, as from a screen; the first fifth of the time is not counted.
async fn move_on(viewer: &mut Viewer, link: &Link) -> Received {
    let mut seen = Received::default();
    let (begun, mut sent) = (Instant::now(), BTreeMap::new());
    let (mut before, mut measured, mut last_frame) = (0, begun, begun);
    let mut poses = tokio::time::interval(POSE);
    while begun.elapsed() < SECONDS {
        tokio::select! {
            _ = poses.tick() => {
                viewer.step().await;
                sent.insert(viewer.steps, Instant::now());
            }
            frame = viewer.down.message() => {
                let Some(Down::Frame(frame)) = frame.expect("a frame").and_then(|response| response.message) else { continue };
                viewer.send(Up::Acknowledge(wire::FrameAcknowledgement { frame_id: frame.frame_id })).await;
                let interval = 1e3 * last_frame.elapsed().as_secs_f64();
                last_frame = Instant::now();
                if begun.elapsed() < SECONDS / 5 {
                    (before, measured) = (link.carried.load(Ordering::Relaxed), last_frame);
                    continue;
                }
                let (age, on_the_link) = (sent[&frame.pose_id].elapsed().as_secs_f64(), link.seconds(frame.color.len()));
                seen.waits.push(1e3 * (age - link.way.round_trip.as_secs_f64() - on_the_link - 1e-3 * own_millis(&frame)).max(0.0));
                seen.on_the_link.push(1e3 * on_the_link);
                seen.ages.push(1e3 * age);
                seen.intervals.push(interval);
                seen.widths.push(f64::from(frame.width_px));
                seen.kilobytes.push(1e-3 * frame.color.len() as f64);
            }
        }
    }
    let bits = 8.0 * (link.carried.load(Ordering::Relaxed) - before) as f64;
    seen.used = bits / measured.elapsed().as_secs_f64() / link.way.bits_per_second;
    seen
}

/// What frames wait for one another.
pub async fn link(server: &Server, stand: &Stand) {
    let link = Link::before(server, SLOW).await;
    // 1 + ⌈round trip × rate⌉, as the interface asks of clients: 15 frames a second fit, the round trip of one is 100 + 66 ms.
    let mut viewer = Viewer::open(RenderingClient::new(link.channel().await), *stand, (320, 240), 4).await;
    let mut seen = move_on(&mut viewer, &link).await;
    let (wait, interval) = (quantile(&mut seen.waits, 0.95), quantile(&mut seen.intervals, 0.5));
    let own_time = quantile(&mut seen.on_the_link, 0.5);
    println!("\nlink: {} frames, each {own_time:.1} ms on the link, one every {interval:.1} ms (medians)", seen.waits.len());
    bound("a frame waits for others, 95 %, ms, against the interval", wait, interval, wait <= interval);
    bound("of the link used", seen.used, 0.8, seen.used >= 0.8);
}

/// The rate that is asked for, on links that full frames of 640 × 480 do not fit.
pub async fn rate(server: &Server, stand: &Stand) {
    println!("\nrate: {USUAL_RATE} frames a second asked for, 640×480");
    for (megabits, millis) in [(1000.0, 0), (20.0, 40), (5.0, 100), (2.0, 100)] {
        let link = Link::before(server, Way { bits_per_second: 1e6 * megabits, round_trip: Duration::from_millis(millis) }).await;
        // One on the screen, those on the way, one on the link and one that is drawn.
        let credits = (3.0 + (1e-3 * millis as f64 * USUAL_RATE).ceil()) as u32;
        let client = RenderingClient::new(link.channel().await);
        let mut viewer = Viewer::open_at(client, *stand, (640, 480), credits, USUAL_RATE as f32).await;
        let mut seen = move_on(&mut viewer, &link).await;
        let [width, kilobytes, age] = [&mut seen.widths, &mut seen.kilobytes, &mut seen.ages].map(|values| quantile(values, 0.5));
        println!(
            "  {megabits} Mbit/s, {millis} ms: {width} pixels wide, {kilobytes:.1} kB, {age:.0} ms from the pose to the frame (medians)"
        );
        bound("frames a second", seen.rate(), 0.9 * USUAL_RATE, seen.rate() >= 0.9 * USUAL_RATE);
    }
}

/// What a download leaves of the frames: alone, then beside one of the same connection and one of another.
pub async fn bulk(server: &Server, stand: &Stand) {
    let file = tempfile::NamedTempFile::new().expect("a file");
    // Nothing on the way makes it shorter.
    let noise: Vec<u8> = (0..DOWNLOAD_BYTES as u64).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 56) as u8).collect();
    std::fs::write(file.path(), noise).expect("room on the disk");
    let uploaded = server.json(&["blob", "upload", file.path().to_str().expect("a path"), "--quiet"]);
    let blake3 = uploaded["blake3"].as_str().expect("its hash").to_string();
    for (megabits, millis) in [(5.0, 100), (100.0, 20)] {
        let link = Link::before(server, Way { bits_per_second: 1e6 * megabits, round_trip: Duration::from_millis(millis) }).await;
        println!("\nbulk: {megabits} Mbit/s, {millis} ms");
        let mut alone = None;
        for beside in ["nothing", "a download of the same connection", "a download of another"] {
            let channel = link.channel().await;
            let bulk = match beside {
                "nothing" => None,
                "a download of another" => Some(link.channel().await),
                _ => Some(channel.clone()),
            };
            let downloading = bulk.map(|channel| tokio::spawn(download(DatasetsClient::new(channel), blake3.clone())));
            let mut viewer = Viewer::open(RenderingClient::new(channel), *stand, (320, 240), 4).await;
            let mut seen = move_on(&mut viewer, &link).await;
            if let Some(downloading) = downloading {
                downloading.abort();
            }
            let (rate, age, slow) = (seen.rate(), quantile(&mut seen.ages, 0.5), quantile(&mut seen.ages, 0.95));
            println!(
                "  beside {beside}: {rate:.1} frames/s, from pose to frame {age:.0} ms, 95 % {slow:.0} ms, link used {:.2}",
                seen.used
            );
            let before = *alone.get_or_insert(rate);
            if beside != "nothing" {
                bound("frames a second / those alone", rate / before, 0.4, rate >= 0.4 * before);
            }
        }
    }
}

/// Again and again, until it is aborted.
async fn download(mut client: DatasetsClient<Channel>, blake3: String) {
    loop {
        let request = wire::DownloadBlobRequest { blake3: blake3.clone(), ..Default::default() };
        let mut chunks = client.download_blob(request).await.expect("a download").into_inner();
        while chunks.message().await.expect("a chunk").is_some() {}
    }
}
