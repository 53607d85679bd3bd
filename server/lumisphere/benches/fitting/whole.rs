//! A whole map, from stored pages to a stored map: 512² texels × 289 views with one lobe each, on one thread; time, and the memory that it takes.

use std::f32::consts::TAU;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use glam::{Vec2, Vec3};
use lumisphere::capture::observation_map::{
    Observation, ObservationMap, ObservationParameters, ObservedTexel, Observer, State, TEXELS_PER_PAGE, tiled_order,
};
use lumisphere::capture::{Background, SurfaceMesh, surface_texels};
use lumisphere::directions::Scheme;
use lumisphere::fitting::{Lobe, Model, Outliers, Precision};
use lumisphere::geometry::TriangleMesh;
use lumisphere::progress::Unattended;
use lumisphere::representations::parameter_map::{ConstructSettings, FitSource, Solver, construct};
use lumisphere::scenes::Environment;
use lumisphere::textures::{Codec, PageId, PixelFormat, Publication, Store, StoreOptions};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use rayon::prelude::*;

use crate::{pool, verdict};

const SIZE: usize = 512;
const VIEWS: usize = 289;
const NOISE: f32 = 0.005;

/// Seconds and memory of the fit; the samples lie in `folder`.
pub fn report(folder: &Path) {
    let (store, _) = Store::open(folder, StoreOptions::local()).expect("a store");
    let map = plane();
    let seen = store_samples(&store, &map);
    let bytes = seen.manifest().stored_bytes();
    println!(
        "\n{SIZE}² texels × {VIEWS} views: {:.2} GB stored, {:.2} GB in memory",
        1e-9 * bytes as f64,
        1e-9 * (SIZE * SIZE * VIEWS * 16) as f64
    );
    store.create_dataset("map").expect("an empty folder");
    let staging = store.stage("map", "bench").expect("an empty folder");
    let read = |page| seen.read_page(page).map(Arc::new);
    let source = FitSource { map: &map, read: &read, name: "seen", beside_bytes: 0, solver: Solver::Processor };
    let settings = ConstructSettings {
        models: "phong:1".parse().expect("a name"),
        noise_floor: Some(NOISE),
        relative_noise: 0.0,
        outliers: Outliers::Keep,
        precision: Precision::Single,
        max_bytes: None,
        pixel_format: PixelFormat::F16,
        codec: Codec::ZstdChunk,
    };
    forget_peak();
    let before = memory_kib("VmRSS");
    let (begin, cpu) = (Instant::now(), process_seconds());
    let (_, summary) = pool(1).install(|| construct(&source, &settings, &staging, &Unattended)).expect("a fit");
    let (wall, cpu, peak) = (begin.elapsed().as_secs_f64(), process_seconds() - cpu, memory_kib("VmHWM"));
    println!("  fits {:.1} s wall, {:.0} texels/s, rms residual {:.5}", summary.seconds, summary.texels_per_second, summary.rms_residual);
    println!("  all, with reading, comparing photographs and packing: {wall:.1} s wall, {cpu:.1} s of processor");
    println!("  memory {} MiB before, {} MiB at most; at most 1024: {}", before / 1024, peak / 1024, verdict(peak < 1 << 20));
    println!("  at most 10 s (AVX-512) or 20 s (AVX2) of processor: {}, {}", verdict(cpu <= 10.0), verdict(cpu <= 20.0));
}

fn plane() -> ObservationMap {
    let corners = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    let positions = corners.map(|c| (c - 0.5).extend(0.0)).to_vec();
    let mesh = TriangleMesh::new(positions, vec![Vec3::Z; 4], corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]]).expect("a square");
    let surface = SurfaceMesh { mesh, part_of_triangle: vec![0, 0], parts: 1 };
    let found = surface_texels(&surface, 0, SIZE);
    let texel = |at: usize| {
        let texel = found[at].expect("the square covers all");
        ObservedTexel { index: at as u32, position: texel.position, normal: texel.normal, tangent: texel.steps[0] }
    };
    let directions = Scheme::icosahedron(VIEWS).expect("a count of the icosahedron").directions();
    let parameters = ObservationParameters {
        object: "plane".into(),
        size_texels: SIZE as u32,
        directions: format!("icosahedron:{VIEWS}"),
        samples_per_observation: 1,
        max_bounces: 1,
        seed: 0,
    };
    ObservationMap {
        parameters,
        background: Background { surfaces: vec![], textures: vec![], environment: Environment::Constant(Vec3::ZERO) },
        observers: directions.into_iter().map(|d| Observer::At(10.0 * d)).collect(),
        texels: tiled_order(SIZE).map(texel).collect(),
        surface,
    }
}

// A lobe that turns and sharpens across the square, in noise.
fn store_samples(store: &Store, map: &ObservationMap) -> Arc<lumisphere::textures::DatasetVersion> {
    store.create_dataset("seen").expect("an empty folder");
    let staging = store.stage("seen", "bench").expect("an empty folder");
    let shape = map.page_shape(PixelFormat::F32);
    let entries = |page: usize| {
        let mut random = Pcg32::seed_from_u64(page as u64);
        let mut noise = || {
            let (u, v): (f32, f32) = (random.random(), random.random());
            NOISE * (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos()
        };
        let mut entries = vec![[0f32; 4]; TEXELS_PER_PAGE * VIEWS];
        for (column, texel) in map.texels_of_page(page).iter().enumerate() {
            let [x, y, _] = texel.position.to_array();
            let axis = Vec3::new(0.4 + 0.3 * x, 0.3 * y, 1.0).normalize().to_array();
            let lobe = Lobe { axis, exponent: 20.0 + 15.0 * x, amplitude: [0.3 + 0.2 * y; 3] };
            let model = Model::Lobes { constant: [0.4 + 0.3 * (40.0 * x).sin() * (30.0 * y).cos(), 0.2, 0.1], lobes: vec![lobe] };
            for (row, observer) in map.observers.iter().enumerate() {
                let radiance = model.eval(texel.direction_to(observer).to_array()).map(|value| value + noise());
                entries[row * TEXELS_PER_PAGE + column] = Observation { radiance, state: State::Seen { clipped: 0 } }.to_texel();
            }
        }
        entries
    };
    let pages: Vec<usize> = (0..map.page_count()).collect();
    for some in pages.chunks(64) {
        let made: Vec<_> = some.par_iter().map(|page| entries(*page)).collect();
        for (page, entries) in some.iter().zip(made) {
            staging.append_page(PageId(*page as u32), &shape, entries.as_flattened()).expect("room on the disk");
        }
    }
    let publication = Publication {
        kind: "observation_map".into(),
        parameters: serde_json::Value::Null,
        inputs: Default::default(),
        code_version: "bench".into(),
        created_unix_millis: 0,
    };
    staging.publish(publication).expect("room on the disk")
}

// The kernel's peak of resident memory starts anew.
fn forget_peak() {
    std::fs::write("/proc/self/clear_refs", "5").expect("Linux forgets the peak");
}

fn memory_kib(line: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux tells a process' memory");
    let value = status.lines().find_map(|l| l.strip_prefix(line)?.strip_prefix(':')?.split_whitespace().next()?.parse().ok());
    value.expect("a number of kibibytes")
}

// Of all threads.
fn process_seconds() -> f64 {
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let nanos = threads.filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok()?.split(' ').next()?.parse::<u64>().ok());
    1e-9 * nanos.sum::<u64>() as f64
}
