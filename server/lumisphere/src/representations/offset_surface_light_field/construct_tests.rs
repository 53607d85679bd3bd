//! Construction on a ball above a table under a sky: resumable, reproducible, refusing nonsense.

use std::f32::consts::{PI, TAU};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use glam::{Vec2, Vec3};

use super::super::*;
use super::{ConstructError, ConstructSettings, construct};
use crate::capture::PartsError;
use crate::directions::FACES;
use crate::geometry::{BezierPatch, PatchPoint, TriangleMesh};
use crate::progress::{Cancelled, Progress, Unattended};
use crate::representations::Original;
use crate::scenes::{Albedo, Environment, Material, Object, Resolution, Scene, Surface, TeaSet, tea_set_patches, tessellate};
use crate::textures::{
    Codec, DatasetVersion, Disk, LimitedDisk, LocalDisk, PageId, PixelFormat, Publication, Staging, Store, StoreError, StoreOptions,
};

fn object(name: &str, mesh: TriangleMesh) -> Object {
    Object { name: name.into(), mesh, surface: Surface::Mesh, material: 0, emission: None }
}

fn ball(center: Vec3, radius: f32) -> TriangleMesh {
    let (rings, sectors) = (12u32, 24u32);
    let mut mesh = TriangleMesh { positions: vec![], normals: vec![], uvs: vec![], triangles: vec![] };
    for ring in 0..=rings {
        for sector in 0..=sectors {
            let (v, u) = (ring as f32 / rings as f32, sector as f32 / sectors as f32);
            let n = Vec3::new((PI * v).sin() * (TAU * u).cos(), -(PI * v).cos(), -(PI * v).sin() * (TAU * u).sin());
            mesh.positions.push(center + radius * n);
            mesh.normals.push(n);
            mesh.uvs.push(Vec2::new(u, v));
            if ring < rings && sector < sectors {
                let i = ring * (sectors + 1) + sector;
                mesh.triangles.extend([[i, i + 1, i + sectors + 2], [i, i + sectors + 2, i + sectors + 1]]);
            }
        }
    }
    TriangleMesh::new(mesh.positions, mesh.normals, mesh.uvs, mesh.triangles).unwrap()
}

fn table(height: f32) -> TriangleMesh {
    let corners = [Vec2::new(-2.0, -2.0), Vec2::new(-2.0, 2.0), Vec2::new(2.0, 2.0), Vec2::new(2.0, -2.0)];
    let positions = corners.map(|c| Vec3::new(c.x, height, c.y)).to_vec();
    TriangleMesh::new(positions, vec![Vec3::Y; 4], vec![Vec2::ZERO; 4], vec![[0, 1, 2], [0, 2, 3]]).unwrap()
}

fn scene(objects: Vec<Object>) -> Scene {
    Scene {
        name: "ball".into(),
        objects,
        materials: vec![Material::Diffuse { albedo: Albedo::Constant(Vec3::splat(0.5)) }],
        textures: vec![],
        point_lights: vec![],
        environment: Environment::Constant(Vec3::ONE),
        cameras: vec![],
        notes: vec![],
    }
}

fn ball_on_table() -> Scene {
    scene(vec![object("ball", ball(Vec3::Y * 1.2, 1.0)), object("table", table(0.0))])
}

fn settings() -> ConstructSettings {
    ConstructSettings {
        object: "ball".into(),
        epsilon: Some(0.1),
        spacing: Spacing::Count(24),
        placing: Placing::Uniform,
        face_size_texels: 16,
        sample_map_size_texels: 16,
        pixel_format: PixelFormat::F32,
        codec: Codec::DEFAULT,
        samples_per_texel: 4,
        max_bounces: 2,
        seed: 5,
        original: Original::Diffuse,
    }
}

fn stage(root: &Path) -> (Store, Staging) {
    stage_on(root, Arc::new(LocalDisk))
}

fn stage_on(root: &Path, disk: Arc<dyn Disk>) -> (Store, Staging) {
    let (store, _) = Store::open(root, StoreOptions { disk, ..StoreOptions::local() }).unwrap();
    let staging = match store.create_dataset("ball").and_then(|()| store.stage("ball", "job-1")) {
        Ok(staging) => staging,
        Err(_) => store.stage("ball", "job-1").unwrap(),
    };
    (store, staging)
}

