//! Opening the adapter.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::GpuError;
use super::meanwhile::Meanwhile;

/// An open graphics device and its queue.
#[derive(Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    adapter: String,
    driver: String,
    is_software: bool,
    // First failure that no call has reported yet.
    failure: Arc<Mutex<Option<String>>>,
    is_lost: Arc<AtomicBool>,
    meanwhile: Meanwhile,
}

impl Gpu {
    /// The most capable adapter, with all the limits it offers.
    pub fn new() -> Result<Self, GpuError> {
        let mut description = wgpu::InstanceDescriptor::new_without_display_handle();
        // Our one indirect dispatch takes a count that our own kernel bounds; checking it again would cost a dispatch a frame.
        description.flags = wgpu::InstanceFlags::from_build_config() - wgpu::InstanceFlags::VALIDATION_INDIRECT_CALL;
        let instance = wgpu::Instance::new(description);
        let options = wgpu::RequestAdapterOptions { power_preference: wgpu::PowerPreference::HighPerformance, ..Default::default() };
        let adapter = pollster::block_on(instance.request_adapter(&options)).map_err(|e| GpuError::NoAdapter { reason: e.to_string() })?;
        let wanted = wgpu::DeviceDescriptor { label: Some("lumisphere"), required_limits: adapter.limits(), ..Default::default() };
        let opened = pollster::block_on(adapter.request_device(&wanted));
        let (device, queue) = opened.map_err(|e| GpuError::Failed { reason: e.to_string() })?;
        let failure = Arc::new(Mutex::new(None));
        let (errors, losses) = (failure.clone(), failure.clone());
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| note(&errors, e.to_string())));
        let is_lost = Arc::new(AtomicBool::new(false));
        let lost = is_lost.clone();
        device.set_device_lost_callback(move |reason, message| {
            lost.store(true, Ordering::SeqCst);
            note(&losses, format!("device lost ({reason:?}): {message}"));
        });
        let info = adapter.get_info();
        let driver = format!("{} {}, {:?}", info.driver, info.driver_info, info.backend);
        let is_software = info.device_type == wgpu::DeviceType::Cpu;
        Ok(Self { device, queue, adapter: info.name, driver, is_software, failure, is_lost, meanwhile: Meanwhile::default() })
    }

    /// Whether the processor does the work.
    pub(crate) fn is_software(&self) -> bool {
        self.is_software
    }

    /// The adapter's name, as its driver gives it.
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// The driver's name and version, and the interface it is used through.
    pub fn driver(&self) -> &str {
        &self.driver
    }

    /// Whether nothing will ever be computed on it again.
    pub fn is_lost(&self) -> bool {
        self.is_lost.load(Ordering::SeqCst)
    }

    /// As when the adapter is taken away.
    #[doc(hidden)]
    pub fn lose(&self) {
        self.settle();
        self.device.destroy();
        // The loss is told while the device is polled.
        let _ = self.poll(wgpu::PollType::Poll);
    }

    pub(crate) fn device(&self) -> &wgpu::Device {
        &self.device
    }

    pub(crate) fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Waits until everything submitted is done.
    pub(crate) fn wait(&self) -> Result<(), GpuError> {
        self.poll(wgpu::PollType::wait_indefinitely())?;
        self.check()
    }

    /// Does what is to be done [meanwhile](Self::meanwhile), then asks the device what it has done.
    pub(crate) fn poll(&self, how: wgpu::PollType) -> Result<(), GpuError> {
        self.settle();
        // A device that is lost in the middle of the wait makes wgpu panic.
        let polled = catch_unwind(AssertUnwindSafe(|| self.device.poll(how)));
        let Ok(polled) = polled else { return Err(GpuError::Failed { reason: "the device was lost while it was waited for".into() }) };
        polled.map(drop).map_err(|e| GpuError::Failed { reason: e.to_string() })
    }

    /// Does `work`, quick and without use of the device, when the device is next waited for and has work of its own, or in [`Self::settle`].
    /// Mapped memory may be read in it: a lost device is torn down by a poll alone, and no poll comes before.
    pub(crate) fn meanwhile(&self, work: impl FnOnce() + Send + 'static) {
        self.meanwhile.add(work);
    }

    /// Does at once what was put off.
    pub(crate) fn settle(&self) {
        self.meanwhile.run();
    }

    /// Lets the device free what was written to and dropped without a submission, which it otherwise keeps until the next one.
    pub(crate) fn release_dropped(&self) {
        self.queue.submit([]);
        // A device that is lost frees nothing, and the next frame says so.
        let _ = self.wait();
    }

    /// The first failure since the last check, if any.
    pub(crate) fn check(&self) -> Result<(), GpuError> {
        let failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        failure.map_or(Ok(()), |reason| Err(GpuError::Failed { reason }))
    }

    /// Errors when a binding of that many bytes is more than the adapter allows.
    pub(crate) fn check_binding(&self, what: &'static str, bytes: u64) -> Result<(), GpuError> {
        let limits = self.device.limits();
        let limit = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        if bytes > limit { Err(GpuError::BeyondLimit { what, needed: bytes, limit }) } else { Ok(()) }
    }
}

// The first cause explains the others.
fn note(failure: &Mutex<Option<String>>, reason: String) {
    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
}

/// A device for tests; None where there is none, which `REQUIRE_GPU=1` forbids.
#[cfg(test)]
pub(crate) fn test_gpu() -> Option<Arc<Gpu>> {
    match Gpu::new() {
        Ok(gpu) => Some(Arc::new(gpu)),
        Err(e) => {
            assert!(std::env::var_os("REQUIRE_GPU").is_none_or(|v| v != "1"), "{e}, and REQUIRE_GPU=1");
            None
        }
    }
}
