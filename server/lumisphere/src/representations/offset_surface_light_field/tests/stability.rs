//! Where the method fails: sweeps up to and beyond its limits. Two things must hold everywhere: what is not flagged is right within a bound, and
//! what cannot be right is flagged. The figures are printed; the bounds are theirs, rounded up.

use glam::{Vec2, Vec3};

use super::super::shade::mirror_direction;
use super::fixture::{MemoryPages, WORLD, World, surface_radiance};
use super::{frame_of, mirror, reconstruction};
use crate::radiometry::brdf::{AnalyticBrdf, AshikhminShirley, CookTorrance};
use crate::representations::Answer;
use crate::representations::offset_surface_light_field::{Blend, Component, Filter, Gloss, NO_SAMPLE, OffsetSurfaceLightField, Settings};
use crate::textures::PixelFormat;

const FINE: World = World { points: 120, quads: 32, pixel: PixelFormat::F32, ..WORLD };
const IN_A_ROOM: World = World { room: 2.5, ..FINE };
const ORIGIN: Vec3 = Vec3::new(0.5, 0.8, 2.0);
const NORMAL: Blend = Blend::Normal { exponent: 4.0 };

fn own(blend: Blend) -> Settings {
    Settings { blend, ..reconstruction() }
}

/// A pixel of the sphere: the angle between its normal and the direction to the camera in degrees, its error, and what was said of it.
struct Seen {
    angle: f32,
    error: f32,
    answer: Answer,
}

// From two opposite sides.
fn seen_of(world: &World, made: &(OffsetSurfaceLightField, MemoryPages), settings: Settings) -> Vec<Seen> {
    [ORIGIN, -ORIGIN].into_iter().flat_map(|origin| seen_from(origin, world, made, settings)).collect()
}

fn seen_from(origin: Vec3, world: &World, (field, pages): &(OffsetSurfaceLightField, MemoryPages), settings: Settings) -> Vec<Seen> {
    let camera = world.camera(origin, Vec3::ZERO, 120, 90);
    let pixels = frame_of(field.clone(), pages, &camera, settings).unwrap().pixels;
    let (depth, provenance) = (pixels.depth.unwrap(), pixels.provenance.unwrap());
    let seen = (0..120 * 90u32).filter_map(|at| {
        let (ray, index) = (camera.pixel_ray(at % 120, at / 120), at as usize);
        let answer = provenance[index].answer();
        let n = ray.at(depth[index]).normalize();
        let radiance = Vec3::from_slice(&pixels.color[3 * index..]);
        let exact = match settings.component {
            Component::Reconstruction => surface_radiance(n),
            _ => world.surroundings(n, mirror_direction(n, ray.direction)).0,
        };
        let angle = (-n.dot(ray.direction)).clamp(-1.0, 1.0).acos().to_degrees();
        (answer != Answer::Background).then(|| Seen { angle, error: (radiance - exact).length(), answer })
    });
    seen.collect()
}

fn root_mean_square(errors: impl Iterator<Item = f32> + Clone) -> f32 {
    let count = errors.clone().count().max(1);
    (errors.map(|e| e * e).sum::<f32>() / count as f32).sqrt()
}

// Share of the sphere's pixels with an answer, and root mean square and largest error of those hit.
fn summary(seen: &[Seen]) -> (f32, f32, f32) {
    let hits = seen.iter().filter(|s| s.answer == Answer::Hit).map(|s| s.error);
    let flagged = seen.iter().filter(|s| s.answer != Answer::Hit).count();
    (flagged as f32 / seen.len() as f32, root_mean_square(hits.clone()), hits.fold(0.0, f32::max))
}

