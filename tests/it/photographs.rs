//! Photographs that are not as they should be: refused by name with nothing stored, or fitted and marked.

use std::fs;
use std::path::Path;

use lumisphere::images::{Rgb8, encode_png};
use lumisphere_proto::v1alpha1 as wire;
use serde_json::Value;
use wire::JobState;

use crate::killed::follow_until;
use crate::process::{Server, temporary_folder};

/// A picture of one grey.
fn grey(width: usize, height: usize) -> Vec<u8> {
    encode_png(&Rgb8::filled(width, height, [90; 3])).unwrap()
}

/// Our own list of a 2 × 1 rectangle.
fn own(photographs: &str) -> String {
    format!(r#"{{"format": "lumisphere-photographs/1", "width": 2, "height": 1, "photographs": [{photographs}]}}"#)
}

/// Nerfstudio's, of one frame, its camera at height z above the origin, looking down or up at it.
fn transforms(model: &str, z: f32) -> String {
    let side = z.signum();
    format!(
        r#"{{"camera_model": "{model}", "fl_x": 20, "fl_y": 20, "cx": 10, "cy": 5, "w": 20, "h": 10, "frames": [{{"file_path": "a.png",
        "transform_matrix": [[{side}, 0, 0, 0], [0, 1, 0, 0], [0, 0, {side}, {z}], [0, 0, 0, 1]]}}]}}"#
    )
}

/// Uploads the files as a client of someone else's might, unchecked, and asks for an import; how it ended: error or state, and what was said.
async fn import(server: &Server, folder: &Path, list: (&str, &str), files: &[(&str, Vec<u8>)], size: f32) -> (Option<JobState>, String) {
    let all = [(list.0, list.1.as_bytes().to_vec())].into_iter().chain(files.iter().map(|(name, bytes)| (*name, bytes.clone())));
    let mut uploaded = Vec::new();
    for (name, bytes) in all {
        let path = folder.join(name);
        fs::write(&path, bytes).unwrap();
        let blob = server.json(&["blob", "upload", path.to_str().unwrap(), "--quiet"]);
        uploaded.push(wire::SceneFile { path: name.into(), blake3: blob["blake3"].as_str().unwrap().into() });
    }
    let photographs =
        wire::PhotographSet { list_path: list.0.into(), files: uploaded, width: size, height: size, response: 0, ..Default::default() };
    let observe = wire::ObserveSpec {
        source: Some(wire::observe_spec::Source::Photographs(photographs)),
        dataset: "seen".into(),
        size_texels: 8,
        ..Default::default()
    };
    let spec = wire::JobSpec { spec: Some(wire::job_spec::Spec::Observe(observe)) };
    let request = wire::SubmitJobRequest { spec: Some(spec), request_id: String::new() };
    match server.jobs().await.submit_job(request).await {
        Err(status) => (None, status.message().into()),
        Ok(job) => {
            let ended = follow_until(server, &job.into_inner().name, |_| false).await;
            (Some(ended.state()), ended.error.map(|e| e.message).unwrap_or_default())
        }
    }
}

