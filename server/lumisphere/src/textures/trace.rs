//! Requests for pages and rows as rendering makes them, recorded to be replayed (see `laboratory`).
//!
//! A file, little-endian: magic "LSTR", u16 version, u16 flags (bit 0: recording stopped at its limit), u16 count of dataset versions,
//! each {u8 length, name, u64 version, u32 pages, u32 width, u32 height, u32 channels, u8 pixel}, u64 count of events, the events, and
//! the xxh3 of all before. An event is a LEB128 number, 4 · version + kind: 0 a frame begins, 1 fetches from one row {page difference
//! as zigzag, row, count}, 2 a whole page {page difference}. Runs of fetches from one row are one event.

use xxhash_rust::xxh3::xxh3_64;

use super::page::{PageId, PageShape, PixelFormat};
use super::version::DatasetVersion;

const MAGIC: [u8; 4] = *b"LSTR";
const FORMAT: u16 = 1;
const TRUNCATED: u16 = 1;
/// Longest file that is read.
pub const MAX_TRACE_BYTES: usize = 1 << 30;
/// Most events that are read: 20 bytes each in memory.
pub const MAX_TRACE_EVENTS: u64 = 1 << 24;

/// A dataset version whose pages a trace asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TracedVersion {
    /// Dataset's name.
    pub dataset: String,
    /// From 1.
    pub version: u64,
    /// Pages 0…count−1 exist.
    pub page_count: u32,
    /// Of its pages; of the largest, if they differ.
    pub shape: PageShape,
}

impl TracedVersion {
    /// What a trace says of a version.
    pub fn of(version: &DatasetVersion) -> Self {
        let manifest = version.manifest();
        let largest = manifest.pages.shapes.iter().max_by_key(|shape| shape.values()).copied();
        Self {
            dataset: manifest.dataset.clone(),
            version: manifest.version,
            page_count: manifest.pages.count,
            // A version without pages is never asked for one.
            shape: largest.unwrap_or(PageShape { width: 1, height: 1, channels: 1, pixel: PixelFormat::F32 }),
        }
    }
}

/// What was asked for. `version` is an index into [`Trace::versions`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TraceEvent {
    /// A rendered frame begins.
    Frame,
    /// Texels of one row, `fetches` of them one after another.
    Row {
        /// Whose page.
        version: u32,
        /// Which.
        page: PageId,
        /// Below the page's height.
        row: u32,
        /// At least 1.
        fetches: u32,
    },
    /// The whole page.
    Page {
        /// Whose page.
        version: u32,
        /// Which.
        page: PageId,
    },
}

/// A recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trace {
    /// Whose pages were asked for.
    pub versions: Vec<TracedVersion>,
    /// In the order of asking; of several threads, in pieces as they came.
    pub events: Vec<TraceEvent>,
    /// The recording reached its limit and goes on no further.
    pub is_truncated: bool,
}

