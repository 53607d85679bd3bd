//! The nine materials: what each reflects and how it stands out, as functions of place.
//!
//! Places are within the patch, [0, 1]², x along +X and y along +Z: seen from above with −Z up, x right and y down. Heights are in the
//! scene's unit; a patch is 0.308 wide.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use super::super::super::noise;
use super::super::patterns::{fract, smooth_step};
use super::foil::Creases;

/// One of the nine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Patch {
    PaperTowel,
    Cloth,
    DuctTape,
    ClearTape,
    RedPlastic,
    SilverFoil,
    GoldFoil,
    Flyer,
    Wood,
}

/// How a place reflects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finish {
    /// Of the diffuse part, sRGB codes from 0 to 1.
    pub code: Vec3,
    /// At normal incidence, linear.
    pub specular: Vec3,
    /// α along x and y.
    pub roughness: Vec2,
}

impl Finish {
    /// Uncoated.
    pub const PAPER: Self = Self { code: Vec3::new(0.93, 0.93, 0.90), specular: Vec3::ZERO, roughness: Vec2::ONE };

    /// A surface of refractive index 1.5, which reflects 4 %, over a colour.
    const fn coated(code: Vec3, roughness: f32) -> Self {
        Self { code, specular: Vec3::splat(0.04), roughness: Vec2::splat(roughness) }
    }

    const fn metal(specular: Vec3, roughness: f32) -> Self {
        Self { code: Vec3::ZERO, specular, roughness: Vec2::splat(roughness) }
    }
}

impl Patch {
    /// Rows from far (−Z) to near, each from left to right.
    pub const ALL: [[Self; 3]; 3] = [
        [Self::PaperTowel, Self::Cloth, Self::DuctTape],
        [Self::ClearTape, Self::RedPlastic, Self::SilverFoil],
        [Self::GoldFoil, Self::Flyer, Self::Wood],
    ];

    /// How it reflects at a place.
    pub fn finish(self, seed: u32, at: Vec2) -> Finish {
        match self {
            Self::PaperTowel => Finish { code: towel_code(seed, at), ..Finish::PAPER },
            Self::Cloth => Finish { code: cloth_code(at), ..Finish::PAPER },
            Self::DuctTape => Finish { specular: Vec3::splat(0.12), ..Finish::coated(duct_code(at), 0.28) },
            Self::ClearTape => clear_tape(at),
            Self::RedPlastic => Finish::coated(Vec3::new(0.76, 0.06, 0.07), 0.05),
            Self::SilverFoil => Finish::metal(Vec3::new(0.91, 0.92, 0.92), 0.06),
            Self::GoldFoil => Finish::metal(Vec3::new(0.93, 0.68, 0.30), 0.14),
            Self::Flyer => Finish::coated(flyer_code(seed, at), 0.16),
            Self::Wood => wood(seed, at),
        }
    }

    /// How far it stands out, 0 to 0.01.
    pub fn height(self, seed: u32, at: Vec2) -> f32 {
        match self {
            Self::PaperTowel => towel_height(seed, at),
            Self::Cloth => 0.0022 * weave(at).1 + 0.005 * noise::fractal(seed.wrapping_add(11), 3.0 * at.x, 3.0 * at.y, 64, 2),
            Self::DuctTape => duct_height(at),
            Self::ClearTape => clear_tape_height(seed, at),
            Self::RedPlastic => plastic_height(at),
            Self::SilverFoil => Creases { seed: seed.wrapping_add(21), widths: [0.15, 0.30] }.height(at),
            Self::GoldFoil => Creases { seed: seed.wrapping_add(22), widths: [0.09, 0.20] }.height(at),
            Self::Flyer => 0.0015 * (PI * at.x).sin() * (0.5 + 0.5 * (2.5 * at.y + 1.0).sin()),
            Self::Wood => 0.0008 * grain(seed, at),
        }
    }
}

// Embossed quilting: round bumps in a lattice of diamonds, on crinkled tissue.
fn towel_bump(at: Vec2) -> f32 {
    const BUMPS: f32 = 7.0;
    let turned = BUMPS * Vec2::new(at.x + at.y, at.x - at.y);
    let from_centre = (turned - turned.floor() - 0.5).length();
    1.0 - smooth_step((from_centre - 0.12) / 0.3)
}

