//! Depth-corrected reads: right where the surroundings are near, and never taken in by a sample point that sees something else.

use std::sync::Arc;

use glam::Vec3;

use super::super::corrected::InverseDistances;
use super::super::shade::{ReadCube, Sight, mirror_direction, own_sample};
use super::fixture::{MemoryPages, WORLD, World};
use super::{BLENDS, frame_of, mirror, reconstruction};
use crate::directions::FACES;
use crate::representations::offset_surface_light_field::{Blend, OffsetSurfaceLightField, Settings};
use crate::representations::{Answer, PixelOrder, Provenance, Recording, RenderError, Representation, Settings as AnySettings};
use crate::textures::{Page, PixelFormat};

pub(super) const NEAR: World = World { points: 120, quads: 32, pixel: PixelFormat::F32, room: 2.0, ..WORLD };
const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 1.8);

// Colour and provenance of each pixel.
fn shown(field: &OffsetSurfaceLightField, pages: &MemoryPages, settings: Settings) -> Vec<(Vec3, Provenance)> {
    let camera = NEAR.camera(ORIGIN, Vec3::ZERO, 64, 48);
    let pixels = frame_of(field.clone(), pages, &camera, settings).unwrap().pixels;
    pixels.color.chunks(3).map(Vec3::from_slice).zip(pixels.provenance.unwrap()).collect()
}

// Root mean square difference from the exact mirror image where it shows the room.
fn mirror_error(world: &World, blend: Blend) -> f32 {
    let camera = world.camera(ORIGIN, Vec3::ZERO, 64, 48);
    let (field, pages) = world.build();
    let pixels = frame_of(field, &pages, &camera, mirror(blend)).unwrap().pixels;
    let (mut squares, mut count) = (0.0, 0);
    for at in 0..64 * 48 {
        let ray = camera.pixel_ray(at % 64, at / 64);
        let at = at as usize;
        if pixels.provenance.as_ref().unwrap()[at].answer() != Answer::Hit {
            continue;
        }
        let x = ray.at(pixels.depth.as_ref().unwrap()[at]).normalize();
        if x.dot(ray.direction) < -0.3 {
            let (exact, _) = world.surroundings(x, mirror_direction(x, ray.direction));
            squares += (Vec3::from_slice(&pixels.color[3 * at..]) - exact).length_squared();
            count += 1;
        }
    }
    assert!(count > 500, "only {count} pixels show the room");
    (squares / count as f32).sqrt()
}

/// Walls at once to nine times the sphere's radius from it, and infinitely far: what the paper's blends lack is parallax.
#[test]
fn the_mirror_image_is_right_however_near_the_walls_are() {
    for room in [1.5, 2.0, 4.0, 10.0, f32::INFINITY] {
        let world = World { room, ..NEAR };
        let corrected = mirror_error(&world, Blend::Corrected);
        let others = BLENDS.into_iter().filter(|b| !matches!(b, Blend::Corrected | Blend::EnvironmentMap));
        let best = others.map(|blend| mirror_error(&world, blend)).fold(f32::INFINITY, f32::min);
        println!("walls at {room}: {corrected:.4} corrected, {best:.4} the best of the others");
        // Texels of 2/32, as in the other tests of exact images.
        assert!(corrected < 0.01, "walls at {room}: {corrected}");
        assert!(room > 4.0 || corrected < 0.25 * best, "walls at {room}: {corrected}, the best of the others {best}");
    }
}

// Sample points for which `lies` see something glaring, `distance` away, everywhere.
pub(super) fn with_liars(lies: impl Fn(usize) -> bool, distance: f32) -> (OffsetSurfaceLightField, MemoryPages) {
    let (field, mut pages) = NEAR.build();
    for cube in (0..NEAR.points).filter(|cube| lies(*cube)) {
        for page in &mut pages.0[FACES * cube..FACES * (cube + 1)] {
            let texels = page.shape().values() / 4;
            let values: Vec<f32> = [100.0, 0.0, 0.0, distance].repeat(texels);
            *page = Arc::new(Page::from_f32(page.shape(), &values).unwrap());
        }
    }
    (field, pages)
}

