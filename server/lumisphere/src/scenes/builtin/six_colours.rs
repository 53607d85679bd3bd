//! A white ball amid six walls, each of its own colour by its own light: fixes faces, signs and handedness for every reader at once.

use serde_json::{Value, json};

/// Radiance of the wall toward +X −X +Y −Y +Z −Z.
pub const WALL_RADIANCE: [[f32; 3]; 6] =
    [[1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]];

/// Walls at distance 4 that emit and do not reflect, a ball of radius 1 and albedo 0.8 at the origin.
pub(super) fn scene() -> Value {
    // Corner and edges of each wall, seen from inside: the front (u × v) faces the ball.
    let walls = [
        ("+X", [4, -4, -4], [0, 0, 8], [0, 8, 0]),
        ("-X", [-4, -4, 4], [0, 0, -8], [0, 8, 0]),
        ("+Y", [-4, 4, -4], [8, 0, 0], [0, 0, 8]),
        ("-Y", [-4, -4, 4], [8, 0, 0], [0, 0, -8]),
        ("+Z", [4, -4, 4], [-8, 0, 0], [0, 8, 0]),
        ("-Z", [-4, -4, -4], [8, 0, 0], [0, 8, 0]),
    ];
    let mut objects: Vec<Value> = walls
        .iter()
        .zip(WALL_RADIANCE)
        .map(|((name, corner, edge_u, edge_v), radiance)| {
            let shape = json!({ "type": "rect", "corner": corner, "edge_u": edge_u, "edge_v": edge_v });
            json!({ "name": name, "shape": shape, "material": "black", "emission": radiance })
        })
        .collect();
    objects.push(json!({
        "name": "ball", "material": "white",
        "shape": { "type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 64 },
    }));
    json!({
        "materials": {
            "black": { "type": "diffuse", "albedo": [0, 0, 0] },
            "white": { "type": "diffuse", "albedo": [0.8, 0.8, 0.8] },
        },
        "objects": objects,
        "environment": null,
        "cameras": [
            super::camera("from +Z", [0.0, 0.0, 3.8], [0.0, 0.0, 0.0], 60.0),
            super::camera("from the corner", [3.5, 3.5, 3.5], [0.0, 0.0, 0.0], 70.0),
        ],
    })
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::WALL_RADIANCE;
    use crate::scenes::{BuiltinOptions, builtin};

    #[test]
    fn each_axis_meets_the_front_of_its_own_colour() {
        let scene = builtin("six_colours", &BuiltinOptions::small()).unwrap();
        let axes = [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z];
        for (axis, radiance) in axes.into_iter().zip(WALL_RADIANCE) {
            let wall = scene.objects.iter().find(|o| o.emission == Some(Vec3::from(radiance))).unwrap();
            assert!(wall.mesh.positions.iter().all(|p| p.dot(axis) == 4.0), "{axis}");
            assert!((0..2).all(|t| wall.mesh.area_vector(t).dot(axis) < 0.0), "{axis}");
        }
    }
}
