//! The texture cache beside OpenImageIO, moka, foyer and quick_cache: time and bytes of misses and hits, misses of the policies, durable
//! writes. Same texels, same requests, page cache warm, CPU time of one thread. Figures go to docs/measurements.md.
//!
//! ```text
//! apt-get install libopenimageio-dev
//! g++ -O3 -march=native docs/rivals/oiio_textures.cpp -lOpenImageIO -lOpenImageIO_Util -o target/oiio_textures
//! python3 -m venv target/oiio && target/oiio/bin/pip install OpenImageIO==3.2.2.0 numpy
//! cargo build --release --manifest-path docs/rivals/cache_policies/Cargo.toml --target-dir target/rivals
//! alias record='lumisphere cache record --dataset d --size 320x240 --out'; cd target/recordings
//! record orbit.lstr --frames 36 --component full
//! record walk.lstr --walk --frames 36 --component full
//! record glossy.lstr --frames 1 --component mirror --lobe-samples 16
//! LUMISPHERE_SHARED_DATA=… RECORDINGS=$PWD cargo bench -p lumisphere --no-default-features --bench texture_cache
//! ```
//! Names of parts (sizes, misses, hits, strategies, policies, writes, memory) after `--` run only these. `OIIO_TEXTURES`, `OIIO_PYTHON` and
//! `CACHE_POLICIES` name the rivals when they lie elsewhere. A missing one fails the benchmark. The recordings are of a server's dataset
//! `d`, an offset surface light field. The texels are three photographed environments of the data pack, resampled to cube maps at random
//! rotations.

mod data;
mod memory;
mod rivals;
mod traces;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use lumisphere::textures::laboratory::{Order, Setting, simulate};
use lumisphere::textures::{
    BLOCK_ROWS, Cache, CacheOptions, Codec, DatasetVersion, PageId, PageShape, PixelFormat, PolicyKind, ReadStrategy, Reader, Tally, Trace,
    encode, encode_as,
};

use self::data::{FACE_BYTES, FACES, SIZE, cpu_seconds};
use self::rivals::Values;

/// Faces that the cache of the miss measurements holds: OpenImageIO 3.2 takes no less.
const CACHE_FACES: u64 = 64;

fn main() {
    let parts: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with("--")).collect();
    if let [part, store, strategy] = &parts[..]
        && part == "memory-of"
    {
        return memory::measured(Path::new(store), strategy.parse().expect("a strategy"));
    }
    let wants = |part: &str| parts.is_empty() || parts.iter().any(|wanted| wanted == part);
    let folder = data::folder();
    if wants("policies") {
        policies(&folder);
    }
    if ["sizes", "misses", "hits", "strategies", "writes", "memory"].iter().any(|part| wants(part)) {
        texels(&folder, wants);
    }
}

/// All that needs the faces.
fn texels(folder: &Path, wants: impl Fn(&str) -> bool) {
    let faces = data::faces();
    let versions = data::stored(folder, &faces);
    let (random, warm) = (traces::random(4000), traces::warm(400_000));
    data::write_numbers(&folder.join("random.u32"), &random);
    data::write_numbers(&folder.join("warm.u32"), &warm);
    if wants("memory") {
        memory::measure(&folder.join(format!("{}-f32", Codec::DEFAULT)));
    }
    if !["sizes", "misses", "hits", "strategies", "writes"].iter().any(|part| wants(part)) {
        return;
    }
    let oiio = rivals::oiio_textures(folder);
    let python = rivals::oiio_misses(folder);
    if wants("sizes") {
        sizes(&faces, &oiio);
    }
    if wants("misses") {
        misses(&versions, &random, &oiio, &python);
    }
    if wants("hits") {
        hits(&versions[&format!("{} f32", Codec::DEFAULT)], &warm, &oiio);
    }
    if wants("strategies") {
        strategies(&versions);
    }
    if wants("writes") {
        writes(folder, &faces);
    }
}

fn bound(what: &str, ratio: f64, most: f64) {
    println!("  {what}: {ratio:.3}, bound {most}: {}", if ratio <= most { "met" } else { "MISSED" });
}

