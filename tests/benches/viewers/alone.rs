//! The same frames by the renderer alone, in this process.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::{Mat3, Vec2, Vec3};
use lumisphere::capture::PartsError;
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::render::{FrameRequest, Outputs, PendingFrame, Refine, Renderer, Representation, Settings, Uploads};
use lumisphere::representations::CachedPages;
use lumisphere::representations::offset_surface_light_field as oslf;
use lumisphere::scenes::Relighting;
use lumisphere::textures::{Cache, CacheOptions, Store, StoreOptions};
use lumisphere_proto::v1alpha1 as wire;

use super::{DATASET, Server, Stand, Viewer, bound, quantile, temporary_folder};

const BYTES: u64 = 1 << 30;
/// Of each in turn.
const ROUND: Duration = Duration::from_secs(8);
const ROUNDS: usize = 5;
const SIZE: (u32, u32) = (640, 480);

/// A dataset with its renderer.
struct Alone {
    field: Arc<dyn Representation>,
    pages: CachedPages,
    renderer: Renderer,
}

impl Alone {
    /// Of a store that nobody else has open.
    fn open(store: &Path) -> Self {
        let (store, _) = Store::open(store, StoreOptions::local()).expect("a store");
        let version = store.open_version(DATASET, None).expect("it was captured");
        let parameters = serde_json::from_value(version.manifest().parameters.clone()).expect("our own parameters");
        let field = oslf::from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).expect("a part"))).expect("our own parts");
        let cache = Arc::new(Cache::new(CacheOptions::decoded(BYTES)));
        let renderer = Renderer::with_gpu(BYTES).expect("an adapter");
        Self { field: Arc::new(field), pages: CachedPages { cache, version }, renderer }
    }

    /// Frames of one who moves, one after the other, for so long; how many a second.
    fn walk(&self, stand: &Stand, time: Duration) -> f64 {
        let settings = Settings::OffsetSurfaceLightField(oslf::Settings {
            component: oslf::Component::Mirror,
            blend: oslf::Blend::Normal { exponent: 4.0 },
            specular_reflectance: Vec3::ONE,
            filter: oslf::Filter::Footprint,
            light: Relighting::NONE,
            reflections: 1,
            bumps: None,
        });
        let outputs = Outputs { depth: false, provenance: false };
        // Pixels come while the next frame is drawn, as in the server.
        let mut before: Option<PendingFrame> = None;
        let (begun, mut steps) = (Instant::now(), 0);
        while begun.elapsed() < time {
            steps += 1;
            let camera = camera(&stand.camera(steps, SIZE));
            let request = FrameRequest { camera: &camera, settings: &settings, outputs, refine: Refine::Whole, uploads: Uploads::NONE };
            let drawn = self.renderer.draw(&self.field, &self.pages, &request, None).expect("a frame");
            before.replace(drawn).map(|before| before.finish().expect("its pixels"));
        }
        self.renderer.settle();
        before.map(|before| before.finish().expect("its pixels"));
        steps as f64 / begun.elapsed().as_secs_f64()
    }
}

fn camera(camera: &wire::Camera) -> Camera {
    let (pose, intrinsics) = (camera.pose.expect("set"), camera.intrinsics.expect("set"));
    let vector = |v: Option<wire::Vector3>| v.map(|v| Vec3::new(v.x, v.y, v.z)).expect("set");
    let rotation = Mat3::from_cols(vector(pose.right), vector(pose.up), vector(pose.backward));
    let (width_px, height_px) = (intrinsics.width_px, intrinsics.height_px);
    let center_px = 0.5 * Vec2::new(width_px as f32, height_px as f32);
    let intrinsics = Intrinsics { width_px, height_px, focal_px: Vec2::splat(intrinsics.focal_x_px), center_px };
    Camera::new(intrinsics, Pose::new(rotation, vector(pose.position)).expect("a rotation")).expect("a camera")
}

/// Frames a second of a viewer with two credits, who reads but does not decode them, beside those of the renderer alone, in turn.
pub async fn alone(server: &Server, data: &Path, stand: &Stand) {
    let copy = temporary_folder();
    copy_folder(data, copy.path());
    let alone = Alone::open(copy.path());
    let serve = async || Viewer::open(server.rendering().await, *stand, SIZE, 2).await.follow(ROUND, |_| ()).await;
    // Brings the pages of these poses to both.
    let _ = (serve().await, alone.walk(stand, ROUND));
    let (mut shares, mut rates) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (served, own) = (serve().await, alone.walk(stand, ROUND));
        shares.push(served / own);
        rates.push([served, own]);
    }
    println!("\nalone: frames a second, served and by the renderer alone, in turn: {rates:.2?}");
    let share = quantile(&mut shares, 0.5);
    bound("served / alone, median", share, 0.95, share >= 0.95);
}

fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        let target = to.join(entry.file_name());
        if entry.file_type().expect("a type").is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("room on the disk");
        }
    }
}