#[tokio::test]
async fn bad_photographs_are_refused_by_file_and_value_and_nothing_is_stored() {
    let folder = temporary_folder();
    let data = folder.path().join("data");
    let server = Server::start(&data);
    let (a, b) = (("a.png", grey(20, 10)), ("b.png", grey(5, 5)));
    let same = ("b.png", grey(20, 10));
    let pair = own(r#"{"file": "a.png", "camera": [0, 0, 3]}, {"file": "b.png", "camera": [1, 0, 3]}"#);
    let bracketed = |exposures: &str| own(&format!(r#"{{"files": ["a.png", "b.png"], {exposures} "camera": [0, 0, 3]}}"#));
    let none = 0.0;
    // List, its text, the other files, width and height, what the answer names.
    type Case<'a> = (&'a str, String, Vec<(&'a str, Vec<u8>)>, f32, &'a [&'a str]);
    let cases: Vec<Case<'_>> = vec![
        ("list.json", pair.clone(), vec![a.clone(), b.clone()], none, &["b.png", "5x5", "20x10 expected"]),
        ("list.json", pair.clone(), vec![a.clone()], none, &["b.png"]),
        ("list.json", pair.clone(), vec![a.clone(), ("b.png", grey(20, 10)[..60].to_vec())], none, &["b.png"]),
        ("list.json", bracketed(""), vec![a.clone(), same.clone()], none, &["a.png", "ExposureTime", "EXIF"]),
        (
            "list.json",
            bracketed(r#""exposures": [1, 0.5, 0.25],"#),
            vec![a.clone(), same.clone()],
            none,
            &["photographs[0].exposures", "0.25", "2 numbers"],
        ),
        ("list.json", bracketed(r#""exposures": [1, 0],"#), vec![a.clone(), same.clone()], none, &["photographs[0].exposures", "above 0"]),
        (
            "list.json",
            own(r#"{"file": "a.png", "camera": [0, 0, -3]}"#),
            vec![a.clone()],
            none,
            &["photographs[0].camera", "-3", "in front"],
        ),
        ("list.json", own(r#"{"file": "a.png", "light": [0, 1, 0]}"#), vec![a.clone()], none, &["photographs[0].light", "in front"]),
        ("list.json", pair.replace("\"width\": 2", "\"width\": -2"), vec![a.clone(), same.clone()], none, &["width", "-2", "above 0"]),
        (
            "dirs.lp",
            "3\na.png 0 0 1\nb.png 0 0.1 1\n".into(),
            vec![a.clone(), same.clone()],
            none,
            &["dirs.lp", "3 photographs announced, 2 found"],
        ),
        ("dirs.lp", "1\na.png 0 NaN 1\n".into(), vec![a.clone()], none, &["dirs.lp", "line 2", "finite"]),
        ("dirs.lp", "1\na.png 0 0 -1\n".into(), vec![a.clone()], none, &["dirs.lp", "-1"]),
        ("transforms.json", transforms("FISHEYE624", 2.0), vec![a.clone()], 1.0, &["transforms.json", "camera_model", "FISHEYE624"]),
        ("transforms.json", transforms("PINHOLE", -2.0), vec![a.clone()], 1.0, &["a.png", "-2", "in front of the surface"]),
        ("transforms.json", transforms("PINHOLE", 2.0), vec![("a.png", grey(5, 5))], 1.0, &["a.png", "5x5", "20x10 expected"]),
        ("transforms.json", transforms("PINHOLE", 2.0), vec![a.clone()], none, &["photographs.width", "missing"]),
        ("list.txt", "a.png 0 0 1".into(), vec![a.clone()], none, &["list.txt", ".lp", "images.txt"]),
    ];
    for (name, text, files, size, said) in &cases {
        let (state, message) = import(&server, folder.path(), (name, text), files, *size).await;
        assert!(matches!(state, None | Some(JobState::Failed)), "{name} {text}: {state:?}");
        assert!(said.iter().all(|part| message.contains(part)), "{name} {text}: {message:?} does not name {said:?}");
        let listed = server.json(&["dataset", "list"]);
        assert!(listed["datasets"].as_array().unwrap().iter().all(|d| d["latest_version"] == 0), "{name} {text}: {listed:#}");
        assert!(fs::read_dir(data.join("staging")).unwrap().next().is_none(), "{name} {text} leaves something behind");
    }
    // The same, as it should be.
    let (state, message) = import(&server, folder.path(), ("transforms.json", &transforms("PINHOLE", 2.0)), &[a], 1.0).await;
    assert_eq!((state, message), (Some(JobState::Succeeded), String::new()));
}

const WIDTH: usize = 20;
const HEIGHT: usize = 10;

/// A picture of radiance in 0 … 1 and beyond, sRGB codes, saturated where they end.
fn picture(radiance: impl Fn(f32, f32) -> f32) -> Vec<u8> {
    let code = |linear: f32| {
        let linear = linear.clamp(0.0, 1.0);
        let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        (255.0 * encoded + 0.5) as u8
    };
    let centres = (0..WIDTH * HEIGHT).map(|at| ((at % WIDTH) as f32 + 0.5, (at / WIDTH) as f32 + 0.5));
    let pixels = centres.flat_map(|(x, y)| [code(radiance(x, y)); 3]).collect();
    encode_png(&Rgb8::from_bytes(WIDTH, HEIGHT, pixels).unwrap()).unwrap()
}

/// Directions over the hemisphere, three rings of eight.
fn directions() -> Vec<[f32; 3]> {
    let ring = |i: usize| {
        let (ring, turn) = ((i / 8) as f32, (i % 8) as f32 * std::f32::consts::FRAC_PI_4 + 0.3 * (i / 8) as f32);
        let zenith = (10.0 + 25.0 * ring).to_radians();
        [zenith.sin() * turn.cos(), zenith.sin() * turn.sin(), zenith.cos()]
    };
    (0..24).map(ring).collect()
}

fn imported_and_fitted(server: &Server, list: &Path, name: &str, flags: &[&str]) -> Value {
    let seen = format!("{name}-seen");
    let import = ["job", "submit", "import", "--photographs", list.to_str().unwrap(), "--dataset", &seen, "--size-texels", "20"];
    server.json(&[&import[..], &["--watch", "--quiet"]].concat());
    let fit = ["job", "submit", "fit", "--observations", &seen, "--dataset", name, "--watch", "--quiet"];
    server.json(&[&fit[..], flags].concat())["result"]["summary"]["fit"].clone()
}

/// A small parameter map of photographs, of no scene.
pub fn of_photographs(server: &Server, folder: &Path, name: &str) {
    let seen = directions().into_iter().enumerate().map(|(k, [x, y, z])| {
        fs::write(folder.join(format!("{k}.png")), picture(|x, _| 0.04 * x)).unwrap();
        format!(r#"{{"file": "{k}.png", "camera": [{}, {}, {}]}}"#, 20.0 * x, 20.0 * y, 20.0 * z)
    });
    let list = folder.join("photographs.json");
    fs::write(&list, own(&seen.collect::<Vec<_>>().join(", "))).unwrap();
    imported_and_fitted(server, &list, name, &[]);
}

/// The left half is exposed as it should be, the upper right is too bright and the lower right too dark for every exposure.
fn scene_radiance(x: f32, y: f32, exposure: f32) -> f32 {
    match (x < WIDTH as f32 / 2.0, y < HEIGHT as f32 / 2.0) {
        (true, _) => exposure * (0.05 + 0.085 * x + 0.005 * y),
        (false, true) => 50.0,
        (false, false) => 0.0,
    }
}

#[test]
fn where_every_exposure_is_clipped_or_dark_there_is_no_model_and_one_exposure_says_clipped() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let exposures = [1.0, 0.5, 0.25, 0.125];
    let (mut stacks, mut singles) = (Vec::new(), Vec::new());
    for (k, [x, y, z]) in directions().into_iter().enumerate() {
        let names = exposures.map(|e| format!("{k}-{e}.png"));
        for (name, exposure) in names.iter().zip(exposures) {
            fs::write(folder.path().join(name), picture(|x, y| scene_radiance(x, y, exposure))).unwrap();
        }
        let camera = format!("[{}, {}, {}]", 20.0 * x, 20.0 * y, 20.0 * z);
        let files = names.each_ref().map(|n| format!("{n:?}")).join(", ");
        stacks.push(format!(r#"{{"files": [{files}], "exposures": {exposures:?}, "camera": {camera}}}"#));
        singles.push(format!(r#"{{"file": {:?}, "camera": {camera}}}"#, names[0]));
    }
    let written = |name: &str, photographs: &[String]| {
        let path = folder.path().join(name);
        fs::write(&path, own(&photographs.join(", "))).unwrap();
        path
    };
    // 20 × 20 texels: a texel between two rows of pixels of which one shows nothing shows nothing.
    let stacked = imported_and_fitted(&server, &written("stacks.json", &stacks), "stacked", &[]);
    assert_eq!(stacked["texels"], 200, "the left half alone has models: {stacked:#}");
    assert_eq!(stacked["histogram"], serde_json::json!({"constant": 200}), "{stacked:#}");
    let single = imported_and_fitted(&server, &written("singles.json", &singles), "single", &[]);
    let clipped = single["flags"]["clipped"].as_u64().unwrap();
    assert!(
        (100..=110).contains(&clipped) && single["texels"] == 400,
        "the upper right is clipped, and the row of texels that reaches into it: {single:#}"
    );
}

/// A highlight over a grey that waves along x: amplitude .1, a period of 20 pixels.
fn waves(x: f32, [dx, _, dz]: [f32; 3]) -> f32 {
    0.3 + 0.1 * (x * std::f32::consts::TAU / 20.0).sin() + 0.3 * (0.3 * dx + 0.954 * dz).max(0.0).powf(15.0)
}

/// Residuals say so, no flag does: what lies beside itself is noise to a fit that does not know how much noise there should be.
#[test]
fn views_that_lie_beside_each_other_leave_no_more_than_the_slope_allows() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let mut before = 0.0;
    for shift in [0.0f32, 1.0, 2.0, 3.0] {
        let mut list = format!("{}\n", directions().len());
        for (k, d) in directions().into_iter().enumerate() {
            // Every other view is half of it to the left, the rest to the right.
            let off = if k % 2 == 0 { 0.5 * shift } else { -0.5 * shift };
            fs::write(folder.path().join(format!("{shift}-{k}.png")), picture(|x, _| waves(x + off, d))).unwrap();
            list.push_str(&format!("{shift}-{k}.png {} {} {}\n", d[0], d[1], d[2]));
        }
        let path = folder.path().join(format!("{shift}.lp"));
        fs::write(&path, list).unwrap();
        let fit = imported_and_fitted(&server, &path, &format!("map-{shift}"), &["--relative-noise", "0"]);
        let rms = fit["rms_residual"].as_f64().unwrap();
        // A shift by s/2 either way of a wave of slope .1 · τ/20 · cos: its root mean square, and a step of 8-bit codes.
        let slope = 0.1 * std::f64::consts::TAU / 20.0 / 2f64.sqrt();
        let most = 0.5 * f64::from(shift) * slope + 0.004;
        println!("shift {shift}: rms {rms:.5} (at most {most:.5}), {}", fit["flags"]);
        assert!(rms <= most && rms > before, "{shift} px: {rms}, at most {most}, {before} for a pixel less");
        before = rms;
    }
}
