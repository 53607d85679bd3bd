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

/// More texels than any face has.
const MOST_TEXELS: f32 = 65536.0;
/// Squared; no image of a pixel spans so many halves of a face.
const MOST_UNITS: f32 = 65536.0;
/// Longer images than this many times their width are read wider than they are. (With eight the errors on the gazebo's teapot are the same.)
const MOST_TAPS: f32 = 4.0;

impl DirectionDifferential {
    /// A look at nothing but one direction.
    pub fn single(direction: Vec3) -> Self {
        Self { direction, across: Vec3::ZERO, down: Vec3::ZERO }
    }

    /// How to read a face of `size` texels an edge over the whole pixel: side by side along the longer side of its image, each over a piece as
    /// long as the shorter one (Feline: McCormack and others 1999). The shorter side is the image's area by the longer one.
    ///
    /// With a the component of d of largest magnitude, on the face's plane d / a, a derivative δ moves by (δ − d · δₐ/a) / |a|; a face is
    /// two units wide.
    pub fn taps(&self, size: u32) -> Taps {
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
        let moved = |by: Vec3| (by - d * (by.dot(along) / a)) / a;
        let (across, down) = (moved(self.across), moved(self.down));
        let (wide, high) = (across.length_squared(), down.length_squared());
        let longer = wide.max(high).sqrt();
        // Neither infinity nor NaN is below it.
        if !(wide + high < MOST_UNITS) {
            return Taps { count: 1, step: Vec3::ZERO, texels: MOST_TEXELS };
        }
        let texels = longer * (0.5 * size as f32);
        // A pixel of less than a texel needs no more than one read.
        if texels <= 1.0 {
            return Taps { count: 1, step: Vec3::ZERO, texels };
        }
        let shorter = (across.cross(down).length() / longer * (0.5 * size as f32)).max(1.0);
        let count = (texels / shorter + 0.5).floor().min(MOST_TAPS);
        let step = if wide > high { self.across } else { self.down } / count;
        Taps { count: count as u32, step, texels: texels / count }
    }
}

/// Reads that together cover a pixel, evenly spaced about the direction of its centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Taps {
    /// 1 to 4.
    pub count: u32,
    /// From one tap's direction to the next.
    pub step: Vec3,
    /// Texels that each covers, along each side.
    pub texels: f32,
}

impl Taps {
    /// Of tap `tap`, where the pixel's centre looks toward `center`.
    pub fn direction(&self, center: Vec3, tap: u32) -> Vec3 {
        center + (tap as f32 - 0.5 * (self.count - 1) as f32) * self.step
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
    fn taps_lie_along_the_longer_side_and_cover_it() {
        for (column, row) in [(20.0, 40.0), (64.0, 64.0), (1.0, 126.0), (100.5, 3.25)] {
            for face in 0..6 {
                let at = |d: Vec3| face_from_direction(d).1 * 64.0;
                let d = texel_direction(face, 128, column, row);
                // Of any length, and its derivatives with it.
                let seen = |across: Vec3, down: Vec3| DirectionDifferential { direction: 3.0 * d, across: 3.0 * across, down: 3.0 * down };
                let (s, t) = d.any_orthonormal_pair();
                let step = |by: Vec3| (at(d + 0.01 * by) - at(d - 0.01 * by)) / 0.02;
                // Long down, short across.
                let taps = seen(0.03 * s, 0.08 * t).taps(128);
                let long = step(0.08 * t).length();
                let short = step(0.03 * s).perp_dot(step(0.08 * t)).abs() / long;
                assert_eq!(taps.count, (long / short).round() as u32, "{face} {column} {row}");
                assert!((taps.texels * taps.count as f32 - long).abs() < 2e-3 * long);
                assert!((taps.direction(d, 0) + taps.direction(d, taps.count - 1) - 2.0 * d).length() < 1e-6);
                assert!((taps.step * taps.count as f32 - 0.24 * t).length() < 1e-5);
                // As long as wide, and less than a texel.
                assert_eq!(seen(0.001 * s, 0.001 * t).taps(128).count, 1);
                assert!(seen(0.03 * s, 0.03 * t).taps(128).count <= 2, "no face is stretched by more");
                // Without any width there is an end to it.
                assert_eq!(seen(Vec3::ZERO, 0.2 * t).taps(128).count, 4);
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
            assert_eq!(d.taps(128), Taps { count: 1, step: Vec3::ZERO, texels: MOST_TEXELS });
        }
    }
}
