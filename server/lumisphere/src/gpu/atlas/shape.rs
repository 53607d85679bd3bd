//! Sizes of an atlas: of its slots, its layers, its pages in the upload ring, and the blocks of rows that pages come in.

use std::ops::Range;

use super::super::Gpu;
use super::super::ring::UploadRing;
use super::ATLAS_TEXTURES;
use crate::textures::PixelFormat;

// The largest layer's edge: far below what devices allow, and 32 MiB of RGBA16F.
const LAYER_EDGE_TEXELS: u32 = 2048;

// lavapipe refuses textures above 1 GiB; other devices have no such limit, but larger ones gain nothing.
const MAX_TEXTURE_BYTES: u64 = 1 << 30;

/// How slots lie in textures.
pub(super) struct Layout {
    /// Along a layer's edge.
    pub slots_per_edge: u32,
    /// Of each texture.
    pub layers: Vec<u32>,
    /// In all, those set apart included: at least one more than those.
    pub slots: usize,
}

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
    /// Rows of level 0 that come together: a power of two, at least a row of every level that a page has, at least a 32nd of a page.
    pub block_rows: u32,
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

    /// Blocks of rows in a page: 1 to 32, the last perhaps of fewer rows.
    pub fn blocks(self) -> u32 {
        self.page_size.div_ceil(self.block_rows)
    }

    /// A bit for each block of a page.
    pub fn all_blocks(self) -> u32 {
        u32::MAX >> (32 - self.blocks())
    }

    /// Texels of these blocks in the first `levels` levels.
    pub fn bytes_of_blocks(self, blocks: u32, levels: u32) -> u64 {
        let rows = |level| self.runs(blocks, level).into_iter().map(|rows| u64::from(rows.end - rows.start)).sum::<u64>();
        (0..levels).map(|level| rows(level) * u64::from(self.page_size >> level) * u64::from(self.texel_bytes())).sum()
    }

    // The blocks' rows in a level, neighbours together.
    pub(super) fn runs(self, blocks: u32, level: u32) -> Vec<Range<u32>> {
        let mut runs: Vec<Range<u32>> = Vec::new();
        for block in (0..self.blocks()).filter(|block| blocks >> block & 1 == 1) {
            let [start, end] = [block, block + 1].map(|b| (b * self.block_rows).min(self.page_size) >> level);
            match runs.last_mut() {
                Some(last) if last.end == start => last.end = end,
                _ => runs.push(start..end),
            }
        }
        runs
    }

    // Of the indirection.
    pub(super) fn words(self) -> usize {
        2 * self.page_count + self.pinned_slots
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

    /// What the smallest atlas takes: a page beside the slots set apart.
    pub(super) fn least_bytes(self) -> u64 {
        self.bytes_beside() + (1 + self.pinned_slots as u64) * self.page_bytes()
    }

    /// Pages that an atlas of `budget_bytes` can hold at once; 0 where there can be none.
    pub fn capacity(self, gpu: &Gpu, budget_bytes: u64) -> usize {
        self.layout(gpu, budget_bytes).map_or(0, |layout| layout.slots - self.pinned_slots)
    }

    // As many slots as there are pages, or as fit beside the upload ring and the indirection; None where no page does.
    pub(super) fn layout(self, gpu: &Gpu, budget_bytes: u64) -> Option<Layout> {
        let budget_bytes = budget_bytes.checked_sub(self.bytes_beside()).filter(|_| budget_bytes >= self.least_bytes())?;
        // No page of them fits a texture.
        let slots_per_edge = Some(self.slots_per_edge(gpu, budget_bytes)).filter(|slots| *slots > 0)?;
        let in_a_layer = (slots_per_edge as usize).pow(2);
        let layer_bytes = self.bytes_of_levels(slots_per_edge * self.page_size);
        let wanted = (self.page_count + self.pinned_slots).div_ceil(in_a_layer.max(1)) as u64;
        let most = (MAX_TEXTURE_BYTES / layer_bytes).min(u64::from(gpu.device().limits().max_texture_array_layers)).min(1 << 13);
        let mut left = wanted.min(budget_bytes / layer_bytes).min(most * ATLAS_TEXTURES as u64);
        let mut layers = Vec::new();
        while left > 0 {
            layers.push(left.min(most) as u32);
            left -= left.min(most);
        }
        let slots = layers.iter().sum::<u32>() as usize * in_a_layer;
        (slots > self.pinned_slots).then_some(Layout { slots_per_edge, layers, slots })
    }

    // Slots along a layer's edge: as many as the largest layer, the budget, and the pages there are make sensible.
    pub(super) fn slots_per_edge(self, gpu: &Gpu, budget_bytes: u64) -> u32 {
        let edge = LAYER_EDGE_TEXELS.max(self.page_size).min(gpu.device().limits().max_texture_dimension_2d);
        let page_bytes = self.page_bytes();
        let all_pages = ((self.page_count + self.pinned_slots) as f64).sqrt().ceil() as u32;
        // A tenth of the budget a layer wastes less than a tenth of it by rounding.
        let in_budget = ((budget_bytes / page_bytes) as f64 / 10.0).sqrt().ceil() as u32;
        (edge / self.page_size).min(256).min(all_pages).min(in_budget)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_every_level_lies_in_one_block() {
        for (page_size, levels, block_rows) in [(128, 3, 16), (24, 2, 16), (1024, 6, 32), (16, 1, 16), (8, 1, 16), (512, 1, 16)] {
            let shape = AtlasShape { page_count: 1, page_size, pixel: PixelFormat::F16, levels, pinned_slots: 0, block_rows };
            let all = shape.all_blocks();
            assert_eq!(all.count_ones(), page_size.div_ceil(block_rows));
            for level in 0..levels {
                assert_eq!(shape.runs(all, level).first(), Some(&(0..page_size >> level)), "{page_size}, level {level}");
                let apart: Vec<u32> = (0..shape.blocks()).flat_map(|block| shape.runs(1 << block, level)).flatten().collect();
                assert_eq!(apart, (0..page_size >> level).collect::<Vec<_>>(), "{page_size}, level {level}");
            }
            let parts: u64 = (0..shape.blocks()).map(|block| shape.bytes_of_blocks(1 << block, levels)).sum();
            assert_eq!((parts, shape.bytes_of_blocks(all, levels)), (shape.page_bytes(), shape.page_bytes()));
        }
    }

    #[test]
    fn blocks_that_are_neighbours_come_in_one_run() {
        let shape = AtlasShape { page_count: 1, page_size: 128, pixel: PixelFormat::F16, levels: 2, pinned_slots: 0, block_rows: 16 };
        assert_eq!(shape.runs(0b1000_0110, 0), [16..48, 112..128]);
        assert_eq!(shape.runs(0b1000_0110, 1), [8..24, 56..64]);
        assert_eq!(shape.bytes_of_blocks(0b11, 2), 8 * (32 * 128 + 16 * 64));
    }
}
