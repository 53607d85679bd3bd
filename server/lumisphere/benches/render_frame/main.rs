//! A 640 × 480 frame of the captured teapot in the gazebo, on the GPU (lavapipe where there is no other) and on the CPU, in milliseconds:
//! wall clock, the whole process's CPU time a frame (what counts where others use the machine, too), and the GPU's stages.
//!
//! `cargo bench -p lumisphere --bench render_frame [-- FACE_SIZE [POINTS]] [gpu | cpu | paging | counting | equal_error | parameter_map] [bilinear]`, by default 128 texels, 300 points and both
//! backends; `paging` measures uploads under a cap instead, `counting` what the texture cache's counters cost a frame, `bilinear` reads without filtering. The capture (one path a texel: noise costs no time) is kept in `target/render_frame` for the next run.
//! `parameter_map` draws a plane with models of one kind instead of the teapot.
//! `for_another FILE` draws whatever poses another program asks for (`for_another.rs`).
//! `equal_error` sets mirror frames beside path-traced ones of the same error instead (a capture of 8 paths a texel, 160 points, unless numbers say otherwise).

mod counting;
mod equal_error;
mod for_another;
mod parameter_map;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::Vec3;
use lumisphere::capture::PartsError;
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::progress::Unattended;
use lumisphere::render::{Backend, Frame, FrameRequest, Outputs, Refine, Renderer, Representation, Settings, UploadUnit, Uploads};
use lumisphere::representations::offset_surface_light_field::{
    Blend, Component, ConstructSettings, Filter, OffsetSurfaceLightField, Placing, Settings as OslfSettings, Spacing, construct, from_parts,
};
use lumisphere::representations::{CachedPages, Fetched, Original, PageSource, TexelReader};
use lumisphere::scenes::{BuiltinOptions, Relighting, builtin};
use lumisphere::textures::{Cache, CacheOptions, Codec, DatasetVersion, PageId, PixelFormat, Publication, Store, StoreError, StoreOptions};

const RUNS: usize = 15;
// Of the orbit under a cap: three seconds a revolution at 30 frames a second.
const STEPS: usize = 90;
const GPU_BUDGET_BYTES: u64 = 1 << 30;
// gpu_upload_bytes_per_frame's default.
const IDLE_CAP_BYTES: u64 = 16 << 20;

/// In the light that is stored.
fn settings(component: Component, blend: Blend, filter: Filter) -> Settings {
    let (specular_reflectance, light) = (Vec3::ONE, Relighting::NONE);
    Settings::OffsetSurfaceLightField(OslfSettings { component, blend, specular_reflectance, filter, light, reflections: 1, bumps: None })
}

