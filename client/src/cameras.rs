//! Cameras from flags and files, and the wire's form of them.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere_proto::v1alpha1 as wire;
use serde::Deserialize;

use crate::exit::Failure;

/// An orbit: the same flags, defaults and meaning as the wire's `OrbitPath`.
#[derive(Debug, Clone, Args)]
pub struct OrbitFlags {
    /// Frames on the orbit
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub frames: u32,
    /// Image size of orbit and single poses
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "640x480")]
    pub size: Size,
    /// Vertical field of view of orbit and single poses
    #[arg(long, value_name = "DEGREES", default_value_t = 40.0)]
    pub vfov_deg: f32,
    /// The orbit's height above the horizon
    #[arg(long, value_name = "DEGREES", default_value_t = 25.0, allow_negative_numbers = true)]
    pub elevation_deg: f32,
    /// The orbit's distance from the object's centre, in radii of its bounding sphere
    #[arg(long, value_name = "RADII", default_value_t = 3.5)]
    pub distance_radii: f32,
    /// Where the orbit begins, from +Z toward +X
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true)]
    pub azimuth_deg: f32,
}

/// Image size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size {
    /// Along a row.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
}

impl std::str::FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parse = || {
            let (width, height) = text.split_once('x')?;
            Some(Self { width_px: width.parse().ok()?, height_px: height.parse().ok()? })
        };
        parse().ok_or_else(|| "WIDTHxHEIGHT in pixels expected, such as 640x480".to_string())
    }
}

/// "1,2.5,-3".
pub fn parse_vec3(text: &str) -> Result<[f32; 3], String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|t| t.trim().parse::<f32>()).collect();
    numbers.ok().and_then(|n| n.try_into().ok()).ok_or_else(|| "three numbers separated by commas expected, such as 0.1,2,-3".to_string())
}

/// A named camera as the wire has it.
pub type Named = (String, wire::Camera);

impl OrbitFlags {
    /// For jobs, which lay the orbit out on the server.
    pub fn to_wire(&self) -> wire::OrbitPath {
        wire::OrbitPath {
            count: self.frames,
            width_px: self.size.width_px,
            height_px: self.size.height_px,
            vertical_field_of_view_deg: self.vfov_deg,
            elevation_deg: Some(self.elevation_deg),
            distance_radii: self.distance_radii,
            azimuth_deg: self.azimuth_deg,
        }
    }

    /// Square pixels and centred.
    pub fn intrinsics(&self) -> wire::Intrinsics {
        let Size { width_px, height_px } = self.size;
        let focal = 0.5 * height_px as f32 / (0.5 * self.vfov_deg.to_radians()).tan();
        wire::Intrinsics { width_px, height_px, focal_x_px: focal, focal_y_px: 0.0, center_x_px: None, center_y_px: None }
    }

    /// Cameras around the box's centre.
    pub fn cameras(&self, bounds: &wire::Box3) -> anyhow::Result<Vec<Named>> {
        let camera = |index: u32| {
            let azimuth_deg = self.azimuth_deg + 360.0 * index as f32 / self.frames as f32;
            let place = Place { azimuth_deg, elevation_deg: self.elevation_deg, distance_radii: self.distance_radii };
            Ok((format!("{index:05}"), self.camera(bounds, place)?))
        };
        (0..self.frames).map(camera).collect()
    }

    /// One that looks from `place` at the box's centre, with the orbit's lens.
    pub fn camera(&self, bounds: &wire::Box3, place: Place) -> anyhow::Result<wire::Camera> {
        let (min, max) = (vec3(bounds.min.unwrap_or_default()), vec3(bounds.max.unwrap_or_default()));
        let centre = 0.5 * (min + max);
        let distance = place.distance_radii * 0.5 * (max - min).length();
        let azimuth = place.azimuth_deg.to_radians();
        let (sin, cos) = place.elevation_deg.to_radians().sin_cos();
        let outward = glam::Vec3::new(cos * azimuth.sin(), sin, cos * azimuth.cos());
        let pose = look_at(centre + distance * outward, centre, glam::Vec3::Y)?;
        Ok(wire::Camera { pose: Some(pose), intrinsics: Some(self.intrinsics()) })
    }
}

/// A viewpoint around an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// From +Z toward +X.
    pub azimuth_deg: f32,
    /// Above the horizon.
    pub elevation_deg: f32,
    /// From the centre of the object's box, in radii of the sphere around the box.
    pub distance_radii: f32,
}

