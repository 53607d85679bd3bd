//! The samples: the thesis' plane under one or two lights, and texels of zero to three lobes.

use std::f32::consts::TAU;
use std::fs;
use std::path::{Path, PathBuf};

use lumisphere::directions::Scheme;
use lumisphere::fitting::{Batch, Lobe, Model, State};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

/// Texels to a side.
const SIDE: usize = 32;
const NOISE: f32 = 0.005;
const COLOUR: [f32; 3] = [200.0 / 255.0, 15.0 / 255.0, 15.0 / 255.0];
const LIGHT: [f32; 3] = [1500.0, 1500.0, 2000.0];

/// Texels that all see along the same directions.
pub struct Map {
    pub name: String,
    directions: Vec<[f32; 3]>,
    values: Vec<Vec<[f32; 3]>>,
}

/// Emptied at each start.
pub fn folder() -> PathBuf {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target/fitting");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder for the samples");
    folder
}

impl Map {
    fn new(name: String, views: usize, model: impl FnMut(usize) -> Model) -> Self {
        let scheme = Scheme::icosahedron(views).expect("a count of the icosahedron");
        let directions: Vec<[f32; 3]> = scheme.directions().iter().map(|d| d.to_array()).collect();
        let mut random = Pcg32::seed_from_u64(5);
        let mut noise = || {
            let (u, v): (f32, f32) = (random.random(), random.random());
            NOISE * (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos()
        };
        let models: Vec<Model> = (0..SIDE * SIDE).map(model).collect();
        let values = models.iter().map(|m| directions.iter().map(|&d| m.eval(d).map(|v| v + noise())).collect()).collect();
        Self { name, directions, values }
    }

    pub fn one_light(views: usize) -> Self {
        Self::new("one light".into(), views, |t| lit(t, &[(LIGHT, 1.0)]))
    }

    pub fn two_lights(second: f32) -> Self {
        let second_light = [second, second, 2000.0];
        Self::new(format!("two lights, the second at {second}"), 289, |t| lit(t, &[(LIGHT, 0.6), (second_light, 0.4)]))
    }

    pub fn diffuse() -> Self {
        Self::new("diffuse".into(), 289, |_| Model::Constant { value: COLOUR })
    }

    /// Zero to three lobes, at least 25° apart.
    pub fn mixed() -> Self {
        let mut random = Pcg32::seed_from_u64(11);
        Self::new("0 to 3 lobes".into(), 289, |t| {
            let constant = std::array::from_fn(|_| 0.1 + 0.5 * random.random::<f32>());
            let mut lobes: Vec<Lobe> = Vec::new();
            while lobes.len() < t % 4 {
                let (z, turn) = (0.4 + 0.6 * random.random::<f32>(), TAU * random.random::<f32>());
                let radius = (1.0 - z * z).sqrt();
                let axis = [radius * turn.cos(), radius * turn.sin(), z];
                let is_apart = |l: &Lobe| (0..3).map(|c| l.axis[c] * axis[c]).sum::<f32>() < 25_f32.to_radians().cos();
                if lobes.iter().all(is_apart) {
                    let exponent = 5.0 * 16_f32.powf(random.random());
                    lobes.push(Lobe { axis, exponent, amplitude: [0.2 + 0.6 * random.random::<f32>(); 3] });
                }
            }
            Model::Lobes { constant, lobes }
        })
    }

    pub fn views(&self) -> usize {
        self.directions.len()
    }

    pub fn texels(&self) -> usize {
        self.values.len()
    }

    pub fn batch(&self) -> Batch {
        let mut batch = Batch::with_shared_directions(&self.directions);
        let states = vec![State::VALID; self.views()];
        self.values.iter().for_each(|values| batch.push_shared(values, &states).expect("as many values as directions"));
        batch
    }

    /// For each texel and view six f32: direction, values.
    pub fn write(&self, folder: &Path) -> PathBuf {
        let path = folder.join(format!("{} {}.f32", self.name, self.views()));
        let sample = |(d, v): (&[f32; 3], &[f32; 3])| [d[0], d[1], d[2], v[0], v[1], v[2]];
        let numbers = self.values.iter().flat_map(|values| self.directions.iter().zip(values).flat_map(sample));
        fs::write(&path, numbers.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()).expect("room on the disk");
        path
    }
}

fn lit(texel: usize, lights: &[([f32; 3], f32)]) -> Model {
    let place = |i: usize| ((i as f32 + 0.5) / SIDE as f32 - 0.5) * 1000.0;
    let (x, y) = (place(texel % SIDE), place(texel / SIDE));
    let mut constant = [0.0; 3];
    let mut lobes = Vec::new();
    for &(at, strength) in lights {
        let to_light = [at[0] - x, at[1] - y, at[2]];
        let length = to_light.iter().map(|v| v * v).sum::<f32>().sqrt();
        let [lx, ly, lz] = to_light.map(|v| v / length);
        constant = std::array::from_fn(|c| constant[c] + strength * COLOUR[c] * lz);
        lobes.push(Lobe { axis: [-lx, -ly, lz], exponent: 20.0, amplitude: [0.4 * strength; 3] });
    }
    Model::Lobes { constant, lobes }
}
