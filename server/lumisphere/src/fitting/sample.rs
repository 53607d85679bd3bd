//! The kernels' view of a sample, 16 texels side by side: direction, values scaled to about one, and the square root of its weight.

use bytemuck::{Pod, Zeroable};

use super::lanes::{GROUP, Row};

/// One observation of 16 texels as the kernels read it, the device's too: rows of 16 numbers in this order.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct Sample {
    /// Unit direction.
    pub direction: [Row; 3],
    /// Values, three channels.
    pub value: [Row; 3],
    /// Square root of the weight of each channel; 0 where there is no sample.
    pub root_weight: [Row; 3],
}

impl Sample {
    /// No sample in any lane.
    pub const NONE: Self =
        Self { direction: [[0.0; GROUP], [0.0; GROUP], [1.0; GROUP]], value: [[0.0; GROUP]; 3], root_weight: [[0.0; GROUP]; 3] };

    /// Copies one lane of another sample.
    pub fn copy_lane(&mut self, lane: usize, from: &Self, from_lane: usize) {
        for c in 0..3 {
            self.direction[c][lane] = from.direction[c][from_lane];
            self.value[c][lane] = from.value[c][from_lane];
            self.root_weight[c][lane] = from.root_weight[c][from_lane];
        }
    }
}

/// Whether every sample of a texel weighs the same in its three channels: one Gram matrix serves all three then.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Weights {
    /// They do.
    #[default]
    Shared,
    /// Clipping, or noise that grows with the value, tells them apart.
    PerChannel,
}
