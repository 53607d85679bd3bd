//! Leaving out what an error bound can do without: sample points, and the finest levels of the cube maps.
//!
//! The error is that of validation pixels, whose truth is known, shaded from the nearest visible sample points that are left. Greedy: the
//! sample point goes first whose loss changes the error least. After each loss only the cheapest are measured anew (lazy greedy: Minoux
//! 1978; errors are nearly, not exactly, submodular, so the order is good, not optimal), several at once where they share no pixel.
//! A thinned light field holds the very texels of the one it was thinned from; where its faces are coarser, the finer one's levels.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashSet};
use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

use super::corrected::InverseDistances;
use super::reference::{Asides, PagedCubes, PagesTouched};
use super::sample_points::nearest_visible;
use super::shade::{ReadCube, shade_from, shade_object, sight};
use super::{NO_SAMPLE, OffsetSurfaceLightField, Parameters, SampleMaps, SamplePoint, Settings, ThinnedFrom, build_sample_maps};
use crate::capture::{Background, halved_distances, inverse_distance};
use crate::directions::{FACES, Texel, bilinear_footprint};
use crate::geometry::Camera;
use crate::progress::{Cancelled, Progress};
use crate::raytrace::Stack;
use crate::representations::g_buffer::{GBufferPixel, GBufferTracer, ProxyGeometry, Seen};
use crate::representations::page_source::CountingSource;
use crate::representations::{PageSource, RenderError};
use crate::scenes::Environment;
use crate::textures::{Codec, DatasetVersion, Page, PageId, PageShape, Staging, StoreError, encode_as};

/// A pixel's nearest visible sample points that are known of: when all of them are gone it shows nothing.
const NEAREST: usize = 64;
/// Sample points measured anew at a time.
const ROUND: usize = 32;
/// Of those, as many leave at most.
const LEAVE: usize = 8;
/// No faces coarser than so many texels.
const LEAST_FACE_SIZE: u32 = 16;
/// A distance of so much coarser a level is read from 64 texels.
const MOST_LEVELS: u32 = 3;
/// Fewer sample points blend nothing.
const FEWEST_POINTS: usize = 4;

/// Why nothing was thinned.
#[derive(Debug, Error)]
pub enum ThinningError {
    /// A pixel cannot be shaded.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// A page cannot be read, made or stored.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Asked to stop.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// A pixel of the object, and what it should show.
pub struct ValidationPixel {
    /// Which pixel.
    pub at: (u32, u32),
    /// Linear radiance.
    pub reference: Vec3,
}

/// A camera and those of its pixels that count.
pub struct ValidationView {
    /// Held for the whole measurement.
    pub camera: Camera,
    /// All show the object.
    pub pixels: Vec<ValidationPixel>,
}

/// Error of a pixel: what it shows, what it should show. What is bounded is the mean over all pixels.
pub type PixelError<'a> = &'a (dyn Fn(Vec3, Vec3) -> f64 + Sync);
/// Whether the sample point is visible from the surface point.
pub type Visible<'a> = &'a (dyn Fn(SamplePoint, Vec3) -> bool + Sync);

/// A light field under thinning.
pub struct Thinning<'a> {
    field: &'a OffsetSurfaceLightField,
    settings: Settings,
    source: CountingSource<'a>,
    touched: PagesTouched,
    error: PixelError<'a>,
    visible: Visible<'a>,
    progress: &'a dyn Progress,
    pixels: Vec<Pixel>,
    /// Of every sample point, the pixels that may read it.
    readers: Vec<Vec<u32>>,
}

struct Pixel {
    camera: Camera,
    at: (u32, u32),
    seen: GBufferPixel,
    reference: Vec3,
    /// Nearest first.
    nearest: Vec<u16>,
}

/// Which cube maps are left, and from which level on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Kept {
    /// Indices of sample points, ascending.
    pub points: Vec<u16>,
    /// Levels left out at the fine end.
    pub levels: u32,
}