fn main() {
    if std::env::args().any(|a| a == "parameter_map") {
        let renderer = Renderer::with_gpu(GPU_BUDGET_BYTES).unwrap_or_else(|e| {
            println!("{e}: CPU only");
            Renderer::cpu_only()
        });
        println!("adapter: {}", renderer.adapter().unwrap_or_else(|| "none".into()));
        return parameter_map::report(&root(), &renderer);
    }
    let mut numbers = std::env::args().skip(1).filter_map(|a| a.parse::<u32>().ok());
    let is_equal_error = std::env::args().any(|a| a == "equal_error");
    let (default_points, paths) = if is_equal_error { (160, 8) } else { (300, 1) };
    let (face_size, points) = (numbers.next().unwrap_or(128), numbers.next().unwrap_or(default_points));
    let version = captured(face_size, points, paths);
    let parameters = serde_json::from_value(version.manifest().parameters.clone()).expect("our own parameters");
    let field: OffsetSurfaceLightField =
        from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).expect("a part"))).expect("our own parts");
    let (low, high) = field.surface.mesh.bounds();
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    let triangles: usize = field.background.surfaces.iter().map(|s| s.mesh.triangles.len()).sum();
    println!("{face_size}² faces, {} points, {} + {triangles} triangles", field.sample_points.len(), field.surface.mesh.triangles.len());
    let faces = field.face_count() as u32;
    let field: Arc<dyn Representation> = Arc::new(field);
    let pages = CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(4 << 30))), version: version.clone() };
    let renderer = Renderer::with_gpu(GPU_BUDGET_BYTES).unwrap_or_else(|e| {
        println!("{e}: CPU only");
        Renderer::cpu_only()
    });
    println!("adapter: {}", renderer.adapter().unwrap_or_else(|| "none".into()));
    if is_equal_error {
        return equal_error::report(&field, &pages, &renderer, [0.0, 0.4].map(|turn| orbit_at(center, radius, turn)));
    }
    if let Some(file) = std::env::args().skip_while(|a| a != "for_another").nth(1) {
        return for_another::serve(Path::new(&file), &field, &pages, &renderer, center, radius);
    }
    let cameras: Vec<Camera> = (0..RUNS).map(|k| orbit(center, radius, k)).collect();
    if std::env::args().any(|a| a == "paging") {
        return report_paging(&field, &version, faces, center, radius);
    }
    if std::env::args().any(|a| a == "counting") {
        let settings = |component, filter| settings(component, Blend::Normal { exponent: 4.0 }, filter);
        for (what, component, filter) in [
            ("full", Component::Full, Filter::Footprint),
            ("mirror", Component::Mirror, Filter::Footprint),
            ("mirror, bilinear", Component::Mirror, Filter::Bilinear),
        ] {
            counting::report(what, &field, &pages, &settings(component, filter), &cameras);
        }
        return;
    }
    println!("component      blend            backend   first    best  median    95 %     CPU  pages  (median: gpu, read back)");
    for (component, blend) in [
        (Component::Reconstruction, Blend::Distance),
        (Component::Mirror, Blend::EnvironmentMap),
        (Component::Mirror, Blend::Distance),
        (Component::Mirror, Blend::Angle),
        (Component::Mirror, Blend::Average),
        (Component::Mirror, Blend::Reflection { exponent: 4.0 }),
        (Component::Mirror, Blend::Normal { exponent: 4.0 }),
        (Component::Full, Blend::Normal { exponent: 4.0 }),
    ] {
        let settings = Settings::OffsetSurfaceLightField(OslfSettings {
            component,
            blend,
            specular_reflectance: Vec3::ONE,
            filter: Filter::Footprint,
            light: Relighting::NONE,
            reflections: 1,
            bumps: None,
        });
        for backend in backends(renderer.adapter().is_some()) {
            let render = |camera: &Camera| {
                renderer.render(&field, &pages, &request(camera, &settings, Refine::Whole), Some(backend)).expect("a frame")
            };
            report(component, blend, &cameras, render);
        }
    }
}

