//! A 640 × 480 frame that a parameter map fills, for two kinds of models.

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use lumisphere::capture::PartsError;
use lumisphere::capture::observation_map::{Coverage, ObservationMap, ObserveSettings, from_parts as observed_from_parts, observe};
use lumisphere::fitting::{Outliers, Precision};
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::progress::Unattended;
use lumisphere::render::{Backend, Refine, Renderer, Representation, Settings};
use lumisphere::representations::CachedPages;
use lumisphere::representations::parameter_map::{
    self, ConstructSettings, FitSource, Settings as MapSettings, Solver, construct, from_parts,
};
use lumisphere::scenes::{BuiltinOptions, builtin};
use lumisphere::textures::{Cache, CacheOptions, Codec, DatasetVersion, PixelFormat, Publication, Store, StoreOptions};

use crate::{RUNS, backends, cpu_millis, request};

const TEXELS: u32 = 128;

/// Best, median and 95 % of the wall clock of fifteen poses, and the process' CPU time a frame; every page resident.
pub fn report(root: &Path, renderer: &Renderer) {
    let (store, _) = Store::open(root, StoreOptions::local()).expect("a store");
    let (seen, observed) = observations(&store);
    let (low, high) = observed.surface.mesh.bounds();
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    let normal = observed.texels[0].normal;
    println!("models    backend     best  median    95 %     CPU  (median: gpu, read back)");
    for (models, bound) in [("phong:1", 12.0), ("phong:3", f64::NAN), ("sh:16", f64::NAN), ("sh:64", 40.0)] {
        let version = fitted(&store, models, (&seen, &observed));
        let parameters = serde_json::from_value(version.manifest().parameters.clone()).expect("our own parameters");
        let map: parameter_map::ParameterMap =
            from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).expect("a part"))).expect("our own parts");
        let map: Arc<dyn Representation> = Arc::new(map);
        let pages = CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(1 << 30))), version };
        let settings = Settings::ParameterMap(MapSettings::default());
        let cameras: Vec<Camera> = (0..RUNS).map(|k| above(center, normal, radius, k)).collect();
        for backend in backends(renderer.adapter().is_some()) {
            let draw = |camera: &Camera| {
                renderer.render(&map, &pages, &request(camera, &settings, Refine::Whole), Some(backend)).expect("a frame")
            };
            cameras.iter().for_each(|camera| drop(draw(camera)));
            let before = cpu_millis();
            let frames: Vec<_> = cameras.iter().map(draw).collect();
            let cpu = (cpu_millis() - before) / RUNS as f64;
            let mut millis: Vec<f64> = frames.iter().map(|f| f.stats.total_millis).collect();
            millis.sort_by(f64::total_cmp);
            let gpu = frames[RUNS / 2].stats.gpu.map(|g| format!("{:6.1} {:5.1}", g.gpu_millis, g.read_back_millis)).unwrap_or_default();
            let verdict = match backend {
                Backend::Gpu if bound > 0.0 => format!("at most {bound} ms: {}", if millis[RUNS / 2] <= bound { "met" } else { "MISSED" }),
                _ => String::new(),
            };
            let (best, median, late) = (millis[0], millis[RUNS / 2], millis[RUNS * 95 / 100]);
            println!("{models:<9} {:<8}{best:>8.1}{median:>8.1}{late:>8.1}{cpu:>8.1}  {gpu}  {verdict}", format!("{backend:?}"));
        }
    }
}

// The square reaches beyond the picture's edges: every pixel shows it.
fn above(center: Vec3, normal: Vec3, radius: f32, k: usize) -> Camera {
    let (u, v) = normal.any_orthonormal_pair();
    let angle = std::f32::consts::TAU * k as f32 / RUNS as f32;
    let origin = center + radius * (normal + 0.25 * (angle.cos() * u + angle.sin() * v));
    let pose = Pose::look_at(origin, center, v).expect("distinct points");
    Camera::new(Intrinsics::from_vfov(35.0, 640, 480).expect("a sensible angle"), pose).expect("a camera")
}

fn publication(kind: &str, parameters: serde_json::Value) -> Publication {
    Publication { kind: kind.into(), parameters, inputs: Default::default(), code_version: "bench".into(), created_unix_millis: 0 }
}

// Made on the first run.
fn observations(store: &Store) -> (Arc<DatasetVersion>, ObservationMap) {
    let dataset = format!("plane-seen-{TEXELS}");
    let version = store.open_version(&dataset, None).unwrap_or_else(|_| {
        let scene = builtin("glossy_plane", &BuiltinOptions::full()).expect("it ships with us");
        let settings = ObserveSettings {
            object: "plane".into(),
            size_texels: TEXELS,
            directions: "icosahedron:73".parse().expect("a scheme"),
            coverage: Coverage::Hemisphere,
            axis: None,
            distance_radii: 10.0,
            samples_per_observation: 1,
            max_bounces: 1,
            seed: 1,
            pixel_format: PixelFormat::F32,
            codec: Codec::DEFAULT,
        };
        drop(store.create_dataset(&dataset));
        let staging = store.stage(&dataset, "bench").expect("nobody else writes it");
        let parameters = observe(&scene, &settings, &staging, &Unattended).expect("observations");
        staging.publish(publication("observation_map", serde_json::to_value(parameters).expect("plain numbers"))).expect("room on the disk")
    });
    let parameters = serde_json::from_value(version.manifest().parameters.clone()).expect("our own parameters");
    let map = observed_from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).expect("a part"))).expect("our own parts");
    (version, map)
}

fn fitted(store: &Store, models: &str, (seen, observed): (&Arc<DatasetVersion>, &ObservationMap)) -> Arc<DatasetVersion> {
    let dataset = format!("plane-{}-{TEXELS}", models.replace(':', "-"));
    store.open_version(&dataset, None).unwrap_or_else(|_| {
        let settings = ConstructSettings {
            models: models.parse().expect("a name"),
            noise_floor: None,
            relative_noise: 0.01,
            outliers: Outliers::Keep,
            precision: Precision::Single,
            max_bytes: None,
            pixel_format: PixelFormat::F16,
            codec: Codec::ZstdChunk,
        };
        drop(store.create_dataset(&dataset));
        let staging = store.stage(&dataset, "bench").expect("nobody else writes it");
        let read = |page| seen.read_page(page).map(Arc::new);
        let source = FitSource { map: observed, read: &read, name: "seen", beside_bytes: 0, solver: Solver::Processor };
        let (parameters, _) = construct(&source, &settings, &staging, &Unattended).expect("a fit");
        staging.publish(publication("parameter_map", serde_json::to_value(parameters).expect("plain numbers"))).expect("room on the disk")
    })
}
