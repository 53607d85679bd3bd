//! Requests: random ones, coherent ones over the faces that are stored, and those that were recorded of real rendering.

use std::path::Path;

use glam::Vec3;
use lumisphere::directions::face_from_direction;
use lumisphere::textures::{BLOCK_ROWS, ReadStrategy, Trace, TraceEvent};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::data::{FACES, SIZE};

/// Look-ups (face, x, y) anywhere.
pub fn random(count: usize) -> Vec<u32> {
    let mut rng = Pcg32::seed_from_u64(2);
    (0..count).flat_map(|_| [rng.random_range(0..FACES), rng.random_range(0..SIZE - 1), rng.random_range(0..SIZE - 1)]).collect()
}

/// Three faces in turn, moving on slowly.
pub fn warm(count: usize) -> Vec<u32> {
    let mut rng = Pcg32::seed_from_u64(3);
    let mut at: [[u32; 3]; 3] = std::array::from_fn(|k| [k as u32, 40, 60]);
    let mut look_ups = Vec::with_capacity(3 * count);
    for k in 0..count {
        let at = &mut at[k % 3];
        if rng.random_range(0..60u32) == 0 {
            at[0] = rng.random_range(0..FACES);
        }
        at[1] = (at[1] + rng.random_range(0..3u32)) % (SIZE - 1);
        at[2] = (at[2] + u32::from(rng.random_range(0..8u32) == 0)) % (SIZE - 1);
        look_ups.extend_from_slice(at);
    }
    look_ups
}

/// The three nearest of the sample points on the unit sphere.
struct SamplePoints(Vec<Vec3>);

impl SamplePoints {
    fn new(count: u32) -> Self {
        let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
        let point = |k: u32| {
            let y = 1.0 - (2 * k + 1) as f32 / count as f32;
            let r = (1.0 - y * y).sqrt();
            Vec3::new(r * (golden * k as f32).cos(), y, r * (golden * k as f32).sin())
        };
        Self((0..count).map(point).collect())
    }

    fn nearest(&self, x: Vec3) -> [u32; 3] {
        let mut best = [(f32::NEG_INFINITY, 0); 3];
        for (k, point) in (0..).zip(&self.0) {
            let near = point.dot(x);
            if near > best[2].0 {
                best[2] = (near, k);
                best.sort_by(|a, b| b.0.total_cmp(&a.0));
            }
        }
        best.map(|(_, k)| k)
    }
}

/// What the pixel centre (i, j) of a square view of the unit sphere sees, and the mirrored direction there.
fn reflection(eye: Vec3, pixels: u32, i: u32, j: u32) -> Option<(Vec3, Vec3)> {
    let forward = -eye.normalize();
    let right = forward.cross(Vec3::Y).normalize();
    let up = right.cross(forward);
    let offset = |k: u32| 0.38 * ((2 * k + 1) as f32 / pixels as f32 - 1.0);
    let d = (forward + offset(i) * right - offset(j) * up).normalize();
    let (b, c) = (eye.dot(d), eye.length_squared() - 1.0);
    let discriminant = b * b - c;
    if !(discriminant > 0.0) {
        return None;
    }
    let x = eye + (-b - discriminant.sqrt()) * d;
    Some((x, d - 2.0 * x.dot(d) * x))
}

/// Pixels in buckets of 16², as the renderer goes.
fn in_buckets(pixels: u32) -> impl Iterator<Item = (u32, u32)> {
    let buckets = pixels / 16;
    (0..buckets * buckets).flat_map(move |b| (0..256).map(move |k| (b % buckets * 16 + k % 16, b / buckets * 16 + k / 16)))
}

/// A cos⁴⁰ lobe.
fn around(axis: Vec3, rng: &mut Pcg32) -> Vec3 {
    let cosine = rng.random_range(0.0..1.0f32).powf(1.0 / 41.0);
    let angle = rng.random_range(0.0..std::f32::consts::TAU);
    let (tangent, bitangent) = axis.any_orthonormal_pair();
    let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
    sine * (angle.cos() * tangent + angle.sin() * bitangent) + cosine * axis
}

/// The faces that a recording of `lumisphere cache record` asks for; its other part, the sample maps, is left out.
pub fn recorded(path: &Path) -> Trace {
    let bytes = std::fs::read(path)
        .unwrap_or_else(|error| panic!("recording missing, see the head of this benchmark: {}: {error}", path.display()));
    let trace = Trace::from_bytes(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert!(!trace.is_truncated, "{} ends before what was rendered", path.display());
    trace.only(0).expect("a recording of some dataset")
}

/// What is cached as one, whole pages or blocks, in the order of their visits.
pub fn visits(trace: &Trace, strategy: ReadStrategy) -> Vec<u32> {
    let blocks = trace.versions[0].shape.height.div_ceil(BLOCK_ROWS);
    let unit = |event: &TraceEvent| match *event {
        TraceEvent::Row { page, row, .. } if strategy == ReadStrategy::Block => Some(page.0 * blocks + row / BLOCK_ROWS),
        TraceEvent::Row { page, .. } | TraceEvent::Page { page, .. } => Some(page.0),
        TraceEvent::Frame => None,
    };
    let mut visits: Vec<Option<u32>> = trace.events.iter().map(unit).collect();
    visits.dedup();
    visits.into_iter().flatten().collect()
}

/// Glossy look-ups (face, x, y) over the faces that are stored: a view of a sphere of 128 sample points with cube maps, after the offset
/// surface light field; the three points nearest to what a pixel sees are read in turn.
pub fn glossy_look_ups() -> Vec<u32> {
    let points = SamplePoints::new(FACES / 6);
    let mut rng = Pcg32::seed_from_u64(5);
    let mut look_ups = Vec::new();
    for (i, j) in in_buckets(96) {
        let Some((x, mirrored)) = reflection(Vec3::new(2.2, -1.6, 1.3), 96, i, j) else { continue };
        let nearest = points.nearest(x);
        for _ in 0..16 {
            let (face, st) = face_from_direction(around(mirrored, &mut rng));
            let texel = |s: f32| ((0.5 * (s + 1.0) * SIZE as f32) as u32).min(SIZE - 2);
            look_ups.extend(nearest.iter().flat_map(|cube| [cube * 6 + face as u32, texel(st.x), texel(st.y)]));
        }
    }
    look_ups
}