fn sizes(faces: &[f32], oiio: &Values) {
    println!("\nbytes of {FACES} faces of {SIZE}², RGB");
    let shape = data::shape(PixelFormat::F32);
    let stored = |codec, pixel| -> f64 {
        let shape = PageShape { pixel, ..shape };
        let page = |texels| encode_as(codec, &shape, texels).expect("a face").payload_bytes() as f64;
        faces.chunks_exact(shape.values()).map(page).sum()
    };
    for (codec, pixel) in [
        (Codec::BitsChunk, PixelFormat::F32),
        (Codec::ZstdChunk, PixelFormat::F32),
        (Codec::ZstdSeq, PixelFormat::F32),
        (Codec::LzwSeq, PixelFormat::F32),
        (Codec::BitsChunk, PixelFormat::F16),
        (Codec::ZstdChunk, PixelFormat::F16),
        (Codec::ZstdSeq, PixelFormat::F16),
    ] {
        println!("  {codec} {pixel:?}: {:.1} MB", 1e-6 * stored(codec, pixel));
    }
    for name in ["zip_f32_bytes", "none_f32_bytes", "zip_f16_bytes"] {
        println!("  EXR {name}: {:.1} MB", 1e-6 * oiio[name]);
    }
    bound("lossless f32 / EXR ZIP f32", stored(Codec::DEFAULT, PixelFormat::F32) / oiio["zip_f32_bytes"], 0.82);
    bound("f16 / EXR ZIP f16", stored(Codec::DEFAULT, PixelFormat::F16) / oiio["zip_f16_bytes"], 1.0);
}

/// CPU seconds and misses of the look-ups through a cache of 64 faces' bytes; the best of some runs.
fn timed(version: &Arc<DatasetVersion>, strategy: ReadStrategy, look_ups: &[u32], runs: usize) -> (f64, u64, f64) {
    let mut best = (f64::INFINITY, 0, 0.0);
    for _ in 0..runs {
        let cache = Cache::new(CacheOptions { strategy, ..CacheOptions::decoded(CACHE_FACES * FACE_BYTES) });
        let started = cpu_seconds();
        let sum = look_all_up(&cache, version, look_ups);
        let seconds = cpu_seconds() - started;
        if seconds < best.0 {
            best = (seconds, cache.stats().texel_misses, sum);
        }
    }
    best
}

/// Bilinear look-ups in the middle of four texels; the sum of the first channel.
fn look_all_up(cache: &Cache, version: &Arc<DatasetVersion>, look_ups: &[u32]) -> f64 {
    look_all_up_by(cache.reader(version), look_ups)
}

fn look_all_up_by<T: Tally>(mut reader: Reader<'_, T>, look_ups: &[u32]) -> f64 {
    let look_up = |at: &[u32; 3]| f64::from(reader.bilinear(PageId(at[0]), (at[1], at[2]), (0.5, 0.5)).expect("intact data")[0]);
    look_ups.as_chunks::<3>().0.iter().map(look_up).sum()
}

/// The four texels of every look-up one by one; the sum of the first channel.
fn fetch_all_by<T: Tally>(mut reader: Reader<'_, T>, look_ups: &[u32]) -> f64 {
    let look_up = |at: &[u32; 3]| {
        let (page, x, y) = (PageId(at[0]), at[1], at[2]);
        let texels = reader.texels([(page, x, y), (page, x + 1, y), (page, x, y + 1), (page, x + 1, y + 1)]).expect("intact data");
        f64::from(texels.iter().map(|texel| texel[0]).sum::<f32>())
    };
    look_ups.as_chunks::<3>().0.iter().map(look_up).sum()
}

fn misses(versions: &BTreeMap<String, Arc<DatasetVersion>>, random: &[u32], oiio: &Values, python: &Values) {
    println!("\n{} random look-ups, cache of {CACHE_FACES} faces; CPU µs a miss (misses)", random.len() / 3);
    let mut seconds = BTreeMap::new();
    for (name, version) in versions {
        for strategy in ReadStrategy::ALL {
            // LZW takes a millisecond a miss.
            let runs = if name.starts_with("lzw") { 1 } else { 3 };
            let (s, misses, sum) = timed(version, strategy, random, runs);
            println!("  {name} {strategy}: {:.1} ({misses})", 1e6 * s / misses as f64);
            // The rival has seen the same texels.
            if name.ends_with("f32") {
                let (a, b) = (sum, oiio["zip_f32_sum"]);
                assert!((a - b).abs() <= 1e-3 * b.abs(), "the sum is {a}, OpenImageIO's {b}");
            }
            seconds.insert(format!("{name} {strategy}"), s);
        }
    }
    for (version, values) in [("2.4 (C++)", oiio), ("3.2 (Python, its own time taken off)", python)] {
        for layout in ["zip_f32", "none_f32", "zip_f32_32"] {
            let (s, misses) = (values[&format!("{layout}_seconds")], values[&format!("{layout}_misses")]);
            println!("  OpenImageIO {version} {layout}: {:.1} ({misses})", 1e6 * s / misses);
        }
        let full = seconds[&format!("{} f32 full_image", Codec::DEFAULT)];
        bound(&format!("face misses, ours / {version} EXR ZIP"), full / values["zip_f32_seconds"], 0.125);
        bound(&format!("face misses, ours / {version} EXR uncompressed"), full / values["none_f32_seconds"], 0.8);
        let block = seconds[&format!("{} f32 block", Codec::DEFAULT)];
        bound(&format!("block misses, ours / {version} 32² ZIP"), block / values["zip_f32_32_seconds"], 0.2);
    }
}

