//! Bézier patches → triangles with analytic normals.
//!
//! Every patch has its own vertices (uv are the patch's own), all patches the same number of steps. Neighbours that share border
//! control points share border positions bit for bit, so no ray passes between them: the sums below are the same read forward
//! and backward.

use glam::{Vec2, Vec3};

use crate::geometry::{BezierPatch, MeshError, TriangleMesh};

/// How fine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Resolution {
    /// Steps along each edge of every patch.
    PerEdge(u32),
    /// Longest triangle edge along u or v, in the patches' unit.
    MaxEdge(f32),
}

/// Most steps along an edge: 2 · 256² triangles a patch.
pub const MAX_STEPS: u32 = 256;

/// The mesh (normals ∂u × ∂v, uv = the patch's) and which patch each triangle belongs to. Triangles that collapse (a lid's apex) are left out.
pub fn tessellate(patches: &[BezierPatch], resolution: Resolution) -> Result<(TriangleMesh, Vec<u32>), MeshError> {
    let steps = resolution.steps(patches);
    let side = steps + 1;
    let (mut positions, mut normals, mut uvs, mut triangles) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for patch in patches {
        let base = positions.len() as u32;
        for i in 0..side {
            for j in 0..side {
                let uv = Vec2::new(i as f32, j as f32) / steps as f32;
                positions.push(position(patch, [i, j], steps));
                normals.push(patch.point(uv.x, uv.y).normal);
                uvs.push(uv);
            }
        }
        for i in 0..steps {
            for j in 0..steps {
                let corner = base + i * side + j;
                triangles.push([corner, corner + side, corner + side + 1]);
                triangles.push([corner, corner + side + 1, corner + 1]);
            }
        }
    }
    let mesh = TriangleMesh::new(positions, normals, uvs, triangles)?;
    let patch_of_triangle = mesh.triangles.iter().map(|t| t[0] / (side * side)).collect();
    Ok((mesh, patch_of_triangle))
}

impl Resolution {
    /// Steps along each edge, equal for all patches: the finest need decides. At most `MAX_STEPS`.
    pub fn steps(self, patches: &[BezierPatch]) -> u32 {
        let steps = match self {
            Self::PerEdge(steps) => steps,
            Self::MaxEdge(edge) => {
                let speed = patches.iter().map(greatest_speed).fold(0.0, f32::max);
                (speed / edge).ceil() as u32
            }
        };
        steps.clamp(1, MAX_STEPS)
    }
}

// Bounds the speed |∂u|, |∂v| everywhere: a cubic's derivative is a mean of its control legs times three.
fn greatest_speed(patch: &BezierPatch) -> f32 {
    let leg = |a: usize, b: usize| (patch.points[a] - patch.points[b]).length();
    (0..4)
        .flat_map(|i| (0..3).flat_map(move |j| [(4 * i + j, 4 * i + j + 1), (4 * j + i, 4 * j + i + 4)]))
        .map(|(a, b)| 3.0 * leg(a, b))
        .fold(0.0, f32::max)
}

// Bernstein polynomials at i/steps, mirrored exactly by i → steps − i.
fn weights(i: u32, steps: u32) -> [f32; 4] {
    let (t, s) = (i as f32 / steps as f32, (steps - i) as f32 / steps as f32);
    [s * s * s, 3.0 * (s * s) * t, 3.0 * (t * t) * s, t * t * t]
}

// Outer plus inner: the same bits when the four are read backward.
fn sum(w: [f32; 4], p: [Vec3; 4]) -> Vec3 {
    (w[0] * p[0] + w[3] * p[3]) + (w[1] * p[1] + w[2] * p[2])
}

fn position(patch: &BezierPatch, [i, j]: [u32; 2], steps: u32) -> Vec3 {
    let (wu, wv) = (weights(i, steps), weights(j, steps));
    let p = &patch.points;
    sum(wu, [0, 4, 8, 12].map(|r| sum(wv, [p[r], p[r + 1], p[r + 2], p[r + 3]])))
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;
    use crate::scenes::tea_set::{self, TeaSet};

    #[test]
    fn vertices_lie_on_their_patch_and_carry_its_uv() {
        let patches = tea_set::patches(TeaSet::Teapot);
        let (mesh, patch_of_triangle) = tessellate(&patches, Resolution::PerEdge(5)).unwrap();
        assert_eq!(mesh.triangles.len(), patch_of_triangle.len());
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            for v in triangle.map(|v| v as usize) {
                let on_patch = patches[patch_of_triangle[t] as usize].position(mesh.uvs[v].x, mesh.uvs[v].y);
                // Rounding of sixteen products at size 4.
                assert!((mesh.positions[v] - on_patch).length() < 4e-6);
            }
        }
    }

    #[test]
    fn the_teapots_inner_edges_are_shared_bit_for_bit() {
        let (mesh, _) = tessellate(&tea_set::patches(TeaSet::Teapot), Resolution::PerEdge(9)).unwrap();
        let key = |p: Vec3| (p + 0.0).to_array().map(f32::to_bits);
        let mut uses: HashMap<[[u32; 3]; 2], u32> = HashMap::new();
        for t in &mesh.triangles {
            let p = t.map(|v| key(mesh.positions[v as usize]));
            for (a, b) in [(0, 1), (1, 2), (2, 0)] {
                let mut edge = [p[a], p[b]];
                edge.sort();
                *uses.entry(edge).or_default() += 1;
            }
        }
        let position = |k: [u32; 3]| Vec3::from(k.map(f32::from_bits));
        // Open edges remain only where the data are open: the lid's brim and the body's rim (y ≥ 2.25), and where handle and spout enter the wall.
        let open: Vec<Vec3> = uses.iter().filter(|(_, n)| **n == 1).map(|(e, _)| position(e[0])).collect();
        let on_wall = |p: &Vec3| p.x.abs() > 1.3 && p.z.abs() < 0.8;
        assert!(open.iter().all(|p| p.y >= 2.25 || on_wall(p)), "{:?}", open.iter().find(|p| !(p.y >= 2.25 || on_wall(p))));
        // Closed ones are the rule: a crack along any patch border would leave 9 edges a border.
        assert!(open.len() < uses.len() / 30, "{} of {}", open.len(), uses.len());
    }

    #[test]
    fn a_longest_edge_is_kept() {
        let patches = tea_set::patches(TeaSet::Teacup);
        let (mesh, _) = tessellate(&patches, Resolution::MaxEdge(0.1)).unwrap();
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|v| v as usize);
            for (i, j) in [(a, b), (b, c), (c, a)] {
                let along_a_line = mesh.uvs[i].x == mesh.uvs[j].x || mesh.uvs[i].y == mesh.uvs[j].y;
                assert!(!along_a_line || (mesh.positions[i] - mesh.positions[j]).length() <= 0.1);
            }
        }
    }
}
