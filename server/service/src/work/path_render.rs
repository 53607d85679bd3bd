//! Dataset version to frames.

use lumisphere::progress::Progress;
use lumisphere::render::Refine;

use super::Work;
use super::views::cameras;
use crate::errors::ApiError;
use crate::frames::FrameOrder;
use crate::jobs::{Attempt, Outcome, ResultBlob, cancelled};
use crate::wire::jobs::PathRenderSpec;
use crate::wire::settings::Encoding;

impl Work {
    pub(super) fn path_render(&self, spec: &PathRenderSpec, attempt: &Attempt) -> Result<Outcome, ApiError> {
        let version = self.open(&spec.dataset, spec.version)?;
        let cameras = cameras(&spec.views, &version)?;
        let (extension, media_type) = file_type(spec.output.encoding);
        let mut blobs: Vec<ResultBlob> = Vec::new();
        let mut micros: Vec<u64> = Vec::new();
        for (i, camera) in cameras.iter().enumerate() {
            attempt.report("rendering", i as u64, cameras.len() as u64);
            if attempt.is_cancelled() {
                return Err(cancelled());
            }
            let (settings, output, refine) = (spec.settings, spec.output, Refine::Whole);
            let passes = settings.passes;
            let order =
                FrameOrder { version: version.clone(), camera: *camera, settings, output, opening_micros: 0, refine, passes, video: None };
            let frame = self.encoded(self.still(order, attempt)?)?;
            micros.push(frame.timings.render_micros);
            blobs.push(self.keep(format!("frame-{i:05}.{extension}"), media_type, &frame.color)?);
            for (name, bytes) in [("depth", &frame.depth.bytes), ("provenance", &frame.provenance)] {
                if !bytes.is_empty() {
                    blobs.push(self.keep(format!("frame-{i:05}.{name}.zst"), "application/zstd", bytes)?);
                }
            }
        }
        attempt.report("rendering", cameras.len() as u64, cameras.len() as u64);
        blobs.sort_by(|a, b| a.name.cmp(&b.name));
        micros.sort_unstable();
        let summary = serde_json::json!({
            "dataset": version.dataset,
            "version": version.version,
            "frames": cameras.len(),
            "median_render_micros": micros[micros.len() / 2],
        });
        Ok(Outcome { published: None, blobs, summary_json: summary.to_string() })
    }
}

/// Ending and media type of a frame's file.
fn file_type(encoding: Encoding) -> (&'static str, &'static str) {
    match encoding {
        Encoding::RawZstd => ("raw.zst", "application/zstd"),
        Encoding::Png { .. } => ("png", "image/png"),
        Encoding::Jpeg { .. } => ("jpg", "image/jpeg"),
        Encoding::H264 { .. } => unreachable!("refused for what is no stream"),
        Encoding::Exr => ("exr", "image/x-exr"),
    }
}
