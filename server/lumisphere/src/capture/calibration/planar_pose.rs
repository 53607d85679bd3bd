//! Poses from which a plane looks as it does in a photograph: there are two.
//!
//! After Collins and Bartoli (2014, "Infinitesimal plane-based pose estimation"): the homography's slope at the middle of the points gives
//! the plane's tilt up to the sign of its depth slope. Both solutions are polished on the points themselves and both are kept, because
//! under weak perspective noise decides which fits better. Exactly fronto-parallel the two are one.

use glam::{DMat2, DMat3, DVec2, DVec3};

use super::homography::homography;
use super::lens::{Extrinsics, Lens};
use super::refine::{BoardProblem, fixed_lens};
use crate::fitting::cholesky::Cholesky;
use crate::fitting::least_squares::minimise;

/// One of the poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PlanarPose {
    pub extrinsics: Extrinsics,
    /// Sum of the squared distances between the points' images and where they were seen, in px².
    pub squares_px2: f64,
}

/// The poses, better fitting first: two, or one where both are the same. Points lie in the world's plane z = 0. None when the points are
/// those of no camera in front of them.
pub(super) fn planar_poses(lens: &Lens, plane: &[DVec2], image_px: &[DVec2]) -> Option<Vec<PlanarPose>> {
    let pinhole: Vec<DVec2> = image_px.iter().map(|&p| lens.pinhole_of(p)).collect::<Option<_>>()?;
    let mut poses = Vec::with_capacity(2);
    for start in infinitesimal_poses(plane, &pinhole)? {
        let Some(pose) = polished(lens, plane, image_px, start) else { continue };
        if !poses.iter().any(|known: &PlanarPose| same(&known.extrinsics, &pose.extrinsics)) {
            poses.push(pose);
        }
    }
    poses.sort_by(|a, b| a.squares_px2.total_cmp(&b.squares_px2));
    (!poses.is_empty()).then_some(poses)
}

// Two polished poses that a hundredth of a degree parts are one minimum reached from two sides.
fn same(a: &Extrinsics, b: &Extrinsics) -> bool {
    const SAME_TURN: f64 = 2e-4;
    let apart = a.rotation - b.rotation;
    apart.to_cols_array().iter().all(|e| e.abs() < SAME_TURN)
}

fn polished(lens: &Lens, plane: &[DVec2], image_px: &[DVec2], start: Extrinsics) -> Option<PlanarPose> {
    const MOST_ITERATIONS: usize = 60;
    let points: Vec<DVec3> = plane.iter().map(|p| p.extend(0.0)).collect();
    let problem = BoardProblem { points: &points, seen_px: &[image_px], free: &fixed_lens() };
    let solution = minimise(&problem, *lens, vec![start], MOST_ITERATIONS).ok()?;
    let extrinsics = *solution.blocks.first()?;
    // The polished pose must still be in front.
    (extrinsics.position().z > 0.0).then_some(PlanarPose { extrinsics, squares_px2: 2.0 * solution.summary.final_cost })
}

fn infinitesimal_poses(plane: &[DVec2], pinhole: &[DVec2]) -> Option<[Extrinsics; 2]> {
    let middle = plane.iter().sum::<DVec2>() / plane.len() as f64;
    let centered: Vec<DVec2> = plane.iter().map(|p| p - middle).collect();
    let h = homography(&centered, pinhole)?;
    let h = h * h.z_axis.z.recip();
    let v = DVec2::new(h.z_axis.x, h.z_axis.y);
    // Slope of the map at the middle.
    let column = |c: DVec3| DVec2::new(c.x, c.y) - v * c.z;
    let slope = DMat2::from_cols(column(h.x_axis), column(h.y_axis));
    let turns = turns(v, slope)?;
    // To the camera's axes: y up, looking along −Z.
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let mut poses = [Extrinsics { rotation: DMat3::IDENTITY, translation: DVec3::ZERO }; 2];
    for (pose, rotation) in poses.iter_mut().zip(turns) {
        let translation = shift(&rotation, &centered, pinhole)?;
        let translation = translation - rotation * middle.extend(0.0);
        *pose = Extrinsics { rotation: flip * rotation, translation: flip * translation };
    }
    Some(poses)
}

// Both rotations (x right, y down, z forward) whose plane through image position `v` has that slope of its map.
fn turns(v: DVec2, slope: DMat2) -> Option<[DMat3; 2]> {
    let to_v = glam::DQuat::from_rotation_arc(DVec3::Z, v.extend(1.0).normalize());
    let toward = DMat3::from_quat(to_v);
    let along = |c: DVec3| DVec2::new(c.x, c.y) - v * c.z;
    let scaled = DMat2::from_cols(along(toward.x_axis), along(toward.y_axis)).inverse() * slope;
    // Its larger singular value is the inverse depth; what it lacks of a rotation's columns is their third component.
    let gram = scaled.transpose() * scaled;
    let (sum, difference) = (gram.x_axis.x + gram.y_axis.y, gram.x_axis.x - gram.y_axis.y);
    let gamma = (0.5 * (sum + difference.hypot(2.0 * gram.x_axis.y))).sqrt();
    if !(gamma > 0.0 && gamma.is_finite()) {
        return None;
    }
    let [a, b] = [scaled.x_axis / gamma, scaled.y_axis / gamma];
    // Fronto-parallel these are zero, and rounding must not make them NaN.
    let depth = |c: DVec2| (1.0 - c.length_squared()).max(0.0).sqrt();
    let (p, q) = (depth(a), depth(b) * if a.dot(b) > 0.0 { -1.0 } else { 1.0 });
    let rotation = |sign: f64| {
        let x = a.extend(sign * p).normalize();
        let z = x.cross(b.extend(sign * q)).normalize();
        toward * DMat3::from_cols(x, z.cross(x), z)
    };
    let both = [rotation(1.0), rotation(-1.0)];
    both.iter().all(|r| r.is_finite()).then_some(both)
}

