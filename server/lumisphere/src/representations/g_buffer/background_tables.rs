//! What finishing the background's pixels reads, as tables: the host side of `g_buffer.wgsl`'s group 1.

use glam::Vec3;
use wgpu::TextureFormat;

use super::{BackgroundVertex, Material, ProxyGeometry};
use crate::gpu::{Gpu, GpuError, binding, table, table_bytes};

/// Triangles, vertices, materials, levels, texels.
pub(super) struct BackgroundTables {
    tables: [wgpu::Texture; 5],
    bytes: u64,
}

const FORMATS: [TextureFormat; 5] =
    [TextureFormat::Rgba32Uint, TextureFormat::Rgba32Float, TextureFormat::Rgba32Uint, TextureFormat::Rgba32Uint, TextureFormat::Rg32Uint];

impl BackgroundTables {
    /// `triangles`: into `geometry.background_vertices`, in the order in which they are numbered.
    pub fn new(gpu: &Gpu, geometry: &ProxyGeometry, triangles: &[[u32; 3]]) -> Result<Self, GpuError> {
        let materials = geometry.materials.as_slice();
        let vertices = geometry.background_vertices.as_slice();
        let with_material = |t: &[u32; 3]| [t[0], t[1], t[2], vertices[t[0] as usize].material];
        let triangles: Vec<[u32; 4]> = triangles.iter().map(with_material).collect();
        let vertices: Vec<_> = vertices.iter().map(|v| vertex_texels(v, &materials[v.material as usize])).collect();
        let materials: Vec<_> = materials.iter().map(material_texels).collect();
        let tables = [
            table(gpu, "rows of the background's triangles", FORMATS[0], &triangles)?,
            table(gpu, "rows of the background's vertices", FORMATS[1], vertices.as_flattened())?,
            table(gpu, "rows of the background's materials", FORMATS[2], materials.as_flattened())?,
            table(gpu, "rows of the background's texture levels", FORMATS[3], &geometry.pyramids.levels)?,
            table(gpu, "rows of the background's textures", FORMATS[4], &geometry.pyramids.texels)?,
        ];
        let bytes = tables.iter().map(table_bytes).sum();
        Ok(Self { tables, bytes })
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bindings 1 to 5.
    pub fn entries() -> [wgpu::BindGroupLayoutEntry; 5] {
        [binding::uint_texture(1), binding::texture(2), binding::uint_texture(3), binding::uint_texture(4), binding::uint_texture(5)]
    }

    /// What belongs to [`Self::entries`].
    pub fn views(&self) -> [wgpu::TextureView; 5] {
        self.tables.each_ref().map(|table| table.create_view(&wgpu::TextureViewDescriptor::default()))
    }
}

// Position and u; normal and v; radiance (with a texture: what its albedo is multiplied by) and whether it is unknown, front and back.
fn vertex_texels(vertex: &BackgroundVertex, material: &Material) -> [[f32; 4]; 4] {
    let shown = |irradiance: [f32; 3], emission: [f32; 3]| {
        let reflected = Vec3::from(material.albedo) * Vec3::from(irradiance) * std::f32::consts::FRAC_1_PI;
        let emission = if material.level_count > 0 { Vec3::ZERO } else { Vec3::from(emission) };
        (emission + reflected).extend(material.unknown as f32).into()
    };
    let ([x, y, z], [nx, ny, nz], [u, v]) = (vertex.position, vertex.normal, vertex.uv);
    [[x, y, z, u], [nx, ny, nz, v], shown(vertex.irradiance_front, material.emission), shown(vertex.irradiance_back, [0.0; 3])]
}

fn material_texels(material: &Material) -> [[u32; 4]; 2] {
    let [r, g, b] = material.emission.map(f32::to_bits);
    [[r, g, b, material.texels_per_length.to_bits()], [material.first_level, material.level_count, 0, 0]]
}
