//! The paper's stage: a teapot on a patterned cloth in a gazebo, in a garden, under a sky with sun.
//!
//! Units are the teapot's (rim 3 across; here about 6 cm each), so that offsets ε = 0.1 and 0.25 mean what they mean in the paper. Near
//! field: cloth, cups, spoon, fruit. Far field: posts, rafters, hedge, trees, sky. The pot shows its own spout, handle and knob, and
//! shades itself and the cloth. The pot is the historic one of 28 patches: its open base stands on the cloth, which closes it to
//! light, and no sample is spent on a bottom that nobody sees.

use glam::Vec3;
use serde_json::{Value, json};

use super::super::noise;
use super::super::tea_set::HISTORIC_TEAPOT_PATCHES;
use super::sky::Sky;
use super::{BuiltinOptions, Parts, camera, patterns};
use crate::images::{ExrStorage, encode_exr_rgb, encode_png};

/// Height of the table's cloth above the floor.
const TABLE: f32 = 12.0;
const TABLE_RADIUS: f32 = 8.4;
/// What hangs over the table's edge.
const CLOTH_DROP: f32 = 4.4;
/// Distance of the posts from the middle.
const POSTS: f32 = 29.5;
/// Height of the ring beam's underside.
const EAVES: f32 = 36.0;
/// Where the rafters meet.
const APEX: f32 = 53.0;
/// Ground below the floor.
const GROUND: f32 = -3.0;
/// Azimuth of the sun, degrees from +X toward +Z: 10° beside a post, so that the post's shadow crosses the cloth beside the pot.
const SUN_AZIMUTH_DEG: f32 = 147.5;
/// Low enough to shine in under the eaves.
const SUN_ELEVATION_DEG: f32 = 33.0;

/// The scene file; its pictures go to `parts`.
pub(super) fn scene(options: &BuiltinOptions, parts: &mut Parts) -> Result<Value, super::SceneError> {
    pictures(options, parts)?;
    let mut objects = table_ware(options);
    objects.extend(floor_and_table());
    objects.extend(frame());
    objects.extend(roof());
    objects.extend(railing());
    objects.extend(garden(options.seed));
    Ok(json!({
        "about": "A teapot in a gazebo. Units: the teapot's rim is 3 across.",
        "materials": materials(),
        "objects": objects,
        "environment": { "file": "sky.exr" },
        "cameras": cameras(),
    }))
}

fn pictures(options: &BuiltinOptions, parts: &mut Parts) -> Result<(), super::SceneError> {
    let (size, seed) = (options.texture_px, options.seed);
    parts.add_picture("cloth.png", encode_png(&patterns::cloth(size, 72.0)))?;
    parts.add_picture("planks.png", encode_png(&patterns::planks(size / 2, seed, 29.0)))?;
    parts.add_picture("timber.png", encode_png(&patterns::timber(size / 4, seed)))?;
    parts.add_picture("grass.png", encode_png(&patterns::grass(size / 2, seed)))?;
    parts.add_picture("leaves.png", encode_png(&patterns::leaves(size / 4, seed)))?;
    if options.environment.is_none() {
        let sky = Sky { sun: sun_direction(), turbidity: 2.6, seed, ground: Vec3::new(0.10, 0.13, 0.05) };
        parts.add_picture("sky.exr", encode_exr_rgb(&sky.map(options.sky_px as usize & !1), ExrStorage::Float))?;
    }
    Ok(())
}

fn sun_direction() -> Vec3 {
    let (elevation, azimuth) = (SUN_ELEVATION_DEG.to_radians(), SUN_AZIMUTH_DEG.to_radians());
    Vec3::new(elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin())
}

fn materials() -> Value {
    let plain = |r: f32, g: f32, b: f32| json!({ "type": "diffuse", "albedo": [r, g, b] });
    let picture = |file: &str| json!({ "type": "diffuse", "albedo_texture": file });
    json!({
        "teapot": plain(0.10, 0.60, 0.15),
        "china": plain(0.78, 0.77, 0.72),
        "blue china": plain(0.16, 0.28, 0.62),
        "silver": plain(0.58, 0.58, 0.60),
        "cloth": picture("cloth.png"),
        "planks": picture("planks.png"),
        "timber": picture("timber.png"),
        "grass": picture("grass.png"),
        "leaves": picture("leaves.png"),
        "white paint": plain(0.78, 0.77, 0.74),
        "stone": plain(0.42, 0.40, 0.37),
        "bark": plain(0.16, 0.11, 0.07),
        "tea": plain(0.22, 0.08, 0.02),
        "orange": plain(0.85, 0.36, 0.04),
        "lemon": plain(0.86, 0.72, 0.08),
        "apple": plain(0.62, 0.05, 0.05),
    })
}

