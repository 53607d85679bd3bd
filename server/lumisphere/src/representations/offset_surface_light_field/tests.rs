//! What must hold of frames of this kind on the CPU. `tests/gpu_equals_cpu.rs` carries it over to the GPU.

mod bumps;
mod corrected;
mod filter;
pub(crate) mod fixture;
mod gloss;
#[cfg(feature = "gpu")]
mod gpu_equals_cpu;
#[cfg(feature = "gpu")]
mod paging;
mod recording;
mod reflections;
mod refraction;
mod relight;
mod replacing;
mod rim_and_knob;
mod stability;
mod thinning;

use std::sync::Arc;

use glam::{Quat, Vec3};

use super::shade::{blend_weights, exponential, logarithm, mirror_direction, power};
use super::{Blend, Component, Filter, NO_SAMPLE, OffsetSurfaceLightField, Settings};
use crate::geometry::{Camera, Intrinsics, Pose};
use crate::images::{Tolerance, count_beyond, elements_agree};
use crate::render::{Backend, Frame, FrameRequest, Outputs, RenderError, Renderer};
use crate::representations::{Answer, Refine, Settings as AnySettings, Uploads};
use crate::scenes::Relighting;
use crate::testdata::golden::assert_golden;
use crate::textures::{PixelFormat, StoreError};
use fixture::{MemoryPages, WORLD, World, environment_radiance, starve, surface_radiance};

pub(crate) const EVERYTHING: Outputs = Outputs { depth: true, provenance: true };

pub(crate) const BLENDS: [Blend; 10] = [
    Blend::Distance,
    Blend::Angle,
    Blend::Average,
    Blend::Reflection { exponent: 1.0 },
    Blend::Reflection { exponent: 64.0 },
    Blend::Reflection { exponent: 0.0 },
    Blend::Normal { exponent: 4.0 },
    Blend::Normal { exponent: 100.0 },
    Blend::EnvironmentMap,
    Blend::Corrected,
];

pub(crate) fn settings(component: Component, blend: Blend) -> Settings {
    Settings {
        component,
        blend,
        specular_reflectance: Vec3::new(1.0, 0.5, 0.25),
        filter: Filter::Bilinear,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    }
}

fn mirror(blend: Blend) -> Settings {
    Settings {
        component: Component::Mirror,
        blend,
        specular_reflectance: Vec3::ONE,
        filter: Filter::Bilinear,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    }
}

fn reconstruction() -> Settings {
    let component = Component::Reconstruction;
    Settings {
        component,
        blend: Blend::Distance,
        specular_reflectance: Vec3::ONE,
        filter: Filter::Bilinear,
        light: Relighting::NONE,
        reflections: 1,
        bumps: None,
    }
}

