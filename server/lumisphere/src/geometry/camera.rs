//! Pinhole camera: intrinsics and pose.

use glam::{Vec2, Vec3};
use thiserror::Error;

use super::{Pose, Ray};

/// Pinhole intrinsics in pixels. Pixel (i, j) has its centre at (i + ½, j + ½); j runs down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Image size.
    pub width_px: u32,
    /// Image size.
    pub height_px: u32,
    /// Focal length along x and y.
    pub focal_px: Vec2,
    /// Principal point, from the image's top left corner.
    pub center_px: Vec2,
}

/// Intrinsics and pose, validated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    intrinsics: Intrinsics,
    pose: Pose,
}

/// Why these numbers are not a camera.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CameraError {
    /// Width or height is zero.
    #[error("image is {width_px}x{height_px} pixels, at least 1x1 expected")]
    ZeroSize {
        /// As given.
        width_px: u32,
        /// As given.
        height_px: u32,
    },
    /// Focal length or principal point is not finite, or the focal length not positive.
    #[error("intrinsics are not finite and positive: focal length ({}, {}) px, principal point ({}, {}) px", focal_px.x, focal_px.y, center_px.x, center_px.y)]
    BadIntrinsics {
        /// As given.
        focal_px: Vec2,
        /// As given.
        center_px: Vec2,
    },
    /// Field of view outside (0°, 180°).
    #[error("vertical field of view is {vfov_deg} degrees, between 0 and 180 (both excluded) expected")]
    BadFieldOfView {
        /// As given.
        vfov_deg: f32,
    },
}

impl Intrinsics {
    /// Square pixels, principal point at the centre. `vfov_deg` is the vertical field of view.
    pub fn from_vfov(vfov_deg: f32, width_px: u32, height_px: u32) -> Result<Self, CameraError> {
        if !(vfov_deg > 0.0 && vfov_deg < 180.0) {
            return Err(CameraError::BadFieldOfView { vfov_deg });
        }
        let focal = 0.5 * height_px as f32 / (0.5 * vfov_deg.to_radians()).tan();
        Ok(Self { width_px, height_px, focal_px: Vec2::splat(focal), center_px: 0.5 * Vec2::new(width_px as f32, height_px as f32) })
    }
}

impl Camera {
    /// Checks sizes and intrinsics; the pose is valid by construction.
    pub fn new(intrinsics: Intrinsics, pose: Pose) -> Result<Self, CameraError> {
        let Intrinsics { width_px, height_px, focal_px, center_px } = intrinsics;
        if width_px == 0 || height_px == 0 {
            return Err(CameraError::ZeroSize { width_px, height_px });
        }
        if !(focal_px.is_finite() && center_px.is_finite() && focal_px.min_element() > 0.0) {
            return Err(CameraError::BadIntrinsics { focal_px, center_px });
        }
        Ok(Self { intrinsics, pose })
    }

    /// Size, focal length and principal point.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Rigid `world_from_camera`.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// The world ray through image position `at_px` (pixel centres at half integers, y down).
    pub fn ray(&self, at_px: Vec2) -> Ray {
        let d = (at_px - self.intrinsics.center_px) / self.intrinsics.focal_px;
        Ray { origin: self.pose.position(), direction: self.pose.world_from_camera_vector(Vec3::new(d.x, -d.y, -1.0)).normalize() }
    }

    /// The world ray through the centre of pixel (i, j).
    pub fn pixel_ray(&self, i: u32, j: u32) -> Ray {
        self.ray(Vec2::new(i as f32 + 0.5, j as f32 + 0.5))
    }

    /// Derivatives of a pixel's ray by its column and row, per pixel: of that vector along the ray which `direction`, the ray's unit
    /// vector, is at this pixel. (Where it changes its length, that tells nothing of where it points.)
    pub fn ray_derivatives(&self, direction: Vec3) -> [Vec3; 2] {
        let axes = self.pose.rotation();
        let scale = -axes.z_axis.dot(direction) / self.intrinsics.focal_px;
        [axes.x_axis * scale.x, -axes.y_axis * scale.y]
    }

    /// Image position of a world point; None behind the camera.
    pub fn project(&self, point: Vec3) -> Option<Vec2> {
        let p = self.pose.camera_from_world_point(point);
        if !(p.z < 0.0) {
            return None;
        }
        Some(self.intrinsics.center_px + self.intrinsics.focal_px * Vec2::new(p.x, -p.y) / -p.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projection_undoes_the_pixel_ray() {
        let pose = Pose::look_at(Vec3::new(3.0, 2.0, 5.0), Vec3::ZERO, Vec3::Y).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(40.0, 64, 48).unwrap(), pose).unwrap();
        let px = camera.project(camera.pixel_ray(7, 40).at(2.5)).unwrap();
        // f32 projection at 64 pixels: well under a thousandth of a pixel.
        assert!((px - Vec2::new(7.5, 40.5)).length() < 1e-3);
        assert_eq!(camera.project(camera.pixel_ray(7, 40).at(-1.0)), None);
    }

    #[test]
    fn derivatives_lead_from_a_pixels_ray_to_its_neighbours() {
        let pose = Pose::look_at(Vec3::new(3.0, 2.0, 5.0), Vec3::ZERO, Vec3::Y).unwrap();
        let intrinsics = Intrinsics { focal_px: Vec2::new(60.0, 45.0), ..Intrinsics::from_vfov(40.0, 64, 48).unwrap() };
        let camera = Camera::new(intrinsics, pose).unwrap();
        let d = camera.pixel_ray(7, 40).direction;
        let [across, down] = camera.ray_derivatives(d);
        assert!(((d + 3.0 * across).normalize() - camera.pixel_ray(10, 40).direction).length() < 1e-6);
        assert!(((d - 5.0 * down).normalize() - camera.pixel_ray(7, 35).direction).length() < 1e-6);
    }

    #[test]
    fn the_ray_agrees_with_the_neutral_scene_formula() {
        let (origin, target, up, vfov, w, h) = (Vec3::new(1.0, 1.5, 3.0), Vec3::new(0.2, 0.4, 0.0), Vec3::Y, 50f32, 32u32, 20u32);
        let camera = Camera::new(Intrinsics::from_vfov(vfov, w, h).unwrap(), Pose::look_at(origin, target, up).unwrap()).unwrap();
        let f = (target - origin).normalize();
        let r = f.cross(up).normalize();
        let u = r.cross(f);
        let t = (vfov.to_radians() / 2.0).tan();
        let (i, j) = (5u32, 17u32);
        let d =
            f + r * (2.0 * (i as f32 + 0.5) / w as f32 - 1.0) * t * w as f32 / h as f32 + u * (1.0 - 2.0 * (j as f32 + 0.5) / h as f32) * t;
        assert!((camera.pixel_ray(i, j).direction - d.normalize()).length() < 1e-5);
    }

    #[test]
    fn degenerate_intrinsics_are_refused() {
        let pose = Pose::look_at(Vec3::Z, Vec3::ZERO, Vec3::Y).unwrap();
        assert!(matches!(Camera::new(Intrinsics::from_vfov(40.0, 0, 48).unwrap(), pose), Err(CameraError::ZeroSize { .. })));
        assert!(matches!(Intrinsics::from_vfov(f32::NAN, 4, 4), Err(CameraError::BadFieldOfView { .. })));
        let bad = Intrinsics { width_px: 4, height_px: 4, focal_px: Vec2::new(f32::NAN, 1.0), center_px: Vec2::ONE };
        assert!(matches!(Camera::new(bad, pose), Err(CameraError::BadIntrinsics { .. })));
    }
}
