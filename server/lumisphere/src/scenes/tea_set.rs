//! Martin Newell's tea set (University of Utah, 1975), shipped as text in `data/geometry`; public-domain numbers.

use crate::formats::bpt::{self, UpAxis};
use crate::geometry::BezierPatch;

/// Which piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TeaSet {
    /// 32 patches: 12 body, 4 handle, 4 spout, 8 lid, 4 bottom (the last, by F. Crow 1987). Rim diameter 3, height 3.15, spout toward +x.
    Teapot,
    /// 26 patches, height 0.95: a cup 0.9 across, double-walled and without bottom, on its saucer, 2 across.
    Teacup,
    /// 16 patches, 1.2 long, along z.
    Teaspoon,
}

/// The historic pot of 1975 has no bottom.
pub const HISTORIC_TEAPOT_PATCHES: usize = 28;

impl TeaSet {
    /// From `teapot`, `teacup` or `teaspoon`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name {
            "teapot" => Some(Self::Teapot),
            "teacup" => Some(Self::Teacup),
            "teaspoon" => Some(Self::Teaspoon),
            _ => None,
        }
    }
}

/// The piece's patches, +Y up, normals (∂u × ∂v) outward.
pub fn patches(piece: TeaSet) -> Vec<BezierPatch> {
    let (bytes, up): (&[u8], UpAxis) = match piece {
        TeaSet::Teapot => (include_bytes!("../../data/geometry/teapot.bpt"), UpAxis::Z),
        TeaSet::Teacup => (include_bytes!("../../data/geometry/teacup.bpt"), UpAxis::Y),
        TeaSet::Teaspoon => (include_bytes!("../../data/geometry/teaspoon.bpt"), UpAxis::Z),
    };
    let patches = bpt::read(bytes, up).expect("compiled in, and read by the tests below");
    match piece {
        // Newell's teapot is wound the other way round than his cup and spoon (measured: tests below).
        TeaSet::Teapot => patches.iter().map(BezierPatch::flipped).collect(),
        TeaSet::Teacup | TeaSet::Teaspoon => patches,
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::scenes::tessellate::{Resolution, tessellate};

    // Σ area vector · position / 3: positive where normals point outward.
    fn enclosed_volume(patches: &[BezierPatch]) -> f32 {
        let (mesh, _) = tessellate(patches, Resolution::PerEdge(8)).unwrap();
        (0..mesh.triangles.len()).map(|t| mesh.area_vector(t).dot(mesh.corners(t)[0]) / 3.0).sum()
    }

    #[test]
    fn every_piece_has_its_patches_and_faces_outward() {
        for (piece, count) in [(TeaSet::Teapot, 32), (TeaSet::Teacup, 26), (TeaSet::Teaspoon, 16)] {
            let patches = patches(piece);
            assert_eq!(patches.len(), count);
            assert!(enclosed_volume(&patches) > 0.0, "{piece:?}: {}", enclosed_volume(&patches));
        }
    }

    #[test]
    fn a_shipped_file_cut_off_anywhere_is_an_error() {
        let whole = include_bytes!("../../data/geometry/teaspoon.bpt");
        for length in (0..whole.len()).step_by(37).chain(whole.len() - 40..whole.len()) {
            assert!(bpt::read(&whole[..length], UpAxis::Z).is_err(), "{length} bytes");
        }
    }

    #[test]
    fn the_teapot_stands_upright_with_a_rim_three_across() {
        let (mesh, _) = tessellate(&patches(TeaSet::Teapot), Resolution::PerEdge(8)).unwrap();
        let (low, high) = mesh.bounds();
        assert!((high.y - 3.15).abs() < 1e-5 && low.y.abs() < 1e-5);
        assert!(high.x > 3.4 && (high.z - 2.0).abs() < 0.01);
        // Patches 1 to 4 are the rim: the widest of them at y = 2.4 is the circle of radius 1.5.
        let rim = patches(TeaSet::Teapot)[..4].iter().map(|p| p.flipped().position(1.0, 0.0)).collect::<Vec<Vec3>>();
        assert!(rim.iter().all(|p| ((p.x * p.x + p.z * p.z).sqrt() - 1.5).abs() < 1e-4 && (p.y - 2.4).abs() < 1e-4), "{rim:?}");
    }

    #[test]
    fn body_normals_point_away_from_the_axis() {
        for patch in &patches(TeaSet::Teapot)[4..12] {
            let p = patch.point(0.5, 0.5);
            assert!(p.normal.dot(Vec3::new(p.position.x, 0.0, p.position.z)) > 0.0);
        }
    }
}
