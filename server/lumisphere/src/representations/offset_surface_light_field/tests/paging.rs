//! Pages on the device: too many for it, brought a few at a time, ahead of need, under changing budgets and policies.

use std::sync::Arc;

use glam::Vec3;

use super::super::corrected::InverseDistances;
use super::super::kernel::Kernel;
use super::super::reference::Reference;
use super::super::shade::ReadCube;
use super::fixture::{WORLD, World, stored};
use super::{EVERYTHING, mirror};
use crate::directions::{Texel, bilinear_footprint};
use crate::geometry::Camera;
use crate::gpu::{GpuCacheStats, GpuError, test_gpu};
use crate::images::{Tolerance, count_beyond};
use crate::radiometry::dielectric::{Body, Dielectric};
use crate::render::{Backend, Renderer};
use crate::representations::offset_surface_light_field::{Blend, Component, Filter, OffsetSurfaceLightField, Settings};
use crate::representations::{
    CachedPages, CountingSource, FrameRequest, GpuFrameStats, GpuKernel, PageSource, Pixels, Refine, RenderError, Representation,
    Settings as AnySettings, UploadUnit, Uploads,
};
use crate::scenes::Relighting;
use crate::textures::{Cache, CacheOptions, Page, PageId, PolicyKind};

const BUDGET: u64 = 256 << 20;
// The coarser levels are coarse enough to be always there. It comes in two blocks of 16 rows.
const PAGE_BYTES: u64 = 32 * 32 * 8;
// 1206 faces: 9.9 MB.
const LARGE: World = World { points: 200, ..WORLD };

struct Scene {
    kernel: Kernel,
    field: Arc<OffsetSurfaceLightField>,
    pages: Box<dyn PageSource>,
    filter: Filter,
    blend: Blend,
}

impl Scene {
    fn new(field: OffsetSurfaceLightField, pages: Box<dyn PageSource>) -> Option<Self> {
        let field = Arc::new(field);
        let kernel = Kernel::new(test_gpu()?, field.clone(), BUDGET).unwrap();
        Some(Self { kernel, field, pages, filter: Filter::Bilinear, blend: Blend::Distance })
    }

    fn in_memory(world: &World) -> Option<Self> {
        let (field, pages) = world.build();
        Self::new(field, Box::new(pages))
    }

    fn settings(&self) -> AnySettings {
        AnySettings::OffsetSurfaceLightField(Settings { filter: self.filter, ..mirror(self.blend) })
    }

    fn draw(&mut self, camera: &Camera, refine: Refine) -> Result<(Pixels, GpuFrameStats), RenderError> {
        let settings = self.settings();
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine, uploads: Uploads::NONE };
        let drawn = self.kernel.render(&request, &CountingSource::new(self.pages.as_ref()))?;
        let stats = self.kernel.stats();
        assert_eq!(stats.look_ups, stats.hits + stats.misses);
        assert!(stats.resident_bytes <= stats.device_bytes && stats.device_bytes <= self.kernel.budget(), "{stats:?}");
        Ok(drawn)
    }

    fn look_ahead(&mut self, camera: &Camera, upload_bytes: u64) -> usize {
        let pages = self.missed_ahead(camera, upload_bytes);
        self.kernel.bring_ahead(&pages).unwrap()
    }

    fn missed_ahead(&mut self, camera: &Camera, upload_bytes: u64) -> Vec<(PageId, Arc<Page>)> {
        let settings = self.settings();
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
        let ahead = self.kernel.look_ahead(&request, upload_bytes).unwrap();
        ahead.into_iter().map(|page| (page, self.pages.page(page).unwrap().page)).collect()
    }
}

fn orbit(world: &World, steps: usize) -> Vec<Camera> {
    let angle = |k: usize| std::f32::consts::TAU * k as f32 / steps as f32;
    let at = |k: usize| Vec3::new(3.0 * angle(k).cos(), 0.6, 3.0 * angle(k).sin());
    (0..steps).map(|k| world.camera(at(k), Vec3::ZERO, 80, 60)).collect()
}

