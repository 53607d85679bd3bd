//! Scenes whose every radiance is known: the tests of energy.

use serde_json::{Value, json};

/// A ball of albedo ρ = 0.5 in an environment of radiance 1: leaves ρ everywhere.
pub(super) fn ball() -> Value {
    json!({
        "materials": { "half": { "type": "diffuse", "albedo": [0.5, 0.5, 0.5] } },
        "objects": [{ "name": "ball", "shape": { "type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 64 }, "material": "half" }],
        "environment": { "radiance": [1, 1, 1] },
        "cameras": [super::camera("front", [0.0, 0.0, 4.0], [0.0, 0.0, 0.0], 40.0)],
    })
}

/// The space between a closed sphere and a ball within it. Both emit E = (0.5, 0.25, 0.125) and reflect ρ = 0.5, so the radiance is
/// E / (1 − ρ) = (1, 0.5, 0.25) at every point in every direction.
pub(super) fn inside() -> Value {
    let emission = [0.5, 0.25, 0.125];
    json!({
        "materials": { "half": { "type": "diffuse", "albedo": [0.5, 0.5, 0.5] } },
        "objects": [
            { "name": "walls", "shape": { "type": "sphere", "center": [0, 0, 0], "radius": 4, "segments": 64 }, "flip": true,
              "material": "half", "emission": emission },
            { "name": "ball", "shape": { "type": "sphere", "center": [0, 0, 0], "radius": 1, "segments": 64 },
              "material": "half", "emission": emission },
        ],
        "environment": null,
        "cameras": [super::camera("inside", [0.0, 0.0, 3.0], [0.0, 0.0, 0.0], 60.0)],
    })
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use crate::scenes::{BuiltinOptions, builtin};

    #[test]
    fn every_emitter_of_the_closed_furnace_faces_the_space_between() {
        let scene = builtin("furnace_inside", &BuiltinOptions::small()).unwrap();
        for (name, sign) in [("walls", -1.0), ("ball", 1.0)] {
            let mesh = &scene.objects[scene.object(name).unwrap()].mesh;
            for t in 0..mesh.triangles.len() {
                assert!(sign * mesh.area_vector(t).dot(mesh.corners(t)[0]) > 0.0, "{name}");
                assert!(sign * mesh.normals[mesh.triangles[t][0] as usize].dot(mesh.corners(t)[0]) > 0.0, "{name}");
            }
        }
        assert_eq!(scene.environment.radiance(Vec3::Y), Vec3::ZERO);
    }
}
