//! Reads over what a pixel covers, held against the mean of many reads within the pixel.

use std::sync::Arc;

use glam::Vec3;

use super::super::shade::short_of_the_horizon;
use super::fixture::{MemoryPages, WORLD, World};
use super::{frame_of, mirror, reconstruction};
use crate::capture::{coarser_levels, halved, stacked};
use crate::directions::FACES;
use crate::geometry::{Camera, Intrinsics};
use crate::representations::offset_surface_light_field::{Blend, Filter, OffsetSurfaceLightField, Settings};
use crate::representations::{Answer, Pixels};
use crate::textures::{Page, PixelFormat};

const FINE: World = World { points: 120, quads: 24, face_size: 64, pixel: PixelFormat::F32, ..WORLD };
// Reads within a pixel, along each of its edges.
const WITHIN: u32 = 12;

// Every texel of the finest level brighter or darker by chance; the coarser levels follow.
fn noisy(world: &World) -> (OffsetSurfaceLightField, MemoryPages) {
    let (field, pages) = world.build();
    let levels = coarser_levels(world.face_size);
    let noise = |page: usize, value: usize| {
        let hash = ((page * 7919 + value / 4 + 1) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        0.25 + 1.5 * ((hash >> 40) as f32 / (1 << 24) as f32)
    };
    let faces: Vec<Page> = (0..field.face_count())
        .map(|page| {
            let clean = &pages.0[page];
            let values: Vec<f32> = clean.to_f32().iter().enumerate().map(|(i, v)| v * noise(page, i)).collect();
            Page::from_f32(clean.shape(), &values).unwrap()
        })
        .collect();
    let mut all: Vec<Arc<Page>> = faces.iter().cloned().map(Arc::new).collect();
    let mut finer = faces;
    for _ in 0..levels {
        finer = finer.iter().map(|face| halved(face, 3).unwrap()).collect();
        all.extend(finer.chunks(FACES).map(|cube| Arc::new(stacked(cube).unwrap())));
    }
    assert_eq!(all.len(), field.page_count());
    (field, MemoryPages(all))
}

fn times(camera: &Camera, factor: u32) -> Camera {
    let Intrinsics { width_px, height_px, focal_px, center_px } = *camera.intrinsics();
    let scale = factor as f32;
    let intrinsics =
        Intrinsics { width_px: factor * width_px, height_px: factor * height_px, focal_px: scale * focal_px, center_px: scale * center_px };
    Camera::new(intrinsics, *camera.pose()).unwrap()
}

// Root mean square difference over the pixels that show the object wholly, and how many there are.
fn error(of: &Pixels, fine: &Pixels, camera: &Camera) -> (f32, usize) {
    let (width, height) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
    let provenance = fine.provenance.as_ref().unwrap();
    let (mut squares, mut count) = (0.0, 0);
    for (j, i) in (0..height).flat_map(|j| (0..width).map(move |i| (j, i))) {
        let within = || (0..WITHIN * WITHIN).map(|k| ((j * WITHIN + k / WITHIN) * width * WITHIN + i * WITHIN + k % WITHIN) as usize);
        if within().all(|at| provenance[at].answer() == Answer::Hit) {
            let mean = within().map(|at| Vec3::from_slice(&fine.color[3 * at..])).sum::<Vec3>() / (WITHIN * WITHIN) as f32;
            squares += (Vec3::from_slice(&of.color[3 * (j * width + i) as usize..]) - mean).length_squared();
            count += 1;
        }
    }
    ((squares / count as f32).sqrt(), count)
}

#[test]
fn a_filtered_read_is_the_mean_over_the_pixel_and_an_unfiltered_one_is_not() {
    let (field, pages) = noisy(&FINE);
    let camera = FINE.camera(Vec3::new(0.7, 0.9, 3.4), Vec3::ZERO, 40, 30);
    for settings in [reconstruction(), mirror(Blend::Distance), mirror(Blend::Average), mirror(Blend::EnvironmentMap)] {
        let frame = |filter, camera: &Camera| frame_of(field.clone(), &pages, camera, Settings { filter, ..settings }).unwrap().pixels;
        let fine = frame(Filter::Bilinear, &times(&camera, WITHIN));
        let (filtered, count) = error(&frame(Filter::Footprint, &camera), &fine, &camera);
        let (unfiltered, _) = error(&frame(Filter::Bilinear, &camera), &fine, &camera);
        println!("{:?} {:?}: {filtered:.4} filtered, {unfiltered:.4} not", settings.component, settings.blend);
        assert!(count > 100, "{count} pixels");
        assert!(filtered < 0.5 * unfiltered, "{settings:?}: {filtered} filtered, {unfiltered} not");
    }
}

#[test]
fn footprints_end_half_way_to_the_horizon_and_none_is_none_below_it() {
    let wide = Vec3::new(0.3, -0.4, 0.0);
    assert!((short_of_the_horizon(wide, 0.8) - 0.8 * wide).length() < 1e-6);
    assert_eq!((short_of_the_horizon(0.1 * wide, 0.8), short_of_the_horizon(wide, 0.0)), (0.1 * wide, Vec3::ZERO));
    for cosine in [0.0, -0.3, 0.5] {
        assert_eq!(short_of_the_horizon(Vec3::ZERO, cosine), Vec3::ZERO);
    }
}

/// Where a pixel is smaller than a texel nothing is filtered: the same texels with the same weights.
#[test]
fn a_close_view_reads_the_finest_level_alone() {
    let (field, pages) = noisy(&World { face_size: 8, ..FINE });
    let camera = FINE.camera(Vec3::new(0.0, 0.0, 1.4), Vec3::ZERO, 160, 120);
    let settings = mirror(Blend::EnvironmentMap);
    let frame = |filter| frame_of(field.clone(), &pages, &camera, Settings { filter, ..settings }).unwrap().pixels;
    let (filtered, unfiltered) = (frame(Filter::Footprint), frame(Filter::Bilinear));
    let same = filtered.color.iter().zip(&unfiltered.color).filter(|(a, b)| a == b).count();
    // Toward the silhouette a pixel covers ever more.
    assert!(same > unfiltered.color.len() * 4 / 5, "{same} of {} numbers", unfiltered.color.len());
}
