//! Cube maps traced at many points, stored page by page, so that a killed capture goes on where it was.

use glam::Vec3;
use rayon::prelude::*;
use thiserror::Error;

use super::levels::{coarser_levels, halved, stacked, with_sky_shares};
use crate::directions::{CubeMap, FACES};
use crate::progress::{Cancelled, Progress, Silent};
use crate::raytrace::{TraceSettings, Tracer};
use crate::textures::{Codec, EncodedPage, Page, PageId, PageShape, PixelFormat, Staging, StoreError, encode_as};

/// Where a cube map is taken, and in which scene.
#[derive(Clone, Copy)]
pub struct Viewpoint<'a> {
    /// The scene as this cube map sees it.
    pub tracer: &'a Tracer,
    /// World space.
    pub position: Vec3,
}

/// Why a capture ended early. What was stored by then stays in the staging area.
#[derive(Debug, Error)]
pub enum CaptureError {
    /// Asked to stop; can be resumed.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// A page could not be stored.
    #[error(transparent)]
    Store(#[from] StoreError),
}

// Cube maps traced side by side: enough to keep the threads busy while one is encoded, few enough to lose little when killed.
const BATCH: usize = 8;

/// Traces viewpoint k of n into the pages of cube map k, as [`store_cube_maps`] has them. Each cube map has its own seed, derived from
/// `settings.seed` and k.
pub fn trace_cube_maps(
    viewpoints: &[Viewpoint<'_>],
    face_size: u32,
    format: (Codec, PixelFormat),
    settings: &TraceSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<(), CaptureError> {
    let trace = |k: usize| {
        let seeded = TraceSettings { seed: settings.seed.wrapping_add((k as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)), ..*settings };
        let Viewpoint { tracer, position } = viewpoints[k];
        Ok(tracer.cube_map(position, face_size as usize, &seeded, &Silent(progress))?)
    };
    store_cube_maps(viewpoints.len(), face_size, format, &trace, staging, ("tracing cube maps", progress))
}

/// Stores what `make` gives for k of `count` in pages 6·k … 6·k + 5: R, G, B (mean over the texel) and distance, `face_size` texels an edge; and
/// in page 6·count + (l − 1)·count + k its faces of each coarser level l = 1 … [`coarser_levels`], below each other: R, G, B and the share of the
/// texel through which light comes from infinity.
///
/// Pages that `staging` holds already are not made again, and pages are appended in order: where `make` gives the same for the same k, the same job
/// gives the same bytes for any number of threads, interrupted or not. `stage` is what progress is told of.
pub fn store_cube_maps<E: From<CaptureError> + Send>(
    count: usize,
    face_size: u32,
    (codec, pixel): (Codec, PixelFormat),
    make: &(dyn Fn(usize) -> Result<CubeMap, E> + Sync),
    staging: &Staging,
    (stage, progress): (&str, &dyn Progress),
) -> Result<(), E> {
    let shape = PageShape { width: face_size, height: face_size, channels: 4, pixel };
    let levels = coarser_levels(face_size) as usize;
    let present = staging.pages_present();
    // Of a cube map's pages in order: its faces, then its levels.
    let page = |k: usize, part: usize| match part.checked_sub(FACES) {
        None => PageId((FACES * k + part) as u32),
        Some(level) => PageId(((FACES + level) * count + k) as u32),
    };
    let missing: Vec<usize> = (0..count).filter(|k| (0..FACES + levels).any(|p| !present.contains(&page(*k, p)))).collect();
    let mut done = count - missing.len();
    for batch in missing.chunks(BATCH) {
        progress.report(stage, done as u64, count as u64);
        let made: Result<Vec<Vec<EncodedPage>>, E> =
            batch.par_iter().map(|k| Ok(encode_cube_map(&make(*k)?, codec, shape, levels)?)).collect();
        for (k, parts) in batch.iter().zip(made?) {
            for (part, encoded) in parts.iter().enumerate().filter(|(p, _)| !present.contains(&page(*k, *p))) {
                staging.append_encoded(page(*k, part), encoded).map_err(CaptureError::from)?;
            }
        }
        done += batch.len();
    }
    progress.report(stage, done as u64, count as u64);
    Ok(())
}

// Faces, then levels.
fn encode_cube_map(map: &CubeMap, codec: Codec, shape: PageShape, levels: usize) -> Result<Vec<EncodedPage>, CaptureError> {
    let faces = map.texels.chunks(map.size * map.size).map(<[_]>::as_flattened);
    let mut pages = faces.clone().map(|face| encode_as(codec, &shape, face)).collect::<Result<Vec<_>, _>>()?;
    let mut finer = faces.map(|face| with_sky_shares(&Page::from_f32(shape, face)?)).collect::<Result<Vec<_>, _>>()?;
    for _ in 0..levels {
        finer = finer.iter().map(|face| halved(face, 4)).collect::<Result<_, _>>()?;
        let level = stacked(&finer)?;
        pages.push(encode_as(codec, &level.shape(), &level.to_f32())?);
    }
    Ok(pages)
}
