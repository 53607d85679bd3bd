//! Host side of `visibility.wgsl`, `band.wgsl` and `g_buffer.wgsl`.
//!
//! Only triangle numbers are rasterised; everything else is computed once for each pixel that is finally seen. On lavapipe a
//! triangle costs at least a block of 16 fragments, which is ruinous for the shading of many small ones.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;

use super::background_tables::BackgroundTables;
use super::object_tables::ObjectTables;
use super::visible_triangles::{Corner, VisibleTriangles};
use super::{ProxyGeometry, pixel_angle};
use crate::geometry::Camera;
use crate::gpu::{Gpu, GpuError, Shader, binding, float_texture, storage_buffer, value_buffer};
use crate::scenes::Environment;

/// All of the source of what finishes a band's pixels.
pub(crate) const SOURCE: &str = concat!(
    include_str!("camera.wgsl"),
    include_str!("../../gpu/table.wgsl"),
    include_str!("band.wgsl"),
    include_str!("../../directions/lat_long.wgsl"),
    include_str!("g_buffer.wgsl")
);
/// All of the rasteriser's source.
pub(crate) const VISIBILITY_SOURCE: &str = concat!(include_str!("camera.wgsl"), include_str!("visibility.wgsl"));

/// The camera of a band of rows. Layout as WGSL's `Camera`.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct CameraUniform {
    pub position: [f32; 3],
    pub near: f32,
    pub right: [f32; 3],
    pub focal_x: f32,
    pub up: [f32; 3],
    pub focal_y: f32,
    pub backward: [f32; 3],
    pub pixel_angle: f32,
    pub center: [f32; 2],
    pub size: [u32; 2],
    pub first_row: u32,
    pub environment_cos: f32,
    pub environment_sin: f32,
    pub infinity: f32,
    pub object_end: u32,
    pub plain_end: u32,
    pub padding: [u32; 2],
}

/// Object, background and environment on the device, and the pipelines that draw them.
pub(crate) struct Rasterizer {
    triangles: VisibleTriangles,
    visibility: wgpu::RenderPipeline,
    corners: wgpu::Buffer,
    indices: wgpu::Buffer,
    camera: wgpu::Buffer,
    camera_only: wgpu::BindGroup,
    shader: Shader,
    sort_pixels: wgpu::ComputePipeline,
    finish: [(wgpu::ComputePipeline, u32); 3],
    resources: wgpu::BindGroup,
    object: ObjectTables,
    environment_turn: f32,
    near: f32,
    bytes: u64,
}

/// What a band of a frame needs, reused while its size stays.
pub(crate) struct Band {
    visibility: wgpu::TextureView,
    depth: wgpu::TextureView,
    work: wgpu::Buffer,
    // The lists' heads, apart: a buffer cannot be written and be an indirect argument in one dispatch.
    heads: wgpu::Buffer,
    output: wgpu::Buffer,
    resources: wgpu::BindGroup,
    pub width: u32,
    pub rows: u32,
}

/// Words of output a pixel: R, G, B, distance, provenance.
pub(crate) const OUTPUT_WORDS: u64 = 5;
/// Of visibility, depth, the pixels' lists and output.
pub(crate) const BAND_BYTES_PER_PIXEL: u64 = 4 + 4 + 4 * LISTS as u64 + 4 * OUTPUT_WORDS;

const VISIBILITY: wgpu::TextureFormat = wgpu::TextureFormat::R32Uint;
// As in band.wgsl.
const LISTS: usize = 4;
const OBJECT_LIST: u32 = 0;
const PLAIN_LIST: u32 = 1;
const TEXTURED_LIST: u32 = 2;
const SKY_LIST: u32 = 3;
const LIST_HEAD_BYTES: u64 = 16;
#[cfg(test)]
const GROUP_SIZE: u32 = 64;
// As in g_buffer.wgsl.
const RUN: u32 = 32;
const SORT_GROUP: u32 = 8;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

// Beyond these the projection's products leave the range of f32.
const FOCAL_RANGE_PX: Range<f32> = 1e-3..1e9;

impl CameraUniform {
    /// Rows `first_row`…`first_row + rows − 1` of the camera's image.
    pub fn new(camera: &Camera, near: f32, environment_turn: f32, first_row: u32, rows: u32) -> Result<Self, GpuError> {
        let intrinsics = camera.intrinsics();
        let (focal, center) = (intrinsics.focal_px, intrinsics.center_px);
        let reach = FOCAL_RANGE_PX.end;
        let position = camera.pose().position();
        let sane = FOCAL_RANGE_PX.contains(&focal.x) && FOCAL_RANGE_PX.contains(&focal.y);
        if !(sane && center.abs().max_element() < reach && position.abs().max_element() < reach * reach) {
            return Err(GpuError::ExtremeCamera);
        }
        let rotation = camera.pose().rotation();
        Ok(Self {
            position: position.into(),
            near,
            right: rotation.x_axis.into(),
            focal_x: focal.x,
            up: rotation.y_axis.into(),
            focal_y: focal.y,
            backward: rotation.z_axis.into(),
            pixel_angle: pixel_angle(camera),
            center: center.into(),
            size: [intrinsics.width_px, rows],
            first_row,
            environment_cos: environment_turn.cos(),
            environment_sin: environment_turn.sin(),
            infinity: f32::INFINITY,
            object_end: 0,
            plain_end: 0,
            padding: [0; 2],
        })
    }
}

