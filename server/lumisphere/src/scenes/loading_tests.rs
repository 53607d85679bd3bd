//! Whole scenes: real ones, small ones in memory, and every way to break them.

use std::path::Path;

use glam::Vec3;

use super::*;
use crate::geometry::{Intrinsics, Pose};
use crate::radiometry::brdf::{AnalyticBrdf, Brdf};
use crate::testdata::{shared, shipped};

const QUAD: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1 4/4/1\n";

fn png() -> Vec<u8> {
    crate::images::encode_png(&crate::images::Rgb8::filled(4, 4, [255, 0, 0])).unwrap()
}

fn exr(width: usize, height: usize, value: f32) -> Vec<u8> {
    let image = crate::images::Image { width, height, planes: vec![vec![value; width * height]; 3] };
    crate::images::encode_exr_rgb(&image, crate::images::ExrStorage::Float).unwrap()
}

fn with(json: &str) -> SceneBundle {
    let mut files = SceneBundle::default();
    files.insert("scene.json", json.as_bytes().to_vec()).unwrap();
    files.insert("meshes/quad.obj", QUAD.as_bytes().to_vec()).unwrap();
    files.insert("red.png", png()).unwrap();
    files.insert("sky.exr", exr(8, 4, 2.0)).unwrap();
    files
}

// A scene with everything the format knows.
const FULL: &str = r#"{
  "format": "neutral-scene/1", "name": "all", "about": "", "up": "+Y", "handedness": "right",
  "materials": {
    "red": { "type": "diffuse", "albedo_texture": "red.png", "hint_roughness": 0.5 },
    "mirror": { "type": "mirror", "reflectance": [0.9, 0.9, 0.9] },
    "rough": { "type": "ggx", "alpha": 0.3, "reflectance": [0.5, 0.4, 0.3] }
  },
  "objects": [
    { "name": "wall", "mesh": "meshes/quad.obj", "material": "red", "triangles": 2, "uv_scale": [2, 3],
      "transform": { "translate": [0, 0, -5], "scale": 2 } },
    { "name": "pot", "patches": "builtin:teapot", "material": "mirror", "first_patches": 28, "tessellation": { "per_edge": 3 } },
    { "name": "lamp", "shape": { "type": "disc", "center": [0, 5, 0], "normal": [0, -1, 0], "radius": 1 }, "material": "rough", "emission": [3, 2, 1] }
  ],
  "lights": [
    { "type": "point", "position": [1, 2, 3], "intensity": [10, 10, 10] },
    { "type": "rect", "name": "window", "corner": [0, 0, 0], "edge_u": [1, 0, 0], "edge_v": [0, 1, 0], "radiance": [1, 1, 1] }
  ],
  "environment": { "file": "sky.exr", "scale": 0.5, "rotation_deg": 90 },
  "cameras": [{ "name": "a", "origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0], "vfov_deg": 40, "width": 64, "height": 48 }]
}"#;

fn load_full(json: &str) -> Result<Scene, SceneError> {
    load(&with(json), "scene.json", &LoadOptions::as_written())
}

// The message when one thing of FULL is changed.
fn broken(from: &str, to: &str) -> String {
    assert!(FULL.contains(from), "{from}");
    load_full(&FULL.replacen(from, to, 1)).expect_err(to).to_string()
}

#[test]
fn everything_the_format_knows_arrives() {
    let scene = load_full(FULL).unwrap();
    let names: Vec<&str> = scene.objects.iter().map(|o| o.name.as_str()).collect();
    assert_eq!(names, ["wall", "pot", "lamp", "window"]);
    assert_eq!(scene.objects[0].mesh.bounds(), (Vec3::new(0.0, 0.0, -5.0), Vec3::new(2.0, 2.0, -5.0)));
    assert_eq!(scene.objects[0].mesh.uvs[2], glam::Vec2::new(2.0, 3.0));
    assert_eq!(scene.albedo(scene.objects[0].material, 0.5, 0.5), Some(Vec3::X));
    assert!(matches!(&scene.objects[1].surface, Surface::Patches { patches, .. } if patches.len() == 28));
    assert_eq!(scene.materials[scene.objects[2].material], Material::Ggx { alpha: 0.3, reflectance: Vec3::new(0.5, 0.4, 0.3) });
    assert_eq!((scene.objects[2].emission, scene.objects[3].emission), (Some(Vec3::new(3.0, 2.0, 1.0)), Some(Vec3::ONE)));
    assert_eq!(scene.albedo(scene.objects[3].material, 0.0, 0.0), Some(Vec3::ZERO));
    assert_eq!(scene.point_lights, vec![PointLight { position: Vec3::new(1.0, 2.0, 3.0), intensity: Vec3::splat(10.0) }]);
    let Environment::Map(map) = &scene.environment else { panic!("a map was given") };
    assert_eq!((map.radiance(Vec3::Y), map.rotation), (Vec3::ONE, std::f32::consts::FRAC_PI_2));
    assert_eq!((scene.cameras[0].name.as_str(), scene.cameras[0].camera.intrinsics().width_px), ("a", 64));
    assert!(scene.notes.is_empty());
}

/// A scene of one triangle and this material, beside a measured table.
fn with_material(material: &str) -> Result<Scene, SceneError> {
    let json = format!(
        r#"{{"format": "neutral-scene/1", "materials": {{"m": {material}}}, "objects": [
            {{"name": "wall", "shape": {{"type": "rect", "corner": [0, 0, 0], "edge_u": [1, 0, 0], "edge_v": [0, 1, 0]}}, "material": "m"}}]}}"#
    );
    let mut files = with(&json);
    let mut table: Vec<u8> = [90i32, 90, 180].iter().flat_map(|n| n.to_le_bytes()).collect();
    table.extend(vec![150f64.to_le_bytes(); 3 * 90 * 90 * 180].concat());
    files.insert("short.binary", table[..1000].to_vec()).unwrap();
    files.insert("grey.binary", table).unwrap();
    load(&files, "scene.json", &LoadOptions::as_written())
}

