//! Sampling schemes: from which directions a surface is photographed.
//!
//! The schemes of the parameter-map thesis, chapter 8 (methods: "Parameter maps", Directions), as one type that is read from and written as a
//! name with its parameters. Capture plans, the paper's tests and dense test sets call it. All directions are unit vectors in the surface's
//! tangent space, strictly above the surface (z > 0, the normal is +Z), azimuths counted from +X toward +Y.

mod icosahedron;

pub use icosahedron::icosphere;

use std::f64::consts::{FRAC_PI_2, TAU};
use std::fmt;
use std::str::FromStr;

use glam::{DVec3, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// No scheme has more directions.
pub const MOST_DIRECTIONS: usize = 1 << 20;

/// A way to spread directions over the hemisphere above a surface.
///
/// Names, which [`FromStr`] reads and [`fmt::Display`] writes:
///
/// | name | directions |
/// | --- | --- |
/// | `spiral:100:8` | 100 on a spiral of 8 turns, from the horizon up, each standing for the same solid angle |
/// | `icosahedron:73` | 17, 73, 289, 305 or 1249: vertices of the subdivided icosahedron |
/// | `latitude-longitude:1,8,8,16,16,32,32` | so many on each band, from the zenith down |
/// | `stratified:64:7` | one at random in each of 8 × 8 cells of equal solid angle, seed 7 |
#[derive(Debug, Clone, PartialEq)]
pub struct Scheme(Kind);

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    Spiral { samples: usize, turns: f64 },
    Icosahedron { samples: usize },
    LatitudeLongitude { bands: Vec<usize> },
    Stratified { cells_a_side: usize, seed: u64 },
}

/// Why there is no such scheme.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SchemeError {
    /// None of the known names, or too many or too few parameters.
    #[error(
        "unknown sampling scheme {0:?}: expected spiral:SAMPLES:TURNS, icosahedron:SAMPLES, latitude-longitude:COUNT,COUNT,… or \
         stratified:SAMPLES:SEED"
    )]
    Unknown(String),
    /// A parameter is no number of its kind.
    #[error("sampling scheme {scheme}: {parameter} is {value:?}, expected {expected}")]
    Parameter {
        /// The scheme's name.
        scheme: &'static str,
        /// The parameter's.
        parameter: &'static str,
        /// What was given.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
}

const SPIRAL: &str = "spiral";
const ICOSAHEDRON: &str = "icosahedron";
const LATITUDE_LONGITUDE: &str = "latitude-longitude";
const STRATIFIED: &str = "stratified";

const A_COUNT: &str = "a number of directions from 1 to 1048576";
const A_SQUARE: &str = "a square number of directions from 1 to 1048576";
const A_POSITIVE_NUMBER: &str = "a number above 0 and at most 1048576";

impl Scheme {
    /// `samples` directions while the azimuth turns `turns` times (both in (0, 2²⁰]), from the horizon to the zenith.
    ///
    /// The heights z are evenly spaced, as the thesis advises: with its even steps in the zenith angle the samples crowd at the pole.
    pub fn spiral(samples: usize, turns: f64) -> Result<Self, SchemeError> {
        let samples = count(SPIRAL, "samples", samples)?;
        if !(turns > 0.0 && turns <= MOST_DIRECTIONS as f64) {
            return Err(unfit(SPIRAL, "turns", turns, A_POSITIVE_NUMBER));
        }
        Ok(Self(Kind::Spiral { samples, turns }))
    }

    /// The strictly upper vertices of an icosahedron with the midpoint of an edge at the zenith, subdivided one to four times: 17, 73, 305 or
    /// 1249 directions; 289 are the 305 less the lowest 16, as in the thesis' tests.
    pub fn icosahedron(samples: usize) -> Result<Self, SchemeError> {
        match icosahedron::is_count(samples) {
            true => Ok(Self(Kind::Icosahedron { samples })),
            false => Err(unfit(ICOSAHEDRON, "samples", samples, "17, 73, 289, 305 or 1249")),
        }
    }

    /// `bands[k]` directions at the zenith angle k·90°/`bands.len()`: the first is the zenith, so that its count is 0 or 1. The thesis' 113
    /// directions are 1,8,8,16,16,32,32.
    pub fn latitude_longitude(bands: Vec<usize>) -> Result<Self, SchemeError> {
        if bands.first().is_none_or(|&zenith| zenith > 1) {
            let zenith = bands.first().map_or(String::new(), usize::to_string);
            return Err(unfit(LATITUDE_LONGITUDE, "first count", zenith, "0 or 1 directions at the zenith"));
        }
        count(LATITUDE_LONGITUDE, "sum of counts", bands.iter().fold(0, |sum: usize, &band| sum.saturating_add(band)))?;
        Ok(Self(Kind::LatitudeLongitude { bands }))
    }

    /// One direction at random in each of √`samples` × √`samples` cells of equal solid angle.
    pub fn stratified(samples: usize, seed: u64) -> Result<Self, SchemeError> {
        let samples = count(STRATIFIED, "samples", samples)?;
        let cells_a_side = samples.isqrt();
        if cells_a_side * cells_a_side != samples {
            return Err(unfit(STRATIFIED, "samples", samples, A_SQUARE));
        }
        Ok(Self(Kind::Stratified { cells_a_side, seed }))
    }

