//! Where a simulated viewer is at each step. Same path, viewer and step: same place.

use clap::ValueEnum;
use lumisphere_proto::v1alpha1 as wire;

use crate::cameras::{Named, OrbitFlags, Place};

/// How viewers move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PathKind {
    /// Once around in --frames steps, viewers spread evenly over the circle
    Orbit,
    /// A smooth wander in every direction, each viewer its own
    Walk,
    /// Somewhere else at every step: nothing to predict, nothing to reuse
    Jump,
    /// The cameras of --cameras, over and over
    Replayed,
}

/// The paths of all viewers.
pub struct ViewerPaths<'a> {
    /// How they move.
    pub kind: PathKind,
    /// Lens, first place and steps of a turn.
    pub orbit: &'a OrbitFlags,
    /// Of the captured object.
    pub bounds: wire::Box3,
    /// How many viewers there are.
    pub viewers: u32,
    /// For `Replayed`; at least one there.
    pub cameras: &'a [Named],
    /// Of walks and jumps.
    pub seed: u64,
}

// A walk's amplitudes about the orbit's own place, and its angular speeds per step: without common multiple, so that it does not close.
const WALK_ELEVATION_DEG: f32 = 20.0;
const WALK_DISTANCE_RATIO: f32 = 0.3;
const WALK_RATES: [f32; 3] = [0.21, 0.13, 0.071];
// The least distance that the server takes for an orbit, and the steepest view that still has an up.
const LEAST_RADII: f32 = 1.05;
const STEEPEST_DEG: f32 = 85.0;

impl ViewerPaths<'_> {
    /// The camera of `viewer` at `step`.
    pub fn camera(&self, viewer: u32, step: u64) -> anyhow::Result<wire::Camera> {
        match self.kind {
            PathKind::Replayed => Ok(self.cameras[((step + u64::from(viewer)) % self.cameras.len() as u64) as usize].1),
            _ => self.orbit.camera(&self.bounds, self.place(viewer, step)),
        }
    }

    fn place(&self, viewer: u32, step: u64) -> Place {
        let orbit = self.orbit;
        let turn = 360.0 / orbit.frames as f32;
        let start = orbit.azimuth_deg + 360.0 * viewer as f32 / self.viewers as f32;
        let along = start + turn * (step % u64::from(orbit.frames)) as f32;
        let (azimuth_deg, elevation_deg, distance_radii) = match self.kind {
            PathKind::Orbit | PathKind::Replayed => (along, orbit.elevation_deg, orbit.distance_radii),
            PathKind::Walk => {
                let wave = |k: usize| {
                    let phase = std::f32::consts::TAU * self.uniform(viewer, 0, k as u64);
                    (WALK_RATES[k] * step as f32 + phase).sin()
                };
                let azimuth = along + 8.0 * turn * wave(0);
                let elevation = orbit.elevation_deg + WALK_ELEVATION_DEG * wave(1);
                (azimuth, elevation, orbit.distance_radii * (1.0 + WALK_DISTANCE_RATIO * wave(2)))
            }
            PathKind::Jump => {
                let elevation = -10.0 + 70.0 * self.uniform(viewer, step + 1, 1);
                let distance = orbit.distance_radii * (0.6 + 0.8 * self.uniform(viewer, step + 1, 2));
                (360.0 * self.uniform(viewer, step + 1, 0), elevation, distance)
            }
        };
        let elevation_deg = elevation_deg.clamp(-STEEPEST_DEG, STEEPEST_DEG);
        Place { azimuth_deg, elevation_deg, distance_radii: distance_radii.max(LEAST_RADII) }
    }

    /// A number in [0, 1) that belongs to viewer, step and dimension.
    fn uniform(&self, viewer: u32, step: u64, dimension: u64) -> f32 {
        let words = [self.seed, viewer.into(), step, dimension];
        let hash = blake3::hash(&words.map(u64::to_le_bytes).concat());
        let [a, b, c, ..] = *hash.as_bytes();
        u32::from_le_bytes([a, b, c, 0]) as f32 / (1u32 << 24) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::Size;

    const ORBIT: OrbitFlags = OrbitFlags {
        frames: 36,
        size: Size { width_px: 64, height_px: 48 },
        vfov_deg: 40.0,
        elevation_deg: 25.0,
        distance_radii: 3.5,
        azimuth_deg: 0.0,
    };

    fn places(kind: PathKind, viewer: u32) -> Vec<Place> {
        let bounds = wire::Box3::default();
        let paths = ViewerPaths { kind, orbit: &ORBIT, bounds, viewers: 4, cameras: &[], seed: 7 };
        (0..200).map(|step| paths.place(viewer, step)).collect()
    }

    fn longest_step(places: &[Place]) -> f32 {
        let turn = |a: &Place, b: &Place| ((a.azimuth_deg - b.azimuth_deg + 540.0).rem_euclid(360.0) - 180.0).abs();
        places.windows(2).map(|w| turn(&w[0], &w[1]).max((w[0].elevation_deg - w[1].elevation_deg).abs())).fold(0.0, f32::max)
    }

    #[test]
    fn an_orbit_closes_and_viewers_are_spread_over_it() {
        let first = places(PathKind::Orbit, 0);
        assert_eq!(first[0], first[36]);
        assert!((longest_step(&first) - 10.0).abs() < 1e-3);
        assert_eq!(places(PathKind::Orbit, 1)[0].azimuth_deg, 90.0);
    }

    #[test]
    fn replayed_cameras_come_over_and_over_each_viewer_one_ahead() {
        let camera = |width_px| {
            let intrinsics = wire::Intrinsics { width_px, ..Default::default() };
            (format!("{width_px} wide"), wire::Camera { intrinsics: Some(intrinsics), pose: None })
        };
        let cameras = [camera(1), camera(2), camera(3)];
        let bounds = wire::Box3::default();
        let paths = ViewerPaths { kind: PathKind::Replayed, orbit: &ORBIT, bounds, viewers: 2, cameras: &cameras, seed: 7 };
        let widths = |viewer| (0..4).map(|step| paths.camera(viewer, step).unwrap().intrinsics.unwrap().width_px).collect::<Vec<_>>();
        assert_eq!((widths(0), widths(1)), (vec![1, 2, 3, 1], vec![2, 3, 1, 2]));
    }

    #[test]
    fn a_walk_is_smooth_and_its_own_and_a_jump_is_not_smooth() {
        let walk = places(PathKind::Walk, 0);
        assert!(longest_step(&walk) < 40.0, "{}", longest_step(&walk));
        assert_ne!(walk, places(PathKind::Walk, 1));
        assert_eq!(walk, places(PathKind::Walk, 0));
        let jump = places(PathKind::Jump, 0);
        assert!(longest_step(&jump) > 90.0);
        assert!(jump.iter().all(|p| p.distance_radii >= LEAST_RADII && p.elevation_deg.abs() <= STEEPEST_DEG));
    }
}