/// Looks from `position` at `target`.
pub fn look_at(position: glam::Vec3, target: glam::Vec3, up: glam::Vec3) -> anyhow::Result<wire::Pose> {
    let pose = Pose::look_at(position, target, up).map_err(|e| Failure::Usage(format!("camera: {e}")))?;
    Ok(pose_to_wire(&pose))
}

/// From a position and the axes right, up, backward.
pub fn rigid(position: glam::Vec3, [right, up, backward]: [glam::Vec3; 3]) -> wire::Pose {
    let vector = |v: glam::Vec3| Some(wire::Vector3 { x: v.x, y: v.y, z: v.z });
    wire::Pose { position: vector(position), right: vector(right), up: vector(up), backward: vector(backward) }
}

fn pose_to_wire(pose: &Pose) -> wire::Pose {
    let axes = pose.rotation();
    rigid(pose.position(), [axes.x_axis, axes.y_axis, axes.z_axis])
}

fn camera_to_wire(camera: &Camera) -> wire::Camera {
    let i = camera.intrinsics();
    let intrinsics = wire::Intrinsics {
        width_px: i.width_px,
        height_px: i.height_px,
        focal_x_px: i.focal_px.x,
        focal_y_px: i.focal_px.y,
        center_x_px: Some(i.center_px.x),
        center_y_px: Some(i.center_px.y),
    };
    wire::Camera { pose: Some(pose_to_wire(camera.pose())), intrinsics: Some(intrinsics) }
}

/// As glam has it.
pub fn vec3(v: wire::Vector3) -> glam::Vec3 {
    glam::Vec3::new(v.x, v.y, v.z)
}

/// The `cameras` of a neutral-scene/1 file; the rest of the file does not matter here.
#[derive(Debug, Deserialize)]
struct CameraFile {
    cameras: Vec<CameraEntry>,
}

#[derive(Debug, Deserialize)]
struct CameraEntry {
    name: String,
    origin: [f32; 3],
    target: [f32; 3],
    #[serde(default = "plus_y")]
    up: [f32; 3],
    vfov_deg: f32,
    width: u32,
    height: u32,
}

fn plus_y() -> [f32; 3] {
    [0.0, 1.0, 0.0]
}

/// Reads the cameras of a scene file.
pub fn read_cameras(path: &Path) -> anyhow::Result<Vec<Named>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let bad = |what: String| Failure::Usage(format!("{}: {what}", path.display()));
    let file: CameraFile = serde_json::from_str(&text).map_err(|e| bad(e.to_string()))?;
    if file.cameras.is_empty() {
        return Err(bad("no cameras".into()).into());
    }
    let camera = |entry: &CameraEntry| {
        let named = |e: &dyn std::fmt::Display| bad(format!("camera {:?}: {e}", entry.name));
        let intrinsics = Intrinsics::from_vfov(entry.vfov_deg, entry.width, entry.height).map_err(|e| named(&e))?;
        let pose = Pose::look_at(entry.origin.into(), entry.target.into(), entry.up.into()).map_err(|e| named(&e))?;
        let camera = Camera::new(intrinsics, pose).map_err(|e| named(&e))?;
        Ok((entry.name.clone(), camera_to_wire(&camera)))
    };
    file.cameras.iter().map(camera).collect()
}

/// Where cameras come from; exactly one of the three.
#[derive(Debug, Clone, Args)]
pub struct CameraFlags {
    /// Cameras on a path around the captured object
    #[arg(long, value_enum, conflicts_with_all = ["cameras", "position"])]
    pub path: Option<PathKind>,
    /// Cameras of a scene file (neutral-scene/1)
    #[arg(long, value_name = "FILE", conflicts_with = "position")]
    pub cameras: Option<PathBuf>,
    /// One camera here
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vec3, allow_hyphen_values = true)]
    pub position: Option<[f32; 3]>,
    /// Where the one camera looks [default: the object's centre]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vec3, allow_hyphen_values = true, requires = "position")]
    pub target: Option<[f32; 3]>,
    #[command(flatten)]
    pub orbit: OrbitFlags,
}

/// Paths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum PathKind {
    /// A circle around the object, looking at its centre
    Orbit,
}

/// Cameras given one by one, or an orbit.
#[derive(Debug, Clone, PartialEq)]
pub enum Views {
    /// In order.
    Cameras(Vec<Named>),
    /// To be laid out around the object.
    Orbit(wire::OrbitPath),
}