/// Nanoseconds of each of the look-ups of every pass, the least of some rounds. The rounds are taken in turn, so that what disturbs the
/// machine disturbs all; the clock moves in steps of 4 ms, so that a measurement has to last.
fn nanos_of_hits<const N: usize>(passes: [&dyn Fn() -> f64; N], look_ups: f64) -> [f64; N] {
    const REPEATS: u32 = 16;
    let mut best = [f64::INFINITY; N];
    for _ in 0..5 {
        for (best, pass) in best.iter_mut().zip(passes) {
            let started = cpu_seconds();
            for _ in 0..REPEATS {
                std::hint::black_box(pass());
            }
            *best = best.min(1e9 * (cpu_seconds() - started) / f64::from(REPEATS) / look_ups);
        }
    }
    best
}

fn hits(version: &Arc<DatasetVersion>, warm: &[u32], oiio: &Values) {
    let count = (warm.len() / 3) as f64;
    println!("\n{count} bilinear RGB look-ups, all resident; CPU ns each");
    let mut ours = f64::INFINITY;
    for strategy in [ReadStrategy::FullImage, ReadStrategy::Block] {
        // One for each policy: handing thousands of pages from one policy to another is no part of a hit.
        let caches = [PolicyKind::DEFAULT, PolicyKind::Lru].map(|decoded_policy| {
            let cache = Cache::new(CacheOptions { strategy, decoded_policy, ..CacheOptions::decoded(4 << 30) });
            let sum = look_all_up(&cache, version, warm);
            assert!((sum - oiio["hit_sum"]).abs() <= 1e-3 * sum.abs(), "the sum is {sum}, OpenImageIO's {}", oiio["hit_sum"]);
            cache
        });
        let [cache, of_lru] = &caches;
        let [bilinear, under_lru, bilinear_uncounted, texels, texels_uncounted] = nanos_of_hits(
            [
                &|| look_all_up(cache, version, warm),
                &|| look_all_up(of_lru, version, warm),
                &|| look_all_up_by(cache.uncounted_reader(version), warm),
                &|| fetch_all_by(cache.reader(version), warm),
                &|| fetch_all_by(cache.uncounted_reader(version), warm),
            ],
            count,
        );
        println!("  {strategy}: {bilinear:.1}, without counting {bilinear_uncounted:.1}, counted under lru {under_lru:.1}");
        println!("    four texels, as the renderer asks: {texels:.1}, without counting {texels_uncounted:.1}");
        ours = ours.min(bilinear);
    }
    println!("  OpenImageIO 2.4 texture(): {:.1}", oiio["hit_nanoseconds"]);
    bound("hit, ours / texture()", ours / oiio["hit_nanoseconds"], 0.2);
    // Against the same arithmetic on pages that are simply held: what finding and counting cost.
    let cache = Cache::new(CacheOptions::decoded(4 << 30));
    let pages: Vec<_> = (0..FACES).map(|p| cache.page(version, PageId(p)).expect("resident")).collect();
    let look_up = |at: &[u32; 3]| f64::from(pages[at[0] as usize].bilinear((at[1], at[2]), (0.5, 0.5))[0]);
    let [direct] = nanos_of_hits([&|| warm.as_chunks::<3>().0.iter().map(look_up).sum()], count);
    println!("  the same texels from pages held in an array: {direct:.1}");
}

