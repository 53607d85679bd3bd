//! The passes of a frame, and bringing the pages it needs.
//!
//! A frame is drawn in bands of rows, so that memory on the device does not grow with it. For each band the object is shaded; the
//! kernel leaves word of every page it wanted, so that what is missing is known before anything is shown. In the steady state that
//! pass is the frame. Otherwise missing pages, or, where many are missing, the blocks of rows that were wanted, are uploaded, as far as the request's allowance
//! goes, and the pixels shaded again: exactly,
//! or with coarse levels standing in for pages that are still missing; such a frame is not final. Where a band wants more pages
//! than there are slots, its pixels are shaded in ranges that do not.

use std::ops::Range;
use std::time::Instant;

use rayon::prelude::*;

use super::super::coarse::with_levels_of_a_face;
use super::super::{Blend, Component, GlossBrdf, OWN_EXPONENT, Settings};
use super::{BoundAtlas, Kernel, PAGES_OF_A_PIXEL, ShadingUniform};
use crate::directions::FACES;
use crate::gpu::{Gpu, GpuError, Upload, conform};
use crate::representations::frame_output::{self, FrameOutput};
use crate::representations::page_source::CountingSource;
use crate::representations::{FrameRequest, GpuFrameStats, PendingPixels, Refine, RenderError, Settings as AnySettings};
use crate::textures::PageId;

// At most this many decoded pages wait for their upload.
const PAGES_IN_FLIGHT: usize = 256;
// Few of a frame's pages are this part of them, and less.
const FEW_OF: u64 = 8;
// In one submission; a band of single reads has fewer pixels.
pub(super) const MOST_DIRECTIONS_AT_ONCE: u32 = 1 << 22;
// Which pages a depth-corrected read wants depends on what others hold: seldom on more than two, one after the other.
const MOST_ROUNDS: u32 = 8;

// By an adapter in software: with 96 its frames were right, with 128 they were not (docs/measurements.md, "How a highlight is best gathered").
const MOST_DIRECTIONS_CORRECTED: u64 = 64;
// Of blends that read four sample points: a tenth of the rounds that `corrected` takes, or a fourth with the most taps.
const MOST_DIRECTIONS_BLENDED: u64 = 256;

/// A frame of which some bands are done.
struct FrameInProgress<'a, 'p> {
    request: &'a FrameRequest<'a>,
    settings: &'a Settings,
    pages: &'a CountingSource<'p>,
    wanted: Vec<bool>,
    wanted_count: usize,
    // What may still be uploaded; None: whatever it takes.
    allowance_bytes: Option<u64>,
    is_final: bool,
    output: FrameOutput,
    stats: GpuFrameStats,
}

/// Rows of a page, a bit for each block of them.
#[derive(Clone, Copy)]
pub(super) struct PageRows {
    pub page: u32,
    pub blocks: u32,
}

/// Some of a band's pixels, in rows from its top.
struct Part {
    pixels: Range<u32>,
    // How often missing pages were uploaded for them.
    rounds: u32,
}

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Fidelity {
    /// Right where every page is there, meaningless elsewhere.
    Exact,
    /// Coarse levels stand in for missing pages.
    StandIn,
}

impl Kernel {
    // llvmpipe, lavapipe's compiler, ends all loops of an invocation after 65,536 rounds together, without a word. The blend `corrected`
    // marches for every direction, some 500 rounds; blends of four sample points some 50 to 150; those of one are right with as many
    // directions as there may be.
    fn check_directions(&self, settings: &Settings) -> Result<(), GpuError> {
        let Some(gloss) = super::gloss(settings.component).filter(|_| self.gpu.is_software()) else { return Ok(()) };
        let (what, limit) = match settings.blend {
            Blend::EnvironmentMap | Blend::Distance | Blend::Angle => return Ok(()),
            Blend::Corrected => ("a depth-corrected glossy pixel in directions a pass", MOST_DIRECTIONS_CORRECTED),
            Blend::Average | Blend::Reflection { .. } | Blend::Normal { .. } => {
                ("a glossy pixel in directions a pass", MOST_DIRECTIONS_BLENDED)
            }
        };
        let needed = u64::from(gloss.looks());
        if needed > limit { Err(GpuError::BeyondLimit { what, needed, limit }) } else { Ok(()) }
    }