#[test]
fn a_dataset_ten_times_the_slots_and_five_times_the_memory_looks_as_with_everything_resident() {
    let (field, pages) = LARGE.build();
    let (faces, cameras) = (field.face_count() as u64, orbit(&LARGE, 6));
    let root = tempfile::tempdir().unwrap();
    let version = stored(root.path(), &pages);
    let Some(mut everything) = Scene::new(field.clone(), Box::new(pages)) else { return };
    everything.filter = Filter::Footprint;
    let expected: Vec<Pixels> = cameras.iter().map(|c| everything.draw(c, Refine::Whole).unwrap().0).collect();
    for policy in PolicyKind::ALL {
        let cache = Arc::new(Cache::new(CacheOptions::decoded(faces * PAGE_BYTES / 5)));
        let pages = CachedPages { cache: cache.clone(), version: version.clone() };
        let mut paged = Scene::new(field.clone(), Box::new(pages)).unwrap();
        paged.filter = Filter::Footprint;
        paged.kernel.set_slots(faces / 10);
        paged.kernel.set_policy(policy);
        for (camera, expected) in cameras.iter().zip(&expected) {
            let drawn = paged.draw(camera, Refine::Whole).unwrap().0;
            // With less room fewer levels are always there, so more pages are needed for the same picture.
            assert!(drawn.pages_needed >= expected.pages_needed);
            assert!(drawn == Pixels { pages_needed: drawn.pages_needed, ..expected.clone() }, "{policy}: another picture");
        }
        let stats = paged.kernel.stats();
        assert!(stats.evictions > faces / 10 && stats.resident_pages <= faces / 10, "{policy}: {stats:?}");
    }
}

#[test]
fn frames_under_a_cap_are_coarse_at_first_and_end_as_the_whole_frame() {
    refines_to_the_whole_frame(Filter::Bilinear);
    refines_to_the_whole_frame(Filter::Footprint);
}

fn refines_to_the_whole_frame(filter: Filter) {
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    let camera = &orbit(&WORLD, 8)[0];
    let mut other = Scene::in_memory(&WORLD).unwrap();
    (scene.filter, other.filter) = (filter, filter);
    let (whole, _) = other.draw(camera, Refine::Whole).unwrap();
    let cap = Refine::UpTo { upload_bytes: 10 * PAGE_BYTES };
    let (mut last_error, mut last_uploaded) = (f32::INFINITY, 0);
    for frame in 1.. {
        let (pixels, stats) = scene.draw(camera, cap).unwrap();
        // Twice as many where half of each is wanted.
        assert!(stats.pages_uploaded <= 20 && (pixels.is_final || stats.pages_uploaded >= 10), "{stats:?}");
        let uploaded = scene.kernel.stats().bytes_uploaded;
        // Whatever is left of a cap is enough for one page's.
        let most = 10 * PAGE_BYTES + PAGE_BYTES / 2;
        assert!(uploaded - last_uploaded <= most && (pixels.is_final || uploaded - last_uploaded >= 10 * PAGE_BYTES), "{uploaded}");
        last_uploaded = uploaded;
        let error: f32 = pixels.color.iter().zip(&whole.color).map(|(a, b)| (a - b).abs()).sum();
        assert!(error < last_error, "frame {frame}: {error} after {last_error}");
        last_error = error;
        if pixels.is_final {
            assert_eq!(pixels, whole);
            assert_eq!(frame, uploaded.div_ceil(10 * PAGE_BYTES), "{} pages", whole.pages_needed);
            break;
        }
    }
    assert!(scene.draw(camera, cap).unwrap().0.is_final);
}

/// Which pages a depth-corrected read wants follows from what others hold: a cold frame finds out in rounds.
#[test]
fn depth_corrected_frames_are_the_same_whether_their_pages_come_in_rounds_or_are_there() {
    let world = World { room: 2.0, ..WORLD };
    let camera = &orbit(&world, 8)[2];
    let corrected = || {
        let mut scene = Scene::in_memory(&world)?;
        (scene.filter, scene.blend) = (Filter::Footprint, Blend::Corrected);
        Some(scene)
    };
    let Some(mut scene) = corrected() else { return };
    let (cold, _) = scene.draw(camera, Refine::Whole).unwrap();
    let (warm, stats) = scene.draw(camera, Refine::Whole).unwrap();
    assert_eq!((stats.passes, stats.pages_uploaded), (1, 0));
    assert_eq!((cold.color == warm.color, cold.provenance == warm.provenance), (true, true));
    // A third of the pages at a time.
    let mut small = corrected().unwrap();
    small.kernel.set_slots(warm.pages_needed as u64 / 3);
    assert!(small.draw(camera, Refine::Whole).unwrap().0.color == warm.color, "another picture from few slots");
    let mut refined = corrected().unwrap();
    let cap = Refine::UpTo { upload_bytes: 20 * PAGE_BYTES };
    let frames = (1..).find(|_| refined.draw(camera, cap).unwrap().0.is_final).expect("refining ends");
    assert!(frames >= refined.kernel.stats().bytes_uploaded / (20 * PAGE_BYTES), "{frames} frames for {} pages", warm.pages_needed);
    assert!(refined.draw(camera, cap).unwrap().0.color == warm.color, "another picture after refining");
}

