//! What each pixel of a frame sees, for kinds that live on a surface: the object's (part, uv, normal, distance), and the finished
//! colour of everything else. The object is shaded afterwards from here; background and environment shade themselves.
//!
//! Twins: `visibility.wgsl` rasterises with a depth buffer, `g_buffer.wgsl` and `object.wgsl` intersect the triangle that a pixel sees with
//! the ray through its centre; `trace.rs` casts that ray. Both see a point of a
//! triangle in a pixel if and only if the pixel's central ray meets it no nearer than [`ProxyGeometry::near`] (a plane); they can
//! differ where the rasteriser's snapping of vertices to 1/256 pixel moves an edge across a pixel's centre.
//!
//! Background: `L = emission (front only) + albedo / π · E`, E the irradiance baked at the vertices on the side that is seen. Textures
//! are read trilinearly from a pyramid in f16, the level chosen from the pixel's size on the surface (distance × pixel angle ÷ √cos).

#[cfg(all(test, feature = "gpu"))]
mod background_equals_rays;
#[cfg(feature = "gpu")]
mod background_tables;
#[cfg(feature = "gpu")]
mod object_tables;
#[cfg(feature = "gpu")]
mod rasterize;
mod texture_pyramid;
mod trace;
#[cfg(feature = "gpu")]
mod visible_triangles;

use bytemuck::{Pod, Zeroable};
use glam::{Vec2, Vec3};

use crate::capture::Background;
use crate::geometry::{Camera, TriangleMesh};
use crate::scenes::{Albedo, Environment};

#[cfg(feature = "gpu")]
pub(crate) use object_tables::object_entries;
#[cfg(feature = "gpu")]
pub(crate) use rasterize::{BAND_BYTES_PER_PIXEL, Band, OUTPUT_WORDS, Rasterizer, band_entries};
#[cfg(all(test, feature = "gpu"))]
pub(crate) use rasterize::{SOURCE as G_BUFFER_SOURCE, VISIBILITY_SOURCE, resolve::SOURCE as RESOLVE_SOURCE};
pub(crate) use texture_pyramid::TexturePyramids;
pub(crate) use trace::{GBufferTracer, ProxySeen};

/// One pixel. `a` = (u, v, code, distance along the ray), `b` = (normal | radiance, 0); `code` is written and read by [`Seen`]. The
/// differentials are Igehy's ("Tracing ray differentials", 1999).
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct GBufferPixel {
    /// u, v, code, distance (+∞ where nothing is).
    pub a: [f32; 4],
    /// The object's unit shading normal, or the finished radiance of everything else.
    pub b: [f32; 4],
    /// Derivatives, per pixel, of the object's point, unit normal and (u, v), by the pixel's column and by its row; 0 for everything else.
    pub differentials: [SurfaceDifferential; 2],
    /// Where the object's u grows, along its triangle, of any length, and the side to which v grows (`geometry::side_of_v`). 0 for everything else.
    pub tangent: [f32; 4],
}

/// How the object's point, unit normal and texture coordinates change from one pixel to the next, on the plane of the triangle that is seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SurfaceDifferential {
    /// Three coordinates, and u.
    pub position: [f32; 4],
    /// Three coordinates, and v.
    pub normal: [f32; 4],
}

/// What a pixel sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// The object's outside.
    Object {
        /// Which part.
        part: u32,
    },
    /// The object from behind: no sample lies on that side.
    ObjectBack {
        /// Which part.
        part: u32,
    },
    /// A proxy with a known colour.
    Background,
    /// The environment.
    Nothing,
    /// A proxy that is not diffuse: black.
    Unknown,
}

impl Seen {
    /// As the G-buffer holds it: small integers, exact in f32.
    pub fn code(self) -> f32 {
        match self {
            Self::Object { part } => part as f32,
            Self::Background => -1.0,
            Self::Nothing => -2.0,
            Self::Unknown => -3.0,
            Self::ObjectBack { part } => -4.0 - part as f32,
        }
    }

