//! A frame on the CPU: rays for the G-buffer, `shade.rs` for the object, quads through the cache.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::{Vec2, Vec3};

use super::shade::{ReadQuads, SurfacePoint, shade_point};
use super::{ParameterMap, Settings, Show, Texel};
use crate::geometry::Camera;
use crate::raytrace::Stack;
use crate::representations::buckets::{PixelResult, render_in_buckets};
use crate::representations::g_buffer::{GBufferPixel, GBufferTracer, ProxyGeometry, Seen};
use crate::representations::page_source::{CountingReader, CountingSource};
use crate::representations::{CpuKernel, FrameRequest, Pixels, Provenance, Recording, RenderError, Settings as AnySettings, TexelRequest};
use crate::textures::PageId;

/// The map with its tree of triangles.
pub(crate) struct Reference {
    map: Arc<ParameterMap>,
    tracer: GBufferTracer,
}

impl Reference {
    pub fn new(map: Arc<ParameterMap>) -> Self {
        let geometry = Arc::new(ProxyGeometry::new(&map.surface.mesh, &map.surface.part_of_triangle, &map.background));
        Self { tracer: GBufferTracer::new(geometry), map }
    }

    /// The finished pixel (i, j) of a G-buffer from either twin.
    pub fn shade(
        &self,
        settings: Settings,
        camera: &Camera,
        (i, j): (u32, u32),
        pixel: &GBufferPixel,
        quads: &mut dyn ReadQuads,
    ) -> Result<PixelResult, RenderError> {
        let (radiance, provenance) = match Seen::from_code(pixel.a[2]) {
            Seen::Background | Seen::Nothing => (Vec3::from_slice(&pixel.b), Provenance::BACKGROUND),
            Seen::Unknown => (Vec3::from_slice(&pixel.b), Provenance::UNKNOWN),
            // Nothing was observed from there.
            Seen::ObjectBack { .. } => (Vec3::ZERO, Provenance::UNKNOWN),
            Seen::Object { part } => {
                let point = SurfacePoint {
                    part,
                    uv: Vec2::new(pixel.a[0], pixel.a[1]),
                    normal: Vec3::from_slice(&pixel.b),
                    tangent: Vec3::from_slice(&pixel.tangent),
                    toward_viewer: -camera.pixel_ray(i, j).direction,
                };
                let shaded = shade_point(&self.map, settings, &point, quads)?;
                (shaded.radiance, shaded.provenance)
            }
        };
        Ok(PixelResult::checked(radiance, pixel.a[3], provenance))
    }

    fn settings(request: &AnySettings) -> Result<Settings, RenderError> {
        match request {
            AnySettings::ParameterMap(settings) => Ok(*settings),
            other => Err(RenderError::OtherKind { settings: other.kind() }),
        }
    }
}

impl CpuKernel for Reference {
    fn render(&self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<Pixels, RenderError> {
        let settings = Self::settings(request.settings)?;
        let touched = PagedQuads::untouched(&self.map);
        let start = || (Stack::new(), PagedQuads::new(&self.map, pages, &touched));
        let mut frame = render_in_buckets(request, start, |(stack, quads), i, j| {
            let pixel = self.tracer.pixel(request.camera, i, j, stack);
            self.shade(settings, request.camera, (i, j), &pixel, quads)
        })?;
        frame.pages_needed = touched.iter().filter(|t| t.load(Ordering::Relaxed)).count();
        Ok(frame)
    }

    fn record(&self, recording: &Recording<'_>, sink: &mut dyn FnMut(TexelRequest)) -> Result<(), RenderError> {
        let settings = Self::settings(recording.settings)?;
        if settings.show != Show::Radiance {
            return Ok(());
        }
        let (camera, mut stack) = (recording.camera, Stack::new());
        let (width, height) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
        for (i, j) in recording.order.pixels(width, height) {
            let pixel = self.tracer.pixel(camera, i, j, &mut stack);
            self.shade(settings, camera, (i, j), &pixel, &mut Recorder { sink, zeros: Vec::new() })?;
        }
        Ok(())
    }
}

/// Quads in pages, read through a thread's reader.
pub(super) struct PagedQuads<'a> {
    map: &'a ParameterMap,
    reader: CountingReader<'a>,
    touched: &'a [AtomicBool],
    /// Pages whose shape this thread has checked.
    checked: Vec<bool>,
    quads: Vec<[f32; 4]>,
}

impl<'a> PagedQuads<'a> {
    /// A mark for every page, none set.
    pub fn untouched(map: &ParameterMap) -> Vec<AtomicBool> {
        (0..map.page_count()).map(|_| AtomicBool::new(false)).collect()
    }

    pub fn new(map: &'a ParameterMap, source: &'a CountingSource<'a>, touched: &'a [AtomicBool]) -> Self {
        Self { map, reader: source.reader(), touched, checked: vec![false; touched.len()], quads: Vec::new() }
    }

    fn check(&mut self, page: PageId) -> Result<(), RenderError> {
        let at = page.0 as usize;
        if self.checked.get(at) == Some(&false) {
            self.map.check_page(page.0, self.reader.shape(page)?)?;
            self.checked[at] = true;
            self.touched[at].store(true, Ordering::Relaxed);
        }
        Ok(())
    }
}

impl ReadQuads for PagedQuads<'_> {
    fn quads(&mut self, texel: &Texel) -> Result<&[[f32; 4]], RenderError> {
        self.quads.clear();
        for at in look_ups(texel) {
            for (page, ..) in at {
                self.check(page)?;
            }
            self.quads.extend(self.reader.texels(at)?);
        }
        Ok(&self.quads)
    }
}

// Four quads at a time; the last one again where there are fewer.
fn look_ups(texel: &Texel) -> impl Iterator<Item = [(PageId, u32, u32); 4]> + use<> {
    let (first, count) = (texel.first_quad, texel.code.quads());
    (0..count).step_by(4).map(move |k| std::array::from_fn(|i| ParameterMap::place(first + (k + i as u32).min(count - 1))))
}

/// Tells what would be read, and reads nothing.
struct Recorder<'a> {
    sink: &'a mut dyn FnMut(TexelRequest),
    zeros: Vec<[f32; 4]>,
}

impl ReadQuads for Recorder<'_> {
    fn quads(&mut self, texel: &Texel) -> Result<&[[f32; 4]], RenderError> {
        for at in look_ups(texel) {
            (self.sink)(TexelRequest::LookUp(at.map(|(page, _, row)| (page, row))));
        }
        self.zeros.resize(texel.code.quads() as usize, [0.0; 4]);
        Ok(&self.zeros)
    }
}