/// The finest level that is always resident, and nothing else.
struct OneLevel<'a> {
    field: &'a OffsetSurfaceLightField,
    pages: &'a dyn PageSource,
    level: u32,
}

impl ReadCube for OneLevel<'_> {
    fn read_level(&mut self, cube: u32, direction: Vec3, _: u32) -> Result<Vec3, RenderError> {
        let size = self.field.level_size(self.level);
        let page = self.pages.page(PageId(self.field.level_page(cube as usize, self.level)))?.page;
        let texel = |t: Texel| Vec3::from_slice(&page.texel(t.column as u32, t.face as u32 * size + t.row as u32));
        Ok(bilinear_footprint(direction, size as usize).into_iter().map(|(t, weight)| weight * texel(t)).sum())
    }

    // Coarse levels hold none.
    fn inverse_distances(&mut self, _: u32, _: Vec3) -> Result<InverseDistances, RenderError> {
        Ok(InverseDistances::of([(0.0, 0.25); 4]))
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        self.field
    }
}

#[test]
fn a_frame_without_any_page_agrees_with_the_coarse_level_on_the_cpu() {
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    let camera = &orbit(&WORLD, 8)[3];
    let (pixels, stats) = scene.draw(camera, Refine::UpTo { upload_bytes: 0 }).unwrap();
    assert!(!pixels.is_final && stats.pages_uploaded == 0 && stats.passes == 2);
    let g_buffer = scene.kernel.read_g_buffer();
    let mut cubes = OneLevel { field: &scene.field, pages: scene.pages.as_ref(), level: 1 };
    let reference = Reference::new(scene.field.clone());
    let settings = Settings { filter: Filter::Bilinear, ..mirror(Blend::Distance) };
    let shade = |cubes: &mut OneLevel<'_>, at: usize| {
        let position = (at as u32 % 80, at as u32 / 80);
        reference.shade(&settings, camera, position, &g_buffer[at], cubes).unwrap().radiance.to_array()
    };
    let expected: Vec<f32> = (0..g_buffer.len()).flat_map(|at| shade(&mut cubes, at)).collect();
    let report = count_beyond(&expected, &pixels.color, &Tolerance::F32_LOOKUP).unwrap();
    assert_eq!(report.beyond, 0, "{report:?}");
}

#[test]
fn frames_that_cannot_be_refined_are_drawn_whole() {
    let camera = &orbit(&WORLD, 8)[0];
    let cap = Refine::UpTo { upload_bytes: PAGE_BYTES };
    // Fewer slots than the frame wants.
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    let (whole, _) = scene.draw(camera, Refine::Whole).unwrap();
    scene.kernel.set_slots(whole.pages_needed as u64 / 2);
    for _ in 0..3 {
        assert_eq!(scene.draw(camera, cap).unwrap().0, whole);
    }
    // No coarse level: faces that cannot be halved.
    let (mut field, mut pages) = WORLD.build();
    pages.0.truncate(field.face_count());
    field.parameters.coarser_levels = 0;
    assert_eq!(field.page_count(), pages.0.len());
    let mut scene = Scene::new(field, Box::new(pages)).unwrap();
    assert_eq!(scene.draw(camera, cap).unwrap().0, whole);
}