fn tissue(seed: u32, at: Vec2) -> f32 {
    noise::fractal(seed.wrapping_add(10), 40.0 * at.x, 40.0 * at.y, 1 << 10, 2)
}

fn towel_height(seed: u32, at: Vec2) -> f32 {
    0.0045 * towel_bump(at) + 0.0006 * tissue(seed, at)
}

fn towel_code(seed: u32, at: Vec2) -> Vec3 {
    Vec3::new(0.95, 0.94, 0.92) * (0.96 + 0.04 * tissue(seed, at))
}

/// Threads across a patch.
const THREADS: f32 = 18.0;

// Plain weave: which thread lies on top (true: one that runs along y), and how high, 0 to 1.
fn weave(at: Vec2) -> (bool, f32) {
    let at = THREADS * at;
    let (cell, inside) = (at.floor(), at - at.floor());
    let warp = fract(0.5 * (cell.x + cell.y)) < 0.25;
    let (across, along) = if warp { (inside.x, inside.y) } else { (inside.y, inside.x) };
    // Round, and bent over the thread below it.
    let round = 1.0 - (2.0 * across - 1.0).powi(2);
    (warp, round * (0.35 + 0.65 * (PI * along).sin()))
}

// A kitchen cloth: white with blue checks.
fn cloth_code(at: Vec2) -> Vec3 {
    let (warp, height) = weave(at);
    let thread = (THREADS * if warp { at.x } else { at.y }).floor();
    let is_blue = thread.rem_euclid(6.0) < 3.0;
    let colour = if is_blue { Vec3::new(0.24, 0.38, 0.66) } else { Vec3::new(0.92, 0.91, 0.87) };
    colour * (0.82 + 0.18 * height)
}

/// Strips of duct tape, one over the next.
const STRIPS: f32 = 3.0;

// Fabric shows through as a fine net.
fn duct_net(at: Vec2) -> f32 {
    let line = |v: f32| (1.0 - 2.0 * (fract(v) - 0.5).abs()).powi(3);
    line(16.0 * at.x).max(line(24.0 * at.y))
}

fn duct_code(at: Vec2) -> Vec3 {
    let at_edge = fract(STRIPS * at.y) < 0.02;
    Vec3::new(0.50, 0.52, 0.54) * if at_edge { 0.75 } else { 0.93 + 0.07 * duct_net(at) }
}

fn duct_height(at: Vec2) -> f32 {
    // Each strip lies on the end of the one before: it rises to its own edge.
    let within = fract(STRIPS * at.y);
    let overlap = (1.0 - smooth_step(within / 0.25)) * smooth_step(within / 0.03);
    0.0012 * overlap + 0.0004 * duct_net(at)
}

// Whether tape lies there: two strips over ruled paper, torn in a zigzag at both ends.
fn is_taped(at: Vec2) -> bool {
    let tooth = 0.02 * (1.0 - 2.0 * (fract(18.0 * at.y) - 0.5).abs());
    let ends = at.x > 0.06 + tooth && at.x < 0.96 - tooth;
    ends && ((0.10..0.44).contains(&at.y) || (0.54..0.88).contains(&at.y))
}

fn clear_tape(at: Vec2) -> Finish {
    let is_ruled = fract(9.0 * at.y) < 0.06;
    let is_margin = (at.x - 0.18).abs() < 0.006;
    let paper = match (is_margin, is_ruled) {
        (true, _) => Vec3::new(0.80, 0.35, 0.38),
        (false, true) => Vec3::new(0.50, 0.62, 0.80),
        (false, false) => Finish::PAPER.code,
    };
    // The film is a little yellow.
    if is_taped(at) { Finish::coated(paper * Vec3::new(0.96, 0.94, 0.88), 0.07) } else { Finish { code: paper, ..Finish::PAPER } }
}

fn clear_tape_height(seed: u32, at: Vec2) -> f32 {
    let film = if is_taped(at) { 0.0004 } else { 0.0 };
    film + 0.0012 * noise::fractal(seed.wrapping_add(14), 3.0 * at.x, 6.0 * at.y, 64, 2)
}

// A lid: a flat disc inside a ring, domed a little towards the rim.
fn plastic_height(at: Vec2) -> f32 {
    let radius = (at - 0.5).length();
    let ring = (1.0 - ((radius - 0.33) / 0.035).powi(2)).max(0.0);
    0.003 * ring * ring + 0.004 * (1.0 - smooth_step((radius - 0.2) / 0.5))
}

