//! What frames in other light need on the device: made when the first of them is drawn.

use bytemuck::bytes_of;

use super::super::Settings;
use super::super::relight::{EnvironmentCube, LightTables, StoredAndShown};
use super::{Kernel, LightUniform, PointLightUniform};
use crate::gpu::{Gpu, GpuError, float_texture};
use crate::representations::RenderError;
use crate::representations::page_source::CountingSource;
use crate::scenes::{MOST_POINT_LIGHTS, PointLight};

/// The environment's cube map and the sample points' irradiances, or a texel each that is never read.
pub(super) struct LightTextures {
    environment: wgpu::Texture,
    irradiances: wgpu::Texture,
    views: [wgpu::TextureView; 2],
    // As the uniform tells them.
    size: u32,
    base: u32,
    has_environment: bool,
    // Whose light the irradiances are: bits of the turn.
    shown: Option<u32>,
}

const TEXEL_BYTES: u64 = 16;
// As in relight.wgsl.
const POINTS_IN_A_ROW: usize = 256;
const TEXELS_OF_A_POINT: usize = 6;

impl LightTextures {
    pub fn none(gpu: &Gpu) -> Self {
        let [environment, irradiances] = [0, 1].map(|_| float_texture(gpu, "no other light", 1, &[[0.0; 4]]));
        let views = [&environment, &irradiances].map(view);
        Self { environment, irradiances, views, size: 1, base: 0, has_environment: false, shown: None }
    }

    pub fn views(&self) -> &[wgpu::TextureView; 2] {
        &self.views
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        let bytes = |texture: &wgpu::Texture| TEXEL_BYTES * u64::from(texture.width()) * u64::from(texture.height());
        bytes(&self.environment) + bytes(&self.irradiances)
    }

    fn set_environment(&mut self, gpu: &Gpu, cube: &EnvironmentCube) -> Result<(), GpuError> {
        let (limit, needed) =
            (u64::from(gpu.device().limits().max_texture_dimension_2d), (cube.texels.len() as u64) / u64::from(cube.size));
        if needed > limit {
            return Err(GpuError::BeyondLimit { what: "height of the environment's cube map in texels", needed, limit });
        }
        let texels: Vec<[f32; 4]> = cube.texels.iter().map(|radiance| radiance.extend(0.0).into()).collect();
        self.environment = float_texture(gpu, "environment cube", cube.size, &texels);
        self.views[0] = view(&self.environment);
        (self.size, self.base, self.has_environment) = (cube.size, cube.base, true);
        Ok(())
    }

    fn set_irradiances(&mut self, gpu: &Gpu, irradiances: &[StoredAndShown], shown: u32) {
        let mut texels = vec![[0f32; 4]; texels_of(irradiances.len())];
        for (point, irradiance) in texels.chunks_mut(TEXELS_OF_A_POINT).zip(irradiances) {
            let vectors = irradiance.stored.iter().chain(&irradiance.shown);
            point.iter_mut().zip(vectors).for_each(|(texel, vector)| *texel = vector.extend(0.0).into());
        }
        self.irradiances = float_texture(gpu, "irradiances", (POINTS_IN_A_ROW * TEXELS_OF_A_POINT) as u32, &texels);
        self.views[1] = view(&self.irradiances);
        self.shown = Some(shown);
    }
}

// Whole rows.
fn texels_of(points: usize) -> usize {
    points.div_ceil(POINTS_IN_A_ROW) * POINTS_IN_A_ROW * TEXELS_OF_A_POINT
}

pub(super) fn view(texture: &wgpu::Texture) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor::default())
}

impl Kernel {
    /// Whether such a frame can be drawn with what there is.
    pub(super) fn is_light_made(&self, settings: &Settings) -> bool {
        !settings.light.changes_light() || self.light_textures.has_environment
    }

    /// Makes what such a frame needs. What is made counts in the budget: where pages leave it no room they are forgotten.
    pub(super) fn ensure_light(&mut self, settings: &Settings, pages: &CountingSource<'_>) -> Result<(), RenderError> {
        if !settings.light.changes_light() {
            return Ok(());
        }
        self.gpu.settle();
        let before = self.light_textures.bytes() + self.light_tables.bytes();
        let (environment, irradiances) = LightTables::texels(&self.field, settings);
        let needed = LightTables::bytes_for(&self.field, settings)
            + TEXEL_BYTES * environment as u64
            + if irradiances > 0 { TEXEL_BYTES * texels_of(irradiances) as u64 } else { 0 };
        if needed > before {
            self.check_room("tables of other light", needed - before, pages)?;
        }
        let made = self.make_light(settings, pages);
        // Some of it may be there even if the rest could not be made.
        let has_grown = self.light_textures.bytes() + self.light_tables.bytes() > before;
        if has_grown || !matches!(made, Ok(false)) {
            self.rebind(has_grown);
        }
        made.map(drop)
    }

    // Whether there was something to make.
    fn make_light(&mut self, settings: &Settings, pages: &CountingSource<'_>) -> Result<bool, RenderError> {
        let Some(lit) = self.light_tables.lit(&self.field, settings, pages)? else { return Ok(false) };
        let turn = settings.light.environment_turn().to_bits();
        let needs_irradiance = !lit.irradiance.is_empty() && self.light_textures.shown != Some(turn);
        if self.light_textures.has_environment && !needs_irradiance {
            return Ok(false);
        }
        if !self.light_textures.has_environment {
            self.light_textures.set_environment(&self.gpu, &lit.environment)?;
        }
        if needs_irradiance {
            self.light_textures.set_irradiances(&self.gpu, &lit.irradiance, turn);
        }
        Ok(true)
    }

    /// After views were made anew: pages stay, unless what was made leaves them no room.
    pub(super) fn rebind(&mut self, has_grown: bool) {
        if has_grown && self.atlas.as_ref().is_some_and(|bound| self.fixed_bytes() + bound.atlas.bytes() > self.budget_bytes) {
            self.forget_pages();
        } else if let Some(bound) = self.atlas.take() {
            let views = self.bind_views(&bound.atlas);
            self.atlas = Some(super::BoundAtlas { views, ..bound });
        }
    }

    pub(super) fn write_light(&self, settings: &Settings) {
        let light = settings.light;
        let (turn_sin, turn_cos) = light.environment_turn().sin_cos();
        let mut point_lights = [PointLightUniform { position: [0.0; 3], before: 0.0, intensity: [0.0; 3], after: 0.0 }; MOST_POINT_LIGHTS];
        for (uniform, PointLight { position, intensity }) in point_lights.iter_mut().zip(light.point_lights()) {
            (uniform.position, uniform.intensity) = ((*position).into(), (*intensity).into());
        }
        let uniform = LightUniform {
            turn_cos,
            turn_sin,
            environment_size: self.light_textures.size,
            environment_base: self.light_textures.base,
            point_light_count: light.point_lights().len() as u32,
            padding: [0; 3],
            point_lights,
        };
        self.gpu.queue().write_buffer(&self.light, 0, bytes_of(&uniform));
    }
}
