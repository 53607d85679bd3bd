//! `job submit observe`, `import` and `fit`: from a scene, or photographs, to a parameter map that is rendered and measured.

use std::path::{Path, PathBuf};

use glam::Vec3;
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::images::{ExrStorage, Image, ReadLimits, Rgb8, decode_image, encode_exr_rgb, encode_png};
use serde_json::{Value, json};

use crate::process::{Server, temporary_folder};

/// A square with a highlight, over a floor, under one lamp.
const SCENE: &str = r#"{"format": "neutral-scene/1",
    "materials": {"red": {"type": "phong", "diffuse": [0.5, 0.06, 0.06], "specular": [0.3, 0.3, 0.3], "exponent": 20},
        "grey": {"type": "diffuse", "albedo": [0.4, 0.4, 0.4]}},
    "objects": [
        {"name": "floor", "shape": {"type": "rect", "corner": [-3, -0.01, 3], "edge_u": [6, 0, 0], "edge_v": [0, 0, -6]}, "material": "grey"},
        {"name": "plane", "shape": {"type": "rect", "corner": [-0.5, 0, 0.5], "edge_u": [1, 0, 0], "edge_v": [0, 0, -1]}, "material": "red"}],
    "lights": [{"type": "disc", "center": [1.5, 2, -1.5], "normal": [-1.5, -2, 1.5], "radius": 0.1, "radiance": [600, 600, 600]}],
    "environment": {"radiance": [0.05, 0.05, 0.05]},
    "cameras": [{"name": "a", "origin": [0, 1, 3], "target": [0, 0, 0], "vfov_deg": 40, "width": 64, "height": 48}]}"#;

fn observe(server: &Server, folder: &Path, dataset: &str) -> Value {
    let scene = folder.join("scene.json");
    std::fs::write(&scene, SCENE).unwrap();
    let submit = ["job", "submit", "observe", "--scene", scene.to_str().unwrap(), "--object", "plane", "--dataset", dataset];
    let quick = ["--size-texels", "16", "--samples-per-observation", "16", "--max-bounces", "1", "--watch", "--quiet"];
    server.json(&[&submit[..], &quick].concat())
}

fn fit(server: &Server, from: &str, into: &str, model: &str) -> Value {
    server.json(&["job", "submit", "fit", "--observations", from, "--dataset", into, "--model", model, "--watch", "--quiet"])
}

fn refused(server: &Server, arguments: &[&str]) -> String {
    let answer = server.lumisphere(arguments);
    assert!(!answer.status.success(), "{arguments:?}");
    String::from_utf8_lossy(&answer.stderr).into_owned()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn a_glossy_square_is_observed_fitted_rendered_and_measured() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let seen = observe(&server, folder.path(), "seen");
    assert_eq!((&seen["result"]["dataset"], &seen["result"]["summary"]["pages"]), (&"seen".into(), &4.into()), "{seen:#}");
    let constant = fit(&server, "seen", "dull", "constant");
    let auto = fit(&server, "seen", "map", "auto");
    let (dull, best) = (&constant["result"]["summary"], &auto["result"]["summary"]);
    assert_eq!(dull["fit"]["histogram"]["constant"], 256, "{dull:#}");
    assert!(number(&best["fit"]["rms_residual"]) < 0.1 * number(&dull["fit"]["rms_residual"]), "{best:#}");
    assert_eq!(best["fit"]["texels"], 256);
    let listed = server.succeed(&["dataset", "list"]);
    assert!(listed.contains("observation_map") && listed.contains("parameter_map"), "{listed}");

    let frames = |dataset: &str, out: &str, flags: &[&str]| {
        let out = folder.path().join(out);
        let render = ["render", "--dataset", dataset, "--frames", "2", "--size", "64x48", "--elevation-deg", "40", "--format", "exr"];
        server.succeed(&[&render[..], &["--out", out.to_str().unwrap()], flags].concat());
        std::fs::read(out.join("frame-00001.exr")).unwrap()
    };
    assert_ne!(frames("map", "radiance", &[]), frames("map", "models", &["--component", "models"]));
    assert_eq!(frames("map", "a", &["--backend", "cpu"]), frames("map", "b", &["--backend", "cpu", "--component", "radiance"]));

    let evaluated = |dataset: &str| {
        let views = ["--frames", "2", "--size", "48x36", "--elevation-deg", "50", "--distance-radii", "3", "--max-bounces", "1"];
        let evaluate = ["evaluate", "--dataset", dataset, "--components", "radiance", "--truth-samples-per-pixel", "64", "--quiet"];
        let rows = server.json(&[&evaluate[..], &views].concat())["summary"]["rows"].clone();
        assert_eq!((rows[0]["truth"].as_str(), rows.as_array().map(Vec::len)), (Some("as_authored"), Some(1)), "{rows:#}");
        number(&rows[0]["delta_e_2000_mean"])
    };
    let (flat, fitted) = (evaluated("dull"), evaluated("map"));
    assert!(fitted < 0.25 * flat && fitted < 2.0, "dE2000 {fitted} with lobes, {flat} without");
}

