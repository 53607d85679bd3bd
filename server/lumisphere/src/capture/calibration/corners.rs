//! Points where four squares meet: saddles of brightness around which it goes dark, bright, dark, bright.
//!
//! Found as maxima of −det of the Hessian of the blurred image (Beaudet 1978; a checkerboard's corner is its only strong saddle), proved by
//! the four changes on a ring, and placed to a few hundredths of a pixel where the gradients around all point past them (Förstner and
//! Gülch 1987).

use glam::{DMat2, DVec2};

use super::grey::Grey;

/// Such a point; pixel centres at whole numbers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Corner {
    pub at: DVec2,
    /// The four edges that leave it, by growing angle (x right, y down).
    pub edges: [Edge; 4],
}

/// A square's edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edge {
    /// Direction from the corner, radians in (−π, π].
    pub angle: f64,
    /// Past it, by angle, it gets bright (else dark).
    pub rising: bool,
}

impl Edge {
    pub fn direction(&self) -> DVec2 {
        DVec2::from_angle(self.angle)
    }
}

// Blur before derivatives, in pixels: less sees noise, more merges the corners of small squares.
const BLUR_PX: f64 = 1.5;

// Radii of the ring; the second is for small squares.
const RING_PX: [f64; 2] = [5.0, 3.5];

// Half the side of the window in which a corner is placed here; callers that know the squares' size place it again.
const WINDOW_PX: f64 = 4.0;

/// Corners of squares at least some 8 pixels wide, the strongest first.
pub(super) fn find_corners(grey: &Grey) -> Vec<Corner> {
    // More saddles than this are texture; the ring test is what costs.
    const MOST_SADDLES: usize = 6000;
    if grey.width < 16 || grey.height < 16 {
        return Vec::new();
    }
    let (blurred, smooth) = (grey.blurred(BLUR_PX), smoothed(grey));
    let mut saddles = saddles(&blurred);
    saddles.sort_by(|a, b| b.0.total_cmp(&a.0));
    saddles.truncate(MOST_SADDLES);
    let mut corners: Vec<Corner> = Vec::new();
    for (_, at) in saddles {
        let Some(edges) = RING_PX.iter().find_map(|&radius| ring(&smooth, at, radius)) else { continue };
        let Some(at) = placed(&smooth, at, WINDOW_PX) else { continue };
        if !corners.iter().any(|known| known.at.distance(at) < 2.0) {
            corners.push(Corner { at, edges });
        }
    }
    corners
}

// Strength and place of the local maxima of −det of the Hessian.
fn saddles(blurred: &Grey) -> Vec<(f32, DVec2)> {
    // Of squares of the full range; the ring test asks for real contrast.
    const LEAST_STRENGTH: f32 = 1e-6;
    const NEIGHBOURS: isize = 2;
    let (width, height) = (blurred.width, blurred.height);
    let strength = strengths(blurred);
    let margin = NEIGHBOURS as usize + 1;
    let mut found = Vec::new();
    for row in margin..height - margin {
        for column in margin..width - margin {
            let own = strength[row * width + column];
            let near = |dr: isize, dc: isize| strength[(row as isize + dr) as usize * width + (column as isize + dc) as usize];
            // Of equal neighbours the first in reading order wins.
            let beaten = |dr: isize, dc: isize| near(dr, dc) > own || (near(dr, dc) == own && (dr, dc) < (0, 0));
            let around = || (-NEIGHBOURS..=NEIGHBOURS).flat_map(|dr| (-NEIGHBOURS..=NEIGHBOURS).map(move |dc| (dr, dc)));
            if own > LEAST_STRENGTH && !around().any(|(dr, dc)| (dr, dc) != (0, 0) && beaten(dr, dc)) {
                found.push((own, DVec2::new(column as f64, row as f64)));
            }
        }
    }
    found
}

fn strengths(blurred: &Grey) -> Vec<f32> {
    let (width, height) = (blurred.width, blurred.height);
    let mut strength = vec![0.0; width * height];
    for row in 1..height - 1 {
        for column in 1..width - 1 {
            let v = |dc: isize, dr: isize| blurred.at((column as isize + dc) as usize, (row as isize + dr) as usize);
            let xx = v(1, 0) - 2.0 * v(0, 0) + v(-1, 0);
            let yy = v(0, 1) - 2.0 * v(0, 0) + v(0, -1);
            let xy = 0.25 * (v(1, 1) - v(-1, 1) - v(1, -1) + v(-1, -1));
            strength[row * width + column] = (xy * xy - xx * yy) as f32;
        }
    }
    strength
}