impl Rasterizer {
    pub fn new(gpu: &Gpu, geometry: &ProxyGeometry) -> Result<Self, GpuError> {
        let triangles = VisibleTriangles::new(geometry);
        let limit = gpu.device().limits().max_buffer_size;
        let needed = size_of_val(triangles.corners.as_slice()) as u64;
        if needed > limit {
            return Err(GpuError::BeyondLimit { what: "the proxy geometry in bytes", needed, limit });
        }
        let shader = Shader::new(gpu, "g-buffer", SOURCE, &[&band_entries(), &background_entries()]);
        let (environment, environment_turn) = environment_texture(gpu, &geometry.environment)?;
        let tables = BackgroundTables::new(gpu, geometry, &triangles.background)?;
        let views = tables.views();
        let view = environment.create_view(&wgpu::TextureViewDescriptor::default());
        let resources: Vec<_> = [&view].into_iter().chain(&views).map(wgpu::BindingResource::TextureView).collect();
        let resources = shader.bind(gpu, 1, &resources);
        let object = ObjectTables::new(gpu, geometry)?;
        let corners = storage_buffer(gpu, "corners", &triangles.corners, wgpu::BufferUsages::VERTEX);
        let indices = storage_buffer(gpu, "indices", &triangles.indices, wgpu::BufferUsages::INDEX);
        let camera = value_buffer::<CameraUniform>(gpu, "camera");
        let visibility_shader = Shader::new(gpu, "visibility", VISIBILITY_SOURCE, &[&[binding::read_buffer(0)]]);
        let camera_only = visibility_shader.bind(gpu, 0, &[camera.as_entire_binding()]);
        let environment_bytes = u64::from(environment.width()) * u64::from(environment.height()) * 16;
        let bytes = environment_bytes + tables.bytes() + object.bytes() + corners.size() + indices.size();
        let background = |textured: f64| shader.compute_pipeline(gpu, "background", &[("TEXTURED", textured)]);
        let finish =
            [(background(0.0), PLAIN_LIST), (background(1.0), TEXTURED_LIST), (shader.compute_pipeline(gpu, "sky", &[]), SKY_LIST)];
        let sort_pixels = shader.compute_pipeline(gpu, "sort_pixels", &[]);
        let visibility = visibility_pipeline(gpu, &visibility_shader);
        gpu.check()?;
        let near = geometry.near;
        Ok(Self {
            triangles,
            visibility,
            corners,
            indices,
            camera,
            camera_only,
            shader,
            sort_pixels,
            finish,
            resources,
            object,
            environment_turn,
            near,
            bytes,
        })
    }

    /// On the device, without bands.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// What `object.wgsl` reads, as [`object_entries`](super::object_entries) describes it.
    pub fn object_views(&self) -> [wgpu::TextureView; 2] {
        self.object.views()
    }

