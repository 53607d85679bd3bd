//! What the readers of known cameras share: what they refuse, how they name it, and the turn from a camera that looks along +Z with
//! y down (OpenCV, COLMAP) to ours, which looks along −Z with y up. The world's axes stay as the file has them.

use std::collections::HashSet;

use glam::{DMat3, DVec2, DVec3};
use thiserror::Error;

use crate::geometry::{Camera, CameraError, Distortion, DistortionError, Intrinsics, PhotographCamera, Pose, PoseError};

/// Greatest file that a reader takes: COLMAP's lists of image points are long.
pub const MAX_FILE_BYTES: usize = 1 << 28;

/// Most photographs in one file.
pub const MAX_PHOTOGRAPHS: usize = 1 << 16;

/// Greatest width or height of a photograph, in pixels.
pub const MAX_SIDE_PX: u32 = 1 << 17;

/// What is wrong with a file of cameras or light directions.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum KnownCamerasError {
    /// More bytes than a reader takes.
    #[error("{bytes} bytes, at most {MAX_FILE_BYTES} expected: {file}")]
    TooLong {
        /// Of the file.
        bytes: usize,
        /// Which file.
        file: String,
    },
    /// Not the format at all.
    #[error("{message}: {file}")]
    Syntax {
        /// What and where.
        message: String,
        /// Which file.
        file: String,
    },
    /// A required value is absent.
    #[error("{place} has no {key}: {file}")]
    Missing {
        /// Inside the file: `frames[3]`, `line 7`.
        place: String,
        /// What is required.
        key: &'static str,
        /// Which file.
        file: String,
    },
    /// A value is not what its place asks for.
    #[error("{place} is {value}, {expected} expected: {file}")]
    Value {
        /// Inside the file: `frames[3].fl_x`, `line 7: z`.
        place: String,
        /// What is there (shortened).
        value: String,
        /// What should be.
        expected: String,
        /// Which file.
        file: String,
    },
    /// The rotation and position are no rigid transform.
    #[error("{place}: {source}: {file}")]
    Pose {
        /// Inside the file.
        place: String,
        /// Why.
        source: PoseError,
        /// Which file.
        file: String,
    },
    /// The intrinsics are those of no camera.
    #[error("{place}: {source}: {file}")]
    Camera {
        /// Inside the file.
        place: String,
        /// Why.
        source: CameraError,
        /// Which file.
        file: String,
    },
    /// The lens.
    #[error("{place}: {source}: {file}")]
    Distortion {
        /// Inside the file.
        place: String,
        /// Why.
        source: DistortionError,
        /// Which file.
        file: String,
    },
    /// Two photographs, or two cameras, of one name.
    #[error("{place} names {name} again: {file}")]
    Duplicate {
        /// Of the second, inside the file.
        place: String,
        /// The name.
        name: String,
        /// Which file.
        file: String,
    },
    /// The announced number and the number found differ.
    #[error("{announced} photographs announced, {found} found: {file}")]
    Count {
        /// In the head.
        announced: usize,
        /// Counted.
        found: usize,
        /// Which file.
        file: String,
    },
    /// No photograph, or too many.
    #[error("{found} photographs, 1 to {MAX_PHOTOGRAPHS} expected: {file}")]
    Photographs {
        /// How many.
        found: usize,
        /// Which file.
        file: String,
    },
}

/// Size, focal lengths, principal point and lens as a file gives them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lens {
    pub size_px: [u32; 2],
    pub focal_px: DVec2,
    pub center_px: DVec2,
    pub coefficients: [f64; 4],
}

/// A file's name, for errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct InFile<'a>(pub &'a str);

