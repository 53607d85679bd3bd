//! Which texels of a light field's cube maps show the object that they were captured around: none of them may be taken for what is behind it.
//!
//! Distances do not tell: where the object stands on a table both are equally far, and a texel's radiance is the mean over its square, its distance
//! that of its centre. So the object's triangles are drawn into every cube map conservatively (every texel that they touch counts), in front of
//! everything. Called by `surroundings.rs`. Faces and their (s, t) are those of `directions::cube_map`.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::super::OffsetSurfaceLightField;
use crate::directions::{FACES, Texel};
use crate::progress::{Cancelled, Progress};

/// Of all masks together; where finest texels would take more, a bit stands for four of them, or sixteen, …
const MOST_BYTES: usize = 64 << 20;
/// Texels by which triangles are taken to be larger: what rounding could hide.
const MARGIN: f32 = 0.01;
/// Cube maps between two reports.
const BATCH: usize = 64;

/// A bit a texel.
pub(super) struct OldObject {
    /// Cube maps, faces, rows, columns.
    bits: Vec<u64>,
    words_per_cube: usize,
    /// Texels an edge that have a bit of their own, or share it.
    size: usize,
    /// Halvings between the cube maps' texels and these.
    level: u32,
}

impl OldObject {
    /// Of every sample point's cube map.
    pub fn new(field: &OffsetSurfaceLightField, progress: &dyn Progress) -> Result<Self, Cancelled> {
        let (cubes, face_size) = (field.sample_points.len(), field.parameters.face_size_texels as usize);
        let words = |level: u32| (FACES * face_size.div_ceil(1 << level).pow(2)).div_ceil(64);
        let level = (0..face_size.ilog2()).find(|level| cubes * words(*level) * 8 <= MOST_BYTES).unwrap_or(face_size.ilog2());
        let mut mask = Self { bits: Vec::new(), words_per_cube: words(level), size: face_size.div_ceil(1 << level), level };
        mask.bits = vec![0; cubes * mask.words_per_cube];
        let (size, per_cube, texels) = (mask.size, mask.words_per_cube, face_size as f32 / (1 << level) as f32);
        let mesh = &field.surface.mesh;
        let batches = mask.bits.chunks_mut(BATCH * per_cube).zip(field.sample_points.chunks(BATCH));
        for (number, (bits, points)) in batches.enumerate() {
            progress.report("finding the old object", (BATCH * number) as u64, cubes as u64);
            if progress.is_cancelled() {
                return Err(Cancelled);
            }
            bits.par_chunks_mut(per_cube).zip(points).for_each(|(bits, point)| {
                let mut drawing = Drawing { bits, size, texels, polygon: Vec::new(), clipped: Vec::new() };
                for t in &mesh.triangles {
                    drawing.draw(t.map(|v| mesh.positions[v as usize] - point.position));
                }
            });
        }
        Ok(mask)
    }

    /// Whether anything of the object may be in this texel of the finest level.
    pub fn is_in(&self, cube: u32, texel: Texel) -> bool {
        let (row, column) = (texel.row >> self.level, texel.column >> self.level);
        let at = (texel.face * self.size + row) * self.size + column;
        self.bits[cube as usize * self.words_per_cube + at / 64] >> (at % 64) & 1 == 1
    }
}

/// One cube map's bits.
struct Drawing<'a> {
    bits: &'a mut [u64],
    size: usize,
    /// Along a face's edge, of these; not a whole number where the last is cut.
    texels: f32,
    polygon: Vec<Vec3>,
    clipped: Vec<Vec3>,
}

