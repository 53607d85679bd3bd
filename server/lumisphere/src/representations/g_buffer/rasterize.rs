//! Host side of `g_buffer.wgsl`.

use std::mem::offset_of;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use wgpu::util::DeviceExt;

use super::{BackgroundVertex, ObjectVertex, ProxyGeometry, pixel_angle};
use crate::geometry::Camera;
use crate::gpu::{Gpu, GpuError, Shader, binding, storage_buffer, uniform_buffer};
use crate::scenes::Environment;

/// All of `g_buffer.wgsl`'s source.
pub(crate) const SOURCE: &str =
    concat!(include_str!("camera.wgsl"), include_str!("../../directions/lat_long.wgsl"), include_str!("g_buffer.wgsl"));

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
}

/// Object, background and environment on the device, and the pipelines that draw them.
pub(crate) struct Rasterizer {
    pipelines: [Draw; 3],
    sky: wgpu::RenderPipeline,
    camera: wgpu::Buffer,
    resources: wgpu::BindGroup,
    environment_turn: f32,
    near: f32,
    bytes: u64,
}

// A pipeline and what it draws.
struct Draw {
    pipeline: wgpu::RenderPipeline,
    vertices: wgpu::Buffer,
    indices: wgpu::Buffer,
    index_count: u32,
}

/// The G-buffer of one band, reused while its size stays.
pub(crate) struct GBufferTargets {
    /// a and b.
    pub textures: [wgpu::Texture; 2],
    pub a_view: wgpu::TextureView,
    pub b_view: wgpu::TextureView,
    depth: wgpu::TextureView,
}

/// Of a, b and depth.
pub(crate) const G_BUFFER_BYTES_PER_PIXEL: u64 = 16 + 16 + 4;

const COLOR: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

// Beyond these the projection's products leave the range of f32.
const FOCAL_RANGE_PX: std::ops::Range<f32> = 1e-3..1e9;

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
        })
    }
}

impl GBufferTargets {
    pub fn new(gpu: &Gpu, width: u32, height: u32) -> Self {
        let texture = |format, usage| {
            gpu.device().create_texture(&wgpu::TextureDescriptor {
                label: Some("g-buffer"),
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            })
        };
        let read = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_SRC;
        let (a, b) = (texture(COLOR, read), texture(COLOR, read));
        let view = |t: &wgpu::Texture| t.create_view(&wgpu::TextureViewDescriptor::default());
        let depth = view(&texture(DEPTH, wgpu::TextureUsages::empty()));
        Self { a_view: view(&a), b_view: view(&b), textures: [a, b], depth }
    }
}

impl GBufferTargets {
    pub fn width(&self) -> u32 {
        self.textures[0].width()
    }

    pub fn height(&self) -> u32 {
        self.textures[0].height()
    }
}

impl Rasterizer {
    pub fn new(gpu: &Gpu, geometry: &ProxyGeometry) -> Result<Self, GpuError> {
        let entries = [binding::uniform(0), binding::texture(1), binding::read_buffer(2), binding::read_buffer(3), binding::read_buffer(4)];
        let shader = Shader::new(gpu, "g-buffer", SOURCE, &[&entries]);
        let (environment, environment_turn) = environment_texture(gpu, &geometry.environment)?;
        let none = wgpu::BufferUsages::empty();
        gpu.check_binding("the background's textures", size_of_val(geometry.pyramids.texels.as_slice()) as u64)?;
        let materials = storage_buffer(gpu, "materials", &geometry.materials, none);
        let levels = storage_buffer(gpu, "levels", &geometry.pyramids.levels, none);
        let texels = storage_buffer(gpu, "texels", &geometry.pyramids.texels, none);
        let camera = uniform_buffer::<CameraUniform>(gpu, "camera");
        let view = environment.create_view(&wgpu::TextureViewDescriptor::default());
        let resources = [
            camera.as_entire_binding(),
            wgpu::BindingResource::TextureView(&view),
            materials.as_entire_binding(),
            levels.as_entire_binding(),
            texels.as_entire_binding(),
        ];
        let resources = shader.bind(gpu, 0, &resources);
        let textured = |t: &[u32; 3]| geometry.materials[geometry.background_vertices[t[0] as usize].material as usize].level_count > 0;
        let (with_textures, plain): (Vec<_>, Vec<_>) = geometry.background_triangles.iter().copied().partition(textured);
        let background = geometry.background_vertices.as_slice();
        let pipelines = [
            Draw::new(gpu, &shader, "object", &object_attributes(), &geometry.object_vertices, &geometry.object_triangles, false)?,
            Draw::new(gpu, &shader, "background", &background_attributes(), background, &plain, false)?,
            Draw::new(gpu, &shader, "background", &background_attributes(), background, &with_textures, true)?,
        ];
        let environment_bytes = u64::from(environment.width()) * u64::from(environment.height()) * 16;
        let bytes = environment_bytes + materials.size() + levels.size() + texels.size() + pipelines.iter().map(Draw::bytes).sum::<u64>();
        let sky = pipeline(gpu, &shader, ["sky_corner", "sky"], None, wgpu::CompareFunction::GreaterEqual, false);
        gpu.check()?;
        Ok(Self { pipelines, sky, camera, resources, environment_turn, near: geometry.near, bytes })
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// The uniform that later passes bind, too.
    pub fn camera_buffer(&self) -> &wgpu::Buffer {
        &self.camera
    }

    /// Records the drawing of a band of rows into `targets`, which has its size.
    pub fn draw(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        camera: &Camera,
        first_row: u32,
        targets: &GBufferTargets,
    ) -> Result<(), GpuError> {
        let uniform = CameraUniform::new(camera, self.near, self.environment_turn, first_row, targets.height())?;
        gpu.queue().write_buffer(&self.camera, 0, bytemuck::bytes_of(&uniform));
        let color = |view| {
            // Every pixel is written, by the sky if by nothing else; clearing is cheaper than loading.
            let ops = wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store };
            Some(wgpu::RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
        };
        let depth_ops = wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("g-buffer"),
            color_attachments: &[color(&targets.a_view), color(&targets.b_view)],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &targets.depth,
                depth_ops: Some(depth_ops),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        pass.set_bind_group(0, &self.resources, &[]);
        for draw in self.pipelines.iter().filter(|d| d.index_count > 0) {
            pass.set_pipeline(&draw.pipeline);
            pass.set_vertex_buffer(0, draw.vertices.slice(..));
            pass.set_index_buffer(draw.indices.slice(..), wgpu::IndexFormat::Uint32);
            pass.draw_indexed(0..draw.index_count, 0, 0..1);
        }
        pass.set_pipeline(&self.sky);
        pass.draw(0..3, 0..1);
        Ok(())
    }
}

impl Draw {
    fn new<V: Pod>(
        gpu: &Gpu,
        shader: &Shader,
        what: &str,
        attributes: &[wgpu::VertexAttribute],
        vertices: &[V],
        triangles: &[[u32; 3]],
        textured: bool,
    ) -> Result<Self, GpuError> {
        let limit = gpu.device().limits().max_buffer_size;
        let needed = size_of_val(vertices).max(size_of_val(triangles)) as u64;
        if needed > limit {
            return Err(GpuError::BeyondLimit { what: "the proxy geometry in bytes", needed, limit });
        }
        let layout = wgpu::VertexBufferLayout { array_stride: size_of::<V>() as u64, step_mode: wgpu::VertexStepMode::Vertex, attributes };
        let corner = format!("{what}_corner");
        let pipeline = pipeline(gpu, shader, [&corner, what], Some(layout), wgpu::CompareFunction::Greater, textured);
        let buffer = |contents: &[u8], usage| {
            let contents = if contents.is_empty() { &[0; 4] } else { contents };
            gpu.device().create_buffer_init(&wgpu::util::BufferInitDescriptor { label: Some("proxies"), contents, usage })
        };
        Ok(Self {
            pipeline,
            vertices: buffer(bytemuck::cast_slice(vertices), wgpu::BufferUsages::VERTEX),
            indices: buffer(bytemuck::cast_slice(triangles), wgpu::BufferUsages::INDEX),
            index_count: 3 * triangles.len() as u32,
        })
    }

