//! nerfstudio's `transforms.json` (also instant-ngp's and that of the Blender scenes): cameras of photographs.
//!
//! `transform_matrix` is `world_from_camera` of a camera with x right, y up, looking along −Z, row by row: ours. The world's axes are the
//! file's (mostly +Z up). Pixel centres lie at half integers. Intrinsics stand at the top or in a frame, which wins. Keys that tell
//! nothing of the camera are passed over.

use std::collections::HashSet;

use glam::{DMat3, DVec2, DVec3};
use serde_json::{Map, Value};

use super::known_cameras::{InFile, KnownCamerasError, Lens, new_name};
use crate::geometry::PhotographCamera;

/// The cameras in the order of `frames`; `file` is for errors. Refused: a camera model other than a pinhole's with k₁ k₂ p₁ p₂, a missing
/// or wrong value, a matrix that is not rigid, a photograph named twice.
pub fn read(file: &str, bytes: &[u8]) -> Result<Vec<PhotographCamera>, KnownCamerasError> {
    let file = InFile(file);
    let root: Value = serde_json::from_str(file.text(bytes)?).map_err(|e| file.syntax(format!("not JSON: {e}")))?;
    let top = root.as_object().ok_or_else(|| file.wrong("the file", &root, "an object {…}"))?;
    let frames = top.get("frames").ok_or_else(|| file.missing("the file", "frames"))?;
    let frames = frames.as_array().ok_or_else(|| file.wrong("frames", frames, "a list […]"))?;
    file.few_enough(frames.len())?;
    let mut names = HashSet::new();
    let mut photographs = Vec::with_capacity(frames.len());
    for (i, frame) in frames.iter().enumerate() {
        let place = format!("frames[{i}]");
        let frame = frame.as_object().ok_or_else(|| file.wrong(&place, frame, "an object {…}"))?;
        let fields = Fields { file, place: &place, frame, top };
        let photograph = fields.photograph()?;
        new_name(file, &mut names, &place, &photograph.file)?;
        photographs.push(photograph);
    }
    Ok(photographs)
}

// Values of a frame, or where it has none, those of the file.
struct Fields<'a> {
    file: InFile<'a>,
    place: &'a str,
    frame: &'a Map<String, Value>,
    top: &'a Map<String, Value>,
}

