//! How much memory a scene takes while it is traced, before it is made ready for that.

use super::bvh::{LANES, Node, Packet};
use super::surfaces::SurfaceTriangle;
use crate::scenes::{Environment, Object, Scene, Surface, Texture};

/// Trees over it: with the captured object and without.
const TREES: u64 = 2;
/// Boxes of a triangle, after long ones were split.
const BOXES: f64 = 1.3;
/// Of binary trees and boxes while a tree is built, bytes a box.
const BUILDING: f64 = 250.0;
/// Of images that hold the same texels: the scene's, the tracer's, the background's, that as it is written out, and compressed.
const COPIES: u64 = 5;
/// Of a texel or an environment's: three f32.
const TEXEL: u64 = 12;
/// The sky's tables, bytes a texel: cells and cumulative weights, and f64 weights while they are made.
const SKY_TABLES: u64 = 24;

/// Bytes that a job needs to trace `scene` with every object and without one, and to hold it and its background: an estimate that
/// grows with triangles and texels, compared with what was measured on one scene (docs/measurements.md, "Memory of the server"). What the
/// background's meshes gain by subdivision is not in it.
pub fn working_bytes(scene: &Scene) -> u64 {
    let triangles: u64 = scene.objects.iter().map(|o| o.mesh.triangles.len() as u64).sum();
    let packets = BOXES / (0.75 * LANES as f64);
    // A four-wide tree has a third as many nodes as leaves.
    let tree = packets * (size_of::<Packet>() as f64 + size_of::<Node>() as f64 / 3.0);
    let traced =
        TREES * (triangles as f64 * (size_of::<SurfaceTriangle>() as f64 + tree)) as u64 + (triangles as f64 * BOXES * BUILDING) as u64;
    let sky = match &scene.environment {
        Environment::Constant(_) => 0,
        Environment::Map(map) => (map.image.width * map.image.height) as u64,
    };
    let meshes: u64 = scene.objects.iter().map(mesh_bytes).sum();
    meshes + traced + texture_bytes(&scene.textures) + sky * (COPIES * TEXEL + SKY_TABLES)
}

/// The part of that which textures have.
pub fn texture_bytes<'t>(textures: impl IntoIterator<Item = &'t Texture>) -> u64 {
    textures.into_iter().map(|t| (t.image.width * t.image.height) as u64 * COPIES * TEXEL).sum()
}

fn mesh_bytes(object: &Object) -> u64 {
    let mesh = &object.mesh;
    let parts = match &object.surface {
        Surface::Mesh => 0,
        Surface::Patches { patches, patch_of_triangle } => size_of_val(&patches[..]) + size_of_val(&patch_of_triangle[..]),
    };
    (parts + size_of_val(&mesh.triangles[..]) + mesh.positions.len() * (2 * size_of::<glam::Vec3>() + size_of::<glam::Vec2>())) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{BuiltinOptions, builtin};

    #[test]
    fn more_triangles_and_more_texels_take_more() {
        let mut scene = builtin("six_colours", &BuiltinOptions::small()).unwrap();
        let bare = working_bytes(&scene);
        let mut more = scene.objects[0].clone();
        more.mesh.triangles = vec![more.mesh.triangles[0]; 100_000];
        scene.objects.push(more);
        let with_triangles = working_bytes(&scene);
        // Its own twelve bytes, twice a record of a hundred and more.
        assert!(with_triangles > bare + 100_000 * 250, "{bare} → {with_triangles}");
        scene.textures.push(Texture { image: crate::images::Image::zeros(1000, 500, 3) });
        assert_eq!(working_bytes(&scene), with_triangles + 500_000 * 60);
    }
}
