//! Texels ↔ stored bytes. One file a codec; all cut a page into pieces of 16 rows, each under its own xxh3.
//!
//! `bits-chunk`, the default, and `zstd-chunk`: every piece is packed on its own, so any rows can be read alone; the first is unpacked
//! faster, the second smaller. `zstd-seq`: one zstd frame a page, flushed after each piece, so that it can be decoded up to any row but only from the start. `lzw-seq`: TIFF's LZW over the plain numbers, the codec
//! of the paper whose read strategies the cache has (offset surface light fields), sequential too and exact to the row.
//!
//! Before all but LZW the numbers pass through [`planes`], a reversible transform. Lossless for f32; f16 loses only what rounding loses.

mod bits_chunk;
mod lzw_seq;
mod stopped;
mod zstd_chunk;
mod zstd_seq;

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use half::f16;
use half::slice::HalfFloatSliceExt;
use xxhash_rust::xxh3::xxh3_64;

pub(super) use stopped::{Stopped, decode_on};

use super::error::StoreError;
use super::page::{Page, PageShape, PixelFormat, Texels};
use super::planes::{self, Relation};

/// Rows in a block; the last block of a page may have fewer.
pub const BLOCK_ROWS: u32 = 16;
/// Largest finite f16. Larger finite numbers are clamped to it (and counted); infinities stay.
pub const MAX_F16: f32 = 65504.0;
/// zstd's fastest regular level: higher ones gain 1–4 % here and cost four times the time.
const ZSTD_LEVEL: i32 = 1;

/// How a page's texels are packed. The numbers are those on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Codec {
    /// Independent blocks of 16 rows, zstd over byte planes: the smallest.
    ZstdChunk = 1,
    /// One zstd frame over byte planes of 16 rows.
    ZstdSeq = 2,
    /// LZW as in TIFF, over the numbers as they are.
    LzwSeq = 3,
    /// Independent blocks of 16 rows, bits of differences: the default.
    BitsChunk = 4,
}

impl Codec {
    /// Every one.
    pub const ALL: [Self; 4] = [Self::ZstdChunk, Self::ZstdSeq, Self::LzwSeq, Self::BitsChunk];
    /// What new datasets are stored as: the fastest to unpack.
    pub const DEFAULT: Self = Self::BitsChunk;

    /// As written in configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::ZstdChunk => "zstd-chunk",
            Self::ZstdSeq => "zstd-seq",
            Self::LzwSeq => "lzw-seq",
            Self::BitsChunk => "bits-chunk",
        }
    }

    /// From the number on disk.
    pub(super) fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|codec| *codec as u8 == number)
    }

    /// Whether rows can be had only by unpacking all rows before them.
    pub fn is_sequential(self) -> bool {
        matches!(self, Self::ZstdSeq | Self::LzwSeq)
    }

    /// Whether a decoder that stopped behind the first `rows` rows of a page takes no more memory than the rows that are missing, for which the cache
    /// has room.
    pub(super) fn decoder_fits(self, shape: &PageShape, rows: u32) -> bool {
        let missing = (shape.height - rows.min(shape.height)) as usize * shape.row_values() * shape.pixel.bytes();
        self.is_sequential() && Stopped::resident_bytes(self, shape) <= missing
    }

    /// Rows that are unpacked together: asking for one row of them gives them all.
    pub fn step_rows(self) -> u32 {
        match self {
            Self::ZstdChunk | Self::ZstdSeq | Self::BitsChunk => BLOCK_ROWS,
            Self::LzwSeq => 1,
        }
    }

    /// The blocks whose bytes are needed for `rows`, which are not empty.
    pub(super) fn blocks_for(self, rows: &Range<u32>) -> Range<u32> {
        let start = if self.is_sequential() { 0 } else { rows.start / BLOCK_ROWS };
        start..rows.end.div_ceil(BLOCK_ROWS)
    }

    /// How many rows are unpacked to have `rows`.
    pub fn unpacked_rows(self, shape: &PageShape, rows: &Range<u32>) -> u32 {
        let end = rows.end.next_multiple_of(self.step_rows()).min(shape.height);
        if self.is_sequential() { end } else { end - rows.start / BLOCK_ROWS * BLOCK_ROWS }
    }
}

