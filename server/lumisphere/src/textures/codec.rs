//! Texels ↔ stored bytes. `zstd-chunk`: blocks of 16 rows, each its own zstd frame over byte planes with its own xxh3.
//!
//! Within a block the numbers pass through [`planes`], a reversible transform. Lossless for f32; f16 loses only what rounding
//! loses. A block never refers outside itself.
//!
//! The sequential codecs (one frame a page, LZW) get their own [`Codec`] value and file beside this one.

use std::cell::RefCell;
use std::ops::Range;

use half::f16;
use half::slice::HalfFloatSliceExt;
use xxhash_rust::xxh3::xxh3_64;

use super::error::StoreError;
use super::page::{Page, PageShape, PixelFormat, Texels};
use super::planes;

/// Rows in a block; the last block of a page may have fewer.
pub const BLOCK_ROWS: u32 = 16;
/// Largest finite f16. Larger finite numbers are clamped to it (and counted); infinities stay.
pub const MAX_F16: f32 = 65504.0;
/// zstd's fastest regular level: higher ones gain 1–4 % here and cost four times the time.
const ZSTD_LEVEL: i32 = 1;

/// How a page's texels are packed. The numbers are those on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// Independent blocks of 16 rows, zstd over byte planes.
    ZstdChunk = 1,
}

/// One block's place in a page's payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Block {
    /// From the payload's start.
    pub offset: u32,
    pub length: u32,
    /// xxh3 of the compressed bytes.
    pub checksum: u64,
}

/// A page ready to be appended. Encoding needs no store, so many threads can do it.
#[derive(Debug, Clone)]
pub struct EncodedPage {
    pub(super) shape: PageShape,
    pub(super) codec: Codec,
    pub(super) blocks: Vec<Block>,
    pub(super) payload: Vec<u8>,
    /// Finite numbers beyond ±65504 that f16 could not hold and that were clamped to it. 0 for f32.
    pub clamped: u64,
}

/// Blocks of a page.
pub(super) fn block_count(shape: &PageShape) -> u32 {
    shape.height.div_ceil(BLOCK_ROWS)
}

/// Rows of block `index`.
pub(super) fn block_rows(shape: &PageShape, index: u32) -> Range<u32> {
    index * BLOCK_ROWS..((index + 1) * BLOCK_ROWS).min(shape.height)
}

/// Packs `texels` (height · width · channels numbers, interleaved, row 0 first) as `shape.pixel`.
/// Same input, same bytes. Fails on a shape that cannot be stored or a wrong count.
pub fn encode(shape: &PageShape, texels: &[f32]) -> Result<EncodedPage, StoreError> {
    let shape = shape.checked()?;
    if texels.len() != shape.values() {
        return Err(StoreError::InvalidPage { reason: format!("{} numbers where the shape has {}", texels.len(), shape.values()) });
    }
    let mut page =
        EncodedPage { shape, codec: Codec::ZstdChunk, blocks: Vec::new(), payload: Vec::with_capacity(shape.decoded_bytes()), clamped: 0 };
    let channels = shape.channels as usize;
    let mut unpacked = Vec::new();
    for block in texels.chunks(shape.row_values() * BLOCK_ROWS as usize) {
        unpacked.clear();
        match shape.pixel {
            PixelFormat::F32 => planes::split::<u32>(bytemuck::cast_slice(block), channels, shape.row_values(), &mut unpacked),
            PixelFormat::F16 => {
                let (halves, clamped) = to_f16(block);
                page.clamped += clamped;
                planes::split::<u16>(bytemuck::cast_slice(&halves), channels, shape.row_values(), &mut unpacked);
            }
        }
        let packed = compress(&unpacked);
        page.blocks.push(Block { offset: page.payload.len() as u32, length: packed.len() as u32, checksum: xxh3_64(&packed) });
        page.payload.extend_from_slice(&packed);
    }
    Ok(page)
}

