//! A published dataset version, opened for reading.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

use super::codec::{BLOCK_ROWS, Stopped, block_rows};
use super::disk::Disk;
use super::error::{At, StoreError};
use super::hash::ContentHash;
use super::manifest::Manifest;
use super::page::{Page, PageId};
use super::segment::{self, BadRecord, Header, Location};
use super::store::Folders;

/// What the store knows of a version whether it is open or not.
#[derive(Debug)]
pub(super) struct VersionRecord {
    pub manifest: Manifest,
    /// Place of each page; None for one whose header is damaged.
    pub pages: Vec<Option<Location>>,
    /// Dense number of this version within this process, for tables indexed by it. Never reused.
    pub slot: u32,
}

static NEXT_SLOT: AtomicU32 = AtomicU32::new(0);

impl VersionRecord {
    pub fn new(manifest: Manifest, pages: Vec<Option<Location>>) -> Self {
        Self { manifest, pages, slot: NEXT_SLOT.fetch_add(1, Ordering::Relaxed) }
    }
}

/// An immutable dataset version. While it is held its files stay readable, even if the dataset is deleted.
#[derive(Debug)]
pub struct DatasetVersion {
    record: Arc<VersionRecord>,
    disk: Arc<dyn Disk>,
    folders: Arc<Folders>,
    /// One for each of the manifest's segments; None if the file is gone.
    segments: Vec<(PathBuf, Option<File>)>,
    blobs: BTreeMap<String, Option<File>>,
}

/// What one read of a page cost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReadCost {
    /// Compressed blocks from disk.
    pub blocks_read: u64,
    /// From disk, headers included.
    pub bytes_read: u64,
    /// Rows unpacked, those included that were not asked for.
    pub rows_decoded: u64,
    /// Rows unpacked that the cache had had before; 0 without a cache.
    pub rows_redundant: u64,
    /// Of those rows.
    pub bytes_redundant: u64,
    /// Of decoded texels.
    pub bytes_decoded: u64,
    /// Waiting for the disk.
    pub read_nanos: u64,
    /// Checking and unpacking.
    pub decode_nanos: u64,
}

