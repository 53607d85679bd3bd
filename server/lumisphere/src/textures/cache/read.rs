//! What a miss does: finds the compressed blocks in memory or on disk, unpacks what the strategy wants, and counts it.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use super::chunk::Chunk;
use super::compressed::CompressedTier;
use super::residency::Arriving;
use super::table::{PageSlots, Part};
use crate::textures::codec::{BLOCK_ROWS, Block, Stopped, block_rows};
use crate::textures::error::StoreError;
use crate::textures::page::Page;
use crate::textures::read_strategy::ReadStrategy;
use crate::textures::segment::Header;
use crate::textures::version::{DatasetVersion, ReadCost};

/// What was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Want {
    WholePage,
    Row(u32),
}

impl Want {
    pub fn is_met_by(self, chunk: &Chunk) -> bool {
        match self {
            Self::WholePage => chunk.is_whole(),
            Self::Row(row) => chunk.rows.contains(&row),
        }
    }
}

/// One miss: where, what, how.
#[derive(Debug, Clone, Copy)]
pub(super) struct Miss<'a> {
    pub version: &'a DatasetVersion,
    pub slots: &'a Arc<PageSlots>,
    pub part: Part,
    pub want: Want,
    pub strategy: ReadStrategy,
}

thread_local! {
    // Compressed blocks under decoding: reused, so that a miss allocates only what it returns.
    static PACKED: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

impl Miss<'_> {
    /// Reads and decodes; `resident` is what the slot has already.
    pub fn read(&self, compressed: &CompressedTier, resident: Option<&Chunk>) -> Result<(Arriving, ReadCost), StoreError> {
        if self.want == Want::WholePage && resident.is_none() && !compressed.is_on() {
            return self.read_whole_record();
        }
        let mut cost = ReadCost::default();
        let header = self.header(&mut cost)?;
        let rows = self.rows(&header)?;
        let resumed =
            resident.filter(|r| r.rows.start == 0 && rows.start == 0 && self.strategy.resumes(header.codec, &header.shape, r.rows.end));
        let kept = resumed.and_then(Chunk::take_decoder).filter(|decoder| Some(decoder.rows()) == resumed.map(|r| r.rows.end));
        // Without its decoder a sequential codec has to begin again.
        let resumed = resumed.filter(|_| kept.is_some() || !header.codec.is_sequential());
        let from = resumed.map_or(rows.start, |resident| resident.rows.end);
        let keeps = self.part == Part::Whole && self.strategy.resumes(header.codec, &header.shape, rows.end);
        let mut decoder = kept.or_else(|| keeps.then(|| Stopped::at_start(header.codec))?);
        let decoded = self.decode(&header, from..rows.end, decoder.as_mut(), compressed, &mut cost)?;
        let page = match resumed {
            Some(resident) => resident.page.with_rows_below(&decoded),
            None => decoded,
        };
        // Slots of equal size, as in the paper: part of a page takes the page's place, a block only its own.
        let bytes = if self.part == Part::Whole { header.shape.resident_bytes() } else { page.resident_bytes() };
        let decoder = Mutex::new(decoder.filter(|_| keeps));
        Ok((Arriving { page: Arc::new(page), rows, page_height: header.shape.height, bytes: bytes as u64, decoder }, cost))
    }

    /// The usual case of a cache of whole pages: one read for header and texels.
    fn read_whole_record(&self) -> Result<(Arriving, ReadCost), StoreError> {
        let (page, header, mut cost) = self.version.read_record(self.slots.page)?;
        let rows = 0..header.shape.height;
        self.count_redundant(&header, rows.clone(), &mut cost);
        let _ = self.slots.header.set(Arc::new(header));
        let (page_height, bytes) = (rows.end, page.resident_bytes() as u64);
        Ok((Arriving { page: Arc::new(page), rows, page_height, bytes, decoder: Mutex::default() }, cost))
    }

    fn header(&self, cost: &mut ReadCost) -> Result<Arc<Header>, StoreError> {
        if let Some(header) = self.slots.header.get() {
            return Ok(header.clone());
        }
        let started = Instant::now();
        let (header, bytes) = self.version.page_header(self.slots.page)?;
        cost.bytes_read += bytes;
        cost.read_nanos += started.elapsed().as_nanos() as u64;
        Ok(self.slots.header.get_or_init(|| Arc::new(header)).clone())
    }

    /// The rows to have in the end.
    fn rows(&self, header: &Header) -> Result<Range<u32>, StoreError> {
        let height = header.shape.height;
        let row = match (self.part, self.want) {
            (Part::Block(block), _) => block * BLOCK_ROWS,
            (Part::Whole, Want::WholePage) => return Ok(0..height),
            (Part::Whole, Want::Row(row)) => row,
        };
        let asked = if let Want::Row(row) = self.want { row } else { row };
        if asked >= height {
            return Err(StoreError::NotFound { what: format!("row {asked} of page {} with {height} rows", self.slots.page) });
        }
        Ok(match self.part {
            Part::Whole => self.strategy.rows_wanted(header.codec, &header.shape, row),
            Part::Block(block) => block_rows(&header.shape, block),
        })
    }

    // With a decoder: the rows that follow those which it has given.
    fn decode(
        &self,
        header: &Header,
        rows: Range<u32>,
        decoder: Option<&mut Stopped>,
        compressed: &CompressedTier,
        cost: &mut ReadCost,
    ) -> Result<Page, StoreError> {
        let blocks = decoder.as_ref().map_or_else(|| header.codec.blocks_for(&rows), |d| d.blocks_up_to(&header.blocks, rows.end));
        let unpacked = if decoder.is_some() { rows.len() as u32 } else { header.codec.unpacked_rows(&header.shape, &rows) };
        let first = blocks.start;
        let id = |block| (self.slots.version, self.slots.key(Part::Block(block)));
        let is_on = compressed.is_on();
        let held: Vec<Option<Arc<[u8]>>> = blocks.clone().map(|block| is_on.then(|| compressed.get(id(block)))?).collect();
        PACKED.with_borrow_mut(|packed| {
            let started = Instant::now();
            let places = self.read_missing(header, blocks.clone(), &held, packed)?;
            let read = Instant::now();
            cost.blocks_read += held.iter().filter(|block| block.is_none()).count() as u64;
            cost.bytes_read += places.last().map_or(0, |place| place.end as u64);
            cost.read_nanos += (read - started).as_nanos() as u64;
            let bytes_of = |block: u32| {
                let at = (block - first) as usize;
                held[at].as_deref().or_else(|| packed.get(places[at].clone()))
            };
            let page = match decoder {
                Some(decoder) => self.version.decode_rows_on(self.slots.page, header, decoder, rows.end, &bytes_of)?,
                None => self.version.decode_rows(self.slots.page, header, rows.clone(), &bytes_of)?,
            };
            cost.decode_nanos += read.elapsed().as_nanos() as u64;
            cost.rows_decoded += u64::from(unpacked);
            cost.bytes_decoded += u64::from(unpacked) * row_bytes(header);
            let end = rows.end.next_multiple_of(header.codec.step_rows()).min(header.shape.height);
            self.count_redundant(header, end - unpacked..end, cost);
            // Only what has proved to be intact is kept.
            if is_on {
                for (block, _) in blocks.zip(&held).filter(|(_, held)| held.is_none()) {
                    compressed.keep(id(block), packed[places[(block - first) as usize].clone()].into());
                }
            }
            Ok(page)
        })
    }

    /// Reads each run of blocks that are not at hand, in one go; where each block lies in `packed`, one behind the other.
    fn read_missing(
        &self,
        header: &Header,
        blocks: Range<u32>,
        held: &[Option<Arc<[u8]>>],
        packed: &mut Vec<u8>,
    ) -> Result<Vec<Range<usize>>, StoreError> {
        let mut end = 0;
        let place = |(block, held): (&Block, &Option<_>)| {
            let start = end;
            end += if held.is_none() { block.length as usize } else { 0 };
            start..end
        };
        let places: Vec<_> = header.blocks[blocks.start as usize..blocks.end as usize].iter().zip(held).map(place).collect();
        // Kept at its largest: what is not written over is not read.
        packed.resize(packed.len().max(end), 0);
        let mut at = 0;
        for run in held.chunk_by(|a, b| a.is_none() == b.is_none()) {
            let behind = at + run.len();
            if run[0].is_none() {
                let missing = blocks.start + at as u32..blocks.start + behind as u32;
                self.version.read_blocks(self.slots.page, header, missing, &mut packed[places[at].start..places[behind - 1].end])?;
            }
            at = behind;
        }
        Ok(places)
    }

    fn count_redundant(&self, header: &Header, unpacked: Range<u32>, cost: &mut ReadCost) {
        let redundant = u64::from(self.slots.count_decoded(unpacked));
        cost.rows_redundant += redundant;
        cost.bytes_redundant += redundant * row_bytes(header);
    }
}

fn row_bytes(header: &Header) -> u64 {
    (header.shape.row_values() * header.shape.pixel.bytes()) as u64
}
