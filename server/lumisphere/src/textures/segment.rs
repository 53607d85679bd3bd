//! Segments: append-only files of page records, sealed by fsync and then named by their BLAKE3.
//!
//! A record, little-endian, padded to 8 bytes:
//! ```text
//!  0 magic "LSPG"   4 layout u16    6 codec u8    7 pixel u8
//!  8 page u32      12 width u32    16 height u32  20 channels u32
//! 24 blocks u32    28 payload bytes u32           32 xxh3 u64 of bytes 0…32 and of the block table
//! 40 block table: {offset u32, length u32, xxh3 u64} each, then the payload
//! ```
//! Everything the index knows can be read back from these headers.

use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use xxhash_rust::xxh3::{Xxh3, xxh3_64};

use super::codec::{self, Block, Codec, EncodedPage, Layout, Source, Stopped};
use super::disk::Disk;
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::page::{Page, PageId, PageShape, PixelFormat};

/// A segment is closed before it would grow beyond this.
pub const MAX_SEGMENT_BYTES: u64 = 256 << 20;
const MAGIC: [u8; 4] = *b"LSPG";
/// Bytes of a header before its block table.
const FIXED_BYTES: usize = 40;
const ENTRY_BYTES: usize = 16;
/// Records start at multiples of this, which bounds the search for the next one behind a damaged header.
const ALIGNMENT: u64 = 8;

/// Where a page's record lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Location {
    /// Index into the manifest's list of segments.
    pub segment: u32,
    pub offset: u64,
    /// Of the record, padding included.
    pub length: u32,
    /// The header's xxh3.
    pub checksum: u64,
}

/// A record's header, checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub page: PageId,
    pub shape: PageShape,
    pub codec: Codec,
    pub layout: Layout,
    pub blocks: Vec<Block>,
    payload_bytes: u32,
    pub checksum: u64,
}

impl Header {
    /// On disk, block table included.
    pub fn bytes(&self) -> usize {
        FIXED_BYTES + self.blocks.len() * ENTRY_BYTES
    }

    fn record_bytes(&self) -> u64 {
        (self.bytes() as u64 + u64::from(self.payload_bytes)).next_multiple_of(ALIGNMENT)
    }

    /// Where a block's packed bytes lie within the record.
    fn block_range(&self, block: &Block) -> Range<usize> {
        let start = self.bytes() + block.offset as usize;
        start..start + block.length as usize
    }

    /// Reads a header from the start of `bytes`. The checksum guards every field, so a lying length is never followed.
    fn parse(bytes: &[u8]) -> Result<Self, &'static str> {
        let fixed = bytes.get(..FIXED_BYTES).ok_or("the segment ends within a header")?;
        let u32_at = |at: usize| u32::from_le_bytes(fixed[at..at + 4].try_into().expect("four bytes"));
        if fixed[..4] != MAGIC {
            return Err("no record header");
        }
        let table_bytes = (u32_at(24) as usize).saturating_mul(ENTRY_BYTES);
        let table =
            FIXED_BYTES.checked_add(table_bytes).and_then(|end| bytes.get(FIXED_BYTES..end)).ok_or("the segment ends within a header")?;
        let checksum = u64::from_le_bytes(fixed[32..40].try_into().expect("eight bytes"));
        if header_checksum(&fixed[..32], table) != checksum {
            return Err("header checksum mismatch");
        }
        let codec = Codec::from_number(fixed[6]).ok_or("a codec that this program does not know")?;
        let layout = Layout::from_number(u16::from_le_bytes([fixed[4], fixed[5]]), codec);
        let layout = layout.ok_or("a record version that this program does not know")?;
        let pixel = match fixed[7] {
            1 => PixelFormat::F32,
            2 => PixelFormat::F16,
            _ => return Err("a pixel format that this program does not know"),
        };
        let shape = PageShape { width: u32_at(12), height: u32_at(16), channels: u32_at(20), pixel };
        let header = Self {
            page: PageId(u32_at(8)),
            shape,
            codec,
            layout,
            blocks: table.chunks_exact(ENTRY_BYTES).map(block_entry).collect(),
            payload_bytes: u32_at(28),
            checksum,
        };
        // Blocks follow one another without gaps and fill the payload.
        let end = header.blocks.iter().try_fold(0u32, |end, b| (b.offset == end).then(|| end.checked_add(b.length))?);
        let counted = shape.checked().is_ok_and(|s| codec::block_count(&s) as usize == header.blocks.len());
        let consistent = counted && end == Some(header.payload_bytes);
        if consistent { Ok(header) } else { Err("a header that contradicts itself") }
    }
}

