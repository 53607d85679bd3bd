//! Placing geometry: an affine transform from the scene file, applied so that fronts stay fronts.

use glam::{EulerRot, Mat3, Mat4, Quat, Vec3};

use super::error::SceneError;
use super::json::Node;
use crate::geometry::{BezierPatch, MeshError, TriangleMesh};

/// From 16 numbers (column by column), or `{translate, rotate_deg, scale}`: scaled first, then turned about X, then Y, then Z, then moved.
pub(super) fn parse(node: &Node) -> Result<Mat4, SceneError> {
    let matrix = if node.is_list() {
        let matrix = Mat4::from_cols_array(&node.numbers::<16>()?);
        if matrix.row(3) != glam::Vec4::W {
            return Err(node.wrong("an affine matrix column by column, its last row 0 0 0 1"));
        }
        matrix
    } else {
        let fields = node.fields()?;
        let translate = fields.optional("translate").map_or(Ok(Vec3::ZERO), |n| n.vec3())?;
        let turn = fields.optional("rotate_deg").map_or(Ok(Vec3::ZERO), |n| n.vec3())?;
        let scale = match fields.optional("scale") {
            None => Vec3::ONE,
            Some(n) if n.is_list() => n.vec3()?,
            Some(n) => Vec3::splat(n.number()?),
        };
        fields.finish()?;
        let rotation = Quat::from_euler(EulerRot::ZYX, turn.z.to_radians(), turn.y.to_radians(), turn.x.to_radians());
        Mat4::from_scale_rotation_translation(scale, rotation, translate)
    };
    let volume = matrix.determinant();
    if !(volume.is_finite() && volume != 0.0) { Err(node.wrong("a transform that keeps volume above 0")) } else { Ok(matrix) }
}

/// The mesh in the world. A mirroring transform turns the winding round, so that the front stays in front.
pub(super) fn place_mesh(mesh: TriangleMesh, world_from_object: Mat4) -> Result<TriangleMesh, MeshError> {
    let linear = Mat3::from_mat4(world_from_object);
    let normal_matrix = linear.inverse().transpose();
    let positions = mesh.positions.iter().map(|p| world_from_object.transform_point3(*p)).collect();
    let normals = mesh.normals.iter().map(|n| normal_matrix * *n).collect();
    let mirrored = linear.determinant() < 0.0;
    let triangles = mesh.triangles.iter().map(|[a, b, c]| if mirrored { [*a, *c, *b] } else { [*a, *b, *c] }).collect();
    TriangleMesh::new(positions, normals, mesh.uvs, triangles)
}

/// The patches in the world, their normals still outward after a mirroring transform.
pub(super) fn place_patches(patches: &[BezierPatch], world_from_object: Mat4) -> Vec<BezierPatch> {
    let mirrored = world_from_object.determinant() < 0.0;
    let place = |patch: &BezierPatch| {
        let placed = BezierPatch { points: patch.points.map(|p| world_from_object.transform_point3(p)) };
        if mirrored { placed.flipped() } else { placed }
    };
    patches.iter().map(place).collect()
}

/// The other side becomes the front.
pub(super) fn turn_inside_out(mut mesh: TriangleMesh) -> TriangleMesh {
    mesh.normals.iter_mut().for_each(|n| *n = -*n);
    mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    mesh
}

/// Winds every triangle so that its own normal lies on the side its vertex normals point to: foreign files often disagree, and
/// the format says that the normals decide which side is the front.
pub(super) fn wind_by_normals(mut mesh: TriangleMesh) -> TriangleMesh {
    for t in 0..mesh.triangles.len() {
        let normal: Vec3 = mesh.triangles[t].iter().map(|v| mesh.normals[*v as usize]).sum();
        if mesh.area_vector(t).dot(normal) < 0.0 {
            mesh.triangles[t].swap(1, 2);
        }
    }
    mesh
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::super::json::Json;
    use super::*;

    fn matrix(text: &str) -> Result<Mat4, SceneError> {
        parse(&Node::root("s.json", &Json::parse("s.json", text.as_bytes()).unwrap()))
    }

    #[test]
    fn scale_comes_first_then_x_y_z_turns_then_the_move() {
        let m = matrix(r#"{"translate":[10,0,0],"rotate_deg":[90,90,0],"scale":2}"#).unwrap();
        // (0,1,0) → scaled (0,2,0) → about X (0,0,2) → about Y (2,0,0) → moved.
        assert!((m.transform_point3(Vec3::Y) - Vec3::new(12.0, 0.0, 0.0)).length() < 1e-5);
        let columns = matrix("[1,0,0,0, 0,1,0,0, 0,0,1,0, 5,6,7,1]").unwrap();
        assert_eq!(columns.transform_point3(Vec3::ZERO), Vec3::new(5.0, 6.0, 7.0));
    }

    #[test]
    fn what_flattens_or_is_not_affine_is_refused() {
        for text in [r#"{"scale":0}"#, r#"{"scale":[1,0,1]}"#, "[1,0,0,0, 0,1,0,0, 0,0,1,0, 5,6,7,2]", "[1,2,3]", r#"{"turn":1}"#] {
            assert!(matrix(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_mirrored_triangle_keeps_its_front() {
        let triangle =
            TriangleMesh::new(vec![Vec3::ZERO, Vec3::X, Vec3::Y], vec![Vec3::Z; 3], vec![Vec2::ZERO; 3], vec![[0, 1, 2]]).unwrap();
        let mirrored = place_mesh(triangle, Mat4::from_scale(Vec3::new(-1.0, 1.0, 1.0))).unwrap();
        assert_eq!(mirrored.normals[0], Vec3::Z);
        assert!(mirrored.area_vector(0).z > 0.0);
        let turned = turn_inside_out(mirrored);
        assert!(turned.area_vector(0).z < 0.0 && turned.normals[0].z < 0.0);
        assert!(wind_by_normals(TriangleMesh { normals: vec![Vec3::Z; 3], ..turned }).area_vector(0).z > 0.0);
    }
}
