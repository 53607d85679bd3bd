//! A frame on the CPU, pixel by pixel in 16×16 buckets: neighbours read the same pages.

use glam::Vec3;
use rayon::prelude::*;

use super::{FrameRequest, Pixels, Provenance, RenderError};

/// Pixels along a bucket's edge: 6 to 11 times fewer cache misses than scanlines (methods page 1's cache experiments, ours).
pub(super) const BUCKET_PX: usize = 16;

/// One finished pixel: radiance and distance without NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PixelResult {
    pub radiance: Vec3,
    pub distance: f32,
    pub provenance: Provenance,
}

impl PixelResult {
    /// Radiance that is not finite becomes black and unknown; a distance that is NaN becomes infinite.
    pub fn checked(radiance: Vec3, distance: f32, provenance: Provenance) -> Self {
        let distance = if distance.is_nan() { f32::INFINITY } else { distance };
        if radiance.is_finite() {
            return Self { radiance, distance, provenance };
        }
        Self { radiance: Vec3::ZERO, distance, provenance: Provenance::UNKNOWN }
    }
}

/// Calls `pixel(thread's state, i, j)` for every pixel, on all of rayon's threads. The first error ends the frame.
pub(crate) fn render_in_buckets<S>(
    request: &FrameRequest<'_>,
    start: impl Fn() -> S + Sync + Send,
    pixel: impl Fn(&mut S, u32, u32) -> Result<PixelResult, RenderError> + Sync,
) -> Result<Pixels, RenderError> {
    let (width, height) = (request.camera.intrinsics().width_px as usize, request.camera.intrinsics().height_px as usize);
    let band = width * BUCKET_PX;
    let mut color = vec![0f32; 3 * width * height];
    let mut depth = vec![0f32; width * height];
    let mut provenance = vec![Provenance::UNKNOWN; width * height];
    let bands = color.par_chunks_mut(3 * band).zip(depth.par_chunks_mut(band)).zip(provenance.par_chunks_mut(band));
    bands.enumerate().try_for_each_init(start, |state, (row, ((color, depth), provenance))| {
        let rows = depth.len() / width;
        for left in (0..width).step_by(BUCKET_PX) {
            for at in (0..rows).flat_map(|j| (left..width.min(left + BUCKET_PX)).map(move |i| j * width + i)) {
                let result = pixel(state, (at % width) as u32, (row * BUCKET_PX + at / width) as u32)?;
                color[3 * at..3 * at + 3].copy_from_slice(&result.radiance.to_array());
                depth[at] = result.distance;
                provenance[at] = result.provenance;
            }
        }
        Ok::<_, RenderError>(())
    })?;
    let depth = request.outputs.depth.then_some(depth);
    let provenance = request.outputs.provenance.then_some(provenance);
    Ok(Pixels { color, depth, provenance, pages_needed: 0, is_final: true })
}