fn block_entry(bytes: &[u8]) -> Block {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    Block { offset: word(0), length: word(4), checksum: u64::from_le_bytes(bytes[8..16].try_into().expect("eight bytes")) }
}

fn header_checksum(fixed: &[u8], table: &[u8]) -> u64 {
    let mut hasher = Xxh3::new();
    hasher.update(fixed);
    hasher.update(table);
    hasher.digest()
}

/// Makes `record` a whole one; its header's checksum.
fn fill_record(page: PageId, encoded: &EncodedPage, record: &mut Vec<u8>) -> u64 {
    let shape = encoded.shape;
    record.clear();
    record.reserve(encoded.stored_bytes() as usize);
    record.extend_from_slice(&MAGIC);
    record.extend_from_slice(&(Layout::of(encoded.codec) as u16).to_le_bytes());
    record.extend_from_slice(&[encoded.codec as u8, shape.pixel as u8]);
    for word in [page.0, shape.width, shape.height, shape.channels, encoded.blocks.len() as u32, encoded.payload.len() as u32] {
        record.extend_from_slice(&word.to_le_bytes());
    }
    record.extend_from_slice(&[0; 8]);
    for block in &encoded.blocks {
        record.extend_from_slice(&block.offset.to_le_bytes());
        record.extend_from_slice(&block.length.to_le_bytes());
        record.extend_from_slice(&block.checksum.to_le_bytes());
    }
    let checksum = header_checksum(&record[..32], &record[FIXED_BYTES..]);
    record[32..40].copy_from_slice(&checksum.to_le_bytes());
    record.extend_from_slice(&encoded.payload);
    record.resize(record.len().next_multiple_of(ALIGNMENT as usize), 0);
    checksum
}

impl EncodedPage {
    /// Bytes that the page takes in a version, header included.
    pub fn stored_bytes(&self) -> u64 {
        ((FIXED_BYTES + self.blocks.len() * ENTRY_BYTES + self.payload.len()) as u64).next_multiple_of(ALIGNMENT)
    }
}

/// Appends records to a file that is not sealed yet.
#[derive(Debug)]
pub(super) struct SegmentWriter {
    disk: Arc<dyn Disk>,
    path: PathBuf,
    file: File,
    /// Bytes of whole records; the file may be longer after a failed write, until the next one.
    length: u64,
    hasher: blake3::Hasher,
    torn: bool,
    /// The record being written: kept, since new memory for each would take longer than filling it.
    record: Vec<u8>,
}

/// A record found by reading a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found {
    pub page: PageId,
    pub shape: PageShape,
    pub location: Location,
}

