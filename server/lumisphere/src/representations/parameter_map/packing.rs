//! A model as numbers in quads, four each, small enough in magnitude for f16.
//!
//! - constant: `K`, 0;
//! - cosine power: `K`, exponent;
//! - lobes: `K_d`, 0; then two quads a lobe: `K_s`, ln m; the axis on the hemi-octahedral square, as the two nearest f16 numbers and what they
//!   leave: 11 bits are 0.02°, too few beside a lobe of 2° (m = 1000), and 22 are enough;
//! - harmonics: three quads for four coefficients, R G B R | G B R G | B R G B, zeros behind the last.
//!
//! Source of the square: Cigolle et al. 2014, "A Survey of Efficient Representations for Independent Unit Vectors".

use half::f16;

use crate::fitting::{Basis, Lobe, Model};

/// Which model a texel has, as stored: 0 none, 1 constant, 2 cosine power, 2 + J for J = 1 … 4 lobes, 16 + n for n = 1 … 10 bands of
/// hemispherical harmonics, 32 + n of spherical ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ModelCode(u8);

/// A model's quads.
pub type Quads = Vec<[f32; 4]>;

const CONSTANT: u8 = 1;
const COSINE_POWER: u8 = 2;
const MOST_LOBES: u8 = 4;
const HEMISPHERICAL: u8 = 16;
const SPHERICAL: u8 = 32;
const MOST_BANDS: u8 = 10;

impl ModelCode {
    /// Nothing is known there.
    pub const NONE: Self = Self(0);

    /// Of a model; NONE for one that cannot be stored (no lobes or more than four, not n² coefficients or more than 100).
    pub fn of(model: &Model) -> Self {
        match model {
            Model::Constant { .. } => Self(CONSTANT),
            Model::CosinePower { .. } => Self(COSINE_POWER),
            Model::Lobes { lobes, .. } if (1..=usize::from(MOST_LOBES)).contains(&lobes.len()) => Self(COSINE_POWER + lobes.len() as u8),
            Model::Harmonics { basis, coefficients } => {
                let first = match basis {
                    Basis::Hemispherical => HEMISPHERICAL,
                    Basis::Spherical => SPHERICAL,
                };
                (1..=MOST_BANDS).find(|n| usize::from(*n).pow(2) == coefficients.len()).map_or(Self::NONE, |n| Self(first + n))
            }
            Model::Lobes { .. } => Self::NONE,
        }
    }

    /// From a file; None for numbers that mean nothing.
    pub fn from_number(number: u8) -> Option<Self> {
        let is_known = number <= COSINE_POWER + MOST_LOBES
            || (HEMISPHERICAL + 1..=HEMISPHERICAL + MOST_BANDS).contains(&number)
            || (SPHERICAL + 1..=SPHERICAL + MOST_BANDS).contains(&number);
        is_known.then_some(Self(number))
    }

    /// As stored.
    pub fn number(self) -> u8 {
        self.0
    }

    /// How many quads such a model takes.
    pub fn quads(self) -> u32 {
        match self.0 {
            0 => 0,
            CONSTANT | COSINE_POWER => 1,
            _ => match self.bands() {
                None => 1 + 2 * self.lobes(),
                Some(n) => 3 * (n * n).div_ceil(4),
            },
        }
    }

    /// In histograms and reports.
    pub fn name(self) -> String {
        match (self.0, self.bands()) {
            (0, _) => "none".into(),
            (CONSTANT, _) => "constant".into(),
            (COSINE_POWER, _) => "cosine_power".into(),
            (number, Some(n)) if number > SPHERICAL => format!("sh:{} (sphere)", n * n),
            (_, Some(n)) => format!("sh:{}", n * n),
            (_, None) => format!("phong:{}", self.lobes()),
        }
    }

    /// 0 for other models.
    pub(super) fn lobes(self) -> u32 {
        if (COSINE_POWER + 1..=COSINE_POWER + MOST_LOBES).contains(&self.0) { u32::from(self.0 - COSINE_POWER) } else { 0 }
    }

    /// Of harmonics.
    pub(super) fn bands(self) -> Option<u32> {
        (self.0 > HEMISPHERICAL).then(|| u32::from(self.0 % HEMISPHERICAL))
    }

    /// Of harmonics.
    #[cfg(feature = "gpu")]
    pub(super) fn basis(self) -> Option<Basis> {
        self.bands().map(|_| if self.0 > SPHERICAL { Basis::Spherical } else { Basis::Hemispherical })
    }

    /// The numbers of a model of this code.
    pub fn pack(model: &Model) -> (Self, Quads) {
        let code = Self::of(model);
        let quads = match model {
            _ if code == Self::NONE => Vec::new(),
            Model::Constant { value: [r, g, b] } => vec![[*r, *g, *b, 0.0]],
            Model::CosinePower { value: [r, g, b], exponent } => vec![[*r, *g, *b, *exponent]],
            Model::Lobes { constant: [r, g, b], lobes } => {
                std::iter::once([*r, *g, *b, 0.0]).chain(lobes.iter().flat_map(pack_lobe)).collect()
            }
            Model::Harmonics { coefficients, .. } => {
                let mut numbers = coefficients.as_flattened().to_vec();
                numbers.resize(4 * code.quads() as usize, 0.0);
                numbers.chunks_exact(4).map(|q| [q[0], q[1], q[2], q[3]]).collect()
            }
        };
        (code, quads)
    }

