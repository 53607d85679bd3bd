//! The surface that a light field lives on: an object's triangles in parts, and the texels of a part.

use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::geometry::TriangleMesh;
use crate::scenes::{Object, Surface};

/// The object's triangles; each belongs to one *part*, one texture region with uv in [0, 1]² and its own sample map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceMesh {
    /// World space.
    pub mesh: TriangleMesh,
    /// Part of each triangle, below `parts`.
    pub part_of_triangle: Vec<u32>,
    /// How many parts there are.
    pub parts: u32,
}

impl SurfaceMesh {
    /// Patches are parts of their own; any other mesh is one part.
    pub fn of(object: &Object) -> Self {
        let mesh = object.mesh.clone();
        match &object.surface {
            Surface::Mesh => Self { part_of_triangle: vec![0; mesh.triangles.len()], parts: 1, mesh },
            Surface::Patches { patches, patch_of_triangle } => {
                Self { part_of_triangle: patch_of_triangle.clone(), parts: patches.len() as u32, mesh }
            }
        }
    }

    /// What does not agree, if anything: for surfaces that come from a file.
    pub fn check(&self) -> Result<(), String> {
        let (parts, triangles) = (self.part_of_triangle.len(), self.mesh.triangles.len());
        if parts != triangles {
            return Err(format!("{parts} part numbers for {triangles} triangles"));
        }
        match self.part_of_triangle.iter().find(|p| **p >= self.parts) {
            Some(p) => Err(format!("a triangle belongs to part {p}, below {} expected", self.parts)),
            None => Ok(()),
        }
    }
}

/// The surface at a texel's centre, world space.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SurfaceTexel {
    /// On the surface.
    pub position: Vec3,
    /// Unit, interpolated.
    pub normal: Vec3,
    /// From this texel's centre to the next in u and to the next in v, on the plane of the triangle that it lies in.
    pub steps: [Vec3; 2],
}

/// The texels of `part`, `size` along an edge, `[row · size + column]`, row = ⌊v · size⌋; None outside its triangles' uv.
pub fn surface_texels(surface: &SurfaceMesh, part: u32, size: usize) -> Vec<Option<SurfaceTexel>> {
    let mesh = &surface.mesh;
    let mut texels = vec![None; size * size];
    for (t, _) in surface.part_of_triangle.iter().enumerate().filter(|(_, p)| **p == part) {
        let corner = mesh.triangles[t].map(|v| v as usize);
        let uv = corner.map(|v| mesh.uvs[v] * size as f32);
        let area = (uv[1] - uv[0]).perp_dot(uv[2] - uv[0]);
        if area == 0.0 {
            continue;
        }
        let steps = steps(corner.map(|v| mesh.positions[v]), uv, area);
        let low = uv[0].min(uv[1]).min(uv[2]).floor().max(Vec2::ZERO).as_usizevec2();
        let high = uv[0].max(uv[1]).max(uv[2]).ceil().min(Vec2::splat(size as f32)).max(Vec2::ZERO).as_usizevec2();
        for row in low.y..high.y {
            for column in low.x..high.x {
                let at = Vec2::new(column as f32 + 0.5, row as f32 + 0.5);
                let b1 = (at - uv[0]).perp_dot(uv[2] - uv[0]) / area;
                let b2 = (uv[1] - uv[0]).perp_dot(at - uv[0]) / area;
                let b0 = 1.0 - b1 - b2;
                // Shared edges are covered from both sides despite rounding.
                if b0.min(b1).min(b2) >= -1e-5 {
                    let blend = |a: &[Vec3]| b0 * a[corner[0]] + b1 * a[corner[1]] + b2 * a[corner[2]];
                    let normal = blend(&mesh.normals).normalize_or(Vec3::Y);
                    texels[row * size + column] = Some(SurfaceTexel { position: blend(&mesh.positions), normal, steps });
                }
            }
        }
    }
    texels
}

// ∂p/∂u and ∂p/∂v in units of texels, of a triangle whose uv span `area` twice.
fn steps([a, b, c]: [Vec3; 3], [at_a, at_b, at_c]: [Vec2; 3], area: f32) -> [Vec3; 2] {
    let (to_b, to_c) = (at_b - at_a, at_c - at_a);
    [((b - a) * to_c.y - (c - a) * to_b.y) / area, ((c - a) * to_b.x - (b - a) * to_c.x) / area]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_texel_lies_where_its_uv_does_and_steps_lead_to_its_neighbours() {
        // p(u, v) = 2u · X + v · (Y + Z), wound either way.
        let corners = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
        let at = |uv: Vec2| 2.0 * uv.x * Vec3::X + uv.y * (Vec3::Y + Vec3::Z);
        let normal = Vec3::new(0.0, -1.0, 1.0).normalize();
        let mesh = TriangleMesh::new(corners.map(at).to_vec(), vec![normal; 4], corners.to_vec(), vec![[0, 1, 2], [0, 3, 2]]).unwrap();
        let surface = SurfaceMesh { mesh, part_of_triangle: vec![0, 0], parts: 1 };
        let texels = surface_texels(&surface, 0, 8);
        for (i, texel) in texels.iter().enumerate() {
            let texel = texel.unwrap();
            let uv = Vec2::new((i % 8) as f32 + 0.5, (i / 8) as f32 + 0.5) / 8.0;
            assert!(texel.position.distance(at(uv)) < 1e-6 && texel.normal.distance(normal) < 1e-6);
            assert!(texel.steps[0].distance(at(Vec2::X) / 8.0) < 1e-6 && texel.steps[1].distance(at(Vec2::Y) / 8.0) < 1e-6);
        }
    }
}
