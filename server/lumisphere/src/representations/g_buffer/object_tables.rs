//! What `object.wgsl` reads of the object, as tables.

use wgpu::TextureFormat;

use super::ProxyGeometry;
use crate::gpu::{Gpu, GpuError, binding, table, table_bytes};

/// Triangles and vertices.
pub(super) struct ObjectTables([wgpu::Texture; 2]);

impl ObjectTables {
    pub fn new(gpu: &Gpu, geometry: &ProxyGeometry) -> Result<Self, GpuError> {
        let vertices = geometry.object_vertices.as_slice();
        // All corners of a triangle are of one part.
        let triangles: Vec<[u32; 4]> = geometry.object_triangles.iter().map(|&[a, b, c]| [a, b, c, vertices[a as usize].part]).collect();
        let texels = vertices.iter().map(|v| {
            let ([x, y, z], [nx, ny, nz], [u, v]) = (v.position, v.normal, v.uv);
            [[x, y, z, u], [nx, ny, nz, v]]
        });
        let vertices: Vec<[[f32; 4]; 2]> = texels.collect();
        Ok(Self([
            table(gpu, "rows of the object's triangles", TextureFormat::Rgba32Uint, &triangles)?,
            table(gpu, "rows of the object's vertices", TextureFormat::Rgba32Float, vertices.as_flattened())?,
        ]))
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        self.0.iter().map(table_bytes).sum()
    }

    /// What belongs to [`object_entries`].
    pub fn views(&self) -> [wgpu::TextureView; 2] {
        self.0.each_ref().map(|table| table.create_view(&wgpu::TextureViewDescriptor::default()))
    }
}

/// Bindings 0 and 1 of the group of a kernel that includes `object.wgsl`.
pub(crate) fn object_entries() -> [wgpu::BindGroupLayoutEntry; 2] {
    [binding::uint_texture(0), binding::texture(1)]
}
