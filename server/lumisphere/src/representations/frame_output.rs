//! A frame's pixels from the device, band by band, in the layout of `band.wgsl`'s output: R, G, B of each pixel; then all distances; then
//! provenance.

use std::mem;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Instant;

use bytemuck::Pod;

use super::g_buffer::{BAND_BYTES_PER_PIXEL, Band, OUTPUT_WORDS, Rasterizer};
use super::pending_pixels::{PendingPixels, Rows};
use super::{FrameRequest, Outputs};
use crate::geometry::Camera;
use crate::gpu::{Gpu, GpuError, ReadBackPair, Shader};

/// A band has at most this many pixels: 42 MiB on the device with everything that grows with it.
pub(crate) const MAX_BAND_PIXELS: u32 = 1 << 19;
/// Of a band, with two copies of the output, which are read back in turn.
pub(crate) const BYTES_PER_PIXEL: u64 = BAND_BYTES_PER_PIXEL + 2 * 4 * OUTPUT_WORDS;
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
    pub read_back: ReadBackPair,
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
        // The copy of its last pixels holds the buffer that they lie in.
        gpu.settle();
        *slot = None;
        let band = rasterizer.band(gpu, width, rows);
        let resources = rasterizer.bind_band(gpu, shader, &band);
        let read_back = ReadBackPair::new(gpu, "output", band.output().size());
        gpu.check()?;
        *slot = Some(Self { band, resources, read_back });
        Ok(())
    }
}

/// A frame's rows, band by band: each is copied out of the device's buffer while the device draws the next, or the next frame.
pub(crate) struct FrameOutput {
    outputs: Outputs,
    rows: Arc<Mutex<Rows>>,
}

impl FrameOutput {
    /// No rows yet.
    pub fn new(request: &FrameRequest<'_>) -> Self {
        let intrinsics = request.camera.intrinsics();
        let pixels = intrinsics.width_px as usize * intrinsics.height_px as usize;
        let rows = Rows { color: Vec::with_capacity(3 * pixels), ..Rows::default() };
        Self { outputs: request.outputs, rows: Arc::new(Mutex::new(rows)) }
    }

    /// Records the copy of what was asked for of a band that is done.
    pub fn copy(outputs: Outputs, encoder: &mut wgpu::CommandEncoder, bound: &BoundBand) {
        let (band, read_back) = (&bound.band, bound.read_back.next());
        for range in wanted_ranges(band.pixels(), outputs) {
            encoder.copy_buffer_to_buffer(band.output(), range.start, read_back.buffer(), range.start, range.end - range.start);
        }
    }

    /// Waits for a band that was copied; appends it when the device is next waited for.
    pub fn read(&self, gpu: &Gpu, bound: &mut BoundBand) -> Result<(), GpuError> {
        let (outputs, pixels) = (self.outputs, bound.band.pixels() as usize);
        let last = wanted_ranges(bound.band.pixels(), outputs).last().map_or(0, |r| r.end);
        let range = 0..last.next_multiple_of(wgpu::MAP_ALIGNMENT).min(bound.read_back.next().bytes());
        let mapped = bound.read_back.next().request(range).arrive(gpu)?;
        bound.read_back.turn();
        let rows = self.rows.clone();
        gpu.meanwhile(move || rows.lock().unwrap_or_else(PoisonError::into_inner).append(mapped.bytes(), pixels, outputs));
        Ok(())
    }

    /// The frame, after its last band.
    pub fn into_pixels(self, gpu: &Gpu, pages_needed: usize, is_final: bool) -> PendingPixels {
        let (sender, rows) = mpsc::channel();
        // A receiver that is gone wants no pixels.
        gpu.meanwhile(move || drop(sender.send(mem::take(&mut *self.rows.lock().unwrap_or_else(PoisonError::into_inner)))));
        PendingPixels::coming(rows, self.outputs, pages_needed, is_final)
    }
}

impl Rows {
    fn append(&mut self, bytes: &[u8], pixels: usize, outputs: Outputs) {
        let begin = Instant::now();
        extend_from_bytes(&mut self.color, &bytes[..12 * pixels]);
        if outputs.depth {
            extend_from_bytes(&mut self.depth, &bytes[12 * pixels..16 * pixels]);
        }
        if outputs.provenance {
            extend_from_bytes(&mut self.provenance, &bytes[16 * pixels..20 * pixels]);
        }
        self.copying_millis += 1e3 * begin.elapsed().as_secs_f64();
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
