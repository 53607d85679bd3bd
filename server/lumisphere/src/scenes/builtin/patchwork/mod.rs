//! Nine materials on one sheet of paper, under one lamp: the surface on which parameter maps were put to the test (Mortensen & Andersen
//! 2007, chapter 16.3 and figure 16.8), generated.
//!
//! The sheet is one object with one material whose parameters are textures, so it is observed, fitted and shown as one surface. It is
//! 1 × 1 in the plane y = 0, facing +Y; u runs along +X, v along −Z. Seen from above with −Z up:
//!
//! | | | |
//! | --- | --- | --- |
//! | paper towel | cloth | duct tape |
//! | clear tape over paper | red plastic | silver foil |
//! | gold foil | flyer | wood |
//!
//! What stands out (weave, creases, edges) is geometry, up to 0.012 high; what changes colour or gloss is texture. Both are computed from
//! the same functions of place. The foils mirror the lamp at some 100 times the paper's radiance;
//! the source needed eight exposures, each half of the one before.

mod foil;
mod patches;
mod relief;

use std::f32::consts::PI;

use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use self::patches::{Finish, Patch};
use super::super::error::SceneError;
use super::{BuiltinOptions, Parts, camera, patterns};
use crate::images::encode_png;
use crate::radiometry::color::srgb_from_linear;

/// Irradiance of the lamp on the middle: paper then has a radiance of about 0.5.
const IRRADIANCE: f32 = 0.6 * PI;
/// Radius of the lamp.
const LAMP_RADIUS: f32 = 0.12;
/// Radiance of the sky above the open room, which keeps the shadows from being black.
const SKY: f32 = 0.15;
/// Edge of a patch with its share of the gap around it; what is left of 1 is the sheet's margin.
const PITCH: f32 = 0.32;
/// Between neighbouring patches.
const GAP: f32 = 0.012;
/// Edge of a patch.
const PATCH: f32 = PITCH - GAP;

/// The scene file; its mesh and pictures go to `parts`.
pub(super) fn scene(options: &BuiltinOptions, parts: &mut Parts) -> Result<Value, SceneError> {
    let Sheet { diffuse, specular, roughness } = Sheet::painted(options);
    parts.add_picture("patchwork_diffuse.png", diffuse)?;
    parts.add_picture("patchwork_specular.png", specular)?;
    parts.add_picture("patchwork_roughness.png", roughness)?;
    parts.add("patchwork.obj", relief::obj(options.patchwork.relief_steps, |at| height(options.seed, at)))?;
    let mut objects = vec![json!({ "name": "patchwork", "mesh": "patchwork.obj", "material": "patchwork" })];
    objects.extend(room());
    Ok(json!({
        "about": "Nine materials on a sheet of paper, 1 across.",
        "generator": { "relief_steps": options.patchwork.relief_steps, "lamp": options.patchwork.lamp.to_array() },
        "materials": materials(),
        "objects": objects,
        "lights": [lamp(options.patchwork.lamp)],
        "environment": { "radiance": [SKY, SKY, SKY] },
        "cameras": [
            camera("front", [0.0, 1.5, 1.3], [0.0, 0.0, 0.02], 34.0),
            camera("above", [0.0, 2.1, 0.02], [0.0, 0.0, 0.0], 31.0),
            camera("against the lamp", [-0.75, 1.5, 0.95], [0.0, 0.0, 0.0], 34.0),
            camera("near", [0.25, 0.55, 0.5], [0.1, 0.0, 0.0], 34.0),
        ],
    }))
}

fn materials() -> Value {
    let plain = |r: f32, g: f32, b: f32| json!({ "type": "diffuse", "albedo": [r, g, b] });
    json!({
        "patchwork": {
            "type": "glossy", "diffuse_texture": "patchwork_diffuse.png", "specular_texture": "patchwork_specular.png",
            "roughness_texture": "patchwork_roughness.png",
        },
        "table": plain(0.24, 0.14, 0.08),
        "floor": plain(0.30, 0.27, 0.24),
        "cream": plain(0.66, 0.62, 0.52),
        "blue": plain(0.32, 0.42, 0.55),
    })
}

