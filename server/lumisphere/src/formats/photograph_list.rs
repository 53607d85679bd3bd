//! Which photographs show a flat surface, and from where: our own list, or that of another program, told by name and content.
//!
//! Ours, `lumisphere-photographs/1`, is JSON: `{"format": "lumisphere-photographs/1", "width": 6.848, "height": 6.848, "photographs": [{"file":
//! "00.png", "camera": [1.0, 0.3, 16.7]}, {"files": ["01-a.jpg", "01-b.jpg"], "exposures": [1, 0.25], "camera": …}, …]}`. The surface is a rectangle in z = 0, its centre at the origin, x right, y up, z toward
//! whoever sees it, any unit of length. A photograph's `camera` is a place and its picture rectified: it shows the rectangle and nothing else;
//! with `light` instead, a direction, the camera stands still and the light moves, as in reflectance transformation imaging; with `pose`
//! instead (`{"position": …, "right": …, "up": …, "backward": …}`, the camera's axes) it is what a camera there with the list's `lens` (`lens.rs`)
//! sees. Several `files` are one picture's exposures, relative to each other; without `exposures` EXIF says them. `saturation` is the value from
//! which on scene-linear pictures (EXR, Radiance HDR) are clipped; without it they are nowhere.
//! Others: RTI's `.lp`, nerfstudio's `transforms.json`, COLMAP's `images.txt` beside its `cameras.txt`; of the last two the surface lies in their z = 0.

use std::collections::HashSet;

use glam::{DMat3, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::known_cameras::{InFile, KnownCamerasError, check_exposures, files, new_name};
use super::lens::LensNumbers;
use super::{colmap, lp, transforms_json};
use crate::geometry::PhotographCamera;

/// Name of our own format.
pub const FORMAT: &str = "lumisphere-photographs/1";

/// Photographs of a rectangle.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotographList {
    /// Of the rectangle, if the list says: along x and y.
    pub size: Option<[f32; 2]>,
    /// From which value on scene-linear pictures are clipped; None: nowhere.
    pub saturation: Option<f32>,
    /// In the list's order.
    pub photographs: Vec<ListedPhotograph>,
}

/// One of them.
#[derive(Debug, Clone, PartialEq)]
pub struct ListedPhotograph {
    /// One, or its exposures; relative to the list.
    pub files: Vec<String>,
    /// As long as `files`; None: as EXIF says, of one file 1.
    pub exposures: Option<Vec<f64>>,
    /// What it shows from where.
    pub view: PhotographView,
}

impl ListedPhotograph {
    /// Of one file.
    pub fn single(file: String, view: PhotographView) -> Self {
        Self { files: vec![file], exposures: None, view }
    }
}

