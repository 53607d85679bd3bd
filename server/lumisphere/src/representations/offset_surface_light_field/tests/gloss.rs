//! Glossy frames: energy, the limits at both ends of roughness, and what anisotropy refers to.

use std::f32::consts::FRAC_1_PI;
use std::sync::Arc;

use glam::{Quat, Vec2, Vec3};

use super::fixture::{MemoryPages, WORLD, World, environment_radiance};
use super::{frame_of, mirror};
use crate::geometry::{TangentFrame, tangent_along_u};
use crate::radiometry::brdf::{AnalyticBrdf, AshikhminShirley, Brdf, CookTorrance, Lambert, Phong};
use crate::render::Accumulator;
use crate::representations::offset_surface_light_field::{
    Blend, Component, Filter, Gloss, GlossBrdf, Integration, OffsetSurfaceLightField, Order, Settings,
};
use crate::representations::{Answer, Pixels, RenderError, Settings as AnySettings};
use crate::testdata::golden::assert_golden;
use crate::textures::{Page, PixelFormat};

const FINE: World = World { points: 120, quads: 32, pixel: PixelFormat::F32, ..WORLD };
const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 3.0);
const SIZE: (u32, u32) = (32, 24);

fn glossy(brdf: AnalyticBrdf, directions: u32) -> Settings {
    let component = Component::Glossy(Gloss::of(brdf, directions));
    Settings { component, filter: Filter::Footprint, ..mirror(Blend::Normal { exponent: 4.0 }) }
}

fn shown(field: &OffsetSurfaceLightField, pages: &MemoryPages, settings: Settings) -> Pixels {
    frame_of(field.clone(), pages, &FINE.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1), settings).unwrap().pixels
}

// Calls `check(normal, ray direction, radiance)` for pixels that show the sphere no flatter than cos⁻¹ `steepest`.
fn for_sphere_pixels(pixels: &Pixels, steepest: f32, mut check: impl FnMut(Vec3, Vec3, Vec3)) {
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1);
    let mut checked = 0;
    for at in 0..SIZE.0 * SIZE.1 {
        let (ray, index) = (camera.pixel_ray(at % SIZE.0, at / SIZE.0), at as usize);
        if pixels.provenance.as_ref().unwrap()[index].answer() == Answer::Background {
            continue;
        }
        let n = ray.at(pixels.depth.as_ref().unwrap()[index]).normalize();
        if n.dot(ray.direction) < -steepest {
            check(n, ray.direction, Vec3::from_slice(&pixels.color[3 * index..]));
            checked += 1;
        }
    }
    assert!(checked > 100, "only {checked} pixels show the sphere");
}

fn cook_torrance(alpha: f32) -> AnalyticBrdf {
    AnalyticBrdf::CookTorrance(CookTorrance::new(Vec2::splat(alpha), Vec3::ONE, Vec3::ONE).unwrap())
}

/// Where everything shines with 1, a surface shines with its albedo: a white furnace.
#[test]
fn in_a_white_furnace_the_albedo_shows() {
    let (field, mut pages) = FINE.build();
    for page in &mut pages.0 {
        *page = Arc::new(Page::from_f32(page.shape(), &vec![1.0; page.shape().values()]).unwrap());
    }
    let albedo = Vec3::new(0.7, 0.5, 0.2);
    let lambert = AnalyticBrdf::Lambert(Lambert::new(albedo).unwrap());
    for_sphere_pixels(&shown(&field, &pages, glossy(lambert, 16)), 0.05, |n, _, radiance| {
        assert!((radiance - albedo).length() < 1e-4, "{radiance} at {n}");
    });
    for alpha in [1e-3, 0.1, 0.6] {
        for_sphere_pixels(&shown(&field, &pages, glossy(cook_torrance(alpha), 256)), 0.5, |n, _, radiance| {
            assert!(radiance.max_element() < 1.02 && (alpha > 0.3 || radiance.min_element() > 0.95), "α = {alpha}: {radiance} at {n}");
        });
    }
}

