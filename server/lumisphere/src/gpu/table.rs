//! Tables in textures, an element a texel.
//!
//! Because lavapipe reads a texel of 16 bytes at once for all lanes, but each word of a storage buffer lane by lane. Rows hold 4096 elements, so
//! that the 8192 rows that every device offers hold 33 million. Beside `table.wgsl`.

use bytemuck::Pod;

use super::{Gpu, GpuError};

// As in table.wgsl.
const ROW_BITS: u32 = 12;

/// A table of so many elements, nothing in it yet; `label`: its rows in an error. At least one texel, since empty textures do not exist.
pub(crate) fn empty_table(gpu: &Gpu, label: &'static str, format: wgpu::TextureFormat, elements: u64) -> Result<wgpu::Texture, GpuError> {
    let (width, height) = sides(elements);
    let limit = u64::from(gpu.device().limits().max_texture_dimension_2d);
    let needed = width.max(height);
    if needed > limit {
        return Err(GpuError::BeyondLimit { what: label, needed, limit });
    }
    let size = wgpu::Extent3d { width: width as u32, height: height as u32, depth_or_array_layers: 1 };
    Ok(gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: Some(label),
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    }))
}

/// Writes elements from number `first` on, the first of its row; as many as whole rows hold, or to the table's end.
pub(crate) fn write_table(gpu: &Gpu, table: &wgpu::Texture, first: u64, elements: &[u8]) {
    let element_bytes = element_bytes(table.format());
    let (width, first_row) = (u64::from(table.width()), (first >> ROW_BITS) as u32);
    let row_bytes = (width * element_bytes) as usize;
    // Whole rows, then what is left for the last one.
    let (rows, rest) = elements.split_at(elements.len() / row_bytes * row_bytes);
    for (bytes, first_row) in [(rows, first_row), (rest, first_row + (rows.len() / row_bytes) as u32)] {
        if bytes.is_empty() {
            continue;
        }
        let size = wgpu::Extent3d {
            width: (bytes.len().min(row_bytes) as u64 / element_bytes) as u32,
            height: bytes.len().div_ceil(row_bytes) as u32,
            depth_or_array_layers: 1,
        };
        let origin = wgpu::Origin3d { x: 0, y: first_row, z: 0 };
        let target = wgpu::TexelCopyTextureInfo { texture: table, mip_level: 0, origin, aspect: wgpu::TextureAspect::All };
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row_bytes as u32), rows_per_image: None };
        gpu.queue().write_texture(target, bytes, layout, size);
    }
}

/// A table of these elements; `label`: its rows in an error.
pub(crate) fn table<T: Pod>(
    gpu: &Gpu,
    label: &'static str,
    format: wgpu::TextureFormat,
    elements: &[T],
) -> Result<wgpu::Texture, GpuError> {
    let table = empty_table(gpu, label, format, elements.len() as u64)?;
    write_table(gpu, &table, 0, bytemuck::cast_slice(elements));
    Ok(table)
}

/// On the device.
pub(crate) fn table_bytes(table: &wgpu::Texture) -> u64 {
    u64::from(table.width()) * u64::from(table.height()) * element_bytes(table.format())
}

/// The same of one that is not made yet.
pub(crate) fn bytes_of_table(format: wgpu::TextureFormat, elements: u64) -> u64 {
    let (width, height) = sides(elements);
    width * height * element_bytes(format)
}

fn sides(elements: u64) -> (u64, u64) {
    let row = 1 << ROW_BITS;
    (elements.clamp(1, row), elements.div_ceil(row).max(1))
}

fn element_bytes(format: wgpu::TextureFormat) -> u64 {
    u64::from(format.block_copy_size(None).expect("tables have colour formats, of one plane"))
}