/// What a photograph shows from where.
#[derive(Debug, Clone, PartialEq)]
pub enum PhotographView {
    /// The rectangle and nothing else, seen from this place.
    Rectified {
        /// Of the camera's centre, z above 0.
        from: Vec3,
    },
    /// The rectangle and nothing else, from where all photographs of the list are taken, under this light. By reciprocity as if seen from there.
    Lit {
        /// Unit direction to the light, z above 0.
        toward: Vec3,
    },
    /// What this camera sees.
    Calibrated(PhotographCamera),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnList {
    #[serde(rename = "format")]
    _format: String,
    width: f64,
    height: f64,
    lens: Option<LensNumbers>,
    saturation: Option<f64>,
    photographs: Vec<OwnPhotograph>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnPhotograph {
    file: Option<String>,
    files: Option<Vec<String>>,
    exposures: Option<Vec<f64>>,
    camera: Option<[f64; 3]>,
    light: Option<[f64; 3]>,
    pose: Option<OwnPose>,
}

/// Position and axes of a camera.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnPose {
    position: [f64; 3],
    right: [f64; 3],
    up: [f64; 3],
    backward: [f64; 3],
}

/// Reads a list; `path` is its name, `beside` gives another file's bytes by its path relative to the list.
pub fn read(path: &str, bytes: &[u8], beside: &dyn Fn(&str) -> Option<Vec<u8>>) -> Result<PhotographList, KnownCamerasError> {
    let file = InFile(path);
    let name = path.rsplit('/').next().unwrap_or(path).to_ascii_lowercase();
    let calibrated = |cameras: Vec<PhotographCamera>| {
        let listed = |c: PhotographCamera| ListedPhotograph::single(c.file.clone(), PhotographView::Calibrated(c));
        PhotographList { size: None, saturation: None, photographs: cameras.into_iter().map(listed).collect() }
    };
    if name.ends_with(".lp") {
        let lit = |l: lp::LitPhotograph| ListedPhotograph::single(l.file, PhotographView::Lit { toward: l.toward_light });
        return Ok(PhotographList { size: None, saturation: None, photographs: lp::read(path, bytes)?.into_iter().map(lit).collect() });
    }
    if name == "images.txt" {
        let cameras = beside("cameras.txt").ok_or_else(|| file.missing("the folder", "cameras.txt"))?;
        return colmap::read(("cameras.txt", &cameras), (path, bytes)).map(calibrated);
    }
    if name.ends_with(".json") {
        let text = file.text(bytes)?;
        let is_own = text.contains(FORMAT);
        return if is_own { own(file, text) } else { transforms_json::read(path, bytes).map(calibrated) };
    }
    Err(file.syntax("not a list of photographs: a .lp, a .json, or COLMAP's images.txt expected"))
}

fn own(file: InFile, text: &str) -> Result<PhotographList, KnownCamerasError> {
    let list: OwnList = serde_json::from_str(text).map_err(|e| file.syntax(format!("not {FORMAT}: {e}")))?;
    file.few_enough(list.photographs.len())?;
    for (key, length) in [("width", list.width), ("height", list.height)] {
        if !(length > 0.0 && length.is_finite()) {
            return Err(file.wrong(key, length, "a length above 0"));
        }
    }
    if let Some(value) = list.saturation.filter(|value| !(*value > 0.0 && value.is_finite())) {
        return Err(file.wrong("saturation", value, "a number above 0"));
    }
    let lens = list.lens.map(|lens| lens.checked(file, "lens.")).transpose()?;
    let mut names = HashSet::new();
    let listed = |(i, p): (usize, &OwnPhotograph)| {
        let place = format!("photographs[{i}]");
        let files = files(file, &place, p.file.clone(), p.files.clone())?;
        files.iter().try_for_each(|name| new_name(file, &mut names, &place, name))?;
        check_exposures(file, &place, p.exposures.as_deref(), files.len())?;
        let view = match (p.camera, p.light, &p.pose) {
            (Some(from), None, None) => PhotographView::Rectified { from: in_front(file, &format!("{place}.camera"), from)?.as_vec3() },
            (None, Some(toward), None) => {
                PhotographView::Lit { toward: in_front(file, &format!("{place}.light"), toward)?.normalize().as_vec3() }
            }
            (None, None, Some(pose)) => {
                let lens = lens.ok_or_else(|| file.missing("the list", "lens"))?;
                let position = in_front(file, &format!("{place}.pose.position"), pose.position)?;
                let axes = DMat3::from_cols(pose.right.into(), pose.up.into(), pose.backward.into());
                let place = format!("{place}.pose");
                PhotographView::Calibrated(file.photograph(&place, &files[0], lens, file.pose(&place, axes, position)?)?)
            }
            (None, None, None) => return Err(file.missing(place, "camera, light or pose")),
            _ => return Err(file.wrong(place, "more than one of camera, light and pose", "one of them")),
        };
        Ok(ListedPhotograph { files, exposures: p.exposures.clone(), view })
    };
    let photographs = list.photographs.iter().enumerate().map(listed).collect::<Result<Vec<_>, _>>()?;
    let size = Some([list.width as f32, list.height as f32]);
    Ok(PhotographList { size, saturation: list.saturation.map(|value| value as f32), photographs })
}

/// A picture by a calibrated camera.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedPicture {
    /// One, or its exposures; relative to the list.
    pub files: Vec<String>,
    /// As long as `files`.
    pub exposures: Option<Vec<f64>>,
    /// What took it; all of a list by one lens.
    pub camera: PhotographCamera,
}

