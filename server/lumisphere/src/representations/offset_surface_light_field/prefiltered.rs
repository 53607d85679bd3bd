//! A glossy surface by one look at each sample point, over the whole highlight: light meant beforehand, level by level, instead of drawn.
//! `prefiltered.wgsl` is the twin.
//!
//! `L(x, v) ≈ R(v) · Σⱼ βⱼ L̄ᵢ(pⱼ; r)`, L̄ the mean over the highlight's rectangle about the mirror direction r and over what the pixel covers there,
//! R the BRDF's weight at its peak (the split sum of Karis 2013, with the footprint's taps for the highlight's shape). What it costs does not
//! depend on the highlight. What it does not know: the tails of GGX, and that a wide highlight is cut at the horizon.

use glam::{Vec2, Vec3};

use super::shade::short_of_the_horizon;
use crate::directions::DirectionDifferential;
use crate::geometry::TangentFrame;

/// The look over the highlight of `frame`, and over what the pixel covers of a mirror's image: two blurs, whose variances add.
pub(super) fn over_highlight(
    frame: &TangentFrame,
    (wi, sides): (Vec3, [Vec3; 2]),
    normal: Vec3,
    pixel: &DirectionDifferential,
) -> DirectionDifferential {
    let direction = frame.world_from_local(wi);
    let plane = TangentFrame::around(direction);
    let [u, v] = sides.map(|side| frame.world_from_local(side));
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for side in [u, v, pixel.across, pixel.down] {
        let (x, y) = (side.dot(plane.tangent), side.dot(plane.bitangent));
        xx += x * x;
        xy += x * y;
        yy += y * y;
    }
    // Principal axes of the sum.
    let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
    let root = (half * half + xy * xy).sqrt();
    let along = if half >= 0.0 { Vec2::new(half + root, xy) } else { Vec2::new(xy, root - half) };
    let length = along.length();
    let along = if length > 0.0 { along / length } else { Vec2::X };
    let (long, short) = ((mean + root).sqrt(), (mean - root).max(0.0).sqrt());
    let cosine = normal.dot(direction);
    let across = long * (along.x * plane.tangent + along.y * plane.bitangent);
    let down = short * (along.x * plane.bitangent - along.y * plane.tangent);
    DirectionDifferential { direction, across: short_of_the_horizon(across, cosine), down: short_of_the_horizon(down, cosine) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In a turned frame: the longer side along u, whatever the order; what the pixel covers is added in squares, and nothing reaches the horizon.
    #[test]
    fn a_look_has_the_sides_of_highlight_and_pixel_together() {
        let (normal, u) = (Vec3::new(0.48, 0.6, 0.64), Vec3::new(0.8, 0.0, -0.6));
        let frame = TangentFrame::along(normal, u);
        let over = |x: f32, y: f32, pixel: Vec3| {
            let pixel = DirectionDifferential { direction: normal, across: pixel, down: Vec3::ZERO };
            over_highlight(&frame, (Vec3::Z, [x * Vec3::X, y * Vec3::Y]), normal, &pixel)
        };
        let is = |side: Vec3, length: f32, along: Vec3| (side.length() - length).abs() < 1e-5 && side.dot(along).abs() > 0.9999 * length;
        let v = normal.cross(u);
        let look = over(0.2, 0.05, Vec3::ZERO);
        assert!(is(look.across, 0.2, u) && is(look.down, 0.05, v), "{look:?}");
        let look = over(0.05, 0.2, Vec3::ZERO);
        assert!(is(look.across, 0.2, v) && is(look.down, 0.05, u), "{look:?}");
        let look = over(0.2, 0.05, 0.15 * u);
        assert!(is(look.across, 0.25, u) && is(look.down, 0.05, v), "{look:?}");
        assert!(is(over(3.0, 0.05, Vec3::ZERO).across, 0.5, u));
        let mirror = over(0.0, 0.0, Vec3::ZERO);
        assert_eq!((mirror.across, mirror.down), (Vec3::ZERO, Vec3::ZERO));
    }
}
