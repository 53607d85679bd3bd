//! The pose of each photograph of a rectangular surface, from its four corners in the photograph.
//!
//! Four corners of a plane have two poses that image them nearly alike when perspective is weak. Both are kept. Which is meant is decided
//! by the corners where they can (against the noise that all photographs show), else by a hint of where the camera stood, else not: the
//! photograph says [`DecidedBy::Nothing`] and the better fitting pose is given with its rival.

use glam::{DVec2, DVec3};

use super::lens::{Extrinsics, photograph_camera};
use super::planar_pose::{PlanarPose, planar_poses};
use super::refine::{BoardProblem, check_corners, fixed_lens, free_lens, greatest_rms_px, lens_deviations};
use super::{CalibrationError, Lens};
use crate::fitting::least_squares::{Summary, minimise};
use crate::geometry::PhotographCamera;

/// A flat rectangle in the world's plane z = 0, seen from z > 0: corners (0, 0), (width, 0), (width, height), (0, height), x right, y up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    width: f64,
    height: f64,
}

/// A photograph in which the surface's corners are marked.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkedPhotograph {
    /// The photograph's name.
    pub file: String,
    /// Its width and height: the lens's.
    pub size_px: [u32; 2],
    /// The four corners in the surface's order: counter-clockwise as one looks at it. Pixel centres at half integers, y down.
    pub corners_px: Vec<DVec2>,
    /// About where the camera stood, in the surface's space, if known (from the capture plan, or from the photograph before).
    pub near: Option<DVec3>,
}

/// Whether the lens is taken as given or refined with the poses. Four corners a photograph tell little of a lens: refine only with many
/// photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensUse {
    /// Only poses are adjusted.
    Fixed,
    /// Focal length and principal point are adjusted with the poses; distortion stays.
    RefinePinhole,
    /// Distortion too.
    RefineAll,
}

/// What decided between a photograph's two poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DecidedBy {
    /// There is one.
    OnlyPose,
    /// Its corners: the other pose misses them by more than the photographs' noise explains.
    Corners,
    /// The hint.
    Hint,
    /// Nothing: both explain the corners.
    Nothing,
}

/// A photograph with its pose.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedPhotograph {
    /// World space is the surface's.
    pub camera: PhotographCamera,
    /// Root mean square distance between the corners and their images.
    pub rms_px: f64,
    /// Why this pose.
    pub decided_by: DecidedBy,
    /// The other pose and its root mean square distance.
    pub rival: Option<(PhotographCamera, f64)>,
}

/// Every photograph's pose, and the lens they share.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedPhotographs {
    /// In the order given.
    pub photographs: Vec<PosedPhotograph>,
    /// As given, or refined.
    pub lens: Lens,
    /// Standard deviation of each of [`Lens::parameters`]; zero where it was taken as given.
    pub deviations: [f64; Lens::PARAMETERS],
    /// Root mean square distance over all corners.
    pub rms_px: f64,
    /// Of the adjustment.
    pub summary: Summary,
}

impl Surface {
    /// In the unit that the poses are wanted in.
    pub fn new(width: f64, height: f64) -> Result<Self, CalibrationError> {
        let positive = width > 0.0 && height > 0.0 && width.is_finite() && height.is_finite();
        if positive { Ok(Self { width, height }) } else { Err(CalibrationError::Surface { width, height }) }
    }

    /// Its corners in order.
    pub fn corners(&self) -> [DVec2; 4] {
        [DVec2::ZERO, DVec2::new(self.width, 0.0), DVec2::new(self.width, self.height), DVec2::new(0.0, self.height)]
    }
}

/// The poses, adjusted together with the lens where asked. `noise_px` is the standard deviation of a marked corner along an axis, if known
/// (a tenth of a pixel where corners were found, one where a hand marked them); otherwise what the better poses leave tells it, with
/// half a pixel to start from.
///
/// Errors: no photograph, or one of another size than the lens's; corners missing, not finite, in the wrong order, of no rectangle, or of another; a lens that the photographs
/// do not determine.
pub fn pose_photographs(
    lens: &Lens,
    surface: &Surface,
    photographs: &[MarkedPhotograph],
    lens_use: LensUse,
    noise_px: Option<f64>,
) -> Result<PosedPhotographs, CalibrationError> {
    if photographs.is_empty() {
        return Err(CalibrationError::TooFewPhotographs { found: 0, least: 1 });
    }
    let plane = surface.corners();
    for photograph in photographs {
        check(lens, photograph)?;
    }
    let all_poses = |lens: &Lens| photographs.iter().map(|p| poses_of(lens, &plane, p)).collect::<Result<Vec<_>, _>>();
    let poses = all_poses(lens)?;
    let chosen = decided(photographs, &poses, noise_px);
    let (refined, deviations, summary) = adjusted(lens, &plane, photographs, &poses, &chosen, lens_use)?;
    // A refined lens is what the other photographs say of a doubtful one: both of its poses are judged again.
    let (poses, chosen) = if refined == *lens {
        (poses, chosen)
    } else {
        let poses = all_poses(&refined)?;
        let chosen = decided(photographs, &poses, noise_px);
        (poses, chosen)
    };
    let lens = refined;
    let posed =
        photographs.iter().zip(&poses).zip(chosen).map(|((photograph, poses), (which, by))| posed(&lens, photograph, poses, which, by));
    let posed = posed.collect::<Result<Vec<_>, _>>()?;
    let rms_px = (posed.iter().map(|p| p.rms_px * p.rms_px).sum::<f64>() / posed.len() as f64).sqrt();
    Ok(PosedPhotographs { photographs: posed, lens, deviations, rms_px, summary })
}

