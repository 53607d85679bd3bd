//! From WGSL to pipelines, and from slices to buffers.

use std::borrow::Cow;

use wgpu::util::DeviceExt;

use super::Gpu;

/// A parsed WGSL source.
#[derive(Debug)]
pub(crate) struct Shader {
    pub module: wgpu::ShaderModule,
    pub layout: wgpu::PipelineLayout,
    pub groups: Vec<wgpu::BindGroupLayout>,
    label: &'static str,
}

impl Shader {
    /// `groups[g]` describes bind group g.
    pub fn new(gpu: &Gpu, label: &'static str, source: impl Into<Cow<'static, str>>, groups: &[&[wgpu::BindGroupLayoutEntry]]) -> Self {
        let device = gpu.device();
        let description = wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) };
        let module = device.create_shader_module(description);
        let group = |entries: &&[_]| device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries });
        let groups: Vec<_> = groups.iter().map(group).collect();
        let references: Vec<_> = groups.iter().map(Some).collect();
        let description = wgpu::PipelineLayoutDescriptor { label: Some(label), bind_group_layouts: &references, immediate_size: 0 };
        let layout = device.create_pipeline_layout(&description);
        Self { module, layout, groups, label }
    }

    /// The compute entry point `entry`, with its `override` constants.
    pub fn compute_pipeline(&self, gpu: &Gpu, entry: &'static str, constants: &[(&str, f64)]) -> wgpu::ComputePipeline {
        gpu.device().create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(self.label),
            layout: Some(&self.layout),
            module: &self.module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
            cache: None,
        })
    }

    /// Resources for group `group`, bound at 0, 1, 2, …
    pub fn bind(&self, gpu: &Gpu, group: usize, resources: &[wgpu::BindingResource<'_>]) -> wgpu::BindGroup {
        let entries = resources.iter().cloned().enumerate();
        let entries: Vec<_> = entries.map(|(binding, resource)| wgpu::BindGroupEntry { binding: binding as u32, resource }).collect();
        let description = wgpu::BindGroupDescriptor { label: Some(self.label), layout: &self.groups[group], entries: &entries };
        gpu.device().create_bind_group(&description)
    }
}

/// Entries of bind group layouts.
pub(crate) mod binding {
    use wgpu::{BindGroupLayoutEntry, BindingType, BufferBindingType, ShaderStages, TextureSampleType, TextureViewDimension};

    fn entry(binding: u32, ty: BindingType) -> BindGroupLayoutEntry {
        let visibility = ShaderStages::VERTEX_FRAGMENT | ShaderStages::COMPUTE;
        // Only compute kernels write.
        let writes = matches!(ty, BindingType::Buffer { ty: BufferBindingType::Storage { read_only: false }, .. });
        let visibility = if writes { ShaderStages::COMPUTE } else { visibility };
        BindGroupLayoutEntry { binding, visibility, ty, count: None }
    }

    pub fn read_buffer(binding: u32) -> BindGroupLayoutEntry {
        let ty = BufferBindingType::Storage { read_only: true };
        entry(binding, BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None })
    }

    pub fn write_buffer(binding: u32) -> BindGroupLayoutEntry {
        let ty = BufferBindingType::Storage { read_only: false };
        entry(binding, BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None })
    }

    pub fn texture(binding: u32) -> BindGroupLayoutEntry {
        texture_of(binding, TextureViewDimension::D2)
    }

    pub fn texture_array(binding: u32) -> BindGroupLayoutEntry {
        texture_of(binding, TextureViewDimension::D2Array)
    }

    /// Whole numbers.
    pub fn uint_texture(binding: u32) -> BindGroupLayoutEntry {
        let ty =
            BindingType::Texture { sample_type: TextureSampleType::Uint, view_dimension: TextureViewDimension::D2, multisampled: false };
        entry(binding, ty)
    }

    // Read texel by texel, never through a sampler: the bilinear weights are the kernel's own.
    fn texture_of(binding: u32, view_dimension: TextureViewDimension) -> BindGroupLayoutEntry {
        let sample_type = TextureSampleType::Float { filterable: false };
        entry(binding, BindingType::Texture { sample_type, view_dimension, multisampled: false })
    }
}

/// A read-only storage buffer with that content (at least one element, since empty bindings do not exist).
pub(crate) fn storage_buffer<T: bytemuck::Pod>(gpu: &Gpu, label: &str, content: &[T], usage: wgpu::BufferUsages) -> wgpu::Buffer {
    let empty = [T::zeroed()];
    let content = if content.is_empty() { &empty } else { content };
    let usage = usage | wgpu::BufferUsages::STORAGE;
    let description = wgpu::util::BufferInitDescriptor { label: Some(label), contents: bytemuck::cast_slice(content), usage };
    gpu.device().create_buffer_init(&description)
}

/// Texels of four f32 in rows of `width`, to be read.
pub(crate) fn float_texture(gpu: &Gpu, label: &str, width: u32, texels: &[[f32; 4]]) -> wgpu::Texture {
    let description = wgpu::TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width, height: texels.len() as u32 / width, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba32Float,
        usage: wgpu::TextureUsages::TEXTURE_BINDING,
        view_formats: &[],
    };
    let order = wgpu::util::TextureDataOrder::default();
    gpu.device().create_texture_with_data(gpu.queue(), &description, order, bytemuck::cast_slice(texels))
}

/// A buffer for one `T`, written before each use; `var<storage, read>` to WGSL. Not in the uniform address space: Mesa's lavapipe compiles a
/// shader anew for every value of a uniform that its branches depend on, such as a frame's size, and keeps a copy of each until the pipeline
/// goes. Measured with Mesa 22.3 and a viewer who drags: 1.4 MB a frame, for ever.
pub(crate) fn value_buffer<T: bytemuck::Pod>(gpu: &Gpu, label: &str) -> wgpu::Buffer {
    gpu.device().create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: size_of::<T>() as u64,
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}
