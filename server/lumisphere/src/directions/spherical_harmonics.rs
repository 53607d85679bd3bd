//! Real spherical harmonics, and the same functions squeezed onto the hemisphere above a surface.
//!
//! Fits of radiance per texel (`fitting`) and their reconstruction call it. Definition as in the parameter-map thesis, equations 12.1 to 12.4, with
//! 12.2's misprint corrected: √2 K cos(mφ) P for m > 0, √2 K sin(|m|φ) P for m < 0, K P for m = 0, where P is the associated Legendre function
//! of z with the Condon–Shortley phase (−1)ᵐ, φ the azimuth, and function (l, m) has the index l(l + 1) + m.
//!
//! The hemispherical basis is that of Gautron and others (2004, "A novel hemispherical basis for accurate and efficient rendering"): √2 times the
//! spherical function at height 2z − 1. Its functions with m ≠ 0 vanish on the horizon, where only one value for all azimuths can be expressed.
//!
//! Evaluated as polynomials in x, y, z: normalised recurrence in the degree (Press and others, "Numerical Recipes" §6.7), rotation by the
//! azimuth in the order. No trigonometric function, nothing special at the pole.

use std::ops::{Add, Mul, Sub};
use std::sync::LazyLock;

use glam::Vec3;

/// Degrees 0 to 9: a hundred functions.
pub const MOST_BANDS: usize = 10;
/// Functions in [`MOST_BANDS`] bands.
pub const MOST_FUNCTIONS: usize = MOST_BANDS * MOST_BANDS;

/// Over which domain functions of direction are orthonormal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
pub enum HarmonicBasis {
    /// The whole sphere.
    Spherical,
    /// The hemisphere z ≥ 0; what is below it is read at the horizon.
    Hemispherical,
}

/// The functions of some bands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Harmonics {
    basis: HarmonicBasis,
    bands: usize,
}

/// No such number of functions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{0} spherical harmonics: expected a square number from 1 to 100")]
pub struct HarmonicsError(pub usize);

impl Harmonics {
    /// `functions` = bands²: 1, 4, 9, … 100.
    pub fn new(basis: HarmonicBasis, functions: usize) -> Result<Self, HarmonicsError> {
        let bands = functions.isqrt();
        if bands * bands != functions || !(1..=MOST_BANDS).contains(&bands) {
            return Err(HarmonicsError(functions));
        }
        Ok(Self { basis, bands })
    }

    /// Of the functions.
    pub fn basis(&self) -> HarmonicBasis {
        self.basis
    }

    /// How many functions there are.
    pub fn functions(&self) -> usize {
        self.bands * self.bands
    }

    /// Degree l of function `index`.
    pub fn degree(index: usize) -> usize {
        index.isqrt()
    }

    /// Values toward a unit vector. `values`: one per function; more are left as they are.
    pub fn evaluate(&self, direction: [f64; 3], values: &mut [f64]) {
        let [x, y, z] = self.squeezed(direction);
        Tables::of(self.basis).double.evaluate::<1>(self.bands, [x], [y], [z], values.as_chunks_mut().0);
    }

    /// Values in single precision toward `W` unit vectors at a time, one array per coordinate; `values[function][lane]`.
    // Always inline: so that the caller's registers are used, however wide.
    #[inline(always)]
    pub fn evaluate_lanes<const W: usize>(&self, x: &[f32; W], y: &[f32; W], z: &[f32; W], values: &mut [[f32; W]]) {
        let (mut x, mut y, mut z) = (*x, *y, *z);
        if self.basis == HarmonicBasis::Hemispherical {
            for lane in 0..W {
                let height = z[lane].clamp(0.0, 1.0);
                let scale = 2.0 * (height / (1.0 + height)).sqrt();
                (x[lane], y[lane], z[lane]) = (scale * x[lane], scale * y[lane], 2.0 * height - 1.0);
            }
        }
        Tables::of(self.basis).single.evaluate(self.bands, x, y, z, values);
    }