#[test]
fn the_smoothest_is_a_mirror_and_the_roughest_the_sky_by_quadrature() {
    let (field, pages) = FINE.build();
    let mirrored = shown(&field, &pages, Settings { filter: Filter::Footprint, ..mirror(Blend::Normal { exponent: 4.0 }) });
    let mut smooth = Vec::new();
    for_sphere_pixels(&shown(&field, &pages, glossy(cook_torrance(1e-4), 16)), 0.3, |_, _, radiance| smooth.push(radiance));
    let mut at = 0;
    for_sphere_pixels(&mirrored, 0.3, |n, _, radiance| {
        assert!((smooth[at] - radiance).length() < 0.02, "{} at {n} where the mirror shows {radiance}", smooth[at]);
        at += 1;
    });
    // E / π by 4096 directions about n. Read unfiltered: a wide mean at a sample point takes in some of the sphere below its horizon.
    let lambert = AnalyticBrdf::Lambert(Lambert::new(Vec3::ONE).unwrap());
    let unfiltered = Settings { filter: Filter::Bilinear, ..glossy(lambert, 1024) };
    for_sphere_pixels(&shown(&field, &pages, unfiltered), 0.3, |n, _, radiance| {
        let frame = TangentFrame::around(n);
        let direction = |k: u32| {
            let (row, column) = (k / 64, k % 64);
            let (r, phi) = (((row as f32 + 0.5) / 64.0).sqrt(), std::f32::consts::TAU * (column as f32 + 0.5) / 64.0);
            frame.world_from_local(Vec3::new(r * phi.cos(), r * phi.sin(), (1.0 - r * r).sqrt()))
        };
        let expected = (0..4096).map(|k| environment_radiance(direction(k))).sum::<Vec3>() / 4096.0;
        assert!((radiance - expected).length() < 0.02, "{radiance} at {n} where {expected} is expected");
    });
}

/// The lobe of a brushed surface is narrow along u: the picture is that of a quadrature over the BRDF in the frame along u. In a turned world, or
/// u would lie where a frame around the normal alone has its first axis.
#[test]
fn anisotropy_lies_along_the_surfaces_u() {
    let world = World { rotation: Quat::from_rotation_z(0.7) * Quat::from_rotation_x(0.5), ..FINE };
    let (field, pages) = world.build();
    let brdf = AshikhminShirley::new(Vec3::ZERO, Vec3::splat(0.9), Vec2::new(400.0, 4.0)).unwrap();
    let camera = world.camera(ORIGIN, Vec3::ZERO, SIZE.0, SIZE.1);
    let along_u = frame_of(field, &pages, &camera, glossy(AnalyticBrdf::AshikhminShirley(brdf), 256)).unwrap().pixels;
    let across_u = AshikhminShirley::new(Vec3::ZERO, Vec3::splat(0.9), Vec2::new(4.0, 400.0)).unwrap();
    let mesh = FINE.build().0.surface.mesh;
    let tangent = |n: Vec3| {
        let center = |t: &[u32; 3]| t.map(|v| mesh.positions[v as usize]).iter().sum::<Vec3>().normalize();
        let t = mesh.triangles.iter().max_by(|a, b| center(a).dot(n).total_cmp(&center(b).dot(n))).unwrap();
        tangent_along_u(t.map(|v| mesh.positions[v as usize]), t.map(|v| mesh.uvs[v as usize]))
    };
    let (mut error, mut other) = (0.0, 0.0);
    for_sphere_pixels(&along_u, 0.5, |n, d, radiance| {
        let frame = TangentFrame::along(n, tangent(n));
        let wo = frame.local_from_world(-d);
        let integral = |brdf: &dyn Brdf| {
            let cell = |k: u32| {
                let (z, phi) = (((k / 256) as f32 + 0.5) / 128.0, std::f32::consts::TAU * ((k % 256) as f32 + 0.5) / 256.0);
                let wi = Vec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z);
                brdf.eval(wo, wi) * environment_radiance(frame.world_from_local(wi)) * z
            };
            (0..128 * 256).map(cell).sum::<Vec3>() * (2.0 / (FRAC_1_PI * 128.0 * 256.0))
        };
        error += (radiance - integral(&brdf)).length_squared();
        other += (radiance - integral(&across_u)).length_squared();
    });
    assert!(error < 0.02 * other, "{error} from the lobe along u, {other} from the one across it");
}