    /// How many directions there are; at least 1.
    pub fn count(&self) -> usize {
        match &self.0 {
            Kind::Spiral { samples, .. } | Kind::Icosahedron { samples } => *samples,
            Kind::LatitudeLongitude { bands } => bands.iter().sum(),
            Kind::Stratified { cells_a_side, .. } => cells_a_side * cells_a_side,
        }
    }

    /// The directions: unit, z > 0, always the same ones in the same order.
    pub fn directions(&self) -> Vec<Vec3> {
        match &self.0 {
            Kind::Spiral { samples, turns } => spiral(*samples, *turns),
            Kind::Icosahedron { samples } => icosahedron::directions(*samples),
            Kind::LatitudeLongitude { bands } => latitude_longitude(bands),
            Kind::Stratified { cells_a_side, seed } => stratified_directions(*cells_a_side, &mut Pcg32::seed_from_u64(*seed)),
        }
    }
}

/// Unit vector at a height above the plane, in [0, 1], and an azimuth in radians.
fn direction(height: f64, azimuth: f64) -> Vec3 {
    let radius = (1.0 - height * height).max(0.0).sqrt();
    DVec3::new(radius * azimuth.cos(), radius * azimuth.sin(), height).as_vec3()
}

fn spiral(samples: usize, turns: f64) -> Vec<Vec3> {
    let along = |k: usize| (k as f64 + 0.5) / samples as f64;
    (0..samples).map(|k| direction(along(k), TAU * turns * along(k))).collect()
}

fn latitude_longitude(bands: &[usize]) -> Vec<Vec3> {
    let zenith = |band: usize| FRAC_PI_2 * band as f64 / bands.len() as f64;
    let azimuth = |at: usize, count: usize| TAU * at as f64 / count as f64;
    let band = |(band, &count): (usize, &usize)| (0..count).map(move |at| direction(zenith(band).cos(), azimuth(at, count)));
    bands.iter().enumerate().flat_map(band).collect()
}

/// One direction at random in each of `cells_a_side`² cells of equal solid angle, row by row from the zenith down ([Green 2003], stratified sampling).
pub fn stratified_directions(cells_a_side: usize, random: &mut Pcg32) -> Vec<Vec3> {
    let mut within = |cell: usize| (cell as f64 + random.random::<f64>()) / cells_a_side as f64;
    let cells = (0..cells_a_side).flat_map(|row| (0..cells_a_side).map(move |column| (row, column)));
    // Below 1 in f64 may round to z = 0 in f32 nowhere: the least height is 2⁻⁵³.
    cells.map(|(row, column)| direction(1.0 - within(row), TAU * within(column))).collect()
}

fn count(scheme: &'static str, parameter: &'static str, samples: usize) -> Result<usize, SchemeError> {
    match samples {
        1..=MOST_DIRECTIONS => Ok(samples),
        _ => Err(unfit(scheme, parameter, samples, A_COUNT)),
    }
}

fn unfit(scheme: &'static str, parameter: &'static str, value: impl fmt::Display, expected: &'static str) -> SchemeError {
    SchemeError::Parameter { scheme, parameter, value: value.to_string(), expected }
}

fn parse<T: FromStr>(scheme: &'static str, parameter: &'static str, text: &str, expected: &'static str) -> Result<T, SchemeError> {
    text.parse().map_err(|_| unfit(scheme, parameter, text, expected))
}

impl FromStr for Scheme {
    type Err = SchemeError;

    fn from_str(text: &str) -> Result<Self, SchemeError> {
        match text.split(':').collect::<Vec<_>>()[..] {
            [SPIRAL, samples, turns] => {
                Self::spiral(parse(SPIRAL, "samples", samples, A_COUNT)?, parse(SPIRAL, "turns", turns, A_POSITIVE_NUMBER)?)
            }
            [ICOSAHEDRON, samples] => Self::icosahedron(parse(ICOSAHEDRON, "samples", samples, "17, 73, 289, 305 or 1249")?),
            [LATITUDE_LONGITUDE, bands] => {
                let count = |band| parse(LATITUDE_LONGITUDE, "count", band, "a number of directions");
                Self::latitude_longitude(bands.split(',').map(count).collect::<Result<_, _>>()?)
            }
            [STRATIFIED, samples, seed] => Self::stratified(
                parse(STRATIFIED, "samples", samples, A_SQUARE)?,
                parse(STRATIFIED, "seed", seed, "an unsigned 64-bit number")?,
            ),
            _ => Err(SchemeError::Unknown(text.to_owned())),
        }
    }
}

impl fmt::Display for Scheme {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Kind::Spiral { samples, turns } => write!(f, "{SPIRAL}:{samples}:{turns}"),
            Kind::Icosahedron { samples } => write!(f, "{ICOSAHEDRON}:{samples}"),
            Kind::LatitudeLongitude { bands } => {
                let bands: Vec<_> = bands.iter().map(usize::to_string).collect();
                write!(f, "{LATITUDE_LONGITUDE}:{}", bands.join(","))
            }
            Kind::Stratified { cells_a_side, seed } => write!(f, "{STRATIFIED}:{}:{seed}", cells_a_side * cells_a_side),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scheme(name: &str) -> Scheme {
        name.parse().unwrap()
    }

