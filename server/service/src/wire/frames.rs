//! Frames out.

use bytes::Bytes;
use lumisphere::geometry::Camera;
use lumisphere::gpu::GpuCacheStats;
use lumisphere::representations::offset_surface_light_field::Gloss;
use lumisphere::textures::CacheStats;

use super::camera::camera_message;
use super::proto;
use super::settings::{Encoding, encoding_number, integration_number};
use crate::depth_plane::EncodedDepth;
use crate::frame_use::AdapterUse;

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
    pub depth: EncodedDepth,
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
    /// That the colour is the mean of.
    pub passes_done: u32,
    /// How a highlight was gathered, where one was.
    pub gloss: Option<Gloss>,
    /// Whether the colour can be decoded without the frames before.
    pub is_key: bool,
    /// In a stream of H.264, from 1; 0 for another encoding.
    pub stream_number: u64,
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

/// What a frame asked of the cache.
pub fn cache_use(asked: &CacheStats, adapter: Option<&AdapterUse>) -> proto::FrameCacheUse {
    proto::FrameCacheUse {
        look_ups: asked.look_ups,
        hits: asked.hits,
        misses: asked.misses,
        read_bytes: asked.bytes_read,
        texel_fetches: asked.texel_fetches,
        texel_misses: asked.texel_misses,
        page_visits: asked.page_visits,
        visit_misses: asked.visit_misses,
        coalesced: asked.coalesced_waits,
        blocks_read: asked.blocks_read,
        rows_decoded: asked.rows_decoded,
        bytes_decoded: asked.bytes_decoded,
        rows_redundant: asked.rows_redundant,
        bytes_redundant: asked.bytes_redundant,
        read_micros: asked.read_nanos / 1000,
        decode_micros: asked.decode_nanos / 1000,
        wait_micros: asked.wait_nanos / 1000,
        adapter: adapter.map(adapter_use),
    }
}

/// Adds what another pass of the same frame asked of the cache.
pub fn add_cache_use(sum: &mut proto::FrameCacheUse, pass: &proto::FrameCacheUse) {
    let of_adapter = |adapter: &Option<proto::AdapterCacheUse>| adapter.unwrap_or_default();
    let (mut whole, part) = (of_adapter(&sum.adapter), of_adapter(&pass.adapter));
    let counts = [
        (&mut sum.look_ups, pass.look_ups),
        (&mut sum.hits, pass.hits),
        (&mut sum.misses, pass.misses),
        (&mut sum.read_bytes, pass.read_bytes),
        (&mut sum.texel_fetches, pass.texel_fetches),
        (&mut sum.texel_misses, pass.texel_misses),
        (&mut sum.page_visits, pass.page_visits),
        (&mut sum.visit_misses, pass.visit_misses),
        (&mut sum.coalesced, pass.coalesced),
        (&mut sum.blocks_read, pass.blocks_read),
        (&mut sum.rows_decoded, pass.rows_decoded),
        (&mut sum.bytes_decoded, pass.bytes_decoded),
        (&mut sum.rows_redundant, pass.rows_redundant),
        (&mut sum.bytes_redundant, pass.bytes_redundant),
        (&mut sum.read_micros, pass.read_micros),
        (&mut sum.decode_micros, pass.decode_micros),
        (&mut sum.wait_micros, pass.wait_micros),
        (&mut whole.look_ups, part.look_ups),
        (&mut whole.hits, part.hits),
        (&mut whole.misses, part.misses),
        (&mut whole.uploads, part.uploads),
        (&mut whole.bytes_uploaded, part.bytes_uploaded),
        (&mut whole.evictions, part.evictions),
        (&mut whole.prefetch_used, part.prefetch_used),
        (&mut whole.prefetch_wasted, part.prefetch_wasted),
        (&mut whole.upload_micros, part.upload_micros),
    ];
    counts.into_iter().for_each(|(sum, count)| *sum += count);
    whole.passes = whole.passes.max(part.passes);
    sum.adapter = sum.adapter.or(pass.adapter).map(|_| whole);
}

fn adapter_use(work: &AdapterUse) -> proto::AdapterCacheUse {
    let AdapterUse { before, after, frame } = work;
    let since = |get: fn(&GpuCacheStats) -> u64| get(after).saturating_sub(get(before));
    proto::AdapterCacheUse {
        look_ups: since(|s| s.look_ups),
        hits: since(|s| s.hits),
        misses: since(|s| s.misses),
        uploads: since(|s| s.uploads),
        bytes_uploaded: since(|s| s.bytes_uploaded),
        evictions: since(|s| s.evictions),
        prefetch_used: since(|s| s.prefetch_used),
        prefetch_wasted: since(|s| s.prefetch_wasted),
        passes: frame.passes,
        upload_micros: (1e3 * frame.pages_millis) as u64,
    }
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
        depth: frame.depth.bytes,
        depth_width_px: frame.depth.width_px,
        depth_height_px: frame.depth.height_px,
        nearest_depth: frame.depth.nearest,
        provenance: frame.provenance,
        timings: Some(frame.timings),
        cache: Some(frame.cache),
        backend: backend as i32,
        adapter: frame.adapter.unwrap_or_default(),
        is_final: frame.is_final,
        passes_done: frame.passes_done,
        integration: frame.gloss.map_or(0, |gloss| integration_number(&gloss)),
        directions: frame.gloss.filter(|gloss| !gloss.is_prefiltered()).map_or(0, |gloss| gloss.directions),
        is_key: frame.is_key,
    }
}
