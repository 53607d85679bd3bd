//! How much of a cube map one pixel looks at: directions with their derivatives by the pixel (Igehy 1999, "Tracing ray differentials").

use glam::Vec3;

/// A direction (any length above zero) and how it changes from a pixel to the next one of its row, and of its column.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DirectionDifferential {
    /// Where the pixel's centre looks.
    pub direction: Vec3,
    /// Derivative by the pixel's column, per pixel.
    pub across: Vec3,
    /// Derivative by the pixel's row, per pixel.
    pub down: Vec3,
}

/// A level of a pyramid of halved images, 0 the finest, and how far to go toward the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PyramidLevel {
    /// The finer of the two levels.
    pub fine: u32,
    /// Of the coarser one, in [0, 1).
    pub fraction: f32,
}

/// More texels than any face has; more than its square root, in units of half a face, is no pixel's image.
const MOST_TEXELS: f32 = 65536.0;

impl DirectionDifferential {
    /// A look at nothing but one direction.
    pub fn single(direction: Vec3) -> Self {
        Self { direction, across: Vec3::ZERO, down: Vec3::ZERO }
    }

    /// The longer side of the pixel's image on a face of `size` texels an edge, in texels; a large number where it has no end.
    ///
    /// With a the component of d of largest magnitude, on the face's plane d / a, a derivative δ moves by (δ − d · δₐ/a) / |a|; a face is
    /// two units wide.
    pub fn texels_per_pixel(&self, size: u32) -> f32 {
        let d = self.direction;
        let m = d.abs();
        let along = if m.x >= m.y && m.x >= m.z {
            Vec3::X
        } else if m.y >= m.z {
            Vec3::Y
        } else {
            Vec3::Z
        };
        let a = d.dot(along);
        let moved = |by: Vec3| ((by - d * (by.dot(along) / a)) / a).length_squared();
        let (across, down) = (moved(self.across), moved(self.down));
        let texels = across.max(down).sqrt() * (0.5 * size as f32);
        // Neither infinity nor NaN is below it.
        if across + down < MOST_TEXELS { texels } else { MOST_TEXELS }
    }
}

impl PyramidLevel {
    /// The level at which `texels` of the finest one are one texel, among 0 … `coarsest`; linear between powers of two.
    pub fn for_texels(texels: f32, coarsest: u32) -> Self {
        let bits = texels.max(1.0).to_bits();
        let fine = (bits >> 23) - 127;
        if fine >= coarsest {
            return Self { fine: coarsest, fraction: 0.0 };
        }
        Self { fine, fraction: f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000) - 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directions::{face_from_direction, texel_direction};

    #[test]
    fn a_pixel_covers_as_many_texels_as_its_neighbours_directions_are_apart() {
        for (column, row) in [(20.0, 40.0), (64.0, 64.0), (1.0, 126.0), (100.5, 3.25)] {
            for face in 0..6 {
                let d = texel_direction(face, 128, column, row);
                let (across, down) = (Vec3::new(0.003, -0.001, 0.002), Vec3::new(-0.002, 0.001, 0.005));
                let found = DirectionDifferential { direction: 3.0 * d, across: 3.0 * across, down: 3.0 * down }.texels_per_pixel(128);
                let at = |d: Vec3| face_from_direction(d).1 * 64.0;
                let step = |by: Vec3| (at(d + 0.01 * by) - at(d - 0.01 * by)).length() / 0.02;
                let exact = step(across).max(step(down));
                assert!((found - exact).abs() < 2e-3 * exact, "{face} {column} {row}: {found} where {exact} is exact");
            }
        }
    }

    #[test]
    fn levels_double_and_stop_at_the_coarsest() {
        let level = |texels| PyramidLevel::for_texels(texels, 4);
        assert_eq!(level(0.0), PyramidLevel { fine: 0, fraction: 0.0 });
        assert_eq!(level(1.5), PyramidLevel { fine: 0, fraction: 0.5 });
        assert_eq!(level(8.0), PyramidLevel { fine: 3, fraction: 0.0 });
        assert_eq!(level(14.0), PyramidLevel { fine: 3, fraction: 0.75 });
        assert_eq!((level(16.0), level(1e30)), (PyramidLevel { fine: 4, fraction: 0.0 }, PyramidLevel { fine: 4, fraction: 0.0 }));
        assert_eq!(PyramidLevel::for_texels(5.0, 0), PyramidLevel { fine: 0, fraction: 0.0 });
    }

    #[test]
    fn derivatives_without_end_are_the_coarsest_level() {
        for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
            let d = DirectionDifferential { direction: Vec3::Z, across: Vec3::X * bad, down: Vec3::ZERO };
            assert_eq!(d.texels_per_pixel(128), MOST_TEXELS);
        }
    }
}
