//! The camera of one photograph: a pinhole camera behind a lens that distorts.
//!
//! What every source of known cameras gives: the readers of `formats` and `capture::calibration`. The renderers' [`Camera`] stays a pinhole.

use glam::{DVec2, Vec2, Vec3};

use super::{Camera, Distortion, DistortionError, Ray};

/// Which photograph, and the camera that took it.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotographCamera {
    /// The photograph's name, as the source of the camera wrote it: usually a path relative to that source.
    pub file: String,
    /// Pinhole part; world space is the source's.
    pub camera: Camera,
    /// Of the lens.
    pub distortion: Distortion,
}

impl PhotographCamera {
    /// Image position (pixel centres at half integers, y down) of a world point. None behind the camera and beyond the lens's fold.
    pub fn project(&self, point: Vec3) -> Option<Vec2> {
        let intrinsics = self.camera.intrinsics();
        let p = self.camera.pose().camera_from_world_point(point).as_dvec3();
        if !(p.z < 0.0) {
            return None;
        }
        let distorted = self.distortion.distort(DVec2::new(p.x, -p.y) / -p.z)?;
        Some((intrinsics.center_px.as_dvec2() + intrinsics.focal_px.as_dvec2() * distorted).as_vec2())
    }

    /// The world ray that is imaged at `at_px`. Errors where no ray is: beyond the lens's fold.
    pub fn ray(&self, at_px: Vec2) -> Result<Ray, DistortionError> {
        let intrinsics = self.camera.intrinsics();
        let focal_px = intrinsics.focal_px.as_dvec2();
        let pinhole = self.distortion.undistort((at_px - intrinsics.center_px).as_dvec2() / focal_px)?;
        Ok(self.camera.ray(intrinsics.center_px + (focal_px * pinhole).as_vec2()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Pose};

    fn photograph(coefficients: [f64; 4]) -> PhotographCamera {
        let pose = Pose::look_at(Vec3::new(3.0, 2.0, 5.0), Vec3::ZERO, Vec3::Y).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(40.0, 640, 480).unwrap(), pose).unwrap();
        PhotographCamera { file: "a.jpg".into(), camera, distortion: Distortion::new(coefficients).unwrap() }
    }

    #[test]
    fn projection_undoes_the_ray_through_a_distorting_lens() {
        let photograph = photograph([-0.3, 0.1, 0.002, -0.001]);
        for at in [Vec2::new(0.5, 0.5), Vec2::new(320.0, 240.0), Vec2::new(600.5, 33.5)] {
            let back = photograph.project(photograph.ray(at).unwrap().at(4.0)).unwrap();
            // A world of 10 units in f32 behind a focal length of 660 px: 660 · 10 · 6e-8 / 4, and a few roundings.
            assert!((back - at).length() < 1e-3, "{at} came back as {back}");
        }
        assert_eq!(photograph.project(photograph.camera.pixel_ray(3, 4).at(-1.0)), None);
    }

    #[test]
    fn a_point_beyond_the_fold_has_no_image() {
        // 65° off the axis: radius 2.1, where the polynomial has turned back and would say pixel (-165, 240).
        let photograph = photograph([-0.3, 0.0, 0.0, 0.0]);
        let pose = photograph.camera.pose();
        assert_eq!(photograph.project(pose.position() + pose.world_from_camera_vector(Vec3::new(2.1, 0.0, -1.0))), None);
        assert!(photograph.project(pose.position() + pose.world_from_camera_vector(Vec3::new(0.9, 0.0, -1.0))).is_some());
    }
}
