//! What must hold of frames of this kind on the CPU; `gpu_equals_cpu.rs` carries it over to the GPU.

mod clipped;
mod construct;
pub(crate) mod fixture;
#[cfg(feature = "gpu")]
mod gpu_equals_cpu;
#[cfg(feature = "gpu")]
mod on_device;
mod registration;
mod suggest;

use std::collections::HashMap;
use std::sync::Arc;

use glam::{Quat, Vec3};

use super::{ParameterMap, Settings, Show, from_parts, to_parts};
use crate::capture::PartsError;
use crate::fitting::{Lobe, Model};
use crate::geometry::Camera;
use crate::images::{Tolerance, count_beyond};
use crate::render::{Backend, Frame, FrameRequest, Outputs, Renderer};
use crate::representations::{Answer, MemoryPages, Refine, RenderError, Representation, Settings as AnySettings, Uploads};
use crate::testdata::golden::assert_golden;
use crate::textures::PixelFormat;
use fixture::{WORLD, World, every_kind};

const EVERYTHING: Outputs = Outputs { depth: true, provenance: true };

fn frame_of((map, pages): (ParameterMap, MemoryPages), camera: &Camera, show: Show) -> Result<Frame, RenderError> {
    let settings = AnySettings::ParameterMap(Settings { show });
    let map: Arc<dyn Representation> = Arc::new(map);
    let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
    Renderer::cpu_only().render(&map, &pages, &request, Some(Backend::Cpu))
}

fn from_above(world: &World) -> Camera {
    world.camera(Vec3::new(0.3, 1.6, 1.4), Vec3::ZERO, 80, 60)
}

// Colour and answer of the pixels that show the object.
fn object_pixels(frame: &Frame) -> Vec<(Vec3, Answer)> {
    let provenance = frame.pixels.provenance.as_ref().unwrap();
    let colors = frame.pixels.color.chunks_exact(3).map(Vec3::from_slice);
    colors.zip(provenance).map(|(c, p)| (c, p.answer())).filter(|(_, a)| *a != Answer::Background).collect()
}

#[test]
fn the_sheet_with_every_kind_of_model_looks_as_it_did() {
    let frame = frame_of(WORLD.build(every_kind), &WORLD.camera(Vec3::new(0.3, 1.6, 1.4), Vec3::ZERO, 64, 48), Show::Radiance);
    assert_golden("parameter_map_radiance.exr", &frame.unwrap());
}

#[test]
fn a_white_map_is_white_from_everywhere() {
    for position in [Vec3::new(0.0, 2.0, 0.01), Vec3::new(1.5, 0.4, 1.0), Vec3::new(-2.0, 0.1, -0.3)] {
        let map = WORLD.build(|_| Some(Model::Constant { value: [1.0; 3] }));
        let frame = frame_of(map, &WORLD.camera(position, Vec3::ZERO, 80, 60), Show::Radiance).unwrap();
        let seen = object_pixels(&frame);
        let (front, hidden): (Vec<_>, Vec<_>) = seen.into_iter().partition(|(_, a)| *a != Answer::Unknown);
        // The four weights sum to 1 within rounding. From the side at least one bump's slope is seen.
        assert!(front.len() > 20, "{position}: {}", front.len());
        assert!(front.iter().all(|(c, _)| (*c - Vec3::ONE).abs().max_element() < 1e-6));
        assert!(hidden.iter().all(|(c, _)| *c == Vec3::ZERO));
    }
}

#[test]
fn a_lobe_is_seen_where_its_axis_points_in_the_surfaces_frame() {
    // Along +u (world +X) and up, in a flat spot: the camera there sees constant and lobe, the one opposite the constant alone.
    let axis = Vec3::new(0.6, 0.0, 0.8);
    let lobes = vec![Lobe { axis: axis.to_array(), exponent: 400.0, amplitude: [2.0, 1.0, 0.5] }];
    let model = Model::Lobes { constant: [0.1; 3], lobes };
    // At x = −π/10 cos 5x = 0: the normal is +Y, the tangent +X, so axis points to (0.6, 0.8, 0) in the world.
    let spot = Vec3::new(-std::f32::consts::PI / 10.0, -0.05 + 0.05, 0.0);
    for (toward, expected) in [(Vec3::new(0.6, 0.8, 0.0), Vec3::new(2.1, 1.1, 0.6)), (Vec3::new(-0.6, 0.8, 0.0), Vec3::splat(0.1))] {
        let map = WORLD.build(|_| Some(model.clone()));
        let frame = frame_of(map, &WORLD.camera(spot + 3.0 * toward, spot, 41, 41), Show::Radiance).unwrap();
        let center = Vec3::from_slice(&frame.pixels.color[3 * (20 * 41 + 20)..]);
        // The sheet is made of facets an eighth wide; normals are interpolated between their corners: within 3° of the analytic one here.
        assert!((center - expected).abs().max_element() < 0.12 * expected.max_element(), "{toward}: {center}");
    }
}