fn object(name: impl Into<String>, material: &str, shape: Value) -> Value {
    json!({ "name": name.into(), "material": material, "shape": shape })
}

fn placed(mut object: Value, translate: [f32; 3], turn_deg: f32) -> Value {
    object["transform"] = json!({ "translate": translate, "rotate_deg": [0, turn_deg, 0] });
    object
}

fn beam(name: impl Into<String>, material: &str, from: Vec3, to: Vec3, width: f32, height: f32) -> Value {
    object(name, material, json!({ "type": "beam", "from": from.to_array(), "to": to.to_array(), "width": width, "height": height }))
}

fn lathe(name: impl Into<String>, material: &str, profile: &[[f32; 2]], segments: u32) -> Value {
    object(name, material, json!({ "type": "lathe", "profile": profile, "segments": segments }))
}

/// On the circle of radius `r` at height `y`, `degrees` from +X toward +Z.
fn around(r: f32, y: f32, degrees: f32) -> Vec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    Vec3::new(r * cos, y, r * sin)
}

/// Azimuth of post `k`; side `k` lies between posts k and k + 1.
fn post_azimuth(k: u32) -> f32 {
    22.5 + 45.0 * k as f32
}

/// The side without railing, before which the steps lie: toward +Z.
const ENTRANCE: u32 = 1;

fn table_ware(options: &BuiltinOptions) -> Vec<Value> {
    let patches = |name: &str, piece: &str, material: &str, steps: u32, transform: Value| {
        json!({
            "name": name, "patches": format!("builtin:{piece}"), "material": material,
            "tessellation": { "per_edge": steps }, "transform": transform,
        })
    };
    let half = (options.patch_steps / 2).max(2);
    let mut teapot =
        patches("teapot", "teapot", "teapot", options.patch_steps, json!({ "translate": [0, TABLE, 0], "rotate_deg": [0, 25, 0] }));
    teapot["first_patches"] = HISTORIC_TEAPOT_PATCHES.into();
    let mut ware = vec![teapot];
    // The data's cup stands on its own saucer and has no bottom: tea closes it, its rim hidden between the cup's two walls.
    const CUP_SCALE: f32 = 1.8;
    for (name, [x, z], turn, material) in [("cup", [4.1f32, 3.5f32], 40.0, "china"), ("second cup", [-4.6, 3.1], 160.0, "blue china")] {
        let transform = json!({ "translate": [x, TABLE + 0.02, z], "rotate_deg": [0, turn, 0], "scale": CUP_SCALE });
        ware.push(patches(name, "teacup", material, half, transform));
        let center = [x, TABLE + 0.02 + 0.5 * CUP_SCALE, z];
        let surface = json!({ "type": "disc", "center": center, "normal": [0, 1, 0], "radius": 0.42 * CUP_SCALE, "segments": 32 });
        ware.push(object(format!("tea in {name}"), "tea", surface));
    }
    let transform = json!({ "translate": [0.9, TABLE + 0.22, 5.1], "rotate_deg": [0, 65, 0], "scale": 2.0 });
    ware.push(patches("spoon", "teaspoon", "silver", half, transform));
    ware.extend(fruit());
    ware
}

fn fruit() -> Vec<Value> {
    let bowl = [[0.0, 0.05], [0.8, 0.0], [0.9, 0.15], [2.2, 0.75], [2.3, 0.80], [2.15, 0.85], [0.8, 0.3], [0.0, 0.25]];
    let (x, z) = (-3.4, -4.3);
    let mut all = vec![placed(lathe("fruit plate", "china", &bowl, 40), [x, TABLE + 0.02, z], 0.0)];
    for (name, material, dx, dy, dz, radius) in [
        ("orange", "orange", 0.75f32, 1.15f32, 0.45f32, 0.78f32),
        ("lemon", "lemon", -0.75, 1.02, 0.55, 0.62),
        ("apple", "apple", 0.0, 1.12, -0.85, 0.74),
        ("second orange", "orange", -0.05, 2.15, 0.1, 0.70),
    ] {
        let center = [x + dx, TABLE + dy, z + dz];
        all.push(object(name, material, json!({ "type": "sphere", "center": center, "radius": radius, "segments": 28 })));
    }
    all
}

