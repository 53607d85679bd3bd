//! The texels, and where they lie on disk.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use glam::{Quat, Vec3};
use lumisphere::directions::{lat_long_from_direction, texel_direction};
use lumisphere::images::{Image, ReadLimits, read_image};
use lumisphere::textures::{Codec, DatasetVersion, PageId, PageShape, PixelFormat, Publication, Staging, Store, StoreOptions, encode_as};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// Texels along a face's edge.
pub const SIZE: u32 = 128;
/// 128 cubes.
pub const FACES: u32 = 768;
/// Of a decoded face, f32, as the cache counts it.
pub const FACE_BYTES: u64 = 128 * 128 * 12 + 64;

/// CPU time of this thread so far.
pub fn cpu_seconds() -> f64 {
    let text = fs::read_to_string("/proc/thread-self/schedstat").expect("Linux tells a thread's CPU time");
    let nanos = text.split(' ').next().and_then(|n| n.parse::<u64>().ok()).expect("its first number is nanoseconds");
    1e-9 * nanos as f64
}

/// Emptied at each start.
pub fn folder() -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/texture_cache");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder for the data");
    folder
}

pub fn shape(pixel: PixelFormat) -> PageShape {
    PageShape { width: SIZE, height: SIZE, channels: 3, pixel }
}

/// Row by row, RGB, face after face.
pub fn faces() -> Vec<f32> {
    let shared = std::env::var("LUMISPHERE_SHARED_DATA").expect("LUMISPHERE_SHARED_DATA names the data pack");
    let environments = ["empty_warehouse_01_1k.hdr", "forest_slope_1k.hdr", "venice_sunset_1k.hdr"]
        .map(|name| read_image(&Path::new(&shared).join("env").join(name), ReadLimits::SCENE).expect("an environment of the data pack"));
    let mut rng = Pcg32::seed_from_u64(1);
    let mut texels = Vec::with_capacity((FACES * SIZE * SIZE * 3) as usize);
    for cube in 0..FACES as usize / 6 {
        let axis: [f32; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0f32));
        let rotation = Quat::from_array(axis).normalize();
        for face in 0..6 {
            for texel in 0..SIZE * SIZE {
                let (column, row) = ((texel % SIZE) as f32 + 0.5, (texel / SIZE) as f32 + 0.5);
                let direction = rotation * texel_direction(face, SIZE as usize, column, row);
                texels.extend_from_slice(&radiance(&environments[cube % 3], direction));
            }
        }
    }
    texels
}

fn radiance(environment: &Image, direction: Vec3) -> [f32; 3] {
    let at = lat_long_from_direction(direction);
    let (x, y) = (at.x * environment.width as f32 - 0.5, at.y * environment.height as f32 - 0.5);
    let (u, v) = (x - x.floor(), y - y.floor());
    let pixel = |i: f32, j: f32| {
        let column = (i.floor() as i64).rem_euclid(environment.width as i64) as usize;
        let row = (j.floor() as i64).clamp(0, environment.height as i64 - 1) as usize;
        Vec3::from(environment.rgb(row * environment.width + column))
    };
    let upper = pixel(x, y).lerp(pixel(x + 1.0, y), u);
    upper.lerp(pixel(x, y + 1.0).lerp(pixel(x + 1.0, y + 1.0), u), v).to_array()
}

pub fn write_numbers(path: &Path, numbers: &[u32]) {
    fs::write(path, numbers.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>()).expect("room on the disk");
}

/// A writer in an empty store.
pub fn staging(root: &Path) -> Staging {
    let (store, _) = Store::open(root, StoreOptions::local()).expect("an empty folder");
    store.create_dataset("bench").expect("an empty store");
    store.stage("bench", "bench").expect("an empty store")
}

/// The faces under every codec, and for the rivals as they are.
pub fn stored(folder: &Path, faces: &[f32]) -> BTreeMap<String, Arc<DatasetVersion>> {
    fs::write(folder.join("faces.f32"), faces.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>()).expect("room on the disk");
    let kinds = Codec::ALL
        .map(|codec| (codec, PixelFormat::F32))
        .into_iter()
        .chain([(Codec::BitsChunk, PixelFormat::F16), (Codec::ZstdChunk, PixelFormat::F16)]);
    kinds
        .map(|(codec, pixel)| {
            let name = format!("{codec} {}", if pixel == PixelFormat::F32 { "f32" } else { "f16" });
            let staging = staging(&folder.join(name.replace(' ', "-")));
            let shape = shape(pixel);
            for (page, texels) in (0..).zip(faces.chunks_exact(shape.values())) {
                let encoded = encode_as(codec, &shape, texels).expect("a face");
                staging.append_encoded(PageId(page), &encoded).expect("room on the disk");
            }
            let publication = Publication {
                kind: "bench".into(),
                parameters: serde_json::Value::Null,
                inputs: BTreeMap::new(),
                code_version: "bench".into(),
                created_unix_millis: 0,
            };
            (name, staging.publish(publication).expect("room on the disk"))
        })
        .collect()
}

/// The usual way to make a file durable: temporary name, sync, rename; the folder once a batch of 32. Wall seconds.
pub fn write_files(folder: &Path, sizes: impl Iterator<Item = usize>) -> f64 {
    fs::create_dir_all(folder).expect("room on the disk");
    let bytes: Vec<u8> = (0..1u32 << 20).map(|i| (i.wrapping_mul(0x9E37_79B9) >> 24) as u8).collect();
    let write = |at: usize, size: usize| -> std::io::Result<()> {
        let partial = folder.join(format!("{at}.tmp"));
        let mut file = File::create(&partial)?;
        file.write_all(&bytes[..size])?;
        file.sync_data()?;
        fs::rename(&partial, folder.join(at.to_string()))?;
        if at % 32 == 31 { File::open(folder)?.sync_all() } else { Ok(()) }
    };
    let started = Instant::now();
    for (at, size) in sizes.enumerate() {
        write(at, size).expect("room on the disk");
    }
    started.elapsed().as_secs_f64()
}
