//! Lambert's surface (Lambert 1760, "Photometria"): equally bright from everywhere. f = albedo / π.

use std::f32::consts::FRAC_1_PI;

use glam::{Vec2, Vec3};

use super::lobes::{cosine_hemisphere, cosine_pdf};
use super::{Brdf, BrdfError, HORIZON, above_horizon, reflectance};

/// A diffuse surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lambert {
    pub(super) albedo: Vec3,
}

impl Lambert {
    /// `albedo`: in [0, 1] per channel.
    pub fn new(albedo: Vec3) -> Result<Self, BrdfError> {
        Ok(Self { albedo: reflectance("albedo", albedo)? })
    }
}

impl Brdf for Lambert {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if above_horizon(wo, wi) { self.albedo * FRAC_1_PI } else { Vec3::ZERO }
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        let wi = cosine_hemisphere(u);
        (wo.z > HORIZON && wi.z > HORIZON).then(|| (wi, cosine_pdf(wi)))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if above_horizon(wo, wi) { cosine_pdf(wi) } else { 0.0 }
    }
}
