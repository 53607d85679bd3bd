//! Makes a fitted function not negative over the hemisphere, at the least cost in the fit's own quadratic form.
//!
//! Minimises (c − ĉ)ᵀ H (c − ĉ) where yᵢ(d)·c ≥ a small margin for directions d, ĉ being the free fit and H its normal equations: Hildreth's dual
//! coordinate ascent (1957) on a growing set of directions. They are the function's own minima, sought from the lowest of a fixed set about
//! 4° apart. What is left after the last round is faded toward the mean.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};
use pulp::Arch;

use super::Basis;
use crate::directions::{Harmonics, Scheme, icosphere};
use crate::fitting::cholesky::dot;

/// Least λ of the form that changes are measured in: below it, what the samples leave open would be changed at no cost, which is neither wanted nor
/// quick.
pub(super) const LEAST_LAMBDA: f64 = 1e-5;
/// Minima are lifted to this share of the mean: half floats round by less, and the search stops a little beside a minimum.
const MARGIN: f64 = 5e-3;
/// Minima are sought where the function is below this share of the mean.
const LOW: f64 = 0.15;
/// Rounds of adding minima.
const MOST_ROUNDS: usize = 24;
/// Minima a round.
const MOST_MINIMA: usize = 12;
/// Passes over the active directions a round.
const MOST_SWEEPS: usize = 100;
/// Directions on the horizon, which no set of directions above it checks.
const ON_HORIZON: usize = 72;
/// Directions evaluated at a time.
const LANES: usize = 16;

/// The functions' values toward the checked directions.
#[derive(Debug, Clone)]
pub(super) struct Checked {
    harmonics: Harmonics,
    /// Points of the sphere on which the functions are smooth: see [`direction`].
    points: Vec<Vec3>,
    /// `values[functions · (point / LANES) + function][point % LANES]`.
    values: Vec<[f32; LANES]>,
}

/// A point at which the function is held: y, H⁻¹ y and yᵀ H⁻¹ y.
struct Active {
    row: Vec<f64>,
    response: Vec<f64>,
    gain: f64,
}

/// A point where the function is lowest nearby.
struct Minimum {
    point: Vec3,
    row: Vec<f64>,
    value: f64,
}

impl Checked {
    pub(super) fn new(harmonics: Harmonics) -> Self {
        let points = points(harmonics.basis());
        let functions = harmonics.functions();
        let mut values = vec![[0f32; LANES]; functions * points.len().div_ceil(LANES)];
        for (at, point) in points.iter().enumerate() {
            for (lanes, value) in values[functions * (at / LANES)..].iter_mut().zip(row(harmonics, *point)) {
                lanes[at % LANES] = value as f32;
            }
        }
        Self { harmonics, points, values }
    }

    /// Changes each channel's coefficients until the function is not negative; `solve` applies H⁻¹ in place.
    pub(super) fn lift(&self, channels: &mut [Vec<f64>; 3], solve: impl Fn(&mut [f64])) {
        let mut active: Vec<Active> = Vec::new();
        for coefficients in channels {
            self.lift_channel(coefficients, &mut active, &solve);
        }
    }

    fn lift_channel(&self, coefficients: &mut [f64], active: &mut Vec<Active>, solve: &impl Fn(&mut [f64])) {
        let mut multipliers = vec![0.0; active.len()];
        let mut values = self.evaluate(coefficients);
        let mean = values.iter().map(|&value| f64::from(value)).sum::<f64>() / values.len() as f64;
        if !(mean > 0.0) {
            // Nothing but zero is not negative and near.
            coefficients.fill(0.0);
            return;
        }
        let margin = MARGIN * mean;
        for _ in 0..MOST_ROUNDS {
            let mut minima = self.minima(coefficients, &values, LOW * mean);
            minima.retain(|minimum| minimum.value < 0.5 * margin);
            if minima.is_empty() {
                return;
            }
            active.extend(minima.into_iter().filter_map(|minimum| Active::new(minimum, solve)));
            multipliers.resize(active.len(), 0.0);
            ascend(coefficients, active, &mut multipliers, margin);
            values = self.evaluate(coefficients);
        }
        let least = self.minima(coefficients, &values, LOW * mean).iter().fold(0.0, |least: f64, minimum| least.min(minimum.value));
        self.fade(coefficients, mean, least);
    }

    /// The lowest minima, sought from the lowest checked points that are below `low` and not close to each other.
    fn minima(&self, coefficients: &[f64], values: &[f32], low: f64) -> Vec<Minimum> {
        // A minimum between two maxima of degree 9 is 20° wide.
        const NEAR: f32 = 0.985;
        let mut lowest: Vec<usize> = (0..values.len()).filter(|&at| f64::from(values[at]) < low).collect();
        lowest.sort_by(|&a, &b| values[a].total_cmp(&values[b]).then(a.cmp(&b)));
        let mut starts: Vec<Vec3> = Vec::new();
        for point in lowest.into_iter().map(|at| self.points[at]) {
            if starts.len() < MOST_MINIMA && starts.iter().all(|other| other.dot(point) <= NEAR) {
                starts.push(point);
            }
        }
        starts.into_iter().map(|start| self.descend(coefficients, start)).collect()
    }