    /// Σ coefficient × function toward a unit vector, per channel. Missing coefficients count as zero, superfluous ones are not read.
    pub fn reconstruct(&self, coefficients: &[[f32; 3]], direction: Vec3) -> [f32; 3] {
        let mut values = [[0f32; 1]; MOST_FUNCTIONS];
        self.evaluate_lanes(&[direction.x], &[direction.y], &[direction.z], &mut values);
        let mut sum = [0f32; 3];
        for (coefficient, [value]) in coefficients.iter().zip(&values[..self.functions()]) {
            for (sum, coefficient) in sum.iter_mut().zip(coefficient) {
                *sum += coefficient * value;
            }
        }
        sum
    }

    /// The direction whose spherical functions are those of `direction`: height 2z − 1 and the same azimuth. With θ' its zenith angle
    /// sin θ' / sin θ = 2 √(z / (1 + z)), which is finite at the pole.
    fn squeezed(&self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self.basis {
            HarmonicBasis::Spherical => [x, y, z],
            HarmonicBasis::Hemispherical => {
                let height = z.clamp(0.0, 1.0);
                let scale = 2.0 * (height / (1.0 + height)).sqrt();
                [scale * x, scale * y, 2.0 * height - 1.0]
            }
        }
    }
}

/// The factors of all bands in both precisions.
struct Tables {
    single: Table<f32>,
    double: Table<f64>,
}

static SPHERICAL: LazyLock<Tables> = LazyLock::new(|| Tables::new(4.0 * std::f64::consts::PI));
static HEMISPHERICAL: LazyLock<Tables> = LazyLock::new(|| Tables::new(2.0 * std::f64::consts::PI));

impl Tables {
    fn new(area: f64) -> Self {
        let double = Table::new(area);
        Self { single: double.rounded(), double }
    }

    fn of(basis: HarmonicBasis) -> &'static Self {
        match basis {
            HarmonicBasis::Spherical => &SPHERICAL,
            HarmonicBasis::Hemispherical => &HEMISPHERICAL,
        }
    }
}

pub(super) trait Real: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    const ZERO: Self;
    const ONE: Self;
}

impl Real for f32 {
    const ZERO: f32 = 0.0;
    const ONE: f32 = 1.0;
}

impl Real for f64 {
    const ZERO: f64 = 0.0;
    const ONE: f64 = 1.0;
}

/// Factors of the recurrences. With p(l, m) = √2 K P / sinᵐθ (K P for m = 0):
/// p(m, m) = `first[m]`, p(l, m) = `rise[l][m]` · z · p(l−1, m) − `fall[l][m]` · p(l−2, m).
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Table<T> {
    pub(super) first: [T; MOST_BANDS],
    pub(super) rise: [[T; MOST_BANDS]; MOST_BANDS],
    pub(super) fall: [[T; MOST_BANDS]; MOST_BANDS],
}

/// Of the spherical functions; the hemispherical ones' are √2 times the first and the same otherwise.
#[cfg(feature = "gpu")]
pub(super) fn spherical_factors() -> &'static Table<f32> {
    &Tables::of(HarmonicBasis::Spherical).single
}

impl Table<f64> {
    /// For functions that are orthonormal over a domain of `area` steradians.
    fn new(area: f64) -> Self {
        let mut table = Self { first: [0.0; MOST_BANDS], rise: [[0.0; MOST_BANDS]; MOST_BANDS], fall: [[0.0; MOST_BANDS]; MOST_BANDS] };
        let mut first = (1.0 / area).sqrt();
        for m in 0..MOST_BANDS {
            if m > 0 {
                first *= -((2 * m + 1) as f64 / (2 * m) as f64).sqrt();
            }
            table.first[m] = if m == 0 { first } else { first * std::f64::consts::SQRT_2 };
            let square = |n: usize| (n * n) as f64;
            for l in m + 1..MOST_BANDS {
                table.rise[l][m] = ((4.0 * square(l) - 1.0) / (square(l) - square(m))).sqrt();
                table.fall[l][m] = table.rise[l][m] * ((square(l - 1) - square(m)) / (4.0 * square(l - 1) - 1.0)).abs().sqrt();
            }
        }
        table
    }

