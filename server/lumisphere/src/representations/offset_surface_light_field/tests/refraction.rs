//! A clear sphere, through which the way of every ray is known.

use glam::Vec3;

use super::fixture::{WORLD, World, environment_radiance};
use super::{FINE, for_sphere_pixels, frame_of, mirror, mirror_direction};
use crate::radiometry::dielectric::{Body, Dielectric, fresnel_reflectance, refracted};
use crate::representations::offset_surface_light_field::{Blend, Component, Filter, NO_SAMPLE, Settings};
use crate::representations::{Answer, RenderError, Settings as AnySettings};
use crate::representations::{PixelOrder, Recording};

const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 3.0);
const GLASS: f32 = 1.5;

fn clear(body: Body, blend: Blend, filter: Filter) -> Settings {
    Settings { component: Component::Refraction(Dielectric::new(GLASS, body).unwrap()), filter, ..mirror(blend) }
}

/// R and T of Fresnel's equations for a ball, and where its ray goes: the deviation inside is twice that of one surface.
fn through_a_ball(n: Vec3, d: Vec3, body: Body) -> (f32, f32, Vec3) {
    let of_surface = fresnel_reflectance(-n.dot(d), GLASS);
    if body == Body::Thin {
        let reflected = 2.0 * of_surface / (1.0 + of_surface);
        return (reflected, (1.0 - reflected) * (1.0 - reflected), d);
    }
    let inside = refracted(d, n, 1.0 / GLASS).unwrap();
    let exit = n - 2.0 * n.dot(inside) * inside;
    (of_surface, (1.0 - of_surface) * (1.0 - of_surface), refracted(inside, -exit, GLASS).unwrap())
}

#[test]
fn a_glass_ball_and_a_bubble_show_the_environment_beyond() {
    let blends = [
        (Blend::Normal { exponent: 4.0 }, Filter::Bilinear),
        (Blend::Corrected, Filter::Footprint),
        (Blend::EnvironmentMap, Filter::Bilinear),
    ];
    for ((blend, filter), body) in blends.into_iter().flat_map(|b| [(b, Body::Solid), (b, Body::Thin)]) {
        let (mut unrefracted, mut checked) = (0f32, 0);
        for_sphere_pixels(&FINE, ORIGIN, clear(body, blend, filter), |n, d, radiance| {
            // Where the eye's ray grazes, facets of 2° turn what is seen by more than a texel.
            if n.dot(d) < -0.5 {
                let (reflected, passed, direction) = through_a_ball(n, d, body);
                let mirrored = reflected * environment_radiance(mirror_direction(n, d));
                let exact = mirrored + passed * environment_radiance(direction);
                assert!((radiance - exact).length() < 0.03, "{body:?} {blend:?} at {n}: {radiance} where {exact} is exact");
                unrefracted = unrefracted.max((mirrored + passed * environment_radiance(d) - exact).length());
                checked += 1;
            }
        });
        assert!(checked > 300 && (body == Body::Thin || unrefracted > 0.3), "{checked}, {unrefracted}");
    }
}

/// In a room what lies beyond is near: uncorrected reads are off by the parallax of the sphere, corrected ones are not.
#[test]
fn corrected_reads_beyond_the_body_have_no_parallax() {
    let world = World { room: 2.6, ..FINE };
    let origin = Vec3::new(0.3, 0.5, 2.2);
    let error = |blend| {
        let (mut sum, mut count) = (0.0, 0);
        for_sphere_pixels(&world, origin, clear(Body::Thin, blend, Filter::Bilinear), |n, d, radiance| {
            if n.dot(d) < -0.5 {
                let reflected = 2.0 * fresnel_reflectance(-n.dot(d), GLASS) / (1.0 + fresnel_reflectance(-n.dot(d), GLASS));
                let seen = |d| world.surroundings(n, d).0;
                let exact = reflected * seen(mirror_direction(n, d)) + (1.0 - reflected) * (1.0 - reflected) * seen(d);
                sum += (radiance - exact).length_squared();
                count += 1;
            }
        });
        (sum / count as f32).sqrt()
    };
    let (corrected, baseline) = (error(Blend::Corrected), error(Blend::EnvironmentMap));
    assert!(corrected < 0.012 && baseline > 5.0 * corrected, "{corrected}, by one environment map {baseline}");
}

#[test]
fn a_body_without_sample_points_on_the_other_side_shows_the_mirror_alone_and_says_so() {
    let (mut field, pages) = FINE.build();
    // The far side's parts see nothing: −Z and −X; the camera is before +Z.
    let (size, parts) = (field.sample_maps.size, [1, 5]);
    for part in parts {
        field.sample_maps.indices[part * size * size..(part + 1) * size * size].fill([NO_SAMPLE; 4]);
    }
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, 64, 48);
    let frame = frame_of(field, &pages, &camera, clear(Body::Thin, Blend::Average, Filter::Bilinear)).unwrap();
    let (provenance, depth) = (frame.pixels.provenance.unwrap(), frame.pixels.depth.unwrap());
    let mut unknown = 0;
    for at in (0..64 * 48).filter(|at| provenance[*at as usize].answer() == Answer::Unknown) {
        let ray = camera.pixel_ray(at % 64, at / 64);
        let n = ray.at(depth[at as usize]).normalize();
        if n.dot(ray.direction) < -0.6 {
            let of_surface = fresnel_reflectance(-n.dot(ray.direction), GLASS);
            let exact = 2.0 * of_surface / (1.0 + of_surface) * environment_radiance(mirror_direction(n, ray.direction));
            let shown = Vec3::from_slice(&frame.pixels.color[3 * at as usize..]);
            assert!((shown - exact).length() < 0.01, "{shown} where {exact} is exact");
            unknown += 1;
        }
    }
    assert!(unknown > 100, "{unknown}");
}

#[test]
fn no_index_makes_a_number_that_is_not_finite_and_what_reads_more_is_not_recorded() {
    let (field, pages) = World { points: 20, quads: 4, ..WORLD }.build();
    let camera = WORLD.camera(ORIGIN, Vec3::ZERO, 32, 24);
    for (index, body) in [1.0, 1.0001, 4.0].into_iter().flat_map(|index| [(index, Body::Solid), (index, Body::Thin)]) {
        let settings = Settings {
            component: Component::Refraction(Dielectric::new(index, body).unwrap()),
            filter: Filter::Footprint,
            ..mirror(Blend::Corrected)
        };
        let frame = frame_of(field.clone(), &pages, &camera, settings).unwrap();
        assert!(frame.pixels.color.iter().all(|c| c.is_finite() && *c >= 0.0), "{index} {body:?}");
    }
    let settings = AnySettings::OffsetSurfaceLightField(clear(Body::Solid, Blend::Average, Filter::Bilinear));
    let recording = Recording { camera: &camera, settings: &settings, order: PixelOrder::Buckets, lobe: None };
    let kernel = crate::representations::Representation::cpu_kernel(std::sync::Arc::new(field));
    assert!(matches!(kernel.record(&recording, &mut |_| ()), Err(RenderError::ReadsMore)));
}