impl<'a> Thinning<'a> {
    /// Finds out what the views' pixels see, and from which sample points that is visible.
    pub fn new(
        field: &'a OffsetSurfaceLightField,
        settings: Settings,
        source: &'a dyn PageSource,
        views: &[ValidationView],
        (error, visible): (PixelError<'a>, Visible<'a>),
        progress: &'a dyn Progress,
    ) -> Result<Self, Cancelled> {
        let geometry = Arc::new(ProxyGeometry::new(&field.surface.mesh, &field.surface.part_of_triangle, &field.background));
        let tracer = GBufferTracer::new(geometry);
        let of_view = |view: &ValidationView| {
            let mut stack = Stack::new();
            let seen = view.pixels.iter().map(|p| (p, tracer.pixel(&view.camera, p.at.0, p.at.1, &mut stack)));
            // What the truth takes for the object's front may be a neighbour's edge for the rasterised mesh.
            let seen = seen.filter(|(_, seen)| matches!(Seen::from_code(seen.a[2]), Seen::Object { .. }));
            let pixel = |(pixel, seen): (&ValidationPixel, GBufferPixel)| {
                let (at, _) = sight(settings.filter, &view.camera, pixel.at, &seen);
                let point = SamplePoint { position: at.position, normal: at.normal };
                let nearest = nearest_visible(point, &field.sample_points, NEAREST, visible);
                Pixel { camera: view.camera, at: pixel.at, seen, reference: pixel.reference, nearest }
            };
            seen.map(pixel).collect::<Vec<_>>()
        };
        let unless_cancelled = |view: &ValidationView| if progress.is_cancelled() { Err(Cancelled) } else { Ok(of_view(view)) };
        let pixels: Vec<Vec<Pixel>> = views.par_iter().map(unless_cancelled).collect::<Result<_, _>>()?;
        let pixels: Vec<Pixel> = pixels.into_iter().flatten().collect();
        let mut readers = vec![Vec::new(); field.sample_points.len()];
        for (number, pixel) in (0..).zip(&pixels) {
            pixel.nearest.iter().for_each(|j| readers[usize::from(*j)].push(number));
        }
        let touched = PagesTouched::new(field.page_count());
        Ok(Self { field, settings, source: CountingSource::new(source), touched, error, visible, progress, pixels, readers })
    }

    /// How many pixels the error is the mean of.
    pub fn pixel_count(&self) -> usize {
        self.pixels.len()
    }

    /// How many of the finest levels could be left out.
    pub fn levels_to_spare(&self) -> u32 {
        let size = self.field.parameters.face_size_texels;
        let possible = |levels: &u32| size >> levels >= LEAST_FACE_SIZE && *levels <= self.field.parameters.coarser_levels.min(MOST_LEVELS);
        (0..).take_while(possible).last().unwrap_or(0)
    }

    /// Of the light field as it is, by its own sample maps.
    pub fn error_before(&self) -> Result<f64, ThinningError> {
        let all = Kept { points: (0..self.field.sample_points.len() as u16).collect(), levels: 0 };
        self.error_of(self.field, &all)
    }

    /// Of a thinned one, by its own sample maps.
    pub fn error_of(&self, thinned: &OffsetSurfaceLightField, kept: &Kept) -> Result<f64, ThinningError> {
        self.mean(|pixel, inner| {
            let cubes = &mut Part { inner, thinned, points: Some(&kept.points), levels: kept.levels };
            Ok(shade_object(thinned, &self.settings, &pixel.camera, pixel.at, &pixel.seen, cubes)?.radiance)
        })
    }

    /// About the same, quicker: every pixel by the sample points that are nearest to itself.
    pub fn error_without(&self, lost: &HashSet<u16>, levels: u32) -> Result<f64, ThinningError> {
        let coarser = self.coarser(levels);
        self.mean(|pixel, inner| {
            let cubes = &mut Part { inner, thinned: &coarser, points: None, levels };
            self.shade(&coarser, pixel, four(pixel, |j| !lost.contains(&j)), cubes)
        })
    }

    /// With what shading from given sample points asks for: no sample maps and no background.
    fn coarser(&self, levels: u32) -> OffsetSurfaceLightField {
        OffsetSurfaceLightField {
            parameters: self.coarser_parameters(levels),
            surface: self.field.surface.clone(),
            sample_points: self.field.sample_points.clone(),
            sample_maps: SampleMaps { size: 0, indices: Vec::new() },
            background: Background { surfaces: Vec::new(), textures: Vec::new(), environment: Environment::Constant(Vec3::ZERO) },
        }
    }