    /// Room for `rows` rows of `width` pixels.
    pub fn band(&self, gpu: &Gpu, width: u32, rows: u32) -> Band {
        let texture = |format, usage| {
            let texture = gpu.device().create_texture(&wgpu::TextureDescriptor {
                label: Some("g-buffer"),
                size: wgpu::Extent3d { width, height: rows, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            });
            texture.create_view(&wgpu::TextureViewDescriptor::default())
        };
        let buffer = |label, size, usage| {
            gpu.device().create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
        };
        let (visibility, depth) = (texture(VISIBILITY, wgpu::TextureUsages::TEXTURE_BINDING), texture(DEPTH, wgpu::TextureUsages::empty()));
        let pixels = u64::from(width) * u64::from(rows);
        let head_bytes = LISTS as u64 * LIST_HEAD_BYTES;
        let copied = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let work = buffer("work", head_bytes + 4 * LISTS as u64 * pixels, wgpu::BufferUsages::STORAGE | copied);
        let heads = buffer("list heads", head_bytes, wgpu::BufferUsages::INDIRECT | wgpu::BufferUsages::COPY_DST);
        let output = buffer("output", 4 * OUTPUT_WORDS * pixels, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
        let resources = self.shader.bind(gpu, 0, &band_bindings(&self.camera, &visibility, &work, &output));
        Band { visibility, depth, work, heads, output, resources, width, rows }
    }

    /// Group 0 of a kernel that reads bands: as [`band_entries`] describes it.
    pub fn bind_band(&self, gpu: &Gpu, shader: &Shader, band: &Band) -> wgpu::BindGroup {
        shader.bind(gpu, 0, &band_bindings(&self.camera, &band.visibility, &band.work, &band.output))
    }

    /// Records a band: visibility, the pixels' lists, and every pixel that does not see the object. Beside the camera radians about +Y by which
    /// the environment is turned.
    pub fn draw(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        (camera, turn): (&Camera, f32),
        first_row: u32,
        band: &Band,
    ) -> Result<(), GpuError> {
        self.list_pixels(gpu, encoder, (camera, turn), first_row, band, self.triangles.in_view(camera, self.near, first_row, band.rows))?;
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_bind_group(0, &band.resources, &[]);
        pass.set_bind_group(1, &self.resources, &[]);
        for (pipeline, list) in &self.finish {
            pass.set_pipeline(pipeline);
            pass.dispatch_workgroups_indirect(&band.heads, u64::from(*list) * LIST_HEAD_BYTES);
        }
        Ok(())
    }

    /// The object's pixels alone, as if nothing stood before it; the others are left as they are.
    pub fn draw_object(&self, gpu: &Gpu, encoder: &mut wgpu::CommandEncoder, camera: &Camera, band: &Band) -> Result<(), GpuError> {
        let object = 0..self.triangles.object_end;
        self.list_pixels(gpu, encoder, (camera, 0.0), 0, band, vec![object])
    }

    // Which of these triangles each pixel sees, and the pixels' lists.
    fn list_pixels(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        (camera, turn): (&Camera, f32),
        first_row: u32,
        band: &Band,
        triangles: Vec<Range<u32>>,
    ) -> Result<(), GpuError> {
        let uniform = CameraUniform {
            object_end: self.triangles.object_end,
            plain_end: self.triangles.plain_end,
            ..CameraUniform::new(camera, self.near, self.environment_turn + turn, first_row, band.rows)?
        };
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&uniform));
        // No groups along x yet, one along y and z, no pixels.
        gpu.queue().write_buffer(&band.work, 0, bytemuck::cast_slice(&[[0u32, 1, 1, 0]; LISTS]));
        self.draw_visibility(encoder, triangles, band);
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_bind_group(0, &band.resources, &[]);
        pass.set_bind_group(1, &self.resources, &[]);
        pass.set_pipeline(&self.sort_pixels);
        pass.dispatch_workgroups(band.width.div_ceil(RUN * SORT_GROUP), band.rows.div_ceil(SORT_GROUP), 1);
        drop(pass);
        encoder.copy_buffer_to_buffer(&band.work, 0, &band.heads, 0, band.heads.size());
        Ok(())
    }

    fn draw_visibility(&self, encoder: &mut wgpu::CommandEncoder, ranges: Vec<Range<u32>>, band: &Band) {
        let color_ops = wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store };
        let depth_ops = wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("visibility"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &band.visibility,
                depth_slice: None,
                resolve_target: None,
                ops: color_ops,
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &band.depth,
                depth_ops: Some(depth_ops),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        pass.set_bind_group(0, &self.camera_only, &[]);
        pass.set_pipeline(&self.visibility);
        pass.set_vertex_buffer(0, self.corners.slice(..));
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        for range in ranges {
            pass.draw_indexed(3 * range.start..3 * range.end, 0, 0..1);
        }
    }
}

impl Band {
    /// How many.
    pub fn pixels(&self) -> u32 {
        self.width * self.rows
    }

    /// R, G, B of each pixel; then all distances; then provenance.
    pub fn output(&self) -> &wgpu::Buffer {
        &self.output
    }

    /// Runs `pass`'s pipeline, of 64 invocations a group, over the list of the object's pixels.
    pub fn dispatch_over_object(&self, pass: &mut wgpu::ComputePass<'_>) {
        pass.dispatch_workgroups_indirect(&self.heads, u64::from(OBJECT_LIST) * LIST_HEAD_BYTES);
    }
}

/// Group 0 of every kernel that includes `band.wgsl`.
pub(crate) fn band_entries() -> [wgpu::BindGroupLayoutEntry; 4] {
    [binding::read_buffer(0), binding::uint_texture(1), binding::write_buffer(2), binding::write_buffer(3)]
}

fn band_bindings<'a>(
    camera: &'a wgpu::Buffer,
    visibility: &'a wgpu::TextureView,
    work: &'a wgpu::Buffer,
    output: &'a wgpu::Buffer,
) -> [wgpu::BindingResource<'a>; 4] {
    let visibility = wgpu::BindingResource::TextureView(visibility);
    [camera.as_entire_binding(), visibility, work.as_entire_binding(), output.as_entire_binding()]
}