// What it takes to have the coarser levels, and a revolution under a cap of uploads a frame: which share of its frames is not final.
fn report_paging(field: &Arc<dyn Representation>, version: &Arc<DatasetVersion>, faces: u32, center: Vec3, radius: f32) {
    let fresh = || CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(4 << 30))), version: version.clone() };
    for (what, numbers) in [("coarser levels", faces..version.page_count()), ("all faces", 0..faces)] {
        let (pages, begin, count) = (fresh(), Instant::now(), numbers.len());
        let before = cpu_millis();
        for number in numbers {
            pages.page(PageId(number)).expect("a page");
        }
        let wall = 1e3 * begin.elapsed().as_secs_f64();
        println!("reading {count} {what}, one thread: {wall:.0} ms, {:.0} ms CPU", cpu_millis() - before);
    }
    let blend = Blend::Normal { exponent: 4.0 };
    let settings = OslfSettings {
        component: Component::Mirror,
        blend,
        specular_reflectance: Vec3::ONE,
        filter: Filter::Footprint,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    };
    let settings = Settings::OffsetSurfaceLightField(settings);
    let cameras: Vec<Camera> = (0..STEPS).map(|k| orbit_at(center, radius, k as f32 / STEPS as f32)).collect();
    report_units(field, version, &settings, &cameras);
    report_idle_time(field, version, &settings, &cameras);
    println!("cap, pages  ahead  not final  uploaded  brought ahead  CPU a frame, ms");
    for (cap, ahead) in [(4, false), (4, true), (8, false), (8, true), (16, false), (16, true)] {
        let (renderer, pages) = (Renderer::with_gpu(GPU_BUDGET_BYTES).expect("there was one"), fresh());
        let upload_bytes = cap * 128 * 128 * 8;
        // The first pose is waited for: what counts is the motion.
        renderer.render(field, &pages, &request(&cameras[0], &settings, Refine::Whole), Some(Backend::Gpu)).expect("a frame");
        let (start, before, mut not_final) = (renderer.gpu_stats().expect("a GPU"), cpu_millis(), 0);
        for (last, camera) in cameras.iter().zip(&cameras[1..]) {
            let frame = renderer
                .render(field, &pages, &request(camera, &settings, Refine::UpTo { upload_bytes }), Some(Backend::Gpu))
                .expect("a frame");
            not_final += u32::from(!frame.pixels.is_final);
            // A page of which only rows came counts as one: a little less is left than might be.
            let left = cap.saturating_sub(frame.stats.gpu.map_or(0, |g| g.pages_uploaded as u64));
            if ahead && left > 0 {
                let pose = camera.pose().extrapolated_from(last.pose()).expect("rotations compose");
                let next = Camera::new(*camera.intrinsics(), pose).expect("the same intrinsics");
                bring_ahead(&renderer, field, &pages, &request(&next, &settings, Refine::Whole), left * 128 * 128 * 8);
            }
        }
        let (stats, frames) = (renderer.gpu_stats().expect("a GPU"), STEPS - 1);
        let cpu = (cpu_millis() - before) / frames as f64;
        let (uploads, prefetched) = (stats.uploads - start.uploads, stats.prefetched);
        println!("{cap:>10} {ahead:>6} {not_final:>6} / {frames} {uploads:>8} {prefetched:>8} {cpu:>10.1}");
    }
}

// A revolution from an empty atlas, of pages the rows that are wanted or the whole of them.
fn report_units(field: &Arc<dyn Representation>, version: &Arc<DatasetVersion>, settings: &Settings, cameras: &[Camera]) {
    println!("unit   cap, MiB  first frame: MB, ms  not final  uploaded, MB  in pages  CPU a frame, ms");
    for (unit, cap_mib) in [UploadUnit::Pages, UploadUnit::Rows].into_iter().flat_map(|unit| [(unit, 1), (unit, 16), (unit, 1), (unit, 16)])
    {
        let pages = CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(4 << 30))), version: version.clone() };
        let renderer = Renderer::with_gpu(GPU_BUDGET_BYTES).expect("there was one");
        let draw =
            |camera, refine| renderer.render(field, &pages, &request(camera, settings, refine), Some(Backend::Gpu)).expect("a frame");
        // Compiles the kernel.
        draw(&cameras[0], Refine::UpTo { upload_bytes: 0 });
        renderer.set_upload_unit(unit);
        draw(&cameras[0], Refine::UpTo { upload_bytes: 0 });
        let first = draw(&cameras[0], Refine::Whole).stats.total_millis;
        let (start, before) = (renderer.gpu_stats().expect("a GPU"), cpu_millis());
        let refine = Refine::UpTo { upload_bytes: cap_mib << 20 };
        let not_final = cameras[1..].iter().filter(|camera| !draw(camera, refine).pixels.is_final).count();
        let (stats, frames) = (renderer.gpu_stats().expect("a GPU"), cameras.len() - 1);
        let (cpu, megabytes) = ((cpu_millis() - before) / frames as f64, |bytes: u64| bytes as f64 / 1e6);
        let (cold, uploaded) = (megabytes(start.bytes_uploaded), megabytes(stats.bytes_uploaded - start.bytes_uploaded));
        let uploads = stats.uploads - start.uploads;
        println!("{unit:?}  {cap_mib:>8} {cold:>16.1} {first:>6.1} {not_final:>5} / {frames} {uploaded:>13.1} {uploads:>9} {cpu:>16.1}");
    }
}

