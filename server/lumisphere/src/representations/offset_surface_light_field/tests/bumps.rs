//! Frames with a normal map: what a flat one is, where a known tilt looks, and what would enter the surface.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::fixture::{MemoryPages, World, environment_radiance};
use super::{EVERYTHING, FINE, mirror};
use crate::directions::{direction_from_face, face_from_direction};
use crate::geometry::{Mapping, NormalMap};
use crate::radiometry::brdf::{AnalyticBrdf, CookTorrance, Lambert};
use crate::radiometry::dielectric::{Body, Dielectric};
use crate::render::{Backend, FrameRequest, RenderError, Renderer};
use crate::representations::offset_surface_light_field::shade::mirror_direction;
use crate::representations::offset_surface_light_field::{
    Blend, Bumps, Component, Filter, Gloss, Integration, OffsetSurfaceLightField, Settings,
};
use crate::representations::{Answer, Pixels, Refine, Representation, Settings as AnySettings, Uploads};
use crate::textures::ContentHash;

const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 3.0);
const SIZE: (u32, u32) = (64, 48);

pub(super) const HASH: ContentHash = ContentHash([3; 32]);

/// All texels of one slope.
fn even(slope: Vec2) -> NormalMap {
    NormalMap::new(4, 2, [slope; 8]).unwrap()
}

/// Hills of slopes up to `steepest`, other along u than along v.
pub(super) fn hills(steepest: f32) -> NormalMap {
    let wave = |at: usize, size: usize, phase: f32| steepest * (std::f32::consts::TAU * (at as f32 / size as f32) + phase).sin();
    let slopes = (0..32 * 16).map(|at| Vec2::new(wave(at % 32, 32, 0.3), wave(at / 32, 16, 1.1)));
    NormalMap::new(32, 16, slopes).unwrap()
}

pub(super) fn bumped(settings: Settings, strength: f32, repeat: f32) -> Settings {
    Settings { bumps: Some(Bumps { map: HASH, mapping: Mapping { strength, repeat } }), ..settings }
}

fn shown(
    (field, pages): &(OffsetSurfaceLightField, MemoryPages),
    world: &World,
    settings: Settings,
    map: Option<NormalMap>,
) -> Result<Pixels, RenderError> {
    let (camera, settings) = (world.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1), AnySettings::OffsetSurfaceLightField(settings));
    let map = map.map(Arc::new);
    let uploads = Uploads { normal_map: map.as_ref(), ..Uploads::NONE };
    let request = FrameRequest { camera: &camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads };
    let field: Arc<dyn Representation> = Arc::new(field.clone());
    Ok(Renderer::cpu_only().render(&field, pages, &request, Some(Backend::Cpu))?.pixels)
}

fn cook_torrance(alpha: f32) -> AnalyticBrdf {
    AnalyticBrdf::CookTorrance(CookTorrance::new(Vec2::splat(alpha), Vec3::ONE, Vec3::ONE).unwrap())
}

fn prefiltered(alpha: f32) -> Component {
    Component::Glossy(Gloss { integration: Integration::Prefiltered, ..Gloss::of(cook_torrance(alpha), 8) })
}

/// All that a map can be on.
pub(super) fn components() -> [Component; 5] {
    let lambert = AnalyticBrdf::Lambert(Lambert::new(Vec3::splat(0.7)).unwrap());
    let drawn = [Component::Glossy(Gloss::of(cook_torrance(0.2), 8)), Component::Glossy(Gloss::of(lambert, 8))];
    [Component::Mirror, Component::Full, prefiltered(0.05), drawn[0], drawn[1]]
}

#[test]
fn a_flat_map_is_no_map_to_the_last_bit() {
    let world = World { points: 60, quads: 12, ..FINE };
    let stored = world.build();
    for component in components() {
        for filter in [Filter::Footprint, Filter::Bilinear] {
            let settings = Settings { component, filter, ..mirror(Blend::Corrected) };
            let without = shown(&stored, &world, settings, None).unwrap();
            let with = |strength, map| shown(&stored, &world, bumped(settings, strength, 2.0), Some(map)).unwrap();
            assert_eq!(with(1.0, even(Vec2::ZERO)), without, "{component:?}, {filter:?}");
            assert_eq!(with(0.0, hills(0.4)), without, "{component:?}, {filter:?}: no strength");
            assert_ne!(with(1.0, hills(0.4)).color, without.color, "{component:?}, {filter:?}: hills");
        }
    }
}

/// Where the sphere's u grows, and v on either side of it: derivatives of the cube's face blown up to it. The fixture's texture is mirrored.
fn tangents(n: Vec3) -> [Vec3; 2] {
    let (face, at) = face_from_direction(n);
    let step = |by: Vec2| {
        let point = |at: Vec2| direction_from_face(face, at.x, at.y).normalize();
        (point(at + by) - point(at - by)).normalize()
    };
    let (along_u, along_v) = (step(1e-2 * Vec2::X), step(1e-2 * Vec2::Y));
    let across = n.cross(along_u);
    [along_u, across * across.dot(along_v).signum()]
}

