//! What can go wrong on the device. None of it concerns the data: the CPU may still be able to do the work.

use thiserror::Error;

/// Why the GPU cannot do it.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum GpuError {
    /// No driver offers an adapter.
    #[error("no graphics adapter found: {reason}")]
    NoAdapter {
        /// As the drivers say.
        reason: String,
    },
    /// The adapter is there but cannot be opened, or has failed since (out of memory, lost).
    #[error("graphics device failed: {reason}")]
    Failed {
        /// As the driver says.
        reason: String,
    },
    /// Beyond what the adapter can hold in one piece.
    #[error("{what} needs {needed}, the adapter allows {limit}")]
    BeyondLimit {
        /// "width of the frame in pixels".
        what: &'static str,
        /// In its own unit.
        needed: u64,
        /// In the same unit.
        limit: u64,
    },
    /// Beyond the memory that may be used.
    #[error("{what} needs {needed_bytes} bytes of graphics memory, {budget_bytes} are left of the budget")]
    OverBudget {
        /// "the dataset's geometry".
        what: &'static str,
        /// At least.
        needed_bytes: u64,
        /// At most.
        budget_bytes: u64,
    },
    /// One frame reads more pages than fit.
    #[error("the frame reads {needed} pages, {capacity} fit into the budget for graphics memory")]
    TooManyPages {
        /// Distinct pages.
        needed: usize,
        /// Slots.
        capacity: usize,
    },
    /// Intrinsics so extreme that the rasteriser's arithmetic overflows.
    #[error("the camera's focal length or principal point is beyond what can be rasterised")]
    ExtremeCamera,
}
