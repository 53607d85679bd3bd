//! Thinning: a constant needs next to nothing, a bound is kept, who is least missed goes first, and what is copied is what was measured.

use std::collections::HashSet;
use std::sync::Arc;

use glam::Vec3;

use super::super::shade::mirror_direction;
use super::fixture::{MemoryPages, WORLD, World, publication, stored};
use super::{frame_of, mirror};
use crate::progress::Unattended;
use crate::representations::Answer;
use crate::representations::offset_surface_light_field::{
    Blend, Filter, Kept, OffsetSurfaceLightField, Settings, Thinning, ValidationPixel, ValidationView, copy_pages,
};
use crate::textures::{Codec, Page, PageId, Store, StoreOptions};

const IN_A_ROOM: World = World { points: 120, face_size: 64, room: 2.5, ..WORLD };
const CORRECTED: Blend = Blend::Corrected;

fn settings() -> Settings {
    Settings { filter: Filter::Footprint, ..mirror(CORRECTED) }
}

fn squared(shown: Vec3, reference: Vec3) -> f64 {
    f64::from((shown - reference).length_squared())
}

// From three sides; the truth is what the sphere mirrors.
fn views(
    world: &World,
    (field, pages): &(OffsetSurfaceLightField, MemoryPages),
    truth: impl Fn(Vec3, Vec3) -> Vec3,
) -> Vec<ValidationView> {
    let from = |origin: Vec3| {
        let camera = world.camera(origin, Vec3::ZERO, 40, 30);
        let pixels = frame_of(field.clone(), pages, &camera, settings()).unwrap().pixels;
        let (depth, provenance) = (pixels.depth.unwrap(), pixels.provenance.unwrap());
        let of_object = (0..40 * 30u32).filter(|at| provenance[*at as usize].answer() == Answer::Hit);
        let pixel = |at: u32| {
            let ray = camera.pixel_ray(at % 40, at / 40);
            let n = ray.at(depth[at as usize]).normalize();
            ValidationPixel { at: (at % 40, at / 40), reference: truth(n, mirror_direction(n, ray.direction)) }
        };
        ValidationView { camera, pixels: of_object.map(pixel).collect() }
    };
    [Vec3::new(0.5, 0.8, 2.0), Vec3::new(-1.9, -0.7, -0.8), Vec3::new(1.4, -0.9, -1.5)].map(from).into()
}

fn in_a_room() -> ((OffsetSurfaceLightField, MemoryPages), Vec<ValidationView>) {
    let made = IN_A_ROOM.build();
    let views = views(&IN_A_ROOM, &made, |n, r| IN_A_ROOM.surroundings(n, r).0);
    (made, views)
}

#[test]
fn a_constant_needs_only_what_covers_the_surface_and_the_coarsest_faces() {
    let (field, pages) = WORLD.build();
    let constant = |page: &Arc<Page>| {
        let texels = page.to_f32();
        let channels = page.shape().channels as usize;
        let grey = texels.chunks_exact(channels).flat_map(|t| [&[0.5; 3], &t[3..]].concat()).collect::<Vec<f32>>();
        Arc::new(Page::from_f32(page.shape(), &grey).unwrap())
    };
    let made = (field, MemoryPages(pages.0.iter().map(constant).collect()));
    let views = views(&WORLD, &made, |_, _| Vec3::splat(0.5));
    let thinning = Thinning::new(&made.0, settings(), &made.1, &views, (&squared, &|_, _| true), &Unattended).unwrap();
    assert!(thinning.pixel_count() > 500);
    let order = thinning.order(1e-9).unwrap();
    // Each sees a cap of 25° about itself; half of them cover the sphere.
    assert!(order.len() >= WORLD.points / 2 - 2, "only {} left", order.len());
    assert_eq!(order.iter().collect::<HashSet<_>>().len(), order.len(), "a sample point leaves once");
    assert_eq!(thinning.levels_to_spare(), 1, "32 texels, 16 at least");
    // The last to leave have broken the bound.
    let error = thinning.error_without(&order[..order.len() - 8].iter().copied().collect(), 1).unwrap();
    assert!(error < 1e-9, "{error}");
}

#[test]
fn half_can_go_for_nothing_if_they_are_chosen() {
    let (made, views) = in_a_room();
    let thinning = Thinning::new(&made.0, settings(), &made.1, &views, (&squared, &|_, _| true), &Unattended).unwrap();
    let before = thinning.error_before().unwrap();
    let order = thinning.order(8.0 * before).unwrap();
    let error = |lost: &[u16]| thinning.error_without(&lost.iter().copied().collect(), 0).unwrap();
    let (half, all) = (error(&order[..order.len() / 2]), error(&order));
    assert!(half < 1.1 * before && all > 4.0 * before, "{before}, {half}, {all}");
    // A fifth, if the dearest of those measured anew left first.
    assert!(order.len() >= IN_A_ROOM.points / 2, "only {} left", order.len());
}

#[test]
fn what_is_copied_shows_what_was_measured() {
    let (made, views) = in_a_room();
    let (field, pages) = &made;
    let thinning = Thinning::new(field, settings(), pages, &views, (&squared, &|_, _| true), &Unattended).unwrap();
    let root = tempfile::tempdir().unwrap();
    let version = stored(&root.path().join("whole"), pages);
    let (store, _) = Store::open(&root.path().join("thinned"), StoreOptions::local()).unwrap();
    for (levels, name) in [(0, "fine"), (1, "coarser"), (2, "coarse")] {
        let kept = Kept { points: (0..IN_A_ROOM.points as u16).filter(|j| j % 3 != 0).collect(), levels };
        let thinned = thinning.thinned(&kept);
        let measured = thinning.error_of(&thinned, &kept).unwrap();
        store.create_dataset(name).unwrap();
        let staging = store.stage(name, "test").unwrap();
        copy_pages((field, &version), (&thinned, &kept), Codec::DEFAULT, &staging, &Unattended).unwrap();
        let copied = staging.publish(publication()).unwrap();
        assert_eq!(copied.page_count() as usize, thinned.page_count());
        let copied = MemoryPages((0..copied.page_count()).map(|page| Arc::new(copied.read_page(PageId(page)).unwrap())).collect());
        let (mut sum, mut count) = (0.0, 0);
        for view in &views {
            let shown = frame_of(thinned.clone(), &copied, &view.camera, settings()).unwrap().pixels;
            for pixel in &view.pixels {
                let at = 3 * (pixel.at.1 * 40 + pixel.at.0) as usize;
                sum += squared(Vec3::from_slice(&shown.color[at..]), pixel.reference);
                count += 1;
            }
        }
        let rendered = sum / f64::from(count);
        // Distances of coarser faces are rounded to half precision once more.
        assert!((rendered - measured).abs() <= 0.02 * measured, "{name}: rendered {rendered}, measured {measured}");
        let size = IN_A_ROOM.face_size >> levels;
        assert_eq!((thinned.parameters.face_size_texels, thinned.sample_points.len()), (size, kept.points.len()));
        assert_eq!(thinned.parameters.thinned_from.as_ref().map(|from| (from.sample_points, from.face_size_texels)), Some((120, 64)));
    }
}