    pub(super) fn draw_frame(
        &mut self,
        request: &FrameRequest<'_>,
        pages: &CountingSource<'_>,
    ) -> Result<(PendingPixels, GpuFrameStats), RenderError> {
        let AnySettings::OffsetSurfaceLightField(settings) = request.settings else {
            return Err(RenderError::OtherKind { settings: request.settings.kind() });
        };
        settings.check_original(self.field.parameters.original)?;
        settings.check_bumps()?;
        let bands = frame_output::bands(&self.gpu, request.camera)?;
        self.check_directions(settings)?;
        self.ensure_light(settings, pages)?;
        self.ensure_tree(settings, pages)?;
        self.ensure_table(request, settings, pages)?;
        self.ensure_normal_map(request, settings, pages)?;
        // Four sample points each time that a mirror is met.
        let pages_of_a_pixel = 4 * settings.reflections as usize * FACES;
        if settings.sees_itself() && pages_of_a_pixel > PAGES_OF_A_PIXEL {
            self.check_room_for(pages_of_a_pixel, "the pages of a pixel's reflections", 0, pages)?;
        }
        self.ensure_atlas(pages)?;
        let bound = self.atlas.as_mut().expect("made above");
        let (atlas, stands_in) = (&mut bound.atlas, bound.coarse.exists());
        atlas.begin_frame();
        // Where one frame's pages do not fit together, refining would bring and lose them in turn for ever.
        let fits = self.last_wanted.iter().filter(|w| **w).count() <= atlas.capacity();
        let allowance_bytes = match request.refine {
            Refine::UpTo { upload_bytes } if fits && stands_in => Some(upload_bytes),
            Refine::Whole | Refine::UpTo { .. } => None,
        };
        let mut frame = FrameInProgress {
            request,
            settings,
            pages,
            wanted: vec![false; self.field.face_count()],
            wanted_count: 0,
            allowance_bytes,
            is_final: true,
            output: FrameOutput::new(request),
            stats: GpuFrameStats::default(),
        };
        for (first_row, rows) in bands {
            self.draw_band(&mut frame, first_row, rows)?;
        }
        let FrameInProgress { output, wanted, wanted_count, is_final, stats, .. } = frame;
        self.last_wanted = wanted;
        Ok((output.into_pixels(&self.gpu, wanted_count, is_final), stats))
    }