/// The mean of the passes 0 … `passes` − 1.
fn still(field: &OffsetSurfaceLightField, pages: &MemoryPages, settings: Settings, passes: u32) -> Accumulator {
    let of_pass = |pass| match AnySettings::OffsetSurfaceLightField(settings).of_pass(pass) {
        Some(AnySettings::OffsetSurfaceLightField(settings)) => settings,
        other => panic!("{other:?}"),
    };
    let mut mean = Accumulator::new(shown(field, pages, of_pass(0)));
    (1..passes).for_each(|pass| mean.add(&shown(field, pages, of_pass(pass))));
    mean
}

/// Root mean square over the sphere's pixels of what two pictures differ by, and of the second.
fn difference(a: &Pixels, b: &Pixels) -> (f32, f32) {
    let mut expected = Vec::new();
    for_sphere_pixels(b, 0.3, |_, _, radiance| expected.push(radiance));
    let (mut error, mut at) = (0.0, 0);
    for_sphere_pixels(a, 0.3, |_, _, radiance| {
        error += (radiance - expected[at]).length_squared();
        at += 1;
    });
    let power: f32 = expected.iter().map(|e| e.length_squared()).sum();
    ((error / at as f32).sqrt(), (power / at as f32).sqrt())
}

/// Sixteen directions of a wide lobe under a small sun, and 16 384, whose shares are a thousandth of theirs. The shares' error of P passes is
/// (1 + 1/2 + … + 1/P)/P of the first's: 0.52, 0.21, 0.074 for 4, 16 and 64.
#[test]
fn the_mean_of_passes_goes_to_the_integral() {
    let (field, pages) = World { sun: 300.0, ..FINE }.build();
    let few = glossy(cook_torrance(0.4), 16);
    let truth = still(&field, &pages, glossy(cook_torrance(0.4), 1024), 16);
    let errors = [1, 4, 16, 64].map(|passes| {
        let (error, of) = difference(still(&field, &pages, few, passes).pixels(), truth.pixels());
        error / of
    });
    println!("relative error of 1, 4, 16 and 64 passes: {errors:?}");
    for (passes, error) in [4.0f32, 16.0, 64.0].into_iter().zip(&errors[1..]) {
        let harmonic = passes.ln() + 0.58;
        assert!(*error < 1.5 * errors[0] * harmonic / passes, "{passes} passes: {error} of {errors:?}");
    }
    // 0.074 of the first's, and what is left of the sequence's own error.
    assert!(errors[3] < 0.11 * errors[0], "{errors:?}");
}

/// The sun of 10⁵ is on single directions' images in later passes, whose shares are small; their mean has none of them.
#[test]
fn passes_under_a_sun_of_a_hundred_thousand_leave_no_firefly() {
    let (field, pages) = World { sun: 1e5, ..FINE }.build();
    let mean = still(&field, &pages, glossy(cook_torrance(0.4), 64), 16);
    let pixels = mean.pixels();
    assert!(pixels.color.iter().all(|c| (0.0..=1.001e5).contains(c)));
    let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
    let provenance = pixels.provenance.as_ref().unwrap();
    let inside = |i: usize, j: usize| (j - 1..=j + 1).all(|r| (i - 1..=i + 1).all(|c| provenance[width * r + c].answer() == Answer::Hit));
    let value = |i: usize, j: usize| pixels.color[3 * (width * j + i)];
    let mut sharpest = 0f32;
    for (i, j) in (1..height - 1).flat_map(|j| (1..width - 1).map(move |i| (i, j))).filter(|(i, j)| inside(*i, *j)) {
        let around = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)].map(|(c, r)| value(c, r));
        sharpest = sharpest.max(value(i, j) / around.into_iter().fold(0.0, f32::max));
    }
    println!("a pixel shines at most {sharpest:.2} times as much as the brightest beside it");
    assert!(sharpest > 0.0 && sharpest < 1.5, "{sharpest}");
}