    /// The model whose numbers these are; None for NONE and for too few quads.
    pub fn unpack(self, quads: &[[f32; 4]]) -> Option<Model> {
        if quads.len() < self.quads() as usize {
            return None;
        }
        let rgb = |q: [f32; 4]| [q[0], q[1], q[2]];
        match (self.0, self.bands()) {
            (0, _) => None,
            (CONSTANT, _) => Some(Model::Constant { value: rgb(quads[0]) }),
            (COSINE_POWER, _) => Some(Model::CosinePower { value: rgb(quads[0]), exponent: quads[0][3] }),
            (number, Some(n)) => {
                let basis = if number > SPHERICAL { Basis::Spherical } else { Basis::Hemispherical };
                let numbers = &quads.as_flattened()[..3 * (n * n) as usize];
                Some(Model::Harmonics { basis, coefficients: numbers.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect() })
            }
            (_, None) => {
                let lobes = quads[1..1 + 2 * self.lobes() as usize].chunks_exact(2).map(|q| unpack_lobe(q[0], q[1])).collect();
                Some(Model::Lobes { constant: rgb(quads[0]), lobes })
            }
        }
    }
}

fn pack_lobe(lobe: &Lobe) -> [[f32; 4]; 2] {
    let [x, y, z] = lobe.axis;
    let scale = 1.0 / (x.abs() + y.abs() + z);
    let square = [(x + y) * scale, (x - y) * scale];
    let near = square.map(|c| f16::from_f32(c).to_f32());
    let [r, g, b] = lobe.amplitude;
    [[r, g, b, lobe.exponent.ln()], [near[0], near[1], square[0] - near[0], square[1] - near[1]]]
}

fn unpack_lobe([r, g, b, ln_exponent]: [f32; 4], [near_u, near_v, u, v]: [f32; 4]) -> Lobe {
    Lobe { axis: axis(near_u + u, near_v + v), exponent: ln_exponent.exp(), amplitude: [r, g, b] }
}

// The unit direction of a point of the hemi-octahedral square. Twin in kernel.wgsl.
fn axis(u: f32, v: f32) -> [f32; 3] {
    let (x, y) = (0.5 * (u + v), 0.5 * (u - v));
    let z = 1.0 - x.abs() - y.abs();
    let scale = 1.0 / (x * x + y * y + z * z).sqrt();
    [x, y, z].map(|c| c * scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn through_f16(quads: &[[f32; 4]]) -> Quads {
        quads.iter().map(|q| q.map(|c| f16::from_f32(c).to_f32())).collect()
    }

    #[test]
    fn every_model_comes_back_as_it_was() {
        let lobe = |x: f32, m| {
            let axis = glam::Vec3::new(x, 0.3 - x, 0.4).normalize().to_array();
            Lobe { axis, exponent: m, amplitude: [0.5, 0.25, 8.0] }
        };
        let constant = [0.25, 0.5, 1.0];
        let mut models = vec![Model::Constant { value: constant }, Model::CosinePower { value: constant, exponent: -0.5 }];
        models.extend((1..=4).map(|j| Model::Lobes { constant, lobes: (0..j).map(|k| lobe(0.2 * k as f32, 3.0 + k as f32)).collect() }));
        for basis in [Basis::Hemispherical, Basis::Spherical] {
            models.extend(
                (1..=10usize).map(|n| Model::Harmonics {
                    basis,
                    coefficients: (0..n * n).map(|i| [i as f32, -(i as f32), 0.5 * i as f32]).collect(),
                }),
            );
        }
        for model in models {
            let (code, quads) = ModelCode::pack(&model);
            assert_eq!(quads.len() as u32, code.quads(), "{}", code.name());
            assert_eq!(ModelCode::from_number(code.number()), Some(code));
            let back = code.unpack(&quads).unwrap();
            assert_eq!(ModelCode::of(&back), code);
            // ln and exp, and the square and back: a few roundings.
            for d in [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.36, 0.48, 0.8]] {
                let (a, b) = (model.eval(d), back.eval(d));
                assert!((0..3).all(|c| (a[c] - b[c]).abs() <= 2e-6 * (1.0 + a[c].abs())), "{}: {a:?} {b:?}", code.name());
            }
            assert_eq!(code.unpack(&quads[1..]), None);
        }
    }

    #[test]
    fn the_narrowest_lobe_keeps_its_place_in_f16() {
        let axis = glam::Vec3::new(0.61, -0.35, 0.42).normalize();
        let model = Model::Lobes { constant: [0.0; 3], lobes: vec![Lobe { axis: axis.to_array(), exponent: 1000.0, amplitude: [1.0; 3] }] };
        let (code, quads) = ModelCode::pack(&model);
        let back = code.unpack(&through_f16(&quads)).unwrap();
        let side = axis.any_orthonormal_vector();
        for step in 0..40 {
            // Over three half widths; half precision of ln m = 6.9 is 0.2 % of m, up to 0.08 % of the lobe: ln m · m-derivative ≤ e⁻¹ · 0.002.
            let d = (axis + 0.003 * step as f32 * side).normalize().to_array();
            let (a, b) = (model.eval(d)[0], back.eval(d)[0]);
            assert!((a - b).abs() < 1.5e-3, "{step}: {a} {b}");
        }
    }

    #[test]
    fn what_is_no_model_has_no_code() {
        assert_eq!(ModelCode::of(&Model::Lobes { constant: [0.0; 3], lobes: vec![] }), ModelCode::NONE);
        assert_eq!(ModelCode::of(&Model::Harmonics { basis: Basis::Spherical, coefficients: vec![[0.0; 3]; 5] }), ModelCode::NONE);
        assert_eq!([7, 16, 27, 32, 43, 255].map(ModelCode::from_number), [None; 6]);
        assert_eq!(ModelCode::NONE.unpack(&[]), None);
    }
}
