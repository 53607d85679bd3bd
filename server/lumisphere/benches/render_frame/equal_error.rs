//! What a mirror frame costs beside a path-traced one of the same error: FLIP over the object's pixels, against a truth of many paths.

use std::sync::Arc;
use std::time::Instant;

use glam::Vec3;
use lumisphere::evaluate::{Truth, TruthRenderer};
use lumisphere::geometry::Camera;
use lumisphere::images::{CompareOptions, Image, compare};
use lumisphere::progress::Unattended;
use lumisphere::raytrace::{Appearance, Mirrors, TraceSettings, Tracer};
use lumisphere::render::{Refine, Renderer, Representation};
use lumisphere::representations::CachedPages;
use lumisphere::representations::offset_surface_light_field::{Blend, Component, Filter};
use lumisphere::scenes::{BuiltinOptions, builtin};

use super::{cpu_millis, request};

const TRUTH_PATHS: u32 = 1024;
const MOST_PATHS: u32 = 256;
const FRAMES: usize = 7;

// Median wall clock and mean CPU time of the whole process, in milliseconds, and the last frame.
fn timed(runs: usize, mut make: impl FnMut() -> Image) -> (f64, f64, Image) {
    let (mut walls, cpu_before, mut last) = (Vec::new(), cpu_millis(), None);
    for _ in 0..runs {
        let begin = Instant::now();
        last = Some(make());
        walls.push(1e3 * begin.elapsed().as_secs_f64());
    }
    walls.sort_by(f64::total_cmp);
    (walls[runs / 2], (cpu_millis() - cpu_before) / runs as f64, last.expect("at least one run"))
}

/// The scene must be the one that was captured. Both sides get both cores; both make whole frames.
pub fn report(field: &Arc<dyn Representation>, pages: &CachedPages, renderer: &Renderer, cameras: [Camera; 2]) {
    let scene = builtin("gazebo", &BuiltinOptions::full()).expect("it ships with us");
    let object = scene.object("teapot").expect("the gazebo has one");
    let tracer = Tracer::new(&scene).expect("our own scene").with_appearance(object, Appearance::Mirrors(Mirrors::one(Vec3::ONE)));
    let truths = TruthRenderer::new(&scene, object).expect("our own scene");
    let trace = |samples_per_pixel, seed| TraceSettings { samples_per_pixel, max_bounces: 1, seed };
    println!("view  frame                 FLIP  wall, ms   CPU, ms");
    for (v, camera) in cameras.iter().enumerate() {
        let view = truths.view(camera, &[Truth::OneReflection], &trace(TRUTH_PATHS, 1), &Unattended).expect("nobody cancels");
        let settings = |blend| super::settings(Component::Mirror, blend, Filter::Footprint);
        let truth = view.reference(&settings(Blend::Corrected), Truth::OneReflection);
        let flip = |image: &Image| compare(&truth, image, Some(&view.mask), CompareOptions::STANDARD).expect("equal sizes").flip_mean;
        let say = |name: &str, error: f64, wall: f64, cpu: f64| println!("{v:>4}  {name:<20} {error:>6.4} {wall:>9.1} {cpu:>9.1}");
        let mut traced: Vec<(f64, f64, f64)> = Vec::new();
        for paths in (0..=MOST_PATHS.ilog2()).map(|k| 1 << k) {
            let (wall, cpu, image) = timed(1, || tracer.render(camera, &trace(paths, 2), &Unattended).expect("nobody cancels").radiance);
            let error = flip(&image);
            say(&format!("path tracer, {paths}"), error, wall, cpu);
            traced.push((error, wall, cpu));
        }
        for blend in [Blend::Normal { exponent: 4.0 }, Blend::Corrected] {
            let settings = settings(blend);
            let frame = || {
                let frame = renderer.render(field, pages, &request(camera, &settings, Refine::Whole), None).expect("a frame");
                assert!(frame.stats.fallback.is_none(), "{:?}", frame.stats.fallback);
                let mut image = Image::zeros(truth.width, truth.height, 3);
                (0..truth.width * truth.height)
                    .for_each(|at| image.set_rgb(at, frame.pixels.color[3 * at..][..3].try_into().expect("three")));
                image
            };
            frame();
            let (wall, cpu, image) = timed(FRAMES, frame);
            let error = flip(&image);
            say(&format!("{blend:?}"), error, wall, cpu);
            match at_equal_error(&traced, error) {
                Some((traced_wall, traced_cpu)) => {
                    println!(
                        "      path tracing with that error: {:.0} times its wall clock, {:.0} times its CPU",
                        traced_wall / wall,
                        traced_cpu / cpu
                    );
                }
                None => println!("      no path-traced frame here has that error"),
            }
        }
    }
}

// Time of path tracing with an error, between the two measured ones around it, geometrically.
fn at_equal_error(traced: &[(f64, f64, f64)], error: f64) -> Option<(f64, f64)> {
    let pair = traced.windows(2).find(|pair| pair[0].0 >= error && error >= pair[1].0)?;
    let f = (pair[0].0 / error).ln() / (pair[0].0 / pair[1].0).ln();
    let between = |a: f64, b: f64| a * (b / a).powf(f);
    Some((between(pair[0].1, pair[1].1), between(pair[0].2, pair[1].2)))
}
