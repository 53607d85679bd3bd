//! Cube maps: faces +X −X +Y −Y +Z −Z in the graphics API's (OpenGL's) orientation, read bilinearly and seamlessly.
//!
//! With s to the right and t down in [−1, 1] on a face, texel centres at half integers, the directions are
//! `+X (1,−t,−s)  −X (−1,−t,s)  +Y (s,1,t)  −Y (s,−1,−t)  +Z (s,−t,1)  −Z (−s,−t,−1)`.

use glam::{Vec2, Vec3, Vec4};

/// How many faces a cube has.
pub const FACES: usize = 6;

/// Incident radiance and distance from one point toward every direction.
///
/// `texels[(face · size + row) · size + column]` = linear R, G, B (mean over the texel) and the distance along the texel's
/// central direction to what is seen there, in the scene's length unit, +∞ where nothing is.
#[derive(Debug, Clone, PartialEq)]
pub struct CubeMap {
    /// Texels along one edge of a face.
    pub size: usize,
    /// R, G, B, distance; length 6·size².
    pub texels: Vec<[f32; 4]>,
}

/// One texel of a cube map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Texel {
    /// 0…5.
    pub face: usize,
    /// 0…size−1, to the right.
    pub column: usize,
    /// 0…size−1, downward.
    pub row: usize,
}

/// The four texels of a bilinear read and their weights (sum 1). At a cube's corner three texels meet; the fourth repeats one with weight 0.
pub type Footprint = [(Texel, f32); 4];

/// Direction (not normalised: its major component is ±1) at (s, t) in [−1, 1]² of `face`.
pub fn direction_from_face(face: usize, s: f32, t: f32) -> Vec3 {
    match face {
        0 => Vec3::new(1.0, -t, -s),
        1 => Vec3::new(-1.0, -t, s),
        2 => Vec3::new(s, 1.0, t),
        3 => Vec3::new(s, -1.0, -t),
        4 => Vec3::new(s, -t, 1.0),
        _ => Vec3::new(-s, -t, -1.0),
    }
}

/// The face that a direction (any length above zero) pierces, and (s, t) there. Ties go to x, then y.
pub fn face_from_direction(d: Vec3) -> (usize, Vec2) {
    let a = d.abs();
    if a.x >= a.y && a.x >= a.z {
        if d.x > 0.0 { (0, Vec2::new(-d.z, -d.y) / a.x) } else { (1, Vec2::new(d.z, -d.y) / a.x) }
    } else if a.y >= a.z {
        if d.y > 0.0 { (2, Vec2::new(d.x, d.z) / a.y) } else { (3, Vec2::new(d.x, -d.z) / a.y) }
    } else if d.z > 0.0 {
        (4, Vec2::new(d.x, -d.y) / a.z)
    } else {
        (5, Vec2::new(-d.x, -d.y) / a.z)
    }
}

/// Unit direction at position (column, row) in texels of a face with `size` texels an edge; centres at half integers.
pub fn texel_direction(face: usize, size: usize, column: f32, row: f32) -> Vec3 {
    let scale = 2.0 / size as f32;
    direction_from_face(face, column * scale - 1.0, row * scale - 1.0).normalize()
}

/// Solid angle of a texel, sr: exact, from the corners' `atan2(st, √(s²+t²+1))`.
pub fn texel_solid_angle(size: usize, column: usize, row: usize) -> f32 {
    let corner = |c: usize, r: usize| {
        let (s, t) = (2.0 * c as f64 / size as f64 - 1.0, 2.0 * r as f64 / size as f64 - 1.0);
        (s * t).atan2((s * s + t * t + 1.0).sqrt())
    };
    (corner(column, row) - corner(column + 1, row) - corner(column, row + 1) + corner(column + 1, row + 1)) as f32
}

/// Texels and weights of a bilinear read toward `d` (any length above zero), continuous across face edges.
pub fn bilinear_footprint(d: Vec3, size: usize) -> Footprint {
    let (face, st) = face_from_direction(d);
    let at = (st + 1.0) * (0.5 * size as f32) - 0.5;
    let base = at.floor();
    let f = at - base;
    let (x, y) = (base.x as i32, base.y as i32);
    let corners =
        [(x, y, (1.0 - f.x) * (1.0 - f.y)), (x + 1, y, f.x * (1.0 - f.y)), (x, y + 1, (1.0 - f.x) * f.y), (x + 1, y + 1, f.x * f.y)];
    let found = corners.map(|(x, y, w)| (neighbour(face, x, y, size), w));
    let fallback = found.iter().find_map(|(t, _)| *t).unwrap_or(Texel { face, column: 0, row: 0 });
    let sum: f32 = found.iter().map(|(t, w)| if t.is_some() { *w } else { 0.0 }).sum();
    found.map(|(t, w)| t.map_or((fallback, 0.0), |t| (t, w / sum)))
}

