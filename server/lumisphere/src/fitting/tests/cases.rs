//! Synthetic texels whose truth is known: a plane of 1000 × 1000 units with 16 × 16 texels, colour (200, 15, 15)/255, a point light at
//! (1500, 1500, 2000) from its middle, seen from the vertices of a subdivided icosahedron (the thesis' tests), and variations.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::directions::Scheme;
use crate::fitting::{Batch, Fit, Lobe, Model, Outcome, Settings, State, fit};

/// Texels to a side of the plane, and its size.
const SIDE: usize = 16;
const PLANE: f32 = 1000.0;
/// Its colour.
const COLOUR: [f32; 3] = [200.0 / 255.0, 15.0 / 255.0, 15.0 / 255.0];
/// Where the first light stands, from the middle of the plane.
pub const LIGHT: [f32; 3] = [1500.0, 1500.0, 2000.0];

/// Texels, what they are, and what was seen of them.
pub struct Case {
    pub truth: Vec<Model>,
    pub directions: Vec<Vec<[f32; 3]>>,
    pub values: Vec<Vec<[f32; 3]>>,
    pub states: Vec<Vec<State>>,
    random: Pcg32,
}

pub fn icosahedron(count: usize) -> Vec<[f32; 3]> {
    Scheme::icosahedron(count).unwrap().directions().iter().map(|d| d.to_array()).collect()
}

impl Case {
    /// Every texel seen along the same directions.
    pub fn new(truth: Vec<Model>, directions: &[[f32; 3]]) -> Self {
        let per_texel = vec![directions.to_vec(); truth.len()];
        let values = truth.iter().map(|model| directions.iter().map(|&d| model.eval(d)).collect()).collect();
        let states = vec![vec![State::VALID; directions.len()]; truth.len()];
        Self { truth, directions: per_texel, values, states, random: Pcg32::seed_from_u64(7) }
    }

    fn normal(&mut self) -> f32 {
        let (u, v): (f32, f32) = (self.random.random(), self.random.random());
        (-2.0 * (1.0 - u).ln()).sqrt() * (std::f32::consts::TAU * v).cos()
    }

    pub fn uniform(&mut self) -> f32 {
        self.random.random()
    }

    /// Changes every value: (value, random normal number).
    pub fn with(mut self, change: impl Fn(f32, f32) -> f32) -> Self {
        for t in 0..self.values.len() {
            for i in 0..self.values[t].len() {
                for c in 0..3 {
                    let normal = self.normal();
                    self.values[t][i][c] = change(self.values[t][i][c], normal);
                }
            }
        }
        self
    }

    pub fn noise(self, sigma: f32) -> Self {
        self.with(|value, normal| value + sigma * normal)
    }

    /// One sample in a hundred is anything up to twice the largest value.
    pub fn outliers(mut self) -> (Self, Vec<Vec<bool>>) {
        let mut hit = Vec::new();
        for t in 0..self.values.len() {
            let mut of_texel = vec![false; self.values[t].len()];
            for (i, hit) in of_texel.iter_mut().enumerate() {
                if self.random.random::<f32>() < 0.01 {
                    *hit = true;
                    self.values[t][i] = std::array::from_fn(|_| 2.0 * self.random.random::<f32>());
                }
            }
            hit.push(of_texel);
        }
        (self, hit)
    }

    /// The sensor is full at `level`.
    pub fn clipped(mut self, level: f32) -> Self {
        for (values, states) in self.values.iter_mut().zip(&mut self.states) {
            for (value, state) in values.iter_mut().zip(states) {
                *state = State::clipped(value.map(|v| v >= level));
                *value = value.map(|v| v.min(level));
            }
        }
        self
    }

    /// Eight bits, with a dither of one step.
    pub fn dithered(mut self) -> Self {
        for t in 0..self.values.len() {
            for i in 0..self.values[t].len() {
                for c in 0..3 {
                    let dither: f32 = self.random.random();
                    self.values[t][i][c] = (self.values[t][i][c] * 255.0 + dither).floor().clamp(0.0, 255.0) / 255.0;
                }
            }
        }
        self
    }

    pub fn batch(&self) -> Batch {
        let mut batch = Batch::new();
        for ((directions, values), states) in self.directions.iter().zip(&self.values).zip(&self.states) {
            batch.push(directions, values, states).unwrap();
        }
        batch
    }

    pub fn fit(&self, settings: &Settings) -> Judged {
        let outcomes = fit(&self.batch(), settings).unwrap();
        let dense = icosahedron(1249);
        let fits: Vec<Fit> = outcomes.iter().filter_map(Outcome::fit).cloned().collect();
        assert_eq!(fits.len(), self.truth.len(), "every texel was seen");
        let error = |(model, truth): (&Model, &Model)| {
            let squares = dense.iter().map(|&d| {
                let (a, b) = (model.eval(d), truth.eval(d));
                (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum::<f64>()
            });
            (squares.sum::<f64>() / (3 * dense.len()) as f64).sqrt()
        };
        let errors = fits.iter().map(|f| &f.model).zip(&self.truth).map(error).collect();
        for fit in &fits {
            check(fit);
        }
        Judged { fits, errors, truth: self.truth.clone() }
    }
}

/// What holds of every fit, whatever the data.
fn check(fit: &Fit) {
    assert!(fit.final_cost.is_finite() && fit.rms_residual.is_finite());
    let Model::Lobes { constant, lobes } = &fit.model else { return };
    assert!(constant.iter().all(|v| v.is_finite() && *v >= 0.0), "{fit:?}");
    for lobe in lobes {
        let length = lobe.axis.iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!((length - 1.0).abs() < 1e-5 && lobe.axis[2] >= 0.0, "{lobe:?}");
        assert!(lobe.amplitude.iter().all(|v| v.is_finite() && *v >= 0.0), "{lobe:?}");
        assert!((1.0..=1000.0).contains(&lobe.exponent), "{lobe:?}");
    }
}

/// Fits beside the truth.
pub struct Judged {
    pub fits: Vec<Fit>,
    /// RMSE against the truth over 1249 directions, per texel.
    pub errors: Vec<f64>,
    pub truth: Vec<Model>,
}

impl Judged {
    /// RMSE over all texels.
    pub fn dense(&self) -> f64 {
        (self.errors.iter().map(|e| e * e).sum::<f64>() / self.errors.len() as f64).sqrt()
    }

