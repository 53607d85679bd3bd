//! A model as its WGSL twin, `brdf.wgsl`, takes it: one layout for all, a number for the model.

use bytemuck::{Pod, Zeroable};
use glam::{Vec2, Vec3};

use super::{AnalyticBrdf, Lafortune};

/// `LobeUniform` of `brdf.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct LobeUniform {
    /// ρ.
    pub reflectance: Vec3,
    /// n.
    pub exponent: f32,
    /// C, its largest component of magnitude 1.
    pub direction: Vec3,
    /// Probability that a direction is drawn from this lobe.
    pub share: f32,
}

/// `BrdfUniform` of `brdf.wgsl`. What a model has no use for is zero.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct BrdfUniform {
    /// Albedo, k_d, R_d or ρ_d.
    pub diffuse: Vec3,
    /// Phong's.
    pub exponent: f32,
    /// k_s, R_s, F(0°) or ρ_s.
    pub specular: Vec3,
    /// Probability that Phong, Ward and a measured table draw from the highlight.
    pub specular_share: f32,
    /// Cook–Torrance's reflectance at grazing incidence.
    pub f90: Vec3,
    /// What `BRDF_MODEL` is to be: [`AnalyticBrdf::number`].
    pub model: u32,
    /// Along +X and +Y: Ashikhmin–Shirley's exponents, or α.
    pub across: Vec2,
    /// Sides of the highlight ([`AnalyticBrdf::highlight`]); 0 where there is not one alone.
    pub highlight: Vec2,
    /// Lafortune's lobes.
    pub first: LobeUniform,
    /// Lafortune's lobes.
    pub second: LobeUniform,
    /// Lafortune's lobes.
    pub third: LobeUniform,
}

impl AnalyticBrdf {
    /// What the override `BRDF_MODEL` is for this model.
    pub fn number(&self) -> u32 {
        match self {
            Self::Lambert(_) => 0,
            Self::Phong(_) => 1,
            Self::AshikhminShirley(_) => 2,
            Self::CookTorrance(_) => 3,
            Self::Ward(_) => 4,
            Self::Lafortune(_) => 5,
        }
    }

    /// Its numbers, for a pipeline whose `BRDF_MODEL` is its `number`.
    pub fn uniform(&self) -> BrdfUniform {
        let highlight = self.highlight().unwrap_or(Vec2::ZERO);
        let base = BrdfUniform { model: self.number(), highlight, ..BrdfUniform::zeroed() };
        match self {
            Self::Lambert(m) => BrdfUniform { diffuse: m.albedo, ..base },
            Self::Phong(m) => {
                let specular_share = m.specular_share();
                BrdfUniform { diffuse: m.diffuse, specular: m.specular, exponent: m.exponent, specular_share, ..base }
            }
            Self::AshikhminShirley(m) => BrdfUniform { diffuse: m.diffuse, specular: m.specular, across: m.exponents, ..base },
            Self::CookTorrance(m) => BrdfUniform { specular: m.f0, f90: m.f90, across: m.alpha, ..base },
            Self::Ward(m) => {
                let specular_share = m.specular_share();
                BrdfUniform { diffuse: m.diffuse, specular: m.specular, across: m.alpha, specular_share, ..base }
            }
            Self::Lafortune(m) => {
                let [first, second, third] = lobes(m);
                BrdfUniform { diffuse: m.diffuse, first, second, third, ..base }
            }
        }
    }
}

fn lobes(model: &Lafortune) -> [LobeUniform; Lafortune::MOST_LOBES] {
    let shares = model.shares();
    std::array::from_fn(|i| {
        let lobe = model.lobes[i];
        LobeUniform { reflectance: lobe.reflectance, exponent: lobe.exponent, direction: lobe.direction, share: shares[i] }
    })
}