    fn bytes(&self) -> u64 {
        self.vertices.size() + self.indices.size()
    }
}

fn pipeline(
    gpu: &Gpu,
    shader: &Shader,
    [vertex, fragment]: [&str; 2],
    layout: Option<wgpu::VertexBufferLayout<'_>>,
    depth_compare: wgpu::CompareFunction,
    textured: bool,
) -> wgpu::RenderPipeline {
    let constants = [("TEXTURED", f64::from(u8::from(textured)))];
    let compilation_options = wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() };
    gpu.device().create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(fragment),
        layout: Some(&shader.layout),
        vertex: wgpu::VertexState {
            module: &shader.module,
            entry_point: Some(vertex),
            compilation_options: compilation_options.clone(),
            buffers: &layout.map(Some).into_iter().collect::<Vec<_>>(),
        },
        // Both sides are drawn: proxies are two-sided, and the object's back is marked as such.
        primitive: wgpu::PrimitiveState { front_face: wgpu::FrontFace::Ccw, cull_mode: None, ..Default::default() },
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(depth_compare == wgpu::CompareFunction::Greater),
            depth_compare: Some(depth_compare),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &shader.module,
            entry_point: Some(fragment),
            compilation_options,
            targets: &[Some(COLOR.into()), Some(COLOR.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

fn attribute(shader_location: u32, offset: usize, format: wgpu::VertexFormat) -> wgpu::VertexAttribute {
    wgpu::VertexAttribute { format, offset: offset as u64, shader_location }
}

fn object_attributes() -> [wgpu::VertexAttribute; 4] {
    use wgpu::VertexFormat::{Float32x2, Float32x3, Uint32};
    [
        attribute(0, offset_of!(ObjectVertex, position), Float32x3),
        attribute(1, offset_of!(ObjectVertex, normal), Float32x3),
        attribute(2, offset_of!(ObjectVertex, uv), Float32x2),
        attribute(3, offset_of!(ObjectVertex, part), Uint32),
    ]
}

fn background_attributes() -> [wgpu::VertexAttribute; 6] {
    use wgpu::VertexFormat::{Float32x2, Float32x3, Uint32};
    [
        attribute(0, offset_of!(BackgroundVertex, position), Float32x3),
        attribute(1, offset_of!(BackgroundVertex, normal), Float32x3),
        attribute(2, offset_of!(BackgroundVertex, uv), Float32x2),
        attribute(3, offset_of!(BackgroundVertex, material), Uint32),
        attribute(4, offset_of!(BackgroundVertex, irradiance_front), Float32x3),
        attribute(5, offset_of!(BackgroundVertex, irradiance_back), Float32x3),
    ]
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
    let description = wgpu::TextureDescriptor {
        label: Some("environment"),
        size: wgpu::Extent3d { width: width as u32, height: height as u32, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: COLOR,
        usage: wgpu::TextureUsages::TEXTURE_BINDING,
        view_formats: &[],
    };
    let order = wgpu::util::TextureDataOrder::default();
    Ok((gpu.device().create_texture_with_data(gpu.queue(), &description, order, bytemuck::cast_slice(&texels)), turn))
}