#[test]
fn what_is_no_glossy_frame_has_one_pass() {
    let of = |component| AnySettings::OffsetSurfaceLightField(Settings { component, ..mirror(Blend::Average) });
    assert!([Component::Reconstruction, Component::Mirror, Component::Full].into_iter().all(|c| of(c).of_pass(1).is_none()));
    assert!(AnySettings::OffsetSurfaceLightField(gathered(cook_torrance(0.4), Integration::Prefiltered)).of_pass(1).is_none());
    assert_eq!(AnySettings::OffsetSurfaceLightField(glossy(cook_torrance(0.4), 8)).of_pass(0).unwrap(), {
        AnySettings::OffsetSurfaceLightField(glossy(cook_torrance(0.4), 8))
    });
}

/// What one pass of a few directions shows, under a sun: 0.1 % of it.
#[test]
fn a_single_pass_is_the_golden_image() {
    let world = World { sun: 100.0, ..WORLD };
    let (field, pages) = world.build();
    let camera = world.camera(ORIGIN, Vec3::ZERO, 64, 48);
    assert_golden("offset_surface_light_field_glossy.exr", &frame_of(field, &pages, &camera, glossy(cook_torrance(0.3), 24)).unwrap());
}

#[test]
fn more_directions_than_a_frame_may_draw_are_refused() {
    let (field, pages) = FINE.build();
    let camera = FINE.camera(ORIGIN, Vec3::ZERO, 256, 129);
    let settings = glossy(cook_torrance(0.1), 4096);
    let refused = frame_of(field, &pages, &camera, settings).unwrap_err();
    assert!(matches!(refused, RenderError::TooManyDirections { pixels: 33_024, directions: 4096, most: 134_217_728 }), "{refused}");
}

/// Where weights do not depend on the direction, both orders have one limit. On the way there four sample points with directions of their own err less
/// than with one set for all, which takes as many reads.
#[test]
fn both_orders_go_to_one_integral() {
    let (field, pages) = FINE.build();
    let brdf = cook_torrance(0.4);
    let of = |order, directions| {
        let component = Component::Glossy(Gloss { order, ..Gloss::of(brdf, directions) });
        shown(&field, &pages, Settings { component, filter: Filter::Bilinear, ..mirror(Blend::Average) })
    };
    let limit = of(Order::BlendFirst, 4096);
    let error = |order, directions| difference(&of(order, directions), &limit).0;
    let [blended, integrated] = [Order::BlendFirst, Order::IntegrateFirst].map(|order| [12, 48, 1024].map(|n| error(order, n)));
    println!("blend first {blended:?}, integrate first {integrated:?}");
    assert!(blended[2] < 0.003 && integrated[2] < 0.003, "{blended:?} {integrated:?}");
    assert!(integrated[1] < 0.9 * blended[1], "{blended:?} {integrated:?}");
}

fn ashikhmin_shirley(exponent: f32) -> AnalyticBrdf {
    AshikhminShirley::new(Vec3::ZERO, Vec3::splat(0.9), Vec2::splat(exponent)).unwrap().into()
}

fn gathered(brdf: AnalyticBrdf, integration: Integration) -> Settings {
    let gloss = Gloss { integration, ..Gloss::suited(brdf.into(), Filter::Footprint) };
    Settings { component: Component::Glossy(gloss), ..glossy(brdf, 1) }
}

/// ∫ f L cos over the world itself, by directions that are others for each pixel.
fn one_reflection(world: &World, brdf: &AnalyticBrdf, n: Vec3, d: Vec3, seed: f32) -> Vec3 {
    const DIRECTIONS: u32 = 4096;
    let frame = TangentFrame::around(n);
    let wo = frame.local_from_world(-d);
    let place = |k: u32| (Vec2::new(seed, 1.7 * seed) + k as f32 * Vec2::new(0.754_877_7, 0.569_840_3)).fract();
    let drawn = (0..DIRECTIONS).filter_map(|k| brdf.sample(wo, place(k)));
    let light = |(wi, pdf): (Vec3, f32)| brdf.eval(wo, wi) * (wi.z / pdf) * world.surroundings(n, frame.world_from_local(wi)).0;
    drawn.map(light).sum::<Vec3>() / DIRECTIONS as f32
}

