//! What gRPC adds to a frame: the client's round trip beside the time inside the server that each answer tells, 640 × 480, mirror
//! reflection, medians in milliseconds. Aimed at: at most 10 % + 2 ms.
//!
//! `cargo build --release --workspace --bins && cargo bench -p lumisphere-tests --bench grpc_overhead`

// Most of the tests' helpers are not needed here.
#[allow(dead_code)]
#[path = "../it/process.rs"]
mod process;

use std::time::Instant;

use lumisphere_proto::v1alpha1 as wire;
use wire::offset_surface_light_field_settings::{Blend, Component};

use process::{Server, temporary_folder};

const DATASET: &str = "teapot";
const WARM_UP: usize = 8;
const RUNS: usize = 41;
/// Coarse: what is measured does not depend on the texels.
const CAPTURE: [&str; 16] = [
    "--scene",
    "gazebo",
    "--object",
    "teapot",
    "--points",
    "100",
    "--face-size-texels",
    "64",
    "--samples-per-texel",
    "1",
    "--max-bounces",
    "1",
    "--dataset",
    DATASET,
    "--watch",
    "--quiet",
];

fn main() {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    server.succeed(&[&["job", "submit", "capture"], &CAPTURE[..]].concat());
    println!("encoding   in the server  round trip  added  allowed   bytes");
    runtime.block_on(async {
        for encoding in [wire::Encoding::RawZstd, wire::Encoding::Jpeg, wire::Encoding::Png] {
            measure(&server, encoding).await;
        }
    });
}

async fn measure(server: &Server, encoding: wire::Encoding) {
    let camera = camera(server).await;
    let request = || wire::RenderFrameRequest {
        dataset: DATASET.into(),
        camera: Some(camera),
        settings: Some(mirror()),
        output: Some(wire::OutputSettings { encoding: encoding.into(), ..Default::default() }),
        ..Default::default()
    };
    let mut client = server.rendering().await;
    let (mut inside, mut outside, mut bytes) = (Vec::new(), Vec::new(), 0);
    for run in 0..WARM_UP + RUNS {
        let request = request();
        let start = Instant::now();
        let frame = client.render_frame(request).await.expect("a frame").into_inner();
        let round_trip = 1e3 * start.elapsed().as_secs_f64();
        if run >= WARM_UP {
            let t = frame.timings.expect("every frame has timings");
            inside.push(1e-3 * (t.queue_micros + t.pages_micros + t.render_micros + t.encode_micros) as f64);
            outside.push(round_trip);
            bytes = frame.color.len();
        }
    }
    let (server, client) = (median(&mut inside), median(&mut outside));
    println!(
        "{:<10} {server:>13.1}  {client:>10.1}  {:>5.1}  {:>7.1}  {bytes:>6}",
        format!("{encoding:?}"),
        client - server,
        0.1 * server + 2.0
    );
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn mirror() -> wire::RenderSettings {
    let settings = wire::OffsetSurfaceLightFieldSettings {
        component: Component::Mirror.into(),
        blend: Blend::Normal.into(),
        exponent: None,
        specular_reflectance: None,
        filter: 0,
        gloss: None,
        relighting: None,
        reflections: 0,
        refraction: None,
        normal_map: None,
    };
    wire::RenderSettings {
        representation: Some(wire::render_settings::Representation::OffsetSurfaceLightField(settings)),
        ..Default::default()
    }
}

/// In front of the captured object, three and a half radii from its middle.
async fn camera(server: &Server) -> wire::Camera {
    let dataset = server.datasets().await.get_dataset(wire::GetDatasetRequest { name: DATASET.into() }).await;
    let bounds = dataset.expect("it was captured").into_inner().versions[0].object_bounds.expect("this kind has bounds");
    let (min, max) = (bounds.min.expect("a corner"), bounds.max.expect("a corner"));
    let middle = |low: f32, high: f32| 0.5 * (low + high);
    let radius = 0.5 * ((max.x - min.x).powi(2) + (max.y - min.y).powi(2) + (max.z - min.z).powi(2)).sqrt();
    let vector = |x, y, z| Some(wire::Vector3 { x, y, z });
    let pose = wire::Pose {
        position: vector(middle(min.x, max.x), middle(min.y, max.y), middle(min.z, max.z) + 3.5 * radius),
        right: vector(1.0, 0.0, 0.0),
        up: vector(0.0, 1.0, 0.0),
        backward: vector(0.0, 0.0, 1.0),
    };
    let intrinsics =
        wire::Intrinsics { width_px: 640, height_px: 480, focal_x_px: 660.0, focal_y_px: 0.0, center_x_px: None, center_y_px: None };
    wire::Camera { pose: Some(pose), intrinsics: Some(intrinsics) }
}
