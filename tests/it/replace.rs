//! `job submit replace`: another object in the light that a dataset holds, and what is refused.

use std::fs;
use std::path::Path;

use lumisphere::images::{ReadLimits, decode_image};
use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET};

/// Half as large as the captured box, amid it, and the same of chrome. No floor, no light.
const NEW: &str = r#"{
  "format": "neutral-scene/1", "name": "new", "up": "+Y", "handedness": "right",
  "materials": {"green": {"type": "diffuse", "albedo": [0.1, 0.7, 0.2]}, "chrome": {"type": "mirror", "reflectance": [0.9, 0.9, 0.9]}},
  "objects": [
    {"name": "small", "mesh": "meshes/box.obj", "material": "green", "transform": {"translate": [0, 0.5, 0], "scale": 0.5}},
    {"name": "bright", "mesh": "meshes/box.obj", "material": "chrome", "transform": {"translate": [0, 0.5, 0], "scale": 0.5}}
  ],
  "environment": null
}"#;

fn replace<'a>(scene: &'a str, flags: &[&'a str]) -> Vec<&'a str> {
    let spec = ["job", "submit", "replace", "--dataset", DATASET, "--into", "new", "--scene", scene];
    [&spec[..], &["--points", "24", "--epsilon", "0.15", "--watch", "--quiet"], flags].concat()
}

/// How much of a frame is greener than anything else of the scene is.
fn green_share(file: &Path) -> f64 {
    let picture = decode_image(&fs::read(file).unwrap(), ReadLimits::SCENE).unwrap();
    let pixels = picture.width * picture.height;
    let is_green = |at: &usize| {
        let [r, g, b] = picture.rgb(*at);
        g > 2.0 * r && g > 1.5 * b
    };
    (0..pixels).filter(is_green).count() as f64 / pixels as f64
}

#[test]
fn another_object_in_captured_light_is_a_dataset_that_renders_and_names_what_it_is_made_of() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let new = folder.path().join("scene").join("new.json");
    fs::write(&new, NEW).unwrap();
    let new = new.to_str().unwrap();

    let job = server.json(&replace(new, &["--object", "small", "--turn-deg", "30"]));
    let summary = &job["result"]["summary"];
    assert_eq!((job["kind"].as_str(), job["dataset"].as_str()), (Some("replace"), Some(DATASET)), "{job:#}");
    let parameters = &summary["parameters"];
    assert_eq!((parameters["object"].as_str(), parameters["replaced"]["object"].as_str()), (Some("small"), Some("box")), "{summary:#}");
    assert_eq!(parameters["face_size_texels"], 16);
    let shares = summary["replacing"]["shares"].as_object().unwrap();
    let sum: f64 = shares.values().map(|share| share.as_f64().unwrap()).sum();
    assert!((sum - 1.0).abs() < 1e-9 && shares["background"].as_f64().unwrap() > 0.02, "{shares:?}");
    let said = server.succeed(&["job", "get", job["name"].as_str().unwrap()]);
    let background = format!("background {:.1} %", 100.0 * shares["background"].as_f64().unwrap());
    assert!(said.contains("light of box version 1: ") && said.contains(&background), "{said}");

    let out = folder.path().join("frames");
    let render = ["render", "--dataset", "new", "--frames", "1", "--size", "64x48", "--component", "reconstruction", "--out"];
    server.succeed(&[&render[..], &[out.to_str().unwrap()]].concat());
    let green = green_share(&out.join("frame-00000.png"));
    assert!(green > 0.05, "{green} of the frame shows the new object");

    let refused = |arguments: &[&str], code: i32| {
        let answer = server.lumisphere(arguments);
        let said = String::from_utf8_lossy(&answer.stderr).into_owned();
        assert_eq!(answer.status.code(), Some(code), "{arguments:?}: {said}");
        said
    };
    // No scene has it: nothing to compare it with.
    let truth =
        refused(&["evaluate", "--dataset", "new", "--frames", "1", "--size", "32x24", "--out", out.to_str().unwrap(), "--force"], 6);
    assert!(truth.contains("does not say from which scene"), "{truth}");
    // A job that was begun and refused is a failed one; what a flag says is refused before.
    let chrome = refused(&replace(new, &["--object", "bright"]), 6);
    assert!(chrome.contains("spec.replace.object") && chrome.contains("not diffuse"), "{chrome}");
    let unknown = refused(&replace(new, &["--object", "teapot"]), 6);
    assert!(unknown.contains("it has small, bright"), "{unknown}");
    let beside = refused(&replace(new, &["--object", "small", "--stand-at", "2,0.75,0"]), 6);
    assert!(beside.contains("spec.replace.placement") && beside.contains("along x"), "{beside}");
    for flags in [["--scale", "0"], ["--face-size-texels", "20"], ["--turn-deg", "NaN"], ["--rays-per-texel", "2000"]] {
        refused(&replace(new, &[&["--object", "small"][..], &flags].concat()), 2);
    }
    // Of another kind, or not there at all.
    refused(&["job", "submit", "replace", "--dataset", "nothing", "--into", "x", "--scene", new, "--object", "small"], 3);
    let versions = server.json(&["dataset", "get", "new"])["versions"].clone();
    assert_eq!(versions.as_array().map(Vec::len), Some(1), "{versions:#}");
    let bounds: Value = versions[0]["object_bounds"].clone();
    assert!(bounds["min"][1].as_f64().is_some_and(|low| (low - 0.75).abs() < 1e-5), "{bounds:#}");
}
