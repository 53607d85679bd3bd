//! Generated textures, painted in sRGB codes. Each follows its seed and size only.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::super::noise;
use crate::images::Rgb8;

// Paints a square picture; `colour` gets positions in [0, 1]², y down. `subsamples` along a texel's edge: patterns with sharp
// outlines need some, noise as fine as the texels none.
pub(super) fn paint(size: u32, subsamples: usize, colour: impl Fn(Vec2) -> Vec3 + Sync) -> Rgb8 {
    let size = size as usize;
    let texel = |index: usize| {
        let corner = Vec2::new((index % size) as f32, (index / size) as f32);
        let mut sum = Vec3::ZERO;
        for i in 0..subsamples * subsamples {
            let inside = Vec2::new((i % subsamples) as f32 + 0.5, (i / subsamples) as f32 + 0.5) / subsamples as f32;
            sum += colour((corner + inside) / size as f32);
        }
        let mean = sum / (subsamples * subsamples) as f32;
        mean.to_array().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8)
    };
    let texels: Vec<[u8; 3]> = (0..size * size).into_par_iter().map(texel).collect();
    Rgb8 { width: size, height: size, bytes: texels.into_flattened() }
}

/// A round gingham cloth laid out flat, seen from above: red and blue checks of twill, an embroidered flower in every fourth white
/// check, a border of scallops and dots. `checks` across the whole cloth.
pub(super) fn cloth(size: u32, checks: f32) -> Rgb8 {
    paint(size, 2, |at| border(2.0 * at - 1.0).unwrap_or_else(|| gingham(at * checks)))
}

// In [0, 1), also below zero; several times faster than the remainder.
pub(super) fn fract(v: f32) -> f32 {
    v - v.floor()
}

/// 0 up to t = 0, 1 from t = 1 on, without a kink.
pub(super) fn smooth_step(t: f32) -> f32 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

const WHITE: Vec3 = Vec3::new(0.96, 0.95, 0.91);
const RED: Vec3 = Vec3::new(0.78, 0.08, 0.12);
const BLUE: Vec3 = Vec3::new(0.10, 0.18, 0.55);
const GOLD: Vec3 = Vec3::new(0.90, 0.68, 0.16);

// `at` in checks.
fn gingham(at: Vec2) -> Vec3 {
    let (cell, inside) = (at.floor(), at - at.floor());
    let odd = |v: f32| fract(0.5 * v) >= 0.5;
    // Twill: half the threads of a mixed check are coloured, in diagonals.
    let thread = |slope: f32| fract(4.0 * (inside.x + slope * inside.y)) < 0.5;
    match (odd(cell.x), odd(cell.y)) {
        (true, true) => RED,
        (true, false) if thread(1.0) => RED,
        (false, true) if thread(-1.0) => BLUE,
        (false, false) => flower(cell, inside),
        _ => WHITE,
    }
}

fn flower(cell: Vec2, inside: Vec2) -> Vec3 {
    let chosen = fract(0.25 * (cell.x + cell.y)) < 0.5;
    let p = inside - 0.5;
    let petal = || 0.22 + 0.14 * (5.0 * p.y.atan2(p.x)).cos();
    match p.length() {
        r if r > 0.36 => WHITE,
        // Cross-stitch in every other one.
        r if !chosen => {
            if r < 0.2 && (p.x.abs() - p.y.abs()).abs() < 0.05 {
                RED
            } else {
                WHITE
            }
        }
        r if r < 0.09 => GOLD,
        r if r < petal() => BLUE,
        _ => WHITE,
    }
}

// Bands from the hem inward, `at` and widths in parts of the cloth's radius; None inside them.
fn border(at: Vec2) -> Option<Vec3> {
    const REPEATS: f32 = 120.0;
    let radius = at.length();
    if radius <= 0.885 {
        return None;
    }
    if radius > 1.0 {
        return Some(WHITE);
    }
    let phase = fract(at.y.atan2(at.x) / TAU * REPEATS) - 0.5;
    // Length of one repeat along the circumference, so that dots are round.
    let step = TAU * radius / REPEATS;
    match radius {
        r if r > 0.965 => Some(if (r - 0.965) < 0.03 * (1.0 - 4.0 * phase * phase) { RED } else { WHITE }),
        r if r > 0.950 => Some(BLUE),
        r if r > 0.905 => {
            let dot = Vec2::new(phase * step, r - 0.9275).length() < 0.011;
            Some(if dot { RED } else { WHITE })
        }
        r if r > 0.895 => Some(GOLD),
        _ => Some(BLUE),
    }
}

