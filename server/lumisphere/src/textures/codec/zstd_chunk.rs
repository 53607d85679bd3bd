//! `zstd-chunk`: every block its own; a block never refers outside itself.
//!
//! A block, little-endian: u8 [`Relation`] of its channels, u32 length of each byte plane, the planes, each a zstd frame of its own or,
//! where its length is that of the unpacked plane, as it is. A plane of its own has its own Huffman code, and the lowest bits of measured
//! light, which are noise, cost nothing to unpack. Records of version 1 ([`Layout::Together`]) have all planes, without a relation, in one
//! frame; they are read, not written.

use std::cell::RefCell;
use std::ops::Range;

use zstd::zstd_safe::CParameter;

use super::{BLOCK_ROWS, BadBlock, EncodedPage, Layout, Source, ZSTD_LEVEL, block_count, block_rows};
use super::{best_relation, join_planes, split_rows};
use crate::textures::page::Texels;
use crate::textures::planes::Relation;

/// A plane is stored as it is unless packing saves more than one byte in so many: unpacking costs time.
const WORTHWHILE: usize = 16;
/// Shorter repetitions are chance here, and take longer to unpack than what they replace.
const MIN_MATCH_BYTES: u32 = 7;
/// Planes of the widest number.
const MAX_PLANES: usize = 4;

thread_local! {
    // A zstd context is some hundred kilobytes: one a thread, not one a block.
    static PACKER: RefCell<Option<zstd::bulk::Compressor<'static>>> = const { RefCell::new(None) };
    static UNPACKER: RefCell<(Option<zstd::bulk::Decompressor<'static>>, Vec<u8>)> = const { RefCell::new((None, Vec::new())) };
}

pub(super) fn pack(texels: &Texels, page: &mut EncodedPage) {
    let shape = page.shape;
    let mut planes = Vec::new();
    for block in 0..block_count(&shape) {
        let rows = block_rows(&shape, block);
        let relation = best_relation(&shape, texels, rows.clone());
        planes.clear();
        split_rows(&shape, texels, rows, relation, &mut planes);
        let start = page.payload.len();
        page.payload.push(relation as u8);
        page.payload.resize(start + prefix_bytes(shape.pixel.bytes()), 0);
        for (index, plane) in planes.chunks_exact(planes.len() / shape.pixel.bytes()).enumerate() {
            let packed = compress(plane);
            let is_worthwhile = packed.len() + plane.len() / WORTHWHILE < plane.len();
            let stored = if is_worthwhile { &packed } else { plane };
            page.payload[start + 1 + 4 * index..][..4].copy_from_slice(&(stored.len() as u32).to_le_bytes());
            page.payload.extend_from_slice(stored);
        }
        page.close_block();
    }
}

/// Of a block, before its planes.
fn prefix_bytes(planes: usize) -> usize {
    1 + 4 * planes
}

/// Appends the blocks that `rows` lie in; the first row appended.
pub(super) fn unpack(source: &Source<'_, '_>, rows: &Range<u32>, texels: &mut Texels) -> Result<u32, BadBlock> {
    let shape = &source.shape;
    let blocks = source.codec.blocks_for(rows);
    let first = blocks.start * BLOCK_ROWS;
    texels.make_room((block_rows(shape, blocks.end - 1).end - first) as usize * shape.row_values());
    for index in blocks {
        let bytes = source.checked(index)?;
        let plane_bytes = block_rows(shape, index).len() * shape.row_values();
        let whole = UNPACKER.with_borrow_mut(|(unpacker, unpacked)| {
            let unpacker =
                unpacker.get_or_insert_with(|| zstd::bulk::Decompressor::new().expect("a zstd context fails only without memory"));
            // Kept at its largest: what is not written over is not read.
            unpacked.resize(unpacked.len().max(plane_bytes * shape.pixel.bytes()), 0);
            let unpacked = &mut unpacked[..plane_bytes * shape.pixel.bytes()];
            let mut planes = [&[][..]; MAX_PLANES];
            let planes = &mut planes[..shape.pixel.bytes()];
            let relation = match source.layout {
                Layout::Together => together(unpacker, bytes, unpacked, planes).then_some(Relation::None),
                Layout::Apart => apart(unpacker, bytes, shape.channels, unpacked, planes),
            };
            relation.map(|relation| join_planes(shape, planes, relation, texels)).is_some()
        });
        if !whole {
            return Err(source.bad(index, "not planes of the right length"));
        }
    }
    Ok(first)
}

fn compress(plane: &[u8]) -> Vec<u8> {
    PACKER.with_borrow_mut(|packer| {
        let packer = packer.get_or_insert_with(|| {
            let mut packer = zstd::bulk::Compressor::new(ZSTD_LEVEL).expect("a zstd context fails only without memory");
            packer.set_parameter(CParameter::MinMatch(MIN_MATCH_BYTES)).expect("within zstd's bounds");
            packer
        });
        packer.compress(plane).expect("zstd compresses any plane into its own bound")
    })
}

/// Unpacks a block whose planes are one frame; false if it does not hold exactly them.
fn together<'a>(unpacker: &mut zstd::bulk::Decompressor<'_>, packed: &[u8], unpacked: &'a mut [u8], planes: &mut [&'a [u8]]) -> bool {
    let length = unpacked.len();
    let plane_bytes = length / planes.len();
    let whole = unpacker.decompress_to_buffer(packed, unpacked).is_ok_and(|written| written == length);
    for (plane, bytes) in planes.iter_mut().zip(unpacked.chunks_exact(plane_bytes)) {
        *plane = bytes;
    }
    whole
}

/// Finds or unpacks each plane of a block; None if it does not hold exactly them.
fn apart<'a>(
    unpacker: &mut zstd::bulk::Decompressor<'_>,
    packed: &'a [u8],
    channels: u32,
    unpacked: &'a mut [u8],
    planes: &mut [&'a [u8]],
) -> Option<Relation> {
    let (prefix, mut rest) = packed.split_at_checked(prefix_bytes(planes.len()))?;
    let relation = Relation::from_number(prefix[0], channels as usize)?;
    let lengths = prefix[1..].as_chunks::<4>().0;
    let plane_bytes = unpacked.len() / planes.len();
    for ((plane, length), unpacked) in planes.iter_mut().zip(lengths).zip(unpacked.chunks_exact_mut(plane_bytes)) {
        let stored;
        (stored, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        *plane = if stored.len() == plane_bytes {
            stored
        } else {
            let written = unpacker.decompress_to_buffer(stored, unpacked).ok()?;
            (written == plane_bytes).then_some(&*unpacked)?
        };
    }
    rest.is_empty().then_some(relation)
}
