//! How much of the hemisphere each sampled direction stands for, as the parameter-map thesis estimates it (section 12.3.2).
//!
//! Only the thesis' own projections need such areas (`fitting::harmonics`): least squares on the samples does without.

use glam::{DVec2, Vec3};

/// Area of each direction's Voronoi cell among the directions projected onto the plane z = 0, clipped to the unit disc, divided by z: about the solid
/// angle in steradians. Directions that coincide share their cell.
///
/// `directions`: unit, z > 0. The sum is not 2π: 5.93 for the thesis' 289 directions, since z is not the cell's mean height.
pub fn planar_voronoi_areas(directions: &[Vec3]) -> Vec<f64> {
    let sites: Vec<DVec2> = directions.iter().map(|d| d.as_dvec3().truncate()).collect();
    let area = |(site, d): (&DVec2, &Vec3)| {
        let sharing = sites.iter().filter(|other| *other == site).count();
        disc_area(&cell(*site, &sites)) / (sharing as f64 * f64::from(d.z))
    };
    sites.iter().zip(directions).map(area).collect()
}

/// Corners of a site's cell within a square around the disc, counter-clockwise.
fn cell(site: DVec2, sites: &[DVec2]) -> Vec<DVec2> {
    let mut corners = vec![DVec2::new(2.0, 2.0), DVec2::new(-2.0, 2.0), DVec2::new(-2.0, -2.0), DVec2::new(2.0, -2.0)];
    for other in sites.iter().filter(|other| **other != site) {
        let (normal, middle) = (*other - site, 0.5 * (*other + site));
        corners = cut(&corners, |corner| normal.dot(corner - middle));
    }
    corners
}

/// The part of a convex polygon where `beyond`, which is linear, is not positive.
fn cut(corners: &[DVec2], beyond: impl Fn(DVec2) -> f64) -> Vec<DVec2> {
    let mut kept = Vec::with_capacity(corners.len() + 1);
    for (at, &a) in corners.iter().enumerate() {
        let b = corners[(at + 1) % corners.len()];
        let (beyond_a, beyond_b) = (beyond(a), beyond(b));
        if beyond_a <= 0.0 {
            kept.push(a);
        }
        if (beyond_a <= 0.0) != (beyond_b <= 0.0) {
            kept.push(a + (b - a) * (beyond_a / (beyond_a - beyond_b)));
        }
    }
    kept
}

/// Area that a counter-clockwise polygon and the unit disc have in common.
fn disc_area(corners: &[DVec2]) -> f64 {
    let edge = |at: usize| edge_area(corners[at], corners[(at + 1) % corners.len()]);
    (0..corners.len()).map(edge).sum()
}

/// Signed area that the triangle (0, a, b) and the unit disc have in common: sectors where the edge is outside, a triangle where it is inside.
fn edge_area(a: DVec2, b: DVec2) -> f64 {
    let sector = |from: DVec2, to: DVec2| 0.5 * from.perp_dot(to).atan2(from.dot(to));
    let along = b - a;
    // |a + t·along|² = 1.
    let (square, half, rest) = (along.length_squared(), along.dot(a), a.length_squared() - 1.0);
    let discriminant = half * half - square * rest;
    if !(discriminant > 0.0) {
        return sector(a, b);
    }
    let root = discriminant.sqrt();
    let (enters, leaves) = (((-half - root) / square).max(0.0), ((root - half) / square).min(1.0));
    if !(enters < leaves) {
        return sector(a, b);
    }
    let (first, last) = (a + enters * along, a + leaves * along);
    sector(a, first) + 0.5 * first.perp_dot(last) + sector(last, b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directions::Scheme;
    use std::f64::consts::PI;

    #[test]
    fn the_cells_tile_the_disc() {
        let directions = Scheme::icosahedron(289).unwrap().directions();
        let projected: f64 = planar_voronoi_areas(&directions).iter().zip(&directions).map(|(area, d)| area * f64::from(d.z)).sum();
        assert!((projected - PI).abs() < 1e-10, "{projected}");
    }

    #[test]
    fn the_sum_is_what_was_measured_for_the_thesis_directions() {
        let sum: f64 = planar_voronoi_areas(&Scheme::icosahedron(289).unwrap().directions()).iter().sum();
        // Measured independently, by another program, to two digits.
        assert!((sum - 5.93).abs() < 0.005, "{sum}");
    }

    #[test]
    fn a_site_alone_or_in_company_has_its_share_of_the_disc() {
        // 0.8 is rounded to f32: 2⁻²⁵ of at most 3.9.
        assert!((planar_voronoi_areas(&[Vec3::new(0.6, 0.0, 0.8)])[0] - PI / 0.8).abs() < 2e-7);
        let halves = planar_voronoi_areas(&[Vec3::new(0.6, 0.0, 0.8), Vec3::new(-0.6, 0.0, 0.8), Vec3::new(-0.6, 0.0, 0.8)]);
        for (area, share) in halves.iter().zip([0.5, 0.25, 0.25]) {
            assert!((area - share * PI / 0.8).abs() < 2e-7, "{halves:?}");
        }
    }
}
