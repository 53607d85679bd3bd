//! Results from the device's memory to ours.

use std::ops::Range;
use std::sync::mpsc;

use super::{Gpu, GpuError};

/// A buffer that commands copy into and the processor reads; reused from frame to frame.
#[derive(Debug)]
pub(crate) struct ReadBack {
    buffer: wgpu::Buffer,
}

/// Two of a size in turn: commands copy into one while what came into the other before is read.
#[derive(Debug)]
pub(crate) struct ReadBackPair {
    both: [ReadBack; 2],
    next: usize,
}

/// The copy is on its way.
#[must_use]
pub(crate) struct Pending {
    buffer: wgpu::Buffer,
    range: Range<u64>,
    mapped: mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
}

/// Bytes that have come. Commands may copy into the buffer again once it is dropped.
pub(crate) struct Mapped {
    buffer: wgpu::Buffer,
    // Goes before the buffer is given back.
    view: Option<wgpu::BufferView>,
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
    pub fn request(&self, range: Range<u64>) -> Pending {
        let (sender, mapped) = mpsc::channel();
        // A receiver that is gone no longer wants the answer.
        self.buffer.map_async(wgpu::MapMode::Read, range.clone(), move |outcome| drop(sender.send(outcome)));
        Pending { buffer: self.buffer.clone(), range, mapped }
    }
}

impl ReadBackPair {
    /// Of so many bytes each.
    pub fn new(gpu: &Gpu, label: &str, bytes: u64) -> Self {
        Self { both: std::array::from_fn(|_| ReadBack::new(gpu, label, bytes)), next: 0 }
    }

    /// To copy into.
    pub fn next(&self) -> &ReadBack {
        &self.both[self.next]
    }

    /// What is in it is being read: the other one from now on.
    pub fn turn(&mut self) {
        self.next = 1 - self.next;
    }
}

impl Pending {
    /// Waits, shows the bytes to `read`, and gives the buffer back.
    pub fn finish<R>(self, gpu: &Gpu, read: impl FnOnce(&[u8]) -> R) -> Result<R, GpuError> {
        Ok(read(self.arrive(gpu)?.bytes()))
    }

    /// Waits. What it returns may be read until the device is polled next, so in [`Gpu::meanwhile`].
    pub fn arrive(self, gpu: &Gpu) -> Result<Mapped, GpuError> {
        gpu.wait()?;
        let failed = |reason: String| GpuError::Failed { reason };
        self.mapped.try_recv().map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
        let view = self.buffer.get_mapped_range(self.range).map_err(|e| failed(e.to_string()))?;
        Ok(Mapped { buffer: self.buffer, view: Some(view) })
    }
}

impl Mapped {
    pub fn bytes(&self) -> &[u8] {
        self.view.as_deref().unwrap_or_default()
    }
}

impl Drop for Mapped {
    fn drop(&mut self) {
        self.view = None;
        self.buffer.unmap();
    }
}