fn frame_of(field: OffsetSurfaceLightField, pages: &MemoryPages, camera: &Camera, settings: Settings) -> Result<Frame, RenderError> {
    let settings = AnySettings::OffsetSurfaceLightField(settings);
    let request = FrameRequest { camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
    let field: Arc<dyn crate::representations::Representation> = Arc::new(field);
    Renderer::cpu_only().render(&field, pages, &request, Some(Backend::Cpu))
}

fn frame(world: &World, origin: Vec3, settings: Settings) -> Frame {
    let (field, pages) = world.build();
    frame_of(field, &pages, &world.camera(origin, Vec3::ZERO, 64, 48), settings).unwrap()
}

// Calls `check(normal, ray direction, radiance)` for every pixel that shows the unturned sphere's front and asks for it.
fn for_sphere_pixels(world: &World, origin: Vec3, settings: Settings, mut check: impl FnMut(Vec3, Vec3, Vec3)) {
    let camera = world.camera(origin, Vec3::ZERO, 64, 48);
    let frame = frame(world, origin, settings);
    let provenance = frame.pixels.provenance.unwrap();
    let mut checked = 0;
    for at in 0..64 * 48 {
        let ray = camera.pixel_ray(at % 64, at / 64);
        let at = at as usize;
        if provenance[at].answer() != Answer::Hit {
            continue;
        }
        let n = ray.at(frame.pixels.depth.as_ref().unwrap()[at]).normalize();
        check(n, ray.direction, Vec3::from_slice(&frame.pixels.color[3 * at..]));
        checked += 1;
    }
    assert!(checked > 500, "only {checked} pixels show the sphere");
}

const FINE: World = World { points: 300, quads: 48, pixel: PixelFormat::F32, ..WORLD };

#[test]
fn every_blend_shows_the_exact_mirror_image_of_light_from_infinity() {
    // Texels are 2/32 wide: a bilinear read of these low-order functions errs by h²/8·|f''| < 0.002; facets of 48 quads turn the normal,
    // which is interpolated, by nothing to first order, and the flat facet's point is off the sphere by 1 − cos(0.016) < 2e-4.
    for blend in BLENDS {
        for_sphere_pixels(&FINE, Vec3::new(0.5, 0.8, 3.0), mirror(blend), |n, d, radiance| {
            // Near the silhouette a neighbour's sample point may see the sphere where x sees the environment.
            if n.dot(d) < -0.6 {
                let exact = environment_radiance(mirror_direction(n, d));
                assert!((radiance - exact).length() < 0.01, "{blend:?} at {n}: {radiance} where {exact} is exact");
            }
        });
    }
}

#[test]
fn reconstruction_shows_the_surfaces_own_light() {
    // A texel seen from ε = 0.1 at 65° or steeper is at most 0.1/cos²(65°)·(2/32) = 0.035 wide on the surface; slopes are below 0.3.
    for_sphere_pixels(&FINE, Vec3::new(0.5, 0.8, 3.0), reconstruction(), |n, _, radiance| {
        let exact = surface_radiance(n);
        assert!((radiance - exact).length() < 0.02, "at {n}: {radiance} where {exact} is exact");
    });
}

#[test]
fn full_is_the_sum_of_its_components() {
    let origin = Vec3::new(-2.0, 1.0, 2.0);
    let of = |component| frame(&WORLD, origin, settings(component, Blend::Normal { exponent: 4.0 })).pixels;
    let (own, reflected, full) = (of(Component::Reconstruction), of(Component::Mirror), of(Component::Full));
    for (at, provenance) in full.provenance.unwrap().iter().enumerate() {
        for channel in 3 * at..3 * at + 3 {
            let is_object = provenance.answer() != Answer::Background;
            let expected = if is_object { own.color[channel] + reflected.color[channel] } else { own.color[channel] };
            assert_eq!(full.color[channel], expected);
        }
    }
}

#[test]
fn weights_sum_to_one_or_nothing_answers() {
    let samples = [Vec3::new(0.1, 0.9, 0.2), Vec3::new(-0.3, 0.8, 0.1), Vec3::new(0.4, 0.5, -0.6), Vec3::new(-0.5, 0.2, 0.1)];
    let directions = [Vec3::Y, Vec3::NEG_Y, Vec3::X, Vec3::new(0.3, -0.2, 0.9)];
    let sharp = [Blend::Reflection { exponent: 1e4 }, Blend::Normal { exponent: 1e4 }, Blend::Normal { exponent: 0.0 }];
    for blend in BLENDS.into_iter().chain(sharp) {
        for r in directions.map(Vec3::normalize) {
            for valid in 0..16u16 {
                let candidates = std::array::from_fn(|k| if valid >> k & 1 == 1 { k as u16 } else { NO_SAMPLE });
                let found = blend_weights(blend, candidates, samples.map(Vec3::normalize), Vec3::Y, r);
                let sum: f32 = found.weights.iter().sum();
                if valid == 0 {
                    assert_eq!((sum, found.answer), (0.0, Answer::Unknown));
                } else {
                    assert!((sum - 1.0).abs() < 1e-6, "{blend:?} {r}: {:?}", found.weights);
                    assert!((0..4).all(|k| candidates[k] != NO_SAMPLE || found.weights[k] == 0.0));
                }
            }
        }
    }
}

#[test]
fn weights_that_all_vanish_leave_the_nearest_and_say_so() {
    let behind = [Vec3::NEG_X; 4];
    let found = blend_weights(Blend::Reflection { exponent: 8.0 }, [NO_SAMPLE, 7, 8, 9], behind, Vec3::Y, Vec3::X);
    assert_eq!((found.weights, found.answer), ([0.0, 1.0, 0.0, 0.0], Answer::Filled));
    // The flag is about vanished weights only.
    let found = blend_weights(Blend::Reflection { exponent: 8.0 }, [NO_SAMPLE, 7, 8, 9], behind, Vec3::Y, Vec3::NEG_X);
    assert_eq!(found.answer, Answer::Hit);
}

#[test]
fn powers_are_accurate_for_every_exponent() {
    for i in 1..=1000 {
        let base = i as f32 / 1000.0;
        for exponent in [0.5, 1.0, 4.0, 100.0, 1e4] {
            let exact = f64::from(base).powf(f64::from(exponent));
            let found = f64::from(power(base, exponent));
            // e to a rounded power: relative error |N ln b| · 2⁻²³ and a few ULP; below 1e-37 the result may be flushed.
            let bound = (f64::from(exponent) * f64::from(base).ln().abs() * 2.4e-7 + 1e-6) * exact + 1e-37;
            assert!((found - exact).abs() <= bound, "{base}^{exponent}: {found} where {exact} is exact");
        }
    }
    assert_eq!((power(0.0, 0.0), power(0.0, 3.0), power(1.0, 1e4)), (1.0, 0.0, 1.0));
    assert_eq!((logarithm(1.0), exponential(0.0), exponential(-1e9)), (0.0, 1.0, 0.0));
}

#[test]
fn a_world_turned_by_right_angles_gives_the_same_image() {
    let quarter = std::f32::consts::FRAC_PI_2;
    let turns = [Quat::from_rotation_y(quarter), Quat::from_rotation_x(quarter), Quat::from_rotation_z(-quarter)];
    for settings in [reconstruction(), settings(Component::Full, Blend::Normal { exponent: 4.0 })] {
        let straight = object_colors(&frame(&WORLD, Vec3::new(1.5, 1.0, 2.2), settings));
        for rotation in turns {
            let turned = object_colors(&frame(&World { rotation, ..WORLD }, Vec3::new(1.5, 1.0, 2.2), settings));
            // Cube maps of quarter turns hold the same texels on other faces: what differs is f32 rounding of the coordinates. A
            // rounded coordinate may choose the neighbouring sample-map texel at a handful of pixels.
            let report = count_beyond(&straight, &turned, &Tolerance::F32_LOOKUP).unwrap();
            assert!(report.beyond <= straight.len() / 200, "{rotation} {settings:?}: {report:?}");
        }
    }
}

#[test]
fn a_world_turned_by_any_angle_gives_nearly_the_same_image() {
    let rotation = Quat::from_rotation_y(0.7) * Quat::from_rotation_x(0.4);
    for blend in [Blend::Distance, Blend::Average] {
        let straight = object_colors(&frame(&WORLD, Vec3::new(1.5, 1.0, 2.2), mirror(blend)));
        let turned = object_colors(&frame(&World { rotation, ..WORLD }, Vec3::new(1.5, 1.0, 2.2), mirror(blend)));
        // Other texels of 2/32 sample the same functions; at the silhouette they mix sphere and environment differently.
        let mean = straight.iter().zip(&turned).map(|(a, b)| (a - b).abs()).sum::<f32>() / straight.len() as f32;
        assert!(mean < 0.005, "{blend:?}: mean difference {mean}");
    }
}

// Colours with the background's pixels (whose baked map is resampled by a turn) set to zero.
fn object_colors(frame: &Frame) -> Vec<f32> {
    let mut colors = frame.pixels.color.clone();
    for (rgb, provenance) in colors.chunks_exact_mut(3).zip(frame.pixels.provenance.as_ref().unwrap()) {
        if provenance.answer() == Answer::Background {
            rgb.fill(0.0);
        }
    }
    colors
}

#[test]
fn a_world_of_any_scale_gives_the_same_image() {
    let origin = Vec3::new(1.5, 1.0, 2.2);
    let unit = frame(&WORLD, origin, settings(Component::Full, Blend::Reflection { exponent: 4.0 }));
    // Powers of two scale without rounding: nothing may change at all, distances excepted.
    let doubled = frame(&World { scale: 1024.0, ..WORLD }, origin, settings(Component::Full, Blend::Reflection { exponent: 4.0 }));
    elements_agree(&unit.pixels.color, &doubled.pixels.color, &Tolerance::F32_ARITHMETIC).unwrap();
    for scale in [1e-3, 1e3] {
        let scaled = frame(&World { scale, ..WORLD }, origin, settings(Component::Full, Blend::Reflection { exponent: 4.0 }));
        let report = count_beyond(&unit.pixels.color, &scaled.pixels.color, &Tolerance::F32_LOOKUP).unwrap();
        assert!(report.beyond <= unit.pixels.color.len() / 200, "scale {scale}: {report:?}");
        let depths: Vec<f32> = scaled.pixels.depth.unwrap().iter().map(|d| d / scale).collect();
        let report = count_beyond(unit.pixels.depth.as_ref().unwrap(), &depths, &Tolerance::F32_ARITHMETIC).unwrap();
        assert!(report.beyond <= depths.len() / 500, "scale {scale}: {report:?}");
    }
}

pub(crate) fn odd_cameras(world: &World) -> Vec<Camera> {
    let views = [
        (Vec3::ZERO, Vec3::Z),                                     // inside, at the centre
        (Vec3::new(0.0, 0.0, 0.999_9), Vec3::ZERO),                // inside, touching
        (Vec3::new(0.0, 0.0, 1.000_01), Vec3::new(1.0, 0.0, 1.0)), // grazing
        (Vec3::new(0.0, 0.0, 4.0), Vec3::new(0.0, 0.0, 9.0)),      // the object behind
        (Vec3::new(0.0, -1.2, 2.0), Vec3::new(0.0, -1.2, 0.0)),    // in the floor's plane
        (Vec3::new(0.0, 5e4, 1.0), Vec3::ZERO),                    // far
    ];
    let mut cameras: Vec<Camera> = views.map(|(origin, target)| world.camera(origin, target, 24, 16)).to_vec();
    let pose = Pose::look_at(Vec3::new(0.0, 0.0, 3.0), Vec3::ZERO, Vec3::Y).unwrap();
    for focal in [1e-30, 1e30] {
        let intrinsics =
            Intrinsics { width_px: 24, height_px: 16, focal_px: glam::Vec2::splat(focal), center_px: glam::Vec2::new(12.5, 8.5) };
        cameras.push(Camera::new(intrinsics, pose).unwrap());
    }
    cameras
}

#[test]
fn no_camera_makes_a_nan_leave() {
    let (mut field, pages) = WORLD.build();
    starve(&mut field, 0);
    for camera in odd_cameras(&WORLD) {
        for blend in BLENDS {
            let frame = frame_of(field.clone(), &pages, &camera, settings(Component::Full, blend)).unwrap();
            assert!(frame.pixels.color.iter().all(|c| c.is_finite()), "{blend:?} from {:?}", camera.pose());
            assert!(frame.pixels.depth.unwrap().iter().all(|d| *d > 0.0));
        }
    }
}

#[test]
fn nan_in_a_page_becomes_black_and_unknown() {
    let world = World { pixel: PixelFormat::F32, ..WORLD };
    let (field, mut pages) = world.build();
    for page in &mut pages.0 {
        let values = vec![f32::NAN; page.shape().values()];
        *page = Arc::new(crate::textures::Page::from_f32(page.shape(), &values).unwrap());
    }
    let frame = frame_of(field, &pages, &world.camera(Vec3::Z * 3.0, Vec3::ZERO, 16, 16), reconstruction()).unwrap();
    let middle = 16 * 8 + 8;
    assert_eq!(frame.pixels.color[3 * middle..3 * middle + 3], [0.0; 3]);
    assert_eq!(frame.pixels.provenance.unwrap()[middle].answer(), Answer::Unknown);
}

#[test]
fn texels_without_samples_are_unknown_and_with_few_still_answer() {
    let camera = WORLD.camera(Vec3::new(0.4, 0.2, 2.5), Vec3::ZERO, 48, 48);
    let unknown_with = |kept: usize, settings: Settings| {
        let (mut field, pages) = WORLD.build();
        starve(&mut field, kept);
        let frame = frame_of(field, &pages, &camera, settings).unwrap();
        frame.pixels.provenance.unwrap().iter().filter(|p| p.answer() == Answer::Unknown).count()
    };
    for settings in [reconstruction(), mirror(Blend::Average), mirror(Blend::Angle)] {
        assert_eq!(unknown_with(1, settings), 0);
        // A third of the texels, and the sphere fills about a third of the image.
        assert!(unknown_with(0, settings) > 48 * 48 / 20);
    }
}

#[test]
fn the_inside_of_the_object_is_unknown() {
    let frame = frame(&WORLD, Vec3::new(0.0, 0.0, 0.2), reconstruction());
    assert!(frame.pixels.provenance.unwrap().iter().all(|p| p.answer() == Answer::Unknown));
}

#[test]
fn a_missing_or_misshapen_page_is_an_error_that_names_it() {
    let camera = WORLD.camera(Vec3::Z * 3.0, Vec3::ZERO, 16, 16);
    let (field, mut pages) = WORLD.build();
    pages.0.truncate(3);
    let outcome = frame_of(field, &pages, &camera, reconstruction());
    assert!(matches!(outcome, Err(RenderError::Store(StoreError::NotFound { .. }))));
    let (mut field, pages) = WORLD.build();
    field.parameters.face_size_texels = 64;
    let outcome = frame_of(field, &pages, &camera, reconstruction());
    assert!(matches!(outcome, Err(RenderError::PageShape { width: 32, expected: [64, 64], .. })), "{outcome:?}");
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let render = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| frame(&WORLD, Vec3::new(1.0, 0.5, 2.5), settings(Component::Full, Blend::Angle))).pixels
    };
    assert_eq!(render(1), render(2));
}

#[test]
fn pages_are_counted_once_and_requests_as_often_as_they_are_made() {
    let (field, pages) = WORLD.build();
    let camera = WORLD.camera(Vec3::Z * 3.0, Vec3::ZERO, 64, 48);
    let frame = frame_of(field, &pages, &camera, mirror(Blend::Distance)).unwrap();
    let usage = frame.stats.page_use;
    assert!(frame.stats.pages_needed > 10 && frame.stats.pages_needed <= pages.0.len());
    assert!(usage.hits >= frame.stats.pages_needed as u64 && usage.misses == 0);
}

#[test]
fn the_sphere_on_its_floor_looks_as_it_did() {
    let frame = frame(&WORLD, Vec3::new(1.2, 0.9, 2.8), settings(Component::Full, Blend::Normal { exponent: 4.0 }));
    assert_golden("offset_surface_light_field_full.exr", &frame);
}