fn check(lens: &Lens, photograph: &MarkedPhotograph) -> Result<(), CalibrationError> {
    let MarkedPhotograph { file, size_px, corners_px, .. } = photograph;
    check_corners(file, [*size_px, lens.size_px], corners_px, 4)?;
    // Turn at each corner; y runs down, so counter-clockwise is negative.
    let corner = |i: usize| corners_px[i % 4];
    let turn = |i: usize| (corner(i + 1) - corner(i)).perp_dot(corner(i + 2) - corner(i + 1));
    let turns: [f64; 4] = std::array::from_fn(turn);
    if turns.iter().all(|&t| t > 0.0) {
        return Err(CalibrationError::Clockwise { file: file.clone() });
    }
    if turns.iter().all(|&t| t < 0.0) { Ok(()) } else { Err(CalibrationError::NoRectangle { file: file.clone() }) }
}

fn poses_of(lens: &Lens, plane: &[DVec2], photograph: &MarkedPhotograph) -> Result<Vec<PlanarPose>, CalibrationError> {
    planar_poses(lens, plane, &photograph.corners_px).ok_or_else(|| CalibrationError::NoPose { file: photograph.file.clone() })
}

// Which of each photograph's poses is meant, and why.
fn decided(photographs: &[MarkedPhotograph], poses: &[Vec<PlanarPose>], noise_px: Option<f64>) -> Vec<(usize, DecidedBy)> {
    // Odds of e^8 = 3000 to 1 under normal noise: half the difference of squares in units of the noise's.
    const LEAST_LOG_ODDS: f64 = 8.0;
    // Eight coordinates less six unknowns.
    const LEFT_OVER: f64 = 2.0;
    // What is expected of corners before any is seen, and the coordinates it counts for: what one photograph leaves may be little by luck.
    const USUAL_NOISE_PX: f64 = 0.5;
    const USUAL_COUNT: f64 = 4.0;
    let left_px2: f64 = poses.iter().filter_map(|p| p.first()).map(|best| best.squares_px2).sum();
    let pooled_px2 = (left_px2 + USUAL_COUNT * USUAL_NOISE_PX * USUAL_NOISE_PX) / (LEFT_OVER * poses.len() as f64 + USUAL_COUNT);
    let noise_px2 = noise_px.map_or(pooled_px2, |noise| noise * noise);
    let decide = |(photograph, poses): (&MarkedPhotograph, &Vec<PlanarPose>)| {
        let [best, rival, ..] = poses.as_slice() else { return (0, DecidedBy::OnlyPose) };
        if rival.squares_px2 - best.squares_px2 > 2.0 * LEAST_LOG_ODDS * noise_px2 {
            return (0, DecidedBy::Corners);
        }
        let Some(near) = photograph.near.filter(|n| n.is_finite()) else { return (0, DecidedBy::Nothing) };
        let away = |pose: &PlanarPose| pose.extrinsics.position().distance(near);
        (usize::from(away(rival) < away(best)), DecidedBy::Hint)
    };
    photographs.iter().zip(poses).map(decide).collect()
}

// The lens, refined with the chosen poses where asked.
fn adjusted(
    lens: &Lens,
    plane: &[DVec2],
    photographs: &[MarkedPhotograph],
    poses: &[Vec<PlanarPose>],
    chosen: &[(usize, DecidedBy)],
    lens_use: LensUse,
) -> Result<(Lens, [f64; Lens::PARAMETERS], Summary), CalibrationError> {
    const MOST_ITERATIONS: usize = 200;
    const PINHOLE_PARAMETERS: usize = 4;
    let points: Vec<DVec3> = plane.iter().map(|p| p.extend(0.0)).collect();
    let seen_px: Vec<&[DVec2]> = photographs.iter().map(|p| p.corners_px.as_slice()).collect();
    let mut free = if lens_use == LensUse::Fixed { fixed_lens() } else { free_lens() };
    if lens_use == LensUse::RefinePinhole {
        free.truncate(PINHOLE_PARAMETERS);
    }
    let problem = BoardProblem { points: &points, seen_px: &seen_px, free: &free };
    let start: Vec<Extrinsics> =
        poses.iter().zip(chosen).filter_map(|(poses, (which, _))| poses.get(*which)).map(|pose| pose.extrinsics).collect();
    let solution = minimise(&problem, *lens, start, MOST_ITERATIONS)
        .map_err(|undefined| CalibrationError::NoPose { file: photographs[undefined.block].file.clone() })?;
    let deviations = lens_deviations(&problem, &solution)?;
    Ok((solution.shared, deviations, solution.summary))
}

fn posed(
    lens: &Lens,
    photograph: &MarkedPhotograph,
    poses: &[PlanarPose],
    which: usize,
    decided_by: DecidedBy,
) -> Result<PosedPhotograph, CalibrationError> {
    let file = &photograph.file;
    let result = |pose: &PlanarPose| {
        let rms_px = (pose.squares_px2 / 4.0).sqrt();
        let pose = pose.extrinsics.pose().map_err(|source| CalibrationError::Pose { source, file: file.clone() })?;
        let camera = photograph_camera(file, lens, pose).map_err(|source| CalibrationError::Camera { source, file: file.clone() })?;
        Ok((camera, rms_px))
    };
    let chosen = poses.get(which).ok_or_else(|| CalibrationError::NoPose { file: file.clone() })?;
    let rival = poses.iter().enumerate().find(|(i, _)| *i != which).map(|(_, pose)| result(pose)).transpose()?;
    let (camera, rms_px) = result(chosen)?;
    let limit_px = greatest_rms_px(lens);
    if !(rms_px <= limit_px) {
        return Err(CalibrationError::Misfit { rms_px, limit_px, file: file.clone() });
    }
    Ok(PosedPhotograph { camera, rms_px, decided_by, rival })
}
