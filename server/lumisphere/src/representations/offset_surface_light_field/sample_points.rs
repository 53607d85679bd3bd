//! From a surface to sample points, and from sample points to sample maps. Geometry only.

use std::cmp::Ordering;
use std::collections::HashMap;

use glam::{IVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::density::Density;
use super::{CONSTRUCTION_HORIZON_DEG, NO_SAMPLE, SampleMaps, SamplePoint};
use crate::capture::{SurfaceMesh, SurfaceTexel, surface_texels};

/// How far apart sample points lie.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Spacing {
    /// No two points on the same side of the surface closer than this, in the scene's unit; none missing where one would fit.
    Distance(f32),
    /// About this many points (within a few percent before points inside geometry are dropped).
    Count(u32),
}

/// The spacing at which `count` points would lie on `surface`, as [`place_sample_points`] places them.
pub fn spacing_of(surface: &SurfaceMesh, count: usize) -> f32 {
    (area(surface) * POINTS_PER_SQUARE_SPACING / count as f32).sqrt()
}

fn area(surface: &SurfaceMesh) -> f32 {
    (0..surface.mesh.triangles.len()).map(|t| surface.mesh.area_vector(t).length()).sum()
}

/// Why no sample points could be placed.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlacementError {
    /// Spacing not above zero.
    #[error("spacing is {0:?}, a finite distance above zero or a count of at least 4 expected")]
    BadSpacing(Spacing),
    /// More points than 16-bit indices can name.
    #[error("spacing {spacing} on a surface of area {area} would need about {points} sample points, at most {limit} can be indexed", limit = NO_SAMPLE - 1)]
    TooMany {
        /// As given or derived.
        spacing: f32,
        /// Of the object's mesh.
        area: f32,
        /// Estimate.
        points: u64,
    },
}

// Candidates a disc of the spacing's radius: with sixteen, gaps that would take another point are rare.
const CANDIDATES_PER_POINT: f32 = 24.0;
// Random discs of minimum distance d cover the plane at about 0.7 points per d² (maximal Poisson-disc sets).
const POINTS_PER_SQUARE_SPACING: f32 = 0.7;

/// A point of a surface, and where in its mesh.
pub(super) struct SurfacePoint {
    pub at: SamplePoint,
    pub triangle: usize,
    /// Barycentric, of the triangle's corners.
    pub weights: Vec3,
}

/// A sample point not yet offset, and how dense its neighbours lie, relative to the mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Placed {
    pub point: SamplePoint,
    pub density: f32,
}

/// Surface points (not yet offset) and their normals at the spacing asked for, by dart throwing in a fixed low-discrepancy order.
///
/// Points on opposite sides of a thin wall do not keep each other away. The same mesh and spacing give the same points.
pub fn place_sample_points(surface: &SurfaceMesh, spacing: Spacing) -> Result<Vec<SamplePoint>, PlacementError> {
    Ok(place_by_density(surface, spacing, &Density::uniform())?.into_iter().map(|placed| placed.point).collect())
}

/// The same, denser in places: the distance asked for, or that at which there are as many as asked for, is kept where the density is 1, and elsewhere
/// `distance / √density`; between two points the mean of theirs.
pub(super) fn place_by_density(surface: &SurfaceMesh, spacing: Spacing, density: &Density<'_>) -> Result<Vec<Placed>, PlacementError> {
    let mut darts = Darts { candidates: Candidates::of(surface), area: area(surface), density, densities: Vec::new() };
    match spacing {
        Spacing::Distance(distance) if distance > 0.0 && distance.is_finite() => darts.throw(distance),
        Spacing::Count(count) if count >= 4 => {
            // The count falls as the spacing grows: bisect on the spacing, 12 halvings of a factor of four.
            let guess = spacing_of(surface, count as usize);
            let (mut low, mut high) = (0.5 * guess, 2.0 * guess);
            let mut best = darts.throw(guess)?;
            for _ in 0..12 {
                let middle = (low * high).sqrt();
                let points = darts.throw(middle)?;
                let closer = |n: usize| n.abs_diff(count as usize);
                if points.len() > count as usize {
                    low = middle;
                } else {
                    high = middle;
                }
                if closer(points.len()) < closer(best.len()) {
                    best = points;
                }
                if best.len() == count as usize {
                    break;
                }
            }
            Ok(best)
        }
        _ => Err(PlacementError::BadSpacing(spacing)),
    }
}

