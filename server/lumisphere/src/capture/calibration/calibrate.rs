//! The lens and every pose from photographs of a checkerboard (Zhang 2000, §3): a first lens in closed form, a pose per photograph, then
//! everything at once by least squares on the corners.

use glam::{DVec2, DVec3};

use super::homography::homography;
use super::lens::{Extrinsics, photograph_camera};
use super::planar_pose::planar_poses;
use super::refine::{BoardProblem, check_corners, free_lens, greatest_rms_px, lens_deviations, misses};
use super::start::lens_candidates;
use super::{BoardPhotograph, CalibrationError, Checkerboard, Lens};
use crate::fitting::least_squares::{Solution, Summary, minimise};
use crate::geometry::PhotographCamera;

/// Least number of photographs of the board: two leave no equation over.
pub const LEAST_PHOTOGRAPHS: usize = 3;

/// A lens, the poses of the photographs it was found from, and how well both explain the corners.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// What all photographs share.
    pub lens: Lens,
    /// Standard deviation of each of [`Lens::parameters`], from what remains of the corners.
    pub deviations: [f64; Lens::PARAMETERS],
    /// In the order given.
    pub photographs: Vec<CalibratedPhotograph>,
    /// Root mean square distance between corners and their images, over all photographs (OpenCV's definition).
    pub rms_px: f64,
    /// Of the last minimisation.
    pub summary: Summary,
}

/// One photograph of the board.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedPhotograph {
    /// World space is the board's.
    pub camera: PhotographCamera,
    /// Root mean square distance over its corners.
    pub rms_px: f64,
}

/// Finds the lens. Every photograph must show all corners, in the board's order.
///
/// Errors: fewer than three photographs, photographs of different sizes, wrong or non-finite corners, corners that no camera sees like that, photographs that do not
/// determine the intrinsics (all from about the same tilt), and no lens that leaves less than 0.5 % of the diagonal.
pub fn calibrate(board: &Checkerboard, photographs: &[BoardPhotograph]) -> Result<Calibration, CalibrationError> {
    let size_px = checked_size(board, photographs)?;
    let plane = board.corners();
    let points: Vec<DVec3> = plane.iter().map(|p| p.extend(0.0)).collect();
    let seen_px: Vec<&[DVec2]> = photographs.iter().map(|p| p.corners_px.as_slice()).collect();
    for (photograph, seen) in photographs.iter().zip(&seen_px) {
        let map = homography(&plane, seen).ok_or_else(|| CalibrationError::NoRectangle { file: photograph.file.clone() })?;
        // The board's y runs up, the image's down.
        if map.determinant() > 0.0 {
            return Err(CalibrationError::Clockwise { file: photograph.file.clone() });
        }
    }
    let candidates = lens_candidates(size_px, &plane, &seen_px)
        .map_err(|view| CalibrationError::NoRectangle { file: photographs[view].file.clone() })?;
    let free = free_lens();
    let problem = BoardProblem { points: &points, seen_px: &seen_px, free: &free };
    let mut best: Option<Solution<Lens, Extrinsics>> = None;
    for lens in candidates {
        let Some(solution) = refined(&problem, &plane, lens) else { continue };
        if best.as_ref().is_none_or(|b| solution.summary.final_cost < b.summary.final_cost) {
            best = Some(solution);
        }
    }
    let solution = best.ok_or(CalibrationError::Undetermined { parameter: "focal length", deviation: f64::INFINITY, limit: 0.0 })?;
    reported(&problem, photographs, solution)
}

// The size of all photographs.
fn checked_size(board: &Checkerboard, photographs: &[BoardPhotograph]) -> Result<[u32; 2], CalibrationError> {
    let too_few = CalibrationError::TooFewPhotographs { found: photographs.len(), least: LEAST_PHOTOGRAPHS };
    let [first, _, _, ..] = photographs else { return Err(too_few) };
    for photograph in photographs {
        check_corners(&photograph.file, [photograph.size_px, first.size_px], &photograph.corners_px, board.corner_count())?;
    }
    Ok(first.size_px)
}

fn refined(problem: &BoardProblem, plane: &[DVec2], lens: Lens) -> Option<Solution<Lens, Extrinsics>> {
    const MOST_ITERATIONS: usize = 200;
    // Of a photograph's two poses the better fitting one. A first lens without distortion could choose wrongly, but in 268 synthetic sets of
    // weak perspective and strong distortion it never did.
    let pose = |seen: &&[DVec2]| planar_poses(&lens, plane, seen)?.first().map(|pose| pose.extrinsics);
    let poses: Vec<Extrinsics> = problem.seen_px.iter().map(pose).collect::<Option<_>>()?;
    minimise(problem, lens, poses, MOST_ITERATIONS).ok()
}

fn reported(
    problem: &BoardProblem,
    photographs: &[BoardPhotograph],
    solution: Solution<Lens, Extrinsics>,
) -> Result<Calibration, CalibrationError> {
    let lens = solution.shared;
    let corners = (problem.points.len() * photographs.len()) as f64;
    let squares_px2 = 2.0 * solution.summary.final_cost;
    let rms_px = (squares_px2 / corners).sqrt();
    let mut calibrated = Vec::with_capacity(photographs.len());
    for (photograph, extrinsics) in photographs.iter().zip(&solution.blocks) {
        let file = &photograph.file;
        let pose = extrinsics.pose().map_err(|source| CalibrationError::Pose { source, file: file.clone() })?;
        let camera = photograph_camera(file, &lens, pose).map_err(|source| CalibrationError::Camera { source, file: file.clone() })?;
        let squares: f64 = misses(&lens, extrinsics, problem.points, &photograph.corners_px).flatten().map(|d| d.length_squared()).sum();
        calibrated.push(CalibratedPhotograph { camera, rms_px: (squares / problem.points.len() as f64).sqrt() });
    }
    let limit_px = greatest_rms_px(&lens);
    if !(rms_px <= limit_px) {
        let worst = calibrated.iter().max_by(|a, b| a.rms_px.total_cmp(&b.rms_px));
        let file = worst.map_or(String::new(), |p| p.camera.file.clone());
        return Err(CalibrationError::Misfit { rms_px, limit_px, file });
    }
    let deviations = lens_deviations(problem, &solution)?;
    Ok(Calibration { lens, deviations, photographs: calibrated, rms_px, summary: solution.summary })
}
