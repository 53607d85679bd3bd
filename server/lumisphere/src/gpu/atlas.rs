//! Pages in the device's memory: square slots in the layers of a few array textures, found through an indirection buffer, given up
//! least recently used first.
//!
//! Several slots share a layer, because devices allow few layers; several textures share an atlas, because some devices limit one
//! texture to a gigabyte. The indirection buffer has a word for each page: its slot's column (bits 0–7) and row (8–15) in its layer,
//! its layer (16–28) and texture (29–30), or all ones where the page is not resident.

use std::sync::Arc;

use super::{Gpu, GpuError, storage_buffer};
use crate::textures::{Page, PageShape, PixelFormat, StoreError};

/// How many textures kernels bind for an atlas; unused ones are a single texel.
pub(crate) const ATLAS_TEXTURES: usize = 4;

/// Marks a page that is not resident.
pub(crate) const NOT_RESIDENT: u32 = u32::MAX;

// The largest layer's edge: far below what devices allow, and 32 MiB of RGBA16F.
const LAYER_EDGE_TEXELS: u32 = 2048;
// lavapipe refuses textures above 1 GiB; other devices have no such limit, but larger ones gain nothing.
const MAX_TEXTURE_BYTES: u64 = 1 << 30;
// Uploads pass through a ring of about this size.
const RING_CHUNK_BYTES: u64 = 4 << 20;
const BATCH_BYTES: u64 = 16 << 20;

/// What an atlas holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AtlasShape {
    /// Pages that there are, resident or not.
    pub page_count: usize,
    /// Texels along a page's edge.
    pub page_size: u32,
    /// Four channels of this.
    pub pixel: PixelFormat,
}

/// The slots, who is in them, and since when.
pub(crate) struct Atlas {
    shape: AtlasShape,
    textures: Vec<wgpu::Texture>,
    views: Vec<wgpu::TextureView>,
    slots_per_edge: u32,
    layers: Vec<u32>,
    slot_of_page: Vec<u32>,
    page_of_slot: Vec<Option<u32>>,
    last_use_of_slot: Vec<u64>,
    words: Vec<u32>,
    indirection: wgpu::Buffer,
    ring: wgpu::util::StagingBelt,
    bytes: u64,
}

impl AtlasShape {
    fn texel_bytes(self) -> u32 {
        4 * self.pixel.bytes() as u32
    }

    fn format(self) -> wgpu::TextureFormat {
        match self.pixel {
            PixelFormat::F32 => wgpu::TextureFormat::Rgba32Float,
            PixelFormat::F16 => wgpu::TextureFormat::Rgba16Float,
        }
    }

    // Slots along a layer's edge: as many as the largest layer, the budget, and the pages there are make sensible.
    fn slots_per_edge(self, gpu: &Gpu, budget_bytes: u64) -> u32 {
        let edge = LAYER_EDGE_TEXELS.max(self.page_size).min(gpu.device().limits().max_texture_dimension_2d);
        let page_bytes = u64::from(self.page_size).pow(2) * u64::from(self.texel_bytes());
        let all_pages = (self.page_count as f64).sqrt().ceil() as u32;
        // A tenth of the budget a layer wastes less than a tenth of it by rounding.
        let in_budget = ((budget_bytes / page_bytes) as f64 / 10.0).sqrt().ceil() as u32;
        (edge / self.page_size).min(256).min(all_pages).min(in_budget)
    }
}

impl Atlas {
    /// As many slots as there are pages, or as fit into `budget_bytes`.
    pub fn new(gpu: &Gpu, shape: AtlasShape, budget_bytes: u64) -> Result<Self, GpuError> {
        let slots_per_edge = shape.slots_per_edge(gpu, budget_bytes);
        let edge = slots_per_edge * shape.page_size;
        let layer_bytes = u64::from(edge).pow(2) * u64::from(shape.texel_bytes());
        let wanted = shape.page_count.div_ceil((slots_per_edge as usize).pow(2).max(1)) as u64;
        let affordable = budget_bytes.checked_div(layer_bytes).unwrap_or(0);
        if affordable == 0 {
            let needed_bytes = u64::from(shape.page_size).pow(2) * u64::from(shape.texel_bytes());
            return Err(GpuError::OverBudget { what: "one page", needed_bytes, budget_bytes });
        }
        let most = (MAX_TEXTURE_BYTES / layer_bytes).min(u64::from(gpu.device().limits().max_texture_array_layers)).min(1 << 13);
        let mut left = wanted.min(affordable).min(most * ATLAS_TEXTURES as u64);
        let mut layers = Vec::new();
        while left > 0 {
            layers.push(left.min(most) as u32);
            left -= left.min(most);
        }
        let textures: Vec<_> = layers.iter().map(|layers| array_texture(gpu, shape.format(), edge, *layers)).collect();
        let mut views: Vec<_> = textures.iter().map(array_view).collect();
        // Unused bindings want a texture all the same.
        views.resize_with(ATLAS_TEXTURES, || array_view(&array_texture(gpu, shape.format(), 1, 1)));
        let slots = layers.iter().sum::<u32>() as usize * (slots_per_edge as usize).pow(2);
        let words = vec![NOT_RESIDENT; shape.page_count];
        let bytes = layers.iter().map(|l| u64::from(*l)).sum::<u64>() * layer_bytes + 4 * shape.page_count as u64;
        gpu.check()?;
        Ok(Self {
            slot_of_page: words.clone(),
            page_of_slot: vec![None; slots],
            last_use_of_slot: vec![0; slots],
            indirection: storage_buffer(gpu, "indirection", &words, wgpu::BufferUsages::COPY_DST),
            ring: wgpu::util::StagingBelt::new(gpu.device().clone(), RING_CHUNK_BYTES),
            shape,
            textures,
            views,
            slots_per_edge,
            layers,
            words,
            bytes,
        })
    }