/// Bytes that are not a trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("not a trace: {0}")]
pub struct InvalidTrace(pub &'static str);

impl Trace {
    /// The requests of one version alone, frames kept; None if there is no such version. Takes no more memory.
    pub fn only(mut self, version: u32) -> Option<Self> {
        let kept = self.versions.get(version as usize)?.clone();
        self.events.retain_mut(|event| match event {
            TraceEvent::Frame => true,
            TraceEvent::Row { version: of, .. } | TraceEvent::Page { version: of, .. } => std::mem::take(of) == version,
        });
        Some(Self { versions: vec![kept], ..self })
    }

    /// The file's content.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend_from_slice(&MAGIC);
        bytes.extend_from_slice(&FORMAT.to_le_bytes());
        bytes.extend_from_slice(&(if self.is_truncated { TRUNCATED } else { 0 }).to_le_bytes());
        bytes.extend_from_slice(&(self.versions.len() as u16).to_le_bytes());
        for version in &self.versions {
            bytes.push(version.dataset.len() as u8);
            bytes.extend_from_slice(version.dataset.as_bytes());
            bytes.extend_from_slice(&version.version.to_le_bytes());
            let shape = version.shape;
            for word in [version.page_count, shape.width, shape.height, shape.channels] {
                bytes.extend_from_slice(&word.to_le_bytes());
            }
            bytes.push(shape.pixel as u8);
        }
        bytes.extend_from_slice(&(self.events.len() as u64).to_le_bytes());
        let mut page = 0;
        for event in &self.events {
            write_event(&mut bytes, event, &mut page);
        }
        let checksum = xxh3_64(&bytes);
        bytes.extend_from_slice(&checksum.to_le_bytes());
        bytes
    }

    /// Reads a file's content; whatever it holds, the result is a trace whose events are within their versions, or an error.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, InvalidTrace> {
        if bytes.len() > MAX_TRACE_BYTES {
            return Err(InvalidTrace("longer than a trace may be"));
        }
        let (content, checksum) = bytes.split_last_chunk::<8>().ok_or(InvalidTrace("too short"))?;
        if xxh3_64(content) != u64::from_le_bytes(*checksum) {
            return Err(InvalidTrace("content does not have the checksum at its end"));
        }
        let mut rest = Input(content);
        if rest.array()? != MAGIC || u16::from_le_bytes(rest.array()?) != FORMAT {
            return Err(InvalidTrace("another kind of file, or another version of it"));
        }
        let flags = u16::from_le_bytes(rest.array()?);
        let count = u16::from_le_bytes(rest.array()?);
        let versions = (0..count).map(|_| rest.version()).collect::<Result<Vec<_>, _>>()?;
        let count = u64::from_le_bytes(rest.array()?);
        // An event has at least one byte, so a lying count reserves nothing.
        if count > rest.0.len() as u64 {
            return Err(InvalidTrace("fewer events than it says"));
        }
        if count > MAX_TRACE_EVENTS {
            return Err(InvalidTrace("more events than a trace may have"));
        }
        let mut page = 0;
        let events = (0..count).map(|_| rest.event(&versions, &mut page)).collect::<Result<Vec<_>, _>>()?;
        if !rest.0.is_empty() {
            return Err(InvalidTrace("more bytes than events"));
        }
        Ok(Self { versions, events, is_truncated: flags & TRUNCATED != 0 })
    }
}

fn write_event(bytes: &mut Vec<u8>, event: &TraceEvent, last_page: &mut u32) {
    let mut page_difference = |bytes: &mut Vec<u8>, page: PageId| {
        let difference = i64::from(page.0) - i64::from(*last_page);
        write_number(bytes, ((difference << 1) ^ (difference >> 63)) as u64);
        *last_page = page.0;
    };
    match *event {
        TraceEvent::Frame => write_number(bytes, 0),
        TraceEvent::Row { version, page, row, fetches } => {
            write_number(bytes, 4 * u64::from(version) + 1);
            page_difference(bytes, page);
            write_number(bytes, u64::from(row));
            write_number(bytes, u64::from(fetches));
        }
        TraceEvent::Page { version, page } => {
            write_number(bytes, 4 * u64::from(version) + 2);
            page_difference(bytes, page);
        }
    }
}

/// LEB128.
fn write_number(bytes: &mut Vec<u8>, mut number: u64) {
    while number >= 0x80 {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
}

struct Input<'a>(&'a [u8]);

