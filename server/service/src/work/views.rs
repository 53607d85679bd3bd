//! Cameras of jobs.

use glam::Vec3;
use lumisphere::geometry::{Camera, Intrinsics, Pose};

use crate::catalog::OpenedVersion;
use crate::errors::{ApiError, Reason};
use crate::wire::jobs::{Orbit, Views};

/// The cameras themselves. An orbit needs the object's bounds, which a version that was captured here has.
pub fn cameras(views: &Views, version: &OpenedVersion) -> Result<Vec<Camera>, ApiError> {
    match views {
        Views::Cameras(cameras) => Ok(cameras.clone()),
        Views::Orbit(orbit) => {
            let bounds = version.origin.as_ref().and_then(|o| o.bounds()).ok_or_else(|| {
                let message =
                    format!("dataset {} version {} does not say where its object is; give cameras", version.dataset, version.version);
                ApiError::new(Reason::DatasetKindMismatch, message)
            })?;
            orbit_cameras(orbit, bounds)
        }
    }
}

fn orbit_cameras(orbit: &Orbit, (low, high): (Vec3, Vec3)) -> Result<Vec<Camera>, ApiError> {
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
    let invalid = |e: &dyn std::fmt::Display| ApiError::field("orbit", e);
    let intrinsics = Intrinsics::from_vfov(orbit.vfov_deg, orbit.width_px, orbit.height_px).map_err(|e| invalid(&e))?;
    let elevation = orbit.elevation_deg.to_radians();
    (0..orbit.count)
        .map(|i| {
            let azimuth = orbit.azimuth_deg.to_radians() + std::f32::consts::TAU * i as f32 / orbit.count as f32;
            let toward = Vec3::new(azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos());
            let pose = Pose::look_at(center + orbit.distance_radii * radius * toward, center, Vec3::Y).map_err(|e| invalid(&e))?;
            Camera::new(intrinsics, pose).map_err(|e| invalid(&e))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_orbit_looks_at_the_object_from_its_distance_beginning_at_plus_z() {
        let orbit =
            Orbit { count: 4, width_px: 64, height_px: 48, vfov_deg: 40.0, elevation_deg: 0.0, distance_radii: 2.0, azimuth_deg: 0.0 };
        let cameras = orbit_cameras(&orbit, (Vec3::new(0.0, 1.0, 1.0), Vec3::new(2.0, 3.0, 3.0))).unwrap();
        let (center, distance) = (Vec3::new(1.0, 2.0, 2.0), 2.0 * 3f32.sqrt());
        let expected = [Vec3::Z, Vec3::X, Vec3::NEG_Z, Vec3::NEG_X];
        assert_eq!(cameras.len(), 4);
        for (camera, toward) in cameras.iter().zip(expected) {
            // f32 sine and cosine of quarter turns: a few ULP of a distance of about three.
            assert!((camera.pose().position() - (center + distance * toward)).length() < 1e-5);
            assert!((camera.project(center).unwrap() - glam::Vec2::new(32.0, 24.0)).length() < 1e-3);
        }
    }
}