// A viewer whose frames leave time between them: what is brought in that time costs its frames nothing. With the cap of the server's default.
fn report_idle_time(field: &Arc<dyn Representation>, version: &Arc<DatasetVersion>, settings: &Settings, cameras: &[Camera]) {
    println!("ms a page from disk  ahead  not final  missed in frames  brought ahead  of use  frame, ms: mean  95 %  between, ms");
    for (delay_millis, ahead) in [(0, false), (0, true), (5, false), (5, true)] {
        let cached = CachedPages { cache: Arc::new(Cache::new(CacheOptions::decoded(4 << 30))), version: version.clone() };
        let pages = SlowPages { pages: cached, delay: Duration::from_millis(delay_millis) };
        let renderer = Renderer::with_gpu(GPU_BUDGET_BYTES).expect("there was one");
        let refine = Refine::UpTo { upload_bytes: IDLE_CAP_BYTES };
        renderer.render(field, &pages, &request(&cameras[0], settings, Refine::Whole), Some(Backend::Gpu)).expect("a frame");
        let (start, mut not_final, mut millis, mut between) = (renderer.gpu_stats().expect("a GPU"), 0, Vec::new(), Duration::ZERO);
        for (last, camera) in cameras.iter().zip(&cameras[1..]) {
            let frame = renderer.render(field, &pages, &request(camera, settings, refine), Some(Backend::Gpu)).expect("a frame");
            not_final += u32::from(!frame.pixels.is_final);
            millis.push(frame.stats.total_millis);
            if ahead {
                let begin = Instant::now();
                let pose = camera.pose().extrapolated_from(last.pose()).expect("rotations compose");
                let next = Camera::new(*camera.intrinsics(), pose).expect("the same intrinsics");
                bring_ahead(&renderer, field, &pages, &request(&next, settings, Refine::Whole), IDLE_CAP_BYTES);
                between += begin.elapsed();
            }
        }
        let (stats, frames) = (renderer.gpu_stats().expect("a GPU"), cameras.len() - 1);
        millis.sort_by(f64::total_cmp);
        let (mean, late) = (millis.iter().sum::<f64>() / frames as f64, millis[frames * 95 / 100]);
        let (missed, brought, used) = (stats.misses - start.misses, stats.prefetched, stats.prefetch_used);
        let between = 1e3 * between.as_secs_f64() / frames as f64;
        println!(
            "{delay_millis:>19} {ahead:>6} {not_final:>5} / {frames} {missed:>17} {brought:>14} {used:>7} {mean:>16.1} {late:>5.1} {between:>12.1}"
        );
    }
}

// As the server does between two frames.
fn bring_ahead(renderer: &Renderer, field: &Arc<dyn Representation>, pages: &dyn PageSource, next: &FrameRequest<'_>, upload_bytes: u64) {
    let ahead = renderer.look_ahead(field, next, upload_bytes).expect("a look");
    let pages: Vec<_> = ahead.into_iter().map(|page| (page, pages.page(page).expect("a page").page)).collect();
    renderer.bring_ahead(field, &pages).expect("room");
}

// A disk on which every page takes so long.
struct SlowPages {
    pages: CachedPages,
    delay: Duration,
}

impl PageSource for SlowPages {
    fn version_slot(&self) -> u32 {
        self.pages.version_slot()
    }

    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        let fetched = self.pages.page(page)?;
        if !fetched.was_resident {
            std::thread::sleep(self.delay);
        }
        Ok(fetched)
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        self.pages.reader()
    }
}

fn request<'a>(camera: &'a Camera, settings: &'a Settings, refine: Refine) -> FrameRequest<'a> {
    FrameRequest { camera, settings, outputs: Outputs { depth: false, provenance: false }, refine, uploads: Uploads::NONE }
}

fn backends(has_gpu: bool) -> Vec<Backend> {
    let wanted = |name: &str, other: &str| std::env::args().any(|a| a == name) || !std::env::args().any(|a| a == other);
    let mut backends = Vec::new();
    if has_gpu && wanted("gpu", "cpu") {
        backends.push(Backend::Gpu);
    }
    if wanted("cpu", "gpu") {
        backends.push(Backend::Cpu);
    }
    backends
}

// What all threads of this process have computed so far; 0 where the system does not tell.
fn cpu_millis() -> f64 {
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let nanos = threads.filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok()?.split(' ').next()?.parse::<u64>().ok());
    1e-6 * nanos.sum::<u64>() as f64
}