fn background_entries() -> Vec<wgpu::BindGroupLayoutEntry> {
    [binding::texture(0)].into_iter().chain(BackgroundTables::entries()).collect()
}

fn visibility_pipeline(gpu: &Gpu, shader: &Shader) -> wgpu::RenderPipeline {
    let attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Uint32];
    let layout = wgpu::VertexBufferLayout {
        array_stride: size_of::<Corner>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &attributes,
    };
    gpu.device().create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("visibility"),
        layout: Some(&shader.layout),
        vertex: wgpu::VertexState {
            module: &shader.module,
            entry_point: Some("corner"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[Some(layout)],
        },
        // Both sides are drawn: proxies are two-sided, and the object's back is marked as such.
        primitive: wgpu::PrimitiveState { front_face: wgpu::FrontFace::Ccw, cull_mode: None, ..Default::default() },
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Greater),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &shader.module,
            entry_point: Some("visible"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(VISIBILITY.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

// The map as it is, or one texel of a constant; and its rotation.
fn environment_texture(gpu: &Gpu, environment: &Environment) -> Result<(wgpu::Texture, f32), GpuError> {
    let (width, height, turn) = match environment {
        Environment::Constant(_) => (1, 1, 0.0),
        Environment::Map(map) => (map.image.width, map.image.height, map.rotation),
    };
    let texel = |at: usize| match environment {
        Environment::Constant(radiance) => *radiance,
        Environment::Map(map) => Vec3::from(map.image.rgb(at)),
    };
    let limit = u64::from(gpu.device().limits().max_texture_dimension_2d);
    if width.max(height) as u64 > limit {
        return Err(GpuError::BeyondLimit { what: "width of the environment map in texels", needed: width.max(height) as u64, limit });
    }
    let texels: Vec<[f32; 4]> = (0..width * height).map(|at| texel(at).extend(0.0).into()).collect();
    Ok((float_texture(gpu, "environment", width as u32, &texels), turn))
}

/// Bands laid open.
#[cfg(test)]
pub(crate) mod resolve {
    use super::{Band, GROUP_SIZE, Rasterizer, background_entries, band_entries};
    use crate::gpu::{Gpu, ReadBack, Shader, binding, storage_buffer};
    use crate::representations::g_buffer::{GBufferPixel, object_entries};

    /// All of `resolve.wgsl`'s source.
    pub(crate) const SOURCE: &str = concat!(
        include_str!("camera.wgsl"),
        include_str!("../../gpu/table.wgsl"),
        include_str!("band.wgsl"),
        include_str!("../../directions/lat_long.wgsl"),
        include_str!("object.wgsl"),
        include_str!("g_buffer.wgsl"),
        include_str!("resolve.wgsl")
    );

    impl Rasterizer {
        /// What each pixel of the band that was drawn last sees, computed by the functions that shading uses.
        pub fn read_g_buffer(&self, gpu: &Gpu, band: &Band) -> Vec<GBufferPixel> {
            let [triangles, vertices] = object_entries();
            let entries = [triangles, vertices, binding::write_buffer(2)];
            let shader = Shader::new(gpu, "resolve", SOURCE, &[&band_entries(), &background_entries(), &entries]);
            let pixels = vec![[[0f32; 4]; 7]; band.pixels() as usize];
            let resolved = storage_buffer(gpu, "resolved", &pixels, wgpu::BufferUsages::COPY_SRC);
            let views = self.object_views();
            let [triangles, vertices] = views.each_ref().map(wgpu::BindingResource::TextureView);
            let own = shader.bind(gpu, 2, &[triangles, vertices, resolved.as_entire_binding()]);
            let pipeline = shader.compute_pipeline(gpu, "resolve", &[("TEXTURED", 1.0)]);
            let read_back = ReadBack::new(gpu, "g-buffer", resolved.size());
            let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(&pipeline);
            for (index, group) in [&band.resources, &self.resources, &own].into_iter().enumerate() {
                pass.set_bind_group(index as u32, group, &[]);
            }
            pass.dispatch_workgroups(band.pixels().div_ceil(GROUP_SIZE), 1, 1);
            drop(pass);
            encoder.copy_buffer_to_buffer(&resolved, 0, read_back.buffer(), 0, resolved.size());
            gpu.queue().submit([encoder.finish()]);
            let read = |bytes: &[u8]| bytes.chunks_exact(size_of::<GBufferPixel>()).map(bytemuck::pod_read_unaligned).collect();
            read_back.request(0..read_back.bytes()).finish(gpu, read).expect("the device works")
        }
    }
}