/// Toward the horizon a sample point sees what its neighbour does not: the error may grow, but within its bound, and pixels may be flagged.
#[test]
fn toward_the_horizon() {
    let made = IN_A_ROOM.build();
    for (settings, bound) in
        [(own(NORMAL), 0.002), (own(Blend::Corrected), 5e-4), (mirror(Blend::Corrected), 0.001), (mirror(NORMAL), 0.03)]
    {
        let seen = seen_of(&IN_A_ROOM, &made, settings);
        for (low, high) in [(0.0, 60.0), (60.0, 70.0), (70.0, 80.0), (80.0, 85.0), (85.0, 89.9)] {
            let bin: Vec<&Seen> = seen.iter().filter(|s| (low..high).contains(&s.angle)).collect();
            let error = root_mean_square(bin.iter().map(|s| s.error));
            println!("{:?} {:?}, {low}–{high}°: {} pixels, error {error:.4}", settings.component, settings.blend, bin.len());
            assert!(bin.len() > 20, "{low}–{high}°: {} pixels", bin.len());
            assert!(error < bound, "{:?} {:?} at {low}–{high}°: {error}", settings.component, settings.blend);
        }
    }
}

/// Sample points that nearly touch the surface see little of it: what they do not see is flagged. Far ones see all of it, and other surroundings
/// than the surface has, which only the corrected blend forgives.
#[test]
fn offsets_from_a_hundredth_of_the_radius_to_all_of_it() {
    let mut flagged_before = 1.0;
    for epsilon in [0.01, 0.03, 0.1, 0.3, 1.0] {
        let world = World { epsilon, ..IN_A_ROOM };
        let made = world.build();
        let (flagged, error, worst) = summary(&seen_of(&world, &made, own(Blend::Corrected)));
        let (_, corrected, _) = summary(&seen_of(&world, &made, mirror(Blend::Corrected)));
        let (_, normal, _) = summary(&seen_of(&world, &made, mirror(NORMAL)));
        println!(
            "ε = {epsilon}: {flagged:.3} flagged, own light {error:.4}, at most {worst:.4}; mirror {corrected:.4} corrected, {normal:.4} normal"
        );
        assert!(flagged <= flagged_before + 0.01, "ε = {epsilon}: {flagged} flagged, {flagged_before} with a smaller one");
        assert!(worst < 0.003 && error < 5e-4, "ε = {epsilon}: {error}, at most {worst}");
        assert!(corrected < 0.001, "ε = {epsilon}: {corrected}");
        assert!(corrected < 0.05 * normal, "ε = {epsilon}: {corrected} corrected, {normal} normal");
        flagged_before = flagged;
    }
    assert!(flagged_before < 0.02, "{flagged_before} flagged at ε = 1");
}

#[test]
fn faces_from_8_to_256_texels() {
    let mut before = f32::INFINITY;
    for face_size in [8, 16, 32, 64, 128, 256] {
        let world = World { face_size, points: 24, epsilon: 0.3, ..FINE };
        let made = world.build();
        let (_, own_light, _) = summary(&seen_of(&world, &made, own(NORMAL)));
        let seen = seen_of(&world, &made, mirror(Blend::Distance));
        // Near the silhouette a sample point sees the sphere where the surface mirrors the sky.
        let (_, mirrored, _) = summary(&seen.into_iter().filter(|s| s.angle < 50.0).collect::<Vec<_>>());
        println!("{face_size}² faces: own light {own_light:.5}, mirror {mirrored:.5}");
        // Bilinear reads err with the square of a texel's width, down to what the facets leave.
        let texel = 2.0 / face_size as f32;
        assert!(own_light + mirrored < before * 1.02, "{face_size}²: {own_light} + {mirrored} after {before}");
        assert!(mirrored < 0.1 * texel * texel + 1e-4, "{face_size}²: {mirrored}");
        assert!(own_light < texel * texel + 2e-4, "{face_size}²: {own_light}");
        before = own_light + mirrored;
    }
}

