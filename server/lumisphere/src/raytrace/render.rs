//! Images and cube maps: tiles over all threads, each pixel's numbers from its own index.

use std::sync::atomic::{AtomicU64, Ordering};

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::low_discrepancy::SampleSequence;
use super::path::PathTracer;
use super::scattering::facing;
use super::tracer::Tracer;
use crate::directions::{CubeMap, FACES, texel_direction};
use crate::geometry::{Camera, Ray};
use crate::images::Image;
use crate::progress::{Cancelled, Progress};

/// How much work to put into a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceSettings {
    /// Paths a pixel or texel; 0 counts as 1. Powers of two are stratified best.
    pub samples_per_pixel: u32,
    /// Reflections along a path: 0 = emitters seen directly, 1 = and light reflected once, …
    pub max_bounces: u32,
    /// Same scene, settings and seed: same bytes, for any number of threads.
    pub seed: u64,
}

/// A traced picture.
#[derive(Debug, Clone, PartialEq)]
pub struct TracedImage {
    /// R, G, B: mean radiance over the pixel's square.
    pub radiance: Image,
    /// One channel: distance along the ray through the pixel's centre, in scene units; +∞ where nothing is hit.
    pub distance: Image,
    /// X, Y, Z: unit shading normal there, turned toward the camera; zero where nothing is hit.
    pub normal: Image,
    /// Whether the front of a surface is there, the side that its normals point to; row by row.
    pub shows_front: Vec<bool>,
    /// Index into `Scene::objects` there, row by row; `u32::MAX` where nothing is hit.
    pub object: Vec<u32>,
    /// R, G, B: variance of `radiance`, as if its samples were independent. They are stratified, so this is an upper estimate;
    /// zero with one sample. The noise of the picture is the root of its mean.
    pub variance: Image,
}

/// What a viewer sees in a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Mean over the pixel's square.
    pub radiance: Vec3,
    /// As `TracedImage::distance`.
    pub distance: f32,
    /// As `TracedImage::object`.
    pub object: u32,
}

// Pixels along the edge of a tile: neighbours share nodes in the cache, and a picture has tiles enough for many threads.
const TILE: usize = 16;

// Samples of a tile's pixels that go side by side: what 16 × 16 × 16 paths carry fits the second-level cache.
const SAMPLES_AT_ONCE: u32 = 16;

/// Mean and variance of the mean of one pixel, and what its central ray hit.
#[derive(Debug, Clone, Copy)]
struct Pixel {
    mean: Vec3,
    variance: Vec3,
    distance: f32,
    normal: Vec3,
    shows_front: bool,
    object: u32,
}

impl Tracer {
    /// The picture that `camera` takes. Reports "tracing" tile by tile; stops between tiles when cancelled.
    pub fn render(&self, camera: &Camera, settings: &TraceSettings, progress: &dyn Progress) -> Result<TracedImage, Cancelled> {
        self.render_where(&|_, _| true, camera, settings, progress)
    }

