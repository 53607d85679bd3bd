//! `lumisphere-corners/1`: photographs of a rectangle in which its four corners are marked, as JSON, for `lumisphere calibrate poses`.
//!
//! `{"format": "lumisphere-corners/1", "photographs": [{"file": "a.jpg", "corners": [[102.5, 400], [530, 410.5], [512, 80], [118, 77]]}, …]}`.
//! Corners in pixels (centres at half integers, y down): lower left, lower right, upper right, upper left of the surface. Several `files`
//! with `exposures` are one picture, as in a list of photographs; `near`, `[x, y, z]`, is about where its camera stood, in the list's space.

use std::collections::HashSet;

use glam::{DVec2, DVec3};
use serde::Deserialize;

use super::known_cameras::{InFile, KnownCamerasError, check_exposures, files, new_name};

/// Name of the format.
pub const FORMAT: &str = "lumisphere-corners/1";

/// A picture with its corners.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkedPicture {
    /// One, or its exposures; relative to the list.
    pub files: Vec<String>,
    /// As long as `files`.
    pub exposures: Option<Vec<f64>>,
    /// Counter-clockwise from the lower left.
    pub corners_px: [DVec2; 4],
    /// Where the camera stood; origin at the surface's centre.
    pub near: Option<DVec3>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CornersFile {
    format: String,
    photographs: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    file: Option<String>,
    files: Option<Vec<String>>,
    exposures: Option<Vec<f64>>,
    corners: Option<Vec<[f64; 2]>>,
    near: Option<[f64; 3]>,
}

/// Reads the marks; `path` is the file's name, for errors. Whether the corners are those of a rectangle is for the calibration to say.
pub fn read(path: &str, bytes: &[u8]) -> Result<Vec<MarkedPicture>, KnownCamerasError> {
    let file = InFile(path);
    let marks: CornersFile = serde_json::from_str(file.text(bytes)?).map_err(|e| file.syntax(format!("not {FORMAT}: {e}")))?;
    if marks.format != FORMAT {
        return Err(file.wrong("format", format!("{:?}", marks.format), format!("{FORMAT:?}")));
    }
    file.few_enough(marks.photographs.len())?;
    let mut names = HashSet::new();
    let marked = |(i, entry): (usize, Entry)| {
        let place = format!("photographs[{i}]");
        let files = files(file, &place, entry.file, entry.files)?;
        files.iter().try_for_each(|name| new_name(file, &mut names, &place, name))?;
        check_exposures(file, &place, entry.exposures.as_deref(), files.len())?;
        let corners = entry.corners.ok_or_else(|| file.missing(&place, "corners"))?;
        let Ok(corners) = <[[f64; 2]; 4]>::try_from(corners.as_slice()) else {
            return Err(file.wrong(format!("{place}.corners"), format!("{} corners", corners.len()), "four"));
        };
        Ok(MarkedPicture { files, exposures: entry.exposures, corners_px: corners.map(DVec2::from), near: entry.near.map(DVec3::from) })
    };
    marks.photographs.into_iter().enumerate().map(marked).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn marks(photographs: &str) -> Result<Vec<MarkedPicture>, String> {
        let text = format!(r#"{{"format": "lumisphere-corners/1", "photographs": [{photographs}]}}"#);
        read("corners.json", text.as_bytes()).map_err(|e| e.to_string())
    }

    #[test]
    fn corners_are_read_in_order() {
        let one = r#"{"file": "a.jpg", "corners": [[1, 9], [8.5, 9], [8, 2], [1, 2]], "near": [0, 0, 3]}"#;
        let two = r#"{"files": ["b.jpg", "c.jpg"], "exposures": [1, 0.5], "corners": [[1, 9], [8, 9], [8, 2], [1, 2]]}"#;
        let marks = marks(&format!("{one}, {two}")).unwrap();
        assert_eq!((marks[0].corners_px[1], marks[0].near), (DVec2::new(8.5, 9.0), Some(DVec3::new(0.0, 0.0, 3.0))));
        assert_eq!((marks[1].files.len(), marks[1].exposures.clone()), (2, Some(vec![1.0, 0.5])));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let wrong = |photographs: &str| marks(photographs).unwrap_err();
        assert_eq!(wrong(r#"{"file": "a"}"#), "photographs[0] has no corners: corners.json");
        assert_eq!(wrong(r#"{"file": "a", "corners": [[1, 2]]}"#), "photographs[0].corners is 1 corners, four expected: corners.json");
        assert!(wrong(r#"{"corners": []}"#).contains("has no file, or files"));
        assert!(wrong(r#"{"file": "a", "exposures": [0], "corners": []}"#).contains("1 numbers above 0"));
        assert!(wrong("").contains("0 photographs"));
        let same = r#"{"file": "a", "corners": [[1, 9], [8, 9], [8, 2], [1, 2]]}"#;
        assert!(wrong(&format!("{same}, {same}")).contains("photographs[1] names \"a\" again"));
    }
}
