//! Normal maps: textures that turn a surface's normal. `raytrace` reads them for the truth, representations for frames; files come through
//! `formats::normal_map`. The twin on the GPU is `bumps.wgsl`.
//!
//! A texel holds a unit normal (x, y, z), z > 0, where +X runs along the texture's u, +Y along its v and +Z along the surface's own normal n. It is
//! kept as its slopes `s = (x, y) / z`, which are those of a height field, and which strength scales as it scales x and y: between texels'
//! centres they are interpolated bilinearly, beyond the edges they repeat, and
//! `n' = normalize(n + s_x t + s_y b)`, t the tangent along u, b = ±n × t on the side to which v grows.

use glam::{Vec2, Vec3};
use half::f16;

use super::TangentFrame;

/// A map of at least one texel.
#[derive(Debug, Clone, PartialEq)]
pub struct NormalMap {
    width: usize,
    height: usize,
    /// Row by row from the top, where v = 1. f16 has 11 bits for each: an angle of at most 0.014°.
    slopes: Vec<[f16; 2]>,
}

/// How a map lies on a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mapping {
    /// What slopes are multiplied with; negative turns hills into hollows.
    pub strength: f32,
    /// How often it repeats over u and v from 0 to 1.
    pub repeat: f32,
}

/// How u and v lie on a surface's point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tangent {
    /// Where u grows, any length; zero leaves it open.
    pub along_u: Vec3,
    /// 1 where v grows to the side of n × `along_u`, −1 where the texture is mirrored.
    pub side_of_v: f32,
}

impl NormalMap {
    /// Of slopes row by row from the top; None where their count is not that of the texels, none, or one is not finite.
    pub fn new(width: usize, height: usize, slopes: impl IntoIterator<Item = Vec2>) -> Option<Self> {
        let slopes: Vec<[f16; 2]> = slopes.into_iter().map(|s| [f16::from_f32(s.x), f16::from_f32(s.y)]).collect();
        let is_whole = !slopes.is_empty() && width.checked_mul(height) == Some(slopes.len());
        (is_whole && slopes.as_flattened().iter().all(|s| s.is_finite())).then_some(Self { width, height, slopes })
    }

    /// Texels along u and v.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// In memory, and on a device.
    pub fn bytes(&self) -> u64 {
        size_of_val(self.slopes.as_slice()) as u64
    }

    /// Row by row from the top.
    pub fn texels(&self) -> &[[f16; 2]] {
        &self.slopes
    }

    /// Times the strength, at a surface's texture coordinates.
    pub fn slopes(&self, uv: Vec2, mapping: &Mapping) -> Vec2 {
        let at = mapping.repeat * uv;
        let (left, right, fx) = texels_beside((at.x - at.x.floor()) * self.width as f32 - 0.5, self.width);
        let down = 1.0 - at.y;
        let (top, bottom, fy) = texels_beside((down - down.floor()) * self.height as f32 - 0.5, self.height);
        let texel = |row: usize, column: usize| {
            let [x, y] = self.slopes[row * self.width + column];
            Vec2::new(x.to_f32(), y.to_f32())
        };
        let upper = texel(top, left) + fx * (texel(top, right) - texel(top, left));
        let lower = texel(bottom, left) + fx * (texel(bottom, right) - texel(bottom, left));
        mapping.strength * (upper + fy * (lower - upper))
    }
}

/// The unit normal as slopes turn it; where there are none itself, to the last bit.
pub fn turned_normal(normal: Vec3, tangent: &Tangent, slopes: Vec2) -> Vec3 {
    if slopes == Vec2::ZERO {
        return normal;
    }
    let frame = TangentFrame::along(normal, tangent.along_u);
    (normal + slopes.x * frame.tangent + tangent.side_of_v * slopes.y * frame.bitangent).normalize_or(normal)
}

// The two texels around position x ∈ [−½, size − ½], and the share of the second.
fn texels_beside(x: f32, size: usize) -> (usize, usize, f32) {
    let below = x.floor();
    let first = if below < 0.0 { size - 1 } else { (below as usize).min(size - 1) };
    (first, if first + 1 == size { 0 } else { first + 1 }, x - below)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONCE: Mapping = Mapping { strength: 1.0, repeat: 1.0 };

    #[test]
    fn slopes_are_those_of_the_texels_between_which_they_are_read() {
        // Two columns, two rows; u grows to the right, v upward.
        let map = NormalMap::new(2, 2, [1.0, 2.0, 3.0, 4.0].map(|x| Vec2::new(x, -x))).unwrap();
        let at = |u, v, mapping| map.slopes(Vec2::new(u, v), &mapping).x;
        assert_eq!([at(0.25, 0.75, ONCE), at(0.75, 0.75, ONCE), at(0.25, 0.25, ONCE), at(0.75, 0.25, ONCE)], [1.0, 2.0, 3.0, 4.0]);
        // In the middle of all four, and over the edges, where the map repeats.
        assert_eq!([at(0.5, 0.5, ONCE), at(0.0, 0.75, ONCE), at(1.0, 0.75, ONCE), at(0.25, 0.0, ONCE)], [2.5, 1.5, 1.5, 2.0]);
        // Twice as often, and at half the strength.
        assert_eq!(at(0.375, 0.375, Mapping { strength: 0.5, repeat: 2.0 }), 0.5 * at(0.75, 0.75, ONCE));
        assert_eq!(map.slopes(Vec2::new(0.25, 0.75), &ONCE), Vec2::new(1.0, -1.0));
    }

    #[test]
    fn a_known_slope_turns_the_normal_by_its_angle_toward_u_and_v() {
        let tangent = Tangent { along_u: 3.0 * Vec3::X, side_of_v: 1.0 };
        // tan 30°: (½, 0, √¾).
        let slope = 30f32.to_radians().tan();
        let (sin, cos) = 30f32.to_radians().sin_cos();
        assert!((turned_normal(Vec3::Z, &tangent, Vec2::new(slope, 0.0)) - Vec3::new(sin, 0.0, cos)).length() < 1e-6);
        assert!((turned_normal(Vec3::Z, &tangent, Vec2::new(0.0, slope)) - Vec3::new(0.0, sin, cos)).length() < 1e-6);
        let mirrored = Tangent { side_of_v: -1.0, ..tangent };
        assert!((turned_normal(Vec3::Z, &mirrored, Vec2::new(0.0, slope)) - Vec3::new(0.0, -sin, cos)).length() < 1e-6);
        // A normal that no square root gives back.
        let normal = Vec3::new(0.267_261_24, 0.534_522_5, 0.801_783_7);
        assert_eq!(turned_normal(normal, &tangent, Vec2::ZERO), normal);
    }

    #[test]
    fn what_is_no_map_is_none() {
        let flat = |count| vec![Vec2::ZERO; count];
        assert!(NormalMap::new(2, 3, flat(6)).is_some());
        for (width, height, count) in [(2, 3, 5), (0, 0, 0), (usize::MAX, 2, 1)] {
            assert!(NormalMap::new(width, height, flat(count)).is_none(), "{width} × {height} of {count}");
        }
        // Beyond f16.
        assert!(NormalMap::new(1, 1, [Vec2::new(1e6, 0.0)]).is_none());
        assert!(NormalMap::new(1, 1, [Vec2::new(0.0, f32::NAN)]).is_none());
    }
}
