//! Phong's highlight made physical (Lafortune & Willems 1994, "Using the Modified Phong Reflectance Model for Physically Based Rendering").
//!
//! f = k_d/π + k_s (n+2)/2π cosⁿ α, α between `wi` and the mirror direction of `wo`. The lobe reflects k_s at normal incidence and less
//! where the horizon cuts it.

use std::f32::consts::{FRAC_1_PI, TAU};

use glam::{Vec2, Vec3};

use super::lobes::{cosine_pdf, cosine_power, one_minus_cosine, power_lobe, power_pdf, sample_highlight};
use super::{Brdf, BrdfError, above_horizon, exponent, reflectances, share_of_second};

/// A diffuse surface with an isotropic highlight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Phong {
    pub(super) diffuse: Vec3,
    pub(super) specular: Vec3,
    pub(super) exponent: f32,
}

impl Phong {
    /// `diffuse` and `specular`: in [0, 1], their sum too, per channel. `exponent`: 0 to [`super::LARGEST_EXPONENT`].
    pub fn new(diffuse: Vec3, specular: Vec3, exponent_n: f32) -> Result<Self, BrdfError> {
        let (diffuse, specular) = reflectances(diffuse, specular)?;
        Ok(Self { diffuse, specular, exponent: exponent("exponent", exponent_n)? })
    }

    pub(super) fn specular_share(&self) -> f32 {
        share_of_second(self.diffuse, self.specular)
    }
}

#[inline]
fn turned_about_normal(w: Vec3) -> Vec3 {
    Vec3::new(-w.x, -w.y, w.z)
}

impl Brdf for Phong {
    fn eval(&self, wo: Vec3, wi: Vec3) -> Vec3 {
        if !above_horizon(wo, wi) {
            return Vec3::ZERO;
        }
        let lobe = (self.exponent + 2.0) / TAU * cosine_power(one_minus_cosine(turned_about_normal(wo), wi), self.exponent);
        self.diffuse * FRAC_1_PI + self.specular * lobe
    }

    fn sample(&self, wo: Vec3, u: Vec2) -> Option<(Vec3, f32)> {
        sample_highlight(self, wo, u, self.specular_share(), |u| power_lobe(turned_about_normal(wo), self.exponent, u))
    }

    fn pdf(&self, wo: Vec3, wi: Vec3) -> f32 {
        if !above_horizon(wo, wi) {
            return 0.0;
        }
        let share = self.specular_share();
        (1.0 - share) * cosine_pdf(wi) + share * power_pdf(turned_about_normal(wo), self.exponent, wi)
    }
}