impl fmt::Display for Codec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// No codec has this name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no codec {0:?}: expected bits-chunk, zstd-chunk, zstd-seq or lzw-seq")]
pub struct UnknownCodec(pub String);

impl FromStr for Codec {
    type Err = UnknownCodec;

    fn from_str(name: &str) -> Result<Self, UnknownCodec> {
        Self::ALL.into_iter().find(|codec| codec.name() == name).ok_or_else(|| UnknownCodec(name.into()))
    }
}

/// How the blocks of a record are laid out. The numbers are the record's version on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layout {
    /// Every codec's first; `zstd-chunk` has a block's planes in one frame.
    Together = 1,
    /// `zstd-chunk` with each plane on its own.
    Apart = 2,
}

impl Layout {
    /// What is written.
    pub fn of(codec: Codec) -> Self {
        if codec == Codec::ZstdChunk { Self::Apart } else { Self::Together }
    }

    /// From the version on disk.
    pub fn from_number(number: u16, codec: Codec) -> Option<Self> {
        [Self::Together, Self::of(codec)].into_iter().find(|layout| *layout as u16 == number)
    }
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

impl EncodedPage {
    /// Compressed bytes, headers aside.
    pub fn payload_bytes(&self) -> usize {
        self.payload.len()
    }
}

/// Blocks of a page.
pub(super) fn block_count(shape: &PageShape) -> u32 {
    shape.height.div_ceil(BLOCK_ROWS)
}

/// Rows of block `index`.
pub(super) fn block_rows(shape: &PageShape, index: u32) -> Range<u32> {
    index * BLOCK_ROWS..((index + 1) * BLOCK_ROWS).min(shape.height)
}

/// [`encode_as`] with [`Codec::DEFAULT`].
pub fn encode(shape: &PageShape, texels: &[f32]) -> Result<EncodedPage, StoreError> {
    encode_as(Codec::DEFAULT, shape, texels)
}

/// Packs `texels` (height · width · channels numbers, interleaved, row 0 first) as `shape.pixel`.
/// Same input, same bytes. Fails on a shape that cannot be stored or a wrong count.
pub fn encode_as(codec: Codec, shape: &PageShape, texels: &[f32]) -> Result<EncodedPage, StoreError> {
    let shape = shape.checked()?;
    if texels.len() != shape.values() {
        return Err(StoreError::InvalidPage { reason: format!("{} numbers where the shape has {}", texels.len(), shape.values()) });
    }
    let (stored, clamped) = match shape.pixel {
        PixelFormat::F32 => (Texels::F32(texels.to_vec()), 0),
        PixelFormat::F16 => {
            let (halves, clamped) = to_f16(texels);
            (Texels::F16(halves), clamped)
        }
    };
    let mut page = EncodedPage { shape, codec, blocks: Vec::new(), payload: Vec::with_capacity(shape.decoded_bytes()), clamped };
    match codec {
        Codec::ZstdChunk => zstd_chunk::pack(&stored, &mut page),
        Codec::ZstdSeq => zstd_seq::pack(&stored, &mut page),
        Codec::LzwSeq => lzw_seq::pack(&stored, &mut page),
        Codec::BitsChunk => bits_chunk::pack(&stored, &mut page),
    }
    Ok(page)
}

impl EncodedPage {
    /// The payload from the last block's end on becomes a block.
    fn close_block(&mut self) {
        self.close_block_at(self.payload.len());
    }

    fn close_block_at(&mut self, end: usize) {
        let start = self.blocks.last().map_or(0, |b| (b.offset + b.length) as usize);
        let checksum = xxh3_64(&self.payload[start..end]);
        self.blocks.push(Block { offset: start as u32, length: (end - start) as u32, checksum });
    }
}

/// A block that does not decode: the rows that cannot be had without it and why.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BadBlock {
    pub rows: Range<u32>,
    pub reason: &'static str,
}

const CUT: &str = "the segment ends before them";
const CHANGED: &str = "checksum mismatch";

