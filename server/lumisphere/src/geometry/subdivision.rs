//! Finer triangles on the same surface.

use std::collections::HashMap;

use glam::Vec3;

use super::TriangleMesh;

/// Splits edges at their midpoints until none is longer than `max_edge(midpoint)`, without cracks between neighbours.
///
/// Whether an edge is split depends on its two end points alone, so both triangles at an edge agree. Stops early rather than exceed
/// `max_triangles`; a mesh that has more already is returned as it is. Normals and uv are interpolated.
pub fn subdivide(mesh: &TriangleMesh, max_edge: &dyn Fn(Vec3) -> f32, max_triangles: usize) -> TriangleMesh {
    let mut fine = mesh.clone();
    loop {
        let long = |a: u32, b: u32| {
            let (p, q) = (fine.positions[a as usize], fine.positions[b as usize]);
            p.distance(q) > max_edge(0.5 * (p + q))
        };
        let split: Vec<[bool; 3]> = fine.triangles.iter().map(|[a, b, c]| [long(*a, *b), long(*b, *c), long(*c, *a)]).collect();
        let added: usize = split.iter().flatten().filter(|s| **s).count();
        if added == 0 || fine.triangles.len() + added > max_triangles {
            return fine;
        }
        fine = split_once(fine, &split);
    }
}

fn split_once(mut mesh: TriangleMesh, split: &[[bool; 3]]) -> TriangleMesh {
    let mut midpoints: HashMap<(u32, u32), u32> = HashMap::new();
    let mut triangles = Vec::new();
    for (t, flags) in split.iter().enumerate() {
        let corner = mesh.triangles[t];
        let mut middle = [None; 3];
        for k in (0..3).filter(|k| flags[*k]) {
            middle[k] = Some(midpoint(&mut mesh, &mut midpoints, corner[k], corner[(k + 1) % 3]));
        }
        let [a, b, c] = corner;
        match middle {
            [None, None, None] => triangles.push(corner),
            [Some(m), None, None] => triangles.extend([[a, m, c], [m, b, c]]),
            [None, Some(m), None] => triangles.extend([[b, m, a], [m, c, a]]),
            [None, None, Some(m)] => triangles.extend([[c, m, b], [m, a, b]]),
            [Some(m), Some(n), None] => triangles.extend([[m, b, n], [a, m, n], [a, n, c]]),
            [None, Some(m), Some(n)] => triangles.extend([[m, c, n], [b, m, n], [b, n, a]]),
            [Some(n), None, Some(m)] => triangles.extend([[m, a, n], [c, m, n], [c, n, b]]),
            [Some(m), Some(n), Some(o)] => triangles.extend([[a, m, o], [m, b, n], [o, n, c], [m, n, o]]),
        }
    }
    mesh.triangles = triangles;
    mesh
}

fn midpoint(mesh: &mut TriangleMesh, known: &mut HashMap<(u32, u32), u32>, a: u32, b: u32) -> u32 {
    *known.entry((a.min(b), a.max(b))).or_insert_with(|| {
        let (i, j) = (a as usize, b as usize);
        mesh.positions.push(0.5 * (mesh.positions[i] + mesh.positions[j]));
        mesh.normals.push((mesh.normals[i] + mesh.normals[j]).normalize_or(mesh.normals[i]));
        mesh.uvs.push(0.5 * (mesh.uvs[i] + mesh.uvs[j]));
        (mesh.positions.len() - 1) as u32
    })
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;

    fn square() -> TriangleMesh {
        let corners = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
        TriangleMesh::new(corners.map(|c| c.extend(0.0)).to_vec(), vec![Vec3::Z; 4], corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]]).unwrap()
    }

    fn area(mesh: &TriangleMesh) -> f32 {
        (0..mesh.triangles.len()).map(|t| mesh.area_vector(t).z).sum()
    }

    #[test]
    fn every_edge_gets_short_and_the_surface_stays_the_same() {
        // Finer toward one corner, so that all cases of one, two and three split edges occur.
        let max_edge = |at: Vec3| 0.05 + 0.3 * at.length();
        let fine = subdivide(&square(), &max_edge, 100_000);
        for [a, b, c] in &fine.triangles {
            for (i, j) in [(a, b), (b, c), (c, a)] {
                let (p, q) = (fine.positions[*i as usize], fine.positions[*j as usize]);
                assert!(p.distance(q) <= max_edge(0.5 * (p + q)));
            }
        }
        // Signed areas: any flipped triangle would be counted against the sum twice.
        assert!((area(&fine) - 1.0).abs() < 1e-5);
        assert!((0..fine.triangles.len()).all(|t| fine.area_vector(t).z > 0.0));
        assert!(fine.positions.iter().zip(&fine.uvs).all(|(p, uv)| (p.truncate() - *uv).length() < 1e-6));
    }

    #[test]
    fn neighbours_share_every_split_edge() {
        let fine = subdivide(&square(), &|at: Vec3| 0.05 + 0.3 * at.length(), 100_000);
        let mut uses: HashMap<(u32, u32), usize> = HashMap::new();
        for [a, b, c] in &fine.triangles {
            for (i, j) in [(a, b), (b, c), (c, a)] {
                *uses.entry((*i.min(j), *i.max(j))).or_default() += 1;
            }
        }
        for ((i, j), n) in uses {
            let (p, q) = (fine.positions[i as usize], fine.positions[j as usize]);
            let border = (0..2).any(|k| p[k] == q[k] && (p[k] == 0.0 || p[k] == 1.0));
            assert_eq!(n, if border { 1 } else { 2 }, "{p} {q}");
        }
    }

    #[test]
    fn the_limit_is_kept() {
        assert!(subdivide(&square(), &|_| 1e-3, 1000).triangles.len() <= 1000);
    }
}