    /// The same of pixels (column, row) that are `wanted` alone; the others are as if nothing was there. A pixel is the same in both.
    pub fn render_where(
        &self,
        wanted: &(dyn Fn(usize, usize) -> bool + Sync),
        camera: &Camera,
        settings: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<TracedImage, Cancelled> {
        let (tiles, pixels) = self.trace_pixels(0, wanted, camera, settings, progress, |pixel| *pixel)?;
        let mut image = TracedImage::empty(tiles.width, tiles.height);
        tiles.scatter(&pixels, wanted, |index, pixel| image.set(index, pixel));
        Ok(image)
    }

    /// What of the same picture a viewer sees, of its samples `first`, `first` + 1, … alone: the mean of such pictures is that of all their samples
    /// together. Row by row; as if nothing was there where not `wanted`.
    pub fn seen(
        &self,
        first: u32,
        wanted: &(dyn Fn(usize, usize) -> bool + Sync),
        camera: &Camera,
        settings: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<Vec<Seen>, Cancelled> {
        let of = |pixel: &Pixel| Seen { radiance: pixel.mean, distance: pixel.distance, object: pixel.object };
        let (tiles, pixels) = self.trace_pixels(first, wanted, camera, settings, progress, of)?;
        let mut seen = vec![Seen { radiance: Vec3::ZERO, distance: f32::INFINITY, object: u32::MAX }; tiles.width * tiles.height];
        tiles.scatter(&pixels, wanted, |index, pixel| seen[index] = *pixel);
        Ok(seen)
    }

    /// What is `kept` of every `wanted` pixel, by tiles; of its samples those from `first`.
    fn trace_pixels<P: Send>(
        &self,
        first: u32,
        wanted: &(dyn Fn(usize, usize) -> bool + Sync),
        camera: &Camera,
        settings: &TraceSettings,
        progress: &dyn Progress,
        kept: impl Fn(&Pixel) -> P + Sync,
    ) -> Result<(Tiles, Vec<Vec<P>>), Cancelled> {
        let (width, height) = (camera.intrinsics().width_px as usize, camera.intrinsics().height_px as usize);
        let tiles = Tiles::new(width, height);
        let pixels = tiles.trace(
            progress,
            wanted,
            || self.paths(settings.max_bounces),
            |paths, tile| {
                let corners: Vec<Vec2> = tile.iter().map(|(column, row)| Vec2::new(*column as f32, *row as f32)).collect();
                let mut pixels = central_hits(paths, corners.iter().map(|c| camera.ray(*c + 0.5)));
                let index = |pixel: usize| (tile[pixel].1 * width + tile[pixel].0) as u64;
                let push = |paths: &mut PathTracer<'_>, pixel: usize, mut random: SampleSequence| {
                    let ray = camera.ray(corners[pixel] + random.pair());
                    paths.push(ray.origin, ray.direction, random);
                };
                let estimates = estimate(paths, tile.len(), first, settings, index, push, PathTracer::reflect_once);
                pixels.iter_mut().zip(estimates).for_each(|(pixel, e)| (pixel.mean, pixel.variance) = (e.mean, e.variance()));
                pixels.iter().map(&kept).collect()
            },
        )?;
        Ok((tiles, pixels))
    }

    /// Radiance and distance seen from `position` in every direction: RGB is the mean over a texel, the distance that of its centre.
    /// `face_size` texels an edge, at least 1. Objects that look `Mirrors` or `OneGlossy` are diffuse here.
    pub fn cube_map(
        &self,
        position: Vec3,
        face_size: usize,
        settings: &TraceSettings,
        progress: &dyn Progress,
    ) -> Result<CubeMap, Cancelled> {
        let size = face_size.max(1);
        let mut cube = CubeMap::black(size);
        // The six faces in one column, as they lie in memory.
        let tiles = Tiles::new(size, FACES * size);
        let texels = tiles.trace(
            progress,
            &|_, _| true,
            || self.paths(settings.max_bounces),
            |paths, tile| {
                let toward = |texel: usize, at: Vec2| {
                    let (column, row) = tile[texel];
                    texel_direction(row / size, size, column as f32 + at.x, (row % size) as f32 + at.y)
                };
                let mut distances = vec![f32::INFINITY; tile.len()];
                let central = (0..tile.len()).map(|texel| (position, toward(texel, Vec2::splat(0.5))));
                paths.nearest(central, |texel, hit| distances[texel] = hit.map_or(f32::INFINITY, |p| p.distance));
                let index = |texel: usize| (tile[texel].1 * size + tile[texel].0) as u64;
                let push = |paths: &mut PathTracer<'_>, texel: usize, mut random: SampleSequence| {
                    let direction = toward(texel, random.pair());
                    paths.push(position, direction, random);
                };
                let estimates = estimate(paths, tile.len(), 0, settings, index, push, |_| ());
                estimates.iter().zip(distances).map(|(e, distance)| [e.mean.x, e.mean.y, e.mean.z, distance]).collect()
            },
        )?;
        tiles.scatter(&texels, &|_, _| true, |index, texel| cube.texels[index] = *texel);
        Ok(cube)
    }
}

impl Tracer {
    /// Radiance that arrives along each of `count` bundles of rays: the mean over `settings.samples_per_pixel` rays `ray(bundle, u)`, u spread
    /// evenly over [0, 1]². Random numbers come from the seed and `first` + the bundle's number. One thread.
    pub fn radiance_along(&self, count: usize, first: u64, ray: &dyn Fn(usize, Vec2) -> Ray, settings: &TraceSettings) -> Vec<Vec3> {
        let mut paths = self.paths(settings.max_bounces);
        let mut radiance = Vec::with_capacity(count);
        for start in (0..count).step_by(TILE * TILE) {
            let push = |paths: &mut PathTracer<'_>, bundle: usize, mut random: SampleSequence| {
                let ray = ray(start + bundle, random.pair());
                paths.push(ray.origin, ray.direction, random);
            };
            let index = |bundle: usize| first + (start + bundle) as u64;
            let estimates = estimate(&mut paths, (count - start).min(TILE * TILE), 0, settings, index, push, |_| ());
            radiance.extend(estimates.iter().map(|e| e.mean));
        }
        radiance
    }
}

/// Mean of the samples of a pixel so far (Welford's recurrence: no cancellation between the sum of squares and the square of the sum).
#[derive(Debug, Clone, Copy)]
struct Estimate {
    mean: Vec3,
    squares: Vec3,
    count: u32,
}

impl Estimate {
    const NOTHING: Self = Self { mean: Vec3::ZERO, squares: Vec3::ZERO, count: 0 };

    fn add(&mut self, value: Vec3) {
        self.count += 1;
        let off = value - self.mean;
        self.mean += off / self.count as f32;
        self.squares += off * (value - self.mean);
    }

    /// Variance of the mean.
    fn variance(&self) -> Vec3 {
        self.squares / (self.count.saturating_sub(1).max(1) as f32 * self.count as f32)
    }
}

