//! A sweep through the real binaries: captured once, measured, drawn, chosen from.

use std::fs;
use std::path::Path;

use lumisphere::images::{ReadLimits, decode_png_codes};
use serde_json::Value;

use crate::process::{Server, temporary_folder};
use crate::tiny;

/// Two face sizes and three blends; flags of `tiny::QUICK` otherwise.
fn write_sweep(folder: &Path, more: &str) -> String {
    tiny::write_scene(&folder.join("scene"));
    let text = format!(
        "timed_frames_per_view = 2
        [capture]\nscene = \"scene/scene.json\"\nobject = \"box\"\npoints = 24\nepsilon = 0.3\nface_size_texels = [16, 32]
        samples_per_texel = 1\nmax_bounces = 1\nsample_map_size_texels = 16\npixel_format = \"f32\"
        [settings]\nblends = [\"distance\", \"average\", \"environment-map\"]
        [views]\nframes = 2\nsize = \"40x30\"\n[truth]\nsamples_per_pixel = 4\n{more}"
    );
    let path = folder.join("sweep.toml");
    fs::write(&path, text).unwrap();
    path.display().to_string()
}

fn jobs(server: &Server, kind: &str) -> usize {
    server.json(&["job", "list"])["jobs"].as_array().unwrap().iter().filter(|j| j["kind"] == kind).count()
}

fn exit_code(server: &Server, arguments: &[&str]) -> (Option<i32>, String) {
    let output = server.lumisphere(arguments);
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn a_sweep_captures_once_measures_draws_and_is_chosen_from() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let file = write_sweep(folder.path(), "");
    let out = folder.path().join("out");
    let arguments = ["evaluate", "sweep", &file, "--out", out.to_str().unwrap(), "--quiet"];
    let document = server.json(&arguments);
    let rows = document["sweep"]["rows"].as_array().unwrap();
    assert_eq!((rows.len(), jobs(&server, "capture"), jobs(&server, "evaluate")), (6, 2, 2), "{document:#}");

    let written: Value = serde_json::from_slice(&fs::read(out.join("sweep.json")).unwrap()).unwrap();
    assert_eq!(written, document["sweep"]);
    let csv = fs::read_to_string(out.join("sweep.csv")).unwrap();
    assert_eq!(csv.lines().count(), 7, "{csv}");
    assert!(csv.lines().next().unwrap().contains("millis_per_frame_p95"), "{csv}");
    let chart = fs::read_to_string(out.join("chart.svg")).unwrap();
    assert!(chart.starts_with("<svg") && chart.contains("environment_map") && chart.trim_end().ends_with("</svg>"));
    assert!(decode_png_codes(&fs::read(out.join("chart.png")).unwrap(), ReadLimits::SCENE).unwrap().width > 500);
    let report = fs::read_to_string(out.join("report.html")).unwrap();
    let pictures: Vec<&str> = report.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    // A truth, and a frame and an error a row.
    assert_eq!(pictures.len(), 1 + 2 * 6);
    for picture in pictures {
        let image = decode_png_codes(&fs::read(out.join(picture)).unwrap_or_else(|e| panic!("{picture}: {e}")), ReadLimits::SCENE).unwrap();
        assert_eq!((image.width, image.height), (40, 30));
    }
    for row in rows {
        let (median, p95) = (row["millis_per_frame"].as_f64().unwrap(), row["millis_per_frame_p95"].as_f64().unwrap());
        assert!(median > 0.0 && median <= p95 && row["timed_frames"] == 4, "{row:#}");
        let faces: u64 = row["variant"]["face"].as_str().unwrap().parse().unwrap();
        assert_eq!(row["parameters"]["face_size_texels"], faces);
        // At least a cube map's texels, three channels and a distance as f32, hardly compressible.
        assert!(row["dataset_bytes"].as_u64().unwrap() > 6 * faces * faces * 8, "{row:#}");
    }

    chosen_as_the_rows_say(&server, rows, &out);
    rendered_as_chosen(&server, rows, &out);

    // Again: nothing is captured or measured, and files are kept unless forced.
    let captures = jobs(&server, "capture");
    assert_eq!(exit_code(&server, &arguments).0, Some(7));
    let again = server.json(&[&arguments[..], &["--force"]].concat());
    assert_eq!((jobs(&server, "capture"), jobs(&server, "evaluate")), (captures, 2));
    assert_eq!(again["sweep"], document["sweep"]);
    server.json(&[&arguments[..], &["--force", "--anew"]].concat());
    assert_eq!((jobs(&server, "capture"), jobs(&server, "evaluate")), (captures, 4));
}

fn chosen_as_the_rows_say(server: &Server, rows: &[Value], out: &Path) {
    let sweep = out.join("sweep.json").display().to_string();
    let choose = |bounds: &[&str]| server.json(&[&["evaluate", "choose", &sweep], bounds].concat());
    let figure = |row: &Value, key: &str| row[key].as_f64().unwrap();
    let error = |row: &Value| figure(row, "delta_e_2000_mean");
    let millis = |row: &Value| figure(row, "millis_per_frame");
    let least = |rows: &mut dyn Iterator<Item = &Value>, key: &dyn Fn(&Value) -> f64| rows.map(key).fold(f64::INFINITY, f64::min);

    // Between the least and the greatest error: some rows keep it, some do not.
    let mut errors: Vec<f64> = rows.iter().map(error).collect();
    errors.sort_by(f64::total_cmp);
    let bound = errors[2];
    let fastest = choose(&["--max-error", &bound.to_string()]);
    assert!(error(&fastest["row"]) <= bound);
    assert_eq!(millis(&fastest["row"]), least(&mut rows.iter().filter(|r| error(r) <= bound), &millis));
    let best = choose(&["--max-millis", "100000"]);
    assert_eq!(error(&best["row"]), errors[0]);
    // Only the smaller faces fit.
    let small = rows.iter().map(|r| r["dataset_bytes"].as_u64().unwrap()).min().unwrap();
    let fits = choose(&["--max-bytes", &small.to_string()]);
    assert_eq!(fits["row"]["variant"]["face"], "16");

    let (code, told) = exit_code(server, &["evaluate", "choose", &sweep, "--max-error", "0.000001"]);
    assert!(code == Some(7) && told.contains("nearest is") && told.contains("above 0.000001"), "{code:?} {told}");
    assert_eq!(exit_code(server, &["evaluate", "choose", &sweep]).0, Some(2));
    assert_eq!(exit_code(server, &["evaluate", "choose", &format!("{sweep}.gone"), "--max-error", "1"]).0, Some(3));
}

fn rendered_as_chosen(server: &Server, rows: &[Value], out: &Path) {
    let (sweep, frames) = (out.join("sweep.json").display().to_string(), out.join("frames").display().to_string());
    let small = rows.iter().map(|r| r["dataset_bytes"].as_u64().unwrap()).min().unwrap().to_string();
    let bounds = ["--choose", &sweep, "--max-bytes", &small];
    let view = ["--frames", "1", "--size", "40x30", "--out", &frames, "--quiet"];
    server.succeed(&[&["render"], &bounds[..], &view].concat());
    // The same as saying it all.
    let chosen = &server.json(&["evaluate", "choose", &sweep, "--max-bytes", &small])["row"];
    let (dataset, blend) = (chosen["dataset"].as_str().unwrap(), chosen["blend"].as_str().unwrap().replace('_', "-"));
    let said = out.join("said").display().to_string();
    let all =
        ["render", "--dataset", dataset, "--component", "mirror", "--blend", &blend, "--frames", "1", "--size", "40x30", "--out", &said];
    server.succeed(&all);
    let frame = |folder: &str| fs::read(Path::new(folder).join("frame-00000.png")).unwrap();
    assert_eq!(frame(&frames), frame(&said));
    // Twice said is once too often.
    assert_eq!(exit_code(server, &[&["render", "--blend", "angle"], &bounds[..], &view].concat()).0, Some(2));

    let scene = out.parent().unwrap().join("scene/scene.json").display().to_string();
    let rest =
        ["--epsilon", "0.3", "--samples-per-texel", "1", "--max-bounces", "1", "--sample-map-size-texels", "16", "--watch", "--quiet"];
    let capture = ["job", "submit", "capture", "--scene", &scene, "--object", "box", "--dataset", "chosen"];
    server.succeed(&[&capture[..], &bounds, &rest].concat());
    let parameters = &server.json(&["dataset", "get", "chosen"])["versions"][0]["parameters"];
    assert_eq!(
        (&parameters["face_size_texels"], &parameters["spacing"]),
        (&chosen["parameters"]["face_size_texels"], &chosen["parameters"]["spacing"])
    );
    server.succeed(&["dataset", "delete", "chosen"]);
}

#[test]
fn a_sweep_that_cannot_be_meant_is_refused_before_anything_is_captured() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let refused = |more: &str| {
        let file = write_sweep(folder.path(), more);
        let (code, told) = exit_code(&server, &["evaluate", "sweep", &file, "--quiet"]);
        assert_eq!(code, Some(2), "{told}");
        told
    };
    assert!(refused("[render]\nx = 1").contains("render is no key here"));
    assert!(refused("bounces = 3").contains("truth.bounces is no key here"));
    let many = write_sweep(folder.path(), "");
    fs::write(&many, fs::read_to_string(&many).unwrap().replace("frames = 2", "frames = 100000")).unwrap();
    let (code, told) = exit_code(&server, &["evaluate", "sweep", &many, "--quiet"]);
    assert!(code == Some(2) && told.contains("100000 views"), "{told}");
    let named = write_sweep(folder.path(), "");
    fs::write(&named, format!("datasets = \"nothing\"\n{}", fs::read_to_string(&named).unwrap())).unwrap();
    assert_eq!(exit_code(&server, &["evaluate", "sweep", &named, "--quiet"]).0, Some(3));
    assert_eq!(jobs(&server, "capture"), 0);
}
