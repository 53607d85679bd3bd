//! `zstd-chunk`: every block its own zstd frame; a block never refers outside itself.

use std::cell::RefCell;
use std::ops::Range;

use super::{BLOCK_ROWS, BadBlock, EncodedPage, Source, ZSTD_LEVEL, block_count, block_rows, join_rows, reserve_rows, split_rows};
use crate::textures::page::Texels;

thread_local! {
    // A zstd context is some hundred kilobytes: one a thread, not one a block.
    static PACKER: RefCell<Option<zstd::bulk::Compressor<'static>>> = const { RefCell::new(None) };
    static UNPACKER: RefCell<(Option<zstd::bulk::Decompressor<'static>>, Vec<u8>)> = const { RefCell::new((None, Vec::new())) };
}

pub(super) fn pack(texels: &Texels, page: &mut EncodedPage) {
    let shape = page.shape;
    let mut planes = Vec::new();
    for block in 0..block_count(&shape) {
        planes.clear();
        split_rows(&shape, texels, block_rows(&shape, block), &mut planes);
        page.payload.extend_from_slice(&compress(&planes));
        page.close_block();
    }
}

/// Appends the blocks that `rows` lie in; the first row appended.
pub(super) fn unpack(source: &Source<'_, '_>, rows: &Range<u32>, texels: &mut Texels) -> Result<u32, BadBlock> {
    let shape = &source.shape;
    let blocks = source.codec.blocks_for(rows);
    let first = blocks.start * BLOCK_ROWS;
    reserve_rows(shape, block_rows(shape, blocks.end - 1).end - first, texels);
    for index in blocks {
        let bytes = source.checked(index)?;
        let length = block_rows(shape, index).len() * shape.row_values() * shape.pixel.bytes();
        if !decompress(bytes, length, |planes| join_rows(shape, planes, texels)) {
            return Err(source.bad(index, "not a zstd frame of the right length"));
        }
    }
    Ok(first)
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
