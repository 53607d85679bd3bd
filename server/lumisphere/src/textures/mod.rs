//! Texture data: immutable dataset versions of checksummed pages on disk, and a cache of decoded pages and compressed blocks in memory.
//!
//! A [`Page`] is the unit that is stored and cached: one small image (a cube-map face, one region × direction texture, one probe
//! level) of one to four channels. This room knows nothing of light: a channel is a number.
//!
//! Writing: [`Store::stage`] → [`Staging::append_page`] … → [`Staging::publish`]. Reading: [`Store::open_version`] →
//! [`DatasetVersion::read_page`], or through a [`Cache`]: whole pages, or texels by a [`Reader`].
//!
//! What may be relied on: a published version never changes and is either whole or absent after a crash; every block of 16 rows
//! carries its own checksum, and a damaged one is an error that names page and rows and hurts nothing else; the index can be
//! deleted at any time; a killed writer finds its pages again; a full disk is [`StoreError::DiskFull`] and loses nothing.

mod bits;
mod buffers;
mod cache;
mod codec;
mod disk;
mod error;
mod hash;
mod index;
pub mod laboratory;
mod manifest;
mod opening;
mod page;
mod planes;
pub mod policy;
mod read_strategy;
mod root_lock;
mod segment;
mod staging;
mod store;
mod trace;
mod upload;
mod version;

#[cfg(test)]
mod tests;

#[doc(hidden)]
pub use cache::Uncounted;
pub use cache::{Cache, CacheOptions, CacheSnapshot, CacheStats, CompressedStats, Counted, Reader, Tally, VersionStats};
pub use codec::{BLOCK_ROWS, Codec, EncodedPage, MAX_F16, UnknownCodec, encode, encode_as};
pub use disk::{Disk, LimitedDisk, LocalDisk};
pub use error::StoreError;
pub use hash::ContentHash;
pub use manifest::{BlobEntry, MANIFEST_FORMAT, Manifest, PageSummary, Publication, SegmentEntry};
pub use page::{MAX_CHANNELS, MAX_PAGE_BYTES, Page, PageId, PageShape, PixelFormat, Texels};
pub use policy::{PageKey, Policy, PolicyKind, UnknownPolicy};
pub use read_strategy::{ReadStrategy, UnknownStrategy};
pub use segment::MAX_SEGMENT_BYTES;
pub use staging::{Appended, Staging};
pub use store::{IndexOutcome, OpenReport, Store, StoreOptions};
pub use trace::{InvalidTrace, MAX_TRACE_BYTES, Trace, TraceEvent, TracedVersion};
pub use upload::BlobUpload;
pub use version::{DatasetVersion, ReadCost};
