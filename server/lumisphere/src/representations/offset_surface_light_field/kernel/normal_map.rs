//! A normal map on the device: brought when the first frame that shows it is drawn, until one with another is.

use super::super::{Bumps, Settings};
use super::Kernel;
use super::light::view;
use crate::gpu::{Gpu, bytes_of_table, float_texture, table, table_bytes};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, RenderError};
use crate::textures::ContentHash;

/// A map's slopes, or a texel that is never read.
pub(super) struct NormalMapTexture {
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    held: Option<(ContentHash, [u32; 2])>,
}

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rg16Float;

impl NormalMapTexture {
    pub fn none(gpu: &Gpu) -> Self {
        let texture = float_texture(gpu, "no normal map", 1, &[[0.0; 4]]);
        Self { view: view(&texture), texture, held: None }
    }

    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        table_bytes(&self.texture)
    }

    /// Texels along u and v; 1 where there is none.
    pub fn size(&self) -> [u32; 2] {
        self.held.map_or([1; 2], |(_, size)| size)
    }
}

impl Kernel {
    /// Whether frames with these settings can be drawn.
    pub(super) fn is_normal_map_there(&self, settings: &Settings) -> bool {
        settings.bumps.is_none_or(|bumps| self.normal_map.held.is_some_and(|(held, _)| held == bumps.map))
    }

    /// Brings what such a frame needs. It counts in the budget.
    pub(super) fn ensure_normal_map(
        &mut self,
        request: &FrameRequest<'_>,
        settings: &Settings,
        pages: &CountingSource<'_>,
    ) -> Result<(), RenderError> {
        let Some(Bumps { map: hash, .. }) = settings.bumps.filter(|_| !self.is_normal_map_there(settings)) else { return Ok(()) };
        let map = request.uploads.normal_map.ok_or(RenderError::NoNormalMap { map: hash })?;
        let (before, after) = (self.normal_map.bytes(), bytes_of_table(FORMAT, map.texels().len() as u64));
        let has_grown = after > before;
        if has_grown {
            self.check_room("a normal map", after - before, pages)?;
        }
        self.gpu.settle();
        let texture = table(&self.gpu, "rows of the normal map", FORMAT, map.texels())?;
        let [width, height] = map.size();
        self.normal_map = NormalMapTexture { view: view(&texture), texture, held: Some((hash, [width as u32, height as u32])) };
        self.rebind(has_grown);
        Ok(())
    }
}