#[test]
fn pages_brought_ahead_are_there_when_the_frame_comes_and_displace_nothing_that_is_shown() {
    let at = |k: f32| WORLD.camera(3.0 * Vec3::new((0.3 * k).cos(), 0.2, (0.3 * k).sin()), Vec3::ZERO, 160, 120);
    let cameras = [at(0.0), at(1.0), at(2.0)];
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    scene.filter = Filter::Footprint;
    assert_eq!(scene.look_ahead(&cameras[1], 1000 * PAGE_BYTES), 0, "before the first frame");
    scene.draw(&cameras[0], Refine::Whole).unwrap();
    let before = scene.kernel.stats();
    let ahead = scene.look_ahead(&cameras[1], 1000 * PAGE_BYTES) as u64;
    let after = scene.kernel.stats();
    assert!(ahead > 0);
    assert_eq!((after.prefetched, after.uploads, after.look_ups), (ahead, before.uploads + ahead, before.look_ups));
    assert_eq!(scene.draw(&cameras[0], Refine::Whole).unwrap().1.pages_uploaded, 0);
    let left = scene.draw(&cameras[1], Refine::Whole).unwrap().1.pages_uploaded as u64;
    assert_eq!(left, 0, "missed after {ahead} were brought");
    // Nothing stands before the object: a look sees just what the frame wants.
    let stats = scene.kernel.stats();
    assert_eq!((stats.prefetch_used, stats.prefetch_wasted), (ahead, 0));
    // Wasted once they leave before any frame wants them.
    assert_eq!(scene.look_ahead(&cameras[2], 3 * PAGE_BYTES), 3);
    scene.kernel.set_slots(2);
    let stats = scene.kernel.stats();
    assert_eq!((stats.prefetched, stats.prefetch_used, stats.prefetch_wasted), (ahead + 3, ahead, 3));
}

#[test]
fn pages_brought_ahead_find_only_the_room_that_is_left() {
    let cameras = orbit(&WORLD, 4);
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    let shown = scene.draw(&cameras[0], Refine::Whole).unwrap().0.pages_needed;
    // Rounded down to whole layers.
    scene.kernel.set_slots(shown as u64 * 3 / 2);
    scene.draw(&cameras[0], Refine::Whole).unwrap();
    let room = scene.kernel.capacity() - shown;
    assert!(room > 0 && room < shown, "{room} slots left");
    let evictions = scene.kernel.stats().evictions;
    assert!(scene.look_ahead(&cameras[2], 1000 * PAGE_BYTES) > 0);
    assert_eq!(scene.draw(&cameras[0], Refine::Whole).unwrap().1.pages_uploaded, 0);
    // Those have the room now; the next look expects others, for which they leave.
    assert!(scene.look_ahead(&cameras[3], 1000 * PAGE_BYTES) > 0);
    let left = scene.kernel.stats().evictions - evictions;
    assert!(left > 0 && left <= room as u64, "{left} gave up {room} slots");
    assert_eq!(scene.draw(&cameras[0], Refine::Whole).unwrap().1.pages_uploaded, 0);
}

/// Two viewers: before what the first one's look found comes, the second one's look expects other pages. Some of the first's are there in part, and
/// more come than there is room for: those that are there stay.
#[test]
fn what_comes_ahead_displaces_nothing_of_itself_whoever_looks_meanwhile() {
    let cameras = orbit(&WORLD, 8);
    for policy in PolicyKind::ALL {
        let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
        let shown = scene.draw(&cameras[0], Refine::Whole).unwrap().0.pages_needed;
        scene.kernel.set_policy(policy);
        scene.kernel.set_slots(shown as u64 * 3 / 2);
        // The second leaves parts of the first's pages, which it does not want.
        scene.draw(&cameras[0], Refine::Whole).unwrap();
        scene.draw(&cameras[1], Refine::Whole).unwrap();
        let mut pages = scene.missed_ahead(&cameras[0], 1000 * PAGE_BYTES);
        scene.missed_ahead(&cameras[4], 1000 * PAGE_BYTES);
        for page in (0..scene.field.face_count() as u32).map(PageId) {
            if !pages.iter().any(|(known, _)| *known == page) {
                pages.push((page, scene.pages.page(page).unwrap().page));
            }
        }
        let brought = scene.kernel.bring_ahead(&pages).unwrap();
        assert!(brought > 0, "{policy}");
        let frame = scene.draw(&cameras[7], Refine::Whole).unwrap().0;
        assert!(frame == Scene::in_memory(&WORLD).unwrap().draw(&cameras[7], Refine::Whole).unwrap().0, "{policy}");
    }
}