impl Fields<'_> {
    fn photograph(&self) -> Result<PhotographCamera, KnownCamerasError> {
        let name = self.frame.get("file_path").ok_or_else(|| self.missing("file_path"))?;
        let expected = "the photograph's path";
        let name = name.as_str().filter(|n| !n.is_empty()).ok_or_else(|| self.file.wrong(self.below("file_path"), name, expected))?;
        self.check_model()?;
        let (axes, position) = self.matrix()?;
        let place = self.below("transform_matrix");
        self.file.photograph(self.place, name, self.lens()?, self.file.pose(&place, axes, position)?)
    }

    fn lens(&self) -> Result<Lens, KnownCamerasError> {
        let side = |key: &'static str| self.file.side_px(self.where_is(key), self.required(key)?);
        let size_px = [side("w")?, side("h")?];
        let [width, height] = size_px.map(f64::from);
        let coefficient = |key: &'static str| Ok(self.number(key)?.unwrap_or(0.0));
        let coefficients = [coefficient("k1")?, coefficient("k2")?, coefficient("p1")?, coefficient("p2")?];
        for key in ["k3", "k4", "k5", "k6"] {
            if coefficient(key)? != 0.0 {
                return Err(self.file.wrong(self.where_is(key), coefficient(key)?, "0 (distortion is k1 k2 p1 p2 here)"));
            }
        }
        let focal_px = self.focal_px(width, height)?;
        // Files that give an angle of view leave the principal point out and mean the middle.
        let center = |key: &'static str, middle: f64| match self.number(key)? {
            Some(center) => Ok(center),
            None if self.value("fl_x").is_none() => Ok(middle),
            None => Err(self.missing(key)),
        };
        Ok(Lens { size_px, focal_px, center_px: DVec2::new(center("cx", 0.5 * width)?, center("cy", 0.5 * height)?), coefficients })
    }

    // fl_x and fl_y, or the full angles of view camera_angle_x and camera_angle_y in radians; pixels are square where y is left out.
    fn focal_px(&self, width: f64, height: f64) -> Result<DVec2, KnownCamerasError> {
        let along = |length: &'static str, angle: &'static str, side: f64| match (self.number(length)?, self.number(angle)?) {
            (Some(focal), _) if focal > 0.0 => Ok(Some(focal)),
            (Some(focal), _) => Err(self.file.wrong(self.where_is(length), focal, "a number above 0")),
            (None, Some(view)) if view > 0.0 && view < std::f64::consts::PI => Ok(Some(0.5 * side / (0.5 * view).tan())),
            (None, Some(view)) => Err(self.file.wrong(self.where_is(angle), view, "an angle between 0 and π radians")),
            (None, None) => Ok(None),
        };
        let x = along("fl_x", "camera_angle_x", width)?.ok_or_else(|| self.missing("fl_x (or camera_angle_x)"))?;
        Ok(DVec2::new(x, along("fl_y", "camera_angle_y", height)?.unwrap_or(x)))
    }

    fn check_model(&self) -> Result<(), KnownCamerasError> {
        const KNOWN: [&str; 5] = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"];
        if let Some(fisheye) = self.value("is_fisheye").filter(|&v| *v != Value::Bool(false)) {
            return Err(self.file.wrong(self.where_is("is_fisheye"), fisheye, "false"));
        }
        match self.value("camera_model") {
            None => Ok(()),
            Some(Value::String(model)) if KNOWN.contains(&model.as_str()) => Ok(()),
            Some(other) => Err(self.file.wrong(self.where_is("camera_model"), other, format!("one of {}", KNOWN.join(", ")))),
        }
    }

    // The camera's axes in the world as columns, and its position.
    fn matrix(&self) -> Result<(DMat3, DVec3), KnownCamerasError> {
        let value = self.frame.get("transform_matrix").ok_or_else(|| self.missing("transform_matrix"))?;
        let place = self.below("transform_matrix");
        let wrong = || self.file.wrong(&place, value, "3 or 4 rows of 4 finite numbers, the fourth [0, 0, 0, 1]");
        let row =
            |row: &Value| -> Option<[f64; 4]> { row.as_array()?.iter().map(Value::as_f64).collect::<Option<Vec<_>>>()?.try_into().ok() };
        let rows: Option<Vec<[f64; 4]>> = value.as_array().and_then(|rows| rows.iter().map(row).collect());
        match rows.as_deref() {
            Some(&[x, y, z] | &[x, y, z, [0.0, 0.0, 0.0, 1.0]]) => {
                let axis = |i: usize| DVec3::new(x[i], y[i], z[i]);
                Ok((DMat3::from_cols(axis(0), axis(1), axis(2)), axis(3)))
            }
            _ => Err(wrong()),
        }
    }

    fn required(&self, key: &'static str) -> Result<f64, KnownCamerasError> {
        self.number(key)?.ok_or_else(|| self.missing(key))
    }

    fn number(&self, key: &str) -> Result<Option<f64>, KnownCamerasError> {
        match self.value(key) {
            None => Ok(None),
            Some(value) => match value.as_f64().filter(|n| (*n as f32).is_finite()) {
                Some(number) => Ok(Some(number)),
                None => Err(self.file.wrong(self.where_is(key), value, "a finite number")),
            },
        }
    }

    fn value(&self, key: &str) -> Option<&Value> {
        self.frame.get(key).or_else(|| self.top.get(key)).filter(|v| !v.is_null())
    }

    // `frames[3].fl_x`, or `fl_x` where the frame has none.
    fn where_is(&self, key: &str) -> String {
        if self.frame.contains_key(key) { self.below(key) } else { key.to_owned() }
    }

    fn below(&self, key: &str) -> String {
        format!("{}.{key}", self.place)
    }

    fn missing(&self, key: &'static str) -> KnownCamerasError {
        self.file.missing(self.place, key)
    }
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};

    use super::*;

    const FILE: &str = r#"{"camera_model": "OPENCV", "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240, "w": 640, "h": 480, "k1": -0.2, "k2": 0.05,
        "p1": 0.001, "p2": -0.002, "aabb_scale": 16, "frames": [
        {"file_path": "images/a.jpg", "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]},
        {"file_path": "images/b.jpg", "fl_x": 600, "transform_matrix": [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 0]]}]}"#;

    fn wrong(from: &str, to: &str) -> String {
        assert!(FILE.contains(from), "{from:?} is not there");
        read("t.json", FILE.replacen(from, to, 1).as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn a_frame_looks_along_minus_z_and_its_own_intrinsics_win() {
        let cameras = read("", FILE.as_bytes()).unwrap();
        assert_eq!(cameras[0].file, "images/a.jpg");
        assert_eq!(cameras[0].camera.pose().position(), Vec3::new(1.0, 2.0, 3.0));
        assert_eq!(cameras[0].project(Vec3::new(1.0, 2.0, 0.0)), Some(Vec2::new(320.0, 240.0)));
        assert_eq!(cameras[0].distortion.coefficients(), [-0.2, 0.05, 0.001, -0.002]);
        assert_eq!(cameras[1].camera.intrinsics().focal_px, Vec2::new(600.0, 510.0));
        // The second camera's z axis is world +X, so it looks along −X from x = 5.
        assert_eq!(cameras[1].project(Vec3::ZERO), Some(Vec2::new(320.0, 240.0)));
    }

    #[test]
    fn an_angle_of_view_stands_for_focal_length_and_principal_point() {
        let blender = r#"{"camera_angle_x": 1.5707963267948966, "w": 800, "h": 600, "frames": [
            {"file_path": "a", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}"#;
        let intrinsics = *read("", blender.as_bytes()).unwrap()[0].camera.intrinsics();
        assert_eq!(intrinsics.center_px, Vec2::new(400.0, 300.0));
        // tan 45° is one rounding below 1.
        assert!((intrinsics.focal_px - 400.0).length() < 1e-3);
    }

    #[test]
    fn what_is_wrong_is_named_with_file_frame_field_and_value() {
        let models = "one of OPENCV, PINHOLE, SIMPLE_PINHOLE, RADIAL, SIMPLE_RADIAL expected: t.json";
        assert_eq!(wrong(r#""OPENCV""#, r#""OPENCV_FISHEYE""#), format!(r#"camera_model is "OPENCV_FISHEYE", {models}"#));
        assert_eq!(wrong(r#""fl_x": 600"#, r#""camera_model": 3"#), format!("frames[1].camera_model is 3, {models}"));
        assert_eq!(wrong(r#""aabb_scale": 16"#, r#""is_fisheye": true"#), "is_fisheye is true, false expected: t.json");
        assert_eq!(wrong(r#""cx": 320, "#, ""), "frames[0] has no cx: t.json");
        assert_eq!(wrong(r#""fl_x": 500, "#, ""), "frames[0] has no fl_x (or camera_angle_x): t.json");
        assert_eq!(wrong("600", "-600"), "frames[1].fl_x is -600, a number above 0 expected: t.json");
        assert_eq!(wrong("600", "1e300"), "frames[1].fl_x is 1e+300, a finite number expected: t.json");
        assert_eq!(wrong(r#""h": 480"#, r#""h": 480.5"#), "h is 480.5, a whole number from 1 to 131072 expected: t.json");
        assert_eq!(wrong(r#""aabb_scale": 16"#, r#""k3": 0.1"#), "k3 is 0.1, 0 (distortion is k1 k2 p1 p2 here) expected: t.json");
        assert_eq!(wrong("b.jpg", "a.jpg"), r#"frames[1] names "images/a.jpg" again: t.json"#);
        assert_eq!(wrong(r#""file_path": "images/b.jpg", "#, ""), "frames[1] has no file_path: t.json");
        assert_eq!(wrong(r#""frames""#, r#""images""#), "the file has no frames: t.json");
        let matrix = "3 or 4 rows of 4 finite numbers, the fourth [0, 0, 0, 1] expected: t.json";
        assert_eq!(wrong("[0, 0, 0, 1]", "[0, 0, 0, 2]").split(", 3 or").nth(1), matrix.strip_prefix("3 or"));
        assert!(wrong("[0, 0, 1, 5]", "[0, 0, 5]").starts_with("frames[1].transform_matrix is [[0,0,5],"));
        assert!(wrong("[0, 0, 1, 3]", "[0, 0, 1.1, 3]").starts_with("frames[0].transform_matrix: pose is not rigid"));
        assert!(wrong("[0, 0, 1, 3]", "[0, 0, -1, 3]").starts_with("frames[0].transform_matrix: pose is not rigid"));
        assert!(wrong("[0, 0, 1, 3]", "[0, 0, 1, NaN]").starts_with("not JSON: expected value at line 3"));
    }

    #[test]
    fn cut_off_anywhere_it_never_panics() {
        for length in 0..FILE.len() {
            assert!(read("", &FILE.as_bytes()[..length]).is_err());
        }
    }
}