/// A table in a room without ceiling, wide enough for cameras at any height to stand in.
fn room() -> Vec<Value> {
    let object = |name: &str, material: &str, shape: Value| json!({ "name": name, "material": material, "shape": shape });
    let wall = |corner: [f32; 3], along: [f32; 3]| json!({ "type": "rect", "corner": corner, "edge_u": along, "edge_v": [0, 6, 0] });
    vec![
        // The sheet lies on it without touching, or its paper would flicker through.
        object("table", "table", json!({ "type": "box", "min": [-1.1, -0.06, -0.8], "max": [1.1, -0.002, 0.8] })),
        object("floor", "floor", json!({ "type": "rect", "corner": [-8, -2.2, 8], "edge_u": [16, 0, 0], "edge_v": [0, 0, -16] })),
        object("north wall", "cream", wall([-8.0, -2.2, -8.0], [16.0, 0.0, 0.0])),
        object("east wall", "blue", wall([8.0, -2.2, -8.0], [0.0, 0.0, 16.0])),
        object("south wall", "cream", wall([8.0, -2.2, 8.0], [-16.0, 0.0, 0.0])),
        object("west wall", "blue", wall([-8.0, -2.2, 8.0], [0.0, 0.0, -16.0])),
    ]
}

fn lamp(at: Vec3) -> Value {
    // Seen from the middle it is a disc face on: E = L · area · cos θ / distance².
    let area = PI * LAMP_RADIUS * LAMP_RADIUS;
    let radiance = IRRADIANCE * at.length_squared() / (area * at.normalize().y);
    json!({
        "type": "disc", "name": "lamp", "center": at.to_array(), "normal": (-at).to_array(), "radius": LAMP_RADIUS,
        "radiance": Vec3::splat(radiance).to_array(),
    })
}

/// The sheet's textures, as PNG.
struct Sheet {
    diffuse: Result<Vec<u8>, crate::images::ImageError>,
    specular: Result<Vec<u8>, crate::images::ImageError>,
    roughness: Result<Vec<u8>, crate::images::ImageError>,
}

impl Sheet {
    fn painted(options: &BuiltinOptions) -> Self {
        let (seed, fine, coarse) = (options.seed, options.texture_px / 2, options.texture_px / 4);
        // Pictures hold sRGB codes, and the loader makes any of them linear.
        let codes = |linear: Vec3| linear.map(srgb_from_linear);
        let picture = |size, of: &(dyn Fn(Finish) -> Vec3 + Sync)| encode_png(&patterns::paint(size, 2, |at| of(finish(seed, at))));
        Self {
            diffuse: picture(fine, &|finish| finish.code),
            specular: picture(coarse, &|finish| codes(finish.specular)),
            roughness: picture(coarse, &|finish| codes(finish.roughness.extend(0.0))),
        }
    }
}

/// The patch at a place of the sheet, and where within it; None on the paper between. Both from 0 to 1, x along +X, y along +Z.
fn patch_at(at: Vec2) -> Option<(Patch, Vec2)> {
    let at = (at - 0.5 * (1.0 - 3.0 * PITCH)) / PITCH;
    let cell = at.floor();
    let within = ((at - cell) * PITCH - 0.5 * GAP) / PATCH;
    let is_inside = cell.min_element() >= 0.0 && cell.max_element() <= 2.0 && within.min_element() >= 0.0 && within.max_element() <= 1.0;
    is_inside.then(|| (Patch::ALL[cell.y as usize][cell.x as usize], within))
}

fn finish(seed: u32, at: Vec2) -> Finish {
    patch_at(at).map_or(Finish::PAPER, |(patch, within)| patch.finish(seed, within))
}

/// Above the sheet's underside, 0 to 0.012.
fn height(seed: u32, at: Vec2) -> f32 {
    /// Of a patch above the paper, and how far from its edge that is reached.
    const THICKNESS: f32 = 0.0012;
    const SLOPE: f32 = 0.03;
    patch_at(at).map_or(0.0, |(patch, within)| {
        let from_edge = within.min(1.0 - within).min_element();
        let risen = patterns::smooth_step(from_edge / SLOPE);
        risen * (THICKNESS + patch.height(seed, within))
    })
}

#[cfg(test)]
mod tests;