    fn rounded(&self) -> Table<f32> {
        let row = |row: &[f64; MOST_BANDS]| row.map(|factor| factor as f32);
        Table { first: row(&self.first), rise: self.rise.each_ref().map(row), fall: self.fall.each_ref().map(row) }
    }
}

impl<T: Real> Table<T> {
    #[inline(always)]
    fn evaluate<const W: usize>(&self, bands: usize, x: [T; W], y: [T; W], z: [T; W], values: &mut [[T; W]]) {
        // sinᵐθ cos mφ and sinᵐθ sin mφ.
        let (mut cosine, mut sine) = ([T::ONE; W], [T::ZERO; W]);
        for m in 0..bands {
            let mut before = [T::ZERO; W];
            let mut legendre = [self.first[m]; W];
            for l in m..bands {
                if l > m {
                    let (rise, fall) = (self.rise[l][m], self.fall[l][m]);
                    for lane in 0..W {
                        let next = rise * z[lane] * legendre[lane] - fall * before[lane];
                        (before[lane], legendre[lane]) = (legendre[lane], next);
                    }
                }
                let middle = l * (l + 1);
                let Some(even) = values.get_mut(middle + m) else { return };
                for lane in 0..W {
                    even[lane] = legendre[lane] * cosine[lane];
                }
                if m > 0 {
                    let odd = &mut values[middle - m];
                    for lane in 0..W {
                        odd[lane] = legendre[lane] * sine[lane];
                    }
                }
            }
            for lane in 0..W {
                (cosine[lane], sine[lane]) = (x[lane] * cosine[lane] - y[lane] * sine[lane], x[lane] * sine[lane] + y[lane] * cosine[lane]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directions::{Scheme, hemisphere_quadrature};

    fn values(basis: HarmonicBasis, functions: usize, direction: [f64; 3]) -> Vec<f64> {
        let mut values = vec![0.0; functions];
        Harmonics::new(basis, functions).unwrap().evaluate(direction, &mut values);
        values
    }

    fn gram(basis: HarmonicBasis, samples: impl Iterator<Item = ([f64; 3], f64)>) -> Vec<f64> {
        let mut gram = vec![0.0; 100 * 100];
        for (direction, weight) in samples {
            let row = values(basis, 100, direction);
            for (i, k) in (0..100).flat_map(|i| (0..100).map(move |k| (i, k))) {
                gram[100 * i + k] += weight * row[i] * row[k];
            }
        }
        gram
    }

    #[test]
    fn a_hundred_functions_are_orthonormal_over_sphere_and_hemisphere() {
        // Products of two functions of degree 9 are polynomials of degree 18 in the height, which ten points integrate exactly.
        let sphere = hemisphere_quadrature(12).into_iter().flat_map(|(d, w)| [[d.x, d.y, d.z], [d.x, d.y, -d.z]].map(|d| (d, w)));
        let hemisphere = hemisphere_quadrature(12).into_iter().map(|(d, w)| ([d.x, d.y, d.z], w));
        for gram in [gram(HarmonicBasis::Spherical, sphere), gram(HarmonicBasis::Hemispherical, hemisphere)] {
            for (at, product) in gram.iter().enumerate() {
                let expected = if at % 101 == 0 { 1.0 } else { 0.0 };
                // Rounding of 576 terms near 1.
                assert!((product - expected).abs() < 1e-12, "{} {}: {product}", at / 100, at % 100);
            }
        }
    }

    #[test]
    fn the_first_nine_are_the_closed_forms() {
        let [x, y, z] = [0.48, -0.6, 0.64];
        let pi = std::f64::consts::PI;
        let (p, d) = ((3.0 / (4.0 * pi)).sqrt(), (15.0 / (4.0 * pi)).sqrt());
        let closed = [
            (1.0 / (4.0 * pi)).sqrt(),
            -p * y,
            p * z,
            -p * x,
            d * x * y,
            -d * y * z,
            (5.0 / (16.0 * pi)).sqrt() * (3.0 * z * z - 1.0),
            -d * x * z,
            0.5 * d * (x * x - y * y),
        ];
        for (got, expected) in values(HarmonicBasis::Spherical, 9, [x, y, z]).iter().zip(closed) {
            assert!((got - expected).abs() < 1e-15, "{got} {expected}");
        }
    }

    #[test]
    fn a_turn_about_the_normal_mixes_only_functions_of_opposite_order() {
        let (angle, height) = (0.7f64, 0.3f64);
        let radius = (1.0 - height * height).sqrt();
        let toward = |azimuth: f64| [radius * azimuth.cos(), radius * azimuth.sin(), height];
        for basis in [HarmonicBasis::Spherical, HarmonicBasis::Hemispherical] {
            let (before, after) = (values(basis, 100, toward(0.4)), values(basis, 100, toward(0.4 + angle)));
            for (l, m) in (0..10usize).flat_map(|l| (0..=l).map(move |m| (l, m))) {
                let (even, odd) = (l * (l + 1) + m, l * (l + 1) - m);
                let (sin, cos) = (m as f64 * angle).sin_cos();
                assert!((after[even] - (cos * before[even] - if m > 0 { sin * before[odd] } else { 0.0 })).abs() < 1e-13, "{l} {m}");
            }
        }
    }

    #[test]
    fn single_precision_follows_double_and_so_do_lanes() {
        let directions = Scheme::icosahedron(73).unwrap().directions();
        for basis in [HarmonicBasis::Spherical, HarmonicBasis::Hemispherical] {
            let harmonics = Harmonics::new(basis, 100).unwrap();
            let mut lanes = [[0f32; 73]; 100];
            let coordinate = |axis: usize| std::array::from_fn(|at| directions[at][axis]);
            harmonics.evaluate_lanes(&coordinate(0), &coordinate(1), &coordinate(2), &mut lanes);
            for (at, d) in directions.iter().enumerate() {
                let double = values(basis, 100, d.as_dvec3().to_array());
                // Values reach √(19/4π)·√2 = 1.7; nine steps of recurrence near the pole, where errors grow by the degree's square: 10²·2⁻²⁴·1.7.
                assert!((0..100).all(|i| (f64::from(lanes[i][at]) - double[i]).abs() < 1e-5), "{basis:?} {d}");
            }
        }
    }

    #[test]
    fn a_sum_of_functions_is_reconstructed_and_below_the_horizon_is_the_horizon() {
        let harmonics = Harmonics::new(HarmonicBasis::Hemispherical, 4).unwrap();
        let unit = (2.0 * std::f32::consts::PI).sqrt();
        // √2 √(3/4π) (2z − 1) at z = 1 is √(3/2π); 1/√(2π) is the constant.
        let coefficients = [[unit, 0.0, 1.0], [0.0; 3], [0.0, unit, 0.0], [0.0; 3], [9.0; 3]];
        let zenith = harmonics.reconstruct(&coefficients, Vec3::Z);
        assert!((zenith[0] - 1.0).abs() < 1e-6 && (zenith[1] - 3f32.sqrt()).abs() < 1e-6 && (zenith[2] - 1.0 / unit).abs() < 1e-6);
        let below = harmonics.reconstruct(&coefficients, Vec3::new(0.6, 0.0, -0.8));
        assert!((below[1] + 3f32.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn numbers_of_functions_that_fill_no_bands_are_refused() {
        for functions in [0, 2, 15, 121] {
            assert_eq!(Harmonics::new(HarmonicBasis::Spherical, functions), Err(HarmonicsError(functions)));
        }
    }
}
