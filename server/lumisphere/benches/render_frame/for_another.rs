//! The renderer alone, for another program that serves its frames: `docs/rivals/viser_frames.py`.

use std::io::{BufRead, Write};
use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use lumisphere::geometry::{Camera, Intrinsics, Pose};
use lumisphere::images::{ToneMap, tone_mapped_pixels};
use lumisphere::render::{Refine, Renderer, Representation};
use lumisphere::representations::CachedPages;
use lumisphere::representations::offset_surface_light_field::{Blend, Component, Filter};

use super::{request, settings};

/// For each line of standard input, a pose's number, writes that frame of the bench `viewers` into `file` (R, G, B, 8 bits each, 640 × 480,
/// rows from the top), and then a line of the milliseconds that rendering took.
pub fn serve(file: &Path, field: &Arc<dyn Representation>, pages: &CachedPages, renderer: &Renderer, center: Vec3, radius: f32) {
    let settings = settings(Component::Mirror, Blend::Normal { exponent: 4.0 }, Filter::Footprint);
    for line in std::io::stdin().lock().lines() {
        let number: f32 = line.expect("a line").trim().parse().expect("a number");
        let camera = camera(center, radius, number);
        let frame = renderer.render(field, pages, &request(&camera, &settings, Refine::Whole), None).expect("a frame");
        let codes = tone_mapped_pixels(frame.pixels.color.as_chunks().0, 640, ToneMap::PLAIN).expect("whole rows");
        std::fs::write(file, &codes.bytes).expect("room");
        let mut output = std::io::stdout().lock();
        // Nobody reads any more.
        if writeln!(output, "{:.1}", frame.stats.total_millis).and_then(|()| output.flush()).is_err() {
            return;
        }
    }
}

// As viewers' Stand has it.
fn camera(center: Vec3, radius: f32, number: f32) -> Camera {
    let (sin, cos) = (0.5 * number).to_radians().sin_cos();
    let pose = Pose::look_at(center + 3.5 * radius * Vec3::new(sin, 0.0, cos), center, Vec3::Y).expect("distinct points");
    let vfov = 2.0 * (0.5 / 1.375_f32).atan();
    Camera::new(Intrinsics::from_vfov(vfov.to_degrees(), 640, 480).expect("a sensible angle"), pose).expect("a camera")
}
