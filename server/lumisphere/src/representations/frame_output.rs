//! A frame's pixels from the device, band by band, in the layout of `band.wgsl`'s output: R, G, B of each pixel; then all distances; then
//! provenance.

use std::ops::Range;

use bytemuck::Pod;

use super::g_buffer::{BAND_BYTES_PER_PIXEL, Band, OUTPUT_WORDS, Rasterizer};
use super::{FrameRequest, Outputs, Pixels, Provenance};
use crate::geometry::Camera;
use crate::gpu::{Gpu, GpuError, ReadBack, Shader};

/// A band has at most this many pixels: 32 MiB on the device with everything that grows with it.
pub(crate) const MAX_BAND_PIXELS: u32 = 1 << 19;
/// Of a band, with the copy of the output that is read back.
pub(crate) const BYTES_PER_PIXEL: u64 = BAND_BYTES_PER_PIXEL + 4 * OUTPUT_WORDS;
/// Of the largest band.
pub(crate) const BAND_BYTES: u64 = MAX_BAND_PIXELS as u64 * BYTES_PER_PIXEL;

/// First row and number of rows of each band of a frame.
pub(crate) fn bands(gpu: &Gpu, camera: &Camera) -> Result<impl Iterator<Item = (u32, u32)> + use<>, GpuError> {
    let (width, height) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
    let limit = gpu.device().limits().max_texture_dimension_2d.min(MAX_BAND_PIXELS);
    if width > limit {
        let what = "width of the frame in pixels";
        return Err(GpuError::BeyondLimit { what, needed: u64::from(width), limit: u64::from(limit) });
    }
    let rows = (MAX_BAND_PIXELS / width).min(limit).min(height);
    Ok((0..height).step_by(rows as usize).map(move |first| (first, rows.min(height - first))))
}

/// What a band of one size needs.
pub(crate) struct BoundBand {
    pub band: Band,
    pub resources: wgpu::BindGroup,
    pub read_back: ReadBack,
}

impl BoundBand {
    /// Leaves `slot` with a band of that size; the one before, of another size, goes first, so that both are never held at once.
    pub fn ensure(
        slot: &mut Option<Self>,
        gpu: &Gpu,
        (rasterizer, shader): (&Rasterizer, &Shader),
        (width, rows): (u32, u32),
    ) -> Result<(), GpuError> {
        if slot.as_ref().is_some_and(|b| (b.band.width, b.band.rows) == (width, rows)) {
            return Ok(());
        }
        *slot = None;
        let band = rasterizer.band(gpu, width, rows);
        let resources = rasterizer.bind_band(gpu, shader, &band);
        let read_back = ReadBack::new(gpu, "output", band.output().size());
        gpu.check()?;
        *slot = Some(Self { band, resources, read_back });
        Ok(())
    }
}

/// The rows that have been read so far.
pub(crate) struct FrameOutput {
    outputs: Outputs,
    color: Vec<f32>,
    depth: Vec<f32>,
    provenance: Vec<Provenance>,
}

impl FrameOutput {
    /// No rows yet.
    pub fn new(request: &FrameRequest<'_>) -> Self {
        let intrinsics = request.camera.intrinsics();
        let pixels = intrinsics.width_px as usize * intrinsics.height_px as usize;
        let (color, depth, provenance) = (Vec::with_capacity(3 * pixels), Vec::new(), Vec::new());
        Self { outputs: request.outputs, color, depth, provenance }
    }

    /// Records the copy of what was asked for of a band that is done.
    pub fn copy(outputs: Outputs, encoder: &mut wgpu::CommandEncoder, band: &Band, read_back: &ReadBack) {
        for range in wanted_ranges(band.pixels(), outputs) {
            encoder.copy_buffer_to_buffer(band.output(), range.start, read_back.buffer(), range.start, range.end - range.start);
        }
    }

    /// Waits for a band that was copied, and appends it.
    pub fn read(&mut self, gpu: &Gpu, band: &Band, read_back: &ReadBack) -> Result<(), GpuError> {
        let pixels = band.pixels() as usize;
        let last = wanted_ranges(band.pixels(), self.outputs).last().map_or(0, |r| r.end);
        let range = 0..last.next_multiple_of(wgpu::MAP_ALIGNMENT).min(read_back.bytes());
        read_back.request(range).finish(gpu, |bytes| {
            // Mapped memory is aligned to 8 bytes; extend_from_bytes does not depend on it.
            extend_from_bytes(&mut self.color, &bytes[..12 * pixels]);
            if self.outputs.depth {
                extend_from_bytes(&mut self.depth, &bytes[12 * pixels..16 * pixels]);
            }
            if self.outputs.provenance {
                extend_from_bytes(&mut self.provenance, &bytes[16 * pixels..20 * pixels]);
            }
        })
    }

    /// The frame.
    pub fn into_pixels(self, pages_needed: usize, is_final: bool) -> Pixels {
        let depth = self.outputs.depth.then_some(self.depth);
        let provenance = self.outputs.provenance.then_some(self.provenance);
        Pixels { color: self.color, depth, provenance, pages_needed, is_final }
    }
}

// Colour, and what else was asked for, as byte ranges of the output; neighbours are merged.
fn wanted_ranges(pixels: u32, outputs: Outputs) -> impl Iterator<Item = Range<u64>> {
    let n = 4 * u64::from(pixels);
    let (first, second) = match (outputs.depth, outputs.provenance) {
        (false, false) => (0..3 * n, 0..0),
        (true, false) => (0..4 * n, 0..0),
        (true, true) => (0..5 * n, 0..0),
        (false, true) => (0..3 * n, 4 * n..5 * n),
    };
    [first, second].into_iter().filter(|r| !r.is_empty())
}

fn extend_from_bytes<T: Pod>(out: &mut Vec<T>, bytes: &[u8]) {
    match bytemuck::try_cast_slice(bytes) {
        Ok(values) => out.extend_from_slice(values),
        Err(_) => out.extend(bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned::<T>)),
    }
}
