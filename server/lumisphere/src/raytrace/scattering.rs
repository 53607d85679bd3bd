//! Reflection at a surface point: value, density and sampling of Lambert, mirror and any BRDF, two-sided.

use std::f32::consts::{FRAC_1_PI, PI};

use glam::{Vec2, Vec3};

use super::sky_cells::NormalBin;
use super::surfaces::{Bumps, Reflectance, SurfacePoint, TexelGrid};
use super::warp;
use crate::geometry::TangentFrame;
use crate::radiometry::brdf::{AshikhminShirley, Brdf, BrdfModel};

/// How the point reflects, seen from `wo`: both normals on the viewer's side, albedo looked up.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scatterer<'a> {
    /// Unit, the side of the surface that `wo` sees.
    pub geometric_normal: Vec3,
    /// Unit, same side as `geometric_normal`.
    pub shading_normal: Vec3,
    /// Unit, toward the viewer.
    pub wo: Vec3,
    pub lobe: Lobe<'a>,
}

/// The scattering functions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Lobe<'a> {
    Lambert(Vec3),
    Mirror(Vec3),
    /// Neither of the two, sampled by its own means. Lambert keeps an arm of its own: most surfaces are.
    Glossy {
        brdf: &'a BrdfModel,
        /// What its +X lies along, any length; zero leaves it open.
        tangent: Vec3,
    },
    /// The same with the parameters that textures have here.
    Textured {
        brdf: AshikhminShirley,
        /// As in `Glossy`.
        tangent: Vec3,
    },
}

/// A sampled direction. `weight` = brdf · cosine / pdf.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scattered {
    pub wi: Vec3,
    pub weight: Vec3,
    /// Solid angle; None for a mirror, which only ever reflects one way.
    pub pdf: Option<f32>,
}

impl<'a> Scatterer<'a> {
    pub fn new(point: &SurfacePoint, reflectance: Reflectance, textures: &[TexelGrid], brdfs: &'a [BrdfModel], wo: Vec3) -> Self {
        let (geometric_normal, shading_normal) = facing(point, wo);
        let uv = || point.triangle.uv(point.u, point.v);
        let lobe = match reflectance {
            Reflectance::Lambert(albedo) => Lobe::Lambert(albedo),
            Reflectance::LambertTexture(texture) => Lobe::Lambert(textures[texture].sample(uv())),
            Reflectance::Mirror(reflectance) => Lobe::Mirror(reflectance),
            Reflectance::Glossy { brdf, .. } => Lobe::Glossy { brdf: &brdfs[brdf], tangent: point.triangle.tangent() },
            Reflectance::Textured(maps) => Lobe::Textured { brdf: maps.brdf(textures, uv()), tangent: point.triangle.tangent() },
            Reflectance::TexturedLambert(maps) => Lobe::Lambert(maps.albedo(textures, uv())),
        };
        Self { geometric_normal, shading_normal, wo, lobe }
    }

    /// By which normals light is to be sampled.
    #[inline]
    pub fn normal_bin(&self) -> NormalBin {
        if matches!(self.lobe, Lobe::Mirror(_)) { NormalBin::ANY } else { NormalBin::of(self.shading_normal) }
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
            Lobe::Glossy { brdf, tangent } => self.eval_glossy(brdf, tangent, wi),
            Lobe::Textured { brdf, tangent } => self.eval_glossy(&brdf, tangent, wi),
        }
    }

    fn eval_glossy(&self, brdf: &impl Brdf, tangent: Vec3, wi: Vec3) -> (Vec3, f32) {
        let frame = TangentFrame::along(self.shading_normal, tangent);
        let (wo, wi) = (frame.local_from_world(self.wo), frame.local_from_world(wi));
        (brdf.eval(wo, wi) * wi.z, brdf.pdf(wo, wi))
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
            Lobe::Glossy { brdf, tangent } => self.sample_glossy(brdf, tangent, u),
            Lobe::Textured { brdf, tangent } => self.sample_glossy(&brdf, tangent, u),
        }
    }

    fn sample_glossy(&self, brdf: &impl Brdf, tangent: Vec3, u: Vec2) -> Option<Scattered> {
        let frame = TangentFrame::along(self.shading_normal, tangent);
        let wo = frame.local_from_world(self.wo);
        let (local, pdf) = brdf.sample(wo, u)?;
        let wi = frame.world_from_local(local);
        let weight = brdf.eval(wo, local) * (local.z / pdf);
        (wi.dot(self.geometric_normal) > 0.0).then_some(Scattered { wi, weight, pdf: Some(pdf) })
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

/// The same of a surface with a normal map: its shading normal is turned, on the side that it is on without.
pub(super) fn facing_bumped(point: &SurfacePoint, wo: Vec3, bumps: Option<&Bumps>) -> (Vec3, Vec3) {
    let (geometric, shading) = facing(point, wo);
    let Some(bumps) = bumps else { return (geometric, shading) };
    let side = 1f32.copysign(point.triangle.shading_normal(point.u, point.v).dot(shading));
    (geometric, side * point.triangle.bumped_normal(point.u, point.v, bumps))
}