// The four edges on a ring around a corner. None where brightness does not change exactly four times, clearly, into opposite directions.
fn ring(smooth: &Grey, at: DVec2, radius: f64) -> Option<[Edge; 4]> {
    const SAMPLES: usize = 48;
    // Between the means of the bright and of the dark part, of the full range. Half of it is still four times what noise of 5 % shows.
    const LEAST_CONTRAST: f64 = 0.06;
    const MOST_BEND: f64 = 0.45;
    let angle = |i: f64| std::f64::consts::TAU * i / SAMPLES as f64 - std::f64::consts::PI;
    let sample = |i: usize| smooth.between(at + radius * DVec2::from_angle(angle(i as f64)));
    let values: Vec<f64> = (0..SAMPLES).map(sample).collect::<Option<_>>()?;
    let (least, greatest) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, g), &v| (l.min(v), g.max(v)));
    let middle = 0.5 * (least + greatest);
    let (bright, dark): (Vec<f64>, Vec<f64>) = values.iter().partition(|&&v| v > middle);
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    if !(mean(&bright) - mean(&dark) > LEAST_CONTRAST) {
        return None;
    }
    let mut edges = Vec::with_capacity(4);
    for i in 0..SAMPLES {
        let (a, b) = (values[i] - middle, values[(i + 1) % SAMPLES] - middle);
        if (a > 0.0) != (b > 0.0) {
            edges.push(Edge { angle: angle(i as f64 + a / (a - b)), rising: b > 0.0 });
        }
    }
    let edges: [Edge; 4] = edges.try_into().ok()?;
    let straight = |i: usize| (edges[i + 2].angle - edges[i].angle - std::f64::consts::PI).abs() < MOST_BEND;
    (straight(0) && straight(1)).then_some(edges)
}

/// What [`placed`] wants: differences of neighbouring pixels of a sharp edge depend on where it lies between them. Measured on rendered
/// boards: a blur of one pixel takes the error from 0.05–0.08 to 0.03–0.04 px.
pub(super) fn smoothed(grey: &Grey) -> Grey {
    const SIGMA_PX: f64 = 1.0;
    grey.blurred(SIGMA_PX)
}

/// The point near `from` that every gradient in a window of half side `half_px` around it stands square to. None when the window leaves
/// the image, has no two edges, or the point leaves the window.
pub(super) fn placed(grey: &Grey, from: DVec2, half_px: f64) -> Option<DVec2> {
    const MOST_STEPS: usize = 40;
    const STILL_PX: f64 = 1e-4;
    let mut at = from;
    for _ in 0..MOST_STEPS {
        let next = square_to_gradients(grey, at, half_px)?;
        if !(next.distance(from) <= half_px) {
            return None;
        }
        let moved = next.distance(at);
        at = next;
        if moved < STILL_PX {
            return Some(at);
        }
    }
    // Wandering between two pixels' interpolation by less than this is placed well enough.
    let last = square_to_gradients(grey, at, half_px)?;
    (last.distance(at) < 0.01).then_some(at)
}

fn square_to_gradients(grey: &Grey, at: DVec2, half_px: f64) -> Option<DVec2> {
    let reach = half_px.ceil() as isize;
    let (mut matrix, mut right) = (DMat2::ZERO, DVec2::ZERO);
    for row in -reach..=reach {
        for column in -reach..=reach {
            let offset = DVec2::new(column as f64, row as f64);
            // Weight falls to e⁻² at the window's middle of side; at the very corner a blurred edge tells nothing, but weighs little.
            let weight = (-2.0 * (offset / half_px).length_squared()).exp();
            let p = at + offset;
            let slope = |d: DVec2| Some(grey.between(p + d)? - grey.between(p - d)?);
            let gradient = 0.5 * DVec2::new(slope(DVec2::X)?, slope(DVec2::Y)?);
            let outer = DMat2::from_cols(gradient * gradient.x, gradient * gradient.y) * weight;
            matrix += outer;
            right += outer * p;
        }
    }
    // Two edges that meet: the smaller eigenvalue is a good part of the larger.
    const LEAST_SPREAD: f64 = 1e-3;
    let trace = matrix.x_axis.x + matrix.y_axis.y;
    (matrix.determinant() > LEAST_SPREAD * trace * trace).then(|| matrix.inverse() * right)
}
