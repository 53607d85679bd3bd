//! The triangles in the order in which they are drawn and numbered, cut into chunks that the camera's frustum can leave out.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::{DVec3, UVec3, Vec3};

use super::ProxyGeometry;
use crate::geometry::Camera;

/// A corner as the rasteriser takes it.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Corner {
    pub position: [f32; 3],
    /// Number of the one triangle that has this corner first.
    pub triangle: u32,
}

/// All triangles: the object's, the background's with one colour, those with textures.
#[derive(Debug)]
pub(super) struct VisibleTriangles {
    pub corners: Vec<Corner>,
    /// Into `corners`, by triangle.
    pub indices: Vec<[u32; 3]>,
    /// Into `ProxyGeometry::background_vertices`, by triangle less `object_end`.
    pub background: Vec<[u32; 3]>,
    pub object_end: u32,
    pub plain_end: u32,
    chunks: Vec<Chunk>,
}

#[derive(Debug)]
struct Chunk {
    low: Vec3,
    high: Vec3,
    triangles: Range<u32>,
}

// Few enough triangles that a chunk is small, many enough that drawing it costs more than asking whether to.
const CHUNK_TRIANGLES: usize = 512;

impl VisibleTriangles {
    pub fn new(geometry: &ProxyGeometry) -> Self {
        let vertices = &geometry.background_vertices;
        let has_texture = |t: &[u32; 3]| geometry.materials[vertices[t[0] as usize].material as usize].level_count > 0;
        let (mut textured, mut plain): (Vec<_>, Vec<_>) = geometry.background_triangles.iter().copied().partition(has_texture);
        let position = |v: u32| Vec3::from(vertices[v as usize].position);
        sort_along_curve(&mut plain, &position);
        sort_along_curve(&mut textured, &position);
        let object_end = geometry.object_triangles.len() as u32;
        let plain_end = object_end + plain.len() as u32;
        let mut background = plain;
        background.append(&mut textured);
        let mut triangles =
            Self { corners: Vec::new(), indices: Vec::new(), background: Vec::new(), object_end, plain_end, chunks: vec![] };
        let object: Vec<[f32; 3]> = geometry.object_vertices.iter().map(|v| v.position).collect();
        triangles.append(&geometry.object_triangles, &object);
        let around: Vec<[f32; 3]> = vertices.iter().map(|v| v.position).collect();
        triangles.append(&background, &around);
        Self { background, ..triangles }
    }

    // Every triangle gets a first corner of its own: one that no other claimed, or a copy.
    fn append(&mut self, triangles: &[[u32; 3]], positions: &[[f32; 3]]) {
        const NONE: u32 = u32::MAX;
        let mut corner_of_vertex = vec![NONE; positions.len()];
        for chunk in triangles.chunks(CHUNK_TRIANGLES) {
            let first = self.indices.len() as u32;
            let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
            for triangle in chunk {
                let number = self.indices.len() as u32;
                let mut corners = triangle.map(|v| {
                    let position = positions[v as usize];
                    (low, high) = (low.min(position.into()), high.max(position.into()));
                    let known = &mut corner_of_vertex[v as usize];
                    if *known == NONE {
                        *known = self.corners.len() as u32;
                        self.corners.push(Corner { position, triangle: NONE });
                    }
                    *known
                });
                match (0..3).find(|k| self.corners[corners[*k] as usize].triangle == NONE) {
                    Some(k) => corners.rotate_left(k),
                    None => {
                        self.corners.push(self.corners[corners[0] as usize]);
                        corners[0] = self.corners.len() as u32 - 1;
                    }
                }
                self.corners[corners[0] as usize].triangle = number;
                self.indices.push(corners);
            }
            self.chunks.push(Chunk { low, high, triangles: first..self.indices.len() as u32 });
        }
    }

    /// Ranges of triangles that rows `first_row`…`first_row + rows − 1` of the camera's image may show; neighbours are merged.
    pub fn in_view(&self, camera: &Camera, near: f32, first_row: u32, rows: u32) -> Vec<Range<u32>> {
        let frustum = Frustum::new(camera, near, first_row, rows);
        let mut ranges: Vec<Range<u32>> = Vec::new();
        for chunk in self.chunks.iter().filter(|c| frustum.may_show(c.low, c.high)) {
            match ranges.last_mut() {
                Some(last) if last.end == chunk.triangles.start => last.end = chunk.triangles.end,
                _ => ranges.push(chunk.triangles.clone()),
            }
        }
        ranges
    }
}

