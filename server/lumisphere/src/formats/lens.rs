//! `lumisphere-lens/1`: a calibrated lens as JSON, as `lumisphere calibrate lens` writes it and lists of photographs carry it.
//!
//! `{"format": "lumisphere-lens/1", "width_px": 640, "height_px": 480, "focal_px": [536.1, 536.0], "center_px": [342.9, 236.1], "distortion":
//! [k₁, k₂, p₁, p₂]}`; pixel centres lie at half integers.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::known_cameras::{InFile, KnownCamerasError, Lens};
use crate::geometry::PhotographCamera;

/// Name of the format.
pub const FORMAT: &str = "lumisphere-lens/1";

/// What a lens is in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LensNumbers {
    width_px: u32,
    height_px: u32,
    focal_px: [f64; 2],
    center_px: [f64; 2],
    #[serde(default)]
    distortion: [f64; 4],
}

impl LensNumbers {
    pub fn of(photograph: &PhotographCamera) -> Self {
        let intrinsics = photograph.camera.intrinsics();
        Self {
            width_px: intrinsics.width_px,
            height_px: intrinsics.height_px,
            focal_px: intrinsics.focal_px.as_dvec2().to_array(),
            center_px: intrinsics.center_px.as_dvec2().to_array(),
            distortion: photograph.distortion.coefficients(),
        }
    }

    /// `place` is that of the lens inside the file, with a dot behind, or empty.
    pub fn checked(&self, file: InFile, place: &str) -> Result<Lens, KnownCamerasError> {
        let side = |key: &str, side: u32| file.side_px(format!("{place}{key}"), side.into());
        let size_px = [side("width_px", self.width_px)?, side("height_px", self.height_px)?];
        Ok(Lens { size_px, focal_px: self.focal_px.into(), center_px: self.center_px.into(), coefficients: self.distortion })
    }
}

/// Reads a lens: a camera with it that stands at the origin. `path` is the file's name, for errors.
pub fn read(path: &str, bytes: &[u8]) -> Result<PhotographCamera, KnownCamerasError> {
    let file = InFile(path);
    let not_ours = |e: serde_json::Error| file.syntax(format!("not {FORMAT}: {e}"));
    let mut members: Map<String, Value> = serde_json::from_str(file.text(bytes)?).map_err(not_ours)?;
    let format = members.remove("format").ok_or_else(|| file.missing("the lens", "format"))?;
    if format != FORMAT {
        return Err(file.wrong("format", format, format!("{FORMAT:?}")));
    }
    let numbers: LensNumbers = serde_json::from_value(Value::Object(members)).map_err(not_ours)?;
    file.photograph("the lens", path, numbers.checked(file, "")?, file.pose("", DMat3::IDENTITY, DVec3::ZERO)?)
}

/// The file of a photograph's lens.
pub fn write(photograph: &PhotographCamera) -> Value {
    let mut file = json!(LensNumbers::of(photograph));
    file["format"] = FORMAT.into();
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"{"format": "lumisphere-lens/1", "width_px": 640, "height_px": 480, "focal_px": [536.5, 536.25],
        "center_px": [342.5, 236], "distortion": [-0.25, 0.125, 0.001, -0.002]}"#;

    #[test]
    fn a_lens_comes_back_as_it_was_written() {
        let lens = read("lens.json", TEXT.as_bytes()).unwrap();
        assert_eq!(lens.camera.intrinsics().focal_px.to_array(), [536.5, 536.25]);
        assert_eq!(lens.distortion.coefficients(), [-0.25, 0.125, 0.001, -0.002]);
        let again = serde_json::to_vec(&write(&lens)).unwrap();
        assert_eq!(read("lens.json", &again).unwrap(), lens);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let wrong = |from: &str, to: &str| read("lens.json", TEXT.replace(from, to).as_bytes()).unwrap_err().to_string();
        assert_eq!(wrong("640", "0"), "width_px is 0, a whole number from 1 to 131072 expected: lens.json");
        assert!(wrong("640", "640.5").contains("expected u32"));
        assert!(wrong("536.5,", "-1,").contains("lens.json"), "{}", wrong("536.5,", "-1,"));
        assert_eq!(wrong("lens/1", "lens/2"), "format is \"lumisphere-lens/2\", \"lumisphere-lens/1\" expected: lens.json");
        assert!(wrong("\"focal_px\"", "\"focal\"").contains("not lumisphere-lens/1"));
    }
}
