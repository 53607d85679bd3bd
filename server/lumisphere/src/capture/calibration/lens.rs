//! The camera model that calibration solves for, in f64, with its derivatives. (`geometry::Camera` is what it is handed on as.)

use glam::{DMat2, DMat3, DVec2, DVec3};

use crate::geometry::{Camera, CameraError, Distortion, Intrinsics, PhotographCamera, Pose, PoseError};

/// Focal lengths, principal point and distortion: what all photographs by one camera share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Width and height of the photographs.
    pub size_px: [u32; 2],
    /// Along x and y.
    pub focal_px: DVec2,
    /// Principal point; pixel centres lie at half integers.
    pub center_px: DVec2,
    /// k₁ k₂ p₁ p₂.
    pub distortion: Distortion,
}

/// Rigid `camera_from_world`; the camera has x right, y up and looks along −Z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Extrinsics {
    pub rotation: DMat3,
    pub translation: DVec3,
}

/// An image position and its derivatives; columns by the parameter named.
#[derive(Debug, Clone, Copy)]
pub(super) struct Projection {
    pub at_px: DVec2,
    /// By focal lengths, principal point, k₁ k₂ p₁ p₂.
    pub by_lens: [DVec2; Lens::PARAMETERS],
    /// By a turn about the camera's axes (radians) and a shift along them.
    pub by_pose: [DVec2; Extrinsics::PARAMETERS],
}

impl Lens {
    /// fx fy cx cy k₁ k₂ p₁ p₂.
    pub const PARAMETERS: usize = 8;

    /// From the camera and distortion of a photograph.
    pub fn of(photograph: &PhotographCamera) -> Self {
        let intrinsics = photograph.camera.intrinsics();
        Self {
            size_px: [intrinsics.width_px, intrinsics.height_px],
            focal_px: intrinsics.focal_px.as_dvec2(),
            center_px: intrinsics.center_px.as_dvec2(),
            distortion: photograph.distortion,
        }
    }

    /// fx fy cx cy k₁ k₂ p₁ p₂.
    pub fn parameters(&self) -> [f64; Self::PARAMETERS] {
        let [k1, k2, p1, p2] = self.distortion.coefficients();
        [self.focal_px.x, self.focal_px.y, self.center_px.x, self.center_px.y, k1, k2, p1, p2]
    }

    // None when no camera has these parameters.
    pub(super) fn with_parameters(&self, parameters: [f64; Self::PARAMETERS]) -> Option<Self> {
        let [fx, fy, cx, cy, k1, k2, p1, p2] = parameters;
        let distortion = Distortion::new([k1, k2, p1, p2]).ok()?;
        let positive = fx > 0.0 && fy > 0.0 && DVec2::new(cx, cy).is_finite();
        positive.then_some(Self { focal_px: DVec2::new(fx, fy), center_px: DVec2::new(cx, cy), distortion, ..*self })
    }

    /// Image position of a point in the camera's space; None behind the camera and beyond the lens's fold.
    pub(super) fn project(&self, point: DVec3) -> Option<DVec2> {
        let distorted = self.distortion.distort(pinhole(point)?)?;
        Some(self.center_px + self.focal_px * distorted)
    }

    /// Undistorted normalised image position (x right, y down) of a pixel.
    pub(super) fn pinhole_of(&self, at_px: DVec2) -> Option<DVec2> {
        self.distortion.undistort((at_px - self.center_px) / self.focal_px).ok()
    }

    /// Image position of a world point with derivatives.
    pub(super) fn projection(&self, extrinsics: &Extrinsics, point: DVec3) -> Option<Projection> {
        let turned = extrinsics.rotation * point;
        let p = turned + extrinsics.translation;
        let u = pinhole(p)?;
        let distorted = self.distortion.distort(u)?;
        let r2 = u.length_squared();
        let by_distortion = [
            u * r2, //
            u * r2 * r2,
            DVec2::new(2.0 * u.x * u.y, r2 + 2.0 * u.y * u.y),
            DVec2::new(r2 + 2.0 * u.x * u.x, 2.0 * u.x * u.y),
        ]
        .map(|d| self.focal_px * d);
        let [k1, k2, p1, p2] = by_distortion;
        let by_lens = [DVec2::X * distorted.x, DVec2::Y * distorted.y, DVec2::X, DVec2::Y, k1, k2, p1, p2];
        let by_pinhole = DMat2::from_diagonal(self.focal_px) * self.distortion.jacobian(u);
        let by_point = |d: DVec3| by_pinhole * (DVec2::new(d.x, -d.y) + u * d.z) / -p.z;
        let turns = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| by_point(axis.cross(turned)));
        let shifts = [DVec3::X, DVec3::Y, DVec3::Z].map(by_point);
        let by_pose = [turns[0], turns[1], turns[2], shifts[0], shifts[1], shifts[2]];
        Some(Projection { at_px: self.center_px + self.focal_px * distorted, by_lens, by_pose })
    }
}

