//! The thesis' test surface: a plane of 1000 × 1000 units, 16 × 16 texels, colour (200, 15, 15)/255, a white point light at
//! (1500, 1500, 2000) from its middle (figure 11.5). Its radiance is known in closed form, so that a fit is judged in all directions.

use glam::{Vec2, Vec3};

use crate::fitting::{Lobe, Model};

/// Texels to a side.
pub const SIDE: usize = 16;
/// Where the light of all tests stands.
pub const LIGHT: Vec3 = Vec3::new(1500.0, 1500.0, 2000.0);

const WIDTH: f32 = 1000.0;
const COLOR: [f32; 3] = [200.0 / 255.0, 15.0 / 255.0, 15.0 / 255.0];

/// A white point light over the plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointLight {
    /// From the plane's middle, in its units.
    pub place: Vec3,
    /// Irradiance of a texel that faces it, over π: the same at any distance.
    pub strength: f32,
}

/// How the plane reflects beside its colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gloss {
    /// Radiance of a highlight's middle per strength.
    pub specular: f32,
    /// Phong's m.
    pub exponent: f32,
}

impl Gloss {
    /// Of all tests but those that vary it.
    pub const USUAL: Self = Self { specular: 0.4, exponent: 20.0 };
}

/// Centres of the texels, row by row.
pub fn texels() -> impl Iterator<Item = Vec2> {
    let place = |i: usize| ((i as f32 + 0.5) / SIDE as f32 - 0.5) * WIDTH;
    (0..SIDE * SIDE).map(move |i| Vec2::new(place(i % SIDE), place(i / SIDE)))
}

/// What a texel looks like: its colour by the lights' cosines, a Phong lobe about each light's mirror direction.
pub fn lit(texel: Vec2, lights: &[PointLight], gloss: Gloss) -> Model {
    let to_light = |light: &PointLight| (light.place - texel.extend(0.0)).normalize();
    let diffuse: f32 = lights.iter().map(|light| light.strength * to_light(light).z).sum();
    let lobe = |light: &PointLight| {
        let l = to_light(light);
        Lobe { axis: [-l.x, -l.y, l.z], exponent: gloss.exponent, amplitude: [light.strength * gloss.specular; 3] }
    };
    Model::Lobes { constant: COLOR.map(|c| diffuse * c), lobes: lights.iter().map(lobe).collect() }
}