// The texel at (x, y) of `face`, which may lie one beyond an edge: then the texel across it. None beyond a corner.
fn neighbour(face: usize, x: i32, y: i32, size: usize) -> Option<Texel> {
    let n = size as i32;
    let inside = |v: i32| (0..n).contains(&v);
    match (inside(x), inside(y)) {
        (true, true) => return Some(Texel { face, column: x as usize, row: y as usize }),
        (false, false) => return None,
        _ => {}
    }
    // Just across the edge the coordinate along it is unchanged; 1e-4 is far below half a texel for any size we store.
    let across = |v: i32| if inside(v) { (2.0 * v as f32 + 1.0) / n as f32 - 1.0 } else { 1.0001f32.copysign(v as f32 - 0.5) };
    let (face, st) = face_from_direction(direction_from_face(face, across(x), across(y)));
    let texel = |c: f32| (((c + 1.0) * 0.5 * n as f32) as i32).clamp(0, n - 1) as usize;
    Some(Texel { face, column: texel(st.x), row: texel(st.y) })
}

impl CubeMap {
    /// All texels black and at infinite distance.
    pub fn black(size: usize) -> Self {
        Self { size, texels: vec![[0.0, 0.0, 0.0, f32::INFINITY]; FACES * size * size] }
    }

    /// Where a texel lies in `texels`.
    pub fn index(&self, t: Texel) -> usize {
        (t.face * self.size + t.row) * self.size + t.column
    }

    /// R, G, B, distance toward `d`, bilinear and seamless. Distance is infinite if any contributing texel's is.
    pub fn sample(&self, d: Vec3) -> Vec4 {
        bilinear_footprint(d, self.size).iter().filter(|(_, w)| *w > 0.0).map(|(t, w)| Vec4::from(self.texels[self.index(*t)]) * *w).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn face_and_direction_invert_each_other_on_every_face() {
        for face in 0..FACES {
            for (s, t) in [(0.0, 0.0), (0.7, -0.3), (-0.9, 0.95)] {
                let (f, st) = face_from_direction(3.0 * direction_from_face(face, s, t));
                assert_eq!(f, face);
                assert!((st - Vec2::new(s, t)).length() < 1e-6);
            }
        }
    }

    #[test]
    fn solid_angles_sum_to_the_sphere() {
        let sum: f64 = (0..8).flat_map(|r| (0..8).map(move |c| texel_solid_angle(8, c, r) as f64)).sum();
        assert!((6.0 * sum - 4.0 * std::f64::consts::PI).abs() < 1e-5);
    }

    #[test]
    fn a_read_of_a_smooth_function_has_no_seam_at_edges_and_corners() {
        let size = 16;
        let mut map = CubeMap::black(size);
        for face in 0..FACES {
            for row in 0..size {
                for column in 0..size {
                    let d = texel_direction(face, size, column as f32 + 0.5, row as f32 + 0.5);
                    let i = map.index(Texel { face, column, row });
                    map.texels[i] = [d.x, d.y, d.z, 1.0];
                }
            }
        }
        // The stored function is the direction itself: bilinear error ≤ h²/8·|f''| plus the kink at an edge, under one texel (2/16).
        for i in 0..500u32 {
            let u = |k: u32| ((i * 7919 + k * 104729) % 1000) as f32 / 500.0 - 1.0;
            let d = Vec3::new(u(1), u(2), u(3)).normalize_or(Vec3::X);
            assert!((map.sample(d).truncate() - d).length() < 0.05, "{d}: {}", map.sample(d));
        }
        // Continuity: crossing an edge by 1e-4 changes the read by no more than the function's own slope allows.
        for d in [Vec3::new(1.0, 1.0, 0.3), Vec3::new(-1.0, 0.2, 1.0), Vec3::new(0.1, -1.0, -1.0), Vec3::new(1.0, 1.0, 1.0)] {
            for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
                let step = map.sample(d + 1e-4 * axis) - map.sample(d - 1e-4 * axis);
                assert!(step.length() < 2e-3, "{d} {axis}: {step}");
            }
        }
    }

    #[test]
    fn weights_sum_to_one_everywhere() {
        for d in [Vec3::ONE, Vec3::X, Vec3::new(1.0, 0.999, -1.0), Vec3::new(-0.3, 0.2, -0.9)] {
            for size in [1, 2, 7] {
                let sum: f32 = bilinear_footprint(d, size).iter().map(|(_, w)| w).sum();
                assert!((sum - 1.0).abs() < 1e-6);
            }
        }
    }
}