    fn draw_band(&mut self, frame: &mut FrameInProgress<'_, '_>, first_row: u32, rows: u32) -> Result<(), RenderError> {
        let begin = Instant::now();
        let pages_millis_before = frame.stats.pages_millis;
        let camera = frame.request.camera;
        self.ensure_band(camera.intrinsics().width_px, rows)?;
        let gpu = self.gpu.clone();
        let mut encoder = new_encoder(&gpu);
        let band = &self.band.as_ref().expect("made above").band;
        let pixels = band.pixels();
        let turn = frame.settings.light.environment_turn();
        self.rasterizer.draw(&gpu, &mut encoder, (camera, turn), first_row, band)?;
        let mut parts = in_ranges(pixels, frame.settings);
        let mut passes = 0;
        while let Some(part) = parts.pop() {
            let recorded = std::mem::replace(&mut encoder, new_encoder(&gpu));
            self.shade(&gpu, recorded, frame, part.pixels.clone(), Fidelity::Exact);
            passes += 1;
            let wanted = self.wanted_pages(&gpu)?;
            self.count_wanted(frame, &wanted, passes == 1);
            let atlas = &self.atlas.as_ref().expect("made before").atlas;
            let missing = wanted.iter().map(|rows| PageRows { blocks: atlas.missing(rows.page, rows.blocks), ..*rows });
            let (capacity, missing) = (atlas.capacity(), missing.filter(|rows| rows.blocks != 0).collect::<Vec<_>>());
            if missing.is_empty() {
                continue;
            }
            if part.rounds == MOST_ROUNDS {
                return Err(GpuError::Failed { reason: "pages stay missing after they were uploaded".into() }.into());
            }
            if wanted.len() > capacity {
                parts.extend(halves(&part.pixels).ok_or(GpuError::TooManyPages { needed: wanted.len(), capacity })?);
                frame.allowance_bytes = None;
                continue;
            }
            let brought = self.bring_allowed(&gpu, frame, &wanted, &missing)?;
            if brought == missing.len() {
                parts.push(Part { rounds: part.rounds + 1, ..part });
                continue;
            }
            self.shade(&gpu, new_encoder(&gpu), frame, part.pixels, Fidelity::StandIn);
            passes += 1;
            frame.is_final = false;
        }
        gpu.wait()?;
        frame.stats.passes = frame.stats.passes.max(passes);
        frame.stats.gpu_millis += millis_since(begin) - (frame.stats.pages_millis - pages_millis_before);
        self.read_band(frame)
    }

    // Look-ups are a band's first ones, and those of pages that it wanted only after it had others.
    fn count_wanted(&mut self, frame: &mut FrameInProgress<'_, '_>, wanted: &[PageRows], is_first: bool) {
        let atlas = &mut self.atlas.as_mut().expect("made before").atlas;
        for PageRows { page, blocks } in wanted {
            let is_new = !std::mem::replace(&mut frame.wanted[*page as usize], true);
            frame.wanted_count += usize::from(is_new);
            if is_first || is_new {
                atlas.look_up(*page, *blocks);
            }
        }
    }

    // Submits what is recorded, shading after it, and the copies that results leave by.
    fn shade(
        &mut self,
        gpu: &Gpu,
        mut encoder: wgpu::CommandEncoder,
        frame: &FrameInProgress<'_, '_>,
        pixels: Range<u32>,
        fidelity: Fidelity,
    ) {
        self.record_shading(&mut encoder, frame.settings, pixels, fidelity, 1);
        FrameOutput::copy(frame.request.outputs, &mut encoder, self.band.as_ref().expect("made before"));
        gpu.queue().submit([encoder.finish()]);
    }

