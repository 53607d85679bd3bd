//! A bowl that sees itself as a mirror: from the command line, beside its ground truth and in an evaluation.

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use crate::pictures::Picture;
use crate::process::{Server, temporary_folder};
use crate::tiny::{DATASET, QUICK};

const BOWL: &str = r#"{"format": "neutral-scene/1",
    "materials": {"clay": {"type": "diffuse", "albedo": [0.8, 0.3, 0.1]}},
    "objects": [{"name": "bowl", "material": "clay",
        "shape": {"type": "lathe", "segments": 24, "profile": [[0.6, 0], [1.0, 0.8], [0.85, 0.8], [0.5, 0.15], [0, 0.15]]}}],
    "environment": {"radiance": [0.4, 0.6, 0.9]},
    "cameras": [{"name": "into", "origin": [0.4, 2.6, 2.4], "target": [0, 0.4, 0], "vfov_deg": 30, "width": 64, "height": 48}]}"#;

fn rendered(server: &Server, folder: &Path, name: &str, flags: &[&str]) -> Picture {
    let out = folder.join(name);
    let (out_text, scene) = (out.to_str().unwrap(), folder.join("bowl.json"));
    let base = ["render", "--dataset", DATASET, "--component", "mirror", "--blend", "corrected", "--cameras", scene.to_str().unwrap()];
    server.succeed(&[&base, flags, &["--out", out_text, "--quiet"]].concat());
    Picture::of_png(&fs::read(out.join("frame-00000.png")).unwrap())
}

fn with_bowl() -> (TempDir, Server) {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = folder.path().join("bowl.json");
    fs::write(&scene, BOWL).unwrap();
    let capture = ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "bowl", "--dataset", DATASET];
    let finer = ["--points", "120", "--epsilon", "0.1", "--face-size-texels", "32"];
    server.json(&[&capture[..], &finer, &QUICK[6..], &["--watch", "--quiet"]].concat());
    (folder, server)
}

#[test]
fn a_mirror_that_sees_itself_is_near_its_ground_truth_which_one_reflection_is_not() {
    let (folder, server) = with_bowl();
    let once = rendered(&server, folder.path(), "once", &[]);
    let twice = rendered(&server, folder.path(), "twice", &["--reflections", "2"]);
    let truth = rendered(&server, folder.path(), "truth", &["--reflections", "2", "--truth", "--truth-passes", "64"]);
    let (right, instead) = (twice.mean(&truth), once.mean(&truth));
    assert!(right < 0.5 * instead && instead > 4.0, "{right} codes from the truth, with one reflection {instead}");
    // Without an adapter these are the same.
    let on_cpu = rendered(&server, folder.path(), "on-cpu", &["--reflections", "2", "--backend", "cpu"]);
    assert!(twice.mean(&on_cpu) < 0.3, "{} codes between the backends", twice.mean(&on_cpu));
}

#[test]
fn evaluations_and_sweeps_compare_several_reflections_with_as_many() {
    let (folder, server) = with_bowl();
    let mut evaluate = vec!["evaluate", "--dataset", DATASET, "--components", "mirror", "--blends", "corrected", "--reflections", "3"];
    evaluate.extend(["--frames", "1", "--size", "32x24", "--truth-samples-per-pixel", "4", "--quiet"]);
    let row = &server.json(&evaluate)["summary"]["rows"][0];
    assert_eq!((row["truth"].as_str(), row["reflections"].as_u64()), (Some("several_reflections"), Some(3)), "{row:#}");

    // A group for each truth, and what is chosen from one reflects as often.
    let (file, out) = (folder.path().join("sweep.toml"), folder.path().join("sweep"));
    let settings =
        "[settings]\nblends = \"corrected\"\nreflections = [1, 2]\n[views]\nframes = 1\nsize = \"32x24\"\n[truth]\nsamples_per_pixel = 4\n";
    fs::write(&file, format!("datasets = [\"{DATASET}\"]\ntimed_frames_per_view = 1\n{settings}")).unwrap();
    server.succeed(&["evaluate", "sweep", file.to_str().unwrap(), "--out", out.to_str().unwrap(), "--quiet"]);
    let (sweep, scene) = (out.join("sweep.json").display().to_string(), folder.path().join("bowl.json").display().to_string());
    let to = folder.path().join("chosen");
    let mut chosen = vec!["render", "--choose", &sweep, "--max-millis", "1000000", "--group", "mirror, 2 reflections"];
    chosen.extend(["--cameras", &scene, "--quiet", "--out", to.to_str().unwrap()]);
    server.succeed(&chosen);
    let chosen = Picture::of_png(&fs::read(to.join("frame-00000.png")).unwrap());
    let once = rendered(&server, folder.path(), "once", &[]);
    let twice = rendered(&server, folder.path(), "twice", &["--reflections", "2"]);
    assert_eq!((chosen.mean(&twice), chosen.mean(&once) > 0.0), (0.0, true));
}

#[test]
fn more_reflections_than_there_may_be_are_refused_by_their_number() {
    let (folder, server) = with_bowl();
    let to = folder.path().join("none").display().to_string();
    let refused = server.lumisphere(&["render", "--dataset", DATASET, "--component", "mirror", "--reflections", "9", "--out", &to]);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && said.contains("reflections: 9, 1 to 4 expected"), "{said}");
}
