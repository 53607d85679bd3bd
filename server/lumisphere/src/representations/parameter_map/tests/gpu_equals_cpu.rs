//! The kernel against its reference: shading is compared on the GPU's own G-buffer, element by element.

use std::sync::Arc;

use glam::Vec3;

use super::super::kernel::{Kernel, ShadingUniform, source};
use super::super::reference::{PagedQuads, Reference};
use super::super::{ModelCode, Settings, Show};
use super::EVERYTHING;
use super::fixture::{WORLD, World, every_kind};
use crate::fitting::Model;
use crate::gpu::layout_check::assert_same_layout;
use crate::gpu::{GpuError, test_gpu};
use crate::images::{Tolerance, count_beyond};
use crate::representations::{CountingSource, FrameRequest, GpuKernel, Refine, RenderError, Settings as AnySettings, Uploads};
use crate::textures::PixelFormat;

const BUDGET: u64 = 256 << 20;

#[test]
fn structs_lie_in_memory_as_wgsl_has_them() {
    assert_same_layout!(&source(0), "Shading", ShadingUniform { size, show_what });
}

#[test]
fn every_model_looks_the_same_on_both() {
    let Some(gpu) = test_gpu() else { return };
    // Kernels are made for the models that a map has: at most so many lobes, harmonics or none.
    let kinds = [
        (12, PixelFormat::F32, 4, Harmonics::Some),
        (12, PixelFormat::F16, 4, Harmonics::Some),
        (5, PixelFormat::F16, 4, Harmonics::Some),
        (12, PixelFormat::F16, 0, Harmonics::None),
        (12, PixelFormat::F16, 1, Harmonics::None),
        (12, PixelFormat::F16, 2, Harmonics::None),
        (12, PixelFormat::F16, 0, Harmonics::Some),
    ];
    for (size, pixel, most_lobes, harmonics) in kinds {
        let world = World { size, pixel, ..WORLD };
        let (map, pages) = world.build(|i| {
            every_kind(i).filter(|model| {
                let code = ModelCode::of(model);
                code.lobes() <= most_lobes && (harmonics == Harmonics::Some || code.bands().is_none())
            })
        });
        let map = Arc::new(map);
        let mut kernel = Kernel::new(gpu.clone(), map.clone(), BUDGET).unwrap();
        let reference = Reference::new(map.clone());
        for position in [Vec3::new(0.3, 1.6, 1.4), Vec3::new(-1.9, 0.25, 0.4), Vec3::new(0.2, -1.0, 1.0)] {
            let camera = world.camera(position, Vec3::ZERO, 80, 60);
            for show in [Show::Radiance, Show::Models, Show::Flags] {
                let settings = AnySettings::ParameterMap(Settings { show });
                let request = FrameRequest {
                    camera: &camera,
                    settings: &settings,
                    outputs: EVERYTHING,
                    refine: Refine::Whole,
                    uploads: Uploads::NONE,
                };
                let source = CountingSource::new(&pages);
                let (pixels, _) = kernel.render(&request, &source).unwrap();
                let touched = PagedQuads::untouched(&map);
                let mut quads = PagedQuads::new(&map, &source, &touched);
                let (mut colors, mut others) = (Vec::new(), 0);
                for (at, pixel) in kernel.read_g_buffer().iter().enumerate() {
                    let result = reference.shade(Settings { show }, &camera, (at as u32 % 80, at as u32 / 80), pixel, &mut quads).unwrap();
                    others += usize::from(result.provenance != pixels.provenance.as_ref().unwrap()[at]);
                    colors.extend(result.radiance.to_array());
                }
                let report = count_beyond(&colors, &pixels.color, &Tolerance::F32_LOOKUP).unwrap();
                // Where a point lies halfway between two texels rounding says which is nearest: 0.2 % of the pixels.
                assert!(others <= 80 * 60 / 500, "{size} {pixel:?} {show:?}: {others} name another texel");
                assert!(report.beyond <= 3 * others, "{size} {pixel:?} {position} {show:?}: {report:?}");
            }
        }
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Harmonics {
    None,
    Some,
}

#[test]
fn a_map_beyond_the_budget_is_refused_and_a_smaller_budget_forgets_it() {
    let Some(gpu) = test_gpu() else { return };
    let (map, pages) = WORLD.build(every_kind);
    let map = Arc::new(map);
    assert!(matches!(Kernel::new(gpu.clone(), map.clone(), 1 << 20).map(drop), Err(GpuError::OverBudget { .. })));
    let mut kernel = Kernel::new(gpu, map, BUDGET).unwrap();
    let camera = WORLD.camera(Vec3::new(0.3, 1.6, 1.4), Vec3::ZERO, 80, 60);
    let settings = AnySettings::ParameterMap(Settings::default());
    let request = FrameRequest { camera: &camera, settings: &settings, outputs: EVERYTHING, refine: Refine::Whole, uploads: Uploads::NONE };
    let source = CountingSource::new(&pages);
    let (first, stats) = kernel.render(&request, &source).unwrap();
    assert_eq!((stats.pages_uploaded, kernel.stats().misses, kernel.stats().hits), (1, 1, 0));
    let pairs = |model: Model| match model {
        Model::Lobes { lobes, .. } => lobes.len(),
        Model::Harmonics { coefficients, .. } => 3 * coefficients.len().div_ceil(8),
        _ => 0,
    };
    // Heads and pairs of eight f32; tables beyond 4096 elements of 16 bytes have whole rows.
    let pairs: usize = (0..2 * 12 * 12).filter_map(every_kind).map(pairs).sum();
    let expected = 2 * 12 * 12 * 32 + 16 * (2 * pairs).next_multiple_of(4096);
    assert!(kernel.bytes() <= BUDGET && kernel.stats().resident_bytes == expected as u64, "{:?}, {expected}", kernel.stats());
    kernel.set_budget(1 << 20);
    assert!(matches!(kernel.render(&request, &source), Err(RenderError::Gpu(GpuError::OverBudget { .. }))));
    assert_eq!((kernel.stats().resident_pages, kernel.stats().evictions), (0, 1));
    kernel.set_budget(BUDGET);
    assert_eq!(kernel.render(&request, &source).unwrap().0.color, first.color);
    let stats = kernel.stats();
    assert_eq!(stats.look_ups, stats.hits + stats.misses);
}