    fn coarser_parameters(&self, levels: u32) -> Parameters {
        let mut parameters = self.field.parameters.clone();
        parameters.face_size_texels >>= levels;
        parameters.coarser_levels -= levels;
        parameters
    }

    fn shade(
        &self,
        field: &OffsetSurfaceLightField,
        pixel: &Pixel,
        candidates: [u16; 4],
        cubes: &mut dyn ReadCube,
    ) -> Result<Vec3, RenderError> {
        Ok(shade_from(field, &self.settings, &pixel.camera, pixel.at, &pixel.seen, candidates, cubes)?.radiance)
    }

    fn mean(&self, shade: impl Fn(&Pixel, &mut PagedCubes<'_>) -> Result<Vec3, RenderError> + Sync) -> Result<f64, ThinningError> {
        let start = || PagedCubes::new(self.field, &self.source, &self.touched, Asides::default());
        let error = |cubes: &mut PagedCubes<'_>, pixel: &Pixel| {
            if self.progress.is_cancelled() {
                return Err(ThinningError::Cancelled(Cancelled));
            }
            Ok(self.error_shown(shade(pixel, cubes)?, pixel))
        };
        // In order, so that the sum does not depend on the number of threads.
        let errors: Vec<f64> = self.pixels.par_iter().map_init(start, error).collect::<Result<_, _>>()?;
        Ok(errors.iter().sum::<f64>() / errors.len().max(1) as f64)
    }

    /// As frames do, what is not finite is shown black; an error that is not finite is the greatest.
    fn error_shown(&self, radiance: Vec3, pixel: &Pixel) -> f64 {
        let shown = if radiance.is_finite() { radiance } else { Vec3::ZERO };
        let error = (self.error)(shown, pixel.reference);
        if error.is_finite() { error } else { f64::MAX.sqrt() }
    }