/// A list of our own, of a surface of this width and height, with the first camera's lens.
pub fn write(size: [f64; 2], pictures: &[CalibratedPicture]) -> Value {
    let photograph = |CalibratedPicture { files, exposures, camera }: &CalibratedPicture| {
        let pose = camera.camera.pose();
        let axis = |a: Vec3| pose.world_from_camera_vector(a).as_dvec3().to_array();
        let position = pose.position().as_dvec3().to_array();
        let pose = OwnPose { position, right: axis(Vec3::X), up: axis(Vec3::Y), backward: axis(Vec3::Z) };
        let mut entry = match files.as_slice() {
            [file] => json!({ "file": file, "pose": pose }),
            _ => json!({ "files": files, "pose": pose }),
        };
        if let Some(exposures) = exposures {
            entry["exposures"] = json!(exposures);
        }
        entry
    };
    let lens = pictures.first().map(|picture| LensNumbers::of(&picture.camera));
    let photographs: Vec<Value> = pictures.iter().map(photograph).collect();
    json!({ "format": FORMAT, "width": size[0], "height": size[1], "lens": lens, "photographs": photographs })
}

fn in_front(file: InFile, place: &str, at: [f64; 3]) -> Result<DVec3, KnownCamerasError> {
    let at = DVec3::from(at);
    match at.is_finite() && at.z > 0.0 {
        true => Ok(at),
        false => Err(file.wrong(place, format!("{at}"), "three numbers, the last above 0: in front of the surface")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alone(path: &str, text: &str) -> Result<PhotographList, String> {
        read(path, text.as_bytes(), &|_| None).map_err(|e| e.to_string())
    }

    fn own_list(photographs: &str) -> Result<PhotographList, String> {
        let text = format!(r#"{{"format": "lumisphere-photographs/1", "width": 2, "height": 1, "photographs": [{photographs}]}}"#);
        alone("list.json", &text)
    }

    #[test]
    fn our_own_list_places_cameras_or_lights() {
        let list = own_list(r#"{"file": "a.png", "camera": [1, 2, 3]}, {"file": "b.png", "light": [0, 3, 4]}"#).unwrap();
        assert_eq!((list.size, list.saturation), (Some([2.0, 1.0]), None));
        let views: Vec<_> = list.photographs.iter().map(|p| p.view.clone()).collect();
        let expected =
            [PhotographView::Rectified { from: Vec3::new(1.0, 2.0, 3.0) }, PhotographView::Lit { toward: Vec3::new(0.0, 0.6, 0.8) }];
        assert_eq!(views, expected);
    }

    #[test]
    fn a_picture_may_be_several_exposures() {
        let list =
            own_list(r#"{"files": ["a", "b"], "exposures": [1, 0.25], "camera": [0, 0, 1]}, {"files": ["c", "d"], "camera": [0, 0, 1]}"#);
        let photographs = list.unwrap().photographs;
        assert_eq!((photographs[0].files.len(), photographs[0].exposures.clone()), (2, Some(vec![1.0, 0.25])));
        assert_eq!((photographs[1].files.clone(), photographs[1].exposures.clone()), (vec!["c".to_string(), "d".to_string()], None));
    }

    #[test]
    fn scene_linear_pictures_may_be_clipped_from_some_value_on() {
        let list = |value: &str| {
            let photographs = r#"[{"file": "a.exr", "camera": [0, 0, 1]}]"#;
            alone(
                "a.json",
                &format!(r#"{{"format": "{FORMAT}", "width": 2, "height": 1, "saturation": {value}, "photographs": {photographs}}}"#),
            )
        };
        assert_eq!(list("0.9").unwrap().saturation, Some(0.9));
        for wrong in ["0", "-1"] {
            assert!(list(wrong).unwrap_err().contains("saturation is"), "{wrong}");
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let wrong = |photographs: &str| own_list(photographs).unwrap_err();
        assert_eq!(
            wrong(r#"{"file": "a", "camera": [0, 0, -1]}"#),
            "photographs[0].camera is [0, 0, -1], three numbers, the last above 0: in front of the surface expected: list.json"
        );
        assert_eq!(wrong(r#"{"file": "a"}"#), "photographs[0] has no camera, light or pose: list.json");
        assert!(wrong(r#"{"file": "a", "camera": [0, 0, 1], "light": [0, 0, 1]}"#).contains("one of them expected"));
        assert!(wrong(r#"{"file": "a", "camera": [0, 0, 1]}, {"file": "a", "camera": [0, 0, 1]}"#).contains("photographs[1] names"));
        let bracketed = |more: &str| wrong(&format!(r#"{{"files": ["a", "b"], {more} "camera": [0, 0, 1]}}"#));
        assert_eq!(
            bracketed(r#""exposures": [1],"#),
            "photographs[0].exposures is [1.0], 2 numbers above 0, one a file expected: list.json"
        );
        assert!(bracketed(r#""exposures": [1, -1],"#).contains("above 0"));
        assert!(bracketed(r#""file": "c","#).contains("has no file, or files"));
        assert!(wrong("").contains("0 photographs"));
        assert!(wrong(r#"{"file": "a", "camera": [0, 0, 1], "lens": 3}"#).contains("unknown field `lens`"));
        assert!(alone("list.txt", "").unwrap_err().contains("a .lp, a .json, or COLMAP's images.txt expected"));
        assert!(alone("images.txt", "").unwrap_err().contains("cameras.txt"));
    }

    const LENS: &str = r#""lens": {"width_px": 640, "height_px": 480, "focal_px": [500, 500], "center_px": [320, 240]}"#;
    const POSE: &str = r#""pose": {"position": [0, 0, 3], "right": [1, 0, 0], "up": [0, 1, 0], "backward": [0, 0, 1]}"#;

    fn posed(lens: &str, pose: &str) -> Result<PhotographList, String> {
        let text = format!(r#"{{"format": "{FORMAT}", "width": 2, "height": 1, {lens} "photographs": [{{"file": "a.png", {pose}}}]}}"#);
        alone("list.json", &text)
    }

    #[test]
    fn a_calibrated_list_comes_back_as_it_was_written() {
        let list = posed(&format!("{LENS},"), POSE).unwrap();
        let PhotographView::Calibrated(camera) = &list.photographs[0].view else { panic!("{list:?}") };
        // The surface's centre is in the picture's.
        assert_eq!(camera.project(Vec3::ZERO).unwrap().to_array(), [320.0, 240.0]);
        let text =
            write([2.0, 1.0], &[CalibratedPicture { files: vec!["a.png".into()], exposures: None, camera: camera.clone() }]).to_string();
        assert_eq!(alone("list.json", &text).unwrap(), list);
    }

    #[test]
    fn a_pose_needs_a_lens_and_must_be_one_in_front_of_the_surface() {
        assert_eq!(posed("", POSE).unwrap_err(), "the list has no lens: list.json");
        let behind = posed(&format!("{LENS},"), &POSE.replace("[0, 0, 3]", "[0, 0, -3]")).unwrap_err();
        assert!(behind.contains("photographs[0].pose.position is [0, 0, -3]") && behind.contains("in front of the surface"), "{behind}");
        let bent = posed(&format!("{LENS},"), &POSE.replace("[0, 1, 0]", "[0, 2, 0]")).unwrap_err();
        assert!(bent.contains("photographs[0].pose"), "{bent}");
    }

    #[test]
    fn other_programs_lists_are_told_by_their_names() {
        let lit = alone("dirs.lp", "1\na.jpg 0 0.6 0.8\n").unwrap();
        assert_eq!(lit.photographs[0].view, PhotographView::Lit { toward: Vec3::new(0.0, 0.6, 0.8) });
        assert!(alone("transforms.json", "{}").unwrap_err().contains("transforms.json"));
    }
}