/// Dart throwing over a surface.
struct Darts<'a> {
    candidates: Candidates<'a>,
    area: f32,
    density: &'a Density<'a>,
    /// Of the candidates up to now: what a pilot capture tells is dear.
    densities: Vec<f32>,
}

impl Darts<'_> {
    fn throw(&mut self, spacing: f32) -> Result<Vec<Placed>, PlacementError> {
        let expected = self.area * POINTS_PER_SQUARE_SPACING / (spacing * spacing);
        if !(expected < f32::from(NO_SAMPLE - 1)) {
            return Err(PlacementError::TooMany { spacing, area: self.area, points: expected as u64 });
        }
        let count = (CANDIDATES_PER_POINT * self.density.most() * expected).ceil().max(64.0) as usize;
        let Self { candidates, density, .. } = &*self;
        let more: Vec<f32> = (self.densities.len()..count).into_par_iter().map(|i| density.at(&candidates.at(i as u64))).collect();
        self.densities.extend(more);
        let widest = spacing / self.density.least().sqrt();
        let mut points: Vec<Placed> = Vec::new();
        let mut grid: HashMap<IVec3, Vec<u32>> = HashMap::new();
        for (i, &density) in (0..).zip(&self.densities[..count]) {
            let point = self.candidates.at(i).at;
            let own = spacing / density.sqrt();
            let cell = (point.position / widest).floor().as_ivec3();
            let crowded = neighbours(cell).filter_map(|c| grid.get(&c)).flatten().any(|j| {
                let Placed { point: other, density } = &points[*j as usize];
                let least = 0.5 * (own + spacing / density.sqrt());
                other.position.distance(point.position) < least && other.normal.dot(point.normal) > 0.0
            });
            if !crowded && points.len() < usize::from(NO_SAMPLE - 1) {
                grid.entry(cell).or_default().push(points.len() as u32);
                points.push(Placed { point, density });
            }
        }
        Ok(points)
    }
}

fn neighbours(cell: IVec3) -> impl Iterator<Item = IVec3> {
    (0..27).map(move |k| cell + IVec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1))
}

/// Points spread evenly over a surface, by the R3 sequence (Roberts 2018, generalised golden ratio g with g⁴ = g + 1).
pub(super) struct Candidates<'a> {
    surface: &'a SurfaceMesh,
    /// Of the triangles up to and with each.
    cumulative_area: Vec<f64>,
}

impl<'a> Candidates<'a> {
    pub fn of(surface: &'a SurfaceMesh) -> Self {
        let mut sum = 0f64;
        let add = |t: usize| {
            sum += f64::from(surface.mesh.area_vector(t).length());
            sum
        };
        Self { surface, cumulative_area: (0..surface.mesh.triangles.len()).map(add).collect() }
    }

    pub fn at(&self, i: u64) -> SurfacePoint {
        const G: f64 = 1.220_744_084_605_759_5;
        let sequence = |power: i32| (0.5 + (i + 1) as f64 * G.powi(-power)).fract();
        let last = self.cumulative_area.len() - 1;
        let triangle = self.cumulative_area.partition_point(|a| *a <= sequence(1) * self.cumulative_area[last]).min(last);
        let (root, b) = ((sequence(2) as f32).sqrt(), sequence(3) as f32);
        let weights = Vec3::new(1.0 - root, root * (1.0 - b), root * b);
        let mesh = &self.surface.mesh;
        let corners = mesh.triangles[triangle].map(|v| v as usize);
        let [p, q, r] = corners.map(|v| mesh.positions[v]);
        let [l, m, n] = corners.map(|v| mesh.normals[v]);
        let position = weights.x * p + weights.y * q + weights.z * r;
        let normal = (weights.x * l + weights.y * m + weights.z * n).normalize_or(Vec3::Y);
        SurfacePoint { at: SamplePoint { position, normal }, triangle, weights }
    }
}

/// For every texel of every part the four nearest sample points within 85° of its normal that `visible(texel, sample)` accepts.
///
/// `size` texels along an edge. Texels outside the surface's uv, and those for which no point qualifies, take the value of the nearest
/// texel that has one, so that a look-up is never empty; when rendered, the 65° check flags what does not serve. `visible` is asked with world positions of the surface point and the sample point.
pub fn build_sample_maps(
    surface: &SurfaceMesh,
    points: &[SamplePoint],
    size: usize,
    visible: &(dyn Fn(SamplePoint, Vec3) -> bool + Sync),
) -> SampleMaps {
    let indices = (0..surface.parts)
        .into_par_iter()
        .flat_map_iter(|part| {
            let texels = surface_texels(surface, part, size);
            let mut map: Vec<Option<[u16; 4]>> = texels.par_iter().map(|t| best_four(t.as_ref()?.into(), points, visible)).collect();
            fill_outside(&mut map, size);
            map.into_iter().map(|m| m.unwrap_or([NO_SAMPLE; 4]))
        })
        .collect();
    SampleMaps { size, indices }
}

