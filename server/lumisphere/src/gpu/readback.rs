//! Results from the device's memory to ours.

use std::ops::Range;
use std::sync::mpsc;

use super::{Gpu, GpuError};

/// A buffer that commands copy into and the processor reads; reused from frame to frame.
#[derive(Debug)]
pub(crate) struct ReadBack {
    buffer: wgpu::Buffer,
}

/// The copy is on its way: [`Pending::finish`] waits for it.
#[must_use]
pub(crate) struct Pending<'a> {
    buffer: &'a wgpu::Buffer,
    range: Range<u64>,
    mapped: mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
}

impl ReadBack {
    pub fn new(gpu: &Gpu, label: &str, bytes: u64) -> Self {
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let size = bytes.next_multiple_of(wgpu::MAP_ALIGNMENT);
        Self { buffer: gpu.device().create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false }) }
    }

    pub fn buffer(&self) -> &wgpu::Buffer {
        &self.buffer
    }

    pub fn bytes(&self) -> u64 {
        self.buffer.size()
    }

    /// Asks for `range` (multiples of 8) once the submitted commands are done.
    pub fn request(&self, range: Range<u64>) -> Pending<'_> {
        let (sender, mapped) = mpsc::channel();
        // A receiver that is gone no longer wants the answer.
        self.buffer.map_async(wgpu::MapMode::Read, range.clone(), move |outcome| drop(sender.send(outcome)));
        Pending { buffer: &self.buffer, range, mapped }
    }
}

impl Pending<'_> {
    /// Waits, shows the bytes to `read`, and gives the buffer back.
    pub fn finish<R>(self, gpu: &Gpu, read: impl FnOnce(&[u8]) -> R) -> Result<R, GpuError> {
        gpu.wait()?;
        let failed = |reason: String| GpuError::Failed { reason };
        self.mapped.try_recv().map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
        let view = self.buffer.get_mapped_range(self.range.clone()).map_err(|e| failed(e.to_string()))?;
        let result = read(&view);
        drop(view);
        self.buffer.unmap();
        Ok(result)
    }
}