/// From plenty of sample points to none within sight: four neighbours, then fewer, then none, and what has none is unknown.
#[test]
fn sample_points_until_four_neighbours_no_longer_exist() {
    let mut complete_before = 0.0;
    for points in [2, 4, 8, 16, 32, 64, 128, 256] {
        let world = World { points, ..FINE };
        let made = world.build();
        let texels = &made.0.sample_maps.indices;
        let complete = texels.iter().filter(|t| !t.contains(&NO_SAMPLE)).count() as f32 / texels.len() as f32;
        let bare = texels.iter().filter(|t| **t == [NO_SAMPLE; 4]).count() as f32 / texels.len() as f32;
        let seen = seen_of(&world, &made, own(Blend::Corrected));
        let (flagged, error, worst) = summary(&seen);
        let unknown = seen.iter().filter(|s| s.answer == Answer::Unknown).count() as f32 / seen.len() as f32;
        println!(
            "{points} points: {complete:.3} texels with four, {bare:.3} with none; {flagged:.3} flagged, {unknown:.3} unknown, error {error:.4}, at most {worst:.4}"
        );
        assert!(complete >= complete_before, "{points}: {complete} after {complete_before}");
        assert!(worst < 0.002, "{points}: {worst}");
        assert!((unknown > 0.0) == (bare > 0.0), "{points}: {unknown} unknown, {bare} of the texels without a sample point");
        complete_before = complete;
    }
    assert!(complete_before == 1.0);
}

/// Sample points that are not where they are said to be: the error grows with the displacement and no faster.
#[test]
fn registration_noise() {
    let (field, pages) = IN_A_ROOM.build();
    let mut first = [0.0; 2];
    for (step, noise) in [0.0, 0.002, 0.005, 0.01, 0.02].into_iter().enumerate() {
        let mut displaced = field.clone();
        for (k, point) in displaced.sample_points.iter_mut().enumerate() {
            let random = |axis: usize| ((k * 3 + axis) as f32 * 12.9898).sin() * 43758.547;
            let unit = Vec3::from_array(std::array::from_fn(|axis| 2.0 * random(axis).rem_euclid(1.0) - 1.0));
            point.position += noise * unit;
        }
        let made = (displaced, MemoryPages(pages.0.clone()));
        let errors = [own(NORMAL), mirror(Blend::Corrected)].map(|settings| summary(&seen_of(&IN_A_ROOM, &made, settings)).1);
        println!("displaced by up to {noise}: own light {:.4}, corrected mirror {:.4}", errors[0], errors[1]);
        if step == 0 {
            first = errors;
        }
        for (error, first) in errors.into_iter().zip(first) {
            assert!(error <= first + 0.3 * noise, "{error} at {noise}, {first} without");
        }
    }
}

/// A sun of 10⁵: nothing is negative or NaN, nothing shines more than it, and a glossy picture has no fireflies: neighbours look alike.
#[test]
fn a_sun_of_a_hundred_thousand() {
    let world = World { sun: 1e5, ..FINE };
    let (field, pages) = world.build();
    let camera = world.camera(ORIGIN, Vec3::ZERO, 64, 48);
    let colour_of = |settings| frame_of(field.clone(), &pages, &camera, settings).unwrap().pixels;
    let brdf = AnalyticBrdf::CookTorrance(CookTorrance::new(Vec2::splat(0.4), Vec3::ONE, Vec3::ONE).unwrap());
    let glossy = Settings { component: Component::Glossy(Gloss::of(brdf, 256)), filter: Filter::Footprint, ..mirror(NORMAL) };
    for settings in [own(NORMAL), own(Blend::Corrected), mirror(NORMAL), mirror(Blend::Corrected), glossy] {
        let pixels = colour_of(settings);
        assert!(pixels.color.iter().all(|c| (0.0..=1.001e5).contains(c)), "{settings:?}");
    }
    let pixels = colour_of(glossy);
    let provenance = pixels.provenance.unwrap();
    let inside = |i: usize, j: usize| (j - 1..=j + 1).all(|r| (i - 1..=i + 1).all(|c| provenance[64 * r + c].answer() == Answer::Hit));
    let value = |i: usize, j: usize| pixels.color[3 * (64 * j + i)];
    let mut sharpest = 0f32;
    for (i, j) in (1..47).flat_map(|j| (1..63).map(move |i| (i, j))).filter(|(i, j)| inside(*i, *j)) {
        let around = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)].map(|(c, r)| value(c, r));
        sharpest = sharpest.max(value(i, j) / around.into_iter().fold(0.0, f32::max));
    }
    println!("a pixel shines at most {sharpest:.2} times as much as the brightest beside it");
    assert!(sharpest < 1.5, "{sharpest}");
}

