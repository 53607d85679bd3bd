//! Recorded requests: every page under the shape it has.

use std::sync::Arc;

use glam::Vec3;

use super::fixture::{WORLD, stored};
use super::mirror;
use crate::representations::offset_surface_light_field::{Blend, Filter, Settings};
use crate::representations::{PixelOrder, Recording, Representation, RequestTrace, Settings as AnySettings};
use crate::textures::TraceEvent;

#[test]
fn coarser_levels_are_parts_of_their_own_and_bilinear_reads_ask_for_none() {
    let (field, pages) = WORLD.build();
    let root = tempfile::tempdir().unwrap();
    let version = stored(root.path(), &pages);
    let camera = WORLD.camera(Vec3::new(0.5, 0.6, 3.0), Vec3::ZERO, 40, 30);
    let kernel = Arc::new(field.clone()).cpu_kernel();
    for filter in [Filter::Bilinear, Filter::Footprint] {
        let settings = AnySettings::OffsetSurfaceLightField(Settings { filter, ..mirror(Blend::Distance) });
        let mut trace = RequestTrace::new(&version, &field, 1 << 20).unwrap();
        let recording = Recording { camera: &camera, settings: &settings, order: PixelOrder::Buckets, lobe: None };
        kernel.record(&recording, &mut |request| trace.push(request)).unwrap();
        let trace = trace.finish();
        // Faces, sample maps, and three levels.
        assert_eq!(trace.versions.iter().map(|v| v.shape.height).collect::<Vec<_>>(), [32, 1, 96, 48, 24]);
        let mut fetched = [0; 5];
        for event in &trace.events {
            let TraceEvent::Row { version: part, page, row, fetches } = *event else { continue };
            fetched[part as usize] += fetches;
            if part != 1 {
                let shape = pages.0[page.0 as usize].shape();
                assert!(shape == trace.versions[part as usize].shape && row < shape.height, "page {page} in part {part}");
            }
        }
        assert_eq!(fetched[2..].iter().sum::<u32>() > 0, filter == Filter::Footprint, "{fetched:?}");
    }
}
