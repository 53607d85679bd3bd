//! A dataset ten times as large as the adapter's budget and five times as large as the memory's, both set in bytes in the configuration file:
//! the pixels are those of a server that holds everything, and budgets hold, by the server's count and by the system's.

use std::fs;
use std::path::Path;
use std::time::Instant;

use lumisphere::capture::{coarser_levels, halved, stacked};
use lumisphere::directions::FACES;
use lumisphere::textures::{Page, PageId, PageShape, PixelFormat, Publication, Staging, Store, StoreOptions};
use lumisphere_proto::v1alpha1 as wire;
use wire::cache_client::CacheClient;
use wire::offset_surface_light_field_settings::{Blend, Component, Filter};
use wire::render_settings::Representation;

use crate::prefetch::has_adapter;
use crate::process::{PATIENCE, Server, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};
use crate::viewers::{Transport, Viewer, opening};
use crate::wire::{camera_around, frame_request, settings};

/// Without pages: the captured one, of which it takes everything but these.
const LARGE: &str = "large";
/// Texels along a face, of four channels in f32: a quarter of a MiB.
const FACE_SIZE: u32 = 128;
const FACE_BYTES: u64 = 16 * (FACE_SIZE as u64).pow(2);

/// Of most frames, in pixels.
const SIZE: (u32, u32) = (64, 48);

/// A band of pixels, the ring and the geometry take 53 MB of it.
const GPU_BUDGET: u64 = 62 << 20;
const MEMORY_BUDGET: u64 = 80 << 20;
const COMPRESSED_BUDGET: u64 = 20 << 20;

/// The dataset `LARGE` in a stopped server's folder: geometry and sample points of a quick capture, faces of a pattern that tells every texel
/// of every page from its neighbours. Returns how many bytes the texels of its faces have.
fn store_large(folder: &Path, points: &str) -> u64 {
    let data = folder.join("data");
    let server = Server::start_with(&data, &["--backend", "cpu"]);
    let with_points = QUICK.map(|flag| if flag == "24" { points } else { flag });
    tiny::capture_with(&server, folder, DATASET, &with_points);
    assert_eq!(server.stop(), Some(0));

    let (store, _) = Store::open(&data, StoreOptions::local()).unwrap();
    let small = store.open_version(DATASET, None).unwrap();
    let manifest = small.manifest();
    let mut parameters = manifest.parameters.clone();
    let levels_of = |parameters: &serde_json::Value| parameters["coarser_levels"].as_u64().unwrap() as u32;
    let cubes = manifest.pages.count / (FACES as u32 + levels_of(&parameters));
    parameters["face_size_texels"] = FACE_SIZE.into();
    parameters["coarser_levels"] = coarser_levels(FACE_SIZE).into();
    store.create_dataset(LARGE).unwrap();
    let staging = store.stage(LARGE, "test").unwrap();
    for name in manifest.blobs.keys() {
        staging.put_blob(name, &small.blob(name).unwrap()).unwrap();
    }
    let staging_of = &staging;
    std::thread::scope(|scope| {
        for first in 0..2 {
            scope.spawn(move || (first..cubes).step_by(2).for_each(|cube| store_cube(staging_of, cube, cubes)));
        }
    });
    let publication = Publication {
        kind: manifest.kind.clone(),
        parameters,
        inputs: manifest.inputs.clone(),
        code_version: manifest.code_version.clone(),
        created_unix_millis: manifest.created_unix_millis,
    };
    staging.publish(publication).unwrap();
    u64::from(cubes) * FACES as u64 * FACE_BYTES
}

/// Six faces, and a page of all six of each coarser level behind the faces of all cubes.
fn store_cube(staging: &Staging, cube: u32, cubes: u32) {
    let shape = PageShape { width: FACE_SIZE, height: FACE_SIZE, channels: 4, pixel: PixelFormat::F32 };
    let append = |page: u32, image: &Page| staging.append_page(PageId(page), &image.shape(), &image.to_f32()).unwrap();
    let first = cube * FACES as u32;
    let mut faces: Vec<Page> = (first..first + FACES as u32).map(|page| pattern(shape, page)).collect();
    for (page, face) in (first..).zip(&faces) {
        append(page, face);
    }
    for level in 0..coarser_levels(FACE_SIZE) {
        faces = faces.iter().map(|face| halved(face, 3).unwrap()).collect();
        append(cubes * (FACES as u32 + level) + cube, &stacked(&faces).unwrap());
    }
}

