//! Bicubic Bézier patches (methods page 1: `x(u,v) = Σᵢ Σⱼ CPᵢⱼ Bᵢ³(u) Bⱼ³(v)`).

use glam::Vec3;

/// Sixteen control points, `points[4 i + j]` = CPᵢⱼ; i goes with u, j with v.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BezierPatch {
    /// Control points in the space of the patch's owner.
    pub points: [Vec3; 16],
}

/// A patch at one (u, v).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchPoint {
    /// On the surface.
    pub position: Vec3,
    /// Unit `∂u × ∂v`; where an edge collapses to a point, the limit from inside.
    pub normal: Vec3,
}

// Cubic Bernstein polynomials at t.
fn bernstein(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [s * s * s, 3.0 * s * s * t, 3.0 * s * t * t, t * t * t]
}

// Their derivatives at t.
fn bernstein_derivative(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [-3.0 * s * s, 3.0 * s * s - 6.0 * s * t, 6.0 * s * t - 3.0 * t * t, 3.0 * t * t]
}

impl BezierPatch {
    /// Position at (u, v) in [0, 1]².
    pub fn position(&self, u: f32, v: f32) -> Vec3 {
        self.weighted(bernstein(u), bernstein(v))
    }

    /// Partial derivatives (∂u, ∂v).
    pub fn derivatives(&self, u: f32, v: f32) -> (Vec3, Vec3) {
        (self.weighted(bernstein_derivative(u), bernstein(v)), self.weighted(bernstein(u), bernstein_derivative(v)))
    }

    /// Position and normal at (u, v). Where the derivatives' cross product vanishes (collapsed edges: a lid's apex, a
    /// bottom's centre), the normal is taken a small step toward the patch's middle.
    pub fn point(&self, u: f32, v: f32) -> PatchPoint {
        let position = self.position(u, v);
        // Steps inward until the cross product is safely above rounding error of the control points' extent.
        let extent = self.points.iter().fold(0f32, |m, p| m.max((*p - position).length()));
        for step in [0.0, 1e-3, 1e-2, 0.1, 0.5] {
            let (du, dv) = self.derivatives(u + step * (0.5 - u), v + step * (0.5 - v));
            let cross = du.cross(dv);
            if cross.length() > 1e-5 * extent * extent {
                return PatchPoint { position, normal: cross.normalize() };
            }
        }
        PatchPoint { position, normal: Vec3::Y }
    }

    /// The same surface with u and v exchanged, so that its normal turns round.
    pub fn flipped(&self) -> Self {
        let mut points = self.points;
        for i in 0..4 {
            for j in 0..4 {
                points[4 * i + j] = self.points[4 * j + i];
            }
        }
        Self { points }
    }

    fn weighted(&self, bu: [f32; 4], bv: [f32; 4]) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for (i, wu) in bu.iter().enumerate() {
            for (j, wv) in bv.iter().enumerate() {
                sum += wu * wv * self.points[4 * i + j];
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bump() -> BezierPatch {
        let mut points = [Vec3::ZERO; 16];
        for i in 0..4 {
            for j in 0..4 {
                let z = if (1..3).contains(&i) && (1..3).contains(&j) { 1.0 } else { 0.0 };
                points[4 * i + j] = Vec3::new(i as f32 / 3.0, j as f32 / 3.0, z);
            }
        }
        BezierPatch { points }
    }

    #[test]
    fn equally_spaced_control_points_reproduce_u_and_v() {
        let p = bump().position(0.3, 0.8);
        assert!((p.x - 0.3).abs() < 1e-6 && (p.y - 0.8).abs() < 1e-6);
        // Centre height: (Σ inner Bernstein)² = (3/4)².
        assert!((bump().position(0.5, 0.5).z - 0.5625).abs() < 1e-6);
    }

    #[test]
    fn derivatives_agree_with_central_differences() {
        let (patch, u, v, h) = (bump(), 0.27, 0.61, 1e-3);
        let (du, dv) = patch.derivatives(u, v);
        let nu = (patch.position(u + h, v) - patch.position(u - h, v)) / (2.0 * h);
        let nv = (patch.position(u, v + h) - patch.position(u, v - h)) / (2.0 * h);
        // Third derivative ~ 18: truncation 18·h²/6 = 3e-6; rounding 1e-7/h = 1e-4.
        assert!((du - nu).length() < 5e-4 && (dv - nv).length() < 5e-4);
    }

    #[test]
    fn flipping_turns_the_normal_round_and_keeps_the_surface() {
        let (a, b) = (bump().point(0.2, 0.7), bump().flipped().point(0.7, 0.2));
        assert!((a.position - b.position).length() < 1e-6);
        assert!((a.normal + b.normal).length() < 1e-5);
    }

    #[test]
    fn a_collapsed_edge_still_has_a_unit_normal_near_its_neighbours() {
        let mut patch = bump();
        for j in 0..4 {
            patch.points[j] = Vec3::new(0.0, 0.5, 0.0);
        }
        let apex = patch.point(0.0, 0.3).normal;
        let beside = patch.point(0.01, 0.3).normal;
        assert!((apex.length() - 1.0).abs() < 1e-5);
        assert!(apex.dot(beside) > 0.9);
    }
}