/// A block that does not decode: its rows and why.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BadBlock {
    pub rows: Range<u32>,
    pub reason: &'static str,
}

/// Rows `blocks.start · 16` … of a page. `packed(index)` gives block `index`'s compressed bytes, or None where the file ends before.
pub(super) fn decode<'a>(
    shape: &PageShape,
    table: &[Block],
    blocks: Range<u32>,
    packed: impl Fn(&Block) -> Option<&'a [u8]>,
) -> Result<Page, BadBlock> {
    let rows = block_rows(shape, blocks.start).start..block_rows(shape, blocks.end - 1).end;
    let part = PageShape { height: rows.end - rows.start, ..*shape };
    let mut texels = match shape.pixel {
        PixelFormat::F32 => Texels::F32(vec![0.0; part.values()]),
        PixelFormat::F16 => Texels::F16(vec![f16::ZERO; part.values()]),
    };
    let (channels, row_values) = (shape.channels as usize, shape.row_values());
    let mut start = 0;
    for index in blocks {
        let rows = block_rows(shape, index);
        let values = start..start + row_values * rows.len();
        start = values.end;
        let bad = |reason| BadBlock { rows: rows.clone(), reason };
        let block = &table[index as usize];
        let bytes = packed(block).ok_or_else(|| bad("the segment ends before them"))?;
        if xxh3_64(bytes) != block.checksum {
            return Err(bad("checksum mismatch"));
        }
        let unpacked = decompress(bytes, values.len() * shape.pixel.bytes(), |unpacked| match &mut texels {
            Texels::F32(v) => planes::join::<u32>(unpacked, channels, row_values, bytemuck::cast_slice_mut(&mut v[values])),
            Texels::F16(v) => planes::join::<u16>(unpacked, channels, row_values, bytemuck::cast_slice_mut(&mut v[values])),
        });
        if !unpacked {
            return Err(bad("not a zstd frame of the right length"));
        }
    }
    Ok(Page::new(part, texels))
}

/// Nearest f16 of each number, and how many finite ones had to be clamped.
pub(super) fn to_f16(values: &[f32]) -> (Vec<f16>, u64) {
    let mut clamped = 0;
    let kept: Vec<f32> = values
        .iter()
        .map(|&v| {
            if v.is_finite() && v.abs() > MAX_F16 {
                clamped += 1;
                return MAX_F16.copysign(v);
            }
            v
        })
        .collect();
    let mut halves = vec![f16::ZERO; values.len()];
    halves.convert_from_f32_slice(&kept);
    (halves, clamped)
}

thread_local! {
    // A zstd context is some hundred kilobytes: one a thread, not one a block.
    static PACKER: RefCell<Option<zstd::bulk::Compressor<'static>>> = const { RefCell::new(None) };
    static UNPACKER: RefCell<(Option<zstd::bulk::Decompressor<'static>>, Vec<u8>)> = const { RefCell::new((None, Vec::new())) };
}

fn compress(planes: &[u8]) -> Vec<u8> {
    PACKER.with_borrow_mut(|packer| {
        let packer =
            packer.get_or_insert_with(|| zstd::bulk::Compressor::new(ZSTD_LEVEL).expect("a zstd context fails only without memory"));
        packer.compress(planes).expect("zstd compresses any block into its own bound")
    })
}

/// Calls `then` with exactly `length` unpacked bytes; false if `packed` does not hold that.
fn decompress(packed: &[u8], length: usize, then: impl FnOnce(&[u8])) -> bool {
    UNPACKER.with_borrow_mut(|(unpacker, planes)| {
        let unpacker = unpacker.get_or_insert_with(|| zstd::bulk::Decompressor::new().expect("a zstd context fails only without memory"));
        planes.clear();
        planes.reserve(length);
        let whole = unpacker.decompress_to_buffer(packed, planes).is_ok_and(|written| written == length);
        if whole {
            then(planes);
        }
        whole
    })
}