thread_local! {
    // The packed record under decoding: reused, so that a miss allocates only the page that it returns.
    static RECORD: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

impl DatasetVersion {
    /// Opens the files, which keeps them alive.
    pub(super) fn open(record: Arc<VersionRecord>, disk: Arc<dyn Disk>, folders: Arc<Folders>) -> Self {
        let segments = record.manifest.segments.iter().map(|s| folders.segment(&s.blake3));
        let segments = segments.map(|path| (path.clone(), File::open(path).ok())).collect();
        let blobs = record.manifest.blobs.iter();
        let blobs = blobs.map(|(name, blob)| (name.clone(), File::open(folders.blob(&blob.blake3)).ok())).collect();
        Self { record, disk, folders, segments, blobs }
    }

    /// All that was said at publication.
    pub fn manifest(&self) -> &Manifest {
        &self.record.manifest
    }

    /// Pages 0…count−1 exist.
    pub fn page_count(&self) -> u32 {
        self.manifest().pages.count
    }

    /// Dense number of this version within this process, the same for every opening of it.
    pub fn slot(&self) -> u32 {
        self.record.slot
    }

    /// Content of a named blob, checked against its hash.
    pub fn blob(&self, name: &str) -> Result<Vec<u8>, StoreError> {
        let manifest = self.manifest();
        let not_found = || StoreError::NotFound { what: format!("blob {name} of {} version {}", manifest.dataset, manifest.version) };
        let entry = manifest.blobs.get(name).ok_or_else(not_found)?;
        let path = self.folders.blob(&entry.blake3);
        let damaged = |reason: &str| StoreError::DamagedFile { reason: reason.into(), path: path.clone() };
        let file = self.blobs.get(name).and_then(Option::as_ref).ok_or_else(|| damaged("the file is missing"))?;
        if file.metadata().at("inspect", &path)?.len() != entry.bytes {
            return Err(damaged("wrong length"));
        }
        let mut bytes = vec![0; entry.bytes as usize];
        self.disk.read_at(file, &mut bytes, 0).at("read", &path)?;
        if ContentHash::of(&bytes) == entry.blake3 { Ok(bytes) } else { Err(damaged("content does not have the hash in its name")) }
    }

    /// A whole page, every block checked.
    pub fn read_page(&self, page: PageId) -> Result<Page, StoreError> {
        self.read_page_with_cost(page).map(|(page, _)| page)
    }

    /// A whole page, and what reading it cost.
    pub fn read_page_with_cost(&self, page: PageId) -> Result<(Page, ReadCost), StoreError> {
        self.read_record(page).map(|(decoded, _, cost)| (decoded, cost))
    }

    /// A whole page and its header, in one read.
    pub(super) fn read_record(&self, page: PageId) -> Result<(Page, Header, ReadCost), StoreError> {
        let (location, file, path) = self.locate(page)?;
        RECORD.with_borrow_mut(|record| {
            let started = Instant::now();
            record.resize(location.length as usize, 0);
            self.read(file, record, location.offset, page, path)?;
            let read = Instant::now();
            let (decoded, header) =
                segment::decode_record(record, page, location.checksum).map_err(|bad| self.damaged(page, bad, path.into()))?;
            let cost = ReadCost {
                blocks_read: header.blocks.len() as u64,
                bytes_read: record.len() as u64,
                rows_decoded: u64::from(decoded.shape().height),
                bytes_decoded: decoded.shape().decoded_bytes() as u64,
                read_nanos: (read - started).as_nanos() as u64,
                decode_nanos: read.elapsed().as_nanos() as u64,
                ..ReadCost::default()
            };
            Ok((decoded, header, cost))
        })
    }

    /// A page's header, and how many bytes of the disk it took.
    pub(super) fn page_header(&self, page: PageId) -> Result<(Header, u64), StoreError> {
        let (location, file, path) = self.locate(page)?;
        let header = self.read_header(file, &location, page, path)?;
        let bytes = header.bytes() as u64;
        Ok((header, bytes))
    }

    /// The compressed bytes of some blocks, unchecked; `out` is as long. Where the file ends before, the rows of all of them are named.
    pub(super) fn read_blocks(&self, page: PageId, header: &Header, blocks: Range<u32>, out: &mut [u8]) -> Result<(), StoreError> {
        let (location, file, path) = self.locate(page)?;
        let range = segment::blocks_range(header, blocks.clone());
        match self.disk.read_at(file, out, location.offset + range.start as u64) {
            Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                let rows = block_rows(&header.shape, blocks.start).start..block_rows(&header.shape, blocks.end - 1).end;
                Err(self.damaged(page, BadRecord { rows: Some(rows), reason: "the segment ends before them" }, path.into()))
            }
            result => result.at("read", path),
        }
    }

    /// Checks and decodes some rows from blocks that are at hand.
    pub(super) fn decode_rows<'a>(
        &self,
        page: PageId,
        header: &Header,
        rows: Range<u32>,
        packed: &dyn Fn(u32) -> Option<&'a [u8]>,
    ) -> Result<Page, StoreError> {
        segment::decode_packed(header, rows, packed).map_err(|bad| match self.locate(page) {
            Ok((_, _, path)) => self.damaged(page, bad, path.into()),
            Err(error) => error,
        })
    }

    /// Checks and decodes the rows that follow those which a decoder has given, up to `end`, from blocks that are at hand.
    pub(super) fn decode_rows_on<'a>(
        &self,
        page: PageId,
        header: &Header,
        stopped: &mut Stopped,
        end: u32,
        packed: &dyn Fn(u32) -> Option<&'a [u8]>,
    ) -> Result<Page, StoreError> {
        segment::decode_packed_on(header, stopped, end, packed).map_err(|bad| match self.locate(page) {
            Ok((_, _, path)) => self.damaged(page, bad, path.into()),
            Err(error) => error,
        })
    }

    /// Some rows of a page, as a page of that height; reads and checks only the blocks they lie in.
    pub fn read_rows(&self, page: PageId, rows: Range<u32>) -> Result<Page, StoreError> {
        let (location, file, path) = self.locate(page)?;
        let header = self.read_header(file, &location, page, path)?;
        if rows.is_empty() || rows.end > header.shape.height {
            return Err(StoreError::NotFound {
                what: format!("rows {}..{} of page {page} with {} rows", rows.start, rows.end, header.shape.height),
            });
        }
        let range = segment::blocks_range(&header, header.codec.blocks_for(&rows));
        let mut bytes = vec![0; range.len()];
        self.read(file, &mut bytes, location.offset + range.start as u64, page, path)?;
        segment::decode_rows(&header, rows, &bytes, range.start).map_err(|bad| self.damaged(page, bad, path.into()))
    }

    /// One read, long enough for the tallest page's block table.
    fn read_header(&self, file: &File, location: &Location, page: PageId, path: &Path) -> Result<Header, StoreError> {
        let tallest = self.manifest().pages.shapes.iter().map(|s| s.height).max().unwrap_or(0);
        let most = segment::header_bytes(tallest.div_ceil(BLOCK_ROWS)).min(location.length as usize);
        let mut bytes = vec![0; most];
        self.read(file, &mut bytes, location.offset, page, path)?;
        segment::expected_header(&bytes, page, location.checksum).map_err(|bad| self.damaged(page, bad, path.into()))
    }

    /// Where a page's record lies.
    fn locate(&self, page: PageId) -> Result<(Location, &File, &Path), StoreError> {
        let manifest = self.manifest();
        let Some(place) = self.record.pages.get(page.0 as usize) else {
            return Err(StoreError::NotFound { what: format!("page {page} of {} version {}", manifest.dataset, manifest.version) });
        };
        let damaged = |reason, path| self.damaged(page, BadRecord { rows: None, reason }, path);
        let location = place.ok_or_else(|| damaged("no intact header of it was found in any segment", self.folders.segments.clone()))?;
        let (path, file) = &self.segments[location.segment as usize];
        let file = file.as_ref().ok_or_else(|| damaged("the segment is missing", path.clone()))?;
        Ok((location, file, path))
    }

    fn read(&self, file: &File, bytes: &mut [u8], offset: u64, page: PageId, path: &Path) -> Result<(), StoreError> {
        match self.disk.read_at(file, bytes, offset) {
            Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                Err(self.damaged(page, BadRecord { rows: None, reason: "the segment ends before them" }, path.into()))
            }
            result => result.at("read", path),
        }
    }

    fn damaged(&self, page: PageId, bad: BadRecord, path: PathBuf) -> StoreError {
        // Of a page whose header cannot be read only this is known: all of its rows, at most the tallest shape's.
        let tallest = self.manifest().pages.shapes.iter().map(|s| s.height).max().unwrap_or(0);
        StoreError::DamagedPage { page, rows: bad.rows.unwrap_or(0..tallest), reason: bad.reason, path }
    }
}