impl InFile<'_> {
    pub fn text<'b>(&self, bytes: &'b [u8]) -> Result<&'b str, KnownCamerasError> {
        if bytes.len() > MAX_FILE_BYTES {
            return Err(KnownCamerasError::TooLong { bytes: bytes.len(), file: self.0.into() });
        }
        std::str::from_utf8(bytes).map_err(|e| self.syntax(format!("not UTF-8 text: {e}")))
    }

    pub fn syntax(&self, message: impl Into<String>) -> KnownCamerasError {
        KnownCamerasError::Syntax { message: message.into(), file: self.0.into() }
    }

    pub fn missing(&self, place: impl Into<String>, key: &'static str) -> KnownCamerasError {
        KnownCamerasError::Missing { place: place.into(), key, file: self.0.into() }
    }

    pub fn wrong(&self, place: impl Into<String>, value: impl ToString, expected: impl Into<String>) -> KnownCamerasError {
        let value = shortened(&value.to_string());
        KnownCamerasError::Value { place: place.into(), value, expected: expected.into(), file: self.0.into() }
    }

    pub fn duplicate(&self, place: impl Into<String>, name: impl ToString) -> KnownCamerasError {
        KnownCamerasError::Duplicate { place: place.into(), name: shortened(&name.to_string()), file: self.0.into() }
    }

    /// One word of a line as a finite number.
    pub fn number(&self, place: impl Into<String>, word: &str) -> Result<f64, KnownCamerasError> {
        word.parse().ok().filter(|n: &f64| n.is_finite()).ok_or_else(|| self.wrong(place, format!("{word:?}"), "a finite number"))
    }

    /// A width or height.
    pub fn side_px(&self, place: impl Into<String>, side: f64) -> Result<u32, KnownCamerasError> {
        let whole = side.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&side);
        if whole { Ok(side as u32) } else { Err(self.wrong(place, side, format!("a whole number from 1 to {MAX_SIDE_PX}"))) }
    }

    /// The pose of a camera, from a matrix that gives its axes (x right, y up, looking along −Z) in the world.
    pub fn pose(&self, place: &str, world_from_camera: DMat3, position: DVec3) -> Result<Pose, KnownCamerasError> {
        Pose::new(world_from_camera.as_mat3(), position.as_vec3()).map_err(|source| KnownCamerasError::Pose {
            place: place.into(),
            source,
            file: self.0.into(),
        })
    }

    /// The pose of a camera with x right, y down, z forward, from the rigid transform that takes the world to it.
    pub fn pose_from_opencv(&self, place: &str, camera_from_world: DMat3, translation: DVec3) -> Result<Pose, KnownCamerasError> {
        let opencv_from_ours = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let world_from_opencv = camera_from_world.transpose();
        self.pose(place, world_from_opencv * opencv_from_ours, -(world_from_opencv * translation))
    }

    pub fn photograph(&self, place: &str, name: &str, lens: Lens, pose: Pose) -> Result<PhotographCamera, KnownCamerasError> {
        let [width_px, height_px] = lens.size_px;
        let intrinsics = Intrinsics { width_px, height_px, focal_px: lens.focal_px.as_vec2(), center_px: lens.center_px.as_vec2() };
        let camera = Camera::new(intrinsics, pose).map_err(|source| KnownCamerasError::Camera {
            place: place.into(),
            source,
            file: self.0.into(),
        })?;
        let distortion = Distortion::new(lens.coefficients).map_err(|source| KnownCamerasError::Distortion {
            place: place.into(),
            source,
            file: self.0.into(),
        })?;
        Ok(PhotographCamera { file: name.into(), camera, distortion })
    }

    /// Refuses no photograph and more than the limit.
    pub fn few_enough(&self, found: usize) -> Result<(), KnownCamerasError> {
        let fits = (1..=MAX_PHOTOGRAPHS).contains(&found);
        if fits { Ok(()) } else { Err(KnownCamerasError::Photographs { found, file: self.0.into() }) }
    }
}

/// Refuses a name that came before.
pub(super) fn new_name(file: InFile, names: &mut HashSet<String>, place: &str, name: &str) -> Result<(), KnownCamerasError> {
    if names.insert(name.to_owned()) { Ok(()) } else { Err(file.duplicate(place, format!("{name:?}"))) }
}

/// Of one picture: `file`, or `files`.
pub(super) fn files(
    in_file: InFile,
    place: &str,
    file: Option<String>,
    files: Option<Vec<String>>,
) -> Result<Vec<String>, KnownCamerasError> {
    match (file, files) {
        (Some(one), None) => Ok(vec![one]),
        (None, Some(several)) if !several.is_empty() => Ok(several),
        _ => Err(in_file.missing(place, "file, or files")),
    }
}

/// As many as files, all above 0.
pub(super) fn check_exposures(file: InFile, place: &str, exposures: Option<&[f64]>, files: usize) -> Result<(), KnownCamerasError> {
    let Some(exposures) = exposures else { return Ok(()) };
    let is_sound = exposures.len() == files && exposures.iter().all(|e| *e > 0.0 && e.is_finite());
    let expected = || format!("{files} numbers above 0, one a file");
    if is_sound { Ok(()) } else { Err(file.wrong(format!("{place}.exposures"), format!("{exposures:?}"), expected())) }
}

fn shortened(value: &str) -> String {
    const LONGEST: usize = 80;
    if value.chars().count() <= LONGEST {
        return value.to_owned();
    }
    value.chars().take(LONGEST).chain("…".chars()).collect()
}
