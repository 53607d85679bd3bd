//! Pages in the device's memory: square slots in the layers of a few array textures, found through an indirection buffer, given up as
//! a policy chooses.
//!
//! Several slots share a layer, because devices allow few layers; several textures share an atlas, because some devices limit one
//! texture to a gigabyte. The indirection buffer has a word for each page: its slot's column (bits 0–7) and row (8–15) in its layer,
//! its layer (16–28) and texture (29–30), or all ones where the page is not resident. A second word for each page has a bit for each block
//! of its rows that is there: a page may come in parts. Some slots can be set apart for images that never leave; their words follow those
//! of the pages.
//!
//! A slot holds levels of its image, each half the size of the one before, in the texture's levels of detail.

mod shape;

use std::sync::Arc;

use super::ring::UploadRing;
use super::{Gpu, GpuCacheStats, GpuError, storage_buffer};
use crate::textures::{Page, PageKey, PageShape, Policy, PolicyKind, StoreError};
pub(crate) use shape::AtlasShape;

/// How many textures kernels bind for an atlas; unused ones are a single texel.
pub(crate) const ATLAS_TEXTURES: usize = 4;

/// Marks a page that is not resident.
pub(crate) const NOT_RESIDENT: u32 = u32::MAX;

/// Some of a page's rows, to be brought.
pub(crate) struct Upload {
    /// Which page.
    pub page: u32,
    /// A bit for each block of [`AtlasShape::block_rows`] rows.
    pub blocks: u32,
    /// The whole page and its coarser levels, as many as will be read.
    pub levels: Vec<Arc<Page>>,
}

/// The slots and who is in them.
pub(crate) struct Atlas {
    shape: AtlasShape,
    textures: Vec<wgpu::Texture>,
    views: Vec<wgpu::TextureView>,
    slots_per_edge: u32,
    layers: Vec<u32>,
    slot_of_page: Vec<u32>,
    page_of_slot: Vec<Option<u32>>,
    // Blocks of rows that came ahead of need, while no frame has wanted one of them.
    ahead: Vec<u32>,
    free: Vec<u32>,
    policy: Box<dyn Policy>,
    words: Vec<u32>,
    indirection: wgpu::Buffer,
    ring: UploadRing,
    bytes: u64,
    stats: GpuCacheStats,
}

impl Atlas {
    /// As many slots as there are pages, or as fit into `budget_bytes` beside the upload ring and the indirection.
    pub fn new(gpu: &Gpu, shape: AtlasShape, budget_bytes: u64, policy: PolicyKind) -> Result<Self, GpuError> {
        let layout = shape.layout(gpu, budget_bytes).ok_or(GpuError::OverBudget {
            what: "one page",
            needed_bytes: shape.least_bytes(),
            budget_bytes,
        })?;
        let (slots_per_edge, layers, slots) = (layout.slots_per_edge, layout.layers, layout.slots);
        let edge = slots_per_edge * shape.page_size;
        let textures: Vec<_> = layers.iter().map(|layers| array_texture(gpu, shape.format(), edge, *layers, shape.levels)).collect();
        let mut views: Vec<_> = textures.iter().map(array_view).collect();
        // Unused bindings want a texture all the same.
        views.resize_with(ATLAS_TEXTURES, || array_view(&array_texture(gpu, shape.format(), 1, 1, 1)));
        let mut words = vec![NOT_RESIDENT; shape.words()];
        words[shape.page_count..2 * shape.page_count].fill(0);
        let bytes = layers.iter().map(|l| u64::from(*l)).sum::<u64>() * shape.bytes_of_levels(edge) + shape.bytes_beside();
        gpu.check()?;
        let mut atlas = Self {
            slot_of_page: vec![NOT_RESIDENT; shape.page_count],
            page_of_slot: vec![None; slots],
            ahead: vec![0; slots],
            free: (shape.pinned_slots as u32..slots as u32).rev().collect(),
            policy: policy.make(slots as u64),
            indirection: storage_buffer(gpu, "indirection", &words, wgpu::BufferUsages::COPY_DST),
            ring: UploadRing::new(gpu, shape.staged_bytes()),
            stats: GpuCacheStats::default(),
            shape,
            textures,
            views,
            slots_per_edge,
            layers,
            words,
            bytes,
        };
        for slot in 0..shape.pinned_slots as u32 {
            atlas.words[2 * shape.page_count + slot as usize] = atlas.word(slot);
        }
        gpu.queue().write_buffer(&atlas.indirection, 0, bytemuck::cast_slice(&atlas.words));
        Ok(atlas)
    }