    /// Inverse of `code`.
    pub fn from_code(code: f32) -> Self {
        match code {
            c if c >= 0.0 => Self::Object { part: c as u32 },
            c if c > -1.5 => Self::Background,
            c if c > -2.5 => Self::Nothing,
            c if c > -3.5 => Self::Unknown,
            c => Self::ObjectBack { part: (-4.0 - c) as u32 },
        }
    }
}

/// A corner of the object.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ObjectVertex {
    pub position: [f32; 3],
    pub normal: [f32; 3],
    pub uv: [f32; 2],
    pub part: u32,
}

/// A corner of a proxy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BackgroundVertex {
    pub position: [f32; 3],
    pub normal: [f32; 3],
    pub uv: [f32; 2],
    /// Index into `ProxyGeometry::materials`.
    pub material: u32,
    pub irradiance_front: [f32; 3],
    pub irradiance_back: [f32; 3],
}

/// How a proxy's light is coloured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Material {
    pub albedo: [f32; 3],
    /// First level of the albedo's pyramid.
    pub first_level: u32,
    pub emission: [f32; 3],
    /// 0 for a constant albedo.
    pub level_count: u32,
    /// Texels of the finest level per unit of length on the surface, averaged over it.
    pub texels_per_length: f32,
    /// 1 for surfaces that are not diffuse.
    pub unknown: u32,
}

/// The object and what is around it, in the form that both twins draw from. Triangles wind as their normals point.
#[derive(Debug)]
pub(crate) struct ProxyGeometry {
    pub object_vertices: Vec<ObjectVertex>,
    pub object_triangles: Vec<[u32; 3]>,
    pub background_vertices: Vec<BackgroundVertex>,
    pub background_triangles: Vec<[u32; 3]>,
    pub materials: Vec<Material>,
    pub pyramids: TexturePyramids,
    pub environment: Environment,
    /// Depth (along the view axis) before which nothing is seen, a fixed part of the geometry's extent.
    pub near: f32,
}

// Closer than this part of the extent no camera needs to see; with reversed infinite depth any value is precise enough.
const NEAR_OF_EXTENT: f32 = 1e-5;

impl ProxyGeometry {
    /// `part_of_triangle` is as long as `object.triangles`.
    pub fn new(object: &TriangleMesh, part_of_triangle: &[u32], background: &Background) -> Self {
        let mut geometry = Self {
            object_vertices: Vec::new(),
            object_triangles: Vec::new(),
            background_vertices: Vec::new(),
            background_triangles: Vec::new(),
            materials: Vec::new(),
            pyramids: TexturePyramids::new(&background.textures),
            environment: background.environment.clone(),
            near: NEAR_OF_EXTENT * extent(object, background),
        };
        geometry.add_object(object, part_of_triangle);
        for proxy in &background.surfaces {
            let (albedo, first_level, level_count, size) = match &proxy.albedo {
                None => (Vec3::ZERO, 0, 0, Vec2::ZERO),
                Some(Albedo::Constant(albedo)) => (*albedo, 0, 0, Vec2::ZERO),
                Some(Albedo::Texture(texture)) => {
                    let levels = geometry.pyramids.of_texture(*texture);
                    (Vec3::ONE, levels.start as u32, levels.len() as u32, geometry.pyramids.size(*texture))
                }
            };
            geometry.materials.push(Material {
                albedo: albedo.into(),
                first_level,
                emission: proxy.emission.into(),
                level_count,
                texels_per_length: texels_per_length(&proxy.mesh, size),
                unknown: u32::from(proxy.albedo.is_none() && proxy.emission == Vec3::ZERO),
            });
            geometry.add_proxy(&proxy.mesh, &proxy.irradiance);
        }
        geometry
    }

