//! Frames in other light, where it is known in closed form: a sphere under an environment of three bands of spherical harmonics.

use std::f32::consts::{FRAC_1_PI, PI};
use std::sync::Arc;

use glam::{Quat, Vec3};

use super::fixture::{MemoryPages, WORLD, World, environment_radiance};
use super::{BLENDS, FINE, for_sphere_pixels, frame_of, mirror, mirror_direction, reconstruction};
use crate::radiometry::brdf::{AnalyticBrdf, Lambert};
use crate::representations::offset_surface_light_field::{Blend, Component, Filter, Gloss, Settings};
use crate::representations::{Answer, RenderError};
use crate::scenes::{PointLight, Relighting};
use crate::textures::{Page, PageShape, PixelFormat};

const TURN: f32 = 1.9;
const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 3.0);
const ALBEDO: Vec3 = Vec3::new(0.8, 0.5, 0.3);

fn turned(turn: f32) -> Relighting {
    Relighting::new(turn, &[]).unwrap()
}

fn lamp(position: Vec3) -> Relighting {
    Relighting::new(0.0, &[PointLight { position, intensity: INTENSITY }]).unwrap()
}

const INTENSITY: Vec3 = Vec3::new(4.0, 6.0, 2.0);

fn before(direction: Vec3) -> Vec3 {
    Quat::from_rotation_y(-TURN) * direction
}

/// Of `environment_radiance` on a plane of normal n: π, 2π/3 and π/4 of its bands.
fn irradiance(n: Vec3) -> Vec3 {
    PI * Vec3::new(0.8, 0.7, 0.9)
        + 2.0 * PI / 3.0 * Vec3::new(0.5 * n.x, 0.3 * n.y, -0.4 * n.z)
        + PI / 4.0 * Vec3::new(0.0, 0.2 * n.x * n.z, 0.3 * n.x * n.y)
}

/// A diffuse sphere in its environment.
fn lit(n: Vec3) -> Vec3 {
    ALBEDO * irradiance(n) * FRAC_1_PI
}

const LIT: World = World { surface: lit, face_size: 64, ..FINE };

#[test]
fn a_mirror_shows_the_turned_environment() {
    for (blend, filter) in BLENDS.into_iter().flat_map(|b| [(b, Filter::Bilinear), (b, Filter::Footprint)]) {
        let settings = Settings { light: turned(TURN), filter, ..mirror(blend) };
        let mut difference = 0f32;
        for_sphere_pixels(&FINE, ORIGIN, settings, |n, d, radiance| {
            if n.dot(d) < -0.6 {
                let r = mirror_direction(n, d);
                let exact = environment_radiance(before(r));
                assert!((radiance - exact).length() < 0.02, "{blend:?} at {n}: {radiance} where {exact} is exact");
                difference = difference.max((exact - environment_radiance(r)).length());
            }
        });
        // Unturned the bound would be missed by far.
        assert!(difference > 0.5, "{difference}");
    }
}

#[test]
fn pixels_around_the_object_show_the_turned_environment() {
    let (field, pages) = WORLD.build();
    let camera = WORLD.camera(Vec3::new(0.5, 0.2, 3.0), Vec3::ZERO, 64, 48);
    let frame = frame_of(field, &pages, &camera, Settings { light: turned(TURN), ..reconstruction() }).unwrap();
    let depth = frame.pixels.depth.unwrap();
    let skies: Vec<u32> = (0..64 * 48).filter(|at| depth[*at as usize].is_infinite()).collect();
    assert!(skies.len() > 500);
    for at in skies {
        let shown = Vec3::from_slice(&frame.pixels.color[3 * at as usize..]);
        let exact = environment_radiance(before(camera.pixel_ray(at % 64, at / 64).direction));
        // A map of 64 × 32 texels.
        assert!((shown - exact).length() < 0.02, "{shown} where {exact} is exact");
    }
}

/// Vector irradiances of points about 0.2 apart, ε off the surface; a point's horizon is taken for its neighbours'.
#[test]
fn a_diffuse_sphere_is_lit_by_the_turned_environment() {
    let mut difference = 0f32;
    let settings = Settings { light: turned(TURN), ..reconstruction() };
    for_sphere_pixels(&LIT, ORIGIN, settings, |n, _, radiance| {
        let exact = ALBEDO * irradiance(before(n)) * FRAC_1_PI;
        assert!((radiance - exact).length() < 0.04, "at {n}: {radiance} where {exact} is exact");
        difference = difference.max((exact - lit(n)).length());
    });
    assert!(difference > 0.25, "{difference}");
}