#[test]
fn a_known_tilt_shows_what_the_tilted_mirror_would() {
    let stored = FINE.build();
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1);
    for (slope, strength) in [(Vec2::new(0.3, 0.0), 1.0), (Vec2::new(0.0, -0.15), 2.0), (Vec2::new(0.2, 0.1), -1.0)] {
        let settings = bumped(mirror(Blend::Normal { exponent: 4.0 }), strength, 1.0);
        let pixels = shown(&stored, &FINE, settings, Some(even(slope))).unwrap();
        let mut checked = 0;
        for at in 0..SIZE.0 * SIZE.1 {
            let (ray, index) = (camera.pixel_ray(at % SIZE.0, at / SIZE.0), at as usize);
            if pixels.provenance.as_ref().unwrap()[index].answer() != Answer::Hit {
                continue;
            }
            let n = ray.at(pixels.depth.as_ref().unwrap()[index]).normalize();
            let [u, v] = tangents(n);
            let turned = (n + strength * (slope.x * u + slope.y * v)).normalize();
            let r = mirror_direction(turned, ray.direction);
            // Nearer to the horizon a neighbour's sample point may see the sphere.
            if r.dot(n) < 0.6 {
                continue;
            }
            checked += 1;
            let (radiance, exact) = (Vec3::from_slice(&pixels.color[3 * index..]), environment_radiance(r));
            // As without a map, and facets of 48 quads whose tangents differ by up to a 48th of 90° from the sphere's: 0.03 · 0.3 · 2 of a slope of 0.5.
            assert!((radiance - exact).length() < 0.02, "{slope} · {strength} at {n}: {radiance} where {exact} is exact");
        }
        assert!(checked > 400, "only {checked} pixels show the sphere");
    }
}

#[test]
fn what_would_enter_the_surface_is_mirrored_as_without_a_map_and_lost_of_a_highlight() {
    let stored = FINE.build();
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1);
    let map = || Some(even(Vec2::new(1.5, 0.0)));
    let mirrored = mirror(Blend::Normal { exponent: 4.0 });
    let narrow = Settings { component: prefiltered(0.01), filter: Filter::Footprint, ..mirrored };
    let [without, with, highlight] = [(mirrored, None), (bumped(mirrored, 1.0, 1.0), map()), (bumped(narrow, 1.0, 1.0), map())]
        .map(|(settings, map)| shown(&stored, &FINE, settings, map).unwrap());
    let (mut entering, mut leaving) = (0, 0);
    for at in 0..SIZE.0 * SIZE.1 {
        let (ray, index) = (camera.pixel_ray(at % SIZE.0, at / SIZE.0), at as usize);
        if with.provenance.as_ref().unwrap()[index].answer() != Answer::Hit {
            continue;
        }
        let n = ray.at(with.depth.as_ref().unwrap()[index]).normalize();
        let turned = (n + 1.5 * tangents(n)[0]).normalize();
        let height = mirror_direction(turned, ray.direction).dot(n);
        let of = |pixels: &Pixels| Vec3::from_slice(&pixels.color[3 * index..]);
        // Well on either side of the tangent plane.
        if height < -0.05 {
            entering += 1;
            assert_eq!(of(&with), of(&without), "at {n}");
            assert_eq!(of(&highlight), Vec3::ZERO, "at {n}");
        } else if height > 0.05 {
            leaving += 1;
            assert_ne!(of(&with), of(&without), "at {n}");
        }
    }
    assert!(entering > 100 && leaving > 100, "{entering} pixels enter, {leaving} leave");
}

#[test]
fn a_map_on_what_it_does_not_change_and_a_map_that_did_not_come_are_refused() {
    let world = World { points: 20, quads: 4, ..FINE };
    let stored = world.build();
    let refused =
        |settings: Settings, map: Option<NormalMap>| shown(&stored, &world, bumped(settings, 1.0, 1.0), map).unwrap_err().to_string();
    let of = |component, reflections| Settings { component, reflections, ..mirror(Blend::Average) };
    let glass = Component::Refraction(Dielectric::new(1.5, Body::Solid).unwrap());
    assert!(refused(of(Component::Reconstruction, 1), Some(hills(0.1))).starts_with("a normal map with reconstruction"));
    assert!(refused(of(glass, 1), Some(hills(0.1))).starts_with("a normal map with refraction"));
    assert!(refused(of(Component::Full, 2), Some(hills(0.1))).starts_with("a normal map with 2 reflections"));
    assert!(refused(of(Component::Mirror, 1), None).starts_with("the normal map 0303"));
}
