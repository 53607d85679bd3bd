//! Whether a sampler draws from the density that it states: chi-squared tests, for the samplers of every module.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::directions::{direction_from_lat_long, lat_long_from_direction};
use crate::geometry::TangentFrame;

/// Draws of one test.
pub const DRAWS: usize = 200_000;

/// Chi-squared test of counts against expected counts. Cells with fewer than 5 expected are pooled. Fails beyond 4 standard
/// deviations of the normal that Wilson & Hilferty's cube root makes of it: one false alarm in 30 000 seeds.
pub fn assert_distributed(counts: &[u32], expected: &[f64], what: &str) {
    let (mut statistic, mut cells) = (0.0, 0);
    let mut pooled = (0.0, 0.0);
    let mut add = |count: f64, expected: f64| {
        statistic += (count - expected).powi(2) / expected;
        cells += 1;
    };
    for (count, expected) in counts.iter().zip(expected) {
        if *expected >= 5.0 { add(f64::from(*count), *expected) } else { pooled = (pooled.0 + f64::from(*count), pooled.1 + expected) }
    }
    if pooled.1 >= 5.0 {
        add(pooled.0, pooled.1);
    } else {
        // A handful expected in all: six sigma of a Poisson variable of mean 5.
        assert!(pooled.0 <= 5.0 + 6.0 * 5f64.sqrt(), "{what}: {} draws where {:.2} were expected", pooled.0, pooled.1);
    }
    let freedom = f64::from(cells - 1);
    let spread = 2.0 / (9.0 * freedom);
    let z = ((statistic / freedom).cbrt() - (1.0 - spread)) / spread.sqrt();
    assert!(z < 4.0, "{what}: chi-squared {statistic:.1} with {freedom} degrees of freedom, z = {z:.2}");
}

/// Two uniform numbers.
pub fn pair(random: &mut Pcg32) -> Vec2 {
    Vec2::new(random.random(), random.random())
}

/// A map of directions to the unit square, whose cells are counted, and back.
pub trait Grid {
    /// Columns and rows.
    const CELLS: [usize; 2];
    /// Where on the square a direction lies.
    fn place(&self, direction: Vec3) -> Vec2;
    /// The direction of a place, and steradian per area of the square there.
    fn direction(&self, place: Vec2) -> (Vec3, f64);
}

/// Longitude × polar angle about +Y.
pub struct Sphere;

impl Grid for Sphere {
    const CELLS: [usize; 2] = [24, 12];

    fn place(&self, direction: Vec3) -> Vec2 {
        lat_long_from_direction(direction)
    }

    fn direction(&self, place: Vec2) -> (Vec3, f64) {
        let area = 2.0 * std::f64::consts::PI.powi(2) * f64::from((std::f32::consts::PI * place.y).sin());
        (direction_from_lat_long(place), area)
    }
}

/// Azimuth × 1 − 1/√(1+r²) of the half vector with `toward`, r being its slopes over `scale`: resolves a lobe however narrow. Equal areas
/// are equal solid angles of the half vectors stretched by `scale`. Tangent space.
pub struct HalfVectors {
    pub toward: Vec3,
    pub scale: Vec2,
}

impl Grid for HalfVectors {
    const CELLS: [usize; 2] = [16, 16];

    fn place(&self, direction: Vec3) -> Vec2 {
        let h = self.toward + direction;
        let slopes = h.truncate() / (h.z * self.scale);
        let squared = slopes.length_squared();
        Vec2::new((slopes.y.atan2(slopes.x) / std::f32::consts::TAU - HALF_A_COLUMN).rem_euclid(1.0), 1.0 - 1.0 / (1.0 + squared).sqrt())
    }

    fn direction(&self, place: Vec2) -> (Vec3, f64) {
        let slopes =
            self.scale * ((1.0 - place.y).powi(-2) - 1.0).sqrt() * Vec2::from_angle(std::f32::consts::TAU * (place.x + HALF_A_COLUMN));
        let h = slopes.extend(1.0).normalize();
        let along = self.toward.dot(h);
        // Square to slopes, slopes to half vectors, half vectors to directions.
        let slopes_per_area = f64::from(self.scale.x * self.scale.y) * std::f64::consts::TAU / f64::from(1.0 - place.y).powi(3);
        (2.0 * along * h - self.toward, slopes_per_area * f64::from(h.z).powi(3) * 4.0 * f64::from(along.abs()))
    }
}

