//! Where sample points lie denser: by the surface's curvature, or by what a pilot capture could not tell (`pilot.rs`).
//!
//! An error that grows with the distance d of sample points as `c·d`, and as many points as there are, is least over the whole surface where
//! their density is as `c^⅔` (Lagrange, with d ∝ density^−½: the same in every unit of area is gained by one point more).

use glam::{Mat2, Vec2, Vec3};
use serde::{Deserialize, Serialize};

use super::sample_points::{Candidates, SurfacePoint};
use crate::capture::SurfaceMesh;

/// Where sample points lie denser.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Placing {
    /// Nowhere.
    #[default]
    Uniform,
    /// Where the surface bends, by the normals of its mesh: there what is mirrored changes most from point to point. Flat facets have none.
    Curvature,
    /// Where a pilot capture of few sample points and small faces shows what a sample point's neighbours cannot tell of what is mirrored there.
    Error,
}

impl Placing {
    /// For manifests, which do not say what is usual.
    pub fn is_uniform(&self) -> bool {
        *self == Self::Uniform
    }

    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Uniform => "uniform",
            Self::Curvature => "curvature",
            Self::Error => "error",
        }
    }
}

/// From the least to the most of a density, relative to the mean: spacings from twice to half the mean one. Beyond, a sample point's nearest four no
/// longer lie around it, and dense places eat up what little they gain.
const LEAST: f32 = 0.25;
const MOST: f32 = 4.0;
/// Of what grows in proportion to the distance of sample points.
const EXPONENT: f32 = 2.0 / 3.0;
/// Points over which the mean is taken.
const MEAN_OF: u64 = 1 << 14;

/// Sample points an area, relative to the mean over the surface.
pub(super) struct Density<'a> {
    need: Option<Need<'a>>,
    /// Factors to the need, and to the density.
    scale: (f32, f32),
}

/// How fast the error grows with the distance of sample points, in any unit; 0 or more.
pub(super) type Need<'a> = Box<dyn Fn(&SurfacePoint) -> f32 + Sync + 'a>;

impl<'a> Density<'a> {
    /// 1 everywhere.
    pub fn uniform() -> Self {
        Self { need: None, scale: (1.0, 1.0) }
    }

    /// As the need has it, in bounds; uniform where there is none.
    pub fn by(surface: &SurfaceMesh, need: Need<'a>) -> Self {
        let candidates = Candidates::of(surface);
        let needs: Vec<f32> = (0..MEAN_OF).map(|i| need(&candidates.at(i)).powf(EXPONENT)).collect();
        let mean = |of: &dyn Fn(f32) -> f32| (needs.iter().map(|n| f64::from(of(*n))).sum::<f64>() / needs.len() as f64) as f32;
        let of_needs = mean(&|n| n);
        if !(of_needs > 0.0 && of_needs.is_finite()) {
            return Self::uniform();
        }
        let scale = 1.0 / of_needs;
        let bounded = mean(&|n| (scale * n).clamp(LEAST, MOST));
        Self { need: Some(need), scale: (scale, 1.0 / bounded) }
    }

    pub fn at(&self, point: &SurfacePoint) -> f32 {
        let Some(need) = &self.need else { return 1.0 };
        (self.scale.0 * need(point).powf(EXPONENT)).clamp(LEAST, MOST) * self.scale.1
    }

    /// No density is less.
    pub fn least(&self) -> f32 {
        if self.need.is_some() { LEAST * self.scale.1 } else { 1.0 }
    }

    /// None is more.
    pub fn most(&self) -> f32 {
        if self.need.is_some() { MOST * self.scale.1 } else { 1.0 }
    }
}

/// By the curvature of the mesh's normals, in 1 / scene unit, interpolated between its vertices.
pub(super) fn curvature(surface: &SurfaceMesh) -> Need<'_> {
    let mesh = &surface.mesh;
    // Of each vertex, the mean over its triangles by their area.
    let mut sums = vec![(0f32, 0f32); mesh.positions.len()];
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let area = mesh.area_vector(t).length();
        let bend = triangle_curvature(corners.map(|v| mesh.positions[v as usize]), corners.map(|v| mesh.normals[v as usize]));
        for v in corners {
            let (sum, areas) = &mut sums[*v as usize];
            *sum += area * bend;
            *areas += area;
        }
    }
    let of_vertex: Vec<f32> = sums.into_iter().map(|(sum, areas)| if areas > 0.0 { sum / areas } else { 0.0 }).collect();
    Box::new(move |point| {
        let corners = mesh.triangles[point.triangle].map(|v| of_vertex[v as usize]);
        point.weights.dot(Vec3::from(corners))
    })
}

