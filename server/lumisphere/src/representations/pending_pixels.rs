//! A frame that is drawn before its pixels are here.

#[cfg(feature = "gpu")]
use std::sync::mpsc;

#[cfg(feature = "gpu")]
use super::{Outputs, Provenance};
use super::{Pixels, RenderError};
#[cfg(feature = "gpu")]
use crate::gpu::GpuError;

/// A frame of which the last band may still lie in the device's buffer: it comes with the next frame, or when the device is settled.
pub struct PendingPixels(Source);

enum Source {
    Here(Pixels),
    #[cfg(feature = "gpu")]
    Coming {
        rows: mpsc::Receiver<Rows>,
        outputs: Outputs,
        pages_needed: usize,
        is_final: bool,
    },
}

/// What was copied so far, R, G, B of each pixel; distances and provenance where they were asked for.
#[cfg(feature = "gpu")]
#[derive(Default)]
pub(super) struct Rows {
    pub color: Vec<f32>,
    pub depth: Vec<f32>,
    pub provenance: Vec<Provenance>,
    pub copying_millis: f64,
}

impl PendingPixels {
    /// Of a frame whose rows are sent when all are copied.
    #[cfg(feature = "gpu")]
    pub(super) fn coming(rows: mpsc::Receiver<Rows>, outputs: Outputs, pages_needed: usize, is_final: bool) -> Self {
        Self(Source::Coming { rows, outputs, pages_needed, is_final })
    }

    /// Waits for them; what copying them took, milliseconds. Errors where the device was given up before.
    pub fn finish(self) -> Result<(Pixels, f64), RenderError> {
        match self.0 {
            Source::Here(pixels) => Ok((pixels, 0.0)),
            #[cfg(feature = "gpu")]
            Source::Coming { rows, outputs, pages_needed, is_final } => {
                let gone = |_| GpuError::Failed { reason: "a frame's pixels were left on the device".into() };
                let Rows { color, depth, provenance, copying_millis } = rows.recv().map_err(gone)?;
                let (depth, provenance) = (outputs.depth.then_some(depth), outputs.provenance.then_some(provenance));
                Ok((Pixels { color, depth, provenance, pages_needed, is_final }, copying_millis))
            }
        }
    }

    /// Whether no better frame of the view follows.
    pub fn is_final(&self) -> bool {
        match &self.0 {
            Source::Here(pixels) => pixels.is_final,
            #[cfg(feature = "gpu")]
            Source::Coming { is_final, .. } => *is_final,
        }
    }

    /// Distinct pages that the frame read.
    pub fn pages_needed(&self) -> usize {
        match &self.0 {
            Source::Here(pixels) => pixels.pages_needed,
            #[cfg(feature = "gpu")]
            Source::Coming { pages_needed, .. } => *pages_needed,
        }
    }
}

impl From<Pixels> for PendingPixels {
    fn from(pixels: Pixels) -> Self {
        Self(Source::Here(pixels))
    }
}
