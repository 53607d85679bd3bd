//! Ashikhmin & Shirley's anisotropic Phong model (2000, "An Anisotropic Phong BRDF Model"), the one that the offset surface light field's
//! paper renders with. k₁ = `wo`, k₂ = `wi`, h their half vector:
//!
//! - f_s = √((n_u+1)(n_v+1)) / 8π · D(h) / ((h·k) max(n·k₁, n·k₂)) · F(k·h), D = (n·h)^((n_u h_x² + n_v h_y²)/(1 − (n·h)²))
//! - f_d = 28 R_d/(23π) (1 − R_s) (1 − (1 − n·k₁/2)⁵) (1 − (1 − n·k₂/2)⁵), F(c) = R_s + (1 − R_s)(1 − c)⁵
//!
//! A sample of f_s has weight F cos θ₂ / max(cos θ₁, cos θ₂) ≤ F. A black R_s still reflects at grazing angles, as F there goes to 1.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::lobes::{cosine_pdf, log_ratio, one_minus_exp, reflected, sample_highlight};
use super::{Brdf, BrdfError, LARGEST_EXPONENT, above_horizon, exponent, fifth_power, fresnel, half_vector, reflectance, share_of_second};

/// A diffuse surface under an anisotropic, Fresnel-weighted highlight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AshikhminShirley {
    pub(super) diffuse: Vec3,
    pub(super) specular: Vec3,
    /// n_u (along +X) and n_v (along +Y).
    pub(super) exponents: Vec2,
}

impl AshikhminShirley {
    /// `diffuse` R_d and `specular` R_s (reflectance at normal incidence): in [0, 1] per channel. `exponents` n_u, n_v: 0 to
    /// [`super::LARGEST_EXPONENT`]; the larger, the narrower the highlight along that tangent.
    pub fn new(diffuse: Vec3, specular: Vec3, exponents: Vec2) -> Result<Self, BrdfError> {
        Ok(Self {
            diffuse: reflectance("diffuse", diffuse)?,
            specular: reflectance("specular", specular)?,
            exponents: Vec2::new(exponent("exponent_u", exponents.x)?, exponent("exponent_v", exponents.y)?),
        })
    }

    /// From the texels of a surface, which filtering may leave a rounding out of their range: all are clamped into [0, 1]. `roughness` α
    /// along +X and +Y becomes n = 2/α² − 2 (Walter et al. 2007, "Microfacet Models for Refraction", p. 7), at most
    /// [`super::LARGEST_EXPONENT`].
    #[inline]
    pub fn from_texels(diffuse: Vec3, specular: Vec3, roughness: Vec2) -> Self {
        let alpha = roughness.clamp(Vec2::ZERO, Vec2::ONE);
        let exponents = (2.0 / (alpha * alpha) - 2.0).min(Vec2::splat(LARGEST_EXPONENT));
        Self { diffuse: diffuse.clamp(Vec3::ZERO, Vec3::ONE), specular: specular.clamp(Vec3::ZERO, Vec3::ONE), exponents }
    }

    /// √((n_u+1)(n_v+1)) / 2π · (n·h)^…: density of half vectors per steradian.
    #[inline]
    fn half_pdf(&self, h: Vec3) -> f32 {
        // ln(n·h) = ½ ln(1 − sin²): the quotient by sin² stays in `log_ratio`, which has no pole.
        let sine2 = (h.x * h.x + h.y * h.y).min(LARGEST_SINE2);
        let turned = self.exponents.x * h.x * h.x + self.exponents.y * h.y * h.y;
        let norm = ((self.exponents.x + 1.0) * (self.exponents.y + 1.0)).sqrt() / TAU;
        norm * (-0.5 * turned * log_ratio(sine2)).exp()
    }

    fn sample_half(&self, u: Vec2) -> Vec3 {
        // The paper's φ = atan(√((n_u+1)/(n_v+1)) tan ψ), for all quadrants at once.
        let (sin, cos) = (TAU * u.y).sin_cos();
        let across = Vec2::new(cos * (self.exponents.y + 1.0).sqrt(), sin * (self.exponents.x + 1.0).sqrt()).normalize();
        let n = self.exponents.x * across.x * across.x + self.exponents.y * across.y * across.y;
        let t = -(1.0 - u.x).ln() / (n + 1.0);
        (across * one_minus_exp(2.0 * t).sqrt()).extend((-t).exp())
    }

    #[inline]
    fn specular_share(&self, wo: Vec3) -> f32 {
        share_of_second(self.diffuse * (Vec3::ONE - self.specular), fresnel(self.specular, Vec3::ONE, wo.z))
    }
}

// A half vector in the surface: its logarithm is finite.
const LARGEST_SINE2: f32 = 1.0 - 1e-7;

impl Brdf for AshikhminShirley {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if !above_horizon(wo, wi) {
            return Vec3::ZERO;
        }
        let (h, along) = half_vector(wo, wi);
        let specular = fresnel(self.specular, Vec3::ONE, along) * (self.half_pdf(h) / (4.0 * along * wo.z.max(wi.z)));
        let rim = |cosine: f32| 1.0 - fifth_power(1.0 - 0.5 * cosine);
        let diffuse = self.diffuse * (Vec3::ONE - self.specular) * (28.0 / (23.0 * PI) * rim(wo.z) * rim(wi.z));
        diffuse + specular
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        sample_highlight(self, wo, u, self.specular_share(wo), |u| reflected(wo, self.sample_half(u)))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if !above_horizon(wo, wi) {
            return 0.0;
        }
        let (h, along) = half_vector(wo, wi);
        let share = self.specular_share(wo);
        (1.0 - share) * cosine_pdf(wi) + share * self.half_pdf(h) / (4.0 * along)
    }
}