#[test]
fn a_material_may_be_any_brdf() {
    for (written, parameters) in [
        (
            r#"{"type": "phong", "diffuse": [0.1, 0.1, 0.1], "specular": [0.5, 0.5, 0.5], "exponent": 20}"#,
            r#"{"model": "phong", "diffuse": [0.1, 0.1, 0.1], "specular": [0.5, 0.5, 0.5], "exponent": 20}"#,
        ),
        (
            r#"{"type": "ashikhmin_shirley", "diffuse": [1, 0, 0], "specular": [0.5, 0.5, 0.5], "exponent_u": 10, "exponent_v": 1000}"#,
            r#"{"model": "ashikhmin_shirley", "diffuse": [1, 0, 0], "specular": [0.5, 0.5, 0.5], "exponent_u": 10, "exponent_v": 1000}"#,
        ),
        (
            r#"{"type": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.2, "f0": [0.9, 0.7, 0.3]}"#,
            r#"{"model": "cook_torrance", "alpha_x": 0.1, "alpha_y": 0.2, "f0": [0.9, 0.7, 0.3]}"#,
        ),
        (
            r#"{"type": "ward", "diffuse": [0, 0, 0], "specular": [1, 1, 1], "alpha_x": 0.1, "alpha_y": 0}"#,
            r#"{"model": "ward", "diffuse": [0, 0, 0], "specular": [1, 1, 1], "alpha_x": 0.1, "alpha_y": 0}"#,
        ),
        (
            r#"{"type": "lafortune", "diffuse": [0, 0, 0], "lobes": [{"reflectance": [1, 1, 1], "direction": [-1, -1, 0.9], "exponent": 8}]}"#,
            r#"{"model": "lafortune", "diffuse": [0, 0, 0], "lobes": [{"reflectance": [1, 1, 1], "direction": [-1, -1, 0.9], "exponent": 8}]}"#,
        ),
    ] {
        let expected: AnalyticBrdf = serde_json::from_str(parameters).unwrap();
        assert_eq!(with_material(written).unwrap().materials, [Material::Brdf(expected.into())]);
    }
    let measured = with_material(r#"{"type": "measured", "file": "grey.binary"}"#).unwrap();
    let Material::Brdf(brdf) = &measured.materials[0] else { panic!("a BRDF") };
    assert!((brdf.eval(Vec3::Z, Vec3::Z).x - 0.1).abs() < 1e-6);
}

#[test]
fn a_glossy_material_takes_constants_or_pictures() {
    let scene =
        with_material(r#"{"type": "glossy", "diffuse_texture": "red.png", "specular": [0.04, 0.04, 0.04], "roughness": [0.1, 0.4]}"#);
    let scene = scene.unwrap();
    let [specular, roughness] = [Vec3::splat(0.04), Vec3::new(0.1, 0.4, 0.0)].map(Albedo::Constant);
    assert_eq!(scene.materials, [Material::Glossy { diffuse: Albedo::Texture(0), specular, roughness }]);
    let even = with_material(r#"{"type": "glossy", "diffuse": [0, 0, 0], "specular_texture": "red.png", "roughness": 0.3}"#).unwrap();
    let Material::Glossy { roughness, .. } = &even.materials[0] else { panic!("glossy") };
    assert_eq!(*roughness, Albedo::Constant(Vec3::new(0.3, 0.3, 0.0)));
}

#[test]
fn a_brdf_out_of_range_is_named_with_its_place() {
    for (material, expected) in [
        (
            r#"{"type": "glossy", "diffuse": [0, 0, 0], "specular": [0, 0, 0], "roughness": [0.1, 1.5]}"#,
            "materials.m.roughness is [0.1, 1.5], two roughnesses from 0 to 1 expected",
        ),
        (
            r#"{"type": "glossy", "diffuse": [0, 0, 0], "specular": [0, 0, 0], "roughness": -0.1}"#,
            "materials.m.roughness is -0.1, a number from 0 to 1 expected",
        ),
        (r#"{"type": "glossy", "diffuse": [0, 0, 0], "roughness": 0.1}"#, "a glossy material with either \"specular\" or"),
        (
            r#"{"type": "phong", "diffuse": [0.6, 0, 0], "specular": [0.5, 0, 0], "exponent": 20}"#,
            "materials.m.specular is [0.5, 0, 0], diffuse + specular of at most 1 in each channel expected: scene.json",
        ),
        (
            r#"{"type": "phong", "diffuse": [0, 0, 0], "specular": [0, 0, 0], "exponent": -1}"#,
            "materials.m.exponent is -1, a number from 0 to 1e7",
        ),
        (r#"{"type": "ward", "diffuse": [0, 0, 0], "specular": [0, 0, 0], "alpha_x": 0.1}"#, "materials.m has no \"alpha_y\""),
        (
            r#"{"type": "ward", "diffuse": [0, 0, 2], "specular": [0, 0, 0], "alpha_x": 1, "alpha_y": 1}"#,
            "materials.m.diffuse is [0, 0, 2]",
        ),
        (
            r#"{"type": "lafortune", "diffuse": [0, 0, 0], "lobes": [{"reflectance": [1, 1, 1], "direction": [0, 0, 0], "exponent": 8}]}"#,
            "materials.m.lobes[0].direction is [0, 0, 0], three finite numbers, not all 0 expected",
        ),
        (r#"{"type": "shiny"}"#, "materials.m.type is \"shiny\", \"diffuse\", \"mirror\""),
        (r#"{"type": "measured", "file": "short.binary"}"#, "table has 1000 bytes, 34992012 expected: short.binary"),
        (r#"{"type": "measured", "file": "../grey.binary"}"#, "path may not leave the scene's folder"),
    ] {
        let error = with_material(material).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn every_mistake_in_a_scene_file_is_named_with_place_and_value() {
    for (from, to, expected) in [
        ("neutral-scene/1", "neutral-scene/2", r#"format is "neutral-scene/2", "neutral-scene/1" expected: scene.json"#),
        ("\"+Y\"", "\"+Z\"", r#"up is "+Z", "+Y" expected"#),
        ("\"cameras\"", "\"camras\"", r#"unknown key "camras""#),
        ("\"type\": \"mirror\"", "\"type\": \"miror\"", r#"materials.mirror.type is "miror""#),
        ("[0.9, 0.9, 0.9]", "[0.9, 0.9, 1.9]", "materials.mirror.reflectance is [0.9, 0.9, 1.9], [r, g, b], each from 0 to 1 expected"),
        ("\"alpha\": 0.3", "\"alpha\": 0", "materials.rough.alpha is 0, a roughness above 0"),
        (
            "\"material\": \"red\"",
            "\"material\": \"rde\"",
            r#"objects[0].material is "rde", the name of a material (mirror, red, rough) expected"#,
        ),
        ("\"name\": \"pot\"", "\"name\": \"wall\"", r#"objects[1].name repeats the name "wall""#),
        ("\"mirror\": {", "\"red\": {", r#""red" is given twice"#),
        ("meshes/quad.obj", "meshes/quad2.obj", "no such file: meshes/quad2.obj (named by objects[0].mesh in scene.json)"),
        ("red.png", "../red.png", "path may not leave the scene's folder"),
        ("red.png", "/red.png", "path may not leave the scene's folder"),
        ("\"triangles\": 2", "\"triangles\": 3", "objects[0].triangles is 3, the 2 triangles of meshes/quad.obj"),
        ("builtin:teapot", "builtin:teepot", r#"objects[1].patches is "builtin:teepot""#),
        ("\"first_patches\": 28", "\"first_patches\": 33", "objects[1].first_patches is 33, a whole number from 1 to 32"),
        ("\"per_edge\": 3", "\"per_edge\": 0", "objects[1].tessellation.per_edge is 0"),
        ("\"scale\": 2", "\"scale\": 0", "objects[0].transform is an object"),
        ("[3, 2, 1]", "[3, -2, 1]", "objects[2].emission is [3, -2, 1]"),
        ("[10, 10, 10]", "[10, 10]", "lights[0].intensity is [10, 10]"),
        ("\"radius\": 1", "\"radius\": -1", "objects[2].shape.radius is -1, a number above 0"),
        ("\"edge_u\": [1, 0, 0]", "\"edge_u\": [0, 1, 0]", r#"object "window": mesh has no triangle with an area above zero: scene.json"#),
        ("\"sky.exr\"", "\"red.png\"", "twice as wide as high expected"),
        ("\"scale\": 0.5", "\"layout\": \"cube\"", "environment.layout is \"cube\""),
        ("\"scale\": 0.5", "\"files\": []", "environment is an object {…}, an environment with one of"),
        ("\"target\": [0, 0, 0]", "\"target\": [0, 0, 5]", "cameras[0] is an object {…}, a camera with origin, target and up apart"),
        ("\"vfov_deg\": 40", "\"vfov_deg\": 180", "vertical field of view is 180 degrees"),
        ("\"width\": 64", "\"width\": 0", "cameras[0].width is 0"),
        ("\"patches\": \"builtin:teapot\", ", "", "objects[1] is an object {…}, an object with exactly one of"),
    ] {
        let message = broken(from, to);
        assert!(message.contains(expected), "{to}: {message}");
    }
}

#[test]
fn a_scene_file_cut_off_anywhere_is_an_error() {
    for length in 0..FULL.len() {
        assert!(load_full(&FULL[..length]).is_err(), "{length} bytes");
    }
}

#[test]
fn a_broken_file_behind_the_scene_is_named() {
    let with_file = |path: &str, bytes: Vec<u8>| {
        let mut files = with(FULL);
        files.insert(path, bytes).unwrap();
        load(&files, "scene.json", &LoadOptions::as_written()).expect_err(path).to_string()
    };
    let quad = QUAD.as_bytes();
    let cut = with_file("meshes/quad.obj", quad[..quad.len() - 8].to_vec());
    assert!(cut.contains("triangles"), "one triangle is left: {cut}");
    let faceless = QUAD.split("f ").next().unwrap_or_default();
    assert!(with_file("meshes/quad.obj", faceless.into()).ends_with("no face: meshes/quad.obj"));
    assert!(with_file("meshes/quad.obj", QUAD.replace("v 1 1 0", "v 1 nan 0").into()).contains("line 3: \"1 nan 0\""));
    for (path, bytes) in [("red.png", png()), ("sky.exr", exr(8, 4, 2.0))] {
        for length in [0, 3, bytes.len() / 2, bytes.len() - 9] {
            let message = with_file(path, bytes[..length].to_vec());
            assert!(message.ends_with(path), "{message}");
        }
    }
    assert!(with_file("sky.exr", exr(8, 4, f32::NAN)).contains("not a number"));
}

#[test]
fn a_given_environment_replaces_the_written_one() {
    let given = |bytes, scale, rotation_deg| {
        let environment = Some(EnvironmentFile { name: "mine.exr".into(), bytes, scale, rotation_deg });
        load(&with(FULL), "scene.json", &LoadOptions { environment })
    };
    assert_eq!(given(exr(4, 2, 3.0), 2.0, 0.0).unwrap().environment.radiance(Vec3::X), Vec3::splat(6.0));
    assert!(given(exr(4, 4, 3.0), 1.0, 0.0).unwrap_err().to_string().ends_with("mine.exr"));
    assert!(given(exr(4, 2, 3.0), f32::NAN, 0.0).is_err());
    assert!(given(exr(4, 2, 3.0), 1.0, f32::INFINITY).is_err());
}

#[test]
fn a_bundle_holds_exactly_what_the_scene_reads() {
    let mut files = with(FULL);
    files.insert("unused.bin", vec![0]).unwrap();
    let paths = referenced_files(&files, "scene.json").unwrap();
    assert_eq!(paths, ["meshes/quad.obj", "red.png", "scene.json", "sky.exr"]);
    let packed = bundle(&files, "scene.json").unwrap();
    assert_eq!(load(&packed, "scene.json", &LoadOptions::as_written()).unwrap().objects.len(), 4);
}

#[test]
fn six_files_make_an_environment_only_with_their_convention() {
    let faces = r#"{ "files": ["f.exr", "f.exr", "f.exr", "f.exr", "f.exr", "f.exr"], "layout": "cube-opengl" }"#;
    let json = FULL.replace(r#"{ "file": "sky.exr", "scale": 0.5, "rotation_deg": 90 }"#, faces);
    let mut files = with(&json);
    files.insert("f.exr", exr(4, 4, 7.0)).unwrap();
    let scene = load(&files, "scene.json", &LoadOptions::as_written()).unwrap();
    assert_eq!(scene.environment.radiance(Vec3::new(0.3, -0.5, 0.2).normalize()), Vec3::splat(7.0));
    files.insert("scene.json", json.replace(r#", "layout": "cube-opengl""#, "").into_bytes()).unwrap();
    assert!(load(&files, "scene.json", &LoadOptions::as_written()).unwrap_err().to_string().contains("layout"));
}

fn from_folder(folder: &Path, path: &str) -> Scene {
    let files = SceneFolder::open(folder, DEFAULT_FILE_LIMIT_BYTES).unwrap();
    load(&files, path, &LoadOptions::as_written()).unwrap()
}

// A scene of the data pack.
fn from_pack(folder: &str, path: &str) -> Option<Scene> {
    Some(from_folder(&shared(folder)?, path))
}

fn triangles(scene: &Scene) -> usize {
    scene.objects.iter().map(|o| o.mesh.triangles.len()).sum()
}

#[test]
fn box_room_loads_unchanged() {
    let scene = from_folder(&shipped("scenes/box-room"), "scene.json");
    assert_eq!((scene.objects.len(), triangles(&scene)), (10, 14 + 24 + 3968));
    let panel = &scene.objects[scene.object("panel").unwrap()];
    assert_eq!(panel.emission, Some(Vec3::new(10.0, 9.0, 7.5)));
    assert!(panel.mesh.area_vector(0).y < 0.0, "the lamp shines down");
    let camera = &scene.cameras[1].camera;
    let pose = Pose::look_at(Vec3::new(-1.6, 2.2, 1.2), Vec3::new(0.6, 0.7, 0.0), Vec3::Y).unwrap();
    assert_eq!(camera.pose(), &pose);
    // tan may differ in its last digit between a constant and a computed argument.
    assert!((camera.intrinsics().focal_px - Intrinsics::from_vfov(60.0, 320, 240).unwrap().focal_px).length() < 1e-4);
    assert_eq!((camera.intrinsics().width_px, camera.intrinsics().height_px), (320, 240));
    assert_eq!((scene.textures.len(), scene.notes.len()), (2, 0));
}

#[test]
fn staircase_loads_unchanged_and_equals_its_gltf() {
    let (Some(scene), Some(model)) = (from_pack("scenes/staircase", "scene.json"), from_pack("scenes/staircase", "staircase.glb")) else {
        return;
    };
    // A few of the 28,611 have no area.
    assert!((28_000..=28_611).contains(&triangles(&scene)), "{}", triangles(&scene));
    assert_eq!(triangles(&scene), triangles(&model));
    assert_eq!(scene.environment.radiance(Vec3::Y), Vec3::new(0.5625, 0.4216, 0.2621));
    let bounds = |s: &Scene| {
        let of = s.objects.iter().map(|o| o.mesh.bounds());
        of.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), (l, h)| (lo.min(l), hi.max(h)))
    };
    let ((low, high), (model_low, model_high)) = (bounds(&scene), bounds(&model));
    assert!((low - model_low).length() < 1e-3 && (high - model_high).length() < 1e-3);
    let shining =
        |s: &Scene| s.objects.iter().filter_map(|o| o.emission).map(|e| e.round().to_string()).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(shining(&scene), shining(&model));
    // Cameras: the same rays but for the picture's size.
    for (ours, theirs) in scene.cameras.iter().zip(&model.cameras) {
        assert!((ours.camera.pose().position() - theirs.camera.pose().position()).length() < 1e-3);
        let middle = |c: &NamedCamera| c.camera.ray(c.camera.intrinsics().center_px).direction;
        assert!(middle(ours).dot(middle(theirs)) > 0.9999, "{}", ours.name);
    }
}

#[test]
fn holodeck_comes_in_the_parts_of_its_own_materials() {
    let Some(scene) = from_pack("scenes/holodeck", "holodeck.obj") else { return };
    assert!(triangles(&scene) >= 2109, "{}", triangles(&scene));
    let wall = scene.objects.iter().find(|o| o.name.contains("wirefrane")).unwrap();
    assert!(matches!(scene.materials[wall.material], Material::Diffuse { albedo: Albedo::Texture(_) }));
    assert!(scene.objects.iter().any(|o| o.emission == Some(Vec3::ONE)));
    assert!(scene.notes.iter().any(|n| n.contains("map_Ke screen.png is not applied")), "{:?}", scene.notes);
}

#[test]
fn sponza_loads_with_notes_about_its_masks() {
    let Some(scene) = from_pack("scenes/sponza", "sponza.glb") else { return };
    assert!((262_000..=262_267).contains(&triangles(&scene)), "{}", triangles(&scene));
    assert_eq!(scene.cameras.len(), 2);
    assert_eq!(scene.notes.iter().filter(|n| n.contains("alpha is not applied")).count(), 3, "{:?}", scene.notes);
}

#[test]
fn real_files_cut_off_never_panic() {
    let root = shipped("scenes/box-room");
    for path in ["box-room.glb", "meshes/ball.obj"] {
        let whole = std::fs::read(root.join(path)).unwrap();
        for part in 0..24 {
            // Uneven steps, so that cuts fall into headers, numbers and line ends alike.
            let bytes = whole[..whole.len() * part / 24 + part % 5].to_vec();
            let mut files = SceneBundle::default();
            files.insert(path, bytes).unwrap();
            let cut = load(&files, path, &LoadOptions::as_written());
            // An OBJ ends wherever it ends; all else says how long it should be.
            assert!(cut.is_err() || path.ends_with(".obj"), "{path}, part {part}");
        }
    }
}

#[test]
fn real_files_with_one_byte_changed_never_panic() {
    let root = shipped("scenes/box-room");
    for (path, header) in [("box-room.glb", 6000), ("meshes/tall.obj", 1500), ("scene.json", 2000), ("textures/floor.png", 800)] {
        let whole = std::fs::read(root.join(path)).unwrap();
        for i in 0..150 {
            let mut bytes = whole.clone();
            let at = (noise::unit(1, i, 0) * header.min(whole.len()) as f32) as usize;
            bytes[at] = (noise::unit(2, i, 0) * 256.0) as u8;
            let changed = OneChanged { root: SceneFolder::open(&root, DEFAULT_FILE_LIMIT_BYTES).unwrap(), path, bytes };
            let asked = if path.ends_with("glb") { path } else { "scene.json" };
            // What matters is that it returns; most changes are errors, some are another scene.
            let _ = load(&changed, asked, &LoadOptions::as_written());
        }
    }
}

// A folder in which one file reads otherwise.
struct OneChanged<'a> {
    root: SceneFolder,
    path: &'a str,
    bytes: Vec<u8>,
}

impl SceneFiles for OneChanged<'_> {
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError> {
        if path == self.path { Ok(self.bytes.clone()) } else { self.root.read(path) }
    }
}