/// What decoding is given: a page's header, and its compressed blocks where they are at hand.
pub(super) struct Source<'s, 'a> {
    pub codec: Codec,
    pub layout: Layout,
    pub shape: PageShape,
    pub table: &'s [Block],
    /// Compressed bytes of a block of [`Codec::blocks_for`]; None where the file ends before.
    pub packed: &'s dyn Fn(u32) -> Option<&'a [u8]>,
}

impl<'a> Source<'_, 'a> {
    /// A block's bytes, once they are known to be what was written.
    fn checked(&self, index: u32) -> Result<&'a [u8], BadBlock> {
        let bytes = (self.packed)(index).ok_or_else(|| self.bad(index, CUT))?;
        if xxh3_64(bytes) == self.table[index as usize].checksum { Ok(bytes) } else { Err(self.bad(index, CHANGED)) }
    }

    /// A sequential codec loses what follows too.
    fn bad(&self, index: u32, reason: &'static str) -> BadBlock {
        let rows = block_rows(&self.shape, index);
        BadBlock { rows: if self.codec.is_sequential() { rows.start..self.shape.height } else { rows }, reason }
    }
}

/// Some rows of a page, not empty and within it, as a page of that height.
pub(super) fn decode(source: &Source<'_, '_>, rows: Range<u32>) -> Result<Page, BadBlock> {
    let mut texels = Texels::none(source.shape.pixel);
    let first = match source.codec {
        Codec::ZstdChunk => zstd_chunk::unpack(source, &rows, &mut texels)?,
        Codec::ZstdSeq => zstd_seq::unpack(source, &rows, &mut texels)?,
        Codec::LzwSeq => lzw_seq::unpack(source, &rows, &mut texels)?,
        Codec::BitsChunk => bits_chunk::unpack(source, &rows, &mut texels)?,
    };
    Ok(page_of(&source.shape, texels).rows(rows.start - first..rows.end - first))
}

/// As many rows of a page as there are.
fn page_of(shape: &PageShape, texels: Texels) -> Page {
    Page::new(PageShape { height: (texels.count() / shape.row_values()) as u32, ..*shape }, texels)
}

/// Appends the byte planes of some rows.
fn split_rows(shape: &PageShape, texels: &Texels, rows: Range<u32>, relation: Relation, planes: &mut Vec<u8>) {
    let (channels, row_values) = (shape.channels as usize, shape.row_values());
    let values = rows.start as usize * row_values..rows.end as usize * row_values;
    match texels {
        Texels::F32(v) => planes::split::<u32>(bytemuck::cast_slice(&v[values]), channels, row_values, relation, planes),
        Texels::F16(v) => planes::split::<u16>(bytemuck::cast_slice(&v[values]), channels, row_values, relation, planes),
    }
}

/// Under which relation some rows' planes will be smaller.
fn best_relation(shape: &PageShape, texels: &Texels, rows: Range<u32>) -> Relation {
    let (channels, row_values) = (shape.channels as usize, shape.row_values());
    let values = rows.start as usize * row_values..rows.end as usize * row_values;
    match texels {
        Texels::F32(v) => planes::best_relation::<u32>(bytemuck::cast_slice(&v[values]), channels, row_values),
        Texels::F16(v) => planes::best_relation::<u16>(bytemuck::cast_slice(&v[values]), channels, row_values),
    }
}

/// Appends the rows whose byte planes these are.
fn join_planes(shape: &PageShape, planes: &[&[u8]], relation: Relation, texels: &mut Texels) {
    let (channels, row_values) = (shape.channels as usize, shape.row_values());
    let values = planes[0].len();
    match texels {
        Texels::F32(v) => {
            let start = v.len();
            v.resize(start + values, 0.0);
            planes::join::<u32>(planes, channels, row_values, relation, bytemuck::cast_slice_mut(&mut v[start..]));
        }
        Texels::F16(v) => {
            let start = v.len();
            v.resize(start + values, f16::ZERO);
            planes::join::<u16>(planes, channels, row_values, relation, bytemuck::cast_slice_mut(&mut v[start..]));
        }
    }
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
