//! All poses and, where asked, the lens at once: the sum of squared distances, in pixels, between where points were seen and where the
//! camera images them (bundle adjustment; Triggs et al. 2000). The points themselves are known.

use glam::{DVec2, DVec3};

use super::CalibrationError;
use super::lens::{Extrinsics, Lens};
use crate::fitting::least_squares::{Problem, Rows, Solution};

/// Points seen by several photographs; every one sees all points.
pub(super) struct BoardProblem<'a> {
    /// In the world.
    pub points: &'a [DVec3],
    /// By photograph, in the points' order.
    pub seen_px: &'a [&'a [DVec2]],
    /// Which of the lens's parameters may change.
    pub free: &'a FreeParameters,
}

/// Root mean square distance above which corners are not those of the points at all. 0.5 % of the diagonal: 4 px of 640 × 480. Corners
/// are found to a hundredth of that, and marked by hand to a quarter.
pub(super) fn greatest_rms_px(lens: &Lens) -> f64 {
    0.005 * f64::from(lens.size_px[0]).hypot(f64::from(lens.size_px[1]))
}

/// Indices into [`Lens::parameters`].
pub(super) type FreeParameters = Vec<usize>;

pub(super) fn fixed_lens() -> FreeParameters {
    Vec::new()
}

pub(super) fn free_lens() -> FreeParameters {
    (0..Lens::PARAMETERS).collect()
}

/// Refuses a photograph of another size, and corners that are not as many as the points, or not finite.
pub(super) fn check_corners(file: &str, sizes_px: [[u32; 2]; 2], corners_px: &[DVec2], expected: usize) -> Result<(), CalibrationError> {
    let file = || file.to_owned();
    let [found, of_the_lens] = sizes_px;
    if found != of_the_lens {
        return Err(CalibrationError::Size { found, expected: of_the_lens, file: file() });
    }
    if corners_px.len() != expected {
        return Err(CalibrationError::CornerCount { found: corners_px.len(), expected, file: file() });
    }
    match corners_px.iter().enumerate().find(|(_, p)| !p.is_finite()) {
        Some((corner, &DVec2 { x, y })) => Err(CalibrationError::NotFinite { corner, x, y, file: file() }),
        None => Ok(()),
    }
}

/// Where the points are seen less where they are imaged; None where one is not imaged at all.
pub(super) fn misses<'a>(
    lens: &'a Lens,
    extrinsics: &'a Extrinsics,
    points: &'a [DVec3],
    seen_px: &'a [DVec2],
) -> impl Iterator<Item = Option<DVec2>> + 'a {
    points.iter().zip(seen_px).map(|(&p, seen)| Some(seen - lens.project(extrinsics.rotation * p + extrinsics.translation)?))
}

impl Problem for BoardProblem<'_> {
    type Shared = Lens;
    type Block = Extrinsics;

    fn shared_len(&self) -> usize {
        self.free.len()
    }

    fn block_len(&self) -> usize {
        Extrinsics::PARAMETERS
    }

    fn rows(&self, index: usize, lens: &Lens, extrinsics: &Extrinsics, row: &mut Rows) -> Option<()> {
        let mut by_lens = vec![0.0; self.free.len()];
        for (&point, &seen) in self.points.iter().zip(self.seen_px[index]) {
            let projection = lens.projection(extrinsics, point)?;
            let missed = projection.at_px - seen;
            for axis in 0..2 {
                for (derivative, &parameter) in by_lens.iter_mut().zip(self.free) {
                    *derivative = projection.by_lens[parameter][axis];
                }
                row(missed[axis], &by_lens, &projection.by_pose.map(|d| d[axis]));
            }
        }
        Some(())
    }

    fn shared_moved(&self, lens: &Lens, step: &[f64]) -> Lens {
        let mut parameters = lens.parameters();
        for (&parameter, step) in self.free.iter().zip(step) {
            parameters[parameter] += step;
        }
        // A lens that is none images nothing: a focal length of NaN makes the cost undefined, and the step is refused.
        lens.with_parameters(parameters).unwrap_or(Lens { focal_px: DVec2::NAN, ..*lens })
    }

    fn block_moved(&self, extrinsics: &Extrinsics, step: &[f64]) -> Extrinsics {
        extrinsics.moved(step)
    }
}

// Of exact data there is no noise to tell how sure the answer is; no photograph's corners are known better.
const LEAST_NOISE_PX: f64 = 0.05;

// Deviations beyond which intrinsics are called undetermined: of the focal length, and of the principal point by the image's size.
const GREATEST_DEVIATION: f64 = 0.05;

/// Standard deviations of the lens's parameters by what remains of the corners; zero for those that were not free. Errors when those of
/// focal length or principal point are too large to be called known.
pub(super) fn lens_deviations(
    problem: &BoardProblem,
    solution: &Solution<Lens, Extrinsics>,
) -> Result<[f64; Lens::PARAMETERS], CalibrationError> {
    let lens = &solution.shared;
    let size = problem.free.len();
    let unknowns = size + Extrinsics::PARAMETERS * problem.seen_px.len();
    let left_over = (2 * problem.points.len() * problem.seen_px.len()).saturating_sub(unknowns).max(1) as f64;
    let noise_px = (2.0 * solution.summary.final_cost / left_over).sqrt();
    let mut unit = [0.0; Lens::PARAMETERS];
    for (i, &parameter) in problem.free.iter().enumerate() {
        unit[parameter] = solution.shared_covariance.as_ref().map_or(f64::INFINITY, |c| c[i * size + i].sqrt());
    }
    let [width, height] = lens.size_px.map(f64::from);
    let limits = [
        ("focal length along x", lens.focal_px.x),
        ("focal length along y", lens.focal_px.y),
        ("principal point x", width),
        ("principal point y", height),
    ];
    for ((parameter, scale), unit) in limits.into_iter().zip(unit) {
        let (deviation, limit) = (unit * noise_px.max(LEAST_NOISE_PX), GREATEST_DEVIATION * scale);
        if !(deviation <= limit) {
            return Err(CalibrationError::Undetermined { parameter, deviation, limit });
        }
    }
    Ok(unit.map(|u| u * noise_px))
}
