//! The functions of a unit direction that a texel can be fitted with. `fitting` makes them, `representations::parameter_map` stores and
//! shades them.
//!
//! Directions are unit vectors of the hemisphere z ≥ 0 of a frame whose +Z is the normal. What the three channels measure is the
//! caller's affair: here they are numbers. Lobes: modified Phong as in Phong 1975, one free axis and exponent each.

use serde::{Deserialize, Serialize};

use super::harmonics::{self, Basis};

/// A function of the unit direction `d` over the hemisphere z ≥ 0, three channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Model {
    /// The same in every direction.
    Constant {
        /// The three channels.
        value: [f32; 3],
    },
    /// `value · z^exponent`: darkening towards the horizon (or, with a negative exponent, brightening).
    CosinePower {
        /// Along the normal.
        value: [f32; 3],
        /// Of z.
        exponent: f32,
    },
    /// `constant + Σ amplitude · max(axis · d, 0)^exponent`.
    Lobes {
        /// What no lobe holds, three channels.
        constant: [f32; 3],
        /// One to four, strongest first.
        lobes: Vec<Lobe>,
    },
    /// `Σ coefficients[i] · yᵢ(d)`, clamped at zero.
    Harmonics {
        /// Which functions `yᵢ` are.
        basis: Basis,
        /// n² of them for n bands, `i = l(l+1) + m`.
        coefficients: Vec<[f32; 3]>,
    },
}

/// `amplitude · max(axis · d, 0)^exponent`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lobe {
    /// Where the lobe is brightest: unit, z ≥ 0.
    pub axis: [f32; 3],
    /// Its sharpness, in 1 … 1000.
    pub exponent: f32,
    /// Along the axis, three channels, each ≥ 0.
    pub amplitude: [f32; 3],
}

impl Model {
    /// The three channels towards `d` (unit, z ≥ 0).
    pub fn eval(&self, d: [f32; 3]) -> [f32; 3] {
        match self {
            Self::Constant { value } => *value,
            // z is kept off zero: a negative exponent has a pole on the horizon.
            Self::CosinePower { value, exponent } => value.map(|v| v * d[2].max(LEAST_COSINE).powf(*exponent)),
            Self::Lobes { constant, lobes } => lobes.iter().fold(*constant, |sum, lobe| {
                let [x, y, z] = lobe.axis;
                let height = (x * d[0] + y * d[1] + z * d[2]).max(0.0).powf(lobe.exponent);
                std::array::from_fn(|c| sum[c] + lobe.amplitude[c] * height)
            }),
            Self::Harmonics { basis, coefficients } => harmonics::eval(*basis, coefficients, d),
        }
    }

    /// Numbers that the model needs (a unit axis is two): its size in memory and in the selection criterion.
    pub fn floats(&self) -> usize {
        match self {
            Self::Constant { .. } => 3,
            Self::CosinePower { .. } => 4,
            Self::Lobes { lobes, .. } => 3 + 6 * lobes.len(),
            Self::Harmonics { coefficients, .. } => 3 * coefficients.len(),
        }
    }
}

/// Smallest z that `CosinePower` sees: a half degree above the horizon.
pub const LEAST_COSINE: f32 = 0.01;
