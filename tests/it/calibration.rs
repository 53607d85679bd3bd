//! `calibrate`: from photographs with marked corners to where they were taken from, and on to a parameter map.

use std::path::Path;
use std::process::{Command, Output};

use lumisphere::geometry::{Camera, Intrinsics, PhotographCamera, Pose};
use lumisphere::images::{ReadLimits, Rgb8, decode_image, encode_png};
use serde_json::{Value, json};

use crate::process::{Server, binary, temporary_folder};

const SIZE: [u32; 2] = [96, 72];
const COLORS: [[u8; 3]; 4] = [[200, 40, 40], [40, 160, 40], [40, 40, 200], [220, 200, 60]];

/// A camera with a lens that distorts, at this place, looking at the middle of a sheet of 2 × 1 in z = 0.
fn photograph(name: &str, at: [f32; 3]) -> PhotographCamera {
    let pose = Pose::look_at(at.into(), [0.0; 3].into(), [0.0, 1.0, 0.0].into()).unwrap();
    let intrinsics = Intrinsics { width_px: SIZE[0], height_px: SIZE[1], focal_px: [90.0, 91.0].into(), center_px: [47.0, 36.5].into() };
    let distortion = lumisphere::geometry::Distortion::new([-0.1, 0.02, 0.001, -0.001]).unwrap();
    PhotographCamera { file: name.into(), camera: Camera::new(intrinsics, pose).unwrap(), distortion }
}

/// What it sees: four coloured quarters on white.
fn picture(photograph: &PhotographCamera) -> Vec<u8> {
    let mut picture = Rgb8::filled(SIZE[0] as usize, SIZE[1] as usize, [255; 3]);
    for (row, column) in (0..SIZE[1]).flat_map(|row| (0..SIZE[0]).map(move |column| (row, column))) {
        let Ok(ray) = photograph.ray([column as f32 + 0.5, row as f32 + 0.5].into()) else { continue };
        let place = ray.at(-ray.origin.z / ray.direction.z);
        if place.x.abs() < 1.0 && place.y.abs() < 0.5 {
            let quarter = usize::from(place.x > 0.0) + 2 * usize::from(place.y > 0.0);
            let at = 3 * (row * SIZE[0] + column) as usize;
            picture.bytes[at..at + 3].copy_from_slice(&COLORS[quarter]);
        }
    }
    encode_png(&picture).unwrap()
}

/// Writes photographs, lens and corners; where the cameras stood.
fn photographed(folder: &Path) -> Vec<[f32; 3]> {
    let places = [[0.9, 0.4, 2.4], [-1.1, 0.3, 2.2], [0.2, -1.3, 2.0], [0.5, 1.2, 2.3], [-0.8, -0.9, 2.1], [1.4, -0.5, 1.9]];
    let entry = |(i, at): (usize, &[f32; 3])| {
        let name = format!("{i}.png");
        let photograph = photograph(&name, *at);
        std::fs::write(folder.join(&name), picture(&photograph)).unwrap();
        let corners = [[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]].map(|[x, y]: [f32; 2]| {
            let at = photograph.project([x, y, 0.0].into()).unwrap();
            [f64::from(at.x), f64::from(at.y)]
        });
        json!({ "file": name, "corners": corners })
    };
    let entries: Vec<Value> = places.iter().enumerate().map(entry).collect();
    let lens = lumisphere::formats::lens::write(&photograph("", places[0]));
    std::fs::write(folder.join("lens.json"), lens.to_string()).unwrap();
    write_corners(folder, entries);
    places.to_vec()
}

fn write_corners(folder: &Path, entries: Vec<Value>) {
    let corners = json!({ "format": "lumisphere-corners/1", "photographs": entries });
    std::fs::write(folder.join("corners.json"), corners.to_string()).unwrap();
}

/// Without a server.
fn calibrate(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(binary("lumisphere")).current_dir(folder).arg("calibrate").args(arguments).output().unwrap()
}

const POSES: [&str; 8] = ["poses", "corners.json", "--lens", "lens.json", "--width", "2", "--height", "1"];