fn pattern(shape: PageShape, page: u32) -> Page {
    let channel = |x: u32, y: u32, c: u32| ((3 * x + 5 * y + 7 * page + 11 * c) % 97 + 1) as f32 / 97.0;
    let texel = |(x, y): (u32, u32)| [0, 1, 2, 3].map(|c| channel(x, y, c));
    let values: Vec<f32> = (0..shape.height).flat_map(|y| (0..shape.width).map(move |x| (x, y))).flat_map(texel).collect();
    Page::from_f32(shape, &values).unwrap()
}

fn full(backend: wire::Backend, filter: Filter) -> wire::RenderSettings {
    let mut settings = wire::RenderSettings { backend: backend.into(), ..settings(Component::Full, Blend::Distance) };
    if let Some(Representation::OffsetSurfaceLightField(field)) = &mut settings.representation {
        field.filter = filter.into();
    }
    settings
}

fn camera_at(step: u32, steps: u32, (width_px, height_px): (u32, u32)) -> wire::Camera {
    camera_around(std::f32::consts::TAU * step as f32 / steps as f32, width_px, height_px)
}

/// Once around the box: the bytes of every frame.
async fn frames(server: &Server, steps: u32, size: (u32, u32), settings: &wire::RenderSettings) -> Vec<Vec<u8>> {
    let mut rendering = server.rendering().await;
    let mut frames = Vec::new();
    for step in 0..steps {
        let request = wire::RenderFrameRequest {
            camera: Some(camera_at(step, steps, size)),
            settings: Some(settings.clone()),
            ..frame_request(LARGE)
        };
        let frame = rendering.render_frame(request).await.unwrap().into_inner();
        assert_eq!(i32::from(frame.backend()), settings.backend, "step {step}");
        frames.push(frame.color.to_vec());
    }
    frames
}