impl From<&SurfaceTexel> for SamplePoint {
    fn from(texel: &SurfaceTexel) -> Self {
        Self { position: texel.position, normal: texel.normal }
    }
}

fn best_four(texel: SamplePoint, points: &[SamplePoint], visible: &(dyn Fn(SamplePoint, Vec3) -> bool + Sync)) -> Option<[u16; 4]> {
    let found = nearest_visible(texel, points, 4, visible);
    (!found.is_empty()).then(|| std::array::from_fn(|k| found.get(k).copied().unwrap_or(NO_SAMPLE)))
}

/// The nearest `count` sample points, and fewer where fewer of the nearest 64 (or `count`) within 85° of the normal are `visible`.
pub(super) fn nearest_visible(
    texel: SamplePoint,
    points: &[SamplePoint],
    count: usize,
    visible: &(dyn Fn(SamplePoint, Vec3) -> bool + Sync),
) -> Vec<u16> {
    let cos_horizon = CONSTRUCTION_HORIZON_DEG.to_radians().cos();
    let mut near: Vec<(f32, u16)> = points
        .iter()
        .enumerate()
        .filter_map(|(i, p)| {
            let to_sample = p.position - texel.position;
            let distance = to_sample.length();
            (texel.normal.dot(to_sample) > cos_horizon * distance).then_some((distance, i as u16))
        })
        .collect();
    let by_distance = |a: &(f32, u16), b: &(f32, u16)| a.0.partial_cmp(&b.0).unwrap_or(Ordering::Equal).then(a.1.cmp(&b.1));
    // Visibility rarely rejects more than a few: order the nearest sixteen first, the rest only when those do not suffice.
    let head = near.len().min(16);
    if near.len() > head {
        near.select_nth_unstable_by(head - 1, by_distance);
    }
    near[..head].sort_unstable_by(by_distance);
    let mut found = Vec::with_capacity(count);
    for k in 0..near.len().min((4 * head).max(count)) {
        if k == head {
            near[head..].sort_unstable_by(by_distance);
        }
        let (_, i) = near[k];
        if visible(texel, points[usize::from(i)].position) {
            found.push(i);
            if found.len() == count {
                break;
            }
        }
    }
    found
}