/// A lobe a thousand times as long as wide, seen at a grazing angle: finite, not negative, and no more light than there is.
#[test]
fn anisotropy_of_a_thousand_to_one_at_grazing_angles() {
    let (field, pages) = FINE.build();
    // From near the surface, past it.
    let camera = FINE.camera(Vec3::new(0.0, 0.3, 1.2), Vec3::new(0.0, 1.0, 0.0), 48, 36);
    let ashikhmin = AshikhminShirley::new(Vec3::ZERO, Vec3::ONE, Vec2::new(1e1, 1e4)).unwrap();
    let brushed = CookTorrance::new(Vec2::new(1e-3, 1.0), Vec3::ONE, Vec3::ONE).unwrap();
    for brdf in [AnalyticBrdf::AshikhminShirley(ashikhmin), AnalyticBrdf::CookTorrance(brushed)] {
        let settings = Settings { component: Component::Glossy(Gloss::of(brdf, 256)), filter: Filter::Footprint, ..mirror(NORMAL) };
        let pixels = frame_of(field.clone(), &pages, &camera, settings).unwrap().pixels;
        let shown = pixels.provenance.unwrap().iter().filter(|p| matches!(p.answer(), Answer::Hit | Answer::Filled)).count();
        let brightest = pixels.color.iter().fold(0f32, |b, c| b.max(*c));
        println!("{shown} pixels, at most {brightest:.3}");
        assert!(shown > 300 && pixels.color.iter().all(|c| *c >= 0.0), "{shown} pixels");
        // The environment's brightest is 1.6; the floor shows up to 1.3.
        assert!(brightest < 1.05 * 1.6, "{brightest}");
    }
}

/// A viewer who moves by half a degree a frame: how unevenly a pixel changes. The nearest sample point alone changes in jumps; root mean square
/// error does not tell.
#[test]
fn flicker_along_a_path() {
    let made = IN_A_ROOM.build();
    let unevenness = |settings: Settings| {
        let frames: Vec<Vec<f32>> = (0..12)
            .map(|k| {
                let (sin, cos) = (0.2 + 0.5f32.to_radians() * k as f32).sin_cos();
                let camera = IN_A_ROOM.camera(2.0 * Vec3::new(sin, 0.3, cos), Vec3::ZERO, 64, 48);
                frame_of(made.0.clone(), &made.1, &camera, settings).unwrap().pixels.color
            })
            .collect();
        // Second differences in the sphere's middle, which every frame shows.
        let middle = |i: usize| (22..42).contains(&(i / 3 % 64)) && (14..34).contains(&(i / 192));
        let mut bends: Vec<f32> = frames
            .windows(3)
            .flat_map(|f| (0..f[0].len()).filter(|i| middle(*i)).map(|i| (f[0][i] - 2.0 * f[1][i] + f[2][i]).abs()).collect::<Vec<_>>())
            .collect();
        bends.sort_by(f32::total_cmp);
        (bends[bends.len() * 99 / 100], *bends.last().unwrap())
    };
    let [distance, normal, corrected] = [Blend::Distance, NORMAL, Blend::Corrected].map(|blend| unevenness(mirror(blend)));
    println!("second difference, 99 % and most: distance {distance:?}, normal {normal:?}, corrected {corrected:?}");
    assert!(normal.0 < 0.5 * distance.0 && corrected.0 < 0.2 * distance.0, "{distance:?} {normal:?} {corrected:?}");
}
