//! A sequential decoder that stopped behind some rows, to go on from there.

use std::fmt;
use std::ops::Range;

use super::{BadBlock, Block, Codec, Source, Texels, lzw_seq, page_of, zstd_seq};
use crate::textures::page::{Page, PageShape};

/// A decoder behind a page's first rows.
pub(in crate::textures) struct Stopped {
    rows: u32,
    decoder: Decoder,
}

enum Decoder {
    Lzw(lzw_seq::Running),
    Zstd(zstd_seq::Running),
}

impl Stopped {
    /// At the start of a page; None for codecs that have no use for one.
    pub fn at_start(codec: Codec) -> Option<Self> {
        let decoder = match codec {
            Codec::LzwSeq => Decoder::Lzw(lzw_seq::Running::new()),
            Codec::ZstdSeq => Decoder::Zstd(zstd_seq::Running::new()),
            Codec::ZstdChunk | Codec::BitsChunk => return None,
        };
        Some(Self { rows: 0, decoder })
    }

    /// How many rows it has given.
    pub fn rows(&self) -> u32 {
        self.rows
    }

    /// Blocks whose bytes it needs to give the rows up to `end`; at least one.
    pub fn blocks_up_to(&self, table: &[Block], end: u32) -> Range<u32> {
        let behind = end.div_ceil(super::BLOCK_ROWS);
        let first = match &self.decoder {
            // The block in which it stopped reading, which may be ahead of the rows it has given.
            Decoder::Lzw(running) => {
                table.iter().position(|b| (b.offset + b.length) as usize > running.read()).unwrap_or(table.len()) as u32
            }
            Decoder::Zstd(_) => self.rows / super::BLOCK_ROWS,
        };
        first.min(behind - 1)..behind
    }

    /// Bytes that a decoder holds wherever in a page of this shape it stops, at most.
    pub fn resident_bytes(codec: Codec, shape: &PageShape) -> usize {
        match codec {
            Codec::LzwSeq => lzw_seq::Running::BYTES,
            Codec::ZstdSeq => zstd_seq::Running::bytes(shape),
            Codec::ZstdChunk | Codec::BitsChunk => 0,
        }
    }
}

impl fmt::Debug for Stopped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stopped").field("rows", &self.rows).finish_non_exhaustive()
    }
}

/// The rows from where `stopped` is to `end` (a multiple of the codec's step, or the page's height), as a page of that height. After an error the
/// decoder is of no use.
pub(in crate::textures) fn decode_on(source: &Source<'_, '_>, stopped: &mut Stopped, end: u32) -> Result<Page, BadBlock> {
    let mut texels = Texels::none(source.shape.pixel);
    let blocks = stopped.blocks_up_to(source.table, end);
    match &mut stopped.decoder {
        Decoder::Lzw(running) => running.go_on(source, blocks, stopped.rows..end, &mut texels)?,
        Decoder::Zstd(running) => running.go_on(source, blocks, &mut texels)?,
    }
    stopped.rows = end;
    Ok(page_of(&source.shape, texels))
}