    // A pixel stands for `pixel_scale` of the frame's along each axis.
    pub(super) fn record_shading(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        settings: &Settings,
        pixels: Range<u32>,
        fidelity: Fidelity,
        pixel_scale: u32,
    ) {
        let key = self.pipeline(settings, fidelity == Fidelity::StandIn);
        let (coarse, shape) = self.atlas.as_ref().map(|bound| (bound.coarse, bound.shape)).expect("made before");
        self.stamp = self.stamp.wrapping_add(1).max(1);
        let gloss = super::gloss(settings.component);
        let numbers = gloss.and_then(|gloss| match gloss.brdf {
            GlossBrdf::Analytic(brdf) => Some(brdf.uniform()),
            GlossBrdf::Measured(_) => self.table.uniform(),
        });
        if let Some(numbers) = numbers {
            self.gpu.queue().write_buffer(&self.gloss, 0, bytemuck::bytes_of(&numbers));
        }
        self.write_light(settings);
        let refraction = match settings.component {
            Component::Refraction(dielectric) => Some(dielectric),
            Component::Reconstruction | Component::Mirror | Component::Full | Component::Glossy(_) => None,
        };
        let uniform = ShadingUniform {
            specular_reflectance: if gloss.is_some() || refraction.is_some() { [1.0; 3] } else { settings.specular_reflectance.into() },
            exponent: exponent(settings.blend),
            face_size: self.field.parameters.face_size_texels,
            map_size: self.field.sample_maps.size as u32,
            baseline_cube: self.field.sample_points.len() as u32,
            stamp: self.stamp,
            coarse_level: coarse.level,
            coarsest_level: self.field.parameters.coarser_levels,
            face_count: self.field.face_count() as u32,
            first_pixel: pixels.start,
            end_pixel: pixels.end,
            pixel_scale: pixel_scale as f32,
            directions: gloss.map_or(0, |gloss| gloss.directions),
            block_shift: shape.block_rows.trailing_zeros(),
            first_direction: gloss.map_or(0, |gloss| gloss.first_direction()),
            refraction_index: refraction.map_or(1.0, |dielectric| dielectric.index()),
            first_packet: self.tree.first_packet(),
            reflections: settings.reflections,
            normal_map_size: self.normal_map.size(),
            normal_strength: settings.bumps.map_or(0.0, |bumps| bumps.mapping.strength),
            normal_repeat: settings.bumps.map_or(1.0, |bumps| bumps.mapping.repeat),
        };
        self.gpu.queue().write_buffer(&self.shading, 0, bytemuck::bytes_of(&uniform));
        let (band, atlas) = (self.band.as_ref().expect("made before"), self.atlas.as_ref().expect("made before"));
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_bind_group(0, &band.resources, &[]);
        pass.set_bind_group(1, &atlas.resources, &[]);
        pass.set_bind_group(2, &atlas.views, &[]);
        pass.set_pipeline(&self.pipelines[&key]);
        band.band.dispatch_over_object(&mut pass);
        drop(pass);
        let pages = self.touched_read_back.buffer();
        encoder.copy_buffer_to_buffer(&self.touched, 0, pages, 0, self.touched.size());
    }

    // Waits for the pass; which rows of which pages it wanted.
    pub(super) fn wanted_pages(&self, gpu: &Gpu) -> Result<Vec<PageRows>, GpuError> {
        let (stamp, blocks) = (self.stamp, self.atlas.as_ref().map_or(1, |bound| bound.shape.blocks()));
        let words = 4 * self.field.face_count() as u64 * u64::from(blocks);
        self.touched_read_back.request(0..words).finish(gpu, |bytes| {
            let blocks_of = |stamps: &[u8]| {
                let is_set = stamps.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) == stamp);
                is_set.enumerate().fold(0, |blocks, (block, set)| blocks | u32::from(set) << block)
            };
            let pages = bytes.chunks_exact(4 * blocks as usize).enumerate();
            pages.map(|(page, stamps)| PageRows { page: page as u32, blocks: blocks_of(stamps) }).filter(|rows| rows.blocks != 0).collect()
        })
    }

    // As many of the missing pages as the frame may still upload; all of them where it is to be whole. How many.
    fn bring_allowed(
        &mut self,
        gpu: &Gpu,
        frame: &mut FrameInProgress<'_, '_>,
        wanted: &[PageRows],
        missing: &[PageRows],
    ) -> Result<usize, RenderError> {
        let begin = Instant::now();
        let bound = self.atlas.as_ref().expect("made before");
        let missing = &rows_to_bring(bound, wanted, missing, frame.allowance_bytes);
        let affordable = match &mut frame.allowance_bytes {
            None => missing.len(),
            // Whatever is allowed at all is enough for a page's, so that refining ends.
            Some(left) => {
                missing.iter().take_while(|rows| std::mem::replace(left, left.saturating_sub(bound.bytes_of(rows.blocks))) > 0).count()
            }
        };
        // What earlier bands wanted stays, too, while there is room for all: the next frame wants it again.
        let keep_all = frame.wanted_count <= bound.atlas.capacity();
        let mut keep = if keep_all { frame.wanted.clone() } else { vec![false; frame.wanted.len()] };
        wanted.iter().for_each(|rows| keep[rows.page as usize] = true);
        self.bring(gpu, frame.pages, &missing[..affordable], &|page| keep[page as usize])?;
        frame.stats.pages_uploaded += affordable;
        frame.stats.pages_millis += millis_since(begin);
        Ok(affordable)
    }

    // Fetches and uploads.
    fn bring(
        &mut self,
        gpu: &Gpu,
        pages: &CountingSource<'_>,
        missing: &[PageRows],
        keep: &dyn Fn(u32) -> bool,
    ) -> Result<(), RenderError> {
        let field = &self.field;
        let bound = self.atlas.as_mut().expect("made before");
        let (shape, levels) = (bound.shape, bound.coarse.levels_before());
        let fetch = |rows: &PageRows| {
            let PageRows { page, blocks } = *rows;
            let fetched = pages.page(PageId(page))?;
            field.check_page(page, fetched.shape())?;
            Ok(Upload { page, blocks, levels: with_levels_of_a_face(conform(fetched, shape)?, levels)? })
        };
        // In batches, so that pages in flight do not fill memory: the source's cache may be small.
        for batch in missing.chunks(PAGES_IN_FLIGHT) {
            let fetched: Vec<Upload> = batch.par_iter().map(fetch).collect::<Result<_, RenderError>>()?;
            bound.atlas.upload(gpu, &fetched, keep)?;
        }
        Ok(())
    }

    fn read_band(&mut self, frame: &mut FrameInProgress<'_, '_>) -> Result<(), RenderError> {
        let begin = Instant::now();
        frame.output.read(&self.gpu, self.band.as_mut().expect("made before"))?;
        frame.stats.read_back_millis += millis_since(begin);
        Ok(())
    }
}