#[test]
fn only_rows_that_frames_want_are_uploaded_each_once_and_the_picture_is_that_of_whole_pages() {
    let cameras = orbit(&WORLD, 24);
    for (blend, filter) in
        [(Blend::Distance, Filter::Bilinear), (Blend::Distance, Filter::Footprint), (Blend::Corrected, Filter::Footprint)]
    {
        let scene = || {
            let scene = Scene::in_memory(&WORLD)?;
            Some(Scene { filter, blend, ..scene })
        };
        let (Some(mut rows), Some(mut pages)) = (scene(), scene()) else { return };
        pages.kernel.set_upload_unit(UploadUnit::Pages);
        for camera in &cameras[..6] {
            let (by_rows, by_pages) = (rows.draw(camera, Refine::Whole).unwrap().0, pages.draw(camera, Refine::Whole).unwrap().0);
            assert!(by_rows == by_pages, "{blend:?}, {filter:?}: another picture");
            assert_eq!(rows.draw(camera, Refine::Whole).unwrap().1.pages_uploaded, 0);
        }
        let (rows, pages) = (rows.kernel.stats(), pages.kernel.stats());
        assert_eq!((pages.uploads, pages.bytes_uploaded), (pages.resident_pages, pages.resident_pages * PAGE_BYTES));
        // What the first frame left out came when a later one wanted it.
        assert_eq!(rows.resident_pages, pages.resident_pages);
        assert!(rows.uploads > rows.resident_pages, "{rows:?}");
        assert!(rows.bytes_uploaded < pages.bytes_uploaded, "{rows:?}");
    }
}

/// Room for one of two: each frame of the other displaces what there was.
#[test]
fn counters_of_versions_that_displace_each_other_make_those_of_the_tier() {
    if test_gpu().is_none() {
        return;
    }
    let (field, pages) = WORLD.build();
    let renderer = Renderer::with_gpu(BUDGET).unwrap();
    let roots = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let cache = Arc::new(Cache::new(CacheOptions::decoded(BUDGET)));
    let datasets: Vec<(Arc<dyn Representation>, CachedPages)> = roots
        .iter()
        .map(|root| (Arc::new(field.clone()) as _, CachedPages { cache: cache.clone(), version: stored(root.path(), &pages) }))
        .collect();
    let settings = AnySettings::OffsetSurfaceLightField(mirror(Blend::Distance));
    // As large as what is drawn at once: it takes all that any frame takes beside its pages.
    let camera = &WORLD.camera(3.0 * Vec3::Z, Vec3::ZERO, 720, 720);
    let draw = |which: usize| {
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
        let (field, pages) = &datasets[which];
        let frame = renderer.render(field, pages, &request, Some(Backend::Gpu)).unwrap();
        assert_eq!(frame.stats.backend, Backend::Gpu, "{:?}", frame.stats.fallback);
        frame.stats.gpu.unwrap().pages_uploaded as u64
    };
    let of_version = |which: usize| {
        let all = renderer.gpu_stats_by_version();
        all.into_iter().find(|(slot, _)| *slot == datasets[which].1.version.slot()).map(|(_, stats)| stats).unwrap_or_default()
    };
    let sums_up = || {
        let (mut sum, whole) = (GpuCacheStats::default(), renderer.gpu_stats().unwrap());
        renderer.gpu_stats_by_version().iter().for_each(|(_, stats)| sum.add(stats));
        assert_eq!(GpuCacheStats { peak_device_bytes: whole.peak_device_bytes, budget_bytes: whole.budget_bytes, ..sum }, whole);
        whole
    };
    draw(0);
    let alone = sums_up();
    assert_eq!(of_version(0), alone);
    renderer.set_gpu_budget(alone.device_bytes * 3 / 2);
    for turn in 1..5 {
        let (drawn, other) = (turn % 2, 1 - turn % 2);
        let (own, left) = (of_version(drawn), of_version(other));
        let uploaded = draw(drawn);
        let (own_now, left_now) = (of_version(drawn), of_version(other));
        assert_eq!((own_now.uploads - own.uploads, own_now.evictions), (uploaded, own.evictions));
        let gone = GpuCacheStats {
            evictions: left.evictions + left.resident_pages,
            resident_pages: 0,
            resident_bytes: 0,
            device_bytes: 0,
            ..left
        };
        assert_eq!(left_now, gone, "turn {turn}");
        assert!(left.resident_pages > 0 && own_now.device_bytes == own_now.peak_device_bytes, "{own_now:?}");
        sums_up();
    }
    renderer.forget_gpu_peaks();
    let held = |which: usize| (of_version(which).peak_device_bytes, of_version(which).device_bytes);
    assert_eq!((held(1), held(0).0), ((0, 0), sums_up().device_bytes));
}

