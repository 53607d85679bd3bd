//! `zstd-seq`: one zstd frame a page, flushed after each block, so that the bytes up to a block's end give all rows up to there.

use std::cell::RefCell;
use std::io::Write;
use std::ops::Range;

use zstd::stream::raw::{Decoder, InBuffer, Operation, OutBuffer};
use zstd::stream::write::Encoder;

use super::{BadBlock, EncodedPage, Source, ZSTD_LEVEL, block_count, block_rows, join_planes, split_rows};
use crate::textures::page::{PageShape, Texels};
use crate::textures::planes::Relation;

thread_local! {
    // A context and its window are some hundred kilobytes: one a thread.
    static UNPACKER: RefCell<(Option<Decoder<'static>>, Vec<u8>)> = const { RefCell::new((None, Vec::new())) };
}

pub(super) fn pack(texels: &Texels, page: &mut EncodedPage) {
    let shape = page.shape;
    let written = "writing to memory fails only without memory";
    let mut encoder = Encoder::new(std::mem::take(&mut page.payload), ZSTD_LEVEL).expect(written);
    encoder.set_pledged_src_size(Some(shape.decoded_bytes() as u64)).expect("nothing was written yet");
    let mut ends = Vec::new();
    let mut planes = Vec::new();
    for block in 0..block_count(&shape) {
        planes.clear();
        split_rows(&shape, texels, block_rows(&shape, block), Relation::None, &mut planes);
        encoder.write_all(&planes).expect(written);
        encoder.flush().expect(written);
        ends.push(encoder.get_ref().len());
    }
    page.payload = encoder.finish().expect(written);
    // The frame's epilogue belongs to the last block.
    if let Some(last) = ends.last_mut() {
        *last = page.payload.len();
    }
    for end in ends {
        page.close_block_at(end);
    }
}

/// A decoder within a page.
pub(super) struct Running(Decoder<'static>);

impl Running {
    pub fn new() -> Self {
        Self(Decoder::new().expect("a zstd context fails only without memory"))
    }

    /// Of its tables (96 KiB) and buffers (three of 128 KiB), and of its window: no larger than the page, rounded up, or 512 KiB at this level.
    pub fn bytes(shape: &PageShape) -> usize {
        const CONTEXT: usize = 484 << 10;
        CONTEXT + shape.decoded_bytes().next_power_of_two().min(512 << 10)
    }

    /// Appends the rows of `blocks`, the next ones.
    pub fn go_on(&mut self, source: &Source<'_, '_>, blocks: Range<u32>, texels: &mut Texels) -> Result<(), BadBlock> {
        let first = blocks.start;
        read_on(&mut self.0, &mut Vec::new(), source, blocks, first, texels)
    }
}

/// Decodes `blocks`, which come next, and appends the rows of those from `first` on.
fn read_on(
    decoder: &mut Decoder<'_>,
    planes: &mut Vec<u8>,
    source: &Source<'_, '_>,
    blocks: Range<u32>,
    first: u32,
    texels: &mut Texels,
) -> Result<(), BadBlock> {
    let shape = &source.shape;
    texels.make_room((block_rows(shape, blocks.end - 1).end - first * super::BLOCK_ROWS) as usize * shape.row_values());
    for index in blocks {
        let bytes = source.checked(index)?;
        planes.resize(block_rows(shape, index).len() * shape.row_values() * shape.pixel.bytes(), 0);
        if !fill(decoder, bytes, planes) {
            return Err(source.bad(index, "not a zstd frame of the right length"));
        }
        if index >= first {
            let mut each = [&[][..]; 4];
            let each = &mut each[..shape.pixel.bytes()];
            for (plane, bytes) in each.iter_mut().zip(planes.chunks_exact(planes.len() / shape.pixel.bytes())) {
                *plane = bytes;
            }
            join_planes(shape, each, Relation::None, texels);
        }
    }
    Ok(())
}

/// Appends the wanted rows and those of their blocks; the first row appended.
pub(super) fn unpack(source: &Source<'_, '_>, rows: &Range<u32>, texels: &mut Texels) -> Result<u32, BadBlock> {
    let first = rows.start / super::BLOCK_ROWS;
    UNPACKER.with_borrow_mut(|(decoder, planes)| {
        let decoder = decoder.get_or_insert_with(|| Decoder::new().expect("a zstd context fails only without memory"));
        decoder.reinit().expect("a context can be reset");
        read_on(decoder, planes, source, source.codec.blocks_for(rows), first, texels)?;
        Ok(first * super::BLOCK_ROWS)
    })
}

/// Whether the bytes of one block fill its planes.
fn fill(decoder: &mut Decoder<'_>, bytes: &[u8], planes: &mut [u8]) -> bool {
    let (mut input, mut output) = (InBuffer::around(bytes), OutBuffer::around(planes));
    loop {
        let before = (input.pos(), output.pos());
        if decoder.run(&mut input, &mut output).is_err() {
            return false;
        }
        if output.pos() == output.capacity() {
            return true;
        }
        if (input.pos(), output.pos()) == before {
            return false;
        }
    }
}