    /// Pattern search: six neighbours, at steps that are halved from 2° to 1/4° when none is lower.
    fn descend(&self, coefficients: &[f64], start: Vec3) -> Minimum {
        let at = |point: Vec3| {
            let row = row(self.harmonics, point);
            Minimum { point, value: dot(&row, coefficients), row }
        };
        let mut best = at(start);
        let mut step = 2f32.to_radians();
        for _ in 0..12 {
            let (s, t) = best.point.any_orthonormal_pair();
            let neighbour = |k: usize| {
                let offset = step * Vec2::from_angle(TAU * k as f32 / 6.0);
                self.inside(best.point + offset.x * s + offset.y * t)
            };
            let lower = (0..6).map(|k| at(neighbour(k))).fold(None, |lowest: Option<Minimum>, next| match lowest {
                Some(lowest) if !(next.value < lowest.value) => Some(lowest),
                _ => Some(next),
            });
            match lower {
                Some(lower) if lower.value < best.value => best = lower,
                _ if step < 0.3f32.to_radians() => break,
                _ => step *= 0.5,
            }
        }
        best
    }

    /// The nearest point that stands for a direction not below the horizon.
    fn inside(&self, point: Vec3) -> Vec3 {
        match self.harmonics.basis() {
            Basis::Hemispherical => point.normalize(),
            Basis::Spherical => point.with_z(point.z.max(0.0)).normalize(),
        }
    }

    /// The function toward every checked direction.
    fn evaluate(&self, coefficients: &[f64]) -> Vec<f32> {
        let coefficients: Vec<f32> = coefficients.iter().map(|&c| c as f32).collect();
        let mut values = Vec::with_capacity(self.points.len() + LANES);
        Arch::new().dispatch(Evaluate { blocks: &self.values, coefficients: &coefficients, values: &mut values });
        values.truncate(self.points.len());
        values
    }

    /// Toward the mean, just so far that the least value is lifted to zero.
    fn fade(&self, coefficients: &mut [f64], mean: f64, least: f64) {
        let constant = row(self.harmonics, Vec3::Z)[0];
        let kept = mean / (mean - least);
        coefficients.iter_mut().for_each(|c| *c *= kept);
        coefficients[0] += (1.0 - kept) * mean / constant;
    }
}

impl Active {
    fn new(minimum: Minimum, solve: &impl Fn(&mut [f64])) -> Option<Self> {
        let mut response = minimum.row.clone();
        solve(&mut response);
        let gain = dot(&minimum.row, &response);
        (gain > 0.0).then_some(Self { row: minimum.row, response, gain })
    }
}

/// Appends the values of a sum of functions, block by block.
struct Evaluate<'a> {
    blocks: &'a [[f32; LANES]],
    coefficients: &'a [f32],
    values: &'a mut Vec<f32>,
}

impl pulp::NullaryFnOnce for Evaluate<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for block in self.blocks.chunks_exact(self.coefficients.len()) {
            let mut sums = [0f32; LANES];
            for (lanes, c) in block.iter().zip(self.coefficients) {
                for lane in 0..LANES {
                    sums[lane] += lanes[lane] * c;
                }
            }
            self.values.extend_from_slice(&sums);
        }
    }
}

/// Hildreth: each active direction in turn is brought to the margin, its multiplier staying ≥ 0, until no value moves.
fn ascend(coefficients: &mut [f64], active: &[Active], multipliers: &mut [f64], margin: f64) {
    for _ in 0..MOST_SWEEPS {
        let mut moved = 0f64;
        for (active, multiplier) in active.iter().zip(multipliers.iter_mut()) {
            let missing = (margin - dot(&active.row, coefficients)) / active.gain;
            let step = missing.max(-*multiplier);
            if step == 0.0 {
                continue;
            }
            *multiplier += step;
            coefficients.iter_mut().zip(&active.response).for_each(|(c, response)| *c += step * response);
            moved = moved.max((step * active.gain).abs());
        }
        if moved < 0.1 * margin {
            break;
        }
    }
}

/// Spread over the sphere on which the basis' functions are smooth, or over its upper half and the horizon.
fn points(basis: Basis) -> Vec<Vec3> {
    match basis {
        Basis::Hemispherical => icosphere(4),
        Basis::Spherical => {
            let horizon = |k: usize| Vec3::from((Vec2::from_angle(TAU * k as f32 / ON_HORIZON as f32), 0.0));
            let above = Scheme::icosahedron(1249).map_or(Vec::new(), |scheme| scheme.directions());
            above.into_iter().chain((0..ON_HORIZON).map(horizon)).collect()
        }
    }
}

/// The functions toward the direction that a point stands for: for hemispherical functions that at height z where the point is at 2z − 1.
fn row(harmonics: Harmonics, point: Vec3) -> Vec<f64> {
    let [x, y, z] = point.as_dvec3().to_array();
    let direction = match harmonics.basis() {
        Basis::Spherical => [x, y, z],
        Basis::Hemispherical => {
            let height = 0.5 * (1.0 + z.clamp(-1.0, 1.0));
            // The inverse of the factor in `directions::Harmonics`; on the horizon the azimuth does not matter.
            let scale = if height > 0.0 { 0.5 * ((1.0 + height) / height).sqrt() } else { 0.0 };
            [scale * x, scale * y, height]
        }
    };
    let mut row = vec![0.0; harmonics.functions()];
    harmonics.evaluate(direction, &mut row);
    row
}
