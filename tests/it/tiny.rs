//! The smallest scene that has everything: a UV-mapped box over a floor under a grey sky, written as files, captured in a moment.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use crate::process::Server;

/// Dataset name that `capture` uses.
pub const DATASET: &str = "box";

/// Corners of the unit square, counter-clockwise.
const SQUARE: [(f32, f32); 4] = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];

/// Each face as (centre, first tangent, second tangent); first × second points outward.
const FACES: [([f32; 3], [f32; 3], [f32; 3]); 6] = [
    ([1., 0., 0.], [0., 1., 0.], [0., 0., 1.]),
    ([-1., 0., 0.], [0., 0., 1.], [0., 1., 0.]),
    ([0., 1., 0.], [0., 0., 1.], [1., 0., 0.]),
    ([0., -1., 0.], [1., 0., 0.], [0., 0., 1.]),
    ([0., 0., 1.], [1., 0., 0.], [0., 1., 0.]),
    ([0., 0., -1.], [0., 1., 0.], [1., 0., 0.]),
];

/// A box of half-width 0.5 around (0, 1, 0): a face to a cell of a 3 × 2 grid of uv.
fn box_obj() -> String {
    let mut text = String::new();
    for (f, (n, s, t)) in FACES.iter().enumerate() {
        for (u, v) in SQUARE {
            let at = |k: usize| 0.5 * (n[k] + (2.0 * u - 1.0) * s[k] + (2.0 * v - 1.0) * t[k]) + if k == 1 { 1.0 } else { 0.0 };
            let cell = ((f % 3) as f32 / 3.0, (f / 3) as f32 / 2.0);
            writeln!(text, "v {} {} {}\nvt {} {}", at(0), at(1), at(2), cell.0 + u / 3.0, cell.1 + v / 2.0).unwrap();
        }
        writeln!(text, "vn {} {} {}", n[0], n[1], n[2]).unwrap();
    }
    for f in 0..6 {
        let corner = |k: usize| format!("{i}/{i}/{}", f + 1, i = 4 * f + k + 1);
        writeln!(text, "f {} {} {} {}", corner(0), corner(1), corner(2), corner(3)).unwrap();
    }
    text
}

const FLOOR_OBJ: &str = "v -3 0 -3\nv -3 0 3\nv 3 0 3\nv 3 0 -3\nvt 0 0\nvt 0 1\nvt 1 1\nvt 1 0\nvn 0 1 0\nf 1/1/1 2/2/1 3/3/1 4/4/1\n";

const SCENE: &str = r#"{
  "format": "neutral-scene/1", "name": "tiny", "up": "+Y", "handedness": "right",
  "materials": {"red": {"type": "diffuse", "albedo": [0.7, 0.2, 0.1]}, "grey": {"type": "diffuse", "albedo": [0.4, 0.5, 0.4]}},
  "objects": [{"name": "box", "mesh": "meshes/box.obj", "material": "red"}, {"name": "floor", "mesh": "meshes/floor.obj", "material": "grey"}],
  "environment": {"radiance": [0.8, 0.9, 1.0]},
  "cameras": [
    {"name": "front", "origin": [0, 1.6, 3], "target": [0, 1, 0], "up": [0, 1, 0], "vfov_deg": 40, "width": 48, "height": 32},
    {"name": "side", "origin": [2.5, 1.8, 1.5], "target": [0, 1, 0], "up": [0, 1, 0], "vfov_deg": 40, "width": 48, "height": 32}
  ]
}"#;

/// Writes the scene's files below `folder` and returns the scene file.
pub fn write_scene(folder: &Path) -> PathBuf {
    fs::create_dir_all(folder.join("meshes")).unwrap();
    fs::write(folder.join("meshes/box.obj"), box_obj()).unwrap();
    fs::write(folder.join("meshes/floor.obj"), FLOOR_OBJ).unwrap();
    let path = folder.join("scene.json");
    fs::write(&path, SCENE).unwrap();
    path
}

/// Flags of a capture that takes a moment: 24 points, four a face, far enough off that each sees its quarter; 16² faces, one path a texel.
pub const QUICK: [&str; 14] = [
    "--points",
    "24",
    "--epsilon",
    "0.3",
    "--face-size-texels",
    "16",
    "--samples-per-texel",
    "1",
    "--max-bounces",
    "1",
    "--sample-map-size-texels",
    "16",
    "--pixel-format",
    "f32",
];

/// Captures the box into `DATASET` and waits for it.
pub fn capture(server: &Server, folder: &Path) -> serde_json::Value {
    capture_with(server, folder, DATASET, &QUICK)
}

/// The same into any dataset with any flags.
pub fn capture_with(server: &Server, folder: &Path, dataset: &str, flags: &[&str]) -> serde_json::Value {
    let scene = write_scene(&folder.join("scene"));
    let base =
        ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", dataset, "--watch", "--quiet"];
    server.json(&[&base, flags].concat())
}