impl CameraFlags {
    /// For a job: the server lays the orbit out. A single pose must say where it looks.
    pub fn views(&self) -> anyhow::Result<Views> {
        if let Some(file) = &self.cameras {
            return Ok(Views::Cameras(read_cameras(file)?));
        }
        if let Some(position) = self.position {
            let target = self.target.ok_or_else(|| Failure::Usage("--position needs --target here".into()))?;
            return Ok(Views::Cameras(vec![self.single(position, target)?]));
        }
        Ok(Views::Orbit(self.orbit.to_wire()))
    }

    /// All cameras, laid out here around the object's box.
    pub fn cameras(&self, bounds: Option<&wire::Box3>) -> anyhow::Result<Vec<Named>> {
        let bounds = || {
            bounds.ok_or_else(|| {
                Failure::Precondition("the dataset tells no object's box; give --cameras, or --position and --target".into())
            })
        };
        match (&self.cameras, self.position) {
            (Some(file), _) => read_cameras(file),
            (None, None) => self.orbit.cameras(bounds()?),
            (None, Some(position)) => {
                let centre = |b: &wire::Box3| (0.5 * (vec3(b.min.unwrap_or_default()) + vec3(b.max.unwrap_or_default()))).to_array();
                let target = match self.target {
                    Some(target) => target,
                    None => centre(bounds()?),
                };
                Ok(vec![self.single(position, target)?])
            }
        }
    }

    fn single(&self, position: [f32; 3], target: [f32; 3]) -> anyhow::Result<Named> {
        let pose = look_at(position.into(), target.into(), glam::Vec3::Y)?;
        Ok(("00000".into(), wire::Camera { pose: Some(pose), intrinsics: Some(self.orbit.intrinsics()) }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn orbit(frames: u32) -> OrbitFlags {
        OrbitFlags {
            frames,
            size: Size { width_px: 64, height_px: 48 },
            vfov_deg: 40.0,
            elevation_deg: 0.0,
            distance_radii: 2.0,
            azimuth_deg: 0.0,
        }
    }

    #[test]
    fn an_orbit_starts_at_plus_z_and_turns_toward_plus_x() {
        let corner = |s: f32| Some(wire::Vector3 { x: s, y: s, z: s });
        let cameras = orbit(4).cameras(&wire::Box3 { min: corner(-1.0), max: corner(1.0) }).unwrap();
        let position = |i: usize| vec3(cameras[i].1.pose.unwrap().position.unwrap());
        // Two radii of a sphere of radius √3; f32 trigonometry.
        assert!((position(0) - glam::Vec3::new(0.0, 0.0, 2.0 * 3f32.sqrt())).length() < 1e-5);
        assert!((position(1) - glam::Vec3::new(2.0 * 3f32.sqrt(), 0.0, 0.0)).length() < 1e-5);
        let back = vec3(cameras[1].1.pose.unwrap().backward.unwrap());
        assert!((back - glam::Vec3::X).length() < 1e-5);
    }

    #[test]
    fn a_scene_file_gives_its_cameras_and_names_a_bad_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.json");
        let scene = |vfov: &str| {
            format!(
                r#"{{"format":"neutral-scene/1","cameras":[{{"name":"a","origin":[0,0,2],"target":[0,0,0],"up":[0,1,0],"vfov_deg":{vfov},"width":8,"height":4}}]}}"#
            )
        };
        std::fs::write(&path, scene("90")).unwrap();
        let cameras = read_cameras(&path).unwrap();
        // tan 45° = 1: the focal length is half the height.
        assert!((cameras[0].1.intrinsics.unwrap().focal_x_px - 2.0).abs() < 1e-5);
        std::fs::write(&path, scene("200")).unwrap();
        let error = read_cameras(&path).unwrap_err();
        assert_eq!(crate::exit::code(&error), 2);
        assert!(error.to_string().contains("camera \"a\""), "{error}");
    }

    #[test]
    fn sizes_and_vectors_are_parsed_or_refused() {
        assert_eq!("640x480".parse(), Ok(Size { width_px: 640, height_px: 480 }));
        assert!("640".parse::<Size>().is_err());
        assert_eq!(parse_vec3("1,2,-3.5"), Ok([1.0, 2.0, -3.5]));
        assert!(parse_vec3("1,2").is_err());
    }
}
