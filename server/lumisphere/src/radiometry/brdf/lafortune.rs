//! Generalised cosine lobes (Lafortune, Foo, Torrance & Greenberg 1997, "Non-Linear Approximation of Reflectance Functions").
//!
//! f = ρ_d/π + Σ ρ_i (n_i+2)/2π · max(0, C_x wo.x wi.x + C_y wo.y wi.y + C_z wo.z wi.z)^n_i, each C scaled so that its largest component
//! has magnitude 1. So no lobe reflects more than its ρ_i. C = (−1, −1, 1) is Phong's highlight, (1, 1, 1) one back to the light,
//! C_z < 1 one that leans off the mirror direction toward the horizon. A published fit ρ (C·…)ⁿ has ρ_i = ρ cⁿ 2π/(n+2) with c the
//! largest |C| of its own.

use std::f32::consts::{FRAC_1_PI, TAU};

use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

use super::lobes::{cosine_hemisphere, cosine_pdf, cosine_power, one_minus_cosine, power_lobe, power_pdf};
use super::{Brdf, BrdfError, HORIZON, above_horizon, exponent, reflectance, wrong};

/// One lobe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LafortuneLobe {
    /// ρ: in [0, 1] per channel.
    pub reflectance: Vec3,
    /// C: finite, not zero; only the ratios of its components matter.
    pub direction: Vec3,
    /// n: 0 to [`super::LARGEST_EXPONENT`].
    pub exponent: f32,
}

/// A diffuse surface with up to [`Lafortune::MOST_LOBES`] lobes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lafortune {
    pub(super) diffuse: Vec3,
    /// Those beyond the given ones are black.
    pub(super) lobes: [LafortuneLobe; Self::MOST_LOBES],
}

const BLACK: LafortuneLobe = LafortuneLobe { reflectance: Vec3::ZERO, direction: Vec3::new(-1.0, -1.0, 1.0), exponent: 0.0 };

impl Lafortune {
    /// As many as published fits have.
    pub const MOST_LOBES: usize = 3;

    /// `diffuse` and the lobes' reflectances: in [0, 1], their sum too, per channel.
    pub fn new(diffuse: Vec3, lobes: &[LafortuneLobe]) -> Result<Self, BrdfError> {
        if lobes.len() > Self::MOST_LOBES {
            return Err(wrong("lobes", format!("a list of {}", lobes.len()), "at most three lobes"));
        }
        let mut all = [BLACK; Self::MOST_LOBES];
        let mut total = reflectance("diffuse", diffuse)?;
        for (lobe, given) in all.iter_mut().zip(lobes) {
            *lobe = given.scaled()?;
            total += lobe.reflectance;
        }
        if total.max_element() > 1.0 + 1e-6 {
            return Err(wrong("lobes", total, "reflectances that sum to at most 1 with diffuse"));
        }
        Ok(Self { diffuse, lobes: all })
    }

    /// Probability of each lobe; the rest is the diffuse part's.
    pub(super) fn shares(&self) -> [f32; Self::MOST_LOBES] {
        let weights = self.lobes.map(|lobe| lobe.reflectance.max_element());
        let total = weights.iter().sum::<f32>() + self.diffuse.max_element();
        if total > 0.0 { weights.map(|w| w / total) } else { weights }
    }
}

impl LafortuneLobe {
    fn scaled(self) -> Result<Self, BrdfError> {
        let largest = self.direction.abs().max_element();
        if !(largest > 0.0 && self.direction.is_finite()) {
            return Err(wrong("direction", self.direction, "three finite numbers, not all 0"));
        }
        let direction = self.direction / largest;
        Ok(Self { reflectance: reflectance("reflectance", self.reflectance)?, direction, exponent: exponent("exponent", self.exponent)? })
    }

    /// Unit axis of the lobe seen from `wo`, and the height |C wo|ⁿ of its peak. No axis where C takes all of `wo` away.
    #[inline]
    fn axis(&self, wo: Vec3) -> Option<(Vec3, f32)> {
        // 1 − |C wo|², which is exactly 0 where all |C| are 1.
        let lost = ((Vec3::ONE - self.direction * self.direction) * (wo * wo)).element_sum();
        let axis = (self.direction * wo).try_normalize()?;
        Some((axis, cosine_power(lost, 0.5 * self.exponent)))
    }
}

impl Brdf for Lafortune {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if !above_horizon(wo, wi) {
            return Vec3::ZERO;
        }
        let mut value = self.diffuse * FRAC_1_PI;
        for lobe in &self.lobes {
            if let Some((axis, peak)) = lobe.axis(wo) {
                let shape = peak * cosine_power(one_minus_cosine(axis, wi), lobe.exponent);
                value += lobe.reflectance * ((lobe.exponent + 2.0) / TAU * shape);
            }
        }
        value
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        if !(wo.z > HORIZON) {
            return None;
        }
        // What is left of u.x once the shares of the lobes before are taken off.
        let (mut rest, mut left) = (u.x, 1.0);
        for (lobe, share) in self.lobes.iter().zip(self.shares()) {
            if rest < share {
                let wi = power_lobe(lobe.axis(wo)?.0, lobe.exponent, Vec2::new(rest / share, u.y));
                let pdf = self.pdf(wo, wi);
                return (pdf > 0.0).then_some((wi, pdf));
            }
            rest -= share;
            left -= share;
        }
        let wi = cosine_hemisphere(Vec2::new((rest / left).clamp(0.0, 1.0), u.y));
        let pdf = self.pdf(wo, wi);
        (pdf > 0.0).then_some((wi, pdf))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if !above_horizon(wo, wi) {
            return 0.0;
        }
        let shares = self.shares();
        let mut pdf = (1.0 - shares.iter().sum::<f32>()).max(0.0) * cosine_pdf(wi);
        for (lobe, share) in self.lobes.iter().zip(shares) {
            if let Some((axis, _)) = lobe.axis(wo) {
                pdf += share * power_pdf(axis, lobe.exponent, wi);
            }
        }
        pdf
    }
}