/// All samples of a tile of `pixels`, from sample `begin` on: `push` starts one path, `ready` is asked before they are traced. `index` names a pixel in the picture: its numbers come from it.
fn estimate<'a>(
    paths: &mut PathTracer<'a>,
    pixels: usize,
    begin: u32,
    settings: &TraceSettings,
    index: impl Fn(usize) -> u64,
    push: impl Fn(&mut PathTracer<'a>, usize, SampleSequence),
    ready: impl Fn(&mut PathTracer<'a>),
) -> Vec<Estimate> {
    let end = begin + settings.samples_per_pixel.max(1);
    let mut estimates = vec![Estimate::NOTHING; pixels];
    for first in (begin..end).step_by(SAMPLES_AT_ONCE as usize) {
        let samples = first..end.min(first + SAMPLES_AT_ONCE);
        paths.clear();
        for pixel in 0..pixels {
            samples.clone().for_each(|s| push(paths, pixel, SampleSequence::new(settings.seed, index(pixel), s)));
        }
        ready(paths);
        paths.trace();
        for (k, radiance) in paths.radiance().enumerate() {
            estimates[k / samples.len()].add(radiance);
        }
    }
    estimates
}

fn central_hits(paths: &mut PathTracer, rays: impl Iterator<Item = Ray> + Clone) -> Vec<Pixel> {
    let zero = Vec3::ZERO;
    let miss = Pixel { mean: zero, variance: zero, distance: f32::INFINITY, normal: zero, shows_front: false, object: u32::MAX };
    let directions: Vec<Vec3> = rays.clone().map(|r| r.direction).collect();
    let mut pixels = vec![miss; directions.len()];
    paths.nearest(rays.map(|r| (r.origin, r.direction)), |pixel, hit| {
        if let Some(point) = hit {
            let (_, normal) = facing(&point, -directions[pixel]);
            let shows_front = point.triangle.front.dot(directions[pixel]) < 0.0;
            pixels[pixel] = Pixel { distance: point.distance, normal, shows_front, object: point.triangle.object, ..miss };
        }
    });
    pixels
}

impl TracedImage {
    fn empty(width: usize, height: usize) -> Self {
        let planes = |channels| Image::zeros(width, height, channels);
        let object = vec![u32::MAX; width * height];
        let mut distance = planes(1);
        distance.planes[0].fill(f32::INFINITY);
        let shows_front = vec![false; width * height];
        Self { radiance: planes(3), distance, normal: planes(3), shows_front, object, variance: planes(3) }
    }

    fn set(&mut self, index: usize, pixel: &Pixel) {
        self.radiance.set_rgb(index, pixel.mean.to_array());
        self.distance.planes[0][index] = pixel.distance;
        self.normal.set_rgb(index, pixel.normal.to_array());
        self.shows_front[index] = pixel.shows_front;
        self.object[index] = pixel.object;
        self.variance.set_rgb(index, pixel.variance.to_array());
    }
}

/// A grid of pixels cut into square tiles.
struct Tiles {
    width: usize,
    height: usize,
}

impl Tiles {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height }
    }

    fn columns(&self) -> usize {
        self.width.div_ceil(TILE)
    }

    fn count(&self) -> usize {
        self.columns() * self.height.div_ceil(TILE)
    }

    /// (column, row) of each pixel of a tile.
    fn pixels(&self, tile: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (left, top) = (tile % self.columns() * TILE, tile / self.columns() * TILE);
        let (right, bottom) = ((left + TILE).min(self.width), (top + TILE).min(self.height));
        (top..bottom).flat_map(move |row| (left..right).map(move |column| (column, row)))
    }

    /// `trace` for the (column, row)s of every tile that are `wanted`, over all threads; `worker` makes what a thread needs for a tile.
    fn trace<W, P: Send>(
        &self,
        progress: &dyn Progress,
        wanted: &(dyn Fn(usize, usize) -> bool + Sync),
        worker: impl Fn() -> W + Sync,
        trace: impl Fn(&mut W, &[(usize, usize)]) -> Vec<P> + Sync,
    ) -> Result<Vec<Vec<P>>, Cancelled> {
        let (done, total) = (AtomicU64::new(0), self.count() as u64);
        let trace_tile = |tile| {
            if progress.is_cancelled() {
                return Err(Cancelled);
            }
            let positions: Vec<(usize, usize)> = self.pixels(tile).filter(|(column, row)| wanted(*column, *row)).collect();
            let pixels = if positions.is_empty() { Vec::new() } else { trace(&mut worker(), &positions) };
            progress.report("tracing", done.fetch_add(1, Ordering::Relaxed) + 1, total);
            Ok(pixels)
        };
        (0..self.count()).into_par_iter().map(trace_tile).collect()
    }

    /// Hands every `wanted` pixel to `place` with its index `row · width + column`.
    fn scatter<P>(&self, tiles: &[Vec<P>], wanted: &dyn Fn(usize, usize) -> bool, mut place: impl FnMut(usize, &P)) {
        for (tile, pixels) in tiles.iter().enumerate() {
            for ((column, row), pixel) in self.pixels(tile).filter(|(column, row)| wanted(*column, *row)).zip(pixels) {
                place(row * self.width + column, pixel);
            }
        }
    }
}
