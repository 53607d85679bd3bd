//! The object's own triangles, for the rays of a frame that meet it once more: inside a clear body, and between mirror reflections.
//! `object_tree.wgsl` has the same by the same names.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use crate::raytrace::{Bvh, Stack};
use crate::representations::g_buffer::ProxyGeometry;

/// Made when the first frame needs it.
#[derive(Debug)]
pub(super) struct ObjectTree {
    geometry: Arc<ProxyGeometry>,
    pub bvh: Bvh,
}

/// Where a ray meets the object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ObjectPoint {
    pub position: Vec3,
    /// Unit, interpolated.
    pub shading: Vec3,
    /// Unit, the triangle's, on the front.
    pub geometric: Vec3,
    pub uv: Vec2,
    pub part: u32,
}

impl ObjectTree {
    pub fn new(geometry: Arc<ProxyGeometry>) -> Self {
        let corners = |t: &[u32; 3]| t.map(|v| Vec3::from(geometry.object_vertices[v as usize].position));
        let triangles: Vec<[Vec3; 3]> = geometry.object_triangles.iter().map(corners).collect();
        Self { bvh: Bvh::build(&triangles), geometry }
    }

    /// Lengths below it are none.
    pub fn near(&self) -> f32 {
        self.geometry.near
    }

    /// The next surface along a ray from a point of the object, `normal` on either side of it.
    pub fn next(&self, from: Vec3, normal: Vec3, direction: Vec3) -> Option<ObjectPoint> {
        let origin = from + self.geometry.near.copysign(normal.dot(direction)) * normal;
        let hit = self.bvh.nearest(origin, direction, f32::INFINITY, &mut Stack::new())?;
        let corners = self.geometry.object_triangles[hit.triangle as usize].map(|v| self.geometry.object_vertices[v as usize]);
        let weights = [1.0 - hit.u - hit.v, hit.u, hit.v];
        let [a, b, c] = corners.map(|corner| Vec3::from(corner.position));
        let normal: Vec3 = (0..3).map(|k| weights[k] * Vec3::from(corners[k].normal)).sum();
        let geometric = (b - a).cross(c - a).normalize_or(-direction);
        Some(ObjectPoint {
            position: origin + hit.distance * direction,
            shading: normal.normalize_or(geometric),
            geometric,
            uv: (0..3).map(|k| weights[k] * Vec2::from(corners[k].uv)).sum(),
            part: corners[0].part,
        })
    }
}
