//! Another object in stored light: what may never be shown, what is refused, and that it can be stopped.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{Vec2, Vec3};

use super::super::*;
use super::fixture::MemoryPages;
use crate::capture::PartsError;
use crate::geometry::TriangleMesh;
use crate::progress::{Cancelled, Progress, Unattended};
use crate::scenes::{Albedo, Environment, Material, Object, Scene, Surface};
use crate::textures::{BlobEntry, Codec, DatasetVersion, PageId, PixelFormat, Publication, SegmentEntry, Staging, Store, StoreOptions};

const GREY: usize = 0;
const BLUE: usize = 1;
const MIRROR: usize = 2;

fn scene(objects: Vec<Object>) -> Scene {
    let diffuse = |albedo: Vec3| Material::Diffuse { albedo: Albedo::Constant(albedo) };
    Scene {
        name: "replacing".into(),
        objects,
        materials: vec![diffuse(Vec3::splat(0.5)), diffuse(Vec3::new(0.1, 0.1, 0.9)), Material::Mirror { reflectance: Vec3::ONE }],
        textures: vec![],
        point_lights: vec![],
        environment: Environment::Constant(Vec3::ONE),
        cameras: vec![],
        notes: vec![],
    }
}

fn object(name: &str, mesh: TriangleMesh, material: usize) -> Object {
    Object { name: name.into(), mesh, surface: Surface::Mesh, material, emission: None }
}

// A body of `sides` flat sides that stands on y = 0.
fn prism(center: Vec2, radius: f32, height: f32, sides: u32) -> TriangleMesh {
    let (mut positions, mut uvs, mut triangles) = (vec![], vec![], vec![]);
    let corner = |k: u32, y: f32| {
        let (sin, cos) = (std::f32::consts::TAU * k as f32 / sides as f32).sin_cos();
        Vec3::new(center.x + radius * cos, y, center.y - radius * sin)
    };
    let top = Vec3::new(center.x, height, center.y);
    for k in 0..sides {
        for triangle in [
            [corner(k, 0.0), corner(k + 1, 0.0), corner(k + 1, height)],
            [corner(k, 0.0), corner(k + 1, height), corner(k, height)],
            [corner(k, height), corner(k + 1, height), top],
        ] {
            let first = positions.len() as u32;
            positions.extend(triangle);
            uvs.extend(triangle.map(|p| Vec2::new(k as f32 / sides as f32, 0.3 * p.y)));
            triangles.push([first, first + 1, first + 2]);
        }
    }
    let count = positions.len();
    TriangleMesh::new(positions, vec![Vec3::ZERO; count], uvs, triangles).unwrap()
}

fn floor() -> Object {
    let corners = [Vec2::new(-3.0, -3.0), Vec2::new(-3.0, 3.0), Vec2::new(3.0, 3.0), Vec2::new(3.0, -3.0)];
    let positions = corners.map(|c| Vec3::new(c.x, 0.0, c.y)).to_vec();
    let mesh = TriangleMesh::new(positions, vec![Vec3::Y; 4], vec![Vec2::ZERO; 4], vec![[0, 1, 2], [0, 2, 3]]).unwrap();
    object("floor", mesh, GREY)
}

/// A blue column on a grey floor under a grey sky, and beside it, taller, a grey one.
fn captured_scene() -> Scene {
    scene(vec![
        floor(),
        object("post", prism(Vec2::new(1.6, 0.2), 0.2, 2.5, 5), GREY),
        object("column", prism(Vec2::ZERO, 0.6, 1.5, 9), BLUE),
    ])
}

fn new_scene() -> Scene {
    scene(vec![object("peg", prism(Vec2::new(0.1, -0.1), 0.35, 1.2, 7), GREY), object("chrome", prism(Vec2::ZERO, 0.3, 1.0, 7), MIRROR)])
}

fn stage(root: &Path) -> (Store, Staging) {
    let (store, _) = Store::open(root, StoreOptions::local()).unwrap();
    // There is one where an earlier attempt was.
    let _ = store.create_dataset("peg");
    let staging = store.stage("peg", "job").unwrap();
    (store, staging)
}