/// What strategy and codec cost on a coherent trace that does not fit.
fn strategies(versions: &BTreeMap<String, Arc<DatasetVersion>>) {
    let glossy = traces::glossy_look_ups();
    println!("\n{} glossy look-ups in 16² buckets, cache of 32 faces; misses a texel fetch, MB decoded, CPU s", glossy.len() / 3);
    for (name, version) in versions {
        for strategy in ReadStrategy::ALL {
            let cache = Cache::new(CacheOptions { strategy, ..CacheOptions::decoded(32 * FACE_BYTES) });
            let started = cpu_seconds();
            look_all_up(&cache, version, &glossy);
            let seconds = cpu_seconds() - started;
            let stats = cache.stats();
            let rate = 100.0 * stats.texel_misses as f64 / stats.texel_fetches as f64;
            println!("  {name} {strategy}: {rate:.3} %, {:.0} MB, {seconds:.3} s", 1e-6 * stats.bytes_decoded as f64);
        }
    }
}

/// Recorded faces through every policy and rival that holds no more than it may, as whole pages and in blocks.
fn policies(folder: &Path) {
    let recordings = PathBuf::from(std::env::var_os("RECORDINGS").expect("RECORDINGS names the folder of the recordings"));
    println!("\nmisses at equal bytes; the default, {}, against the best of the others but Belady", PolicyKind::DEFAULT);
    for name in ["orbit", "walk", "glossy"] {
        let trace = traces::recorded(&recordings.join(name).with_extension("lstr"));
        for strategy in [ReadStrategy::FullImage, ReadStrategy::Block] {
            compare_policies(folder, name, &trace, strategy);
        }
    }
}

fn compare_policies(folder: &Path, name: &str, trace: &Trace, strategy: ReadStrategy) {
    let visits = traces::visits(trace, strategy);
    data::write_numbers(&folder.join("visits.u32"), &visits);
    let shape = trace.versions[0].shape;
    // As many units as make so many pages, all of one size.
    let (units, unit) = match strategy {
        ReadStrategy::Block => (shape.height.div_ceil(BLOCK_ROWS), PageShape { height: shape.height.min(BLOCK_ROWS), ..shape }),
        _ => (1, shape),
    };
    println!("  {name}, {strategy}: {} visits of {}", visits.len(), visits.iter().collect::<BTreeSet<_>>().len());
    let capacities = [8u64, 16, 32, 64, 128, 256].map(|pages| pages * u64::from(units));
    let theirs = rivals::cache_policies(folder, &capacities);
    for capacity in capacities {
        let misses = |order| {
            let capacity_bytes = capacity * unit.resident_bytes() as u64;
            simulate(trace, Setting { strategy, codec: Codec::DEFAULT, order, capacity_bytes }).loads
        };
        let ours: Vec<(String, u64)> = PolicyKind::ALL.map(|kind| (kind.name().into(), misses(Order::Policy(kind)))).into();
        let kept: Vec<(String, u64)> =
            theirs.iter().filter(|r| r.capacity == capacity && r.most <= capacity).map(|r| (r.name.clone(), r.misses)).collect();
        let (best_name, best) = ours
            .iter()
            .chain(&kept)
            .filter(|(name, _)| name != PolicyKind::DEFAULT.name())
            .min_by_key(|(_, misses)| *misses)
            .expect("there are policies");
        let all: Vec<String> = ours.iter().chain(&kept).map(|(name, misses)| format!("{name} {misses}")).collect();
        println!("    {capacity}: {}, belady {}; best {best_name}", all.join(", "), misses(Order::Belady));
        bound(&format!("{} / best", PolicyKind::DEFAULT), misses(Order::Policy(PolicyKind::DEFAULT)) as f64 / *best as f64, 1.02);
    }
}

/// 512 pages in batches of 32, each batch durable before the next begins. Wall time: it is the disk's.
fn writes(folder: &Path, faces: &[f32]) {
    let shape = data::shape(PixelFormat::F32);
    let pages: Vec<_> = faces.chunks_exact(shape.values()).take(512).map(|texels| encode(&shape, texels).expect("a face")).collect();
    let (mut ours, mut theirs) = (f64::INFINITY, f64::INFINITY);
    for run in 0..3 {
        let staging = data::staging(&folder.join(format!("writes-{run}")));
        let started = Instant::now();
        for (page, encoded) in (0..).zip(&pages) {
            staging.append_encoded(PageId(page), encoded).expect("room on the disk");
            if page % 32 == 31 {
                staging.sync().expect("room on the disk");
            }
        }
        ours = ours.min(started.elapsed().as_secs_f64());
        theirs = theirs.min(data::write_files(&folder.join(format!("files-{run}")), pages.iter().map(|p| p.payload_bytes())));
    }
    println!("\n512 pages made durable in batches of 32, wall s: ours {ours:.3}, a file a page {theirs:.3}");
    bound("ours / a file a page", ours / theirs, 1.0 / 3.0);
}
