//! The graphics device: opening it, building kernels, an atlas of pages in its memory, reading results back. Knows no light.
//!
//! Any Vulkan, Metal or DX12 adapter will do, software ones (lavapipe) included; no window is needed. All of it blocks: one frame at
//! a time is drawn, and whoever asks for it waits; what it left in a buffer is copied out while the device is at work on the next.
//!
//! WGSL lives beside its Rust twin; `concat!(include_str!(…), …)` is the import system, `override` constants are the preprocessor.

mod atlas;
mod device;
mod error;
mod kernel;
#[cfg(test)]
pub(crate) mod layout_check;
mod meanwhile;
mod readback;
mod ring;
mod stats;
mod table;

pub(crate) use atlas::{Atlas, AtlasShape, Upload, conform};
pub use device::Gpu;
#[cfg(test)]
pub(crate) use device::test_gpu;
pub use error::GpuError;
pub(crate) use kernel::{Shader, binding, float_texture, storage_buffer, value_buffer};
pub(crate) use readback::{ReadBack, ReadBackPair};
pub use stats::GpuCacheStats;
pub(crate) use table::{bytes_of_table, empty_table, table, table_bytes, write_table};