/// Root mean square of what two frames differ by on a display, 1 being white.
fn error_on_display(world: &World, brdf: &AnalyticBrdf, pixels: &Pixels) -> f32 {
    let shown = |radiance: Vec3| radiance / (1.0 + radiance);
    let (mut sum, mut count) = (0.0, 0);
    for_sphere_pixels(pixels, 0.3, |n, d, radiance| {
        sum += (shown(radiance) - shown(one_reflection(world, brdf, n, d, count as f32 * 0.37))).length_squared();
        count += 1;
    });
    (sum / (3 * count) as f32).sqrt()
}

/// Wide highlights under a small sun need directions, narrow ones need no more than a look: neither way is much better than the one that suits.
#[test]
fn the_integration_that_suits_a_highlight_errs_little_more_than_the_other() {
    let world = World { sun: 60.0, face_size: 64, ..FINE };
    let (field, pages) = world.build();
    let mut worst_other = 1f32;
    for exponent in [3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10_000.0, 30_000.0] {
        let brdf = ashikhmin_shirley(exponent);
        let error = |integration| error_on_display(&world, &brdf, &shown(&field, &pages, gathered(brdf, integration)));
        let (drawn, one_look) = (error(Integration::MonteCarlo), error(Integration::Prefiltered));
        let suited = Gloss::suited(brdf.into(), Filter::Footprint).integration;
        println!("n = {exponent}: drawn {drawn:.4}, one look {one_look:.4}, {suited:?} suits");
        let (chosen, other) = if suited == Integration::Prefiltered { (one_look, drawn) } else { (drawn, one_look) };
        assert!(chosen < 1.2 * other + 0.002, "n = {exponent}: {chosen} where the other errs by {other}");
        worst_other = worst_other.max(other / chosen);
    }
    // Otherwise there would be nothing to choose.
    assert!(worst_other > 2.0, "{worst_other}");
}

#[test]
fn one_look_suits_a_single_narrow_highlight_read_by_footprint_alone() {
    let suits = |brdf: GlossBrdf, filter| Gloss::suited(brdf, filter).integration;
    let narrow: GlossBrdf = ashikhmin_shirley(30_000.0).into();
    assert_eq!(suits(narrow, Filter::Footprint), Integration::Prefiltered);
    // Single directions know no means.
    assert_eq!(suits(narrow, Filter::Bilinear), Integration::MonteCarlo);
    assert_eq!([30.0, 10.0].map(|n| Gloss::suited(ashikhmin_shirley(n).into(), Filter::Footprint).directions), [32, 64]);
    let brushed = AshikhminShirley::new(Vec3::ZERO, Vec3::splat(0.9), Vec2::new(30_000.0, 10.0)).unwrap();
    let coated = AshikhminShirley::new(Vec3::splat(0.1), Vec3::splat(0.5), Vec2::splat(30_000.0)).unwrap();
    let matt = Lambert::new(Vec3::splat(0.5)).unwrap();
    for drawn in [brushed.into(), coated.into(), AnalyticBrdf::from(matt)] {
        assert_eq!(suits(drawn.into(), Filter::Footprint), Integration::MonteCarlo, "{drawn:?}");
    }
}

/// What a facet reflects of 1: Fresnel's term, for Phong cos θ (n + 2)/(n + 1).
#[test]
fn one_look_in_a_white_furnace_shows_what_the_highlight_reflects() {
    let (field, mut pages) = FINE.build();
    for page in &mut pages.0 {
        *page = Arc::new(Page::from_f32(page.shape(), &vec![1.0; page.shape().values()]).unwrap());
    }
    for_sphere_pixels(&shown(&field, &pages, gathered(ashikhmin_shirley(1000.0), Integration::Prefiltered)), 0.1, |n, d, radiance| {
        let expected = 0.9 + 0.1 * (1.0 + n.dot(d)).powi(5);
        assert!((radiance - expected).length() < 2e-3, "{radiance} at {n}, {expected} expected");
    });
    let phong = Phong::new(Vec3::ZERO, Vec3::new(0.7, 0.5, 0.2), 1000.0).unwrap().into();
    for_sphere_pixels(&shown(&field, &pages, gathered(phong, Integration::Prefiltered)), 0.1, |n, d, radiance| {
        let expected = Vec3::new(0.7, 0.5, 0.2) * (-n.dot(d) * 1002.0 / 1001.0);
        assert!((radiance - expected).length() < 2e-3, "{radiance} at {n}, {expected} expected");
    });
}