    /// On the device: textures, indirection and the upload ring.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Pages that can be resident at once.
    pub fn capacity(&self) -> usize {
        self.page_of_slot.len() - self.shape.pinned_slots
    }

    /// How many textures hold slots; the other views are never read.
    pub fn texture_count(&self) -> usize {
        self.textures.len()
    }

    /// One for each of [`ATLAS_TEXTURES`].
    pub fn views(&self) -> &[wgpu::TextureView] {
        &self.views
    }

    /// A word for each page, its blocks, then a word for each slot set apart.
    pub fn indirection(&self) -> &wgpu::Buffer {
        &self.indirection
    }

    /// Whether `page` has a slot.
    pub fn is_resident(&self, page: u32) -> bool {
        self.slot_of_page[page as usize] != NOT_RESIDENT
    }

    /// Those of `blocks` of a page that are not there.
    pub fn missing(&self, page: u32, blocks: u32) -> u32 {
        blocks & !self.words[self.shape.page_count + page as usize]
    }

    /// A frame begins.
    pub fn begin_frame(&mut self) {
        self.policy.begin_frame();
    }

    /// A frame wants these blocks of `page`: counted, a miss where one is missing, and remembered by the policy where the page has a slot.
    pub fn look_up(&mut self, page: u32, blocks: u32) {
        self.stats.look_ups += 1;
        let is_hit = self.missing(page, blocks) == 0;
        self.stats.hits += u64::from(is_hit);
        self.stats.misses += u64::from(!is_hit);
        let slot = self.slot_of_page[page as usize];
        if slot != NOT_RESIDENT {
            let ahead = &mut self.ahead[slot as usize];
            if *ahead & blocks != 0 {
                *ahead = 0;
                self.stats.prefetch_used += 1;
            }
            self.policy.touch(slot);
        }
    }

    /// Counters since the atlas was made, and what is in it.
    pub fn stats(&self) -> GpuCacheStats {
        let resident_pages = (self.capacity() - self.free.len()) as u64;
        GpuCacheStats { resident_pages, resident_bytes: resident_pages * self.shape.page_bytes(), ..self.stats }
    }

    /// Another policy from now on; it knows who is there but not since when.
    pub fn set_policy(&mut self, kind: PolicyKind) {
        self.policy = kind.make(self.page_of_slot.len() as u64);
        for (slot, page) in self.page_of_slot.iter().enumerate() {
            if let Some(page) = page {
                self.policy.insert(slot as u32, PageKey(u64::from(*page)), 1);
            }
        }
    }

    /// Fills the slots set apart, each with an image and as many levels of it as will be read.
    pub fn upload_pinned(&mut self, gpu: &Gpu, images: &[Vec<Arc<Page>>]) -> Result<(), GpuError> {
        assert!(images.len() <= self.shape.pinned_slots, "{} images for {} slots", images.len(), self.shape.pinned_slots);
        let slots: Vec<u32> = (0..images.len() as u32).collect();
        let all = self.shape.all_blocks();
        for (batch, slots) in images.chunks(self.ring.pages_at_once()).zip(slots.chunks(self.ring.pages_at_once())) {
            self.send(gpu, &batch.iter().map(|levels| (all, levels.as_slice())).collect::<Vec<_>>(), slots)?;
        }
        gpu.check()
    }