// Spreads values to empty texels, nearest first, ring by ring.
fn fill_outside(map: &mut [Option<[u16; 4]>], size: usize) {
    let mut front: Vec<usize> = (0..map.len()).filter(|i| map[*i].is_some()).collect();
    while !front.is_empty() {
        let mut next = Vec::new();
        for i in front {
            let (row, column) = (i / size, i % size);
            let around = [(row.wrapping_sub(1), column), (row + 1, column), (row, column.wrapping_sub(1)), (row, column + 1)];
            for (r, c) in around {
                if r < size && c < size && map[r * size + c].is_none() {
                    map[r * size + c] = map[i];
                    next.push(r * size + c);
                }
            }
        }
        front = next;
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;
    use crate::geometry::TriangleMesh;

    // A unit square in the plane z = 0, normals +Z, uv = position; its back side as part 1 at z = −0.01.
    fn sheet() -> SurfaceMesh {
        let corners = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
        let mut positions: Vec<Vec3> = corners.iter().map(|c| c.extend(0.0)).collect();
        positions.extend(corners.iter().map(|c| c.extend(-0.01)));
        let mut normals = vec![Vec3::Z; 4];
        normals.extend([Vec3::NEG_Z; 4]);
        let mut uvs = corners.to_vec();
        uvs.extend(corners);
        let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]];
        let mesh = TriangleMesh::new(positions, normals, uvs, triangles).unwrap();
        SurfaceMesh { mesh, part_of_triangle: vec![0, 0, 1, 1], parts: 2 }
    }

    #[test]
    fn points_keep_their_distance_and_leave_no_large_gap() {
        let spacing = 0.1;
        let points = place_sample_points(&sheet(), Spacing::Distance(spacing)).unwrap();
        for (i, p) in points.iter().enumerate() {
            for q in &points[..i] {
                assert!(p.normal.dot(q.normal) < 0.0 || p.position.distance(q.position) >= spacing);
            }
        }
        // Maximal sets leave no uncovered point farther than the spacing; 24 candidates a point leave at most a third more.
        for k in 0..400u32 {
            let at = Vec3::new((k % 20) as f32 / 19.0, (k / 20) as f32 / 19.0, 0.0);
            let nearest = points.iter().filter(|p| p.normal.z > 0.0).map(|p| p.position.distance(at)).fold(f32::INFINITY, f32::min);
            assert!(nearest < 1.35 * spacing, "{at}: {nearest}");
        }
    }

    #[test]
    fn a_count_is_met_within_five_percent() {
        for count in [40u32, 300] {
            let n = place_sample_points(&sheet(), Spacing::Count(count)).unwrap().len();
            assert!(n.abs_diff(count as usize) as f32 <= 0.05 * count as f32, "{n} for {count}");
        }
    }

    #[test]
    fn senseless_spacings_are_refused() {
        assert!(matches!(place_sample_points(&sheet(), Spacing::Distance(f32::NAN)), Err(PlacementError::BadSpacing(_))));
        assert!(matches!(place_sample_points(&sheet(), Spacing::Count(3)), Err(PlacementError::BadSpacing(_))));
        assert!(matches!(place_sample_points(&sheet(), Spacing::Distance(1e-4)), Err(PlacementError::TooMany { .. })));
    }

    #[test]
    fn each_texel_names_the_four_nearest_points_above_its_own_horizon() {
        let surface = sheet();
        let offset = |p: &SamplePoint| SamplePoint { position: p.position + 0.05 * p.normal, normal: p.normal };
        let points: Vec<_> = place_sample_points(&surface, Spacing::Distance(0.2)).unwrap().iter().map(offset).collect();
        let maps = build_sample_maps(&surface, &points, 8, &|_, _| true);
        let cos_horizon = CONSTRUCTION_HORIZON_DEG.to_radians().cos();
        for (part, normal) in [(0u32, Vec3::Z), (1, Vec3::NEG_Z)] {
            for texel in 0..64 {
                let (u, v) = ((texel % 8) as f32 / 8.0 + 0.0625, (texel / 8) as f32 / 8.0 + 0.0625);
                let at = Vec3::new(u, v, if part == 0 { 0.0 } else { -0.01 });
                let mut expected: Vec<(f32, u16)> = points
                    .iter()
                    .enumerate()
                    .filter(|(_, p)| normal.dot((p.position - at).normalize()) > cos_horizon)
                    .map(|(i, p)| (p.position.distance(at), i as u16))
                    .collect();
                expected.sort_by(|a, b| a.0.total_cmp(&b.0));
                let found = maps.at(part, u, v);
                for (k, index) in found.iter().enumerate() {
                    assert_eq!(*index, expected.get(k).map_or(NO_SAMPLE, |e| e.1));
                }
            }
        }
    }

    #[test]
    fn hidden_points_are_passed_over_and_too_few_leave_invalid_entries() {
        let surface = sheet();
        let points: Vec<_> = (0..5).map(|i| SamplePoint { position: Vec3::new(0.5, 0.5, 0.1 + 0.1 * i as f32), normal: Vec3::Z }).collect();
        let maps = build_sample_maps(&surface, &points, 1, &|_, p| p.z > 0.35);
        assert_eq!(maps.at(0, 0.5, 0.5), [3, 4, NO_SAMPLE, NO_SAMPLE]);
        assert_eq!(maps.at(1, 0.5, 0.5), [NO_SAMPLE; 4]);
    }

    #[test]
    fn texels_that_no_point_serves_take_their_neighbours_value() {
        // One point low over a corner: only texels close to it have it above their 85° horizon, tan 85° · 0.01 = 0.11 away.
        let points = [SamplePoint { position: Vec3::new(0.1, 0.1, 0.01), normal: Vec3::Z }];
        let maps = build_sample_maps(&sheet(), &points, 8, &|_, _| true);
        assert_eq!(maps.at(0, 0.9, 0.9), [0, NO_SAMPLE, NO_SAMPLE, NO_SAMPLE]);
    }

    #[test]
    fn texels_beyond_the_charts_border_repeat_the_nearest_inside() {
        let mut surface = sheet();
        surface.mesh.triangles.truncate(1);
        surface.part_of_triangle = vec![0];
        surface.parts = 1;
        let points = [SamplePoint { position: Vec3::new(0.9, 0.1, 0.3), normal: Vec3::Z }];
        let maps = build_sample_maps(&surface, &points, 8, &|_, _| true);
        assert!(maps.indices.iter().all(|four| four[0] == 0));
    }
}
