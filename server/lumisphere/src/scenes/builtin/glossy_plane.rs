//! The source's synthetic test of fitted lobes: a red plane with Phong's highlight under a point light (Mortensen & Andersen 2007,
//! "Modeling View-Dependent Surface Point Radiance with Parameter Maps", chapter 11.3 and figure 11.5).
//!
//! Theirs is 1000 × 1000 in the plane z = 0, with the light at (1500, 1500, 2000). Here 1 is their 1000, and their (x, y, z) is
//! (x, z, −y): +Y up. u runs along their x, v along their y.
//!
//! Radiance at a texel is exactly `K_d + K_s (v·r)^m`, under one point light. Their light has no fall-off; ours has the intensity that
//! gives the middle of the plane the same: K_d = colour × cos θ there, 0.54 in red. The highlight's height is half of the white
//! surface's radiance whatever its width, so m can be changed alone.

use std::f32::consts::PI;

use glam::Vec3;
use serde_json::{Value, json};

use super::{PlaneLamp, PlaneOptions};

/// Of the first light.
const LAMP: Vec3 = Vec3::new(1.5, 2.0, -1.5);
/// Diffuse reflectance, from 8-bit codes that the source takes as linear.
const COLOUR: [f32; 3] = [200.0 / 255.0, 15.0 / 255.0, 15.0 / 255.0];
/// Highest value of the highlight, over that of a white diffuse surface. With `COLOUR`, energy is kept from m = 2 on.
const HIGHLIGHT: f32 = 0.4;
/// Between neighbours of the nine points, and radius of the disc: about 6° seen from the plane.
const POINT_SPACING: f32 = 0.15;
const DISC_RADIUS: f32 = 0.2;

/// The scene file.
pub(super) fn scene(options: &PlaneOptions) -> Value {
    // The peak of the normalised lobe is specular · (m + 2) / 2π.
    let specular = Vec3::splat(2.0 * HIGHLIGHT / (options.shininess + 2.0)).to_array();
    // Irradiance π cos θ in the middle: I cos θ / distance².
    let intensity = PI * LAMP.length_squared();
    let mut lights = first_light(options.lamp, intensity);
    if let Some(d) = options.second_light {
        lights.push(point(Vec3::new(d, LAMP.y, -d), options.second_strength * intensity));
    }
    json!({
        "about": "A red plane with Phong's highlight. 1 is the source's 1000.",
        "materials": { "red": { "type": "phong", "diffuse": COLOUR, "specular": specular, "exponent": options.shininess } },
        "objects": [{
            "name": "plane", "material": "red",
            "shape": { "type": "rect", "corner": [-0.5, 0, 0.5], "edge_u": [1, 0, 0], "edge_v": [0, 0, -1] },
        }],
        "lights": lights,
        "environment": null,
        "generator": {
            "shininess": options.shininess, "plane_lamp": options.lamp.name(),
            "second_light": options.second_light, "second_strength": options.second_strength,
        },
        "cameras": [
            super::camera("highlight", [-1.4, 1.9, 1.4], [0.0, 0.0, 0.0], 30.0),
            super::camera("above", [0.0, 2.6, 0.9], [0.0, 0.0, 0.0], 30.0),
            super::camera("beside the light", [1.4, 1.9, 1.4], [0.0, 0.0, 0.0], 30.0),
        ],
    })
}

fn first_light(lamp: PlaneLamp, intensity: f32) -> Vec<Value> {
    match lamp {
        PlaneLamp::Point => vec![point(LAMP, intensity)],
        PlaneLamp::NinePoints => (0..9)
            .map(|k| point(LAMP + POINT_SPACING * Vec3::new((k % 3) as f32 - 1.0, 0.0, (k / 3) as f32 - 1.0), intensity / 9.0))
            .collect(),
        PlaneLamp::Disc => {
            let radiance = Vec3::splat(intensity / (PI * DISC_RADIUS * DISC_RADIUS)).to_array();
            vec![json!({
                "type": "disc", "name": "lamp", "center": LAMP.to_array(), "normal": (-LAMP).to_array(), "radius": DISC_RADIUS,
                "radiance": radiance,
            })]
        }
    }
}

fn point(position: Vec3, intensity: f32) -> Value {
    json!({ "type": "point", "position": position.to_array(), "intensity": Vec3::splat(intensity).to_array() })
}

#[cfg(test)]
#[path = "glossy_plane_tests.rs"]
mod tests;