    /// Makes blocks of pages resident, of pages that have no slot in slots that are empty or given up by pages that `keep` does not name.
    /// Their shape was checked.
    pub fn upload(&mut self, gpu: &Gpu, uploads: &[Upload], keep: &dyn Fn(u32) -> bool) -> Result<(), GpuError> {
        for batch in uploads.chunks(self.ring.pages_at_once()) {
            let places = batch.iter().map(|upload| self.slot_for(upload.page, keep)).collect::<Result<Vec<_>, _>>()?;
            self.send(gpu, &batch.iter().map(|upload| (upload.blocks, upload.levels.as_slice())).collect::<Vec<_>>(), &places)?;
            for Upload { page, blocks, levels } in batch {
                self.words[self.shape.page_count + *page as usize] |= blocks;
                self.stats.bytes_uploaded += self.shape.bytes_of_blocks(*blocks, levels.len() as u32);
            }
        }
        self.stats.uploads += uploads.len() as u64;
        gpu.queue().write_buffer(&self.indirection, 0, bytemuck::cast_slice(&self.words));
        gpu.check()
    }

    /// This one, just made, came ahead of need.
    pub fn note_ahead(&mut self, upload: &Upload) {
        let ahead = &mut self.ahead[self.slot_of_page[upload.page as usize] as usize];
        self.stats.prefetched += u64::from(*ahead == 0);
        *ahead |= upload.blocks;
    }

    fn slot_for(&mut self, page: u32, keep: &dyn Fn(u32) -> bool) -> Result<u32, GpuError> {
        match self.slot_of_page[page as usize] {
            NOT_RESIDENT => self.admit(page, keep),
            slot => Ok(slot),
        }
    }

    // The slot that `page`, not resident, gets.
    fn admit(&mut self, page: u32, keep: &dyn Fn(u32) -> bool) -> Result<u32, GpuError> {
        let key = PageKey(u64::from(page));
        self.policy.expect(key, 1);
        let slot = match self.free.pop() {
            Some(slot) => slot,
            None => self.make_room(keep).ok_or(GpuError::TooManyPages { needed: self.capacity() + 1, capacity: self.capacity() })?,
        };
        self.policy.insert(slot, key, 1);
        self.page_of_slot[slot as usize] = Some(page);
        self.slot_of_page[page as usize] = slot;
        self.words[page as usize] = self.word(slot);
        Ok(slot)
    }

    // Empties the slot that the policy gives up first of those it may.
    fn make_room(&mut self, keep: &dyn Fn(u32) -> bool) -> Option<u32> {
        let mut kept = Vec::new();
        let victim = loop {
            let Some(slot) = self.policy.evict() else { break None };
            let page = self.page_of_slot[slot as usize].expect("the policy knows only occupied slots");
            if !keep(page) {
                self.slot_of_page[page as usize] = NOT_RESIDENT;
                self.words[page as usize] = NOT_RESIDENT;
                self.words[self.shape.page_count + page as usize] = 0;
                self.page_of_slot[slot as usize] = None;
                self.stats.evictions += 1;
                self.stats.prefetch_wasted += u64::from(std::mem::take(&mut self.ahead[slot as usize]) != 0);
                break Some(slot);
            }
            kept.push((slot, PageKey(u64::from(page))));
        };
        for (slot, key) in kept {
            self.policy.insert(slot, key, 1);
        }
        victim
    }