    const NAMES: [&str; 7] = [
        "spiral:100:8.5",
        "icosahedron:17",
        "icosahedron:289",
        "icosahedron:1249",
        "latitude-longitude:1,8,8,16,16,32,32",
        "latitude-longitude:0,6",
        "stratified:64:7",
    ];

    #[test]
    fn every_scheme_gives_as_many_unit_vectors_above_the_surface_as_it_says() {
        for name in NAMES {
            let directions = scheme(name).directions();
            assert_eq!(directions.len(), scheme(name).count(), "{name}");
            // Rounding each of three coordinates to f32: 2⁻²⁴·√3.
            assert!(directions.iter().all(|d| d.z > 0.0 && (d.as_dvec3().length() - 1.0).abs() < 1.1e-7), "{name}");
        }
        assert_eq!(scheme("latitude-longitude:1,8,8,16,16,32,32").count(), 113, "the thesis' figure 8.3");
    }

    #[test]
    fn a_name_comes_back_as_it_was() {
        for name in NAMES {
            assert_eq!(scheme(name).to_string(), name);
        }
    }

    #[test]
    fn schemes_that_do_not_exist_are_refused_with_the_parameter_at_fault() {
        for unknown in ["", "spiral", "spiral:100", "hexagon:7", "icosahedron:17:1"] {
            assert_eq!(unknown.parse::<Scheme>(), Err(SchemeError::Unknown(unknown.into())));
        }
        for (name, at_fault) in [
            ("spiral:0:8", "samples"),
            ("spiral:100:NaN", "turns"),
            ("spiral:100:-1", "turns"),
            ("spiral:1048577:8", "samples"),
            ("icosahedron:42", "samples"),
            ("latitude-longitude:2,8", "first count"),
            ("latitude-longitude:", "count"),
            ("latitude-longitude:0,0", "sum of counts"),
            ("latitude-longitude:1,18446744073709551615", "sum of counts"),
            ("stratified:60:1", "samples"),
            ("stratified:64:-1", "seed"),
        ] {
            let Err(SchemeError::Parameter { parameter, .. }) = name.parse::<Scheme>() else { panic!("{name} was accepted") };
            assert_eq!(parameter, at_fault, "{name}");
        }
    }

    /// Greatest deviation, over degrees 1 and 2, of a set's mean from the hemisphere's.
    fn unevenness(directions: &[Vec3]) -> f32 {
        let n = directions.len() as f32;
        let mean = directions.iter().sum::<Vec3>() / n;
        let squares = directions.iter().map(|d| *d * *d).sum::<Vec3>() / n;
        (mean - Vec3::new(0.0, 0.0, 0.5)).abs().max_element().max((squares - Vec3::splat(1.0 / 3.0)).abs().max_element())
    }

    #[test]
    fn spiral_and_strata_give_every_solid_angle_its_share() {
        // Evenly spaced heights leave (1/n)²/12; the azimuth's sum over a whole number of turns leaves a fraction of turns/n.
        assert!(unevenness(&scheme("spiral:400:20").directions()) < 0.01);
        // A coordinate's standard deviation within one of 400 cells is at most 1/20 of its range, so that of a mean is 1/400; four of them.
        for seed in 0..5 {
            assert!(unevenness(&Scheme::stratified(400, seed).unwrap().directions()) < 0.01);
        }
    }

    #[test]
    fn strata_hold_one_direction_each_and_another_seed_gives_others() {
        let directions = scheme("stratified:64:7").directions();
        for (at, d) in directions.iter().enumerate() {
            let row = ((1.0 - d.z) * 8.0) as usize;
            let column = (f64::from(d.y).atan2(f64::from(d.x)).rem_euclid(TAU) / TAU * 8.0) as usize;
            assert_eq!((row, column), (at / 8, at % 8));
        }
        assert_ne!(scheme("stratified:64:8").directions(), directions);
    }

    #[test]
    fn bands_are_evenly_spaced_in_zenith_and_azimuth() {
        let directions = scheme("latitude-longitude:1,4,6").directions();
        assert_eq!(directions[0], Vec3::Z);
        // 30° and 60° below the zenith; f32 rounding.
        assert!((directions[2] - Vec3::new(0.0, 0.5, 0.75f32.sqrt())).length() < 1e-7);
        assert!((directions[5] - Vec3::new(0.75f32.sqrt(), 0.0, 0.5)).length() < 1e-7);
    }

    #[test]
    fn the_spiral_climbs_and_turns_as_often_as_asked() {
        let directions = scheme("spiral:1000:8").directions();
        assert!(directions.is_sorted_by(|a, b| a.z < b.z));
        let crossings = directions.windows(2).filter(|pair| pair[0].y < 0.0 && pair[1].y >= 0.0).count();
        // The last turn ends before it crosses.
        assert_eq!(crossings, 7);
    }
}
