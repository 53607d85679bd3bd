//! What a frame asks of stored textures, request by request: the input of cache experiments.

use super::buckets::BUCKET_PX;
use super::{Representation, Settings};
use crate::geometry::Camera;
use crate::textures::{DatasetVersion, PageId, PageShape, PixelFormat, StoreError, Trace, TraceEvent, TracedVersion};

/// One request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TexelRequest {
    /// A bilinear look-up: page and row of each of its four texels, in the order in which they are fetched.
    LookUp([(PageId, u32); 4]),
    /// A texel of a part's table of sample points.
    SampleMap {
        /// Which part's.
        part: u32,
        /// From 0.
        row: u32,
    },
}

/// In which order pixels are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelOrder {
    /// 16 × 16 pixels at a time, as frames are computed.
    Buckets,
    /// Row by row.
    Scanlines,
}

/// Directions drawn about the mirror direction r with density ∝ max(r·ω, 0)ⁿ: a glossy reflection estimated by Monte Carlo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lobe {
    /// Directions a pixel; those below the surface are not asked for.
    pub samples: u32,
    /// n, at least 0.
    pub exponent: f32,
    /// Same seed and pixel: same directions.
    pub seed: u64,
}

/// Whose requests.
#[derive(Debug, Clone, Copy)]
pub struct Recording<'a> {
    /// Its size is the frame's.
    pub camera: &'a Camera,
    /// Of the representation's own kind.
    pub settings: &'a Settings,
    /// Of the pixels.
    pub order: PixelOrder,
    /// In the mirror direction's place.
    pub lobe: Option<Lobe>,
}

/// Builds a [`Trace`] of frames: version 0 are the dataset's first pages, version 1 the rows of its sample maps, each a page of one row;
/// then follow the dataset's other pages, a version for each group of one shape. Pages keep their numbers.
#[derive(Debug)]
pub struct RequestTrace {
    trace: Trace,
    rows_per_part: u32,
    groups: Vec<PageId>,
    left: usize,
}

impl RequestTrace {
    /// Nothing asked for yet. `limit_bytes` is the memory that events may take. Reads a page of each group, for its shape.
    pub fn new(version: &DatasetVersion, representation: &dyn Representation, limit_bytes: usize) -> Result<Self, StoreError> {
        let groups = representation.page_groups();
        let of_group = |first: &PageId| Ok(TracedVersion { shape: version.read_page(*first)?.shape(), ..TracedVersion::of(version) });
        let mut versions = groups.iter().map(of_group).collect::<Result<Vec<_>, StoreError>>()?;
        let (parts, rows_per_part) = representation.sample_map_rows();
        let row = PageShape { width: rows_per_part.max(1), height: 1, channels: 4, pixel: PixelFormat::F16 };
        let pages = TracedVersion::of(version);
        let dataset = format!("{} sample maps", pages.dataset);
        versions.insert(versions.len().min(1), TracedVersion { dataset, page_count: parts * rows_per_part, shape: row, ..pages });
        let trace = Trace { versions, events: Vec::new(), is_truncated: false };
        Ok(Self { trace, rows_per_part, groups, left: limit_bytes / size_of::<TraceEvent>() })
    }

    /// The next frame's requests follow.
    pub fn begin_frame(&mut self) {
        self.append(TraceEvent::Frame);
    }

    /// The next request.
    pub fn push(&mut self, request: TexelRequest) {
        match request {
            TexelRequest::LookUp(texels) => texels.into_iter().for_each(|(page, row)| {
                let group = self.groups.partition_point(|first| *first <= page).max(1) as u32 - 1;
                self.fetch(if group == 0 { 0 } else { group + 1 }, page, row);
            }),
            TexelRequest::SampleMap { part, row } => self.fetch(1, PageId(part * self.rows_per_part + row), 0),
        }
    }

    /// Whether something was left out for want of room.
    pub fn is_full(&self) -> bool {
        self.trace.is_truncated
    }

    /// What was recorded.
    pub fn finish(self) -> Trace {
        self.trace
    }

    // Fetches from one row, one after the other, are one event.
    fn fetch(&mut self, version: u32, page: PageId, row: u32) {
        if let Some(TraceEvent::Row { version: v, page: p, row: r, fetches }) = self.trace.events.last_mut()
            && (*v, *p, *r) == (version, page, row)
        {
            *fetches += 1;
            return;
        }
        self.append(TraceEvent::Row { version, page, row, fetches: 1 });
    }

    fn append(&mut self, event: TraceEvent) {
        match self.left {
            0 => self.trace.is_truncated = true,
            _ => {
                self.left -= 1;
                self.trace.events.push(event);
            }
        }
    }
}

impl PixelOrder {
    /// Every pixel (i, j) of a frame once.
    pub fn pixels(self, width: u32, height: u32) -> Box<dyn Iterator<Item = (u32, u32)>> {
        let edge = match self {
            Self::Buckets => BUCKET_PX as u32,
            Self::Scanlines => return Box::new((0..height).flat_map(move |j| (0..width).map(move |i| (i, j)))),
        };
        let corners =
            (0..height).step_by(edge as usize).flat_map(move |top| (0..width).step_by(edge as usize).map(move |left| (left, top)));
        let inside = move |(left, top): (u32, u32)| {
            (top..height.min(top + edge)).flat_map(move |j| (left..width.min(left + edge)).map(move |i| (i, j)))
        };
        Box::new(corners.flat_map(inside))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_pixel_comes_once_and_buckets_finish_before_the_next_begins() {
        for order in [PixelOrder::Buckets, PixelOrder::Scanlines] {
            let pixels: Vec<_> = order.pixels(37, 21).collect();
            assert_eq!((pixels.len(), pixels.iter().collect::<HashSet<_>>().len()), (37 * 21, 37 * 21));
        }
        let buckets: Vec<_> = PixelOrder::Buckets.pixels(37, 21).map(|(i, j)| (i / 16, j / 16)).collect();
        let changes = buckets.windows(2).filter(|w| w[0] != w[1]).count();
        assert_eq!(changes, 3 * 2 - 1);
        assert_eq!(PixelOrder::Scanlines.pixels(37, 21).nth(40), Some((3, 1)));
    }
}