impl SegmentWriter {
    /// Opens `path`, new or left by a killed writer. Keeps the whole records at its start, cuts off what follows, and tells which
    /// pages it has. `segment` is the number that their locations carry.
    pub fn recover(disk: Arc<dyn Disk>, path: &Path, segment: u32) -> Result<(Self, Vec<Found>), StoreError> {
        let file = disk.open_writable(path).at("open", path)?;
        let file_bytes = file.metadata().at("inspect", path)?.len();
        let hasher = blake3::Hasher::new();
        let mut writer = Self { disk, path: path.into(), file, length: 0, hasher, torn: false, record: Vec::new() };
        let mut found = Vec::new();
        while let Some(record) = writer.next_whole_record(file_bytes)? {
            let header = Header::parse(&record).expect("checked when the record was read");
            let location = Location { segment, offset: writer.length, length: record.len() as u32, checksum: header.checksum };
            found.push(Found { page: header.page, shape: header.shape, location });
            writer.hasher.update(&record);
            writer.length += record.len() as u64;
        }
        if writer.length < file_bytes {
            writer.torn = true;
            writer.cut_torn_tail()?;
        }
        Ok((writer, found))
    }

    /// The record at the writer's end, if header, every block and the padding are intact.
    fn next_whole_record(&self, file_bytes: u64) -> Result<Option<Vec<u8>>, StoreError> {
        let Ok(header) = read_header(self.disk.as_ref(), &self.file, self.length, file_bytes, &self.path)? else { return Ok(None) };
        if self.length + header.record_bytes() > file_bytes {
            return Ok(None);
        }
        let mut record = vec![0; header.record_bytes() as usize];
        self.disk.read_at(&self.file, &mut record, self.length).at("read", &self.path)?;
        let intact = header.blocks.iter().all(|b| xxh3_64(&record[header.block_range(b)]) == b.checksum);
        Ok(intact.then_some(record))
    }

    fn cut_torn_tail(&mut self) -> Result<(), StoreError> {
        if self.torn {
            self.disk.set_len(&self.file, self.length).at("truncate", &self.path)?;
            self.torn = false;
        }
        Ok(())
    }

    /// Bytes so far.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Appends one record; after an error the segment is as before the call, and the call can be repeated.
    pub fn append(&mut self, page: PageId, encoded: &EncodedPage, segment: u32) -> Result<Location, StoreError> {
        self.cut_torn_tail()?;
        let checksum = fill_record(page, encoded, &mut self.record);
        if let Err(error) = self.disk.write_at(&self.file, &self.record, self.length).at("write", &self.path) {
            self.torn = true;
            // Gives the space back at once where possible; otherwise the next append tries again.
            let _ = self.cut_torn_tail();
            return Err(error);
        }
        self.hasher.update(&self.record);
        let location = Location { segment, offset: self.length, length: self.record.len() as u32, checksum };
        self.length += self.record.len() as u64;
        Ok(location)
    }

    /// Makes what was appended so far survive a power cut.
    pub fn sync(&mut self) -> Result<(), StoreError> {
        self.cut_torn_tail()?;
        self.disk.sync(&self.file).at("sync", &self.path)
    }

