//! Cube maps traced at many points, stored page by page, so that a killed capture goes on where it was.

use glam::Vec3;
use rayon::prelude::*;
use thiserror::Error;

use crate::directions::{CubeMap, FACES};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{TraceSettings, Tracer};
use crate::textures::{EncodedPage, PageId, PageShape, PixelFormat, Staging, StoreError, encode};

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

/// Traces viewpoint k of n into pages 6·k … 6·k + 5: R, G, B (mean over the texel) and distance, `face_size` texels an edge; and into
/// page 6·n + k the same faces below each other, shrunk to `coarse_size` texels an edge, R, G, B.
///
/// Pages that `staging` holds already are not traced again. Each cube map has its own seed, derived from `settings.seed` and k, and
/// pages are appended in order: the same job gives the same bytes for any number of threads, interrupted or not.
pub fn trace_cube_maps(
    viewpoints: &[Viewpoint<'_>],
    [face_size, coarse_size]: [u32; 2],
    pixel: PixelFormat,
    settings: &TraceSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<(), CaptureError> {
    let shape = PageShape { width: face_size, height: face_size, channels: 4, pixel };
    let coarse_shape = PageShape { width: coarse_size, height: FACES as u32 * coarse_size, channels: 3, pixel };
    let present = staging.pages_present();
    // Face 6 is all of them, coarsely.
    let page = |k: usize, face: usize| if face < FACES { FACES * k + face } else { FACES * viewpoints.len() + k };
    let page = |k: usize, face: usize| PageId(page(k, face) as u32);
    let missing: Vec<usize> = (0..viewpoints.len()).filter(|k| (0..=FACES).any(|f| !present.contains(&page(*k, f)))).collect();
    let mut done = viewpoints.len() - missing.len();
    for batch in missing.chunks(BATCH) {
        progress.report("tracing cube maps", done as u64, viewpoints.len() as u64);
        let traced: Result<Vec<Vec<EncodedPage>>, CaptureError> = batch
            .par_iter()
            .map(|k| {
                let seeded =
                    TraceSettings { seed: settings.seed.wrapping_add((*k as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)), ..*settings };
                let Viewpoint { tracer, position } = viewpoints[*k];
                let map = tracer.cube_map(position, face_size as usize, &seeded, &Silent(progress))?;
                let mut pages = encode_faces(&map, &shape)?;
                pages.push(encode(&coarse_shape, shrunk_faces(&map, coarse_size as usize).as_flattened())?);
                Ok(pages)
            })
            .collect();
        for (k, faces) in batch.iter().zip(traced?) {
            for (face, encoded) in faces.iter().enumerate().filter(|(f, _)| !present.contains(&page(*k, *f))) {
                staging.append_encoded(page(*k, face), encoded)?;
            }
        }
        done += batch.len();
    }
    progress.report("tracing cube maps", done as u64, viewpoints.len() as u64);
    Ok(())
}

/// The cube map's faces below each other, each `size` texels an edge: a texel is the mean of those it touches, NaN left out.
pub fn shrunk_faces(map: &CubeMap, size: usize) -> Vec<[f32; 3]> {
    let span = |at: usize| at * map.size / size..((at + 1) * map.size).div_ceil(size);
    let mean = |face: usize, row: usize, column: usize| {
        let texels = span(row).flat_map(|r| span(column).map(move |c| (face * map.size + r) * map.size + c));
        let colors = texels.map(|t| Vec3::new(map.texels[t][0], map.texels[t][1], map.texels[t][2])).filter(|c| c.is_finite());
        let (sum, count) = colors.fold((Vec3::ZERO, 0f32), |(sum, count), c| (sum + c, count + 1.0));
        (sum / count.max(1.0)).to_array()
    };
    (0..FACES * size * size).map(|t| mean(t / (size * size), t / size % size, t % size)).collect()
}

fn encode_faces(map: &CubeMap, shape: &PageShape) -> Result<Vec<EncodedPage>, CaptureError> {
    let texels = map.size * map.size;
    map.texels.chunks(texels).map(|face| Ok(encode(shape, face.as_flattened())?)).collect()
}

// Passes cancellation on and keeps the tracer's own tile counts to itself.
struct Silent<'a>(&'a dyn Progress);

impl Progress for Silent<'_> {
    fn report(&self, _what: &str, _done: u64, _total: u64) {}
    fn is_cancelled(&self) -> bool {
        self.0.is_cancelled()
    }
}
