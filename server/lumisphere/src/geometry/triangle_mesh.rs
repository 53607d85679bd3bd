//! Indexed triangles with normals and texture coordinates.

use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Indexed triangles. `normals` and `uvs` are per vertex and as long as `positions`; every index is in range; every number finite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Unchecked")]
pub struct TriangleMesh {
    /// Vertex positions, in the space of the mesh's owner.
    pub positions: Vec<Vec3>,
    /// Unit shading normals.
    pub normals: Vec<Vec3>,
    /// Texture coordinates; v runs up.
    pub uvs: Vec<Vec2>,
    /// Counter-clockwise seen from the front.
    pub triangles: Vec<[u32; 3]>,
}

/// Why these arrays are not a mesh.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MeshError {
    /// No triangle with an area.
    #[error("mesh has no triangle with an area above zero")]
    Empty,
    /// Arrays of different lengths.
    #[error("mesh has {positions} positions, {normals} normals and {uvs} texture coordinates, equal counts expected")]
    Lengths {
        /// Counts as given.
        positions: usize,
        /// Counts as given.
        normals: usize,
        /// Counts as given.
        uvs: usize,
    },
    /// An index beyond the vertices.
    #[error("triangle {triangle} names vertex {index}, below {vertices} expected")]
    Index {
        /// Which triangle.
        triangle: usize,
        /// What it names.
        index: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// NaN or infinity.
    #[error("vertex {vertex} is not finite")]
    NotFinite {
        /// Which vertex.
        vertex: usize,
    },
}

// What a file says, before `TriangleMesh::new` has looked at it.
#[derive(Deserialize)]
struct Unchecked {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
}

impl TryFrom<Unchecked> for TriangleMesh {
    type Error = MeshError;

    fn try_from(raw: Unchecked) -> Result<Self, MeshError> {
        Self::new(raw.positions, raw.normals, raw.uvs, raw.triangles)
    }
}

impl TriangleMesh {
    /// Checks lengths, indices and finiteness; drops triangles without area; replaces normals that cannot be normalised by
    /// the triangle's own. Errors when nothing with an area is left.
    pub fn new(positions: Vec<Vec3>, normals: Vec<Vec3>, uvs: Vec<Vec2>, triangles: Vec<[u32; 3]>) -> Result<Self, MeshError> {
        let count = positions.len();
        if normals.len() != count || uvs.len() != count {
            return Err(MeshError::Lengths { positions: count, normals: normals.len(), uvs: uvs.len() });
        }
        for (triangle, t) in triangles.iter().enumerate() {
            if let Some(index) = t.iter().find(|i| **i as usize >= count) {
                return Err(MeshError::Index { triangle, index: *index, vertices: count });
            }
        }
        if let Some(vertex) = (0..count).find(|i| !(positions[*i].is_finite() && normals[*i].is_finite() && uvs[*i].is_finite())) {
            return Err(MeshError::NotFinite { vertex });
        }
        let mut mesh = Self { positions, normals, uvs, triangles };
        mesh.triangles = (0..mesh.triangles.len()).filter(|t| mesh.area_vector(*t).length() > 0.0).map(|t| mesh.triangles[t]).collect();
        if mesh.triangles.is_empty() {
            return Err(MeshError::Empty);
        }
        for t in 0..mesh.triangles.len() {
            let face_normal = mesh.area_vector(t).normalize_or(Vec3::Y);
            for i in mesh.triangles[t] {
                let n = &mut mesh.normals[i as usize];
                // One that is unit but for rounding stays: a mesh that is stored and loaded is the same.
                if !((n.length_squared() - 1.0).abs() <= 4.0 * f32::EPSILON) {
                    *n = n.try_normalize().unwrap_or(face_normal);
                }
            }
        }
        Ok(mesh)
    }

    /// The corners of triangle `t`.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        self.triangles[t].map(|i| self.positions[i as usize])
    }

    /// Half the cross product of two edges: length = area, direction = geometric normal.
    pub fn area_vector(&self, t: usize) -> Vec3 {
        let [a, b, c] = self.corners(t);
        0.5 * (b - a).cross(c - a)
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.positions.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle(points: [Vec3; 3]) -> Result<TriangleMesh, MeshError> {
        TriangleMesh::new(points.to_vec(), vec![Vec3::ZERO; 3], vec![Vec2::ZERO; 3], vec![[0, 1, 2]])
    }

    #[test]
    fn a_missing_normal_becomes_the_triangles_own() {
        let mesh = triangle([Vec3::ZERO, Vec3::X, Vec3::Y]).unwrap();
        assert_eq!(mesh.normals, vec![Vec3::Z; 3]);
    }

    #[test]
    fn broken_arrays_are_refused_by_name() {
        assert_eq!(triangle([Vec3::ZERO, Vec3::X, 2.0 * Vec3::X]), Err(MeshError::Empty));
        assert_eq!(triangle([Vec3::ZERO, Vec3::X, Vec3::new(0.0, f32::NAN, 0.0)]), Err(MeshError::NotFinite { vertex: 2 }));
        let out = TriangleMesh::new(vec![Vec3::ZERO; 3], vec![Vec3::Y; 3], vec![Vec2::ZERO; 3], vec![[0, 1, 3]]);
        assert_eq!(out, Err(MeshError::Index { triangle: 0, index: 3, vertices: 3 }));
    }
}