// The rest of the pages, too, where few are missing and all of it is allowed: the next frames of a viewer who moves want other rows of them,
// and a page is prepared as a whole. Where much is missing, what is wanted comes first.
fn rows_to_bring(bound: &BoundAtlas, wanted: &[PageRows], missing: &[PageRows], allowance_bytes: Option<u64>) -> Vec<PageRows> {
    let all = bound.shape.all_blocks();
    let whole = missing.iter().map(|rows| PageRows { blocks: bound.atlas.missing(rows.page, all), ..*rows }).collect::<Vec<_>>();
    let bytes = whole.iter().map(|rows| bound.bytes_of(rows.blocks)).sum::<u64>();
    let are_few = missing.len() as u64 * FEW_OF <= wanted.len() as u64;
    if are_few && allowance_bytes.is_none_or(|left| bytes <= left) { whole } else { missing.to_vec() }
}

// Work of one submission: drivers give up on a device that does not answer for seconds.
fn in_ranges(pixels: u32, settings: &Settings) -> Vec<Part> {
    let directions = super::gloss(settings.component).map_or(1, |gloss| gloss.looks());
    let step = (MOST_DIRECTIONS_AT_ONCE / directions).max(1);
    (0..pixels).step_by(step as usize).map(|first| Part { pixels: first..pixels.min(first.saturating_add(step)), rounds: 0 }).collect()
}

// Two parts of fewer pixels; None where there is only one.
fn halves(pixels: &Range<u32>) -> Option<[Part; 2]> {
    let middle = pixels.start + pixels.len() as u32 / 2;
    let part = |pixels| Part { pixels, rounds: 0 };
    (middle > pixels.start).then(|| [part(middle..pixels.end), part(pixels.start..middle)])
}

fn exponent(blend: Blend) -> f32 {
    match blend {
        Blend::Reflection { exponent } | Blend::Normal { exponent } => exponent,
        Blend::Corrected => OWN_EXPONENT,
        Blend::Distance | Blend::Angle | Blend::Average | Blend::EnvironmentMap => 0.0,
    }
}

pub(super) fn new_encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") })
}

fn millis_since(begin: Instant) -> f64 {
    1e3 * begin.elapsed().as_secs_f64()
}