#[test]
fn sample_points_that_see_something_else_are_left_out() {
    let (field, honest) = NEAR.build();
    for settings in [mirror(Blend::Corrected), Settings { blend: Blend::Corrected, ..reconstruction() }] {
        let expected = shown(&field, &honest, settings);
        // Too far, so that nothing is met there, and as near as a wall that stands right before the sample point.
        for distance in [1e4, 1e-4] {
            let (field, pages) = with_liars(|cube| cube % 3 == 0, distance);
            let taken_in = shown(&field, &pages, Settings { blend: Blend::Distance, ..settings });
            assert!(taken_in.iter().filter(|(color, _)| color.x > 10.0).count() > 100, "{settings:?}");
            for (at, ((color, provenance), (right, _))) in shown(&field, &pages, settings).into_iter().zip(&expected).enumerate() {
                if provenance.answer() == Answer::Hit {
                    assert!((color - *right).length() < 0.06, "{settings:?}, {distance}: pixel {at} is {color}, {right} expected");
                }
            }
        }
    }
}

#[test]
fn where_no_sample_point_knows_the_reads_are_uncorrected_and_say_so() {
    let (field, pages) = with_liars(|_| true, 1e-4);
    let uncorrected = [(Blend::Normal { exponent: 4.0 }, mirror(Blend::Corrected)), (Blend::Distance, reconstruction())];
    for (fallback, settings) in uncorrected {
        let found = shown(&field, &pages, Settings { blend: Blend::Corrected, ..settings });
        let expected = shown(&field, &pages, Settings { blend: fallback, ..settings });
        let mut filled = 0;
        for ((color, provenance), (right, before)) in found.into_iter().zip(expected) {
            assert!((color - right).length() < 1e-4 * right.length(), "{color} where {right} is expected");
            if before.answer() == Answer::Hit {
                assert_eq!((provenance.answer(), provenance.sample()), (Answer::Filled, before.sample()));
                filled += 1;
            }
        }
        assert!(filled > 500, "{filled} pixels");
    }
}

// Sees a point where it is, in the cubes that are `honest`, and a wall halfway to it in the others.
struct Told<'a> {
    field: &'a OffsetSurfaceLightField,
    honest: u16,
}

impl ReadCube for Told<'_> {
    fn read_level(&mut self, _cube: u32, _direction: Vec3, _level: u32) -> Result<Vec3, RenderError> {
        unreachable!("only distances are asked for")
    }

    fn inverse_distances(&mut self, cube: u32, offset: Vec3) -> Result<InverseDistances, RenderError> {
        let distance = if self.honest >> cube & 1 == 1 { offset.length() } else { 0.5 * offset.length() };
        Ok(InverseDistances::of([(distance, 0.25); 4]))
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        self.field
    }
}

/// Whoever sees the surface's point goes before whoever does not, however low; of those the nearest above the horizon, else the highest.
#[test]
fn a_sample_point_below_the_horizon_that_sees_the_surface_goes_before_one_that_does_not() {
    let (mut field, _) = NEAR.build();
    let angles = [70f32, 20.0, 80.0, 50.0];
    for (point, angle) in field.sample_points.iter_mut().zip(angles) {
        point.position = Vec3::new(angle.to_radians().sin(), angle.to_radians().cos(), 0.0);
    }
    let at = Sight { position: Vec3::ZERO, normal: Vec3::Y, direction: Vec3::NEG_Y };
    let candidates = [0, 1, 2, 3];
    let chosen = |blend, honest| {
        let settings = Settings { blend, ..reconstruction() };
        own_sample(&field, &settings, &at, candidates, &mut Told { field: &field, honest }).unwrap()
    };
    for honest in 0..16u16 {
        let sees = |k: usize| honest >> k & 1 == 1;
        let expected = match () {
            () if sees(1) => (1, Answer::Hit),
            () if sees(3) => (3, Answer::Hit),
            () if sees(0) => (0, Answer::Filled),
            () if sees(2) => (2, Answer::Filled),
            () => (1, Answer::Filled),
        };
        assert_eq!(chosen(Blend::Corrected, honest), Some(expected), "{honest:04b}");
        assert_eq!(chosen(Blend::Distance, honest), Some((1, Answer::Hit)), "{honest:04b}");
    }
}

#[test]
fn such_frames_cannot_be_recorded() {
    let (field, _) = NEAR.build();
    let camera = NEAR.camera(ORIGIN, Vec3::ZERO, 16, 12);
    let kernel = Arc::new(field).cpu_kernel();
    for settings in [mirror(Blend::Corrected), Settings { blend: Blend::Corrected, ..reconstruction() }] {
        let settings = AnySettings::OffsetSurfaceLightField(settings);
        let recording = Recording { camera: &camera, settings: &settings, order: PixelOrder::Buckets, lobe: None };
        assert!(matches!(kernel.record(&recording, &mut |_| ()), Err(RenderError::DependsOnPages)));
    }
}