// By centroid along a Morton curve: neighbours in the list are neighbours in space.
fn sort_along_curve(triangles: &mut [[u32; 3]], position: &dyn Fn(u32) -> Vec3) {
    let centroid = |t: &[u32; 3]| t.map(position).into_iter().sum::<Vec3>() / 3.0;
    let (low, high) = triangles.iter().map(centroid).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), c| (low.min(c), high.max(c)));
    let scale = 1023.0 / (high - low).max_element().max(f32::MIN_POSITIVE);
    let spread = |v: u32| (0..10).map(|bit| (v >> bit & 1) << (3 * bit)).sum::<u32>();
    triangles.sort_by_cached_key(|t| {
        let UVec3 { x, y, z } = ((centroid(t) - low) * scale).as_uvec3();
        spread(x) | spread(y) << 1 | spread(z) << 2
    });
}

/// Half spaces `normal · (point − origin) ≥ least` that hold everything visible, a pixel wider than the image.
struct Frustum {
    origin: DVec3,
    planes: [(DVec3, f64); 5],
}

impl Frustum {
    // In f64: at long focal lengths a pixel is less than f32's rounding.
    fn new(camera: &Camera, near: f32, first_row: u32, rows: u32) -> Self {
        let intrinsics = camera.intrinsics();
        let rotation = camera.pose().rotation().as_dmat3();
        let (right, up, forward) = (rotation.x_axis, rotation.y_axis, -rotation.z_axis);
        let (focal, center) = (intrinsics.focal_px.as_dvec2(), intrinsics.center_px.as_dvec2());
        let (left_px, top_px) = (center.x + 1.0, center.y - f64::from(first_row) + 1.0);
        let (right_px, bottom_px) = (f64::from(intrinsics.width_px) - center.x + 1.0, f64::from(first_row + rows) - center.y + 1.0);
        Self {
            origin: camera.pose().position().as_dvec3(),
            planes: [
                (focal.x * right + left_px * forward, 0.0),
                (right_px * forward - focal.x * right, 0.0),
                (top_px * forward - focal.y * up, 0.0),
                (bottom_px * forward + focal.y * up, 0.0),
                (forward, 0.5 * f64::from(near)),
            ],
        }
    }

    // Whether the box is not wholly beyond one plane; what is not a number may be seen.
    fn may_show(&self, low: Vec3, high: Vec3) -> bool {
        let (low, high) = (low.as_dvec3() - self.origin, high.as_dvec3() - self.origin);
        !self.planes.iter().any(|(normal, least)| {
            let farthest = DVec3::select(normal.cmpgt(DVec3::ZERO), high, low);
            normal.dot(farthest) < *least
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Pose};

    fn frustum() -> (Camera, Frustum) {
        let pose = Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::new(-4.0, 0.5, 0.0), Vec3::Y).unwrap();
        let camera = Camera::new(Intrinsics::from_vfov(50.0, 64, 48).unwrap(), pose).unwrap();
        let frustum = Frustum::new(&camera, 1e-3, 12, 24);
        (camera, frustum)
    }

    #[test]
    fn nothing_that_a_pixel_of_the_band_sees_is_left_out() {
        let (camera, frustum) = frustum();
        for (i, j) in (12..36).flat_map(|j| (0..64).map(move |i| (i, j))) {
            for distance in [0.01, 1.0, 500.0] {
                let point = camera.pixel_ray(i, j).at(distance);
                assert!(frustum.may_show(point, point), "{distance} along pixel {i}, {j}");
            }
        }
    }

    #[test]
    fn what_lies_well_outside_is_left_out() {
        let (camera, frustum) = frustum();
        let at = |x: f32, y: f32| camera.ray(glam::Vec2::new(x, y)).at(5.0);
        for outside in [at(-4.0, 24.0), at(68.0, 24.0), at(32.0, 8.0), at(32.0, 40.0), camera.ray(glam::Vec2::new(32.0, 24.0)).at(-1.0)] {
            assert!(!frustum.may_show(outside, outside), "{outside}");
        }
    }
}
