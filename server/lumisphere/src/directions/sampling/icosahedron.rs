//! Vertices of the subdivided icosahedron above the surface: the thesis' uniform scheme.
//!
//! The thesis gives the counts only (17, 73, 305 and "289"); they come out when the midpoint of an edge is at the zenith and vertices on the
//! horizon are left out.

use std::collections::HashMap;

use glam::{DVec3, Vec3};

/// Directions that each number of subdivisions, from one, leaves strictly above the horizon.
const COUNTS: [usize; 4] = [17, 73, 305, 1249];
/// The thesis' tests of chapters 11 and 12: 305 less the lowest 16.
const TRIMMED: usize = 289;
/// Vertices on the horizon lie there up to rounding, the others far above it.
const ON_HORIZON: f64 = 1e-9;

pub(super) fn is_count(samples: usize) -> bool {
    samples == TRIMMED || COUNTS.contains(&samples)
}

/// From the zenith down, and by azimuth where heights are equal. None for a count that is not [`is_count`].
pub(super) fn directions(samples: usize) -> Vec<Vec3> {
    let subdivisions = COUNTS.iter().position(|&count| count >= samples).map_or(0, |at| at + 1);
    let mut upper = upper(subdivisions);
    // Rounded, so that vertices of one height are ordered by azimuth whatever the last bit says.
    let key = |v: &DVec3| ((-v.z * 1e9).round() as i64, (v.y.atan2(v.x).rem_euclid(std::f64::consts::TAU) * 1e9).round() as i64);
    upper.sort_by_key(key);
    upper.truncate(samples);
    upper.into_iter().map(DVec3::as_vec3).collect()
}

/// All 10·4ˢ + 2 vertices of the icosahedron subdivided s times (at most 6), both hemispheres, in a fixed order.
pub fn icosphere(subdivisions: usize) -> Vec<Vec3> {
    vertices(subdivisions.min(6)).into_iter().map(DVec3::as_vec3).collect()
}

fn upper(subdivisions: usize) -> Vec<DVec3> {
    vertices(subdivisions).into_iter().filter(|v| v.z > ON_HORIZON).collect()
}

/// All vertices, unit. Two of the icosahedron's lie in the yz-plane at (0, ±1, (1 + √5)/2), so that the edge between them crosses the z-axis.
fn vertices(subdivisions: usize) -> Vec<DVec3> {
    let golden = 0.5 * (1.0 + 5f64.sqrt());
    let corners = [(1.0, golden), (1.0, -golden), (-1.0, golden), (-1.0, -golden)];
    let mut vertices: Vec<DVec3> =
        corners.iter().flat_map(|&(a, b)| [DVec3::new(0.0, a, b), DVec3::new(a, b, 0.0), DVec3::new(b, 0.0, a)]).collect();
    vertices.iter_mut().for_each(|v| *v = v.normalize());
    let mut triangles = faces(&vertices);
    for _ in 0..subdivisions {
        triangles = split(&mut vertices, &triangles);
    }
    vertices
}

/// The twenty triples of vertices that are neighbours of each other.
fn faces(vertices: &[DVec3]) -> Vec<[usize; 3]> {
    // Neighbours are 63.4° apart (cosine 1/√5 ≈ 0.447), the next 116.6°.
    let are_neighbours = |a: usize, b: usize| vertices[a].dot(vertices[b]) > 0.4;
    let pairs = (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))).filter(|&(a, b)| are_neighbours(a, b));
    pairs.flat_map(|(a, b)| (b + 1..12).filter(move |&c| are_neighbours(a, c) && are_neighbours(b, c)).map(move |c| [a, b, c])).collect()
}

/// Four triangles of each, with the edges' midpoints on the sphere.
fn split(vertices: &mut Vec<DVec3>, triangles: &[[usize; 3]]) -> Vec<[usize; 3]> {
    let mut midpoints = HashMap::new();
    let mut midpoint = |a: usize, b: usize| {
        *midpoints.entry((a.min(b), a.max(b))).or_insert_with(|| {
            vertices.push((vertices[a] + vertices[b]).normalize());
            vertices.len() - 1
        })
    };
    let mut quarters = |&[a, b, c]: &[usize; 3]| {
        let (ab, bc, ca) = (midpoint(a, b), midpoint(b, c), midpoint(c, a));
        [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    };
    triangles.iter().flat_map(&mut quarters).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_counts_are_those_of_the_thesis() {
        assert_eq!([1, 2, 3, 4].map(|subdivisions| upper(subdivisions).len()), COUNTS);
        assert_eq!(icosphere(2).len(), 162, "10·4² + 2");
        assert!(!is_count(42) && !is_count(0));
    }

    #[test]
    fn the_zenith_is_an_edges_midpoint_and_the_coarser_sets_are_in_the_finer() {
        assert_eq!(directions(17)[0], Vec3::Z);
        let finer = directions(305);
        assert!(directions(73).iter().all(|d| finer.contains(d)));
        assert_eq!(directions(289), finer[..289], "the lowest sixteen are left out");
        assert!(finer[288].z > finer[289].z, "and no tie is cut in two");
    }

    #[test]
    fn neighbours_are_evenly_apart() {
        // On the subdivided icosahedron edges of one level differ by less than 30 %.
        let set = directions(305);
        let nearest = |d: &Vec3| set.iter().filter(|o| *o != d).map(|o| o.distance(*d)).fold(f32::MAX, f32::min);
        let (least, most) = set.iter().map(nearest).fold((f32::MAX, 0f32), |(a, b), x| (a.min(x), b.max(x)));
        assert!(most / least < 1.3, "{least} {most}");
    }
}
