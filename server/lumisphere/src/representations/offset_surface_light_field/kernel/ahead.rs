//! Pages brought before the frame that wants them: a look at the frame to come tells which, without reading any; whoever has read them
//! hands them in. Both are bounded work, between which frames are drawn.

use std::sync::Arc;

use rayon::prelude::*;

use super::super::Settings;
use super::super::coarse::with_levels_of_a_face;
use super::frame::{Fidelity, MOST_DIRECTIONS_AT_ONCE, new_encoder};
use super::{Kernel, gloss};
use crate::geometry::{Camera, Intrinsics};
use crate::gpu::{Upload, conform};
use crate::representations::frame_output::MAX_BAND_PIXELS;
use crate::representations::{FrameRequest, RenderError, Settings as AnySettings};
use crate::textures::{Page, PageId};

impl Kernel {
    /// Pages that a frame like `request` would miss, at most `upload_bytes` of texels and no more than there are slots that neither the last
    /// frame nor this one wants. Looks at the object alone, whatever stands before it, and at large frames with fewer pixels. None before
    /// the first frame, and of clear bodies, other light, a measured BRDF or a normal map before the first of those.
    pub(super) fn pages_ahead(&mut self, request: &FrameRequest<'_>, upload_bytes: u64) -> Result<Vec<PageId>, RenderError> {
        let AnySettings::OffsetSurfaceLightField(settings) = request.settings else {
            return Err(RenderError::OtherKind { settings: request.settings.kind() });
        };
        let has_tree = !settings.needs_tree() || self.tree.is_made();
        if self.atlas.is_none()
            || !has_tree
            || !self.is_light_made(settings)
            || !self.is_table_there(settings)
            || !self.is_normal_map_there(settings)
        {
            return Ok(Vec::new());
        }
        let scale = scale(request.camera, settings, self.gpu.device().limits().max_texture_dimension_2d);
        let Some(camera) = scaled_down(request.camera, scale) else { return Ok(Vec::new()) };
        let (width, rows) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
        self.ensure_band(width, rows)?;
        let gpu = self.gpu.clone();
        let mut encoder = new_encoder(&gpu);
        self.rasterizer.draw_object(&gpu, &mut encoder, &camera, &self.band.as_ref().expect("made above").band)?;
        self.record_shading(&mut encoder, settings, 0..width * rows, Fidelity::Exact, scale);
        gpu.queue().submit([encoder.finish()]);
        let wanted = self.wanted_pages(&gpu)?;
        self.expected.fill(false);
        wanted.iter().for_each(|rows| self.expected[rows.page as usize] = true);
        let bound = self.atlas.as_ref().expect("looked at above");
        // They come whole: what moves on wants other rows soon.
        let affordable = (upload_bytes / bound.bytes_of(bound.shape.all_blocks())) as usize;
        let (missing, mut room) = (wanted.into_iter().filter(|rows| bound.atlas.missing(rows.page, rows.blocks) != 0), self.slots_ahead());
        let fits = missing.map(|rows| rows.page).filter(|page| bound.atlas.is_resident(*page) || take_one(&mut room));
        Ok(fits.take(affordable).map(PageId).collect())
    }

    /// Uploads `pages`, as far as neither what the last frame showed nor what the last look ahead expects has to leave for them; how many.
    pub(super) fn take_ahead(&mut self, pages: &[(PageId, Arc<Page>)]) -> Result<usize, RenderError> {
        // Another viewer's look may have forgotten them since; none may leave for another of them.
        for (page, _) in pages {
            if let Some(is_expected) = self.expected.get_mut(page.0 as usize) {
                *is_expected = true;
            }
        }
        let mut room = self.slots_ahead();
        let Some(bound) = &mut self.atlas else { return Ok(0) };
        let (field, atlas) = (&self.field, &mut bound.atlas);
        let (shape, levels) = (bound.shape, bound.coarse.levels_before());
        let mut fresh: Vec<(u32, u32, &Arc<Page>)> = Vec::new();
        for (page, image) in pages.iter().filter(|(page, _)| (page.0 as usize) < field.face_count()) {
            let blocks = atlas.missing(page.0, shape.all_blocks());
            if blocks != 0 && (atlas.is_resident(page.0) || take_one(&mut room)) {
                fresh.push((page.0, blocks, image));
            }
        }
        let prepared = fresh.into_par_iter().map(|(page, blocks, image)| {
            field.check_page(page, image.shape())?;
            Ok(Upload { page, blocks, levels: with_levels_of_a_face(conform(image.clone(), shape)?, levels)? })
        });
        let prepared: Vec<Upload> = prepared.collect::<Result<_, RenderError>>()?;
        let (shown, expected) = (&self.last_wanted, &self.expected);
        atlas.upload(&self.gpu, &prepared, &|page| shown[page as usize] || expected[page as usize])?;
        prepared.iter().for_each(|upload| atlas.note_ahead(upload));
        Ok(prepared.len())
    }

    // Free ones, and those of pages that nobody is known to want.
    fn slots_ahead(&self) -> usize {
        let Some(bound) = &self.atlas else { return 0 };
        let is_kept = |page: u32| self.last_wanted[page as usize] || self.expected[page as usize];
        let kept = (0..bound.shape.page_count as u32).filter(|page| is_kept(*page) && bound.atlas.is_resident(*page));
        bound.atlas.capacity() - kept.count()
    }
}

fn take_one(room: &mut usize) -> bool {
    let is_left = *room > 0;
    *room = room.saturating_sub(1);
    is_left
}

// The least at which a frame fits a band, in one submission, no side longer than `longest`.
fn scale(camera: &Camera, settings: &Settings, longest: u32) -> u32 {
    let directions = gloss(settings.component).map_or(1, |gloss| gloss.looks());
    let most = u64::from(MAX_BAND_PIXELS.min(MOST_DIRECTIONS_AT_ONCE / directions).max(1));
    let Intrinsics { width_px, height_px, .. } = *camera.intrinsics();
    let fits = |scale: &u32| {
        let (width, height) = (width_px.div_ceil(*scale), height_px.div_ceil(*scale));
        width.max(height) <= longest && u64::from(width) * u64::from(height) <= most
    };
    (1..).find(fits).expect("one pixel is within any limit")
}

// The same view with fewer pixels; None where the focal length, next to zero, becomes it.
fn scaled_down(camera: &Camera, scale: u32) -> Option<Camera> {
    let Intrinsics { width_px, height_px, focal_px, center_px } = *camera.intrinsics();
    let (width, height) = (width_px.div_ceil(scale), height_px.div_ceil(scale));
    let shrink = glam::Vec2::new(width as f32 / width_px as f32, height as f32 / height_px as f32);
    let small = Intrinsics { width_px: width, height_px: height, focal_px: focal_px * shrink, center_px: center_px * shrink };
    Camera::new(small, *camera.pose()).ok()
}