/// What is added by a lamp is `ρ/π · I cos θ / d²`, and nothing where the sphere is in its own shadow.
#[test]
fn a_point_light_lights_a_diffuse_sphere_and_a_glossy_one_alike() {
    let position = Vec3::new(2.0, 1.0, 1.5);
    let brdf = AnalyticBrdf::Lambert(Lambert::new(ALBEDO).unwrap());
    let gloss = Component::Glossy(Gloss::of(brdf, 64));
    let shown = |component, light| {
        let mut radiance = Vec::new();
        let settings = Settings { component, light, filter: Filter::Footprint, ..mirror(Blend::Normal { exponent: 4.0 }) };
        for_sphere_pixels(&LIT, ORIGIN, settings, |n, _, shown| radiance.push((n, shown)));
        radiance
    };
    for (component, tolerance) in [(Component::Reconstruction, 0.06), (gloss, 2e-3)] {
        let (with, without) = (shown(component, lamp(position)), shown(component, Relighting::NONE));
        let (mut brightest, mut dark) = (0f32, 0);
        for ((n, with), (_, without)) in with.into_iter().zip(without) {
            let to_light = position - n;
            let cosine = n.dot(to_light.normalize());
            let exact = ALBEDO * FRAC_1_PI * INTENSITY * cosine.max(0.0) / to_light.length_squared();
            // Where the light grazes, a sample point's texels cannot tell the horizon.
            if cosine.abs() > 0.15 {
                let added = with - without;
                assert!(
                    (added - exact).length() <= tolerance * (0.1 + exact.length()),
                    "{component:?} at {n}: {added} where {exact} is exact"
                );
                brightest = brightest.max(exact.length());
                dark += u32::from(cosine < 0.0);
            }
        }
        assert!(brightest > 0.3 && dark > 100, "{brightest}, {dark}");
    }
}

#[test]
fn a_lamp_behind_a_wall_is_not_seen() {
    // The room's wall is met at 2.6; a lamp beyond it shines on nothing.
    let world = World { room: 2.6, ..LIT };
    let settings = |position| Settings { light: lamp(position), ..reconstruction() };
    let mean = |light: Option<Vec3>| {
        let (mut sum, mut count) = (Vec3::ZERO, 0.0);
        let settings = light.map_or(reconstruction(), settings);
        for_sphere_pixels(&world, Vec3::new(0.4, 0.5, 2.3), settings, |_, _, radiance| {
            sum += radiance;
            count += 1.0;
        });
        sum / count
    };
    let toward = Vec3::new(0.4, 0.3, 1.0).normalize();
    let (dark, within, beyond) = (mean(None), mean(Some(2.3 * toward)), mean(Some(3.0 * toward)));
    assert!((within - dark).min_element() > 0.05, "{within} from {dark}");
    assert!((beyond - dark).length() < 1e-3, "{beyond} from {dark}");
}

#[test]
fn no_light_makes_a_number_that_is_not_finite() {
    let (field, pages) = World { points: 20, face_size: 8, ..WORLD }.build();
    let camera = WORLD.camera(ORIGIN, Vec3::ZERO, 32, 24);
    let positions = [Vec3::ZERO, Vec3::Z, Vec3::splat(1e9), Vec3::splat(1e-30), field.sample_points[3].position];
    let brdf = AnalyticBrdf::Lambert(Lambert::new(ALBEDO).unwrap());
    for component in [Component::Full, Component::Glossy(Gloss::of(brdf, 2))] {
        for position in positions {
            let light = Relighting::new(1e6, &[PointLight { position, intensity: Vec3::splat(1e9) }]).unwrap();
            let frame = frame_of(field.clone(), &pages, &camera, Settings { component, light, ..mirror(Blend::Corrected) }).unwrap();
            assert!(frame.pixels.color.iter().all(|c| c.is_finite() && *c >= 0.0), "{position}");
        }
    }
}

#[test]
fn a_dataset_without_shares_of_sky_is_refused_and_shown_as_captured() {
    let (field, mut pages) = WORLD.build();
    for page in pages.0.iter_mut().skip(field.face_count()) {
        let texels: Vec<f32> = page.to_f32().chunks(4).flat_map(|texel| texel[..3].to_vec()).collect();
        *page = Arc::new(Page::from_f32(PageShape { channels: 3, ..page.shape() }, &texels).unwrap());
    }
    let camera = WORLD.camera(ORIGIN, Vec3::ZERO, 32, 24);
    let shown = |light| frame_of(field.clone(), &pages, &camera, Settings { light, ..mirror(Blend::Average) });
    assert!(matches!(shown(turned(1.0)), Err(RenderError::NoSkyShares)));
    let (old, new) = (shown(Relighting::NONE).unwrap(), {
        let (field, pages): (_, MemoryPages) = WORLD.build();
        frame_of(field, &pages, &camera, mirror(Blend::Average)).unwrap()
    });
    assert!(old.pixels == new.pixels && old.pixels.provenance.unwrap().iter().any(|p| p.answer() == Answer::Hit));
    assert_eq!(pages.0[0].shape().pixel, PixelFormat::F16);
}