#[test]
fn budget_and_policy_change_between_frames_and_the_picture_does_not() {
    if test_gpu().is_none() {
        return;
    }
    let (field, pages) = WORLD.build();
    let field: Arc<dyn Representation> = Arc::new(field);
    let renderer = Renderer::with_gpu(BUDGET).unwrap();
    let settings = AnySettings::OffsetSurfaceLightField(mirror(Blend::Distance));
    let camera = &orbit(&WORLD, 8)[0];
    let draw = || {
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
        renderer.render(&field, &pages, &request, None).unwrap()
    };
    let first = draw();
    let full = renderer.gpu_stats().unwrap();
    // Less and less, down to a few slots: the ring, a band and 486 pages of 8 KiB take 60 MB.
    for (budget, policy) in
        [(58 << 20, PolicyKind::S3Fifo), (56 << 20, PolicyKind::Arc), (55 << 20, PolicyKind::FrameLru), (BUDGET, PolicyKind::Clock)]
    {
        renderer.set_gpu_budget(budget);
        renderer.forget_gpu_peaks();
        renderer.set_gpu_policy(policy);
        assert_eq!(renderer.gpu_policy(), Some(policy));
        let frame = draw();
        assert_eq!((frame.stats.backend, &frame.pixels), (Backend::Gpu, &first.pixels), "{budget}: {:?}", frame.stats.fallback);
        let stats = renderer.gpu_stats().unwrap();
        assert!(stats.peak_device_bytes <= budget && stats.budget_bytes == budget, "{stats:?}");
        assert_eq!(stats.look_ups, stats.hits + stats.misses);
    }
    let stats = renderer.gpu_stats().unwrap();
    assert!(stats.uploads > full.uploads && stats.evictions >= full.resident_pages, "{stats:?}");
    // No room for a band and a page: the CPU draws.
    renderer.set_gpu_budget(1 << 20);
    assert!(renderer.gpu_bytes() <= 1 << 20);
    assert_eq!(draw().stats.backend, Backend::Cpu);
    // What was held once stays told.
    assert_eq!(renderer.gpu_stats().unwrap().peak_device_bytes, stats.peak_device_bytes);
    renderer.forget_gpu_peaks();
    assert_eq!(renderer.gpu_stats().unwrap().peak_device_bytes, renderer.gpu_bytes());
}

#[test]
fn tables_of_other_light_and_of_clear_bodies_leave_room_for_pages_or_are_not_made() {
    let Some(mut scene) = Scene::in_memory(&WORLD) else { return };
    let camera = &orbit(&WORLD, 8)[0];
    let turned = Relighting::new(1.0, &[]).unwrap();
    let glass = Component::Refraction(Dielectric::new(1.5, Body::Solid).unwrap());
    let asking = [
        Settings { component: Component::Full, light: turned, ..mirror(Blend::Average) },
        Settings { component: glass, ..mirror(Blend::Average) },
        Settings { reflections: 4, ..mirror(Blend::Average) },
    ];
    let (mut made, mut refused) = (0, 0);
    for (settings, slots) in asking.into_iter().flat_map(|s| [26, 34, 44, 60, 90, 200, 400].map(move |slots| (s, slots))) {
        let mut kernel = Kernel::new(test_gpu().unwrap(), scene.field.clone(), BUDGET).unwrap();
        std::mem::swap(&mut kernel, &mut scene.kernel);
        // Before there are tables: with them as many slots would be more bytes.
        scene.kernel.set_slots(26);
        let least = scene.kernel.budget();
        scene.kernel.set_slots(slots);
        let settings = AnySettings::OffsetSurfaceLightField(settings);
        let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
        match scene.kernel.render(&request, &CountingSource::new(scene.pages.as_ref())) {
            Ok(_) => made += 1,
            Err(RenderError::Gpu(GpuError::OverBudget { what, needed_bytes, budget_bytes })) => {
                assert!(needed_bytes > budget_bytes && what != "one page", "{what}: {needed_bytes} of {budget_bytes}");
                refused += 1;
            }
            Err(error) => panic!("{slots} slots: {error}"),
        }
        let stats = scene.kernel.stats();
        assert!(stats.device_bytes <= scene.kernel.budget(), "{stats:?}");
        // In the light that is stored there is room as before.
        scene.blend = Blend::Average;
        scene.draw(camera, Refine::Whole).unwrap_or_else(|error| panic!("{slots} slots: {error}"));
        // And where the budget becomes smaller afterwards.
        scene.kernel.set_budget(least);
        scene.draw(camera, Refine::Whole).unwrap_or_else(|error| panic!("{slots} slots, then 26: {error}"));
    }
    assert!(made >= 3 && refused >= 3, "{made} made, {refused} refused");
}