    /// On the device: textures and indirection. The upload ring (at most 20 MiB) is not part of it.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Pages that can be resident at once.
    pub fn capacity(&self) -> usize {
        self.page_of_slot.len()
    }

    /// How many textures hold slots; the other views are never read.
    pub fn texture_count(&self) -> usize {
        self.textures.len()
    }

    /// One for each of [`ATLAS_TEXTURES`].
    pub fn views(&self) -> &[wgpu::TextureView] {
        &self.views
    }

    /// A word for each page.
    pub fn indirection(&self) -> &wgpu::Buffer {
        &self.indirection
    }

    /// Whether `page` can be read.
    pub fn is_resident(&self, page: u32) -> bool {
        self.slot_of_page[page as usize] != NOT_RESIDENT
    }

    /// `page`, which is resident, was read in frame `frame` (increasing, from 1).
    pub fn touch(&mut self, page: u32, frame: u64) {
        self.last_use_of_slot[self.slot_of_page[page as usize] as usize] = frame;
    }

    /// Makes `pages` resident for frame `frame`, in slots that are empty or were not used in that frame. Their shape was checked.
    pub fn upload<'a>(&mut self, gpu: &Gpu, frame: u64, pages: impl ExactSizeIterator<Item = (u32, &'a Page)>) -> Result<(), GpuError> {
        let mut free: Vec<u32> = (0..self.capacity() as u32).filter(|s| self.last_use_of_slot[*s as usize] < frame).collect();
        let needed = pages.len();
        if free.len() < needed {
            return Err(GpuError::TooManyPages { needed: self.capacity() - free.len() + needed, capacity: self.capacity() });
        }
        // Empty slots were never used: they come first.
        free.sort_by_key(|s| (self.last_use_of_slot[*s as usize], *s));
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("upload pages") });
        let mut batch = 0;
        for (slot, (number, page)) in free.into_iter().zip(pages) {
            if let Some(previous) = self.page_of_slot[slot as usize].replace(number) {
                self.slot_of_page[previous as usize] = NOT_RESIDENT;
                self.words[previous as usize] = NOT_RESIDENT;
            }
            self.slot_of_page[number as usize] = slot;
            self.words[number as usize] = self.word(slot);
            self.last_use_of_slot[slot as usize] = frame;
            batch += self.copy_page(&mut encoder, slot, page);
            if batch >= BATCH_BYTES {
                let next = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("upload pages") });
                self.submit(gpu, std::mem::replace(&mut encoder, next))?;
                batch = 0;
            }
        }
        self.submit(gpu, encoder)?;
        gpu.queue().write_buffer(&self.indirection, 0, bytemuck::cast_slice(&self.words));
        gpu.check()
    }

    // Waiting here keeps the ring small: its chunks are free again before the next batch wants them.
    fn submit(&mut self, gpu: &Gpu, encoder: wgpu::CommandEncoder) -> Result<(), GpuError> {
        self.ring.finish();
        gpu.queue().submit([encoder.finish()]);
        self.ring.recall();
        gpu.wait()
    }

    fn copy_page(&mut self, encoder: &mut wgpu::CommandEncoder, slot: u32, page: &Page) -> u64 {
        let row_bytes = self.shape.page_size * self.shape.texel_bytes();
        let stride = row_bytes.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let bytes = u64::from(stride) * u64::from(self.shape.page_size);
        let size = wgpu::BufferSize::new(bytes).expect("a page has texels");
        let alignment = wgpu::BufferSize::new(u64::from(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT)).expect("above zero");
        let slice = self.ring.allocate(size, alignment);
        let (buffer, offset) = (slice.buffer().clone(), slice.offset());
        let mut mapped = slice.get_mapped_range_mut().expect("the ring hands out mapped memory");
        for (row, texels) in page.bytes().chunks_exact(row_bytes as usize).enumerate() {
            let start = row * stride as usize;
            mapped.slice(start..start + row_bytes as usize).copy_from_slice(texels);
        }
        drop(mapped);
        let (texture, layer, column, row) = self.place(slot);
        let source = wgpu::TexelCopyBufferInfo {
            buffer: &buffer,
            layout: wgpu::TexelCopyBufferLayout { offset, bytes_per_row: Some(stride), rows_per_image: None },
        };
        let origin = wgpu::Origin3d { x: column * self.shape.page_size, y: row * self.shape.page_size, z: layer };
        let target =
            wgpu::TexelCopyTextureInfo { texture: &self.textures[texture], mip_level: 0, origin, aspect: wgpu::TextureAspect::All };
        let extent = wgpu::Extent3d { width: self.shape.page_size, height: self.shape.page_size, depth_or_array_layers: 1 };
        encoder.copy_buffer_to_texture(source, target, extent);
        bytes
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

fn array_texture(gpu: &Gpu, format: wgpu::TextureFormat, edge: u32, layers: u32) -> wgpu::Texture {
    gpu.device().create_texture(&wgpu::TextureDescriptor {
        label: Some("atlas"),
        size: wgpu::Extent3d { width: edge, height: edge, depth_or_array_layers: layers },
        mip_level_count: 1,
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