// Translation with least squared error of x (z' ) = x', y (z') = y' at the points, for a given rotation.
fn shift(rotation: &DMat3, centered: &[DVec2], pinhole: &[DVec2]) -> Option<DVec3> {
    let (mut matrix, mut right) = ([0.0; 9], [0.0; 3]);
    for (p, u) in centered.iter().zip(pinhole) {
        let turned = *rotation * p.extend(0.0);
        for (row, value) in [([1.0, 0.0, -u.x], u.x * turned.z - turned.x), ([0.0, 1.0, -u.y], u.y * turned.z - turned.y)] {
            for i in 0..3 {
                right[i] += row[i] * value;
                for j in 0..3 {
                    matrix[3 * i + j] += row[i] * row[j];
                }
            }
        }
    }
    Cholesky::new(&matrix, 3)?.solve(&mut right);
    Some(DVec3::from_array(right))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Distortion;

    const SURFACE: [DVec2; 4] = [DVec2::ZERO, DVec2::new(0.3, 0.0), DVec2::new(0.3, 0.2), DVec2::new(0.0, 0.2)];

    fn lens() -> Lens {
        let distortion = Distortion::new([-0.2, 0.05, 0.001, -0.002]).unwrap();
        Lens { size_px: [1600, 1200], focal_px: DVec2::new(1800.0, 1790.0), center_px: DVec2::new(810.0, 590.0), distortion }
    }

    // From zenith and azimuth in degrees around the surface's middle, looking at it, upright.
    fn camera(zenith: f64, azimuth: f64, distance: f64) -> Extrinsics {
        let (z, a) = (zenith.to_radians(), azimuth.to_radians());
        let toward = DVec3::new(z.sin() * a.cos(), z.sin() * a.sin(), z.cos());
        let up = if zenith == 0.0 { DVec3::Y } else { DVec3::Z };
        let x = up.cross(toward).normalize();
        let rotation = DMat3::from_cols(x, toward.cross(x), toward).transpose();
        Extrinsics { rotation, translation: -(rotation * (DVec3::new(0.15, 0.1, 0.0) + distance * toward)) }
    }

    fn seen(lens: &Lens, camera: &Extrinsics) -> Vec<DVec2> {
        SURFACE.iter().map(|p| lens.projection(camera, p.extend(0.0)).unwrap().at_px).collect()
    }

    #[test]
    fn the_true_pose_fits_best_from_every_side_and_the_other_is_kept() {
        for zenith in [5.0, 20.0, 45.0, 70.0, 85.0] {
            for azimuth in [0.0, 40.0, 130.0, 260.0] {
                let truth = camera(zenith, azimuth, 0.8);
                let poses = planar_poses(&lens(), &SURFACE, &seen(&lens(), &truth)).unwrap();
                let off = (poses[0].extrinsics.position() - truth.position()).length();
                // Exact data: the polish ends at rounding, some 1e-12 px, times the leverage of a flat pose.
                assert!(off < 1e-7, "{zenith}/{azimuth}: {off} m off");
            }
        }
        let poses = planar_poses(&lens(), &SURFACE, &seen(&lens(), &camera(45.0, 40.0, 0.8))).unwrap();
        assert_eq!(poses.len(), 2);
        assert!(poses[1].squares_px2 > 1.0, "the mirrored tilt fits as well: {}", poses[1].squares_px2);
    }

    #[test]
    fn the_closed_form_alone_is_exact_on_exact_corners() {
        let lens = Lens { distortion: Distortion::NONE, ..lens() };
        for azimuth in [0.0, 40.0, 130.0, 260.0] {
            let truth = camera(50.0, azimuth, 0.8);
            let pinhole: Vec<DVec2> = seen(&lens, &truth).iter().map(|&p| lens.pinhole_of(p).unwrap()).collect();
            let off = infinitesimal_poses(&SURFACE, &pinhole).unwrap().map(|pose| pose.position().distance(truth.position()));
            assert!(off[0].min(off[1]) < 1e-9, "{azimuth}°: {off:?}");
            assert!(off[0].max(off[1]) > 0.5, "{azimuth}°: {off:?}");
        }
    }

    #[test]
    fn an_exactly_fronto_parallel_photograph_has_one_pose() {
        for turn in (0..360).step_by(5).map(f64::from) {
            let straight = camera(0.0, 0.0, 0.8);
            let turned = DMat3::from_rotation_z(turn.to_radians());
            let truth = Extrinsics { rotation: turned * straight.rotation, translation: turned * straight.translation };
            for lens in [lens(), Lens { distortion: Distortion::NONE, ..lens() }] {
                let poses = planar_poses(&lens, &SURFACE, &seen(&lens, &truth)).unwrap();
                // Its tilt is only quadratic in the residual, so rounding of 1e-12 px leaves 1e-6 of it and less.
                assert!((poses[0].extrinsics.position() - truth.position()).length() < 1e-5, "turned by {turn}°");
            }
        }
    }

    #[test]
    fn corners_in_mirrored_order_have_no_pose_in_front() {
        let mut image = seen(&lens(), &camera(30.0, 40.0, 0.8));
        image.reverse();
        assert_eq!(planar_poses(&lens(), &SURFACE, &image), None);
        image.swap(0, 1);
        assert_eq!(planar_poses(&lens(), &SURFACE, &image), None);
    }
}
