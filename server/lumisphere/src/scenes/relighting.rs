//! Other light on a scene than its own: its environment turned, point lights added.

use glam::{Quat, Vec3};

use super::{Environment, EnvironmentMap, PointLight};

/// Most point lights of a [`Relighting`].
pub const MOST_POINT_LIGHTS: usize = 4;

/// What is changed of the light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Relighting {
    environment_turn: f32,
    lights: [PointLight; MOST_POINT_LIGHTS],
    light_count: usize,
}

impl Relighting {
    /// The light as it is.
    pub const NONE: Self = Self {
        environment_turn: 0.0,
        lights: [PointLight { position: Vec3::ZERO, intensity: Vec3::ZERO }; MOST_POINT_LIGHTS],
        light_count: 0,
    };

    /// `environment_turn`: radians about +Y by which the light from infinity turns, as an object would. None with more than
    /// [`MOST_POINT_LIGHTS`] lights, where a number is not finite, or an intensity negative.
    pub fn new(environment_turn: f32, point_lights: &[PointLight]) -> Option<Self> {
        let sound = |light: &PointLight| light.position.is_finite() && light.intensity.is_finite() && light.intensity.min_element() >= 0.0;
        if point_lights.len() > MOST_POINT_LIGHTS || !environment_turn.is_finite() || !point_lights.iter().all(sound) {
            return None;
        }
        let mut relighting = Self { environment_turn, light_count: point_lights.len(), ..Self::NONE };
        relighting.lights[..point_lights.len()].copy_from_slice(point_lights);
        Some(relighting)
    }

    /// Whether any light is another.
    pub fn changes_light(&self) -> bool {
        self.turns() || self.light_count > 0
    }

    /// Whether the environment is turned.
    pub fn turns(&self) -> bool {
        self.environment_turn != 0.0
    }

    /// Radians about +Y.
    pub fn environment_turn(&self) -> f32 {
        self.environment_turn
    }

    /// The lights that are added.
    pub fn point_lights(&self) -> &[PointLight] {
        &self.lights[..self.light_count]
    }

    /// The direction from which light comes now that did come from the turned one's.
    pub fn before(&self, direction: Vec3) -> Vec3 {
        Quat::from_rotation_y(-self.environment_turn) * direction
    }

    /// The environment after its turn.
    pub fn environment(&self, environment: &Environment) -> Environment {
        match environment {
            Environment::Map(map) => Environment::Map(EnvironmentMap { rotation: map.rotation + self.environment_turn, ..map.clone() }),
            Environment::Constant(radiance) => Environment::Constant(*radiance),
        }
    }

    /// "turned-90-2-lights", for reports and file names; None where nothing is changed.
    pub fn name(&self) -> Option<String> {
        let turned = self.turns().then(|| format!("turned-{}", (10.0 * self.environment_turn.to_degrees()).round() / 10.0));
        let lit = (self.light_count > 0).then(|| format!("{}-lights", self.light_count));
        let parts: Vec<String> = turned.into_iter().chain(lit).collect();
        (!parts.is_empty()).then(|| parts.join("-"))
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;

    use super::*;
    use crate::images::Image;

    const LIGHT: PointLight = PointLight { position: Vec3::ONE, intensity: Vec3::X };

    #[test]
    fn light_that_comes_from_a_direction_came_from_the_one_before_the_turn() {
        let mut image = Image::zeros(64, 32, 3);
        (0..64 * 32).for_each(|at| image.set_rgb(at, [(at % 64) as f32, (at / 64) as f32, 1.0]));
        let map = Environment::Map(EnvironmentMap { image, rotation: 0.3 });
        let relighting = Relighting::new(FRAC_PI_2, &[]).unwrap();
        for direction in [Vec3::X, Vec3::new(0.3, 0.5, -0.8).normalize(), Vec3::new(-0.6, -0.7, 0.2).normalize()] {
            let (now, before) = (relighting.environment(&map).radiance(direction), map.radiance(relighting.before(direction)));
            assert!((now - before).length() < 1e-3, "{now} where {before} was");
        }
        // A quarter turn about +Y carries −Z to −X.
        assert!((relighting.before(Vec3::NEG_X) - Vec3::NEG_Z).length() < 1e-6);
    }

    #[test]
    fn only_finite_light_that_shines_is_added_and_no_more_than_four() {
        assert!(Relighting::new(1.0, &[LIGHT; 4]).is_some() && Relighting::new(1.0, &[LIGHT; 5]).is_none());
        for bad in [PointLight { intensity: Vec3::NEG_X, ..LIGHT }, PointLight { position: Vec3::NAN, ..LIGHT }] {
            assert!(Relighting::new(0.0, &[LIGHT, bad]).is_none(), "{bad:?}");
        }
        assert!(Relighting::new(f32::INFINITY, &[]).is_none());
        assert!(!Relighting::NONE.changes_light() && Relighting::new(0.0, &[LIGHT]).unwrap().changes_light());
    }

    #[test]
    fn names_tell_turn_and_lights() {
        assert_eq!(Relighting::NONE.name(), None);
        assert_eq!(Relighting::new(FRAC_PI_2, &[LIGHT; 2]).unwrap().name().unwrap(), "turned-90-2-lights");
    }
}
