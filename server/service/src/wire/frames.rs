//! Frames out.

use bytes::Bytes;
use lumisphere::geometry::Camera;

use super::camera::camera_message;
use super::proto;
use super::settings::{Encoding, encoding_number};

/// An encoded frame and its account.
#[derive(Debug, Clone)]
pub struct EncodedFrame {
    /// As used.
    pub camera: Camera,
    /// Of the colour.
    pub encoding: Encoding,
    /// The image.
    pub color: Bytes,
    /// Empty unless asked for.
    pub depth: Bytes,
    /// Empty unless asked for.
    pub provenance: Bytes,
    /// Where the time went.
    pub timings: proto::FrameTimings,
    /// What the cache did.
    pub cache: proto::FrameCacheUse,
    /// The adapter's name; None on the CPU.
    pub adapter: Option<String>,
    /// No better frame of this pose follows.
    pub is_final: bool,
}

/// What a frame answers.
#[derive(Debug, Clone)]
pub struct FrameIdentity {
    /// Counts frames.
    pub frame_id: u64,
    /// The client's.
    pub pose_id: u64,
    /// Which.
    pub dataset: String,
    /// Which.
    pub dataset_version: u64,
}

/// The message.
pub fn frame(frame: EncodedFrame, identity: FrameIdentity) -> proto::Frame {
    let FrameIdentity { frame_id, pose_id, dataset, dataset_version } = identity;
    let intrinsics = frame.camera.intrinsics();
    let backend = if frame.adapter.is_some() { proto::Backend::Gpu } else { proto::Backend::Cpu };
    proto::Frame {
        frame_id,
        pose_id,
        dataset,
        dataset_version,
        camera: Some(camera_message(&frame.camera)),
        width_px: intrinsics.width_px,
        height_px: intrinsics.height_px,
        encoding: encoding_number(frame.encoding),
        color: frame.color,
        depth: frame.depth,
        provenance: frame.provenance,
        timings: Some(frame.timings),
        cache: Some(frame.cache),
        backend: backend as i32,
        adapter: frame.adapter.unwrap_or_default(),
        is_final: frame.is_final,
    }
}