fn publish(staging: Staging, parameters: &Parameters) -> Arc<DatasetVersion> {
    let publication = Publication {
        kind: "offset_surface_light_field".into(),
        parameters: serde_json::to_value(parameters).unwrap(),
        inputs: Default::default(),
        code_version: "test".into(),
        created_unix_millis: 0,
    };
    staging.publish(publication).unwrap()
}

fn load(version: &DatasetVersion) -> OffsetSurfaceLightField {
    let parameters = serde_json::from_value(version.manifest().parameters.clone()).unwrap();
    from_parts::<PartsError>(parameters, &|name| Ok(version.blob(name).unwrap())).unwrap()
}

fn pages(version: &DatasetVersion) -> MemoryPages {
    MemoryPages((0..version.page_count()).map(|page| Arc::new(version.read_page(PageId(page)).unwrap())).collect())
}

/// The column's: large texels, so that many show a little of it.
fn light() -> (OffsetSurfaceLightField, MemoryPages) {
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let settings = ConstructSettings {
        object: "column".into(),
        epsilon: Some(0.15),
        spacing: Spacing::Count(60),
        placing: Placing::Uniform,
        face_size_texels: 16,
        sample_map_size_texels: 16,
        pixel_format: PixelFormat::F32,
        codec: Codec::DEFAULT,
        samples_per_texel: 16,
        max_bounces: 1,
        seed: 3,
        original: Original::Diffuse,
    };
    let parameters = construct(&captured_scene(), &settings, &staging, &Unattended).unwrap();
    let version = publish(staging, &parameters);
    (load(&version), pages(&version))
}

fn settings() -> ReplaceSettings {
    ReplaceSettings {
        object: "peg".into(),
        placement: Placement::NONE,
        light: "column version 1".into(),
        epsilon: Some(0.1),
        spacing: Spacing::Count(40),
        face_size_texels: 16,
        sample_map_size_texels: 16,
        pixel_format: PixelFormat::F32,
        codec: Codec::DEFAULT,
        rays_per_texel: 4,
        order: BAKED_FIRST,
        scene_bytes: u64::MAX,
    }
}

fn has_blue(texel: &[f32]) -> bool {
    texel[2] != texel[1]
}

#[test]
fn no_texel_shows_the_old_object() {
    let (mut field, source) = light();
    // Everything else has as much green as blue; so shall what the column's own reflection left in baked light.
    field.background.surfaces.iter_mut().flat_map(|s| &mut s.irradiance).flatten().for_each(|e| *e = Vec3::splat(e.x));
    let blue =
        |pages: &MemoryPages| pages.0.iter().flat_map(|page| page.to_f32()).collect::<Vec<_>>().chunks(4).filter(|t| has_blue(t)).count();
    let before = blue(&source);
    assert!(before > 10_000, "{before} texels show the column in its own light field");
    let looked_up = [Surrounding::CubeMaps, Surrounding::Baseline, Surrounding::Background];
    for order in [BAKED_FIRST, looked_up] {
        let root = tempfile::tempdir().unwrap();
        let (_store, staging) = stage(root.path());
        let (parameters, shares) =
            replace((&field, &source), &new_scene(), &ReplaceSettings { order, ..settings() }, &staging, &Unattended).unwrap();
        assert!(order == BAKED_FIRST || shares.cube_maps > 0.01, "{shares:?}");
        let made = pages(&publish(staging, &parameters));
        assert_eq!(blue(&made), 0, "of {} texels", made.0.iter().map(|p| p.to_f32().len() / 4).sum::<usize>());
        let lit = made.0.iter().flat_map(|page| page.to_f32()).collect::<Vec<_>>().chunks(4).filter(|t| t[0] > 0.1).count();
        assert!(lit > before / 4, "{lit} texels show anything");
    }
}

