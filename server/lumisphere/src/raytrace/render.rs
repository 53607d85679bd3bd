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
    /// Index into `Scene::objects` there, row by row; `u32::MAX` where nothing is hit.
    pub object: Vec<u32>,
    /// R, G, B: variance of `radiance`, as if its samples were independent. They are stratified, so this is an upper estimate;
    /// zero with one sample. The noise of the picture is the root of its mean.
    pub variance: Image,
}

// Pixels along the edge of a tile: neighbours share nodes in the cache, and a picture has tiles enough for many threads.
const TILE: usize = 16;

/// Mean and variance of the mean of one pixel, and what its central ray hit.
#[derive(Debug, Clone, Copy)]
struct Pixel {
    mean: Vec3,
    variance: Vec3,
    distance: f32,
    normal: Vec3,
    object: u32,
}

impl Tracer {
    /// The picture that `camera` takes. Reports "tracing" tile by tile; stops between tiles when cancelled.
    pub fn render(&self, camera: &Camera, settings: &TraceSettings, progress: &dyn Progress) -> Result<TracedImage, Cancelled> {
        let (width, height) = (camera.intrinsics().width_px as usize, camera.intrinsics().height_px as usize);
        let tiles = Tiles::new(width, height);
        let pixels = tiles.trace(
            progress,
            || self.paths(settings.max_bounces),
            |paths, column, row| {
                let corner = Vec2::new(column as f32, row as f32);
                let index = (row * width + column) as u64;
                let mut pixel = central_hit(paths, camera.ray(corner + 0.5));
                (pixel.mean, pixel.variance) = estimate(settings, index, |random| {
                    let ray = camera.ray(corner + random.pair());
                    paths.camera_radiance(ray.origin, ray.direction, random)
                });
                pixel
            },
        )?;
        let mut image = TracedImage::empty(width, height);
        tiles.scatter(&pixels, |index, pixel| image.set(index, pixel));
        Ok(image)
    }

    /// Radiance and distance seen from `position` in every direction: RGB is the mean over a texel, the distance that of its centre.
    /// `face_size` texels an edge, at least 1. Objects that look `OneMirror` are diffuse here.
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
            || self.paths(settings.max_bounces),
            |paths, column, row| {
                let (face, corner) = (row / size, Vec2::new(column as f32, (row % size) as f32));
                let toward = |at: Vec2| texel_direction(face, size, corner.x + at.x, corner.y + at.y);
                let distance = paths.nearest(position, toward(Vec2::splat(0.5))).map_or(f32::INFINITY, |p| p.distance);
                let (mean, _) = estimate(settings, (row * size + column) as u64, |random| {
                    let direction = toward(random.pair());
                    paths.radiance(position, direction, random)
                });
                [mean.x, mean.y, mean.z, distance]
            },
        )?;
        tiles.scatter(&texels, |index, texel| cube.texels[index] = *texel);
        Ok(cube)
    }
}

/// Mean of the samples of a pixel, and the variance of that mean.
fn estimate(settings: &TraceSettings, pixel: u64, mut sample: impl FnMut(&mut SampleSequence) -> Vec3) -> (Vec3, Vec3) {
    let count = settings.samples_per_pixel.max(1);
    // Welford's recurrence: no cancellation between the sum of squares and the square of the sum.
    let (mut mean, mut squares) = (Vec3::ZERO, Vec3::ZERO);
    for s in 0..count {
        let value = sample(&mut SampleSequence::new(settings.seed, pixel, s));
        let off = value - mean;
        mean += off / (s + 1) as f32;
        squares += off * (value - mean);
    }
    (mean, squares / (count.saturating_sub(1).max(1) as f32 * count as f32))
}

fn central_hit(paths: &mut PathTracer, ray: Ray) -> Pixel {
    let miss = Pixel { mean: Vec3::ZERO, variance: Vec3::ZERO, distance: f32::INFINITY, normal: Vec3::ZERO, object: u32::MAX };
    let Some(point) = paths.nearest(ray.origin, ray.direction) else { return miss };
    let (_, normal) = facing(&point, -ray.direction);
    Pixel { distance: point.distance, normal, object: point.triangle.object, ..miss }
}

impl TracedImage {
    fn empty(width: usize, height: usize) -> Self {
        let planes = |channels| Image::zeros(width, height, channels);
        let object = vec![u32::MAX; width * height];
        Self { radiance: planes(3), distance: planes(1), normal: planes(3), object, variance: planes(3) }
    }

    fn set(&mut self, index: usize, pixel: &Pixel) {
        self.radiance.set_rgb(index, pixel.mean.to_array());
        self.distance.planes[0][index] = pixel.distance;
        self.normal.set_rgb(index, pixel.normal.to_array());
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

    /// `pixel` for every pixel, tile by tile over all threads; `worker` makes what a thread needs for a tile.
    fn trace<W, P: Send>(
        &self,
        progress: &dyn Progress,
        worker: impl Fn() -> W + Sync,
        pixel: impl Fn(&mut W, usize, usize) -> P + Sync,
    ) -> Result<Vec<Vec<P>>, Cancelled> {
        let (done, total) = (AtomicU64::new(0), self.count() as u64);
        let trace_tile = |tile| {
            if progress.is_cancelled() {
                return Err(Cancelled);
            }
            let mut worker = worker();
            let pixels = self.pixels(tile).map(|(column, row)| pixel(&mut worker, column, row)).collect();
            progress.report("tracing", done.fetch_add(1, Ordering::Relaxed) + 1, total);
            Ok(pixels)
        };
        (0..self.count()).into_par_iter().map(trace_tile).collect()
    }

    /// Hands every pixel to `place` with its index `row · width + column`.
    fn scatter<P>(&self, tiles: &[Vec<P>], mut place: impl FnMut(usize, &P)) {
        for (tile, pixels) in tiles.iter().enumerate() {
            for ((column, row), pixel) in self.pixels(tile).zip(pixels) {
                place(row * self.width + column, pixel);
            }
        }
    }
}