    // Blocks of rows of images, each with its levels, into these slots.
    fn send(&mut self, gpu: &Gpu, batch: &[(u32, &[Arc<Page>])], slots: &[u32]) -> Result<(), GpuError> {
        let shape = self.shape;
        let origins: Vec<_> = slots.iter().map(|slot| self.place(*slot)).collect();
        let level_offset = |level: u32| (0..level).map(|finer| shape.staged_level_bytes(finer)).sum::<u64>();
        let fill = |k: usize, mut place: wgpu::WriteOnly<'_, [u8]>| {
            let (blocks, levels) = batch[k];
            for (level, image) in (0u32..).zip(levels) {
                let row_bytes = ((shape.page_size >> level) * shape.texel_bytes()) as usize;
                for row in shape.runs(blocks, level).into_iter().flatten().map(|row| row as usize) {
                    let start = level_offset(level) as usize + row * shape.staged_stride(level) as usize;
                    place.slice(start..start + row_bytes).copy_from_slice(&image.bytes()[row * row_bytes..(row + 1) * row_bytes]);
                }
            }
        };
        let textures = &self.textures;
        let copy = |encoder: &mut wgpu::CommandEncoder, buffer: &wgpu::Buffer, k: usize, offset: u64| {
            let (texture, layer, column, row) = origins[k];
            let (blocks, levels) = batch[k];
            for (level, rows) in (0..levels.len() as u32).flat_map(|level| shape.runs(blocks, level).into_iter().map(move |r| (level, r))) {
                let (edge, stride) = (shape.page_size >> level, shape.staged_stride(level));
                let offset = offset + level_offset(level) + u64::from(rows.start) * u64::from(stride);
                let layout = wgpu::TexelCopyBufferLayout { offset, bytes_per_row: Some(stride), rows_per_image: None };
                let origin = wgpu::Origin3d { x: column * edge, y: row * edge + rows.start, z: layer };
                let aspect = wgpu::TextureAspect::All;
                let target = wgpu::TexelCopyTextureInfo { texture: &textures[texture], mip_level: level, origin, aspect };
                let extent = wgpu::Extent3d { width: edge, height: rows.end - rows.start, depth_or_array_layers: 1 };
                encoder.copy_buffer_to_texture(wgpu::TexelCopyBufferInfo { buffer, layout }, target, extent);
            }
        };
        self.ring.send(gpu, batch.len(), fill, copy)
    }

    // Texture, layer, column and row of a slot.
    fn place(&self, slot: u32) -> (usize, u32, u32, u32) {
        let per_layer = self.slots_per_edge * self.slots_per_edge;
        let (mut layer, rest) = (slot / per_layer, slot % per_layer);
        let mut texture = 0;
        while layer >= self.layers[texture] {
            layer -= self.layers[texture];
            texture += 1;
        }
        (texture, layer, rest % self.slots_per_edge, rest / self.slots_per_edge)
    }

    fn word(&self, slot: u32) -> u32 {
        let (texture, layer, column, row) = self.place(slot);
        (texture as u32) << 29 | layer << 16 | row << 8 | column
    }
}

/// The page as an atlas of that shape takes it: its own texels, or converted to four channels of the atlas's format.
pub(crate) fn conform(page: Arc<Page>, atlas: AtlasShape) -> Result<Arc<Page>, StoreError> {
    let wanted = PageShape { width: atlas.page_size, height: atlas.page_size, channels: 4, pixel: atlas.pixel };
    let shape = page.shape();
    if shape == wanted {
        return Ok(page);
    }
    let mut values = Vec::with_capacity(wanted.values());
    for (row, column) in (0..shape.height).flat_map(|r| (0..shape.width).map(move |c| (r, c))) {
        values.extend(page.texel(column, row));
    }
    Page::from_f32(wanted, &values).map(Arc::new)
}

fn array_texture(gpu: &Gpu, format: wgpu::TextureFormat, edge: u32, layers: u32, levels: u32) -> wgpu::Texture {
    gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: Some("atlas"),
        size: wgpu::Extent3d { width: edge, height: edge, depth_or_array_layers: layers },
        mip_level_count: levels,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

fn array_view(texture: &wgpu::Texture) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor { dimension: Some(wgpu::TextureViewDimension::D2Array), ..Default::default() })
}
