//! An object that sees itself: the ball, whose part toward −X stands before its other side and looks at it.

use glam::Vec3;

use super::fixture::{MemoryPages, World, environment_radiance};
use super::{FINE, frame_of, mirror_direction, settings};
use crate::representations::offset_surface_light_field::{Blend, Component, Filter, OffsetSurfaceLightField, Settings};
use crate::representations::{Answer, PixelOrder, Recording, RenderError, Representation, Settings as AnySettings};

/// Where the moved part's own ball would be.
const MOVED: Vec3 = Vec3::new(3.0, 0.0, 0.0);
const ORIGIN: Vec3 = Vec3::new(1.0, 0.5, 2.6);

/// The world's field, a part of it moved. Its cube maps still show it where it was.
pub fn facing_itself(world: &World) -> (OffsetSurfaceLightField, MemoryPages) {
    let (mut field, pages) = world.build();
    let per_part = field.surface.mesh.positions.len() / 6;
    let mesh = &mut field.surface.mesh;
    assert!(mesh.normals[per_part..2 * per_part].iter().all(|n| n.x < -0.5), "the second part is the one toward −X");
    mesh.positions[per_part..2 * per_part].iter_mut().for_each(|p| *p += MOVED);
    (field, pages)
}

/// Where a ray from the ball meets the moved part: its normal; None past it. Pixels at its rim are left out by `margin`.
fn met(x: Vec3, r: Vec3, margin: f32) -> Option<Vec3> {
    let (to, b) = (x - MOVED, (x - MOVED).dot(r));
    let t = -b - (b * b - to.length_squared() + 1.0).max(0.0).sqrt();
    let n = x + t * r - MOVED;
    let inside = b * b - to.length_squared() + 1.0 > 0.0 && t > 0.0 && n.x < 0.0;
    (inside && n.y.abs().max(n.z.abs()) < (1.0 - margin) * n.x.abs()).then_some(n)
}

#[test]
fn further_reflections_show_what_the_reflected_surface_mirrors() {
    let (field, pages) = facing_itself(&FINE);
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, 96, 72);
    let frame = |component, reflections, filter| {
        // By one map, which is exact for light from infinity: what is tested are the rays.
        let settings = Settings { reflections, filter, ..settings(component, Blend::EnvironmentMap) };
        frame_of(field.clone(), &pages, &camera, settings).unwrap().pixels
    };
    let tint = settings(Component::Mirror, Blend::EnvironmentMap).specular_reflectance;
    let own = frame(Component::Reconstruction, 1, Filter::Bilinear).color;
    for (reflections, filter) in [(1, Filter::Bilinear), (2, Filter::Bilinear), (2, Filter::Footprint), (4, Filter::Footprint)] {
        let (alone, both) = (frame(Component::Mirror, reflections, filter), frame(Component::Full, reflections, filter));
        let (provenance, depth) = (alone.provenance.unwrap(), alone.depth.unwrap());
        let (mut once, mut twice) = (0, 0);
        for at in (0..96 * 72).filter(|at| provenance[*at].answer() == Answer::Hit) {
            let ray = camera.pixel_ray(at as u32 % 96, at as u32 / 96);
            let (x, of) = (ray.at(depth[at]), |color: &[f32]| Vec3::from_slice(&color[3 * at..]));
            let n = x.normalize();
            // The ball, where it does not graze.
            if x.length() > 1.01 || n.dot(ray.direction) > -0.4 {
                continue;
            }
            let r = mirror_direction(n, ray.direction);
            let first = tint * environment_radiance(r);
            let (mirror, full) = match met(x, r, 0.1) {
                Some(m) if reflections > 1 => {
                    let next = mirror_direction(m, r);
                    // From there to the sky: past the ball.
                    assert!(next.x < 0.9);
                    if (x + met_distance(x, r, m) * r).cross(next).length() < 1.1 {
                        continue;
                    }
                    twice += 1;
                    let second = tint * tint * environment_radiance(next);
                    (second, first + second)
                }
                Some(_) => (first, first),
                // Near the rim facets decide.
                None if met(x, r, -0.1).is_some() => continue,
                None => {
                    once += 1;
                    (first, first)
                }
            };
            assert!((of(&alone.color) - mirror).length() < 0.02, "{reflections} at {x}: {} where {mirror} is exact", of(&alone.color));
            let full = full + of(&own);
            assert!((of(&both.color) - full).length() < 0.03, "{reflections} at {x}: {} where {full} is exact", of(&both.color));
        }
        assert!(once > 300 && (reflections == 1 || twice > 40), "{once} pixels once, {twice} twice");
    }
}

/// Near its silhouette, too, where interpolated normals mirror rays into the facet that they come from.
#[test]
fn a_convex_body_does_not_see_itself() {
    let world = World { quads: 6, ..FINE };
    let (field, pages) = world.build();
    let camera = world.camera(ORIGIN, Vec3::ZERO, 96, 72);
    for component in [Component::Mirror, Component::Full] {
        let shown = |reflections| {
            let settings = Settings { reflections, ..settings(component, Blend::EnvironmentMap) };
            frame_of(field.clone(), &pages, &camera, settings).unwrap().pixels.color
        };
        assert!(shown(1) == shown(4), "{component:?}");
    }
}

fn met_distance(x: Vec3, r: Vec3, normal: Vec3) -> f32 {
    (MOVED + normal - x).dot(r)
}

#[test]
fn a_ray_that_meets_a_back_ends_before_it_and_what_reads_more_is_not_recorded() {
    // Behind the moved part, whose front looks away: from +X one sees its back, in which nothing is mirrored.
    let (mut field, pages) = facing_itself(&FINE);
    let mesh = &mut field.surface.mesh;
    let triangles_per_part = mesh.triangles.len() / 6;
    mesh.triangles[triangles_per_part..2 * triangles_per_part].iter_mut().for_each(|t| t.swap(1, 2));
    mesh.normals.iter_mut().zip(&mesh.positions).filter(|(_, p)| p.x > 1.5).for_each(|(n, _)| *n = -*n);
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, 96, 72);
    let shown = |reflections| {
        let settings = Settings { reflections, ..settings(Component::Mirror, Blend::EnvironmentMap) };
        frame_of(field.clone(), &pages, &camera, settings).unwrap().pixels
    };
    let (one, three) = (shown(1), shown(3));
    let on_ball = |at: usize| one.depth.as_ref().unwrap()[at].is_finite() && one.provenance.as_ref().unwrap()[at].answer() == Answer::Hit;
    let of_ball: Vec<usize> = (0..96 * 72).filter(|at| on_ball(*at)).collect();
    assert!(of_ball.len() > 500 && of_ball.iter().all(|at| one.color[3 * at..3 * at + 3] == three.color[3 * at..3 * at + 3]));

    let settings = Settings { reflections: 2, ..settings(Component::Full, Blend::Average) };
    let (camera, settings) = (FINE.camera(ORIGIN, Vec3::ZERO, 8, 6), AnySettings::OffsetSurfaceLightField(settings));
    let recording = Recording { camera: &camera, settings: &settings, order: PixelOrder::Buckets, lobe: None };
    let kernel = std::sync::Arc::new(field).cpu_kernel();
    assert!(matches!(kernel.record(&recording, &mut |_| ()), Err(RenderError::ReadsMore)));
}
