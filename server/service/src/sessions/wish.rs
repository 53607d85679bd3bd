//! What a viewer wants to see: the newest of what each of its messages said, whichever arrived first.

use std::sync::Arc;

use lumisphere::geometry::Camera;
use lumisphere::render::Refine;
use tokio::time::Instant;

use crate::catalog::OpenedVersion;
use crate::frames::{FrameOrder, VideoStream};
use crate::wire::settings::{Output, RenderSettings};

/// What the viewer wants to see, as of the last message.
#[derive(Clone)]
pub(super) struct Wish {
    pub pose: Option<(u64, Camera)>,
    pub settings: RenderSettings,
    pub output: Output,
    /// Of the updates that these came with.
    pub sequences: Sequences,
    /// Increases with every change that needs a new frame.
    pub revision: u64,
    /// When it last did.
    pub changed: Instant,
    /// Poses received.
    pub poses: u64,
    /// All frames up to this one have arrived.
    pub acknowledged: u64,
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sequences {
    pub pose: u64,
    pub settings: u64,
    pub output: u64,
}

/// An update that was checked.
pub(super) struct Change {
    pub sequence: u64,
    pub pose: Option<(u64, Camera)>,
    pub settings: Option<RenderSettings>,
    pub output: Option<Output>,
    pub acknowledged: u64,
}

impl Wish {
    /// It, drawn by this camera, which may be smaller than the pose's.
    pub fn order(&self, version: Arc<OpenedVersion>, camera: Camera, video: Option<VideoStream>, upload_bytes: u64) -> FrameOrder {
        let (settings, output, refine) = (self.settings, self.output, Refine::UpTo { upload_bytes });
        FrameOrder { version, camera, settings, output, opening_micros: 0, refine, passes: settings.passes, video }
    }

    /// What a later update has not overtaken.
    pub fn apply(&mut self, change: Change) {
        let Change { sequence, pose, settings, output, acknowledged } = change;
        let before = self.revision;
        if let Some(pose) = pose.filter(|_| sequence >= self.sequences.pose) {
            (self.pose, self.sequences.pose) = (Some(pose), sequence);
            self.poses += 1;
            self.revision = before + 1;
        }
        if let Some(settings) = settings.filter(|_| sequence >= self.sequences.settings) {
            (self.settings, self.sequences.settings) = (settings, sequence);
            self.revision = before + 1;
        }
        if let Some(output) = output.filter(|_| sequence >= self.sequences.output) {
            (self.output, self.sequences.output) = (output, sequence);
            self.revision = before + 1;
        }
        if self.revision > before {
            self.changed = Instant::now();
        }
        self.acknowledged = self.acknowledged.max(acknowledged);
    }
}