// A printed page: a headline, a picture, three columns of text, a coloured foot with a logo.
fn flyer_code(seed: u32, at: Vec2) -> Vec3 {
    const INK: Vec3 = Vec3::new(0.12, 0.12, 0.14);
    const BLUE: Vec3 = Vec3::new(0.10, 0.25, 0.58);
    const WHITE: Vec3 = Vec3::new(0.96, 0.96, 0.95);
    match at.y {
        y if y > 0.82 => {
            let from_logo = (at - Vec2::new(0.86, 0.91)).length();
            if from_logo < 0.06 && from_logo > 0.025 { WHITE } else { BLUE }
        }
        y if (0.07..0.17).contains(&y) && at.x > 0.07 && at.x < 0.80 => letters(seed, at * Vec2::new(14.0, 1.0), INK, WHITE),
        y if (0.23..0.47).contains(&y) && at.x > 0.07 && at.x < 0.93 => flyer_picture(seed, at),
        y if (0.53..0.78).contains(&y) => {
            let column = fract((at.x - 0.05) / 0.3);
            let line = fract((y - 0.53) / 0.036);
            let is_text = (0.06..0.92).contains(&column) && line < 0.5 && at.x > 0.05 && at.x < 0.95;
            let row = ((y - 0.53) / 0.036).floor();
            if is_text { letters(seed, Vec2::new(70.0 * at.x, 100.0 + row), INK, WHITE) } else { WHITE }
        }
        _ => WHITE,
    }
}

// Words as bars of uneven length: `at.x` in letters, `at.y` tells lines apart.
fn letters(seed: u32, at: Vec2, ink: Vec3, paper: Vec3) -> Vec3 {
    let letter = at.x.floor();
    let is_space = noise::unit(seed.wrapping_add(31), letter as i32, at.y as i32) < 0.2;
    let is_between = fract(at.x) > 0.78;
    if is_space || is_between { paper } else { ink }
}

// Hills below an evening sky.
fn flyer_picture(seed: u32, at: Vec2) -> Vec3 {
    let y = (at.y - 0.23) / 0.24;
    let ridge = |k: u32| noise::fractal(seed.wrapping_add(40 + k), 5.0 * at.x, k as f32, 64, 3);
    let from_sun = (at - Vec2::new(0.68, 0.31)).length();
    match y {
        y if y > 0.95 - 0.35 * ridge(0) => Vec3::new(0.10, 0.30, 0.16),
        y if y > 0.75 - 0.45 * ridge(1) => Vec3::new(0.22, 0.46, 0.30),
        _ if from_sun < 0.035 => Vec3::new(1.0, 0.93, 0.55),
        y => Vec3::new(0.95, 0.62, 0.30).lerp(Vec3::new(0.35, 0.48, 0.80), 1.0 - y),
    }
}

// A board sawn off the trunk's middle: rings become stripes along y, which waver; 0 early wood, 1 late wood.
fn rings(seed: u32, at: Vec2) -> f32 {
    let waver = noise::fractal(seed.wrapping_add(50), 2.0 * at.x, 0.9 * at.y, 64, 3);
    let from_pith = Vec2::new(at.x + 0.35 + 0.18 * waver, 0.25 * (at.y - 0.4)).length();
    let phase = fract(11.0 * from_pith);
    // Grows slowly darker, and ends at once.
    phase * phase * (1.0 - smooth_step((phase - 0.93) / 0.07))
}

fn grain(seed: u32, at: Vec2) -> f32 {
    let fibre = noise::fractal(seed.wrapping_add(51), 60.0 * at.x, 4.0 * at.y, 1 << 10, 2);
    0.6 * rings(seed, at) + 0.4 * fibre
}

fn wood(seed: u32, at: Vec2) -> Finish {
    let fibre = noise::fractal(seed.wrapping_add(52), 110.0 * at.x, 5.0 * at.y, 1 << 10, 2);
    let code = Vec3::new(0.80, 0.60, 0.38).lerp(Vec3::new(0.52, 0.31, 0.15), rings(seed, at)) * (0.86 + 0.2 * fibre);
    // Fibres run along y: across them the highlight is wide.
    Finish { roughness: Vec2::new(0.40, 0.18), ..Finish::coated(code, 0.0) }
}
