//! Sizes of an atlas: of its slots, its layers, and its pages in the upload ring.

use super::super::Gpu;
use super::super::ring::UploadRing;
use crate::textures::PixelFormat;

// The largest layer's edge: far below what devices allow, and 32 MiB of RGBA16F.
const LAYER_EDGE_TEXELS: u32 = 2048;

/// What an atlas holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AtlasShape {
    /// Pages that there are, resident or not.
    pub page_count: usize,
    /// Texels along a page's edge.
    pub page_size: u32,
    /// Four channels of this.
    pub pixel: PixelFormat,
    /// Levels of detail in a slot, at least 1; `page_size` is a multiple of 2 to the power of one less.
    pub levels: u32,
    /// Slots set apart.
    pub pinned_slots: usize,
}

impl AtlasShape {
    pub(super) fn texel_bytes(self) -> u32 {
        4 * self.pixel.bytes() as u32
    }

    /// Of a slot's texels, all levels.
    pub fn page_bytes(self) -> u64 {
        self.bytes_of_levels(self.page_size)
    }

    /// What an atlas takes beside its slots: the upload ring and the indirection.
    pub fn bytes_beside(self) -> u64 {
        UploadRing::bytes_for(self.staged_bytes()) + 4 * self.words() as u64
    }

    pub(super) fn words(self) -> usize {
        self.page_count + self.pinned_slots
    }

    // Of a square of `edge` texels and its levels.
    pub(super) fn bytes_of_levels(self, edge: u32) -> u64 {
        (0..self.levels).map(|level| u64::from(edge >> level).pow(2) * u64::from(self.texel_bytes())).sum()
    }

    // A slot in the upload ring, where rows are aligned.
    pub(super) fn staged_bytes(self) -> u64 {
        (0..self.levels).map(|level| self.staged_level_bytes(level)).sum()
    }

    pub(super) fn staged_level_bytes(self, level: u32) -> u64 {
        u64::from(self.staged_stride(level)) * u64::from(self.page_size >> level)
    }

    pub(super) fn staged_stride(self, level: u32) -> u32 {
        ((self.page_size >> level) * self.texel_bytes()).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT)
    }

    pub(super) fn format(self) -> wgpu::TextureFormat {
        match self.pixel {
            PixelFormat::F32 => wgpu::TextureFormat::Rgba32Float,
            PixelFormat::F16 => wgpu::TextureFormat::Rgba16Float,
        }
    }

    // Slots along a layer's edge: as many as the largest layer, the budget, and the pages there are make sensible.
    pub(super) fn slots_per_edge(self, gpu: &Gpu, budget_bytes: u64) -> u32 {
        let edge = LAYER_EDGE_TEXELS.max(self.page_size).min(gpu.device().limits().max_texture_dimension_2d);
        let page_bytes = self.page_bytes();
        let all_pages = (self.words() as f64).sqrt().ceil() as u32;
        // A tenth of the budget a layer wastes less than a tenth of it by rounding.
        let in_budget = ((budget_bytes / page_bytes) as f64 / 10.0).sqrt().ceil() as u32;
        (edge / self.page_size).min(256).min(all_pages).min(in_budget)
    }
}
