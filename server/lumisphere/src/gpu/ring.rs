//! The one way of pages into the device's memory: a buffer in two halves, one filled while the other is copied from.

use super::{Gpu, GpuError};

// Of a half; one page if a page is larger.
const HALF_BYTES: u64 = 4 << 20;

/// A ring for pages of one size.
pub(crate) struct UploadRing {
    halves: [Half; 2],
    page_bytes: u64,
    next: usize,
}

struct Half {
    buffer: wgpu::Buffer,
    // The copies out of it, until they are done.
    busy: Option<wgpu::SubmissionIndex>,
}

impl UploadRing {
    /// What a ring for pages of `page_bytes` takes.
    pub fn bytes_for(page_bytes: u64) -> u64 {
        2 * Self::pages_per_half(page_bytes) * page_bytes
    }

    pub fn new(gpu: &Gpu, page_bytes: u64) -> Self {
        let description = wgpu::BufferDescriptor {
            label: Some("upload ring"),
            size: Self::pages_per_half(page_bytes) * page_bytes,
            usage: wgpu::BufferUsages::MAP_WRITE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        };
        let half = || Half { buffer: gpu.device().create_buffer(&description), busy: None };
        Self { halves: [half(), half()], page_bytes, next: 0 }
    }

    fn pages_per_half(page_bytes: u64) -> u64 {
        (HALF_BYTES / page_bytes).max(1)
    }

    /// At most so many pages go into one [`UploadRing::send`].
    pub fn pages_at_once(&self) -> usize {
        Self::pages_per_half(self.page_bytes) as usize
    }

    /// `fill(k, place)` writes page k of `count`; `copy(encoder, buffer, k, offset)` records its copy. Returns before the copies are done.
    pub fn send(
        &mut self,
        gpu: &Gpu,
        count: usize,
        mut fill: impl FnMut(usize, wgpu::WriteOnly<'_, [u8]>),
        mut copy: impl FnMut(&mut wgpu::CommandEncoder, &wgpu::Buffer, usize, u64),
    ) -> Result<(), GpuError> {
        assert!(count <= self.pages_at_once(), "a half holds what it was made for");
        let half = &mut self.halves[self.next];
        self.next = 1 - self.next;
        let failed = |reason: String| GpuError::Failed { reason };
        if let Some(submission_index) = half.busy.take() {
            let wait = wgpu::PollType::Wait { submission_index: Some(submission_index), timeout: None };
            gpu.poll(wait)?;
        }
        let bytes = count as u64 * self.page_bytes;
        let (sender, mapped) = std::sync::mpsc::channel();
        half.buffer.map_async(wgpu::MapMode::Write, 0..bytes, move |outcome| drop(sender.send(outcome)));
        gpu.poll(wgpu::PollType::Poll)?;
        mapped.recv().map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
        let mut view = half.buffer.get_mapped_range_mut(0..bytes).map_err(|e| failed(e.to_string()))?;
        let mut encoder = gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("upload pages") });
        for k in 0..count {
            let offset = k as u64 * self.page_bytes;
            fill(k, view.slice(offset as usize..(offset + self.page_bytes) as usize));
            copy(&mut encoder, &half.buffer, k, offset);
        }
        drop(view);
        half.buffer.unmap();
        half.busy = Some(gpu.queue().submit([encoder.finish()]));
        gpu.check()
    }
}