#[test]
fn what_is_made_says_out_of_what_and_is_infinitely_far_where_nothing_is() {
    let (field, source) = light();
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let (parameters, shares) = replace((&field, &source), &new_scene(), &settings(), &staging, &Unattended).unwrap();
    let version = publish(staging, &parameters);
    let made = load(&version);
    assert_eq!(made.parameters.replaced, Some(Replaced { object: "column".into(), light: "column version 1".into() }));
    assert_eq!((made.parameters.object.as_str(), field.parameters.replaced.as_ref()), ("peg", None));
    assert_eq!(version.page_count() as usize, made.page_count());
    // Straight up from above there is the sky, and of a level's texel all of it.
    let (top, _) = made.sample_points.iter().enumerate().max_by(|a, b| a.1.position.y.total_cmp(&b.1.position.y)).unwrap();
    assert_eq!(version.read_page(PageId(OffsetSurfaceLightField::page(top, 2))).unwrap().texel(8, 8), [1.0, 1.0, 1.0, f32::INFINITY]);
    assert_eq!(version.read_page(PageId(made.level_page(top, 1))).unwrap().texel(4, 2 * 8 + 4), [1.0; 4]);
    // Its foot stands on the floor: no point below it, and every point sees the peg at ε to within a texel's slant.
    for (cube, point) in made.sample_points.iter().enumerate() {
        assert!(point.position.y > 0.0, "{}", point.position);
        // Where the floor is not nearer.
        if point.position.y < 0.2 {
            continue;
        }
        let (face, _) = crate::directions::face_from_direction(-point.normal);
        let page = version.read_page(PageId(OffsetSurfaceLightField::page(cube, face))).unwrap();
        let nearest = (0..256).map(|t| page.texel(t % 16, t / 16)[3]).fold(f32::INFINITY, f32::min);
        assert!((0.09..0.12).contains(&nearest), "cube {cube}: {nearest}");
    }
    let sum = shares.object + shares.environment + shares.cube_maps + shares.baseline + shares.background + shares.unknown;
    assert!((sum - 1.0).abs() < 1e-9 && shares.object > 0.2 && shares.environment > 0.2 && shares.unknown == 0.0, "{shares:?}");
}

#[test]
fn objects_that_cannot_stand_there_are_refused_by_name() {
    let (field, source) = light();
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let refuse = |settings: ReplaceSettings| {
        let refused = replace((&field, &source), &new_scene(), &settings, &staging, &Unattended);
        refused.err().unwrap_or_else(|| panic!("{settings:?} is taken")).to_string()
    };
    let place = |placement: Placement| refuse(ReplaceSettings { placement, ..settings() });
    assert!(refuse(ReplaceSettings { object: "pot".into(), ..settings() }).contains("it has peg, chrome"));
    assert!(refuse(ReplaceSettings { object: "chrome".into(), ..settings() }).contains("\"chrome\" is not diffuse"));
    let beside = place(Placement { stand_at: Some(Vec3::new(0.9, 0.0, 0.0)), ..Placement::NONE });
    assert!(beside.contains("along x") && beside.contains("to 1.2") && beside.contains("where light was captured"), "{beside}");
    let sunk = place(Placement { stand_at: Some(Vec3::new(0.0, -0.2, 0.0)), ..Placement::NONE });
    assert!(sunk.contains("along y") && sunk.contains("from -0.2"), "{sunk}");
    for scale in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert!(place(Placement { scale, ..Placement::NONE }).contains("scale is"));
    }
    assert!(place(Placement { scale: 3.0, ..Placement::NONE }).contains("along x"));
    assert!(place(Placement { scale: 1e-30, ..Placement::NONE }).contains("cannot be placed"));
    assert!(place(Placement { turn_deg: f32::NAN, ..Placement::NONE }).contains("turn"));
    assert!(place(Placement { stand_at: Some(Vec3::NAN), ..Placement::NONE }).contains("place"));
    assert!(refuse(ReplaceSettings { epsilon: Some(f32::NAN), ..settings() }).contains("epsilon"));
    assert!(refuse(ReplaceSettings { spacing: Spacing::Count(1), ..settings() }).contains("spacing"));
    assert!(refuse(ReplaceSettings { rays_per_texel: 0, ..settings() }).contains("rays per texel"));
    assert!(refuse(ReplaceSettings { scene_bytes: 1000, ..settings() }).contains("at most 1000"));
    assert!(staging.pages_present().is_empty());
}