// Every pose once to bring the pages, then once more for the clock.
fn report(component: Component, blend: Blend, cameras: &[Camera], render: impl Fn(&Camera) -> Frame) {
    let first: Vec<Frame> = cameras.iter().map(&render).collect();
    let cpu_before = cpu_millis();
    let frames: Vec<Frame> = cameras.iter().map(&render).collect();
    let cpu = (cpu_millis() - cpu_before) / RUNS as f64;
    let sorted = |of: &dyn Fn(&Frame) -> f64| {
        let mut millis: Vec<f64> = frames.iter().map(of).collect();
        millis.sort_by(f64::total_cmp);
        millis
    };
    let total = sorted(&|f| f.stats.total_millis);
    let stages = frames[0].stats.gpu.map(|_| {
        let gpu = sorted(&|f| f.stats.gpu.map_or(0.0, |g| g.gpu_millis));
        let read_back = sorted(&|f| f.stats.gpu.map_or(0.0, |g| g.read_back_millis));
        format!("{:6.1} {:5.1}", gpu[RUNS / 2], read_back[RUNS / 2])
    });
    let backend = frames[0].stats.fallback.clone().unwrap_or(format!("{:?}", frames[0].stats.backend));
    println!(
        "{:<14} {:<16} {backend:<6} {:>8.1}{:>8.1}{:>8.1}{:>8.1}{cpu:>8.1}  {:>5}  {}",
        format!("{component:?}"),
        format!("{blend:?}").split_whitespace().next().unwrap_or_default(),
        first[0].stats.total_millis,
        total[0],
        total[RUNS / 2],
        total[RUNS * 95 / 100],
        frames[RUNS / 2].pixels.pages_needed,
        stages.unwrap_or_default(),
    );
}

fn orbit(center: Vec3, radius: f32, k: usize) -> Camera {
    orbit_at(center, radius, k as f32 / RUNS as f32)
}

// The teapot fills about half of the image's height.
fn orbit_at(center: Vec3, radius: f32, turn: f32) -> Camera {
    let angle = std::f32::consts::TAU * turn;
    let origin = center + 3.2 * radius * Vec3::new(angle.cos(), 0.45, angle.sin());
    let pose = Pose::look_at(origin, center, Vec3::Y).expect("distinct points");
    Camera::new(Intrinsics::from_vfov(45.0, 640, 480).expect("a sensible angle"), pose).expect("a camera")
}

// Emptied by nobody: captures are kept for the next run.
fn root() -> PathBuf {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../target/render_frame");
    std::fs::create_dir_all(&root).expect("a folder under target");
    root
}

// The teapot's capture, made on the first run.
fn captured(face_size: u32, points: u32, samples_per_texel: u32) -> Arc<DatasetVersion> {
    let root = root();
    let (store, _) = Store::open(&root, StoreOptions::local()).expect("a store");
    let dataset = format!("teapot-levels-{face_size}-{points}-{samples_per_texel}");
    if let Ok(version) = store.open_version(&dataset, None) {
        return version;
    }
    println!("capturing, once");
    let scene = builtin("gazebo", &BuiltinOptions::full()).expect("it ships with us");
    let settings = ConstructSettings {
        object: "teapot".into(),
        epsilon: None,
        spacing: Spacing::Count(points),
        placing: Placing::Uniform,
        face_size_texels: face_size,
        sample_map_size_texels: 256,
        pixel_format: PixelFormat::F16,
        codec: Codec::DEFAULT,
        samples_per_texel,
        max_bounces: 1,
        seed: 1,
        original: Original::Diffuse,
    };
    // An earlier run may have been killed between the two.
    drop(store.create_dataset(&dataset));
    let staging = store.stage(&dataset, "bench").expect("nobody else writes it");
    let parameters = construct(&scene, &settings, &staging, &Unattended).expect("a capture");
    let publication = Publication {
        kind: "offset_surface_light_field".into(),
        parameters: serde_json::to_value(&parameters).expect("plain numbers"),
        inputs: Default::default(),
        code_version: env!("CARGO_PKG_VERSION").into(),
        created_unix_millis: 0,
    };
    staging.publish(publication).expect("room on the disk")
}
