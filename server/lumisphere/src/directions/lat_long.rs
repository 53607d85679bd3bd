//! Latitude–longitude maps as OpenEXR defines them: left edge −Z, +X at a quarter, +Z in the middle, −X at three quarters, top +Y.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

/// Unit direction at image position (u, v) in [0, 1]², v down.
pub fn direction_from_lat_long(at: Vec2) -> Vec3 {
    let (longitude, polar) = (TAU * at.x, PI * at.y);
    Vec3::new(polar.sin() * longitude.sin(), polar.cos(), -polar.sin() * longitude.cos())
}

/// Image position (u, v) in [0, 1]², v down, of a direction (any length above zero).
pub fn lat_long_from_direction(d: Vec3) -> Vec2 {
    let longitude = d.x.atan2(-d.z);
    Vec2::new((longitude / TAU).rem_euclid(1.0), (d.y / d.length()).clamp(-1.0, 1.0).acos() / PI)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_axes_lie_where_openexr_puts_them() {
        for (u, d) in [(0.0, Vec3::NEG_Z), (0.25, Vec3::X), (0.5, Vec3::Z), (0.75, Vec3::NEG_X)] {
            assert!((direction_from_lat_long(Vec2::new(u, 0.5)) - d).length() < 1e-6);
        }
        assert!((direction_from_lat_long(Vec2::new(0.3, 0.0)) - Vec3::Y).length() < 1e-6);
    }

    #[test]
    fn position_and_direction_invert_each_other() {
        for at in [Vec2::new(0.1, 0.2), Vec2::new(0.6, 0.9), Vec2::new(0.99, 0.5)] {
            assert!((lat_long_from_direction(direction_from_lat_long(at)) - at).length() < 1e-5);
        }
    }
}