    /// Sample points in the order in which they can be done without, until the mean error exceeds `most`.
    pub fn order(&self, most: f64) -> Result<Vec<u16>, ThinningError> {
        let progress = self.progress;
        let count = self.field.sample_points.len();
        let start = || PagedCubes::new(self.field, &self.source, &self.touched, Asides::default());
        let mut is_left = vec![true; count];
        let error_of = |pixel: &Pixel, candidates: [u16; 4], cubes: &mut PagedCubes<'_>| {
            if progress.is_cancelled() {
                return Err(ThinningError::Cancelled(Cancelled));
            }
            Ok(self.error_shown(self.shade(self.field, pixel, candidates, cubes)?, pixel))
        };
        let now = |cubes: &mut PagedCubes<'_>, pixel: &Pixel| error_of(pixel, four(pixel, |_| true), cubes);
        let mut errors: Vec<f64> = self.pixels.par_iter().map_init(start, now).collect::<Result<_, _>>()?;
        // What is lost with a sample point: of each pixel that reads it, the error without it.
        let loss_of = |cubes: &mut PagedCubes<'_>, point: u16, is_left: &[bool], errors: &[f64]| {
            let mut affected = Vec::new();
            for number in &self.readers[usize::from(point)] {
                let pixel = &self.pixels[*number as usize];
                if four(pixel, |j| is_left[usize::from(j)]).contains(&point) {
                    let without = four(pixel, |j| j != point && is_left[usize::from(j)]);
                    affected.push((*number, error_of(pixel, without, cubes)?));
                }
            }
            let loss: f64 = affected.iter().map(|(number, error)| error - errors[*number as usize]).sum();
            Ok::<_, ThinningError>((loss, affected))
        };
        let first =
            |cubes: &mut PagedCubes<'_>, point: u16| Ok((Reverse(Loss(loss_of(cubes, point, &is_left, &errors)?.0)), Reverse(point)));
        progress.report("measuring sample points", 0, count as u64);
        let all: Vec<_> = (0..count as u16).into_par_iter().map_init(start, first).collect::<Result<_, ThinningError>>()?;
        let mut queue = BinaryHeap::from(all);
        let mut gone = Vec::new();
        let mut sum: f64 = errors.iter().sum();
        while sum <= most * errors.len() as f64 && count - gone.len() > FEWEST_POINTS {
            progress.report("thinning sample points", gone.len() as u64, count as u64);
            if progress.is_cancelled() {
                return Err(Cancelled.into());
            }
            let cheapest: Vec<u16> = (0..ROUND).filter_map(|_| queue.pop()).map(|(_, Reverse(point))| point).collect();
            let anew = |cubes: &mut PagedCubes<'_>, point: &u16| Ok((*point, loss_of(cubes, *point, &is_left, &errors)?));
            let mut losses: Vec<_> = cheapest.par_iter().map_init(start, anew).collect::<Result<_, ThinningError>>()?;
            losses.sort_by(|(p, (a, _)), (q, (b, _))| a.total_cmp(b).then(p.cmp(q)));
            // Those that stay in the queue were cheaper when last measured than now they are.
            let next = queue.peek().map_or(f64::INFINITY, |(Reverse(loss), _)| loss.0);
            let (mut changed, mut left) = (HashSet::new(), 0);
            for (point, (loss, affected)) in losses {
                let is_cheapest = left == 0 || loss <= next;
                // Of a pixel that another's leaving has changed, it may be among the four by now.
                let is_read = |number: &u32| four(&self.pixels[*number as usize], |j| is_left[usize::from(j)]).contains(&point);
                let is_apart = !changed.iter().any(is_read);
                if left < LEAVE && is_cheapest && is_apart && count - gone.len() > FEWEST_POINTS {
                    for (number, error) in affected {
                        sum += error - errors[number as usize];
                        errors[number as usize] = error;
                        changed.insert(number);
                    }
                    is_left[usize::from(point)] = false;
                    gone.push(point);
                    left += 1;
                } else {
                    queue.push((Reverse(Loss(loss)), Reverse(point)));
                }
            }
        }
        Ok(gone)
    }

    /// The light field of what is kept, without its pages. Its parameters say from what it was thinned.
    pub fn thinned(&self, kept: &Kept) -> OffsetSurfaceLightField {
        let sample_points: Vec<SamplePoint> = kept.points.iter().map(|j| self.field.sample_points[usize::from(*j)]).collect();
        let sample_maps = build_sample_maps(&self.field.surface, &sample_points, self.field.sample_maps.size, self.visible);
        let mut parameters = self.coarser_parameters(kept.levels);
        let Parameters { face_size_texels, .. } = self.field.parameters;
        parameters.thinned_from.get_or_insert(ThinnedFrom { sample_points: self.field.sample_points.len() as u32, face_size_texels });
        let (surface, background) = (self.field.surface.clone(), self.field.background.clone());
        OffsetSurfaceLightField { parameters, surface, sample_points, sample_maps, background }
    }
}

/// The nearest four that are left.
fn four(pixel: &Pixel, is_left: impl Fn(u16) -> bool) -> [u16; 4] {
    let mut left = pixel.nearest.iter().copied().filter(|j| is_left(*j));
    std::array::from_fn(|_| left.next().unwrap_or(NO_SAMPLE))
}

/// In a total order.
#[derive(Debug, Clone, Copy)]
struct Loss(f64);

impl PartialEq for Loss {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Loss {}

impl PartialOrd for Loss {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Loss {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// Some of a light field's cube maps from some level on, read as those of a thinned one.
struct Part<'p, 'a> {
    inner: &'p mut PagedCubes<'a>,
    thinned: &'p OffsetSurfaceLightField,
    /// None for all.
    points: Option<&'p [u16]>,
    levels: u32,
}

impl Part<'_, '_> {
    fn cube(&self, cube: u32) -> u32 {
        let Some(points) = self.points else { return cube };
        // The baseline's comes last.
        points.get(cube as usize).map_or_else(|| self.inner.field().sample_points.len() as u32, |j| u32::from(*j))
    }
}

impl ReadCube for Part<'_, '_> {
    fn read_level(&mut self, cube: u32, direction: Vec3, level: u32) -> Result<Vec3, RenderError> {
        let cube = self.cube(cube);
        self.inner.read_level(cube, direction, level + self.levels)
    }