impl Input<'_> {
    fn array<const N: usize>(&mut self) -> Result<[u8; N], InvalidTrace> {
        let (array, rest) = self.0.split_first_chunk().ok_or(InvalidTrace("it ends too early"))?;
        self.0 = rest;
        Ok(*array)
    }

    fn word(&mut self) -> Result<u32, InvalidTrace> {
        self.array().map(u32::from_le_bytes)
    }

    fn number(&mut self) -> Result<u64, InvalidTrace> {
        let mut number = 0;
        for shift in (0..63).step_by(7) {
            let [byte] = self.array()?;
            number |= u64::from(byte & 0x7F) << shift;
            if byte & 0x80 == 0 {
                return Ok(number);
            }
        }
        Err(InvalidTrace("a number too long"))
    }

    fn version(&mut self) -> Result<TracedVersion, InvalidTrace> {
        let [length] = self.array()?;
        let (name, rest) = self.0.split_at_checked(usize::from(length)).ok_or(InvalidTrace("it ends too early"))?;
        self.0 = rest;
        let dataset = String::from_utf8(name.to_vec()).map_err(|_| InvalidTrace("a name that is not UTF-8"))?;
        let version = u64::from_le_bytes(self.array()?);
        let (page_count, width, height, channels) = (self.word()?, self.word()?, self.word()?, self.word()?);
        let pixel = match self.array()? {
            [1] => PixelFormat::F32,
            [2] => PixelFormat::F16,
            _ => return Err(InvalidTrace("an unknown pixel format")),
        };
        let shape = PageShape { width, height, channels, pixel };
        let shape = shape.checked().map_err(|_| InvalidTrace("a shape that no page has"))?;
        Ok(TracedVersion { dataset, version, page_count, shape })
    }

    fn event(&mut self, versions: &[TracedVersion], last_page: &mut u32) -> Result<TraceEvent, InvalidTrace> {
        let number = self.number()?;
        if number == 0 {
            return Ok(TraceEvent::Frame);
        }
        let index = number / 4;
        let of = versions.get(index as usize).ok_or(InvalidTrace("an event of a version that it does not list"))?;
        let zigzag = self.number()?;
        let difference = (zigzag >> 1) as i64 ^ -((zigzag & 1) as i64);
        let page = i64::from(*last_page).checked_add(difference).and_then(|p| u32::try_from(p).ok());
        let page = page.filter(|p| *p < of.page_count).ok_or(InvalidTrace("a page that its version does not have"))?;
        *last_page = page;
        let (version, page) = (index as u32, PageId(page));
        match number % 4 {
            1 => {
                let row = u32::try_from(self.number()?).ok().filter(|row| *row < of.shape.height);
                let fetches = u32::try_from(self.number()?).ok().filter(|fetches| *fetches > 0);
                let row = row.ok_or(InvalidTrace("a row that its page does not have"))?;
                Ok(TraceEvent::Row { version, page, row, fetches: fetches.ok_or(InvalidTrace("an impossible count of fetches"))? })
            }
            2 => Ok(TraceEvent::Page { version, page }),
            _ => Err(InvalidTrace("an unknown event")),
        }
    }
}

/// A recording under way.
#[derive(Debug)]
pub(super) struct Recorder {
    trace: Trace,
    /// Version slots by index.
    slots: Vec<u32>,
    left: usize,
}

/// Memory that an event takes while it is recorded.
const EVENT_BYTES: usize = size_of::<TraceEvent>();

impl Recorder {
    pub fn new(limit_bytes: usize) -> Self {
        let trace = Trace { versions: vec![], events: vec![], is_truncated: false };
        Self { trace, slots: vec![], left: limit_bytes / EVENT_BYTES }
    }

    /// The version's number within the trace.
    pub fn index_of(&mut self, version: &DatasetVersion) -> u32 {
        if let Some(index) = self.slots.iter().position(|slot| *slot == version.slot()) {
            return index as u32;
        }
        self.slots.push(version.slot());
        self.trace.versions.push(TracedVersion::of(version));
        self.slots.len() as u32 - 1
    }

    pub fn push(&mut self, event: TraceEvent) {
        if self.left == 0 {
            self.trace.is_truncated = true;
            return;
        }
        self.left -= 1;
        self.trace.events.push(event);
    }

    pub fn finish(self) -> Trace {
        self.trace
    }
}