fn floor_and_table() -> Vec<Value> {
    let edge = POSTS + 3.0;
    let octagon =
        |r: f32, low: f32, high: f32| json!({ "type": "lathe", "profile": [[r, low], [r, high]], "segments": 8, "flat_sides": true });
    let table = [
        [0.0, TABLE - 0.75],
        [TABLE_RADIUS - 0.15, TABLE - 0.75],
        [TABLE_RADIUS - 0.05, TABLE - 0.4],
        [TABLE_RADIUS - 0.1, TABLE - 0.08],
        [0.0, TABLE - 0.08],
    ];
    let foot = [
        [0.0, 0.0],
        [4.2, 0.0],
        [4.2, 0.5],
        [1.6, 1.3],
        [0.9, 2.4],
        [0.8, 4.5],
        [1.3, 6.0],
        [0.9, 7.5],
        [1.0, 9.8],
        [2.6, TABLE - 0.75],
        [0.0, TABLE - 0.75],
    ];
    let turn = |o: Value| placed(o, [0.0; 3], 22.5);
    vec![
        turn(object("floor", "planks", json!({ "type": "disc", "center": [0, 0, 0], "normal": [0, 1, 0], "radius": edge, "segments": 8 }))),
        turn(object("floor rim", "white paint", octagon(edge, GROUND, 0.0))),
        object(
            "steps",
            "stone",
            json!({ "type": "box", "min": [-6.0, GROUND, edge * 0.92], "max": [6.0, GROUND + 1.5, edge * 0.92 + 5.0] }),
        ),
        lathe("table foot", "white paint", &foot, 24),
        lathe("table", "timber", &table, 48),
        placed(
            object(
                "cloth",
                "cloth",
                json!({ "type": "cloth", "radius": TABLE_RADIUS, "drop": CLOTH_DROP, "folds": 17, "fold_depth": 0.42, "segments": 170 }),
            ),
            [0.0, TABLE, 0.0],
            0.0,
        ),
    ]
}

fn frame() -> Vec<Value> {
    let post = [
        [0.0, 0.0],
        [1.6, 0.0],
        [1.6, 2.6],
        [1.15, 3.0],
        [1.0, 3.4],
        [0.9, EAVES - 3.2],
        [1.0, EAVES - 2.8],
        [1.4, EAVES - 2.2],
        [1.4, EAVES],
        [0.0, EAVES],
    ];
    let mut all = Vec::new();
    for k in 0..8 {
        let mut shape = lathe(format!("post {k}"), "white paint", &post, 6);
        shape["shape"]["flat_sides"] = true.into();
        let foot = around(POSTS, 0.0, post_azimuth(k));
        all.push(placed(shape, foot.to_array(), -post_azimuth(k)));
        let (a, b) = (around(POSTS, EAVES + 1.1, post_azimuth(k)), around(POSTS, EAVES + 1.1, post_azimuth(k + 1)));
        let overlap = 0.03 * (b - a);
        all.push(beam(format!("ring beam {k}"), "white paint", a - overlap, b + overlap, 1.5, 2.2));
        // Braces from post to ring beam, both ways.
        for (side, toward) in [("left", b), ("right", around(POSTS, EAVES + 1.1, post_azimuth(k + 7)))] {
            let along = (toward - a).normalize();
            let (low, high) = (foot.with_y(EAVES - 6.5) + 0.6 * along, a.with_y(EAVES + 0.3) + 6.5 * along);
            all.push(beam(format!("brace {k} {side}"), "white paint", low, high, 0.7, 0.9));
        }
    }
    all
}

// Rafters from the posts and the middles of the sides; slats across them leave gaps, and the top third stays open.
fn roof() -> Vec<Value> {
    const SLATS: u32 = 8;
    let hub = [
        [0.0, APEX - 2.6],
        [1.3, APEX - 2.2],
        [1.9, APEX - 1.0],
        [1.9, APEX + 1.0],
        [1.0, APEX + 1.6],
        [0.5, APEX + 2.6],
        [0.9, APEX + 3.6],
        [0.5, APEX + 4.5],
        [0.0, APEX + 6.0],
    ];
    let mut all = vec![lathe("roof hub", "white paint", &hub, 16)];
    let at = |r: f32, degrees: f32| around(r, EAVES + 2.6 + (APEX - EAVES - 2.6) * (1.0 - r / POSTS), degrees);
    for k in 0..8 {
        let (corner, middle) = (post_azimuth(k), post_azimuth(k) + 22.5);
        all.push(beam(format!("rafter {k}"), "timber", at(POSTS + 3.5, corner), at(1.2, corner), 1.1, 1.8));
        // The sides' middles lie nearer: cos 22.5° of the corners' distance.
        let rafter_end = at(POSTS + 3.5, corner).lerp(at(POSTS + 3.5, corner + 45.0), 0.5);
        all.push(beam(format!("side rafter {k}"), "timber", rafter_end, at(1.2, middle), 0.8, 1.3));
        for s in 0..SLATS {
            let r = (POSTS + 3.0) * (1.0 - 0.66 * s as f32 / (SLATS - 1) as f32);
            let lift = Vec3::Y * 1.1;
            let (a, b) = (at(r, corner) + lift, at(r, corner + 45.0) + lift);
            all.push(beam(format!("slat {k} {s}"), "timber", a, b, 1.5, 0.3));
        }
    }
    all
}