fn publish(staging: Staging, parameters: &Parameters) -> Arc<DatasetVersion> {
    let parameters = serde_json::to_value(parameters).unwrap();
    let publication = Publication {
        kind: "offset_surface_light_field".into(),
        parameters,
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    staging.publish(publication).unwrap()
}

fn built_in(root: &Path, threads: usize) -> Arc<DatasetVersion> {
    let (_store, staging) = stage(root);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let parameters = pool.install(|| construct(&ball_on_table(), &settings(), &staging, &Unattended)).unwrap();
    publish(staging, &parameters)
}

fn load(version: &DatasetVersion) -> OffsetSurfaceLightField {
    let parameters = serde_json::from_value(version.manifest().parameters.clone()).unwrap();
    from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap()
}

// Files and their hashes, without what names the dataset.
fn content(version: &DatasetVersion) -> (Vec<crate::textures::SegmentEntry>, Vec<crate::textures::BlobEntry>) {
    (version.manifest().segments.clone(), version.manifest().blobs.values().cloned().collect())
}

#[test]
fn one_thread_and_two_give_the_same_bytes() {
    let (one, two) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert_eq!(content(&built_in(one.path(), 1)), content(&built_in(two.path(), 2)));
}

// Cancels once `left` progress reports of the tracing stage have been made.
struct CancelAfter(AtomicU64);

impl Progress for CancelAfter {
    fn report(&self, what: &str, done: u64, _total: u64) {
        if what == "tracing cube maps" && done > 0 {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }
}

#[test]
fn a_stopped_capture_goes_on_where_it_was_and_ends_in_the_same_bytes() {
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let expected = built_in(whole.path(), 2);
    {
        let (_store, staging) = stage(broken.path());
        let stopped = construct(&ball_on_table(), &settings(), &staging, &CancelAfter(AtomicU64::new(0)));
        assert!(matches!(stopped, Err(ConstructError::Cancelled(Cancelled))));
        // Dropped without a word, as a kill would.
    }
    let (_store, staging) = stage(broken.path());
    let kept = staging.pages_present().len();
    assert!(kept >= FACES && kept < expected.page_count() as usize, "{kept} pages kept");
    let parameters = construct(&ball_on_table(), &settings(), &staging, &Unattended).unwrap();
    let resumed = publish(staging, &parameters);
    for page in 0..expected.page_count() {
        assert_eq!(expected.read_page(PageId(page)).unwrap().to_f32(), resumed.read_page(PageId(page)).unwrap().to_f32(), "page {page}");
    }
    assert_eq!(content(&expected).1, content(&resumed).1);
}

#[test]
fn a_full_disk_is_told_and_the_capture_goes_on_when_there_is_room() {
    let (whole, cramped) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let expected = built_in(whole.path(), 2);
    let bytes: u64 = expected.manifest().segments.iter().map(|segment| segment.bytes).sum();
    let disk = Arc::new(LimitedDisk::new(u64::MAX));
    let (_store, staging) = stage_on(cramped.path(), disk.clone());
    let mut present = 0;
    // Full at once, twice amid the pages, and again at once.
    for free in [0, bytes / 3, bytes / 3, 0] {
        disk.set_free_bytes(free);
        let full = construct(&ball_on_table(), &settings(), &staging, &Unattended);
        assert!(matches!(full, Err(ConstructError::Store(StoreError::DiskFull { .. }))), "{free} bytes free: {full:?}");
        let before = std::mem::replace(&mut present, staging.pages_present().len());
        assert!(if free == 0 { present == before } else { present > before }, "{before} pages, {present} with {free} bytes more");
    }
    assert!(present < expected.page_count() as usize);
    disk.set_free_bytes(u64::MAX);
    let parameters = construct(&ball_on_table(), &settings(), &staging, &Unattended).unwrap();
    assert_eq!(content(&publish(staging, &parameters)), content(&expected));
}

#[test]
fn what_is_stored_loads_and_every_cube_map_sees_the_sky_above_and_its_surface_below() {
    let root = tempfile::tempdir().unwrap();
    let version = built_in(root.path(), 2);
    let field = load(&version);
    assert_eq!(version.page_count() as usize, field.page_count());
    assert!(field.sample_points.len() >= 20);
    for (cube, point) in field.sample_points.iter().enumerate() {
        // Toward its own surface: the distance is ε to within what a flat facet of the ball's mesh and a texel's width cut off.
        let (face, _) = crate::directions::face_from_direction(-point.normal);
        let page = version.read_page(PageId(OffsetSurfaceLightField::page(cube, face))).unwrap();
        let nearest = (0..16 * 16).map(|t| page.texel(t % 16, t / 16)[3]).fold(f32::INFINITY, f32::min);
        assert!((0.08..0.13).contains(&nearest), "cube {cube}: {nearest}");
    }
    // The baseline sees the sky where the ball was: up is radiance 1, exactly, at infinity.
    let up = version.read_page(PageId(OffsetSurfaceLightField::page(field.sample_points.len(), 2))).unwrap();
    assert_eq!(up.texel(8, 8), [1.0, 1.0, 1.0, f32::INFINITY]);
}

#[test]
fn points_below_the_table_are_dropped() {
    // The ball's lowest fifth is sunk into the table, a closed slab so that "inside" has a meaning.
    let slab =
        scene(vec![object("ball", ball(Vec3::Y * 0.6, 1.0)), object("slab", block(Vec3::new(-2.0, -1.0, -2.0), Vec3::new(2.0, 0.0, 2.0)))]);
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let parameters = construct(&slab, &ConstructSettings { samples_per_texel: 1, ..settings() }, &staging, &Unattended).unwrap();
    let field = load(&publish(staging, &parameters));
    let lowest = field.sample_points.iter().map(|p| p.position.y).fold(f32::INFINITY, f32::min);
    assert!(lowest > 0.0, "a sample point at height {lowest}");
}

fn block(low: Vec3, high: Vec3) -> TriangleMesh {
    let corner = |k: u32| Vec3::select(glam::BVec3::new(k & 1 > 0, k & 2 > 0, k & 4 > 0), high, low);
    let quads = [[0u32, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles: Vec<[u32; 3]> = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
    let positions = triangles.iter().flatten().map(|i| corner(*i)).collect::<Vec<_>>();
    let n = positions.len();
    let own = (0..n as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    TriangleMesh::new(positions, vec![Vec3::ZERO; n], vec![Vec2::ZERO; n], own).unwrap()
}

/// A teaspoon in place of the ball, and its patches.
fn spoon() -> (Scene, Vec<BezierPatch>) {
    let patches = tea_set_patches(TeaSet::Teaspoon);
    let (mesh, patch_of_triangle) = tessellate(&patches, Resolution::PerEdge(8)).unwrap();
    let surface = Surface::Patches { patches: patches.clone(), patch_of_triangle };
    (scene(vec![Object { surface, ..object("ball", mesh) }]), patches)
}

/// The nearest of 33² points of each patch.
fn foot(patches: &[BezierPatch], of: Vec3) -> PatchPoint {
    let places = patches.iter().flat_map(|patch| (0..33 * 33).map(move |k| (patch, (k % 33) as f32 / 32.0, (k / 33) as f32 / 32.0)));
    let distance = |(patch, u, v): &(&BezierPatch, f32, f32)| patch.position(*u, *v).distance(of);
    let (patch, u, v) = places.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
    patch.point(u, v)
}

/// The nearest sample point above a surface point's horizon.
fn nearest_above(field: &OffsetSurfaceLightField, at: PatchPoint) -> Option<usize> {
    let cos_horizon = CONSTRUCTION_HORIZON_DEG.to_radians().cos();
    let above = |p: &&(usize, &SamplePoint)| at.normal.dot((p.1.position - at.position).normalize()) > cos_horizon;
    let distance = |p: &(usize, &SamplePoint)| p.1.position.distance(at.position);
    let points = field.sample_points.iter().enumerate();
    points.filter(|p| above(&p)).min_by(|a, b| distance(a).total_cmp(&distance(b))).map(|(index, _)| index)
}

#[test]
fn every_patch_is_a_part_and_its_sample_map_has_the_patchs_own_u_and_v() {
    let (scene, patches) = spoon();
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let (low, high) = scene.objects[0].mesh.bounds();
    let epsilon = 0.03 * (high - low).length();
    let settings = ConstructSettings { epsilon: Some(epsilon), samples_per_texel: 1, face_size_texels: 4, ..settings() };
    let parameters = construct(&scene, &settings, &staging, &Unattended).unwrap();
    let field = load(&publish(staging, &parameters));
    assert_eq!(field.surface.parts as usize, patches.len());
    assert!(field.sample_points.len() >= 20);
    for point in &field.sample_points {
        let foot = foot(&patches, point.position);
        // Flat triangles and the places tried cut off up to 4 %; the normal turns most at the handle's tip.
        let height = foot.position.distance(point.position) / epsilon;
        assert!((height - 1.0).abs() < 0.06, "{height} ε above the patches");
        assert!(foot.normal.dot(point.normal) > 0.9, "{} and {}", foot.normal, point.normal);
    }
    let size = field.sample_maps.size;
    let center = |k: usize| (k as f32 + 0.5) / size as f32;
    let texels = patches.len() * size * size;
    let agrees = |texel: &usize| {
        let (part, u, v) = (texel / (size * size), center(texel % size), center(texel / size % size));
        let nearest = nearest_above(&field, patches[part].point(u, v));
        nearest.is_some_and(|index| usize::from(field.sample_maps.at(part as u32, u, v)[0]) == index)
    };
    let agreeing = (0..texels).filter(agrees).count();
    // 90 % do: of others the nearest is hidden, or the flat triangle's horizon is another. With u and v exchanged 39 % do.
    assert!(agreeing as f64 > 0.8 * texels as f64, "{agreeing} of {texels} texels name the nearest sample point");
}

#[test]
fn senseless_settings_are_refused_by_name() {
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let refuse = |settings: ConstructSettings| construct(&ball_on_table(), &settings, &staging, &Unattended).unwrap_err().to_string();
    assert!(refuse(ConstructSettings { object: "pot".into(), ..settings() }).contains("ball, table"));
    assert!(refuse(ConstructSettings { epsilon: Some(f32::NAN), ..settings() }).contains("epsilon"));
    assert!(refuse(ConstructSettings { face_size_texels: 0, ..settings() }).contains("face size"));
    assert!(refuse(ConstructSettings { samples_per_texel: 0, ..settings() }).contains("samples per texel"));
    assert!(refuse(ConstructSettings { spacing: Spacing::Distance(0.0), ..settings() }).contains("spacing"));
    assert_eq!(staging.pages_present().len(), 0);
}

#[test]
fn a_pilot_puts_sample_points_where_they_differ_and_the_same_ones_on_any_number_of_threads() {
    let built = |placing, threads| {
        let root = tempfile::tempdir().unwrap();
        let (_store, staging) = stage(root.path());
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let settings = ConstructSettings { placing, spacing: Spacing::Count(200), epsilon: None, face_size_texels: 8, ..settings() };
        let parameters = pool.install(|| construct(&ball_on_table(), &settings, &staging, &Unattended)).unwrap();
        assert_eq!(parameters.placing, placing);
        load(&publish(staging, &parameters))
    };
    let [uniform, by_error] = [Placing::Uniform, Placing::Error].map(|placing| built(placing, 2));
    assert_eq!(by_error.sample_points, built(Placing::Error, 1).sample_points);
    // The ball's lower half sees the table and its shadow, the upper one little but an even sky.
    let below = |field: &OffsetSurfaceLightField| {
        assert!(field.sample_points.len().abs_diff(200) < 20);
        field.sample_points.iter().filter(|p| p.normal.y < -0.2).count()
    };
    assert!(
        4 * below(&by_error) > 5 * below(&uniform),
        "{} of {} by error, {} uniform",
        below(&by_error),
        by_error.sample_points.len(),
        below(&uniform)
    );
    // Where they lie apart they lie high: half the distance to a neighbour off the ball.
    let center = Vec3::Y * 1.2;
    let height = |p: &SamplePoint| p.position.distance(center) - 1.0;
    let mean = |field: &OffsetSurfaceLightField, above: bool| {
        let heights: Vec<f32> =
            field.sample_points.iter().filter(|p| (p.normal.y > 0.5) == above && p.normal.y.abs() > 0.5).map(height).collect();
        heights.iter().sum::<f32>() / heights.len() as f32
    };
    assert!(mean(&by_error, true) > 1.2 * mean(&by_error, false), "{} above, {} below", mean(&by_error, true), mean(&by_error, false));
    assert!((mean(&uniform, true) - mean(&uniform, false)).abs() < 0.02 * mean(&uniform, true));
}