#[test]
fn what_cannot_be_observed_fitted_or_shown_is_said_by_name() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    observe(&server, folder.path(), "seen");
    let out = folder.path().join("out");
    let render = refused(&server, &["render", "--dataset", "seen", "--out", out.to_str().unwrap()]);
    assert!(render.contains("cannot be rendered: fit a parameter map to it"), "{render}");
    let submit = |flags: &[&str]| refused(&server, &[&["job", "submit"][..], flags].concat());
    assert!(submit(&["fit", "--observations", "nothing", "--dataset", "map"]).contains("nothing"));
    let model = submit(&["fit", "--observations", "seen", "--dataset", "map", "--model", "phong:9"]);
    assert!(model.contains("phong:1 to phong:4"), "{model}");
    let twice = submit(&["fit", "--observations", "seen", "--dataset", "seen", "--watch"]);
    assert!(twice.contains("observation_map") && twice.contains("parameter_map"), "{twice}");
    fit(&server, "seen", "map", "constant");
    let other = submit(&["fit", "--observations", "map", "--dataset", "again"]);
    assert!(other.contains(r#""observation_map" expected"#), "{other}");
    let settings = refused(&server, &["render", "--dataset", "map", "--component", "mirror", "--out", out.to_str().unwrap()]);
    assert!(settings.contains("parameter_map"), "{settings}");
    let observe = ["observe", "--scene", "gazebo", "--object", "nobody", "--dataset", "x", "--watch", "--quiet"];
    assert!(submit(&observe).contains("nobody"));
    let scheme = submit(&["observe", "--scene", "gazebo", "--object", "teapot", "--dataset", "x", "--directions", "icosahedron:18"]);
    assert!(scheme.contains("icosahedron"), "{scheme}");
}

#[test]
fn directions_are_suggested_for_a_map_from_the_observations_that_it_was_fitted_to() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    observe(&server, folder.path(), "seen");
    fit(&server, "seen", "map", "phong:1");
    let submit = ["job", "submit", "suggest", "--dataset", "map", "--watch", "--quiet"];
    let job = server.json(&[&submit[..], &["--count", "5", "--candidates", "icosahedron:1249"]].concat());
    let suggested = &job["result"]["summary"]["suggested"];
    assert_eq!((&job["kind"], &suggested["candidates"], &suggested["texels"]), (&"suggest".into(), &1249.into(), &256.into()), "{job:#}");
    let directions = suggested["directions"].as_array().unwrap();
    assert_eq!(directions.len(), 5);
    for one in directions {
        let d = [0, 1, 2].map(|axis| number(&one["direction"][axis]));
        // The plane faces +Y.
        assert!(d[1] > 0.0 && (d.iter().map(|c| c * c).sum::<f64>() - 1.0).abs() < 1e-5 && number(&one["gain_nats"]) > 0.0, "{one}");
    }
    let text = server.succeed(&[&submit[..], &["--count", "2"]].concat());
    assert!(text.contains("NATS A TEXEL") && text.lines().count() >= 4, "{text}");
    assert!(server.json(&["job", "list"])["jobs"][0]["kind"] == "suggest");

    let kind = refused(&server, &["job", "submit", "suggest", "--dataset", "seen"]);
    assert!(kind.contains(r#""parameter_map" expected"#), "{kind}");
    let many = refused(&server, &[&submit[..], &["--candidates", "stratified:4096:0"]].concat());
    assert!(many.contains("spec.suggest.candidates: 4096 directions, at most 2600"), "{many}");
    server.succeed(&["dataset", "delete", "seen"]);
    let gone = refused(&server, &submit);
    assert!(gone.contains("seen"), "{gone}");
}

/// Photographs of a dull square with a highlight that moves with the light, and their list.
fn photographs(folder: &Path) -> PathBuf {
    let directions: Vec<[f32; 3]> = (0..24)
        .map(|i| {
            let (ring, turn) = ((i / 8) as f32, (i % 8) as f32 * std::f32::consts::FRAC_PI_4 + 0.3 * (i / 8) as f32);
            let zenith = (10.0 + 25.0 * ring).to_radians();
            [zenith.sin() * turn.cos(), zenith.sin() * turn.sin(), zenith.cos()]
        })
        .collect();
    let mut list = format!("{}\n", directions.len());
    for (k, [x, y, z]) in directions.into_iter().enumerate() {
        // Modified Phong about the direction (.3, 0, .954), in sRGB codes of radiance.
        let height = (0.3 * x + 0.954 * z).max(0.0).powf(15.0);
        let code = |radiance: f32| (255.0 * (1.055 * radiance.powf(1.0 / 2.4) - 0.055)) as u8;
        let row = (0..20).flat_map(|i| [code(0.1 + 0.02 * i as f32 + 0.3 * height), code(0.2 + 0.3 * height), code(0.05)]);
        let pixels: Vec<u8> = std::iter::repeat_n(row, 10).flatten().collect();
        let picture = encode_png(&Rgb8::from_bytes(20, 10, pixels).unwrap()).unwrap();
        std::fs::write(folder.join(format!("{k}.png")), picture).unwrap();
        list.push_str(&format!("{k}.png {x} {y} {z}\n"));
    }
    let path = folder.join("dirs.lp");
    std::fs::write(&path, list).unwrap();
    path
}

#[test]
fn photographs_under_a_moving_light_become_a_map_whose_frames_show_the_highlight() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let list = photographs(folder.path());
    let import = ["job", "submit", "import", "--photographs", list.to_str().unwrap(), "--dataset", "seen", "--size-texels", "20"];
    let seen = server.json(&[&import[..], &["--watch", "--quiet"]].concat());
    assert_eq!(seen["result"]["summary"]["parameters"]["directions"], "dirs.lp", "{seen:#}");
    let fitted = fit(&server, "seen", "map", "phong:1");
    assert_eq!(fitted["result"]["summary"]["fit"]["histogram"]["phong:1"], 400, "{fitted:#}");
    // 8-bit codes of values around .3: a step is .004.
    assert!(number(&fitted["result"]["summary"]["fit"]["rms_residual"]) < 0.004, "{fitted:#}");
    // From where the highlight is, and from the other side.
    let brightness = |position: &str, out: &str| {
        let out = folder.path().join(out);
        let pose = ["--position", position, "--target", "0,0,0", "--size", "33x33", "--vfov-deg", "10"];
        server.succeed(&[&["render", "--dataset", "map", "--out", out.to_str().unwrap()][..], &pose].concat());
        let frame = decode_image(&std::fs::read(out.join("frame-00000.png")).unwrap(), ReadLimits::SCENE).unwrap();
        frame.rgb(33 * 16 + 16)[1]
    };
    let (toward, away) = (brightness("0.9,0,2.86", "toward"), brightness("-0.9,0,2.86", "away"));
    // Green: .2 + .3, and .2 + .3 · .82¹⁵ = .215; codes of both ends are .004 apart at most.
    assert!((toward - 0.5).abs() < 0.015 && (away - 0.215).abs() < 0.015, "{toward} {away}");

    std::fs::write(&list, "24\n0.png 0 0 NaN\n").unwrap();
    let nan = refused(&server, &import);
    assert!(nan.contains("line 2: z") && nan.contains("finite"), "{nan}");
    std::fs::write(&list, "2\n0.png 0 0 1\n").unwrap();
    assert!(refused(&server, &import).contains("2 photographs announced, 1 found"));
    std::fs::write(&list, "1\nnone.png 0 0 1\n").unwrap();
    assert!(refused(&server, &import).contains("none.png"));
    std::fs::write(&list, "2\n0.png 0 0 1\n1.png 0 0.1 1\n").unwrap();
    std::fs::write(folder.path().join("1.png"), encode_png(&Rgb8::filled(5, 5, [9; 3])).unwrap()).unwrap();
    let sizes = refused(&server, &[&import[..], &["--watch"]].concat());
    assert!(sizes.contains("1.png has 5x5 pixels, 20x10 expected"), "{sizes}");
}

/// What the square of `SCENE` is painted with here: red grows with u (x), green with v (−z).
fn paint(x: f32, z: f32) -> [f32; 3] {
    let inside = x.abs() <= 0.5 && z.abs() <= 0.5;
    if inside { [0.7 + x, 0.7 - z, 0.3] } else { [0.0; 3] }
}

#[test]
fn photographs_of_an_object_become_a_map_of_it() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = folder.path().join("scene.json");
    std::fs::write(&scene, SCENE).unwrap();
    // Cameras in the scene's space, +Y up, and what they see of the painted square.
    let intrinsics = Intrinsics::from_vfov(30.0, 80, 60).unwrap();
    let places = [[0.0, 3.0, 0.1], [1.5, 2.5, 0.5], [-1.0, 2.0, 1.5], [0.4, 2.2, -1.8], [-1.6, 2.4, -0.7]];
    let frames = places.iter().enumerate().map(|(k, place)| {
        let pose = Pose::look_at(Vec3::from(*place), Vec3::ZERO, Vec3::Y).unwrap();
        let camera = Camera::new(intrinsics, pose).unwrap();
        let mut picture = Image::zeros(80, 60, 3);
        for (i, j) in (0..80 * 60).map(|at| (at % 80, at / 80)) {
            let ray = camera.pixel_ray(i, j);
            let at = ray.origin - ray.origin.y / ray.direction.y * ray.direction;
            picture.set_rgb((j * 80 + i) as usize, paint(at.x, at.z));
        }
        let file = format!("{k}.exr");
        std::fs::write(folder.path().join(&file), encode_exr_rgb(&picture, ExrStorage::Float).unwrap()).unwrap();
        let columns = [Vec3::X, Vec3::Y, Vec3::Z].map(|axis| pose.world_from_camera_vector(axis));
        let row = |r: usize| [columns[0][r], columns[1][r], columns[2][r], pose.position()[r]];
        json!({"file_path": file, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
    });
    let frames: Vec<Value> = frames.collect();
    let (focal, center) = (intrinsics.focal_px, intrinsics.center_px);
    let list = folder.path().join("transforms.json");
    let lens = json!({"w": 80, "h": 60, "fl_x": focal.x, "fl_y": focal.y, "cx": center.x, "cy": center.y, "frames": frames});
    std::fs::write(&list, lens.to_string()).unwrap();

    let import =
        ["job", "submit", "import", "--photographs", list.to_str().unwrap(), "--dataset", "seen", "--size-texels", "16", "--watch"];
    let of = |object: &'static str| ["--scene", scene.to_str().unwrap(), "--object", object, "--quiet"].map(String::from);
    let arguments = |object: &'static str| import.iter().map(|a| a.to_string()).chain(of(object)).collect::<Vec<_>>();
    let submit = arguments("plane");
    let seen = server.json(&submit.iter().map(String::as_str).collect::<Vec<_>>());
    assert_eq!(seen["result"]["summary"]["parameters"]["object"], "plane", "{seen:#}");
    let fitted = fit(&server, "seen", "map", "constant");
    assert_eq!(fitted["result"]["summary"]["fit"]["histogram"]["constant"], 256, "{fitted:#}");
    // A pixel is a twentieth of the square wide, and red changes by 1 along it; at the rim black is mixed in.
    assert!(number(&fitted["result"]["summary"]["fit"]["median_residual"]) < 0.02, "{fitted:#}");

    let out = folder.path().join("out");
    let pose = ["--position", "0,3,0.001", "--target", "0,0,0", "--size", "60x60", "--vfov-deg", "20", "--format", "exr"];
    server.succeed(&[&["render", "--dataset", "map", "--out", out.to_str().unwrap()][..], &pose].concat());
    let frame = decode_image(&std::fs::read(out.join("frame-00000.exr")).unwrap(), ReadLimits::SCENE).unwrap();
    // From above, +X right, −Z up: half of the picture's height is 3 · tan 10° = .529.
    for (x, z) in [(0.3, 0.0), (-0.3, 0.2), (0.0, -0.35)] {
        let (i, j) = ((30.0 + 30.0 * x / 0.529) as usize, (30.0 + 30.0 * z / 0.529) as usize);
        let (shown, expected) = (frame.rgb(j * 60 + i), paint(x, z));
        assert!((0..3).all(|c| (shown[c] - expected[c]).abs() < 0.05), "({x}, {z}): {shown:?}, {expected:?} expected");
    }

    let other = arguments("pot");
    let refusal = refused(&server, &other.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(refusal.contains(r#"no object "pot"; it has floor, plane"#), "{refusal}");
    let alone = refused(&server, &[&import[..], &["--object", "plane"]].concat());
    assert!(alone.contains("--scene"), "{alone}");
}

#[test]
fn scene_linear_exposures_become_one_photograph() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    // A dull and a bright half; a sensor that is full at 1, and an exposure of an eighth beside the whole one.
    let exposure = |scale: f32| {
        let mut picture = Image::zeros(20, 10, 3);
        (0..200).for_each(|at| picture.set_rgb(at, [if at % 20 < 10 { 0.2 } else { 4.0 }; 3].map(|v: f32| (scale * v).min(1.0))));
        encode_exr_rgb(&picture, ExrStorage::Float).unwrap()
    };
    for (file, scale) in [("a.exr", 1.0), ("b.exr", 0.125), ("c.exr", 1.0), ("d.exr", 0.125), ("e.exr", 0.125)] {
        std::fs::write(folder.path().join(file), exposure(scale)).unwrap();
    }
    let list = folder.path().join("list.json");
    let write = |exposures: &str| {
        let one = |files: &str, x: f32| format!(r#"{{"files": [{files}], {exposures} "camera": [{x}, 0, 5]}}"#);
        // The last is an eighth alone: its exposure counts, too.
        let alone = r#"{"files": ["e.exr"], "exposures": [0.125], "camera": [-1, 0, 5]}"#.to_string();
        let photographs = [one(r#""a.exr", "b.exr""#, 0.0), one(r#""c.exr", "d.exr""#, 1.0), alone].join(", ");
        let head = r#""format": "lumisphere-photographs/1", "width": 2, "height": 1, "saturation": 1"#;
        std::fs::write(&list, format!(r#"{{{head}, "photographs": [{photographs}]}}"#)).unwrap();
    };
    write(r#""exposures": [1, 0.125],"#);
    let import = ["job", "submit", "import", "--photographs", list.to_str().unwrap(), "--dataset", "seen", "--size-texels", "20"];
    let import = [&import[..], &["--watch", "--quiet"]].concat();
    server.json(&import);
    let fitted = fit(&server, "seen", "map", "constant");
    assert_eq!(fitted["result"]["summary"]["fit"]["histogram"]["constant"], 400, "{fitted:#}");
    let out = folder.path().join("out");
    let pose = ["--position", "0,0,6", "--target", "0,0,0", "--size", "40x20", "--vfov-deg", "8", "--format", "exr"];
    server.succeed(&[&["render", "--dataset", "map", "--out", out.to_str().unwrap()][..], &pose].concat());
    let frame = decode_image(&std::fs::read(out.join("frame-00000.exr")).unwrap(), ReadLimits::SCENE).unwrap();
    let (dull, bright) = (frame.rgb(10 * 40 + 8)[0], frame.rgb(10 * 40 + 32)[0]);
    // Frames are half floats.
    assert!((dull / 0.2 - 1.0).abs() < 0.01 && (bright / 4.0 - 1.0).abs() < 0.01, "{dull} {bright}");
    write("");
    let refusal = refused(&server, &import);
    assert!(refusal.contains("a.exr, b.exr") && refusal.contains(r#"a list with "exposures" expected"#), "{refusal}");
}