impl Extrinsics {
    /// Three turns, three shifts.
    pub const PARAMETERS: usize = 6;

    pub fn moved(&self, step: &[f64]) -> Self {
        let [turn, shift] = [0, 3].map(|at| DVec3::new(step[at], step[at + 1], step[at + 2]));
        let angle = turn.length();
        let rotation = turn.try_normalize().map_or(DMat3::IDENTITY, |axis| DMat3::from_axis_angle(axis, angle));
        Self { rotation: orthonormal(rotation * self.rotation), translation: self.translation + shift }
    }

    /// Where the camera stands in the world.
    pub fn position(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    pub fn pose(&self) -> Result<Pose, PoseError> {
        Pose::new(self.rotation.transpose().as_mat3(), self.position().as_vec3())
    }
}

/// The photograph's camera from a lens and a pose. Errors when the lens's numbers are none of a camera in f32.
pub(super) fn photograph_camera(file: &str, lens: &Lens, pose: Pose) -> Result<PhotographCamera, CameraError> {
    let [width_px, height_px] = lens.size_px;
    let intrinsics = Intrinsics { width_px, height_px, focal_px: lens.focal_px.as_vec2(), center_px: lens.center_px.as_vec2() };
    Ok(PhotographCamera { file: file.to_owned(), camera: Camera::new(intrinsics, pose)?, distortion: lens.distortion })
}

// Normalised image position, x right, y down.
fn pinhole(point: DVec3) -> Option<DVec2> {
    if !(point.z < 0.0) {
        return None;
    }
    Some(DVec2::new(point.x, -point.y) / -point.z)
}

// Gram–Schmidt: hundreds of multiplied turns drift.
fn orthonormal(m: DMat3) -> DMat3 {
    let x = m.x_axis.normalize();
    let z = x.cross(m.y_axis).normalize();
    DMat3::from_cols(x, z.cross(x), z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_derivative_is_the_slope() {
        let distortion = Distortion::new([-0.2, 0.05, 0.002, -0.003]).unwrap();
        let lens = Lens { size_px: [640, 480], focal_px: DVec2::new(500.0, 520.0), center_px: DVec2::new(330.0, 235.0), distortion };
        let rotation = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.7);
        let extrinsics = Extrinsics { rotation, translation: DVec3::new(0.1, -0.2, -2.0) };
        let point = DVec3::new(0.4, 0.3, 0.1);
        let projection = lens.projection(&extrinsics, point).unwrap();
        const H: f64 = 1e-6;
        // Central differences in pixels: rounding 1e-13 / H plus H² · third derivative (about 10³).
        let near = |found: DVec2, plus: Option<DVec2>, minus: Option<DVec2>| {
            (found - (plus.unwrap() - minus.unwrap()) / (2.0 * H)).length() < 1e-6
        };
        for i in 0..Lens::PARAMETERS {
            let at = |h: f64| {
                let mut parameters = lens.parameters();
                parameters[i] += h;
                lens.with_parameters(parameters)?.project(extrinsics.rotation * point + extrinsics.translation)
            };
            assert!(near(projection.by_lens[i], at(H), at(-H)), "lens parameter {i}");
        }
        for i in 0..Extrinsics::PARAMETERS {
            let at = |h: f64| {
                let mut step = [0.0; 6];
                step[i] = h;
                let moved = extrinsics.moved(&step);
                lens.project(moved.rotation * point + moved.translation)
            };
            assert!(near(projection.by_pose[i], at(H), at(-H)), "pose parameter {i}");
        }
    }

    #[test]
    fn the_camera_stands_at_the_origin_of_its_own_space() {
        let rotation = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.7);
        let extrinsics = Extrinsics { rotation, translation: DVec3::new(0.1, -0.2, -2.0) };
        assert!((rotation * extrinsics.position() + extrinsics.translation).length() < 1e-15);
    }

    #[test]
    fn the_photographs_camera_images_a_point_where_the_model_does() {
        let distortion = Distortion::new([-0.2, 0.05, 0.002, -0.003]).unwrap();
        let lens = Lens { size_px: [640, 480], focal_px: DVec2::new(500.0, 520.0), center_px: DVec2::new(330.0, 235.0), distortion };
        let rotation = DMat3::from_euler(glam::EulerRot::XYZ, 0.3, -0.4, 0.7);
        let extrinsics = Extrinsics { rotation, translation: DVec3::new(0.1, -0.2, -2.0) };
        let point = DVec3::new(0.4, 0.3, 0.1);
        let photograph = photograph_camera("a", &lens, extrinsics.pose().unwrap()).unwrap();
        let expected = lens.projection(&extrinsics, point).unwrap().at_px;
        // Unit-sized coordinates in f32 behind a focal length of 500 px.
        assert!((photograph.project(point.as_vec3()).unwrap().as_dvec2() - expected).length() < 1e-3);
        assert!((Lens::of(&photograph).focal_px - lens.focal_px).length() < 1e-4);
    }
}
