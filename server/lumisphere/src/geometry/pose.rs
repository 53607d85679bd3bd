//! The rigid transform from a camera's space to the world.

use glam::{Mat3, Vec3};
use thiserror::Error;

/// Rigid `world_from_camera`: camera +X right, +Y up, looking along −Z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    rotation: Mat3,
    position: Vec3,
}

/// Why a transform is not a pose.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PoseError {
    /// A component is NaN or infinite.
    #[error("pose has a component that is not finite")]
    NotFinite,
    /// The rotation is not orthonormal with determinant +1.
    #[error("pose is not rigid: its rotation part is off orthonormal by {deviation:.2e}, at most {limit:.0e} expected", limit = Pose::RIGID_TOLERANCE)]
    NotRigid {
        /// Largest element of `|RᵀR − I|`, or 2 for a mirroring transform.
        deviation: f32,
    },
    /// `look_at` has no direction, or `up` is along it.
    #[error("look-at has no defined rotation: target equals origin, or up is parallel to the view")]
    Degenerate,
}

impl Pose {
    /// Largest accepted element of `|RᵀR − I|`: wide enough for a rotation written with four digits.
    pub const RIGID_TOLERANCE: f32 = 1e-3;

    /// From a rotation (columns: camera axes in the world) and the camera's position. Errors when not finite or not rigid.
    /// The stored rotation is re-orthonormalised.
    pub fn new(rotation: Mat3, position: Vec3) -> Result<Self, PoseError> {
        if !(rotation.is_finite() && position.is_finite()) {
            return Err(PoseError::NotFinite);
        }
        let gram = rotation.transpose() * rotation - Mat3::IDENTITY;
        let off = gram.to_cols_array().iter().fold(0f32, |m, e| m.max(e.abs()));
        let deviation = if rotation.determinant() > 0.0 { off } else { off.max(2.0) };
        if !(deviation <= Self::RIGID_TOLERANCE) {
            return Err(PoseError::NotRigid { deviation });
        }
        let x = rotation.x_axis.normalize();
        let z = x.cross(rotation.y_axis).normalize();
        Ok(Self { rotation: Mat3::from_cols(x, z.cross(x), z), position })
    }

    /// The camera at `origin` looking at `target`, `up` roughly upward (need not be a unit vector).
    pub fn look_at(origin: Vec3, target: Vec3, up: Vec3) -> Result<Self, PoseError> {
        if !(origin.is_finite() && target.is_finite() && up.is_finite()) {
            return Err(PoseError::NotFinite);
        }
        let forward = (target - origin).try_normalize().ok_or(PoseError::Degenerate)?;
        let right = forward.cross(up.try_normalize().ok_or(PoseError::Degenerate)?);
        if !(right.length() > 1e-6) {
            return Err(PoseError::Degenerate);
        }
        let right = right.normalize();
        Self::new(Mat3::from_cols(right, right.cross(forward), -forward), origin)
    }

    /// Where a camera that moved and turned from `earlier` to here is after as long again.
    pub fn extrapolated_from(&self, earlier: &Self) -> Result<Self, PoseError> {
        let turn = self.rotation * earlier.rotation.transpose();
        Self::new(turn * self.rotation, self.position + (self.position - earlier.position))
    }

    /// Camera axes in the world, as columns.
    pub fn rotation(&self) -> Mat3 {
        self.rotation
    }

    /// The camera's centre in the world.
    pub fn position(&self) -> Vec3 {
        self.position
    }

    /// World direction of a camera-space vector.
    pub fn world_from_camera_vector(&self, v: Vec3) -> Vec3 {
        self.rotation * v
    }

    /// Camera-space coordinates of a world point.
    pub fn camera_from_world_point(&self, p: Vec3) -> Vec3 {
        self.rotation.transpose() * (p - self.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_keeps_turning_and_moving_is_where_extrapolation_says() {
        let at = |k: f32| Pose::new(Mat3::from_rotation_y(0.1 * k), Vec3::new(k, 2.0 * k, 1.0)).unwrap();
        let ahead = at(1.0).extrapolated_from(&at(0.0)).unwrap();
        // A few roundings of numbers around 1.
        assert!((ahead.position() - at(2.0).position()).length() < 1e-6);
        assert!((ahead.rotation() - at(2.0).rotation()).to_cols_array().iter().all(|e| e.abs() < 1e-6));
    }

    #[test]
    fn look_at_puts_the_target_on_the_negative_z_axis() {
        let pose = Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 2.0, -1.0), Vec3::Y).unwrap();
        let target_in_camera = pose.camera_from_world_point(Vec3::new(4.0, 2.0, -1.0));
        assert!((target_in_camera - Vec3::new(0.0, 0.0, -5.0)).length() < 1e-5);
        assert!(pose.world_from_camera_vector(Vec3::Y).dot(Vec3::Y) > 0.99);
    }

    #[test]
    fn what_is_not_rigid_or_not_finite_is_refused() {
        assert!(matches!(Pose::new(Mat3::IDENTITY * 1.1, Vec3::ZERO), Err(PoseError::NotRigid { .. })));
        assert!(matches!(Pose::new(Mat3::from_diagonal(Vec3::new(-1.0, 1.0, 1.0)), Vec3::ZERO), Err(PoseError::NotRigid { .. })));
        assert_eq!(Pose::new(Mat3::IDENTITY, Vec3::new(f32::NAN, 0.0, 0.0)), Err(PoseError::NotFinite));
        assert_eq!(Pose::look_at(Vec3::ZERO, Vec3::Y, Vec3::Y), Err(PoseError::Degenerate));
        assert_eq!(Pose::look_at(Vec3::ONE, Vec3::ONE, Vec3::Y), Err(PoseError::Degenerate));
    }
}