    pub fn median(&self) -> f64 {
        let mut errors = self.errors.clone();
        errors.sort_by(f64::total_cmp);
        errors[errors.len() / 2]
    }

    pub fn share(&self, wanted: impl Fn(&Fit) -> bool) -> f64 {
        self.fits.iter().filter(|fit| wanted(fit)).count() as f64 / self.fits.len() as f64
    }

    /// Share of texels with an error above .05.
    pub fn bad(&self) -> f64 {
        self.errors.iter().filter(|&&e| e > 0.05).count() as f64 / self.errors.len() as f64
    }

    /// Share of texels with as many lobes as the truth, and with more.
    pub fn exact(&self) -> (f64, f64) {
        let count = |wanted: fn(usize, usize) -> bool| {
            let pairs = self.fits.iter().zip(&self.truth);
            pairs.filter(|(fit, truth)| wanted(lobes(&fit.model), lobes(truth))).count() as f64 / self.fits.len() as f64
        };
        (count(|a, b| a == b), count(|a, b| a > b))
    }

    pub fn floats(&self) -> f64 {
        self.fits.iter().map(|fit| fit.model.floats()).sum::<usize>() as f64 / self.fits.len() as f64
    }
}

pub fn lobes(model: &Model) -> usize {
    if let Model::Lobes { lobes, .. } = model { lobes.len() } else { 0 }
}

pub fn normalized(v: [f32; 3]) -> [f32; 3] {
    let length = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    v.map(|x| x / length)
}

/// Where the texels' centres lie.
pub fn texels() -> impl Iterator<Item = [f32; 2]> {
    let place = |i: usize| ((i as f32 + 0.5) / SIDE as f32 - 0.5) * PLANE;
    (0..SIDE * SIDE).map(move |i| [place(i % SIDE), place(i / SIDE)])
}

/// Diffuse part and highlights of a texel under point lights: (place, strength, specular, exponent).
pub fn lit(texel: [f32; 2], lights: &[([f32; 3], f32, f32, f32)]) -> Model {
    let mut constant = [0.0; 3];
    let mut found = Vec::new();
    for &([x, y, z], strength, specular, exponent) in lights {
        let to_light = normalized([x - texel[0], y - texel[1], z]);
        constant = std::array::from_fn(|c| constant[c] + strength * COLOUR[c] * to_light[2]);
        let axis = [-to_light[0], -to_light[1], to_light[2]];
        found.push(Lobe { axis, exponent, amplitude: [strength * specular; 3] });
    }
    found.retain(|lobe| lobe.amplitude[0] > 0.0);
    if found.is_empty() { Model::Constant { value: constant } } else { Model::Lobes { constant, lobes: found } }
}

/// The plane under one light.
pub fn one_light(specular: f32, exponent: f32) -> Vec<Model> {
    texels().map(|texel| lit(texel, &[(LIGHT, 1.0, specular, exponent)])).collect()
}

/// The plane under a second light at this place.
pub fn two_lights(second: [f32; 3]) -> Vec<Model> {
    texels().map(|texel| lit(texel, &[(LIGHT, 0.5, 0.8, 20.0), (second, 0.5, 0.8, 20.0)])).collect()
}

/// Every texel another set of lobes, `count(random)` of them, at least 25° apart, m in the range given.
pub fn random_lobes(texels: usize, counts: &[usize], exponents: [f32; 2]) -> Vec<Model> {
    let mut random = Pcg32::seed_from_u64(11);
    let model = |t: usize| {
        let count = counts[t % counts.len()];
        let constant = std::array::from_fn(|_| 0.1 + 0.5 * random.random::<f32>());
        let mut lobes: Vec<Lobe> = Vec::new();
        while lobes.len() < count {
            let (z, turn) = (0.4 + 0.6 * random.random::<f32>(), std::f32::consts::TAU * random.random::<f32>());
            let r = (1.0 - z * z).sqrt();
            let axis = [r * turn.cos(), r * turn.sin(), z];
            let apart = |l: &Lobe| (0..3).map(|c| l.axis[c] * axis[c]).sum::<f32>() < 25_f32.to_radians().cos();
            if lobes.iter().all(apart) {
                let exponent = exponents[0] * (exponents[1] / exponents[0]).powf(random.random());
                let strength = 0.2 + 0.6 * random.random::<f32>();
                lobes.push(Lobe { axis, exponent, amplitude: std::array::from_fn(|_| strength * (0.7 + 0.3 * random.random::<f32>())) });
            }
        }
        if lobes.is_empty() { Model::Constant { value: constant } } else { Model::Lobes { constant, lobes } }
    };
    (0..texels).map(model).collect()
}
