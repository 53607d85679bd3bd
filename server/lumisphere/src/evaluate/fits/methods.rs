//! What is fitted: the thesis' own methods, and ours as a fit job has them.

use std::fmt;

use glam::Vec3;
use rayon::prelude::*;
use thiserror::Error;

use crate::capture::observation_map::{Observation, ObservedTexel, State as Seen};
use crate::fitting::harmonics::{HarmonicsFitError, optimal_projection, project};
use crate::fitting::{Basis, Batch, Choice, Model, Noise, Outcome, Rung, Settings, SettingsError, Starts, State, fit};
use crate::representations::parameter_map::{AllowedModels, FitError, fitted_models};

/// A way to a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The thesis' model and objective (11.2): one lobe by plain least squares, clipped values taken as they are. It starts better than the
    /// thesis' (brightest direction, m = 10), and its K have no upper bound.
    PlainPhong,
    /// The thesis' (12.3.2): spherical harmonics, nothing below the horizon.
    ZeroHemisphere(usize),
    /// The thesis' (12.3.3): least-squares optimal projection.
    OptimalProjection(usize),
    /// Ours.
    Job(AllowedModels),
}

/// One texel's samples: direction in its frame (unit, z ≥ 0), and what was seen.
pub type Samples = Vec<([f32; 3], Observation)>;

/// Why a method has no model.
#[derive(Debug, Error)]
pub enum MethodError {
    /// Ours.
    #[error(transparent)]
    Job(#[from] FitError),
    /// The thesis' lobe.
    #[error(transparent)]
    Lobe(#[from] SettingsError),
    /// The thesis' harmonics.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsFitError),
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PlainPhong => write!(f, "plain phong"),
            Self::ZeroHemisphere(count) => write!(f, "thesis zh:{count}"),
            Self::OptimalProjection(count) => write!(f, "thesis lsop:{count}"),
            Self::Job(models) => models.fmt(f),
        }
    }
}

impl Method {
    /// A model for each texel, or None where nothing was seen. `noise` is that of the samples; the thesis' methods do not ask for it.
    pub fn fit(self, texels: &[Samples], noise: Noise) -> Result<Vec<Option<Model>>, MethodError> {
        match self {
            Self::PlainPhong => plain_phong(texels, noise),
            Self::ZeroHemisphere(count) => projected(texels, |directions, values| project(count, directions, values)),
            Self::OptimalProjection(count) => projected(texels, |directions, values| optimal_projection(count, directions, values)),
            Self::Job(models) => {
                // A job's samples come with a place, which no model depends on.
                let anywhere = ObservedTexel { index: 0, position: Vec3::ZERO, normal: Vec3::Z, tangent: Vec3::X };
                let observed: Vec<_> = texels.iter().map(|samples| (&anywhere, samples.clone())).collect();
                Ok(fitted_models(&observed, models, noise)?)
            }
        }
    }
}

/// What was seen, with its direction.
fn seen(samples: &Samples) -> impl Iterator<Item = ([f32; 3], [f32; 3])> + '_ {
    let seen = samples.iter().filter(|(direction, o)| o.state != Seen::Missing && direction[2] > 0.0);
    seen.map(|(direction, o)| (*direction, o.radiance))
}

fn plain_phong(texels: &[Samples], noise: Noise) -> Result<Vec<Option<Model>>, MethodError> {
    let mut batch = Batch::new();
    for samples in texels {
        let (directions, values): (Vec<_>, Vec<_>) = seen(samples).unzip();
        batch.push(&directions, &values, &vec![State::VALID; values.len()]).expect("as many of each");
    }
    // All samples weigh the same.
    let noise = Noise { relative: 0.0, ..noise };
    let settings = Settings { prior: None, starts: Starts::Exactly(1), ..Settings::new(Choice::Exactly(Rung::Lobes(1)), noise) };
    Ok(fit(&batch, &settings)?.iter().map(|outcome| Outcome::fit(outcome).map(|fit| fit.model.clone())).collect())
}

fn projected(
    texels: &[Samples],
    projection: impl Fn(&[Vec3], &[[f32; 3]]) -> Result<Vec<[f32; 3]>, HarmonicsFitError> + Sync,
) -> Result<Vec<Option<Model>>, MethodError> {
    let one = |samples: &Samples| {
        let (directions, values): (Vec<Vec3>, Vec<_>) = seen(samples).map(|(direction, value)| (Vec3::from(direction), value)).unzip();
        if directions.is_empty() {
            return Ok(None);
        }
        Ok(Some(Model::Harmonics { basis: Basis::Spherical, coefficients: projection(&directions, &values)? }))
    };
    texels.par_iter().map(one).collect()
}
