//! `lzw-seq`: the numbers' bytes, row by row, through LZW as TIFF has it (most significant bit first, code sizes switched early), one
//! stream a page. No transform before: this is the codec of the paper, kept to compare with. On f32 it gains nothing.
//!
//! LZW cannot be flushed, so a block ends where a decoder that has given all of its rows has read to.

use std::cell::RefCell;
use std::ops::Range;

use half::f16;
use weezl::BitOrder;
use weezl::decode::{Configuration, Decoder};
use weezl::encode::Encoder;

use super::{BadBlock, EncodedPage, Source, block_count, block_rows};
use crate::textures::page::{PixelFormat, Texels};

thread_local! {
    static UNPACKER: RefCell<(Option<Decoder>, Vec<u8>)> = const { RefCell::new((None, Vec::new())) };
}

fn new_decoder() -> Decoder {
    Configuration::with_tiff_size_switch(BitOrder::Msb, 8).with_yield_on_full_buffer(true).build()
}

pub(super) fn pack(texels: &Texels, page: &mut EncodedPage) {
    let shape = page.shape;
    let plain: Vec<u8> = match texels {
        Texels::F32(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
        Texels::F16(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
    };
    let mut encoder = Encoder::with_tiff_size_switch(BitOrder::Msb, 8);
    page.payload = encoder.encode(&plain).expect("every byte is a symbol of 8 bits");
    let mut decoder = new_decoder();
    let mut unpacked = vec![0; shape.row_values() * shape.pixel.bytes() * super::BLOCK_ROWS as usize];
    let mut end = 0;
    for block in 0..block_count(&shape) {
        let bytes = block_rows(&shape, block).len() * shape.row_values() * shape.pixel.bytes();
        end += feed(&mut decoder, &page.payload[end..], &mut unpacked[..bytes]).0;
        // The stream's end mark belongs to the last block.
        let is_last = block + 1 == block_count(&shape);
        page.close_block_at(if is_last { page.payload.len() } else { end });
    }
}

/// Decodes until `out` is full or `input` is used up; bytes read and written.
fn feed(decoder: &mut Decoder, input: &[u8], out: &mut [u8]) -> (usize, usize) {
    let (mut read, mut written) = (0, 0);
    while written < out.len() {
        let result = decoder.decode_bytes(&input[read..], &mut out[written..]);
        read += result.consumed_in;
        written += result.consumed_out;
        if result.status.is_err() || (result.consumed_in, result.consumed_out) == (0, 0) {
            break;
        }
    }
    (read, written)
}

/// A decoder within a page.
pub(super) struct Running {
    decoder: Decoder,
    /// Bytes of the payload that it has read.
    read: usize,
}

impl Running {
    /// Of a decoder: 4096 codes of four bytes, their lengths, and a buffer.
    pub const BYTES: usize = 32 << 10;

    pub fn new() -> Self {
        Self { decoder: new_decoder(), read: 0 }
    }

    pub fn read(&self) -> usize {
        self.read
    }

    /// Appends `rows`, of which it has given those before, from `blocks`: that in which it stopped reading and those behind it.
    pub fn go_on(&mut self, source: &Source<'_, '_>, blocks: Range<u32>, rows: Range<u32>, texels: &mut Texels) -> Result<(), BadBlock> {
        let mut plain = vec![0; rows.len() * source.shape.row_values() * source.shape.pixel.bytes()];
        read_on(&mut self.decoder, &mut self.read, source, blocks, rows.start, &mut plain)?;
        append(&plain, source.shape.pixel, texels);
        Ok(())
    }
}

/// Fills `plain` with the rows from `first_row` on, out of `blocks`, behind the `read` bytes of the payload that the decoder has had.
fn read_on(
    decoder: &mut Decoder,
    read: &mut usize,
    source: &Source<'_, '_>,
    blocks: Range<u32>,
    first_row: u32,
    plain: &mut [u8],
) -> Result<(), BadBlock> {
    let shape = &source.shape;
    let row_bytes = shape.row_values() * shape.pixel.bytes();
    let mut filled = 0;
    for index in blocks {
        // It may have read the bytes of these rows before it was asked for them.
        if !plain.is_empty() && filled == plain.len() {
            break;
        }
        let bytes = source.checked(index)?;
        let start = source.table[index as usize].offset as usize;
        let (taken, given) = feed(decoder, &bytes[(*read).saturating_sub(start).min(bytes.len())..], &mut plain[filled..]);
        *read = (*read).max(start) + taken;
        filled += given;
        // Everything up to the block's last row, as far as it is wanted.
        let rows = block_rows(shape, index).end.saturating_sub(first_row) as usize;
        if filled < plain.len().min(rows * row_bytes) {
            return Err(source.bad(index, "not an LZW stream of the right length"));
        }
    }
    Ok(())
}

fn append(plain: &[u8], pixel: PixelFormat, texels: &mut Texels) {
    texels.make_room(plain.len() / pixel.bytes());
    match texels {
        Texels::F32(v) => v.extend(plain.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b))),
        Texels::F16(v) => v.extend(plain.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b))),
    }
}

/// Appends exactly the wanted rows; the first of them.
pub(super) fn unpack(source: &Source<'_, '_>, rows: &Range<u32>, texels: &mut Texels) -> Result<u32, BadBlock> {
    let row_bytes = source.shape.row_values() * source.shape.pixel.bytes();
    UNPACKER.with_borrow_mut(|(decoder, plain)| {
        let decoder = decoder.get_or_insert_with(new_decoder);
        decoder.reset();
        plain.resize(rows.end as usize * row_bytes, 0);
        read_on(decoder, &mut 0, source, source.codec.blocks_for(rows), 0, plain)?;
        append(&plain[rows.start as usize * row_bytes..], source.shape.pixel, texels);
        Ok(rows.start)
    })
}