    // A vertex shared by two parts becomes two, since the part is a property of the vertex here.
    fn add_object(&mut self, mesh: &TriangleMesh, part_of_triangle: &[u32]) {
        let mut index_of = std::collections::HashMap::new();
        for (t, part) in part_of_triangle.iter().enumerate() {
            let vertices = &mut self.object_vertices;
            let corners = wound_as_normals(mesh, t).map(|v| {
                *index_of.entry((v, *part)).or_insert_with(|| {
                    let i = v as usize;
                    let (position, normal, uv) = (mesh.positions[i].into(), mesh.normals[i].into(), mesh.uvs[i].into());
                    vertices.push(ObjectVertex { position, normal, uv, part: *part });
                    vertices.len() as u32 - 1
                })
            });
            self.object_triangles.push(corners);
        }
    }

    fn add_proxy(&mut self, mesh: &TriangleMesh, irradiance: &[[Vec3; 2]]) {
        let first = self.background_vertices.len() as u32;
        let material = self.materials.len() as u32 - 1;
        for (i, [front, back]) in irradiance.iter().enumerate() {
            self.background_vertices.push(BackgroundVertex {
                position: mesh.positions[i].into(),
                normal: mesh.normals[i].into(),
                uv: mesh.uvs[i].into(),
                material,
                irradiance_front: (*front).into(),
                irradiance_back: (*back).into(),
            });
        }
        let triangles = (0..mesh.triangles.len()).map(|t| wound_as_normals(mesh, t).map(|v| v + first));
        self.background_triangles.extend(triangles);
    }
}

fn extent(object: &TriangleMesh, background: &Background) -> f32 {
    let meshes = background.surfaces.iter().map(|s| &s.mesh).chain([object]);
    let (low, high) =
        meshes.map(TriangleMesh::bounds).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), (l, h)| (lo.min(l), hi.max(h)));
    (high - low).length()
}

// The corners, reordered if they wind against their own normals: front is the side the normals point to.
fn wound_as_normals(mesh: &TriangleMesh, t: usize) -> [u32; 3] {
    let [i, j, k] = mesh.triangles[t];
    let normals: Vec3 = [i, j, k].iter().map(|v| mesh.normals[*v as usize]).sum();
    if mesh.area_vector(t).dot(normals) < 0.0 { [i, k, j] } else { [i, j, k] }
}

// √(area in texels ÷ area in space), over the whole surface.
fn texels_per_length(mesh: &TriangleMesh, size: Vec2) -> f32 {
    let (mut texels, mut area) = (0f32, 0f32);
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = corners.map(|v| mesh.uvs[v as usize] * size);
        texels += 0.5 * (b - a).perp_dot(c - a).abs();
        area += mesh.area_vector(t).length();
    }
    (texels / area).sqrt()
}

/// Angle that a pixel subtends at the image's centre, radians per pixel: the same for both axes by the finer one.
pub(crate) fn pixel_angle(camera: &Camera) -> f32 {
    1.0 / camera.intrinsics().focal_px.max_element()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "gpu")]
    #[test]
    fn structs_lie_in_memory_as_wgsl_has_them() {
        use crate::gpu::layout_check::assert_same_layout;
        use rasterize::CameraUniform;
        assert_same_layout!(
            G_BUFFER_SOURCE,
            "Camera",
            CameraUniform {
                position,
                near,
                right,
                focal_x,
                up,
                focal_y,
                backward,
                pixel_angle,
                center,
                size,
                first_row,
                environment_cos,
                environment_sin,
                infinity,
                object_end,
                plain_end,
                padding
            }
        );
    }

    #[test]
    fn codes_name_what_was_seen_for_every_part() {
        let parts = [0, 1, 27, 65_535];
        let objects = parts.map(|part| Seen::Object { part }).into_iter().chain(parts.map(|part| Seen::ObjectBack { part }));
        for seen in objects.chain([Seen::Background, Seen::Nothing, Seen::Unknown]) {
            assert_eq!(Seen::from_code(seen.code()), seen);
        }
    }
}