    fn inverse_distances(&mut self, cube: u32, direction: Vec3) -> Result<InverseDistances, RenderError> {
        let cube = self.cube(cube);
        if self.levels == 0 {
            return self.inner.inverse_distances(cube, direction);
        }
        let footprint = bilinear_footprint(direction, self.thinned.parameters.face_size_texels as usize);
        let mut texels = [(0.0, 0.0); 4];
        for (place, (texel, weight)) in texels.iter_mut().zip(footprint) {
            *place = (1.0 / self.mean_inverse(cube, texel, self.levels)?, weight);
        }
        Ok(InverseDistances::of(texels))
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        self.thinned
    }
}

impl Part<'_, '_> {
    /// Over the finest texels that a coarser level's covers.
    fn mean_inverse(&mut self, cube: u32, texel: Texel, levels: u32) -> Result<f32, RenderError> {
        let finer = |row, column| Texel { face: texel.face, row: 2 * texel.row + row, column: 2 * texel.column + column };
        let finer = [finer(0, 0), finer(0, 1), finer(1, 0), finer(1, 1)];
        if levels == 1 {
            let distances = self.inner.distances(cube, finer)?;
            return Ok(0.25 * distances.map(inverse_distance).iter().sum::<f32>());
        }
        let mut sum = 0.0;
        for texel in finer {
            sum += self.mean_inverse(cube, texel, levels - 1)?;
        }
        Ok(0.25 * sum)
    }
}

/// Copies into `staging` the pages of what is kept of `field`, as `thinned` has them; pages that are there already are not made again.
pub fn copy_pages(
    (field, version): (&OffsetSurfaceLightField, &DatasetVersion),
    (thinned, kept): (&OffsetSurfaceLightField, &Kept),
    codec: Codec,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<(), ThinningError> {
    let present = staging.pages_present();
    // Of a dataset that was made elsewhere no page is taken for what it should be.
    let read = |page: PageId| {
        let read = version.read_page(page)?;
        field.check_page(page.0, read.shape())?;
        Ok::<_, ThinningError>(read)
    };
    let baseline = field.sample_points.len();
    let cubes: Vec<usize> = kept.points.iter().map(|j| usize::from(*j)).chain([baseline]).collect();
    for (cube, &from) in cubes.iter().enumerate() {
        progress.report("copying cube maps", cube as u64, cubes.len() as u64);
        if progress.is_cancelled() {
            return Err(Cancelled.into());
        }
        let append = |page: u32, make: &dyn Fn() -> Result<Page, ThinningError>| {
            let page = PageId(page);
            if !present.contains(&page) {
                let texels = make()?;
                staging.append_encoded(page, &encode_as(codec, &texels.shape(), &texels.to_f32())?)?;
            }
            Ok::<_, ThinningError>(())
        };
        for face in 0..FACES {
            let finest = PageId(OffsetSurfaceLightField::page(from, face));
            append(OffsetSurfaceLightField::page(cube, face), &|| {
                let finest = read(finest)?;
                if kept.levels == 0 {
                    Ok(finest)
                } else {
                    Ok(coarser_face(&finest, &read(level_page(field, from, kept.levels))?, face, kept.levels)?)
                }
            })?;
        }
        for level in 1..=thinned.parameters.coarser_levels {
            append(thinned.level_page(cube, level), &|| read(level_page(field, from, level + kept.levels)))?;
        }
    }
    progress.report("copying cube maps", cubes.len() as u64, cubes.len() as u64);
    Ok(())
}

fn level_page(field: &OffsetSurfaceLightField, cube: usize, level: u32) -> PageId {
    PageId(field.level_page(cube, level))
}

/// A level's face with distances: R, G, B as the level has them, distances the inverse of the mean inverse ones.
fn coarser_face(finest: &Page, level: &Page, face: usize, levels: u32) -> Result<Page, StoreError> {
    let PageShape { width, channels, pixel, .. } = level.shape();
    if finest.shape().channels != 4 {
        return Err(StoreError::InvalidPage { reason: format!("{} channels, R, G, B and distance expected", finest.shape().channels) });
    }
    let shape = PageShape { width, height: width, channels: 4, pixel };
    let distances = halved_distances(finest, levels);
    let colors = level.to_f32();
    let of_face = colors.chunks_exact((width * width * channels) as usize).nth(face).unwrap_or_default();
    let texels =
        of_face.chunks_exact(channels as usize).zip(&distances).flat_map(|(color, distance)| [color[0], color[1], color[2], *distance]);
    Page::from_f32(shape, &texels.collect::<Vec<f32>>())
}
