//! One texel's model while it is being chosen: scaled numbers, fixed size, what every rung of the ladder gives.

use super::lobes::question::{LobePrior, Lobes, MAX_LOBES, Report};
use super::sample::Sample;
use super::settings::{Rung, Termination};
use super::{Lobe, Model};

/// Sum of a lobe's squares over the samples below which it rests on a view or two.
const LEAST_CARRIED: f32 = 1.2;

/// Axis and ln m of up to four lobes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start {
    /// Unit axes.
    pub axis: [[f32; 3]; MAX_LOBES],
    /// ln m.
    pub log_exponent: [f32; MAX_LOBES],
}

impl Start {
    /// No lobes: axes along the normal, m = 1.
    pub const NONE: Self = Self { axis: [[0.0, 0.0, 1.0]; MAX_LOBES], log_exponent: [0.0; MAX_LOBES] };

    /// Writes one lane.
    pub fn put(&self, lobes: &mut Lobes, lane: usize) {
        for j in 0..MAX_LOBES {
            for c in 0..3 {
                lobes.axis[j][c][lane] = self.axis[j][c];
            }
            lobes.log_exponent[j][lane] = self.log_exponent[j];
        }
    }
}

/// A fitted rung.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Its kind.
    pub rung: Rung,
    /// Its lobes, if any.
    pub shape: Start,
    /// Constant (of a cosine power: its value), then amplitudes.
    pub linear: [[f32; 3]; MAX_LOBES + 1],
    /// Of a cosine power.
    pub exponent: f32,
    /// Weighted sum of squared residuals.
    pub cost: f64,
    /// The same at the start.
    pub initial_cost: f64,
    /// Passes over the samples.
    pub iterations: u32,
    /// Why it ended.
    pub termination: Termination,
    /// Variance of each ln m for residuals of variance one.
    pub log_exponent_variance: [f32; MAX_LOBES],
    /// How many samples carry each lobe: the sum of its squares over them.
    pub carried: [f32; MAX_LOBES],
}

impl Candidate {
    /// A rung without lobes.
    pub fn flat(rung: Rung, value: [f32; 3], exponent: f32, cost: f32) -> Self {
        let mut linear = [[0.0; 3]; MAX_LOBES + 1];
        linear[0] = value;
        let cost = f64::from(cost);
        Self {
            rung,
            shape: Start::NONE,
            linear,
            exponent,
            cost,
            initial_cost: cost,
            iterations: 0,
            termination: Termination::Linear,
            log_exponent_variance: [0.0; MAX_LOBES],
            carried: [0.0; MAX_LOBES],
        }
    }

    /// One lane of a fit of `count` lobes.
    pub fn from_lane(count: usize, lobes: &Lobes, report: &Report, lane: usize) -> Self {
        let mut candidate = Self::flat(Rung::Lobes(count), [0.0; 3], 0.0, report.cost[lane]);
        for j in 0..count.min(MAX_LOBES) {
            candidate.shape.axis[j] = lobes.axis[j].map(|row| row[lane]);
            candidate.shape.log_exponent[j] = lobes.log_exponent[j][lane];
            candidate.log_exponent_variance[j] = report.log_exponent_variance[j][lane];
            candidate.carried[j] = report.carried[j][lane];
        }
        for i in 0..=count.min(MAX_LOBES) {
            candidate.linear[i] = lobes.linear[i].map(|row| row[lane]);
        }
        candidate.initial_cost = f64::from(report.initial_cost[lane]);
        candidate.iterations = report.iterations[lane] as u32;
        candidate.termination = if report.converged[lane] > 0.0 { Termination::Converged } else { Termination::IterationLimit };
        candidate
    }

    /// How many lobes it has.
    pub fn lobes(&self) -> usize {
        if let Rung::Lobes(count) = self.rung { count } else { 0 }
    }

    /// Which lobes rest on a view or two.
    pub fn lonely(&self) -> impl Iterator<Item = usize> {
        let lobes = 0..self.lobes();
        lobes.filter(|&j| !(self.carried[j] >= LEAST_CARRIED))
    }

    /// Numbers that it needs.
    pub fn parameters(&self) -> f64 {
        match self.rung {
            Rung::Constant => 3.0,
            Rung::CosinePower => 4.0,
            Rung::Lobes(count) => 3.0 + 6.0 * count as f64,
        }
    }

    /// Cost and what the prior adds to it, for residuals of this variance.
    pub fn objective(&self, prior: Option<LobePrior>, variance: f64) -> f64 {
        let Some(prior) = prior else { return self.cost };
        let off = |l: &f32| f64::from((l - prior.log_exponent) / prior.deviation).powi(2);
        let height = |a: &f32| f64::from(a / prior.amplitude).powi(2);
        let lobes = self.lobes();
        let shape: f64 = self.shape.log_exponent[..lobes].iter().map(off).sum();
        self.cost + variance * (shape + self.linear[1..=lobes].iter().flatten().map(height).sum::<f64>())
    }

    /// Writes one lane.
    pub fn put(&self, lobes: &mut Lobes, lane: usize) {
        self.shape.put(lobes, lane);
        lobes.put_linear(&self.linear, lane);
    }

    /// The model, its values times `scale`, strongest lobe first.
    pub fn model(&self, scale: f32) -> Model {
        let value = self.linear[0].map(|v| v * scale);
        match self.rung {
            Rung::Constant => Model::Constant { value },
            Rung::CosinePower => Model::CosinePower { value, exponent: self.exponent },
            Rung::Lobes(count) => {
                let lobe = |j: usize| Lobe {
                    axis: self.shape.axis[j],
                    exponent: self.shape.log_exponent[j].exp().clamp(1.0, 1000.0),
                    amplitude: self.linear[1 + j].map(|v| v * scale),
                };
                let mut lobes: Vec<Lobe> = (0..count).map(lobe).collect();
                let strength = |lobe: &Lobe| lobe.amplitude.iter().sum::<f32>();
                lobes.sort_by(|a, b| strength(b).total_cmp(&strength(a)));
                Model::Lobes { constant: value, lobes }
            }
        }
    }

    /// Residuals of one lane, scaled, three channels a sample.
    pub fn residuals(&self, group: &[Sample], lane: usize) -> Vec<[f32; 3]> {
        let model = self.model(1.0);
        let of = |s: &Sample| {
            let seen = model.eval(s.direction.map(|row| row[lane]));
            std::array::from_fn(|c| s.value[c][lane] - seen[c])
        };
        group.iter().map(of).collect()
    }
}
