//! A measured BRDF on the device: brought when the first frame that shows it is drawn, until one with another is.

use super::super::{GlossBrdf, Settings};
use super::light::view;
use super::{Kernel, gloss};
use crate::gpu::{Gpu, bytes_of_table, float_texture, table, table_bytes};
use crate::radiometry::brdf::{BrdfUniform, Measured};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, RenderError};
use crate::textures::ContentHash;

/// A table's texels, or one that is never read.
pub(super) struct TableTexture {
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    held: Option<(ContentHash, BrdfUniform)>,
}

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;

impl TableTexture {
    pub fn none(gpu: &Gpu) -> Self {
        let texture = float_texture(gpu, "table", 1, &[[0.0; 4]]);
        Self { view: view(&texture), texture, held: None }
    }

    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        table_bytes(&self.texture)
    }

    /// The numbers of the table that is there.
    pub fn uniform(&self) -> Option<BrdfUniform> {
        self.held.map(|(_, uniform)| uniform)
    }
}

impl Kernel {
    /// Whether frames with these settings can be drawn.
    pub(super) fn is_table_there(&self, settings: &Settings) -> bool {
        match gloss(settings.component).map(|gloss| gloss.brdf) {
            Some(GlossBrdf::Measured(hash)) => self.table.held.is_some_and(|(held, _)| held == hash),
            Some(GlossBrdf::Analytic(_)) | None => true,
        }
    }

    /// Brings what such a frame needs. It counts in the budget.
    pub(super) fn ensure_table(
        &mut self,
        request: &FrameRequest<'_>,
        settings: &Settings,
        pages: &CountingSource<'_>,
    ) -> Result<(), RenderError> {
        let wanted = gloss(settings.component).and_then(|gloss| gloss.brdf.table());
        let Some(hash) = wanted.filter(|_| !self.is_table_there(settings)) else { return Ok(()) };
        self.gpu.settle();
        let measured = request.uploads.table.ok_or(RenderError::NoTable { table: hash })?;
        let is_first = self.table.held.is_none();
        if is_first {
            self.check_room("a measured BRDF", bytes_of_table(FORMAT, Measured::TEXELS as u64), pages)?;
        }
        let texels: Vec<[f32; 4]> = measured.texels().collect();
        let texture = table(&self.gpu, "rows of the measured BRDF", FORMAT, &texels)?;
        self.table = TableTexture { view: view(&texture), texture, held: Some((hash, measured.uniform())) };
        self.rebind(is_first);
        Ok(())
    }
}
