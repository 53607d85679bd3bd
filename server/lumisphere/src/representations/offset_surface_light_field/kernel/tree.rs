//! The object's tree on the device: made when the first frame is drawn that needs it.

use std::sync::Arc;

use super::super::Settings;
use super::super::object_tree::ObjectTree;
use super::Kernel;
use super::light::view;
use crate::gpu::{Gpu, GpuError, bytes_of_table, float_texture, table, table_bytes};
use crate::representations::RenderError;
use crate::representations::g_buffer::ProxyGeometry;
use crate::representations::page_source::CountingSource;

/// Nodes and packets, or a texel that is never read.
pub(super) struct TreeTexture {
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    first_packet: Option<u32>,
    /// The room that was too little, and what was said: it is not built again for no more.
    refused: Option<(u64, GpuError)>,
}

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;
// In an error.
const ROWS: &str = "rows of the object's tree";

impl TreeTexture {
    pub fn none(gpu: &Gpu) -> Self {
        let texture = float_texture(gpu, "no tree", 1, &[[0.0; 4]]);
        Self { view: view(&texture), texture, first_packet: None, refused: None }
    }

    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        table_bytes(&self.texture)
    }

    /// Whether frames can be drawn that need it.
    pub fn is_made(&self) -> bool {
        self.first_packet.is_some()
    }

    /// Texels before the packets.
    pub fn first_packet(&self) -> u32 {
        self.first_packet.unwrap_or(0)
    }
}

impl Kernel {
    /// Makes what such a frame needs. What is made counts in the budget.
    pub(super) fn ensure_tree(&mut self, settings: &Settings, pages: &CountingSource<'_>) -> Result<(), RenderError> {
        if !settings.needs_tree() || self.tree.first_packet.is_some() {
            return Ok(());
        }
        let room = self.budget_bytes.saturating_sub(self.fixed_bytes());
        if let Some((_, error)) = self.tree.refused.as_ref().filter(|(tried, _)| room <= *tried) {
            return Err(error.clone().into());
        }
        self.gpu.settle();
        let field = &self.field;
        let geometry = ProxyGeometry::new(&field.surface.mesh, &field.surface.part_of_triangle, &field.background);
        let tree = ObjectTree::new(Arc::new(geometry));
        let limit = u64::from(self.gpu.device().limits().max_texture_dimension_2d);
        let (texels, first_packet) = tree.bvh.as_vectors().ok_or(GpuError::BeyondLimit { what: ROWS, needed: u64::MAX, limit })?;
        if let Err(error) = self.check_room("the object's tree", bytes_of_table(FORMAT, texels.len() as u64), pages) {
            if let RenderError::Gpu(error) = &error {
                self.tree.refused = Some((room, error.clone()));
            }
            return Err(error);
        }
        let texture = table(&self.gpu, ROWS, FORMAT, &texels)?;
        self.tree = TreeTexture { view: view(&texture), texture, first_packet: Some(first_packet as u32), refused: None };
        self.rebind(true);
        Ok(())
    }
}
