//! `job submit observe`, `import` and `fit`: from a scene, or photographs, to a parameter map that is rendered and measured.

use std::path::{Path, PathBuf};

use lumisphere::images::{ReadLimits, Rgb8, decode_image, encode_png};
use serde_json::Value;

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
