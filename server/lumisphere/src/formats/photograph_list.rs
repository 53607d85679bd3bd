//! Which photographs show a flat surface, and from where: our own list, or that of another program, told by name and content.
//!
//! Ours, `lumisphere-photographs/1`, is JSON: `{"format": "lumisphere-photographs/1", "width": 6.848, "height": 6.848, "photographs": [{"file":
//! "00.png", "camera": [1.0, 0.3, 16.7]}, {"files": ["01-a.jpg", "01-b.jpg"], "exposures": [1, 0.25], "camera": …}, …]}`. The surface is a rectangle in z = 0, its centre at the origin, x right, y up, z toward
//! whoever sees it, any unit of length. A photograph's `camera` is a place and its picture rectified: it shows the rectangle and nothing else;
//! with `light` instead, a direction, the camera stands still and the light moves, as in reflectance transformation imaging. Several `files` are
//! one picture's exposures, relative to each other; without `exposures` EXIF says them.
//! Others: RTI's `.lp`, nerfstudio's `transforms.json`, COLMAP's `images.txt` beside its `cameras.txt`; of the last two the surface lies in their z = 0.

use std::collections::HashSet;

use glam::{DVec3, Vec3};
use serde::Deserialize;

use super::known_cameras::{InFile, KnownCamerasError, new_name};
use super::{colmap, lp, transforms_json};
use crate::geometry::PhotographCamera;

/// Name of our own format.
pub const FORMAT: &str = "lumisphere-photographs/1";

/// Photographs of a rectangle.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotographList {
    /// Of the rectangle, if the list says: along x and y.
    pub size: Option<[f32; 2]>,
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
}

/// Reads a list; `path` is its name, `beside` gives another file's bytes by its path relative to the list.
pub fn read(path: &str, bytes: &[u8], beside: &dyn Fn(&str) -> Option<Vec<u8>>) -> Result<PhotographList, KnownCamerasError> {
    let file = InFile(path);
    let name = path.rsplit('/').next().unwrap_or(path).to_ascii_lowercase();
    let calibrated = |cameras: Vec<PhotographCamera>| {
        let listed = |c: PhotographCamera| ListedPhotograph::single(c.file.clone(), PhotographView::Calibrated(c));
        PhotographList { size: None, photographs: cameras.into_iter().map(listed).collect() }
    };
    if name.ends_with(".lp") {
        let lit = |l: lp::LitPhotograph| ListedPhotograph::single(l.file, PhotographView::Lit { toward: l.toward_light });
        return Ok(PhotographList { size: None, photographs: lp::read(path, bytes)?.into_iter().map(lit).collect() });
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
    let mut names = HashSet::new();
    let listed = |(i, p): (usize, &OwnPhotograph)| {
        let place = format!("photographs[{i}]");
        let files = match (&p.file, &p.files) {
            (Some(one), None) => vec![one.clone()],
            (None, Some(several)) if !several.is_empty() => several.clone(),
            _ => return Err(file.missing(place, "file, or files")),
        };
        files.iter().try_for_each(|name| new_name(file, &mut names, &place, name))?;
        if let Some(exposures) = &p.exposures {
            let is_sound = exposures.len() == files.len() && exposures.iter().all(|e| *e > 0.0 && e.is_finite());
            if !is_sound {
                let expected = format!("{} numbers above 0, one a file", files.len());
                return Err(file.wrong(format!("{place}.exposures"), format!("{exposures:?}"), expected));
            }
        }
        let view = match (p.camera, p.light) {
            (Some(from), None) => PhotographView::Rectified { from: in_front(file, &format!("{place}.camera"), from)?.as_vec3() },
            (None, Some(toward)) => {
                PhotographView::Lit { toward: in_front(file, &format!("{place}.light"), toward)?.normalize().as_vec3() }
            }
            (None, None) => return Err(file.missing(place, "camera or light")),
            (Some(_), Some(_)) => return Err(file.wrong(place, "both camera and light", "one of them")),
        };
        Ok(ListedPhotograph { files, exposures: p.exposures.clone(), view })
    };
    let photographs = list.photographs.iter().enumerate().map(listed).collect::<Result<Vec<_>, _>>()?;
    Ok(PhotographList { size: Some([list.width as f32, list.height as f32]), photographs })
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
        assert_eq!(list.size, Some([2.0, 1.0]));
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
    fn what_is_wrong_is_named() {
        let wrong = |photographs: &str| own_list(photographs).unwrap_err();
        assert_eq!(
            wrong(r#"{"file": "a", "camera": [0, 0, -1]}"#),
            "photographs[0].camera is [0, 0, -1], three numbers, the last above 0: in front of the surface expected: list.json"
        );
        assert_eq!(wrong(r#"{"file": "a"}"#), "photographs[0] has no camera or light: list.json");
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

    #[test]
    fn other_programs_lists_are_told_by_their_names() {
        let lit = alone("dirs.lp", "1\na.jpg 0 0.6 0.8\n").unwrap();
        assert_eq!(lit.photographs[0].view, PhotographView::Lit { toward: Vec3::new(0.0, 0.6, 0.8) });
        assert!(alone("transforms.json", "{}").unwrap_err().contains("transforms.json"));
    }
}