/// Floorboards along y, seen from above: `boards` of them, of staggered lengths and differing shades, with grain and gaps.
pub(super) fn planks(size: u32, seed: u32, boards: f32) -> Rgb8 {
    paint(size, 1, |at| {
        let board = (at.x * boards).floor();
        let across = (at.x * boards).fract();
        let along = at.y * 5.0 + noise::unit(seed, board as i32, 7);
        let piece = along.floor();
        let shade = 0.75 + 0.35 * noise::unit(seed, board as i32 * 31 + 5, piece as i32);
        let grain = noise::fractal(seed.wrapping_add(9), across * 6.0 + 13.0 * board, along * 1.7 + 3.0 * piece, 1 << 12, 4);
        let gap = across < 0.035 || along.fract() < 0.006;
        let wood = Vec3::new(0.62, 0.44, 0.29) * shade * (0.75 + 0.5 * grain);
        if gap { Vec3::new(0.10, 0.07, 0.05) } else { wood }
    })
}

/// Painted or bare timber: streaks along x.
pub(super) fn timber(size: u32, seed: u32) -> Rgb8 {
    paint(size, 1, |at| {
        let grain = noise::fractal(seed, at.x * 4.0, at.y * 48.0, 1 << 10, 4);
        Vec3::new(0.50, 0.34, 0.22) * (0.65 + 0.7 * grain)
    })
}

/// Grass that may be laid side by side: blades as fine noise over worn patches, daisies here and there.
pub(super) fn grass(size: u32, seed: u32) -> Rgb8 {
    paint(size, 1, |at| {
        let patch = noise::fractal(seed, at.x * 8.0, at.y * 8.0, 8, 4);
        let blade = noise::value(seed.wrapping_add(50), at.x * 256.0, at.y * 256.0, 256);
        let cell = (at * 48.0).floor();
        let centre =
            Vec2::new(noise::unit(seed, cell.x as i32, 100 + cell.y as i32), noise::unit(seed, 200 + cell.x as i32, cell.y as i32));
        let daisy = noise::unit(seed.wrapping_add(3), cell.x as i32, cell.y as i32) < 0.06
            && ((at * 48.0 - cell) - (0.2 + 0.6 * centre)).length() < 0.10;
        let green = Vec3::new(0.28, 0.44, 0.14).lerp(Vec3::new(0.48, 0.56, 0.24), patch) * (0.55 + 0.7 * blade);
        if daisy { Vec3::new(0.93, 0.93, 0.88) } else { green }
    })
}

/// Foliage: clumps of lit and shaded leaves.
pub(super) fn leaves(size: u32, seed: u32) -> Rgb8 {
    paint(size, 1, |at| {
        let clump = noise::fractal(seed, at.x * 12.0, at.y * 12.0, 12, 3);
        let leaf = noise::value(seed.wrapping_add(20), at.x * 96.0, at.y * 96.0, 96);
        Vec3::new(0.16, 0.32, 0.09).lerp(Vec3::new(0.42, 0.56, 0.20), leaf) * (0.45 + 0.85 * clump)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cloth_is_finely_patterned_in_several_colours() {
        let cloth = cloth(1024, 72.0);
        let near = |i: usize, c: Vec3| (Vec3::from([0, 1, 2].map(|k| cloth.bytes[3 * i + k] as f32 / 255.0)) - c).length() < 0.1;
        for colour in [WHITE, RED, BLUE, GOLD] {
            let count = (0..1024 * 1024).filter(|i| near(*i, colour)).count();
            assert!(count > 1024 * 1024 / 200, "{colour}: {count}");
        }
        // Fine: along the middle row colours change at least twice a check.
        let row: Vec<bool> = (0..1024).map(|x| near(512 * 1024 + x, WHITE)).collect();
        assert!(row.windows(2).filter(|w| w[0] != w[1]).count() > 144);
    }

    #[test]
    fn grass_and_leaves_join_at_their_borders() {
        for picture in [grass(256, 1), leaves(256, 1)] {
            let luminance = |x: usize, y: usize| picture.pixel(x, y).iter().map(|c| *c as f32).sum::<f32>();
            let step = |a: usize, b: usize| (0..256).map(|y| (luminance(a, y) - luminance(b, y)).abs()).sum::<f32>();
            assert!(step(255, 0) < 1.5 * step(100, 101).max(step(30, 31)), "{} against {}", step(255, 0), step(100, 101));
        }
    }
}
