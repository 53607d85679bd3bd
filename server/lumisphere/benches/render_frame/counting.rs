//! What counting costs a frame on the CPU: the same frames through readers that count and readers that leave it out, in turn, everything
//! resident. The median of the ratios, by CPU time of the whole process; bound 1.02.

use std::sync::Arc;

use lumisphere::geometry::Camera;
use lumisphere::render::{Backend, Refine, Renderer, Representation, Settings};
use lumisphere::representations::{CachedPages, Fetched, PageSource, PageUse, TexelReader};
use lumisphere::textures::{PageId, PageShape, Reader, StoreError, Tally};

use crate::{cpu_millis, request};

/// Of a measurement.
const FRAMES: usize = 4;
const ROUNDS: usize = 15;

/// Pages whose texels are read without counting.
struct UncountedPages<'a>(&'a CachedPages);

impl PageSource for UncountedPages<'_> {
    fn version_slot(&self) -> u32 {
        self.0.version_slot()
    }

    fn page(&self, page: PageId) -> Result<Fetched, StoreError> {
        self.0.page(page)
    }

    fn reader(&self) -> Box<dyn TexelReader + '_> {
        Box::new(Through(self.0.cache.uncounted_reader(&self.0.version)))
    }
}

struct Through<'a, T: Tally>(Reader<'a, T>);

impl<T: Tally> TexelReader for Through<'_, T> {
    fn texels(&mut self, at: [(PageId, u32, u32); 4]) -> Result<[[f32; 4]; 4], StoreError> {
        self.0.texels(at)
    }

    fn shape(&mut self, page: PageId) -> Result<PageShape, StoreError> {
        self.0.shape(page)
    }

    fn usage(&self) -> PageUse {
        let done = self.0.counted();
        PageUse { hits: done.hits, misses: done.misses, bytes_read: done.bytes_read }
    }
}

/// Prints a line for these settings.
pub fn report(what: &str, field: &Arc<dyn Representation>, pages: &CachedPages, settings: &Settings, cameras: &[Camera]) {
    let renderer = Renderer::cpu_only();
    let draw = |source: &dyn PageSource| {
        let before = cpu_millis();
        for camera in &cameras[..FRAMES] {
            renderer.render(field, source, &request(camera, settings, Refine::Whole), Some(Backend::Cpu)).expect("a frame");
        }
        (cpu_millis() - before) / FRAMES as f64
    };
    let uncounted = UncountedPages(pages);
    draw(pages);
    let fetches = pages.cache.stats().texel_fetches;
    draw(pages);
    let fetches = (pages.cache.stats().texel_fetches - fetches) / FRAMES as u64;
    // Who comes first changes, so that what drifts favours neither.
    let mut rounds: Vec<[f64; 2]> = (0..ROUNDS)
        .map(|round| {
            let [first, second]: [&dyn PageSource; 2] = if round % 2 == 0 { [pages, &uncounted] } else { [&uncounted, pages] };
            let (first, second) = (draw(first), draw(second));
            if round % 2 == 0 { [first, second] } else { [second, first] }
        })
        .collect();
    let mut median = |of: fn(&[f64; 2]) -> f64| {
        rounds.sort_by(|a, b| of(a).total_cmp(&of(b)));
        of(&rounds[ROUNDS / 2])
    };
    let (counted, uncounted, ratio) = (median(|r| r[0]), median(|r| r[1]), median(|r| r[0] / r[1]));
    let verdict = if ratio <= 1.02 { "met" } else { "MISSED" };
    println!(
        "{what}: {fetches} texel fetches a frame, CPU ms {counted:.1}, without counting {uncounted:.1}; ratio {ratio:.4}, bound 1.02: {verdict}"
    );
}
