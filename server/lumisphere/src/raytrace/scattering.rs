//! Reflection at a surface point: value, density and sampling of Lambert, mirror and GGX (F = 1), two-sided.

use std::f32::consts::{FRAC_1_PI, PI};

use glam::{Vec2, Vec3};

use super::sky_cells::NormalBin;
use super::surfaces::{Reflectance, SurfacePoint, TexelGrid};
use super::warp;
use crate::geometry::TangentFrame;

/// How the point reflects, seen from `wo`: both normals on the viewer's side, albedo looked up.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scatterer {
    /// Unit, the side of the surface that `wo` sees.
    pub geometric_normal: Vec3,
    /// Unit, same side as `geometric_normal`.
    pub shading_normal: Vec3,
    /// Unit, toward the viewer.
    pub wo: Vec3,
    pub lobe: Lobe,
}

/// The scattering functions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Lobe {
    Lambert(Vec3),
    Mirror(Vec3),
    Ggx { alpha: f32, reflectance: Vec3 },
}

/// A sampled direction. `weight` = brdf · cosine / pdf.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scattered {
    pub wi: Vec3,
    pub weight: Vec3,
    /// Solid angle; None for a mirror, which only ever reflects one way.
    pub pdf: Option<f32>,
}

impl Scatterer {
    pub fn new(point: &SurfacePoint, reflectance: Reflectance, textures: &[TexelGrid], wo: Vec3) -> Self {
        let (geometric_normal, shading_normal) = facing(point, wo);
        let lobe = match reflectance {
            Reflectance::Lambert(albedo) => Lobe::Lambert(albedo),
            Reflectance::LambertTexture(texture) => Lobe::Lambert(textures[texture].sample(point.triangle.uv(point.u, point.v))),
            Reflectance::Mirror(reflectance) => Lobe::Mirror(reflectance),
            Reflectance::Ggx { alpha, reflectance } => Lobe::Ggx { alpha, reflectance },
        };
        Self { geometric_normal, shading_normal, wo, lobe }
    }

    /// By which normals light is to be sampled.
    #[inline]
    pub fn normal_bin(&self) -> NormalBin {
        if matches!(self.lobe, Lobe::Lambert(_)) { NormalBin::of(self.shading_normal) } else { NormalBin::ANY }
    }

    /// brdf · cosine and the density with which `sample` draws `wi` (solid angle). Zero for a mirror and below the surface:
    /// a direction must be above both normals, or light would leak through the triangles.
    #[inline]
    pub fn eval(&self, wi: Vec3) -> (Vec3, f32) {
        let cosine = wi.dot(self.shading_normal);
        if !(cosine > 0.0 && wi.dot(self.geometric_normal) > 0.0) {
            return (Vec3::ZERO, 0.0);
        }
        match self.lobe {
            Lobe::Lambert(albedo) => (albedo * (cosine * FRAC_1_PI), cosine * FRAC_1_PI),
            Lobe::Mirror(_) => (Vec3::ZERO, 0.0),
            Lobe::Ggx { alpha, reflectance } => {
                let frame = TangentFrame::around(self.shading_normal);
                let (value, pdf) = ggx(frame.local_from_world(self.wo), frame.local_from_world(wi), alpha);
                (reflectance * value, pdf)
            }
        }
    }

    /// A direction to go on with; None where the surface absorbs it.
    #[inline]
    pub fn sample(&self, u: Vec2) -> Option<Scattered> {
        match self.lobe {
            Lobe::Lambert(albedo) => {
                let local = warp::cosine_hemisphere(u);
                let wi = TangentFrame::around(self.shading_normal).world_from_local(local);
                (local.z > 0.0 && wi.dot(self.geometric_normal) > 0.0).then_some(Scattered { wi, weight: albedo, pdf: Some(local.z / PI) })
            }
            Lobe::Mirror(reflectance) => Some(Scattered { wi: self.mirrored(), weight: reflectance, pdf: None }),
            Lobe::Ggx { alpha, reflectance } => self.sample_ggx(alpha, reflectance, u),
        }
    }

    fn sample_ggx(&self, alpha: f32, reflectance: Vec3, u: Vec2) -> Option<Scattered> {
        let frame = TangentFrame::around(self.shading_normal);
        let wo = frame.local_from_world(self.wo);
        if !(wo.z > 0.0) {
            return None;
        }
        let m = warp::ggx_visible_normal(wo, alpha, u);
        let wi = 2.0 * wo.dot(m) * m - wo;
        let (value, pdf) = ggx(wo, wi, alpha);
        let direction = frame.world_from_local(wi);
        (pdf > 0.0 && direction.dot(self.geometric_normal) > 0.0).then_some(Scattered {
            wi: direction,
            weight: reflectance * (value / pdf),
            pdf: Some(pdf),
        })
    }

    /// The mirror direction about the shading normal; about the geometric one where the former would enter the surface.
    pub fn mirrored(&self) -> Vec3 {
        let about = |n: Vec3| 2.0 * self.wo.dot(n) * n - self.wo;
        let wi = about(self.shading_normal);
        if wi.dot(self.geometric_normal) > 0.0 { wi } else { about(self.geometric_normal) }
    }
}

/// Geometric and shading normal on the side that `wo` sees. The geometry decides which side, so a smooth silhouette has no black rim.
pub(super) fn facing(point: &SurfacePoint, wo: Vec3) -> (Vec3, Vec3) {
    let geometric = point.triangle.front * 1f32.copysign(point.triangle.front.dot(wo));
    let shading = point.triangle.shading_normal(point.u, point.v);
    (geometric, shading * 1f32.copysign(shading.dot(geometric)))
}

/// brdf · cosine and density of GGX with F = 1, in tangent space. Zero unless both directions are above the surface.
#[inline]
fn ggx(wo: Vec3, wi: Vec3, alpha: f32) -> (f32, f32) {
    if !(wo.z > 0.0 && wi.z > 0.0) {
        return (0.0, 0.0);
    }
    let m = (wo + wi).normalize_or(Vec3::Z);
    let (lambda_o, lambda_i) = (warp::ggx_lambda(wo, alpha), warp::ggx_lambda(wi, alpha));
    // D / (4 cos θo) is common: brdf · cos θi = D G₂ / (4 cos θo), pdf = D G₁ / (4 cos θo).
    let common = warp::ggx_distribution(m, alpha) / (4.0 * wo.z);
    (common / (1.0 + lambda_o + lambda_i), common / (1.0 + lambda_o))
}
