//! The plane as the path tracer sees it, against the thesis's closed form.

use super::*;
use crate::geometry::Ray;
use crate::progress::Unattended;
use crate::raytrace::{TraceSettings, Tracer};
use crate::scenes::{BuiltinOptions, Scene, builtin};

fn plane(change: impl Fn(&mut PlaneOptions)) -> Scene {
    let mut options = BuiltinOptions::small();
    change(&mut options.plane);
    builtin("glossy_plane", &options).unwrap()
}

/// Mean radiance of the middle of the plane toward `wo`, whose share of the picture is one pixel.
fn radiance(scene: &Scene, wo: Vec3) -> Vec3 {
    use crate::geometry::{Camera, Intrinsics, Pose};
    let pose = Pose::look_at(2.0 * wo, Vec3::ZERO, Vec3::X).unwrap();
    let camera = Camera::new(Intrinsics::from_vfov(0.01, 16, 16).unwrap(), pose).unwrap();
    let settings = TraceSettings { samples_per_pixel: 16, max_bounces: 1, seed: 1 };
    let image = Tracer::new(scene).unwrap().render(&camera, &settings, &Unattended).unwrap().radiance;
    (0..256).map(|i| Vec3::from(image.rgb(i))).sum::<Vec3>() / 256.0
}

#[test]
fn the_middle_shows_the_sources_lobe_for_every_shininess() {
    let light = LAMP.normalize();
    let mirrored = Vec3::new(-light.x, light.y, -light.z);
    for shininess in [2.0, 15.0, 200.0] {
        let scene = plane(|p| p.shininess = shininess);
        for wo in [mirrored, Vec3::Y, Vec3::new(0.4, 0.8, -0.2).normalize()] {
            let lobe = 0.4 * wo.dot(mirrored).max(0.0).powf(shininess);
            let expected = light.y * (Vec3::from(COLOUR) + lobe);
            // One light without noise; a pixel's width of 10⁻⁵ and f32.
            let seen = radiance(&scene, wo);
            assert!((seen - expected).abs().max_element() < 1e-3, "m = {shininess} toward {wo}: {seen}, {expected} expected");
        }
    }
}

#[test]
fn every_lamp_sends_the_same_to_the_middle() {
    let toward = Vec3::new(0.3, 0.9, 0.6).normalize();
    let point = radiance(&plane(|_| ()), toward);
    for lamp in [PlaneLamp::NinePoints, PlaneLamp::Disc] {
        let seen = radiance(&plane(|p| p.lamp = lamp), toward);
        // A lamp 0.4 wide at distance 2.9 differs from its middle by squares of their quotient, 2 %.
        assert!((seen / point - 1.0).abs().max_element() < 0.02, "{lamp:?}: {seen}, {point} expected");
    }
}

#[test]
fn the_second_light_stands_where_it_is_asked_for() {
    for d in [0.45, -0.45, -1.5] {
        let scene = plane(|p| p.second_light = Some(d));
        assert_eq!(scene.point_lights.len(), 2);
        assert_eq!(scene.point_lights[1].position, Vec3::new(d, 2.0, -d));
        assert!(scene.point_lights[1].intensity.max_element() < scene.point_lights[0].intensity.min_element());
    }
}

#[test]
fn the_plane_faces_up_with_its_texture_as_in_the_source() {
    let tracer = Tracer::new(&plane(|_| ())).unwrap();
    // Their corner of largest (x, y), below the light, is (s, t) = (1, 1).
    let ray = Ray { origin: Vec3::new(0.45, 1.0, -0.45), direction: Vec3::NEG_Y };
    let hit = tracer.intersect(&ray, f32::INFINITY).unwrap();
    assert!((hit.uv - 0.95).abs().max_element() < 1e-5, "{}", hit.uv);
    assert_eq!(hit.geometric_normal, Vec3::Y);
}
