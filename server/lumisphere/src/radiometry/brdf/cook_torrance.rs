//! Cook & Torrance's microfacet model (1982) with GGX facets (Walter et al. 2007), anisotropic (Heitz 2014, eq. 85), Smith's masking and
//! shadowing correlated by height (Heitz 2014, eq. 99), Schlick's Fresnel term.
//!
//! f = D(m) G₂(wo, wi) F(wo·m) / (4 cos θo cos θi), m the half vector. Facets are drawn as `wo` sees them by spherical caps (Dupuy &
//! Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"), so a sample has weight F G₂/G₁ ≤ F.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::lobes::reflected;
use super::{Brdf, BrdfError, HORIZON, above_horizon, fresnel, half_vector, reflectance, roughness};

/// A rough conductor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CookTorrance {
    /// α along +X and +Y.
    pub(super) alpha: Vec2,
    pub(super) f0: Vec3,
    pub(super) f90: Vec3,
}

impl CookTorrance {
    /// `alpha`: GGX roughness along the two tangents, in [0, 1], at least [`super::SMOOTHEST`] in effect. `f0`, `f90`: reflectance of a
    /// facet at normal and at grazing incidence, in [0, 1] per channel; equal ones switch Fresnel's term off.
    pub fn new(alpha: Vec2, f0: Vec3, f90: Vec3) -> Result<Self, BrdfError> {
        let alpha = Vec2::new(roughness("alpha_x", alpha.x)?, roughness("alpha_y", alpha.y)?);
        Ok(Self { alpha, f0: reflectance("f0", f0)?, f90: reflectance("f90", f90)? })
    }

    /// D: density of facets per steradian and projected area, for `m.z ≥ 0`.
    #[inline]
    fn distribution(&self, m: Vec3) -> f32 {
        let (x, y) = (m.x / self.alpha.x, m.y / self.alpha.y);
        let d = x * x + y * y + m.z * m.z;
        1.0 / (PI * self.alpha.x * self.alpha.y * d * d)
    }

    /// Smith's Λ: G₁(w) = 1/(1+Λ(w)), G₂(wo, wi) = 1/(1+Λ(wo)+Λ(wi)).
    #[inline]
    fn lambda(&self, w: Vec3) -> f32 {
        let (x, y) = (self.alpha.x * w.x, self.alpha.y * w.y);
        0.5 * ((1.0 + (x * x + y * y) / (w.z * w.z)).sqrt() - 1.0)
    }

    /// A facet's normal as seen from `wo`, density G₁(wo) max(0, wo·m) D(m) / wo.z.
    #[inline]
    fn sample_facet(&self, wo: Vec3, u: Vec2) -> Vec3 {
        // Stretched until the facets form a hemisphere, what they mirror `wo` to covers the sphere above −wo.z evenly.
        let stretched = Vec3::new(self.alpha.x * wo.x, self.alpha.y * wo.y, wo.z).normalize();
        let z = (1.0 - u.x) * (1.0 + stretched.z) - stretched.z;
        let radius = (1.0 - z * z).max(0.0).sqrt();
        let (sin, cos) = (TAU * u.y).sin_cos();
        let h = Vec3::new(radius * cos, radius * sin, z) + stretched;
        Vec3::new(self.alpha.x * h.x, self.alpha.y * h.y, h.z.max(0.0)).normalize_or(Vec3::Z)
    }
}

impl Brdf for CookTorrance {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if !above_horizon(wo, wi) {
            return Vec3::ZERO;
        }
        let (m, along) = half_vector(wo, wi);
        let masking = 1.0 + self.lambda(wo) + self.lambda(wi);
        fresnel(self.f0, self.f90, along) * (self.distribution(m) / (4.0 * wo.z * wi.z * masking))
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        if !(wo.z > HORIZON) {
            return None;
        }
        let wi = reflected(wo, self.sample_facet(wo, u));
        let pdf = self.pdf(wo, wi);
        (pdf > 0.0).then_some((wi, pdf))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if !above_horizon(wo, wi) {
            return 0.0;
        }
        let (m, _) = half_vector(wo, wi);
        self.distribution(m) / (4.0 * wo.z * (1.0 + self.lambda(wo)))
    }
}