fn railing() -> Vec<Value> {
    const BALUSTERS: u32 = 9;
    let mut all = Vec::new();
    for k in (0..8).filter(|k| *k != ENTRANCE) {
        let (a, b) = (around(POSTS, 0.0, post_azimuth(k)), around(POSTS, 0.0, post_azimuth(k + 1)));
        for (name, y, width, height) in [("top rail", 11.0, 1.2, 0.7), ("middle rail", 9.0, 0.6, 0.5), ("bottom rail", 1.8, 0.8, 0.6)] {
            all.push(beam(format!("{name} {k}"), "white paint", a.with_y(y), b.with_y(y), width, height));
        }
        for i in 1..=BALUSTERS {
            let foot = a.lerp(b, i as f32 / (BALUSTERS + 1) as f32);
            all.push(beam(format!("baluster {k} {i}"), "white paint", foot.with_y(1.8), foot.with_y(9.0), 0.55, 0.55));
        }
    }
    all
}

fn garden(seed: u32) -> Vec<Value> {
    let mut ground =
        object("ground", "grass", json!({ "type": "disc", "center": [0, GROUND, 0], "normal": [0, 1, 0], "radius": 600, "segments": 64 }));
    ground["uv_scale"] = json!([24, 24]);
    let mut all = vec![ground];
    let random = |k: u32, i: i32| noise::unit(seed.wrapping_add(77), k as i32, i);
    let blob = |name: String, center: Vec3, radii: Vec3, segments: u32, k: u32| {
        let shape = json!({ "type": "blob", "center": center.to_array(), "radii": radii.to_array(), "roughness": 0.34, "segments": segments, "seed": seed.wrapping_add(k) });
        object(name, "leaves", shape)
    };
    // A clipped hedge with openings before and behind; the view from the garden comes through the wide one.
    for k in (0..24).filter(|k| ![3, 4, 5, 15].contains(k)) {
        let height = 7.0 + 1.5 * random(k, 0);
        let at = around(72.0, GROUND + 0.6 * height, 15.0 * k as f32);
        all.push(blob(format!("bush {k}"), at, Vec3::new(10.5, height, 10.5), 20, k));
    }
    for k in (0..22).filter(|k| ![2, 3, 4].contains(k)) {
        let azimuth = 360.0 / 22.0 * k as f32 + 9.0 * random(k, 1);
        let (distance, size) = (115.0 + 85.0 * random(k, 2), 0.7 + 0.6 * random(k, 3));
        let foot = around(distance, GROUND, azimuth);
        all.push(placed(lathe(format!("trunk {k}"), "bark", &[[2.4 * size, 0.0], [1.6 * size, 30.0 * size]], 8), foot.to_array(), 0.0));
        // A crown and a lower, offset part of it.
        let crown = Vec3::new(16.0, 19.0 + 10.0 * random(k, 4), 16.0) * size;
        let middle = foot + Vec3::Y * (24.0 * size + 0.75 * crown.y);
        all.push(blob(format!("crown {k}"), middle, crown, 20, 100 + k));
        let offset = around(8.0 * size, -0.35 * crown.y, 360.0 * random(k, 5));
        all.push(blob(format!("lower crown {k}"), middle + offset, 0.8 * crown.with_y(0.75 * crown.y), 16, 200 + k));
    }
    // Hills close the horizon.
    for k in 0..12 {
        let center = around(470.0, GROUND - 12.0, 30.0 * k as f32 + 14.0 * random(k, 6));
        let radii = Vec3::new(120.0 + 60.0 * random(k, 7), 34.0 + 22.0 * random(k, 8), 120.0);
        all.push(blob(format!("hill {k}"), center, radii, 18, 300 + k));
    }
    all
}

fn cameras() -> Vec<Value> {
    let middle = [0.0, TABLE + 1.5, 0.0];
    let orbit = |name: &str, degrees: f32, distance: f32, height: f32| {
        camera(name, around(distance, TABLE + height, degrees).to_array(), middle, 42.0)
    };
    vec![
        orbit("front", 90.0, 13.0, 5.0),
        orbit("front left", 140.0, 12.0, 4.0),
        orbit("left", 190.0, 12.0, 5.5),
        orbit("back", 265.0, 13.0, 4.0),
        orbit("right", 350.0, 12.0, 4.5),
        orbit("front right", 40.0, 12.0, 3.0),
        orbit("near", 75.0, 7.5, 2.6),
        orbit("above", 80.0, 7.0, 14.0),
        camera("doorway", around(27.0, 17.0, 62.0).to_array(), [0.0, 14.0, 0.0], 55.0),
        camera("garden", around(118.0, 16.0, 66.0).to_array(), [0.0, 22.0, 0.0], 38.0),
    ]
}