#[test]
fn marked_corners_become_poses_and_photographs_a_map() {
    let folder = temporary_folder();
    let places = photographed(folder.path());
    let answer = calibrate(folder.path(), &[&POSES[..], &["--out", "photographs.json", "--json"]].concat());
    assert!(answer.status.success(), "{}", String::from_utf8_lossy(&answer.stderr));
    let document: Value = serde_json::from_slice(&answer.stdout).unwrap();
    for (photograph, place) in document["photographs"].as_array().unwrap().iter().zip(places) {
        let found: Vec<f64> = photograph["position"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        // Corners are exact but for f32: 1e-5 px of 40 px at a distance of 2.5.
        assert!((0..3).all(|k| (found[k] - f64::from(place[k])).abs() < 1e-3), "{found:?} is not {place:?}");
    }
    assert!(document["rms_px"].as_f64().unwrap() < 1e-3, "{document:#}");

    let server = Server::start(&folder.path().join("data"));
    let list = folder.path().join("photographs.json");
    let import = ["job", "submit", "import", "--photographs", list.to_str().unwrap(), "--dataset", "seen", "--size-texels", "32"];
    server.json(&[&import[..], &["--watch", "--quiet"]].concat());
    server.json(&["job", "submit", "fit", "--observations", "seen", "--dataset", "map", "--model", "constant", "--watch", "--quiet"]);
    let out = folder.path().join("frames");
    let front = ["--frames", "1", "--size", "80x40", "--vfov-deg", "20", "--elevation-deg", "5", "--azimuth-deg", "0", "--format", "png"];
    server.succeed(&[&["render", "--dataset", "map", "--out", out.to_str().unwrap()][..], &front].concat());
    let frame = decode_image(&std::fs::read(out.join("frame-00000.png")).unwrap(), ReadLimits::SCENE).unwrap();
    // Each quarter's hue is found in the frame: red, green, blue and yellow, in four different places.
    let mut found = [0; 4];
    for at in 0..80 * 40 {
        let [r, g, b] = frame.rgb(at);
        let quarter = if r > 4.0 * g && r > 4.0 * b {
            0
        } else if g > 4.0 * r && g > 4.0 * b {
            1
        } else if b > 4.0 * r && b > 4.0 * g {
            2
        } else if r > 4.0 * b && g > 4.0 * b {
            3
        } else {
            continue;
        };
        found[quarter] += 1;
    }
    let sum: usize = found.iter().sum();
    assert!(found.iter().all(|n| *n * 8 > sum && *n > 50), "{found:?}");
}

#[test]
fn corners_and_lenses_that_cannot_be_are_named() {
    let folder = temporary_folder();
    photographed(folder.path());
    let refused = |code: i32, arguments: &[&str]| {
        let answer = calibrate(folder.path(), arguments);
        let message = String::from_utf8_lossy(&answer.stderr).into_owned();
        assert_eq!(answer.status.code(), Some(code), "{arguments:?}: {message}");
        message
    };
    let clockwise = json!({ "file": "0.png", "corners": [[20, 20], [70, 20], [70, 50], [20, 50]] });
    let sound = std::fs::read(folder.path().join("corners.json")).unwrap();
    for (entry, words) in [
        (clockwise, "clockwise"),
        (json!({ "file": "0.png", "corners": [[20, 50], [70, 50], [70, 20]] }), "photographs[0].corners is 3 corners"),
        (json!({ "file": "0.png", "corners": [[20, 50], [70, 20], [70, 50], [20, 20]] }), "0.png"),
        (json!({ "file": "0.png", "corners": [[20, 50], [70, 50], [70, 20], [20, 20]], "nearby": [0, 0, 1] }), "nearby"),
    ] {
        write_corners(folder.path(), vec![entry]);
        let message = refused(2, &POSES);
        assert!(message.contains(words), "{message}");
    }
    write_corners(folder.path(), vec![json!({ "file": "nobody.png", "corners": [[20, 50], [70, 50], [70, 20], [20, 20]] })]);
    assert!(refused(3, &POSES).contains("nobody.png"));
    std::fs::write(folder.path().join("corners.json"), sound).unwrap();
    let lens = std::fs::read_to_string(folder.path().join("lens.json")).unwrap();
    std::fs::write(folder.path().join("lens.json"), lens.replace("96", "97")).unwrap();
    assert!(refused(2, &POSES).contains("97x72 expected as of the lens"), "a lens of photographs of another size");
    let nothing = refused(2, &["lens", "0.png", "1.png", "2.png", "--board", "9x6"]);
    assert!(nothing.contains("at least 3 expected") && nothing.contains("0.png: no checkerboard"), "{nothing}");
    assert!(refused(2, &["lens", "0.png", "--board", "9by6"]).contains("COLUMNSxROWS"));
    assert!(!folder.path().join("photographs.json").exists());
    std::fs::write(folder.path().join("lens.json"), lens).unwrap();
    let elsewhere = temporary_folder();
    let out = elsewhere.path().join("photographs.json");
    assert!(refused(2, &[&POSES[..], &["--out", out.to_str().unwrap()]].concat()).contains("where the corners are"));
    let again = [&POSES[..], &["--out", "photographs.json"]].concat();
    assert!(calibrate(folder.path(), &again).status.success());
    assert!(refused(7, &again).contains("--force"));
    assert!(calibrate(folder.path(), &[&again[..], &["--force"]].concat()).status.success());
}

#[test]
fn a_lens_is_found_from_real_photographs_of_a_board() {
    let Some(data) = std::env::var_os("LUMISPHERE_SHARED_DATA").map(|data| Path::new(&data).join("calib")).filter(|p| p.exists()) else {
        assert!(std::env::var_os("REQUIRE_DATA").is_none_or(|v| v != "1"), "no calib in the data pack, and REQUIRE_DATA=1");
        eprintln!("skipped: no calib in the data pack");
        return;
    };
    let folder = temporary_folder();
    let photographs: Vec<String> = ["01", "02", "03", "05"].map(|n| data.join(format!("left{n}.jpg")).to_str().unwrap().to_string()).into();
    let files: Vec<&str> = photographs.iter().map(String::as_str).collect();
    let answer =
        calibrate(folder.path(), &[&["lens"][..], &files, &["--board", "9x6", "--square", "25", "--out", "lens.json", "--json"]].concat());
    let document: Value = serde_json::from_slice(&answer.stdout).unwrap_or_else(|_| panic!("{answer:?}"));
    // All 13 give 533.4 ± .4, and OpenCV 532.9 to 535.9 by the model of distortion.
    let focal = document["lens"]["focal_px"][0].as_f64().unwrap();
    assert!((focal - 533.4).abs() < 6.0 && document["rms_px"].as_f64().unwrap() < 0.3, "{document:#}");
    assert_eq!(document["photographs"][0]["corners_px"].as_array().map(Vec::len), Some(54));
}

#[test]
fn the_papers_tests_write_tables_and_charts_and_refuse_what_is_none() {
    let folder = temporary_folder();
    let out = folder.path().join("fits");
    let evaluate = |more: &[&str]| {
        let command = ["evaluate", "parameter-map", "--out", out.to_str().unwrap(), "--json", "--quiet"];
        Command::new(binary("lumisphere")).args(command).args(more).output().unwrap()
    };
    let unknown = evaluate(&["--sections", "11.3.1,11.4"]);
    assert_eq!(unknown.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("--sections 11.4: 11.3.1, 11.3.2"), "{unknown:?}");
    let answer = evaluate(&["--sections", "11.3.1"]);
    let document: Value = serde_json::from_slice(&answer.stdout).unwrap_or_else(|_| panic!("{answer:?}"));
    assert_eq!(document["plane"].as_array().map(Vec::len), Some(4), "two cases, two methods");
    assert_eq!(document["plane"][0]["thesis_percent"], json!([0.94, 2.34, 2.34]));
    for name in document["files"].as_array().unwrap().iter().chain([&json!("fits.json"), &json!("plane.csv")]) {
        assert!(out.join(name.as_str().unwrap()).exists(), "{name}");
    }
    assert!(std::fs::read_to_string(out.join("11.3.1-area-light.svg")).unwrap().contains("plain phong"));
    assert_eq!(evaluate(&["--sections", "11.3.1"]).status.code(), Some(7), "a folder with files");
    assert!(evaluate(&["--sections", "11.3.1", "--force"]).status.success());
}