async fn tiers(server: &Server) -> Vec<wire::CacheTierStats> {
    let mut cache = CacheClient::new(server.channel().await);
    cache.get_cache_stats(wire::GetCacheStatsRequest {}).await.unwrap().into_inner().tiers
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dataset_ten_times_the_adapters_and_five_times_the_memorys_budget_looks_as_with_everything_resident() {
    let folder = temporary_folder();
    let stored = tokio::task::block_in_place(|| store_large(folder.path(), "420"));
    assert!(stored >= (10 * GPU_BUDGET).max(5 * (MEMORY_BUDGET + COMPRESSED_BUDGET)), "{stored} bytes of texels");
    let all = (4 * stored).to_string();
    let resident = Server::start_with(&folder.path().join("data"), &["--memory-cache-bytes", &all, "--gpu-cache-bytes", &all]);
    if !has_adapter(&resident) {
        return;
    }
    let expected = frames(&resident, 6, SIZE, &full(wire::Backend::Gpu, Filter::Footprint)).await;
    assert!(expected.windows(2).all(|pair| pair[0] != pair[1]));
    let held = tiers(&resident).await;
    assert!(held.iter().all(|tier| tier.evictions == 0), "{held:?}");
    assert_eq!(resident.stop(), Some(0));

    let file = folder.path().join("server.toml");
    let budgets =
        format!("gpu_cache_bytes = {GPU_BUDGET}\nmemory_cache_bytes = {MEMORY_BUDGET}\ncompressed_cache_bytes = {COMPRESSED_BUDGET}\n");
    fs::write(&file, budgets).unwrap();
    let small = Server::start_with(&folder.path().join("data"), &["--config", file.to_str().unwrap()]);
    for round in 0..2 {
        let drawn = frames(&small, 6, SIZE, &full(wire::Backend::Gpu, Filter::Footprint)).await;
        for (step, (drawn, expected)) in drawn.iter().zip(&expected).enumerate() {
            assert!(drawn == expected, "another picture at step {step} of round {round}");
        }
    }
    let tiers = tiers(&small).await;
    assert_eq!(tiers.iter().map(|tier| tier.budget_bytes).collect::<Vec<_>>(), [COMPRESSED_BUDGET, MEMORY_BUDGET, GPU_BUDGET]);
    for tier in &tiers {
        assert!(tier.used_bytes <= tier.budget_bytes && tier.peak_bytes <= tier.budget_bytes, "{tier:?}");
        assert!(tier.evictions > 0 && tier.look_ups == tier.hits + tier.misses, "{tier:?}");
    }
}

/// What each one's frame brings drives out what another's has brought: without end, if a frame that misses pages were always followed by one that
/// does not wait for them either.
#[tokio::test(flavor = "multi_thread")]
async fn viewers_at_rest_who_drive_out_each_others_pages_all_see_their_last_frame() {
    const VIEWERS: u32 = 16;
    let folder = temporary_folder();
    tokio::task::block_in_place(|| store_large(folder.path(), "48"));
    let settings = full(wire::Backend::Gpu, Filter::Bilinear);
    let data = folder.path().join("data");
    // For the pages of one or two of them.
    let budget = (GPU_BUDGET + 8_000_000).to_string();
    let small = Server::start_with(&data, &["--gpu-cache-bytes", &budget, "--gpu-upload-bytes-per-frame", "200000"]);
    if !has_adapter(&small) {
        return;
    }
    let expected = frames(&small, VIEWERS, SIZE, &settings).await;
    let mut viewers = tokio::task::JoinSet::new();
    for step in 0..VIEWERS {
        let open = wire::OpenInteraction { dataset: LARGE.into(), settings: Some(settings.clone()), ..opening(1) };
        let mut viewer = Viewer::open_as(&small, open, Transport::Interact).await.unwrap();
        viewers.spawn(async move {
            viewer.pose(1, camera_at(step, VIEWERS, SIZE)).await;
            for frames in 1..=1000 {
                let frame = viewer.frame().await;
                viewer.acknowledge(frame.frame_id).await;
                if frame.is_final {
                    return (step, frames, frame.color);
                }
            }
            panic!("no last frame at step {step}")
        });
    }
    let mut most = 0;
    while let Some(seen) = viewers.join_next().await {
        let (step, frames, color) = seen.unwrap();
        most = most.max(frames);
        assert!(color == expected[step as usize], "another picture at step {step}");
    }
    assert!(most > 4, "there was room for all: {most} frames");
}

/// Anonymous memory, over what the program has with next to nothing in its cache: pages, blocks, and what the allocator takes beside them.
#[tokio::test(flavor = "multi_thread")]
async fn real_memory_is_within_a_tenth_of_the_sum_of_the_memorys_budgets() {
    let folder = temporary_folder();
    let stored = tokio::task::block_in_place(|| store_large(folder.path(), "210"));
    let flags = ["--backend", "cpu", "--memory-cache-bytes", "1000000", "--compressed-cache-bytes", "1000000"];
    let server = Server::start_with(&folder.path().join("data"), &flags);
    // Without filtering no read is coarse: that fills.
    let settings = full(wire::Backend::Cpu, Filter::Bilinear);
    frames(&server, 6, (160, 120), &settings).await;
    let held = async || tiers(&server).await.iter().map(|tier| tier.used_bytes).sum::<u64>();
    let program = server.anonymous_bytes() - held().await;

    let (memory, compressed) = (32 << 20, 8 << 20);
    let budgets = memory + compressed;
    assert!(stored >= 7 * budgets, "{stored} bytes of texels");
    let (memory, compressed) = (memory.to_string(), compressed.to_string());
    let change = ["cache", "configure", "--memory-budget-bytes", &memory, "--compressed-budget-bytes", &compressed];
    tokio::task::block_in_place(|| server.json(&change));
    // Blocks of 32 KiB, pages of 256 KiB, both: each churns what the one before has left.
    for state in ["block", "full_image", "full_image", "half_threshold", "on_demand", "block"] {
        tokio::task::block_in_place(|| server.json(&["cache", "configure", "--strategy", state]));
        frames(&server, 36, (160, 120), &settings).await;
        let counted = held().await;
        assert!(counted <= budgets && counted * 10 >= budgets * 9, "{state}: {counted} of {budgets} bytes are used");
        let (ended, at_once) = (Instant::now(), server.anonymous_bytes() - program);
        // The server gives back what the allocator has left over every second.
        let mut real = at_once;
        while real * 10 > budgets * 11 {
            assert!(ended.elapsed() < PATIENCE, "{state}: {real} bytes above the program's {program}, budgets of {budgets}");
            real = server.anonymous_bytes() - program;
        }
        let ratio = |bytes: u64| bytes as f64 / budgets as f64;
        println!("{state}: {:.3} of the budgets at once, {:.3} after {:?}", ratio(at_once), ratio(real), ended.elapsed());
        // Of pages with half of their rows the whole is counted, and the program's own garbage goes, too.
        assert!(at_once * 2 >= counted, "{state}: {at_once} bytes real, {counted} counted: this measures something else");
    }
}