impl Drawing<'_> {
    /// Corners as seen from the cube map's place.
    fn draw(&mut self, corners: [Vec3; 3]) {
        for face in 0..FACES {
            // In front of the face, x to the right and y down, all inside where |x| ≤ z and |y| ≤ z.
            let seen = corners.map(|corner| on_face(face, corner));
            let widen = 1.0 + 2.0 * MARGIN / self.texels;
            let sides = [Vec3::new(1.0, 0.0, widen), Vec3::new(-1.0, 0.0, widen), Vec3::new(0.0, 1.0, widen), Vec3::new(0.0, -1.0, widen)];
            if sides.iter().any(|side| seen.iter().all(|p| side.dot(*p) < 0.0)) {
                continue;
            }
            self.polygon.clear();
            self.polygon.extend(seen);
            for side in sides {
                self.clip(side);
            }
            self.mark(face);
        }
    }

    /// What of the polygon has `side · p ≥ 0` (Sutherland & Hodgman 1974).
    fn clip(&mut self, side: Vec3) {
        self.clipped.clear();
        let mut before = *self.polygon.last().unwrap_or(&Vec3::ZERO);
        for &p in &self.polygon {
            let (a, b) = (side.dot(before), side.dot(p));
            if (a < 0.0) != (b < 0.0) {
                self.clipped.push(before + (a / (a - b)) * (p - before));
            }
            if b >= 0.0 {
                self.clipped.push(p);
            }
            before = p;
        }
        std::mem::swap(&mut self.polygon, &mut self.clipped);
    }

    /// Every texel that the polygon touches.
    fn mark(&mut self, face: usize) {
        if self.polygon.is_empty() {
            return;
        }
        let place = |p: &Vec3| (p.truncate() / p.z.max(f32::MIN_POSITIVE) + 1.0) * (0.5 * self.texels);
        let (low, high) = self.polygon.iter().map(place).fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
        let last = self.size as i64 - 1;
        let texel = |at: f32| (at.floor() as i64).clamp(0, last) as usize;
        let (left, right) = (texel(low.x - MARGIN), texel(high.x + MARGIN));
        let (top, bottom) = (texel(low.y - MARGIN), texel(high.y + MARGIN));
        let is_small = right - left < 2 && bottom - top < 2;
        let polygon: Vec<Vec2> = if is_small { Vec::new() } else { self.polygon.iter().map(place).collect() };
        for row in top..=bottom {
            for column in left..=right {
                if is_small || touches(&polygon, Vec2::new(column as f32, row as f32)) {
                    let at = (face * self.size + row) * self.size + column;
                    self.bits[at / 64] |= 1 << (at % 64);
                }
            }
        }
    }
}

/// Whether a convex polygon may touch the square of edge 1 at `corner`: no edge of it has the whole square outside.
fn touches(polygon: &[Vec2], corner: Vec2) -> bool {
    let area: f32 = polygon.iter().zip(polygon.iter().cycle().skip(1)).map(|(a, b)| a.perp_dot(*b)).sum();
    let middle = corner + 0.5;
    polygon.iter().zip(polygon.iter().cycle().skip(1)).all(|(a, b)| {
        let inward = (*b - *a).perp() * area.signum();
        // The square's corner that lies furthest inward.
        inward.dot(middle - *a) + (0.5 + MARGIN) * (inward.x.abs() + inward.y.abs()) >= 0.0
    })
}

/// A direction in a face's own axes: s and t times the third.
fn on_face(face: usize, d: Vec3) -> Vec3 {
    match face {
        0 => Vec3::new(-d.z, -d.y, d.x),
        1 => Vec3::new(d.z, -d.y, -d.x),
        2 => Vec3::new(d.x, d.z, d.y),
        3 => Vec3::new(d.x, -d.z, -d.y),
        4 => Vec3::new(d.x, -d.y, d.z),
        _ => Vec3::new(-d.x, -d.y, -d.z),
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::tests::fixture::{WORLD, World};
    use super::*;
    use crate::directions::texel_direction;
    use crate::progress::Unattended;
    use crate::raytrace::{Bvh, Stack};

    /// Many rays a texel find no triangle in a texel that is not marked, and nearly every one that is marked.
    #[test]
    fn every_texel_that_touches_the_object_is_marked_and_few_others_are() {
        let (field, _) = World { face_size: 16, ..WORLD }.build();
        let mask = OldObject::new(&field, &Unattended).unwrap();
        let mesh = &field.surface.mesh;
        let corners: Vec<[Vec3; 3]> = mesh.triangles.iter().map(|t| t.map(|v| mesh.positions[v as usize])).collect();
        let (bvh, mut stack) = (Bvh::build(&corners), Stack::new());
        let (mut marked, mut met) = (0, 0);
        for (cube, point) in field.sample_points.iter().enumerate().step_by(7) {
            for at in 0..FACES * 256 {
                let texel = Texel { face: at / 256, row: at / 16 % 16, column: at % 16 };
                let place = |k: usize| ((k % 9) as f32 / 8.0, (k / 9) as f32 / 8.0);
                let toward = |(x, y): (f32, f32)| texel_direction(texel.face, 16, texel.column as f32 + x, texel.row as f32 + y);
                let is_met = (0..81).any(|k| bvh.nearest(point.position, toward(place(k)), f32::INFINITY, &mut stack).is_some());
                assert!(!is_met || mask.is_in(cube as u32, texel), "cube map {cube}, {texel:?}");
                marked += usize::from(mask.is_in(cube as u32, texel));
                met += usize::from(is_met);
            }
        }
        assert!(met > 1000 && marked as f64 <= 1.06 * met as f64, "{marked} marked, {met} met");
    }
}
