//! Orthonormal basis around a normal, for shading and sampling.

use glam::{Vec2, Vec3};

/// Right-handed orthonormal basis `(tangent, bitangent, normal)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TangentFrame {
    /// First axis.
    pub tangent: Vec3,
    /// Second axis, `normal × tangent`.
    pub bitangent: Vec3,
    /// Third axis, the surface normal.
    pub normal: Vec3,
}

impl TangentFrame {
    /// A basis around the unit vector `normal`; continuous except at −Z (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
    pub fn around(normal: Vec3) -> Self {
        let sign = 1f32.copysign(normal.z);
        let a = -1.0 / (sign + normal.z);
        let b = normal.x * normal.y * a;
        Self {
            tangent: Vec3::new(1.0 + sign * normal.x * normal.x * a, sign * b, -sign * normal.x),
            bitangent: Vec3::new(b, sign + normal.y * normal.y * a, -normal.y),
            normal,
        }
    }

    /// The basis around the unit vector `normal` whose tangent lies as close to `tangent` (any length) as it can; that of `around` where
    /// `tangent` says nothing.
    pub fn along(normal: Vec3, tangent: Vec3) -> Self {
        match (tangent - normal * normal.dot(tangent)).try_normalize() {
            Some(tangent) => Self { tangent, bitangent: normal.cross(tangent), normal },
            None => Self::around(normal),
        }
    }

    /// World vector from coordinates along tangent, bitangent and normal.
    pub fn world_from_local(&self, local: Vec3) -> Vec3 {
        local.x * self.tangent + local.y * self.bitangent + local.z * self.normal
    }

    /// Coordinates along tangent, bitangent and normal of a world vector.
    pub fn local_from_world(&self, world: Vec3) -> Vec3 {
        Vec3::new(world.dot(self.tangent), world.dot(self.bitangent), world.dot(self.normal))
    }
}

/// Direction in which u grows over a triangle (∂p/∂u up to a factor above zero): what the +X of anisotropic reflection lies along. Zero
/// where its texture coordinates span no area.
pub fn tangent_along_u([a, b, c]: [Vec3; 3], [at_a, at_b, at_c]: [Vec2; 3]) -> Vec3 {
    let (to_b, to_c) = (at_b - at_a, at_c - at_a);
    let turn = to_b.perp_dot(to_c);
    if turn == 0.0 { Vec3::ZERO } else { ((b - a) * to_c.y - (c - a) * to_b.y) * turn.signum() }
}

/// Of a triangle whose corners run counter-clockwise about its normal n: 1 where v grows to the side of n × the tangent along u, −1 where its
/// texture is mirrored.
pub fn side_of_v([a, b, c]: [Vec2; 3]) -> f32 {
    if (b - a).perp_dot(c - a) < 0.0 { -1.0 } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_yields_a_right_handed_orthonormal_basis() {
        for normal in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z, Vec3::new(0.6, 0.0, -0.8)] {
            let f = TangentFrame::around(normal);
            // A handful of f32 roundings: 8 ULP of 1.
            assert!((f.tangent.cross(f.bitangent) - f.normal).length() < 1e-6);
            assert!((f.tangent.length() - 1.0).abs() < 1e-6);
            let v = Vec3::new(0.3, -0.5, 0.7);
            assert!((f.world_from_local(f.local_from_world(v)) - v).length() < 1e-6);
        }
    }

    #[test]
    fn u_grows_along_the_tangent_of_a_triangle_wound_either_way() {
        // p(u, v) = 2u · X + v · (Y + Z): ∂p/∂u = 2X.
        let at = [Vec2::new(0.2, 0.1), Vec2::new(0.9, 0.3), Vec2::new(0.4, 0.8)];
        let position = |at: Vec2| 2.0 * at.x * Vec3::X + at.y * (Vec3::Y + Vec3::Z);
        for order in [[0, 1, 2], [0, 2, 1]] {
            let uvs = order.map(|i| at[i]);
            assert!((tangent_along_u(uvs.map(position), uvs).normalize() - Vec3::X).length() < 1e-6);
        }
        assert_eq!(tangent_along_u(at.map(position), [Vec2::ONE; 3]), Vec3::ZERO);
    }

    #[test]
    fn v_grows_to_the_left_of_u_but_in_a_mirrored_texture() {
        let at = [Vec2::new(0.2, 0.1), Vec2::new(0.9, 0.3), Vec2::new(0.4, 0.8)];
        assert_eq!(side_of_v(at), 1.0);
        assert_eq!(side_of_v(at.map(|at| Vec2::new(1.0 - at.x, at.y))), -1.0);
    }

    #[test]
    fn a_given_tangent_is_kept_as_far_as_the_normal_allows() {
        let normal = Vec3::new(0.6, 0.0, -0.8);
        let f = TangentFrame::along(normal, 7.0 * Vec3::Y + 3.0 * normal);
        assert!((f.tangent - Vec3::Y).length() < 1e-6 && (f.tangent.cross(f.bitangent) - normal).length() < 1e-6);
        for nothing in [Vec3::ZERO, Vec3::NAN] {
            assert_eq!(TangentFrame::along(normal, nothing), TangentFrame::around(normal));
        }
    }
}