/// `√(κ₁² + κ₂²)`: the Frobenius norm of the second fundamental form, which takes the triangle's edges to the differences of its normals
/// (Rusinkiewicz 2004, Estimating Curvatures and Their Derivatives on Triangle Meshes). 0 of what has no area.
fn triangle_curvature([p, q, r]: [Vec3; 3], [l, m, n]: [Vec3; 3]) -> f32 {
    let Some(along) = (q - p).try_normalize() else { return 0.0 };
    let Some(normal) = (q - p).cross(r - p).try_normalize() else { return 0.0 };
    let within = |d: Vec3| Vec2::new(along.dot(d), normal.cross(along).dot(d));
    let edges = Mat2::from_cols(within(q - p), within(r - p));
    let form = Mat2::from_cols(within(m - l), within(n - l)) * edges.inverse();
    let norm = (form.x_axis.length_squared() + form.y_axis.length_squared()).sqrt();
    if norm.is_finite() { norm } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use super::*;
    use crate::geometry::TriangleMesh;
    use crate::representations::offset_surface_light_field::sample_points::{Placed, Spacing, place_by_density};

    // A round bar of length 8 along X, its radius 0.5 for x < 4 and 1 beyond, without its ends and the step.
    fn bar() -> SurfaceMesh {
        let (sectors, rings) = (48u32, 32u32);
        let (mut positions, mut normals, mut triangles) = (vec![], vec![], vec![]);
        for (radius, from) in [(0.5, 0.0), (1.0, 4.0)] {
            let first = positions.len() as u32;
            for ring in 0..=rings {
                for sector in 0..=sectors {
                    let (sin, cos) = (2.0 * PI * sector as f32 / sectors as f32).sin_cos();
                    positions.push(Vec3::new(from + 4.0 * ring as f32 / rings as f32, radius * cos, radius * sin));
                    normals.push(Vec3::new(0.0, cos, sin));
                    if ring < rings && sector < sectors {
                        let i = first + ring * (sectors + 1) + sector;
                        triangles.extend([[i, i + 1, i + sectors + 2], [i, i + sectors + 2, i + sectors + 1]]);
                    }
                }
            }
        }
        let uvs = vec![Vec2::ZERO; positions.len()];
        let part_of_triangle = vec![0; triangles.len()];
        SurfaceMesh { mesh: TriangleMesh::new(positions, normals, uvs, triangles).unwrap(), part_of_triangle, parts: 1 }
    }

    fn thin_and_thick(placed: &[Placed]) -> (f32, f32) {
        let thin = placed.iter().filter(|p| p.point.position.x < 4.0).count() as f32;
        (thin, placed.len() as f32 - thin)
    }

    #[test]
    fn the_curvature_of_a_cylinder_is_one_over_its_radius() {
        let bar = bar();
        let need = curvature(&bar);
        let candidates = Candidates::of(&bar);
        for i in 0..500 {
            let point = candidates.at(i);
            let expected = if point.at.position.x < 4.0 { 2.0 } else { 1.0 };
            let found = need(&point);
            assert!((found - expected).abs() < 0.02 * expected, "{} at {}", found, point.at.position);
        }
    }

    #[test]
    fn a_triangle_without_area_and_a_flat_one_have_no_curvature() {
        assert_eq!(triangle_curvature([Vec3::ZERO, Vec3::X, 2.0 * Vec3::X], [Vec3::X, Vec3::Y, Vec3::Z]), 0.0);
        assert_eq!(triangle_curvature([Vec3::ZERO, Vec3::X, Vec3::Y], [Vec3::Z; 3]), 0.0);
    }

    #[test]
    fn points_lie_as_dense_as_the_need_asks_and_as_many() {
        let bar = bar();
        let uniform = place_by_density(&bar, Spacing::Count(400), &Density::uniform()).unwrap();
        let bent = place_by_density(&bar, Spacing::Count(400), &Density::by(&bar, curvature(&bar))).unwrap();
        assert!(bent.len().abs_diff(400) <= 20, "{}", bent.len());
        // The thick half has twice the area. Densities are as 2^⅔ to 1.
        let [of_uniform, of_bent] = [uniform, bent].map(|placed| thin_and_thick(&placed));
        let ratio = (of_bent.0 / of_bent.1) / (of_uniform.0 / of_uniform.1);
        assert!((ratio - 2f32.powf(EXPONENT)).abs() < 0.2, "{ratio}: {of_uniform:?}, {of_bent:?}");
    }

    #[test]
    fn a_need_beyond_all_bounds_keeps_the_mean_and_the_bounds() {
        let bar = bar();
        let density = Density::by(&bar, Box::new(|point| if point.at.position.x < 0.1 { 1e6 } else { 0.0 }));
        let candidates = Candidates::of(&bar);
        let all: Vec<f32> = (0..20_000).map(|i| density.at(&candidates.at(i))).collect();
        let mean = all.iter().sum::<f32>() / all.len() as f32;
        assert!((mean - 1.0).abs() < 0.02, "{mean}");
        assert!(all.iter().all(|d| (density.least()..=density.most()).contains(d)));
        let placed = place_by_density(&bar, Spacing::Distance(0.3), &density).unwrap();
        for (i, p) in placed.iter().enumerate() {
            for q in &placed[..i] {
                let least = 0.15 / p.density.sqrt() + 0.15 / q.density.sqrt();
                assert!(p.point.normal.dot(q.point.normal) <= 0.0 || p.point.position.distance(q.point.position) >= 0.999 * least);
            }
        }
    }

    #[test]
    fn where_nothing_bends_points_lie_as_they_do_when_nothing_is_asked() {
        let mut flat = bar();
        flat.mesh.normals.fill(Vec3::Y);
        let bent = place_by_density(&flat, Spacing::Count(100), &Density::by(&flat, curvature(&flat))).unwrap();
        assert_eq!(bent, place_by_density(&flat, Spacing::Count(100), &Density::uniform()).unwrap());
    }
}
