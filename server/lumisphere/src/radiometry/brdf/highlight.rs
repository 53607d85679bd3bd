//! How wide the highlight of a surface is that reflects by one highlight and nothing else, for those who read all of it at once, and for those
//! who choose how to read it by that width.
//!
//! Its sides are those of the rectangle over which the density p of directions at its peak amounts to all of it: their product is 1/p. Seen along the
//! normal p is a quarter of the half vectors', √((n_u+1)(n_v+1))/2π of Ashikhmin–Shirley's model and 1/(π α_x α_y) of GGX and Ward's; Phong's
//! is (n+1)/2π.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use super::AnalyticBrdf;
use crate::geometry::TangentFrame;

impl AnalyticBrdf {
    /// Sides along +X and +Y as seen along the normal, lengths on the unit sphere; None with a diffuse part, or where there may be several lobes.
    pub fn highlight(&self) -> Option<Vec2> {
        match self {
            Self::Phong(m) if m.diffuse == Vec3::ZERO => Some(Vec2::splat((TAU / (m.exponent + 1.0)).sqrt())),
            Self::AshikhminShirley(m) if m.diffuse == Vec3::ZERO => Some(2.0 * (TAU / (m.exponents + 1.0)).map(f32::sqrt)),
            Self::CookTorrance(m) => Some(2.0 * PI.sqrt() * m.alpha),
            Self::Ward(m) if m.diffuse == Vec3::ZERO => Some(2.0 * PI.sqrt() * m.alpha),
            Self::Phong(_) | Self::AshikhminShirley(_) | Self::Ward(_) | Self::Lambert(_) | Self::Lafortune(_) => None,
        }
    }

    /// Sides of the highlight, in tangent space, about the direction in which a mirror would show `wo`. With l = 2 (k·h) h − k and h = n, a half
    /// vector's step δh moves l by 2 ((k·δh) n + (k·n) δh).
    pub fn highlight_about(&self, wo: Vec3) -> Option<(Vec3, [Vec3; 2])> {
        let sides = self.highlight()?;
        let mirrored = Vec3::new(-wo.x, -wo.y, wo.z);
        if let Self::Phong(_) = self {
            let frame = TangentFrame::around(mirrored);
            return Some((mirrored, [sides.x * frame.tangent, sides.y * frame.bitangent]));
        }
        Some((mirrored, [sides.x * Vec3::new(wo.z, 0.0, wo.x), sides.y * Vec3::new(0.0, wo.z, wo.y)]))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{AshikhminShirley, Brdf, CookTorrance, Lambert, Phong, Ward};
    use super::*;

    /// 1/p on the normal and off it; GGX's facets hide some of each other, by 1 in 10³ here.
    #[test]
    fn a_highlight_is_as_large_as_its_peak_is_low() {
        let (none, white) = (Vec3::ZERO, Vec3::splat(0.9));
        let models: [AnalyticBrdf; 4] = [
            Phong::new(none, white, 200.0).unwrap().into(),
            AshikhminShirley::new(none, white, Vec2::new(100.0, 900.0)).unwrap().into(),
            CookTorrance::new(Vec2::new(0.05, 0.02), white, white).unwrap().into(),
            Ward::new(none, white, Vec2::new(0.05, 0.2)).unwrap().into(),
        ];
        for (brdf, (x, y)) in models.iter().flat_map(|m| [(0f32, 0f32), (0.6, 0.0), (-0.3, 0.7)].map(|at| (m, at))) {
            let wo = Vec3::new(x, y, (1.0 - x * x - y * y).sqrt());
            let (wi, [across, down]) = brdf.highlight_about(wo).unwrap();
            assert!(wi.dot(across).abs() < 1e-6 && wi.dot(down).abs() < 1e-6, "{brdf:?}: not on the sphere about {wi}");
            let area = across.cross(down).length();
            assert!((area * brdf.pdf(wo, wi) - 1.0).abs() < 2e-3, "{brdf:?} toward {wo}: {area} for {}", 1.0 / brdf.pdf(wo, wi));
        }
    }

    #[test]
    fn more_than_a_highlight_is_none() {
        let coated = AshikhminShirley::new(Vec3::splat(0.1), Vec3::splat(0.5), Vec2::splat(100.0)).unwrap();
        assert_eq!(AnalyticBrdf::from(coated).highlight(), None);
        assert_eq!(AnalyticBrdf::from(Lambert::new(Vec3::ONE).unwrap()).highlight(), None);
    }
}
