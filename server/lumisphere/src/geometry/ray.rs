//! A half line.

use glam::Vec3;

/// Points `origin + t·direction`, `t > 0`. `direction` is a unit vector in world space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start, world space.
    pub origin: Vec3,
    /// Unit vector, world space.
    pub direction: Vec3,
}

impl Ray {
    /// The point at distance `t`.
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + t * self.direction
    }
}
