//! Pages for a viewer's next frame, brought while there is none to draw: `sessions` looks ahead after frames of a viewer who moves, where that
//! leaves time for it.
//!
//! A look on the render thread tells which pages the extrapolated camera misses; they are read into memory off that thread, so that a slow
//! disk delays nobody, and handed to the adapter in small pieces, between which any frame goes first. A frame that comes during the look, which
//! shades the object alone, waits for it. Whoever drops the future ends it.

use std::sync::Arc;

use lumisphere::geometry::Camera;
use lumisphere::textures::{Page, PageId};

use crate::api::blocking;
use crate::catalog::OpenedVersion;
use crate::errors::ApiError;
use crate::frames::Frames;
use crate::wire::settings::RenderSettings;

/// In one piece: what a frame may have to wait for, a few milliseconds.
const PAGES_AT_ONCE: usize = 8;

/// Where a viewer was at the last two frames.
#[derive(Debug, Default)]
pub struct Motion {
    before: Option<Camera>,
    now: Option<Camera>,
}

impl Motion {
    /// A frame of a new pose was drawn from here.
    pub fn moved_to(&mut self, camera: Camera) {
        self.before = self.now.replace(camera);
    }

    /// Where the next frame will be drawn from if the viewer goes on; None for one who rests or has only begun.
    pub fn next(&self) -> Option<Camera> {
        let (before, now) = (self.before?, self.now?);
        if before.pose() == now.pose() {
            return None;
        }
        // Beyond the range of f32 there is nothing to look at.
        let pose = now.pose().extrapolated_from(before.pose()).ok()?;
        Camera::new(*now.intrinsics(), pose).ok()
    }
}

/// What the next frame would show.
#[derive(Clone)]
pub struct Expected {
    /// Of what.
    pub version: Arc<OpenedVersion>,
    /// From where.
    pub camera: Camera,
    /// What.
    pub settings: RenderSettings,
}

impl Expected {
    /// What such a frame would miss on the adapter, at most `upload_bytes` of texels.
    pub async fn missing(&self, frames: &Frames, upload_bytes: u64) -> Result<Vec<PageId>, ApiError> {
        frames.look_ahead(self.clone(), upload_bytes).await
    }

    /// Brings these pages, a piece at a time; how many.
    pub async fn bring(self, frames: &Frames, missing: &[PageId]) -> Result<usize, ApiError> {
        let mut brought = 0;
        for piece in missing.chunks(PAGES_AT_ONCE) {
            let (version, piece) = (self.version.clone(), piece.to_vec());
            let pages = blocking(move || piece.into_iter().map(|page| read(&version, page)).collect::<Result<Vec<_>, _>>()).await?;
            brought += frames.bring_ahead(self.version.clone(), pages).await?;
        }
        Ok(brought)
    }
}

/// Through the cache, as a prefetch: no frame asked for it.
fn read(version: &OpenedVersion, page: PageId) -> Result<(PageId, Arc<Page>), ApiError> {
    let (image, _) = version.pages.cache.prefetch(&version.pages.version, page)?;
    Ok((page, image))
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use lumisphere::geometry::{Intrinsics, Pose};

    use super::*;

    fn at(x: f32) -> Camera {
        let pose = Pose::look_at(Vec3::new(x, 0.0, 5.0), Vec3::new(x, 0.0, 0.0), Vec3::Y).unwrap();
        Camera::new(Intrinsics::from_vfov(40.0, 64, 48).unwrap(), pose).unwrap()
    }

    #[test]
    fn a_viewer_who_moves_is_expected_as_far_again_and_one_who_rests_nowhere() {
        let mut motion = Motion::default();
        assert!(motion.next().is_none());
        motion.moved_to(at(1.0));
        assert!(motion.next().is_none(), "a single pose is no motion");
        motion.moved_to(at(1.5));
        assert_eq!(motion.next().unwrap().pose().position(), Vec3::new(2.0, 0.0, 5.0));
        motion.moved_to(at(1.5));
        assert!(motion.next().is_none(), "at rest");
        // Beyond f32.
        motion.moved_to(at(-2e38));
        motion.moved_to(at(2e38));
        assert!(motion.next().is_none());
    }
}
