//! A map's texels and numbers as `kernel.wgsl` reads them, packed from its pages.
//!
//! What costs lavapipe is how often a pixel reads, whatever it reads: so everything comes in elements of 16 bytes, eight f16 numbers or four f32. A
//! texel's head says its model and has the model's constant; what else the model has stands in pairs of quads: a lobe is a pair, harmonics are octets of
//! coefficients, three pairs each, zeros behind the last.

use super::{ModelCode, ParameterMap, Texel, texel_order};
use crate::gpu::{Gpu, GpuError, bytes_of_table, empty_table, table, table_bytes, write_table};
use crate::textures::PixelFormat;

const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Uint;
const ELEMENT_BYTES: usize = 16;
const PAIRS_PER_OCTET: u32 = 3;

/// Heads and pairs.
pub(super) struct DeviceTables([wgpu::Texture; 2]);

impl DeviceTables {
    /// Packs all pages; `page(number)` gives the bytes of one.
    pub fn new<E: From<GpuError>>(
        gpu: &Gpu,
        map: &ParameterMap,
        mut page: impl FnMut(u32, &mut Packer<'_>) -> Result<(), E>,
    ) -> Result<Self, E> {
        let mut packer = Packer::new(map);
        let pairs = empty_table(gpu, "rows of the models' pairs", FORMAT, elements(map, pairs(map)))?;
        gpu.check()?;
        let row_bytes = pairs.width() as usize * ELEMENT_BYTES;
        let mut written = 0;
        for number in 0..map.page_count() as u32 {
            page(number, &mut packer)?;
            let whole = packer.pairs.len() / row_bytes * row_bytes;
            write_table(gpu, &pairs, written, &packer.pairs[..whole]);
            packer.pairs.drain(..whole);
            written += (whole / ELEMENT_BYTES) as u64;
            // Writes wait in memory until they are submitted.
            gpu.queue().submit([]);
        }
        write_table(gpu, &pairs, written, &packer.pairs);
        Ok(Self([table(gpu, "rows of the map's texels", FORMAT, &packer.heads)?, pairs]))
    }

    /// On the device.
    pub fn bytes(&self) -> u64 {
        self.0.iter().map(table_bytes).sum()
    }

    /// The same of a map's that are not made yet.
    pub fn bytes_of(map: &ParameterMap) -> u64 {
        [map.texels.texels.len() as u64, pairs(map)].map(|count| bytes_of_table(FORMAT, elements(map, count))).iter().sum()
    }

    /// In the order of the kernel's bindings.
    pub fn views(&self) -> [wgpu::TextureView; 2] {
        self.0.each_ref().map(|table| table.create_view(&wgpu::TextureViewDescriptor::default()))
    }
}

/// Takes the map's pages in their order.
pub(super) struct Packer<'a> {
    texels: &'a [Texel],
    order: std::iter::Peekable<Box<dyn Iterator<Item = usize> + 'a>>,
    pixel: PixelFormat,
    // Of texels that go on in the next page.
    pending: Vec<u8>,
    next_pair: u32,
    heads: Vec<[u32; 4]>,
    pairs: Vec<u8>,
}

impl<'a> Packer<'a> {
    fn new(map: &'a ParameterMap) -> Self {
        let (texels, pixel) = (map.texels.texels.as_slice(), map.parameters.pixel_format);
        let order: Box<dyn Iterator<Item = usize>> = Box::new(texel_order(map.texels.size, texels.len()));
        let heads = vec![[0; 4]; elements(map, texels.len() as u64) as usize];
        Self { texels, order: order.peekable(), pixel, pending: Vec::new(), next_pair: 0, heads, pairs: Vec::new() }
    }

    fn quad_bytes(&self) -> usize {
        4 * self.pixel.bytes()
    }

    fn pair_bytes(&self) -> usize {
        2 * self.quad_bytes()
    }

    /// The next page's bytes.
    pub fn append(&mut self, page: &[u8]) {
        let mut numbers = std::mem::take(&mut self.pending);
        numbers.extend_from_slice(page);
        let mut rest = numbers.as_slice();
        while let Some(at) = self.order.peek().copied() {
            let Some((own, further)) = rest.split_at_checked(self.texels[at].code.quads() as usize * self.quad_bytes()) else { break };
            self.push(at, own);
            self.order.next();
            rest = further;
        }
        self.pending = rest.to_vec();
    }

    fn push(&mut self, at: usize, numbers: &[u8]) {
        let Texel { code, flags, .. } = self.texels[at];
        let has_constant = code != ModelCode::NONE && code.bands().is_none();
        let (constant, rest) = numbers.split_at(if has_constant { self.quad_bytes() } else { 0 });
        let mut words = [0u32; 4];
        bytemuck::bytes_of_mut(&mut words)[..constant.len()].copy_from_slice(constant);
        let code_and_flags = u32::from(code.number()) | u32::from(flags.bits()) << 8;
        match self.pixel {
            PixelFormat::F16 => self.heads[at] = [code_and_flags, self.next_pair, words[0], words[1]],
            PixelFormat::F32 => self.heads[2 * at..][..2].copy_from_slice(&[[code_and_flags, self.next_pair, 0, 0], words]),
        }
        let end = self.pairs.len() + pairs_of(code) as usize * self.pair_bytes();
        self.pairs.extend_from_slice(rest);
        self.pairs.resize(end, 0);
        self.next_pair += pairs_of(code);
    }
}

// That so many heads or pairs take.
fn elements(map: &ParameterMap, count: u64) -> u64 {
    count * (8 * map.parameters.pixel_format.bytes() / ELEMENT_BYTES) as u64
}

fn pairs_of(code: ModelCode) -> u32 {
    code.bands().map_or(code.lobes(), |bands| PAIRS_PER_OCTET * (bands * bands).div_ceil(8))
}

fn pairs(map: &ParameterMap) -> u64 {
    map.texels.texels.iter().map(|t| u64::from(pairs_of(t.code))).sum()
}

#[cfg(test)]
mod tests {
    use super::super::tests::fixture::{WORLD, World, every_kind};
    use super::*;

    #[test]
    fn wherever_pages_end_the_tables_are_the_same() {
        for pixel in [PixelFormat::F16, PixelFormat::F32] {
            let (map, pages) = World { pixel, ..WORLD }.build(every_kind);
            let bytes: Vec<u8> = pages.0.iter().flat_map(|page| page.bytes().to_vec()).collect();
            let packed = |page_bytes: usize| {
                let mut packer = Packer::new(&map);
                bytes.chunks(page_bytes).for_each(|page| packer.append(page));
                assert!(packer.order.peek().is_none());
                (packer.heads, packer.pairs)
            };
            let whole = packed(bytes.len());
            assert_eq!(whole.1.len() as u64, pairs(&map) * 8 * pixel.bytes() as u64);
            // A page may end within a quad's number, within a texel, and before any of its numbers.
            assert!([7, 4096, 10_000].into_iter().all(|page_bytes| packed(page_bytes) == whole));
        }
    }
}