#[test]
fn between_texels_radiance_is_blended_and_what_has_no_model_is_left_out() {
    let red = Model::Constant { value: [1.0, 0.0, 0.0] };
    // Columns in turn red, nothing, blue, nothing.
    let columns = |i: usize| match i % 12 % 4 {
        0 => Some(red.clone()),
        2 => Some(Model::Constant { value: [0.0, 0.0, 1.0] }),
        _ => None,
    };
    let seen = object_pixels(&frame_of(WORLD.build(columns), &from_above(&WORLD), Show::Radiance).unwrap());
    // Beyond the last column's centres there is no other column: half a texel of twelve at the end of each part is unknown.
    let (unknown, filled): (Vec<_>, Vec<_>) = seen.into_iter().partition(|(_, a)| *a == Answer::Unknown);
    assert!(unknown.len() * 12 < filled.len() && unknown.iter().all(|(c, _)| *c == Vec3::ZERO));
    // Before the first column's centres it is alone, and right; everywhere else a neighbour has no model.
    assert!(filled.iter().filter(|(_, a)| *a == Answer::Hit).count() * 12 < filled.len());
    assert!(filled.iter().all(|(c, _)| (c.x + c.z - 1.0).abs() < 1e-6 && c.y == 0.0));
    let all = |i: usize| if i.is_multiple_of(2) { Some(red.clone()) } else { Some(Model::Constant { value: [0.0, 1.0, 0.0] }) };
    let mixed = object_pixels(&frame_of(WORLD.build(all), &from_above(&WORLD), Show::Radiance).unwrap());
    assert!(mixed.iter().filter(|(c, _)| c.x > 0.2 && c.y > 0.2).count() > 300);
    let nothing = object_pixels(&frame_of(WORLD.build(|_| None), &from_above(&WORLD), Show::Radiance).unwrap());
    assert!(nothing.len() > 1000 && nothing.iter().all(|p| *p == (Vec3::ZERO, Answer::Unknown)));
}

#[test]
fn turning_and_scaling_scene_and_camera_together_changes_nothing() {
    let straight = frame_of(WORLD.build(every_kind), &from_above(&WORLD), Show::Radiance).unwrap();
    let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.7, -1.9, 2.6);
    for (rotation, scale) in [(turn, 1.0), (Quat::IDENTITY, 1e-3), (Quat::IDENTITY, 1e3), (turn, 30.0)] {
        let world = World { rotation, scale, ..WORLD };
        let moved = frame_of(world.build(every_kind), &from_above(&world), Show::Radiance).unwrap();
        let report = count_beyond(&straight.pixels.color, &moved.pixels.color, &Tolerance::F32_LOOKUP).unwrap();
        // At edges of triangles and texels rounding decides; 0.5 % of the numbers.
        assert!(report.beyond * 200 <= straight.pixels.color.len(), "{scale}: {report:?}");
    }
}

#[test]
fn numbers_that_are_none_never_leave() {
    let poison = |i: usize| match i % 3 {
        0 => Some(Model::Constant { value: [f32::NAN, 1.0, 1.0] }),
        1 => Some(Model::CosinePower { value: [1.0; 3], exponent: f32::INFINITY }),
        _ => Some(Model::Lobes { constant: [1e38; 3], lobes: vec![Lobe { axis: [0.0; 3], exponent: -1.0, amplitude: [1e38; 3] }] }),
    };
    let frame = frame_of(WORLD.build(poison), &from_above(&WORLD), Show::Radiance).unwrap();
    assert!(frame.pixels.color.iter().all(|c| c.is_finite()));
}

#[test]
fn overlays_tell_models_and_flags_apart() {
    for show in [Show::Models, Show::Flags] {
        let seen = object_pixels(&frame_of(WORLD.build(every_kind), &from_above(&WORLD), show).unwrap());
        let mut colors: Vec<[u32; 3]> = seen.iter().map(|(c, _)| c.to_array().map(f32::to_bits)).collect();
        colors.sort_unstable();
        colors.dedup();
        // Black for none, constant, cosine power, four numbers of lobes, ten of bands; or none, flagged, not flagged.
        let expected = if show == Show::Models { 17 } else { 3 };
        assert_eq!(colors.len(), expected, "{show:?}");
    }
}

#[test]
fn stored_parts_load_bit_equal_and_a_part_cut_anywhere_is_an_error_that_names_it() {
    let (map, _) = WORLD.build(every_kind);
    let reload = |parts: &HashMap<&'static str, Vec<u8>>| {
        from_parts::<PartsError>(map.parameters.clone(), &|name| Ok(parts.get(name).cloned().unwrap_or_default()))
    };
    let whole: HashMap<_, _> = to_parts(&map).unwrap().into_iter().collect();
    let back = reload(&whole).unwrap();
    assert!(back.surface == map.surface && back.texels == map.texels);
    assert!(to_parts(&back).unwrap() == to_parts(&map).unwrap());
    for (name, bytes) in &whole {
        for length in (0..bytes.len()).step_by(bytes.len() / 60 + 1) {
            let cut = whole.iter().map(|(n, b)| (*n, if n == name { b[..length].to_vec() } else { b.clone() })).collect();
            assert_eq!(reload(&cut).unwrap_err().part, *name);
        }
    }
}

#[test]
fn half_precision_costs_less_than_the_eye_sees() {
    let world = World { pixel: PixelFormat::F16, ..WORLD };
    let single = frame_of(WORLD.build(every_kind), &from_above(&WORLD), Show::Radiance).unwrap();
    let half = frame_of(world.build(every_kind), &from_above(&world), Show::Radiance).unwrap();
    let worst = single.pixels.color.iter().zip(&half.pixels.color).map(|(a, b)| (a - b).abs() / (0.1 + a)).fold(0f32, f32::max);
    // Coefficients and amplitudes 2⁻¹¹, exponents 2⁻⁹ of ln m: sums of up to a hundred terms stay below a 200th.
    assert!(worst > 0.0 && worst < 5e-3, "{worst}");
}