    /// Content hash of the whole records so far: the name under which the segment is published.
    pub fn content_hash(&self) -> ContentHash {
        ContentHash(*self.hasher.finalize().as_bytes())
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// Header at `offset`, or why there is none; the outer error is the disk's.
fn read_header(
    disk: &dyn Disk,
    file: &File,
    offset: u64,
    file_bytes: u64,
    path: &Path,
) -> Result<Result<Header, &'static str>, StoreError> {
    let mut bytes = vec![0; (file_bytes.saturating_sub(offset)).min(FIXED_BYTES as u64) as usize];
    disk.read_at(file, &mut bytes, offset).at("read", path)?;
    if bytes.len() < FIXED_BYTES || bytes[..4] != MAGIC {
        return Ok(Err("no record header"));
    }
    let blocks = u64::from(u32::from_le_bytes(bytes[24..28].try_into().expect("four bytes")));
    let header_bytes = FIXED_BYTES as u64 + blocks * ENTRY_BYTES as u64;
    if header_bytes > file_bytes - offset {
        return Ok(Err("the segment ends within a header"));
    }
    bytes.resize(header_bytes as usize, 0);
    disk.read_at(file, &mut bytes[FIXED_BYTES..], offset + FIXED_BYTES as u64).at("read", path)?;
    Ok(Header::parse(&bytes))
}

/// Every record of a sealed segment whose header is intact. A damaged header costs its own page only: the search goes on behind it.
pub(super) fn scan_headers(disk: &dyn Disk, file: &File, segment: u32, path: &Path) -> Result<Vec<Found>, StoreError> {
    let file_bytes = file.metadata().at("inspect", path)?.len();
    let mut found = Vec::new();
    let mut offset = 0;
    while offset < file_bytes {
        match read_header(disk, file, offset, file_bytes, path)? {
            Ok(header) => {
                let length = header.record_bytes();
                let location = Location { segment, offset, length: length as u32, checksum: header.checksum };
                found.push(Found { page: header.page, shape: header.shape, location });
                offset += length;
            }
            Err(_) => offset += ALIGNMENT,
        }
    }
    Ok(found)
}

/// What is wrong with a record: the rows that cannot be read (None: the whole page) and why.
pub(super) struct BadRecord {
    pub rows: Option<Range<u32>>,
    pub reason: &'static str,
}

impl BadRecord {
    fn page(reason: &'static str) -> Self {
        Self { rows: None, reason }
    }
}

/// Decodes the whole page from the bytes of its record; `record` may be shorter than the record if the file ends before.
pub(super) fn decode_record(record: &[u8], page: PageId, checksum: u64) -> Result<(Page, Header), BadRecord> {
    let header = expected_header(record, page, checksum)?;
    Ok((decode_rows(&header, 0..header.shape.height, record, 0)?, header))
}

/// The header of the record that the index promised.
pub(super) fn expected_header(record: &[u8], page: PageId, checksum: u64) -> Result<Header, BadRecord> {
    let header = Header::parse(record).map_err(BadRecord::page)?;
    if header.page != page || header.checksum != checksum {
        return Err(BadRecord::page("the record is another page's"));
    }
    Ok(header)
}

/// Decodes some rows. `bytes` are the record's from `first_byte` on and hold [`Codec::blocks_for`] them, unless the file is cut.
pub(super) fn decode_rows(header: &Header, rows: Range<u32>, bytes: &[u8], first_byte: usize) -> Result<Page, BadRecord> {
    let packed = |index: u32| {
        let range = header.block_range(&header.blocks[index as usize]);
        bytes.get(range.start - first_byte..range.end - first_byte)
    };
    decode_packed(header, rows, &packed)
}

/// The same from blocks that lie anywhere.
pub(super) fn decode_packed<'a>(header: &Header, rows: Range<u32>, packed: &dyn Fn(u32) -> Option<&'a [u8]>) -> Result<Page, BadRecord> {
    let source = Source { codec: header.codec, layout: header.layout, shape: header.shape, table: &header.blocks, packed };
    codec::decode(&source, rows).map_err(|bad| BadRecord { rows: Some(bad.rows), reason: bad.reason })
}

/// The rows that follow those which a decoder has given, up to `end`.
pub(super) fn decode_packed_on<'a>(
    header: &Header,
    stopped: &mut Stopped,
    end: u32,
    packed: &dyn Fn(u32) -> Option<&'a [u8]>,
) -> Result<Page, BadRecord> {
    let source = Source { codec: header.codec, layout: header.layout, shape: header.shape, table: &header.blocks, packed };
    codec::decode_on(&source, stopped, end).map_err(|bad| BadRecord { rows: Some(bad.rows), reason: bad.reason })
}

/// Bytes of the header of a page with so many blocks.
pub(super) fn header_bytes(blocks: u32) -> usize {
    FIXED_BYTES + blocks as usize * ENTRY_BYTES
}

/// Where the packed bytes of `blocks` lie within the record.
pub(super) fn blocks_range(header: &Header, blocks: Range<u32>) -> Range<usize> {
    let first = &header.blocks[blocks.start as usize];
    let last = &header.blocks[blocks.end as usize - 1];
    header.block_range(first).start..header.block_range(last).end
}
