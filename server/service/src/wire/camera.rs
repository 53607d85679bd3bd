//! Cameras.

use glam::{Mat3, Vec2, Vec3};
use lumisphere::geometry::{Camera, Intrinsics, Pose};

use super::{proto, required};
use crate::errors::ApiError;

/// A checked camera of at most `max_pixels`; `field` is its path in the request.
pub fn camera(message: Option<proto::Camera>, max_pixels: u64, field: &str) -> Result<Camera, ApiError> {
    let message = required(message, field)?;
    let intrinsics = intrinsics(required(message.intrinsics, &format!("{field}.intrinsics"))?, max_pixels, &format!("{field}.intrinsics"))?;
    let pose = pose(required(message.pose, &format!("{field}.pose"))?, &format!("{field}.pose"))?;
    Camera::new(intrinsics, pose).map_err(|e| ApiError::field(format!("{field}.intrinsics"), e))
}

fn intrinsics(message: proto::Intrinsics, max_pixels: u64, field: &str) -> Result<Intrinsics, ApiError> {
    let proto::Intrinsics { width_px, height_px, focal_x_px, focal_y_px, center_x_px, center_y_px } = message;
    let pixels = u64::from(width_px) * u64::from(height_px);
    if pixels > max_pixels {
        let problem = format!("{width_px}x{height_px} is {pixels} pixels, at most {max_pixels} expected");
        return Err(ApiError::field(format!("{field}.width_px"), problem).with("max_pixels_per_frame", max_pixels));
    }
    let focal_y_px = if focal_y_px == 0.0 { focal_x_px } else { focal_y_px };
    let center_px = Vec2::new(center_x_px.unwrap_or(0.5 * width_px as f32), center_y_px.unwrap_or(0.5 * height_px as f32));
    Ok(Intrinsics { width_px, height_px, focal_px: Vec2::new(focal_x_px, focal_y_px), center_px })
}

fn pose(message: proto::Pose, field: &str) -> Result<Pose, ApiError> {
    let axis = |v: Option<proto::Vector3>, name: &str| required(v, &format!("{field}.{name}")).map(vec3);
    let rotation = Mat3::from_cols(axis(message.right, "right")?, axis(message.up, "up")?, axis(message.backward, "backward")?);
    Pose::new(rotation, axis(message.position, "position")?).map_err(|e| ApiError::field(field, e))
}

/// The camera as used.
pub fn camera_message(camera: &Camera) -> proto::Camera {
    let (i, pose) = (camera.intrinsics(), camera.pose());
    let rotation = pose.rotation();
    proto::Camera {
        pose: Some(proto::Pose {
            position: Some(vector(pose.position())),
            right: Some(vector(rotation.x_axis)),
            up: Some(vector(rotation.y_axis)),
            backward: Some(vector(rotation.z_axis)),
        }),
        intrinsics: Some(proto::Intrinsics {
            width_px: i.width_px,
            height_px: i.height_px,
            focal_x_px: i.focal_px.x,
            focal_y_px: i.focal_px.y,
            center_x_px: Some(i.center_px.x),
            center_y_px: Some(i.center_px.y),
        }),
    }
}

/// Library vector.
pub fn vec3(v: proto::Vector3) -> Vec3 {
    Vec3::new(v.x, v.y, v.z)
}

/// Wire vector.
pub fn vector(v: Vec3) -> proto::Vector3 {
    proto::Vector3 { x: v.x, y: v.y, z: v.z }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message() -> proto::Camera {
        let pose = Pose::look_at(Vec3::new(3.0, 2.0, 5.0), Vec3::ZERO, Vec3::Y).unwrap();
        camera_message(&Camera::new(Intrinsics::from_vfov(40.0, 64, 48).unwrap(), pose).unwrap())
    }

    fn refusal(change: impl FnOnce(&mut proto::Camera)) -> String {
        let mut m = message();
        change(&mut m);
        camera(Some(m), 10_000, "camera").unwrap_err().to_string()
    }

    #[test]
    fn a_camera_survives_the_wire() {
        let back = camera_message(&camera(Some(message()), 10_000, "camera").unwrap());
        assert_eq!(back, message());
    }

    #[test]
    fn defaults_are_square_pixels_and_a_centred_principal_point() {
        let mut m = message();
        let i = m.intrinsics.as_mut().unwrap();
        (i.focal_y_px, i.center_x_px, i.center_y_px) = (0.0, None, None);
        let c = camera(Some(m), 10_000, "camera").unwrap();
        assert_eq!((c.intrinsics().focal_px.y, c.intrinsics().center_px), (c.intrinsics().focal_px.x, Vec2::new(32.0, 24.0)));
    }

    #[test]
    fn what_is_no_camera_is_refused_by_field() {
        assert_eq!(camera(None, 1, "camera").unwrap_err().to_string(), "camera: missing");
        assert!(refusal(|c| c.pose = None).starts_with("camera.pose: missing"));
        assert!(refusal(|c| c.pose.as_mut().unwrap().up = None).starts_with("camera.pose.up: missing"));
        assert!(refusal(|c| c.pose.as_mut().unwrap().position.as_mut().unwrap().y = f32::NAN).contains("not finite"));
        assert!(refusal(|c| c.pose.as_mut().unwrap().right.as_mut().unwrap().x *= 2.0).contains("not rigid"));
        assert!(refusal(|c| c.intrinsics.as_mut().unwrap().width_px = 0).contains("0x48"));
        assert!(refusal(|c| c.intrinsics.as_mut().unwrap().focal_x_px = f32::NAN).contains("not finite"));
        assert!(refusal(|c| c.intrinsics.as_mut().unwrap().width_px = u32::MAX).contains("at most 10000 expected"));
    }
}