// The horizon lies along an axis of the slopes: inside cells, not in a sliver beside their edges that the midpoint rule would miss.
const HALF_A_COLUMN: f32 = 0.5 / 16.0;

/// Azimuth × 1 − 1/√(1+r²), r being the tangent of the angle to `axis` over `scale`: the hemisphere around it.
pub struct AroundAxis {
    pub axis: Vec3,
    pub scale: f32,
}

impl Grid for AroundAxis {
    const CELLS: [usize; 2] = [16, 16];

    fn place(&self, direction: Vec3) -> Vec2 {
        let local = TangentFrame::around(self.axis).local_from_world(direction);
        let slopes = local.truncate() / (local.z * self.scale);
        let squared = slopes.length_squared();
        Vec2::new((slopes.y.atan2(slopes.x) / std::f32::consts::TAU).rem_euclid(1.0), 1.0 - 1.0 / (1.0 + squared).sqrt())
    }

    fn direction(&self, place: Vec2) -> (Vec3, f64) {
        let slopes = self.scale * ((1.0 - place.y).powi(-2) - 1.0).sqrt() * Vec2::from_angle(std::f32::consts::TAU * place.x);
        let local = slopes.extend(1.0).normalize();
        let slopes_per_area = f64::from(self.scale).powi(2) * std::f64::consts::TAU / f64::from(1.0 - place.y).powi(3);
        (TangentFrame::around(self.axis).world_from_local(local), slopes_per_area * f64::from(local.z).powi(3))
    }
}

/// Draws of a direction, and the integral of its stated density, cell by cell over the sphere.
pub fn assert_density_on_sphere(what: &str, sample: impl FnMut(Vec2) -> Option<(Vec3, f32)>, density: impl Fn(Vec3) -> f32) {
    assert_density(what, &Sphere, sample, density);
}

/// Draws of a direction, and the integral of its stated density, cell by cell over a grid.
pub fn assert_density<G: Grid>(what: &str, grid: &G, mut sample: impl FnMut(Vec2) -> Option<(Vec3, f32)>, density: impl Fn(Vec3) -> f32) {
    let [columns, rows] = G::CELLS;
    let mut random = Pcg32::seed_from_u64(17);
    let mut counts = vec![0; columns * rows + 1];
    for _ in 0..DRAWS {
        let Some((direction, pdf)) = sample(pair(&mut random)) else {
            counts[columns * rows] += 1;
            continue;
        };
        assert!((direction.length() - 1.0).abs() < 1e-4, "{what}: {direction}");
        let stated = density(direction);
        assert!((pdf / stated - 1.0).abs() < 2e-2, "{what}: drawn with {pdf}, stated {stated} toward {direction}");
        let at = grid.place(direction);
        let cell = |x: f32, count: usize| ((x * count as f32) as usize).min(count - 1);
        counts[cell(at.y, rows) * columns + cell(at.x, columns)] += 1;
    }
    // Midpoint rule, fine enough that its error stays far below the counts' own noise.
    const FINE: usize = 32;
    let mut expected = vec![0.0; columns * rows];
    for (cell, expected) in expected.iter_mut().enumerate() {
        for k in 0..FINE * FINE {
            let within = Vec2::new((k % FINE) as f32 + 0.5, (k / FINE) as f32 + 0.5) / FINE as f32;
            let at = (Vec2::new((cell % columns) as f32, (cell / columns) as f32) + within) / Vec2::new(columns as f32, rows as f32);
            let (direction, steradian) = grid.direction(at);
            *expected += DRAWS as f64 * steradian / (columns * rows * FINE * FINE) as f64 * f64::from(density(direction));
        }
    }
    let total = expected.iter().sum::<f64>() / DRAWS as f64;
    // The midpoint rule's own error.
    assert!(total < 1.01, "{what}: the density integrates to {total}");
    // What the density leaves out is absorbed.
    expected.push((DRAWS as f64 * (1.0 - total)).max(0.0));
    assert_distributed(&counts, &expected, what);
}