#[test]
fn an_object_grows_and_turns_about_its_foot_and_stands_where_it_is_put() {
    let (field, source) = light();
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let placement = Placement { stand_at: Some(Vec3::new(0.05, 0.1, 0.0)), turn_deg: 90.0, scale: 0.5 };
    let settings = ReplaceSettings { placement, spacing: Spacing::Count(12), ..settings() };
    let (parameters, _) = replace((&field, &source), &new_scene(), &settings, &staging, &Unattended).unwrap();
    let made = load(&publish(staging, &parameters));
    let (before_low, before_high) = new_scene().objects[0].mesh.bounds();
    let (low, high) = made.surface.mesh.bounds();
    let (size, before) = (high - low, before_high - before_low);
    assert!((size - 0.5 * Vec3::new(before.z, before.y, before.x)).length() < 1e-5, "{size}, {before} before");
    assert!((Vec3::new(0.5 * (low.x + high.x), low.y, 0.5 * (low.z + high.z)) - Vec3::new(0.05, 0.1, 0.0)).length() < 1e-5);
}

#[test]
fn slivers_that_rounding_takes_leave_the_rest_of_the_object() {
    let (field, source) = light();
    let root = tempfile::tempdir().unwrap();
    let (_store, staging) = stage(root.path());
    let mut with_sliver = new_scene();
    let mesh = &with_sliver.objects[0].mesh;
    let corner = mesh.positions[0];
    // At 0 a billionth is a number, beside 0.05 it is none.
    let at_zero = [Vec3::ZERO, Vec3::new(1e-9, 0.0, 0.0), Vec3::new(0.0, 0.0, 1e-9)].map(|p| p + Vec3::new(0.0, corner.y, 0.0));
    let first = mesh.positions.len() as u32;
    let positions = [&mesh.positions[..], &at_zero].concat();
    let (normals, uvs) = (vec![Vec3::ZERO; positions.len()], [&mesh.uvs[..], &[Vec2::ZERO; 3]].concat());
    let triangles = [&[[first, first + 1, first + 2]], &mesh.triangles[..]].concat();
    let count = triangles.len();
    let mesh = TriangleMesh::new(positions, normals, uvs, triangles).unwrap();
    assert_eq!(mesh.triangles.len(), count);
    with_sliver.objects[0].mesh = mesh;
    let placement = Placement { stand_at: Some(Vec3::new(0.05, 0.1, 0.05)), turn_deg: 0.0, scale: 0.5 };
    let settings = ReplaceSettings { placement, spacing: Spacing::Count(12), ..settings() };
    let (parameters, _) = replace((&field, &source), &with_sliver, &settings, &staging, &Unattended).unwrap();
    let made = load(&publish(staging, &parameters));
    assert_eq!((made.surface.mesh.triangles.len(), made.surface.part_of_triangle.len()), (count - 1, count - 1));
}

struct CancelAfter(AtomicUsize);

impl Progress for CancelAfter {
    fn report(&self, what: &str, done: u64, _total: u64) {
        if what == "filling cube maps" && done > 0 {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }
}

fn content(version: &DatasetVersion) -> (Vec<SegmentEntry>, Vec<BlobEntry>) {
    (version.manifest().segments.clone(), version.manifest().blobs.values().cloned().collect())
}

#[test]
fn stopped_it_goes_on_where_it_was_and_ends_in_the_same_bytes_and_shares() {
    let (field, source) = light();
    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let (_store, staging) = stage(whole.path());
    let (parameters, shares) = pool.install(|| replace((&field, &source), &new_scene(), &settings(), &staging, &Unattended)).unwrap();
    let expected = publish(staging, &parameters);
    {
        let (_store, staging) = stage(broken.path());
        let stopped = replace((&field, &source), &new_scene(), &settings(), &staging, &CancelAfter(AtomicUsize::new(0)));
        assert!(matches!(stopped, Err(ReplaceError::Construct(ConstructError::Cancelled(Cancelled)))), "{stopped:?}");
        // Dropped without a word, as a kill would.
    }
    let (_store, staging) = stage(broken.path());
    let kept = staging.pages_present().len();
    assert!(kept >= 6 && kept < expected.page_count() as usize, "{kept} pages kept");
    let (parameters, told) = replace((&field, &source), &new_scene(), &settings(), &staging, &Unattended).unwrap();
    let resumed = publish(staging, &parameters);
    for page in 0..expected.page_count() {
        assert_eq!(expected.read_page(PageId(page)).unwrap().to_f32(), resumed.read_page(PageId(page)).unwrap().to_f32(), "page {page}");
    }
    assert_eq!((content(&expected).1, shares), (content(&resumed).1, told));
}
