//! An object captured with its highlights, through the real binaries.

use std::fs;

use crate::process::{Server, temporary_folder};
use crate::tiny;

#[test]
fn what_was_captured_as_authored_is_compared_with_that_and_not_lit_or_coated_once_more() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = tiny::write_scene(&folder.path().join("scene"));
    let matte = r#"{"type": "diffuse", "albedo": [0.7, 0.2, 0.1]}"#;
    let text = fs::read_to_string(&scene).unwrap();
    assert!(text.contains(matte));
    fs::write(&scene, text.replace(matte, r#"{"type": "ggx", "alpha": 0.5, "reflectance": [0.7, 0.2, 0.1]}"#)).unwrap();
    let capture = |dataset: &str, original: &str| {
        let scene = scene.to_str().unwrap();
        let what = ["job", "submit", "capture", "--scene", scene, "--object", "box", "--dataset", dataset, "--original", original];
        let how = "--points 24 --epsilon 0.3 --face-size-texels 16 --samples-per-texel 4 --max-bounces 2 --sample-map-size-texels 16 --watch --quiet";
        server.succeed(&[&what[..], &how.split_whitespace().collect::<Vec<_>>()].concat());
    };
    capture("shiny", "as-authored");
    capture("matte", "diffuse");
    let rows = |dataset: &str| {
        let how = "--components reconstruction --blends corrected --frames 2 --size 48x32 --truth-samples-per-pixel 64 --quiet";
        let document = server.json(&[&["evaluate", "--dataset", dataset][..], &how.split_whitespace().collect::<Vec<_>>()].concat());
        let rows = document["summary"]["rows"].as_array().unwrap_or_else(|| panic!("{document:#}")).clone();
        rows.iter().map(|row| (row["truth"].as_str().unwrap().to_string(), row["rmse_lab"][0].as_f64().unwrap())).collect::<Vec<_>>()
    };
    let (shiny, matte) = (rows("shiny"), rows("matte"));
    assert!(shiny.len() == 2 && shiny.iter().all(|(truth, error)| truth == "as_authored" && *error < 0.1), "{shiny:?}");
    assert!(matte.iter().all(|(truth, _)| truth == "diffuse"), "{matte:?}");

    // Thinned by what it should show, and not by the matte object.
    let thin = |component: &str| {
        let what = ["job", "submit", "thin", "--dataset", "shiny", "--into", "thinned", "--component", component, "--blend", "corrected"];
        let how = "--metric rmse-l --max-error 0.4 --windows 60 --truth-samples-per-pixel 64 --watch --quiet --json";
        server.lumisphere(&[&what[..], &how.split_whitespace().collect::<Vec<_>>()].concat())
    };
    let output = thin("reconstruction");
    let job: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {output:?}"));
    let error = job["result"]["summary"]["thinning"]["report"]["error_before"].as_f64().unwrap_or_else(|| panic!("{job:#}"));
    // .083 is measured, .107 against the matte object.
    assert!(error < 0.095, "{error}");
    // Refused where it is asked for, before there is a job.
    let jobs = || server.json(&["job", "list"]);
    let before = jobs();
    let output = thin("full");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && text.contains("captured as authored"), "{text}");
    assert_eq!(jobs(), before);

    let manifest = server.json(&["dataset", "get", "shiny"]);
    assert!(manifest.to_string().contains("as_authored"), "{manifest:#}");
    for refused in [&["--component", "full"][..], &["--environment-turn-deg", "30"]] {
        let out = folder.path().join("frame.png");
        let frame = ["render", "--dataset", "shiny", "--blend", "average", "--size", "48x32", "--out", out.to_str().unwrap()];
        let output = server.lumisphere(&[&frame[..], refused].concat());
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && text.contains("captured as authored"), "{refused:?}: {text}");
    }
}
