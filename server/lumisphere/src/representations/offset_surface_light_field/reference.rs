//! A frame on the CPU: rays for the G-buffer, `shade.rs` for the object, texels through a few pages kept by each thread.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};

use glam::Vec3;

use super::corrected::InverseDistances;
use super::object_tree::ObjectTree;
use super::relight::{LightTables, Lit};
use super::requests::record_requests;
use super::shade::{ReadCube, shade_object};
use super::{OffsetSurfaceLightField, Settings};
use crate::directions::{Footprint, Texel, bilinear_footprint};
use crate::geometry::{Camera, NormalMap};
use crate::radiometry::brdf::Measured;
use crate::raytrace::Stack;
use crate::representations::buckets::{PixelResult, render_in_buckets};
use crate::representations::g_buffer::{GBufferPixel, GBufferTracer, ProxyGeometry, Seen};
use crate::representations::page_source::{CountingReader, CountingSource};
use crate::representations::{
    CpuKernel, FrameRequest, Pixels, Provenance, Recording, RenderError, Settings as AnySettings, TexelRequest, Uploads,
};
use crate::textures::PageId;

/// The field with its tree of triangles.
pub(crate) struct Reference {
    field: Arc<OffsetSurfaceLightField>,
    tracer: GBufferTracer,
    light: LightTables,
    geometry: Arc<ProxyGeometry>,
    tree: OnceLock<Arc<ObjectTree>>,
}

impl Reference {
    pub fn new(field: Arc<OffsetSurfaceLightField>) -> Self {
        let geometry = Arc::new(ProxyGeometry::new(&field.surface.mesh, &field.surface.part_of_triangle, &field.background));
        Self { tracer: GBufferTracer::new(geometry.clone()), field, light: LightTables::default(), geometry, tree: OnceLock::new() }
    }

    /// What frames with these settings read beside cube maps.
    pub fn asides(&self, settings: &Settings, uploads: &Uploads<'_>, pages: &CountingSource<'_>) -> Result<Asides, RenderError> {
        let make_tree = || Arc::new(ObjectTree::new(self.geometry.clone()));
        let tree = settings.needs_tree().then(|| self.tree.get_or_init(make_tree).clone());
        let lit = self.light.lit(&self.field, settings, pages)?;
        Ok(Asides { lit, tree, table: uploads.table.cloned(), normal_map: uploads.normal_map.cloned() })
    }

    /// What every pixel sees.
    #[cfg(all(test, feature = "gpu"))]
    pub fn g_buffer(&self, camera: &Camera) -> Vec<GBufferPixel> {
        let (width, height) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
        let mut stack = Stack::new();
        (0..width * height).map(|at| self.tracer.pixel(camera, at % width, at / width, &mut stack)).collect()
    }

    /// The finished pixel (i, j) of a G-buffer from either twin.
    pub fn shade(
        &self,
        settings: &Settings,
        camera: &Camera,
        (i, j): (u32, u32),
        pixel: &GBufferPixel,
        cubes: &mut dyn ReadCube,
    ) -> Result<PixelResult, RenderError> {
        let seen = Seen::from_code(pixel.a[2]);
        let (radiance, provenance) = match seen {
            Seen::Nothing if settings.light.turns() => {
                let direction = settings.light.before(camera.pixel_ray(i, j).direction);
                (self.field.background.environment.radiance(direction), Provenance::BACKGROUND)
            }
            Seen::Background | Seen::Nothing => (Vec3::from_slice(&pixel.b), Provenance::BACKGROUND),
            Seen::Unknown => (Vec3::from_slice(&pixel.b), Provenance::UNKNOWN),
            Seen::Object { .. } | Seen::ObjectBack { .. } => {
                let shaded = shade_object(&self.field, settings, camera, (i, j), pixel, cubes)?;
                (shaded.radiance, shaded.provenance)
            }
        };
        Ok(PixelResult::checked(radiance, pixel.a[3], provenance))
    }
}

impl CpuKernel for Reference {
    fn render(&self, request: &FrameRequest<'_>, pages: &CountingSource<'_>) -> Result<Pixels, RenderError> {
        let AnySettings::OffsetSurfaceLightField(settings) = request.settings else {
            return Err(RenderError::OtherKind { settings: request.settings.kind() });
        };
        settings.check_original(self.field.parameters.original)?;
        settings.check_bumps()?;
        let touched = PagesTouched::new(self.field.page_count());
        let asides = self.asides(settings, &request.uploads, pages)?;
        let start = || (Stack::new(), PagedCubes::new(&self.field, pages, &touched, asides.clone()));
        let mut frame = render_in_buckets(request, start, |(stack, cubes), i, j| {
            let pixel = self.tracer.pixel(request.camera, i, j, stack);
            self.shade(settings, request.camera, (i, j), &pixel, cubes)
        })?;
        frame.pages_needed = touched.count();
        Ok(frame)
    }

    fn record(&self, recording: &Recording<'_>, sink: &mut dyn FnMut(TexelRequest)) -> Result<(), RenderError> {
        record_requests(&self.field, &self.tracer, recording, sink)
    }
}

/// What some frames read beside cube maps.
#[derive(Debug, Clone, Default)]
pub(super) struct Asides {
    /// Where light is another than was captured.
    pub lit: Option<Arc<Lit>>,
    /// Where rays go through the object.
    pub tree: Option<Arc<ObjectTree>>,
    /// Where the surface reflects as a measured one.
    pub table: Option<Arc<Measured>>,
    /// Where a map turns the surface's normals.
    pub normal_map: Option<Arc<NormalMap>>,
}

/// Which pages a frame has read.
pub(super) struct PagesTouched(Vec<AtomicU32>);

impl PagesTouched {
    pub fn new(pages: usize) -> Self {
        Self((0..pages.div_ceil(32)).map(|_| AtomicU32::new(0)).collect())
    }

    fn mark(&self, page: u32) {
        self.0[page as usize / 32].fetch_or(1 << (page % 32), Ordering::Relaxed);
    }

    /// At least as many as the frame can read.
    fn pages(&self) -> usize {
        32 * self.0.len()
    }

    pub fn count(&self) -> usize {
        self.0.iter().map(|w| w.load(Ordering::Relaxed).count_ones() as usize).sum()
    }
}

/// Cube maps in pages, read texel by texel.
pub(super) struct PagedCubes<'a> {
    field: &'a OffsetSurfaceLightField,
    reader: CountingReader<'a>,
    touched: &'a PagesTouched,
    asides: Asides,
    /// Pages whose shape this thread has checked.
    checked: Vec<bool>,
}

impl<'a> PagedCubes<'a> {
    /// The four of a bilinear read, where they are and their weights.
    pub fn texels_around(&mut self, cube: u32, direction: Vec3, level: u32) -> Result<([[f32; 4]; 4], Footprint), RenderError> {
        let footprint = bilinear_footprint(direction, self.field.level_size(level) as usize);
        let mut at = [(PageId(0), 0, 0); 4];
        for (at, (texel, _)) in at.iter_mut().zip(&footprint) {
            let (page, row) = self.field.texel_place(cube, level, *texel);
            self.check(page)?;
            *at = (PageId(page), texel.column as u32, row);
        }
        Ok((self.reader.texels(at)?, footprint))
    }

    /// The stored distances of texels of level 0.
    pub fn distances(&mut self, cube: u32, texels: [Texel; 4]) -> Result<[f32; 4], RenderError> {
        let mut at = [(PageId(0), 0, 0); 4];
        for (at, texel) in at.iter_mut().zip(texels) {
            let (page, row) = self.field.texel_place(cube, 0, texel);
            self.check(page)?;
            *at = (PageId(page), texel.column as u32, row);
        }
        Ok(self.reader.texels(at)?.map(|texel| texel[3]))
    }

    /// For shading with what `asides` holds.
    pub fn new(field: &'a OffsetSurfaceLightField, source: &'a CountingSource<'a>, touched: &'a PagesTouched, asides: Asides) -> Self {
        Self { field, reader: source.reader(), touched, asides, checked: vec![false; touched.pages()] }
    }

    fn check(&mut self, page: u32) -> Result<(), RenderError> {
        match self.checked.get_mut(page as usize) {
            Some(true) => Ok(()),
            unchecked => {
                self.field.check_page(page, self.reader.shape(PageId(page))?)?;
                if let Some(checked) = unchecked {
                    *checked = true;
                    self.touched.mark(page);
                }
                Ok(())
            }
        }
    }
}

impl ReadCube for PagedCubes<'_> {
    fn read_level(&mut self, cube: u32, direction: Vec3, level: u32) -> Result<Vec3, RenderError> {
        let (texels, footprint) = self.texels_around(cube, direction, level)?;
        if let Some(lit) = self.asides.lit.as_ref().filter(|lit| lit.light.turns()) {
            return Ok(lit.environment.after(&lit.light, &texels, &footprint, direction, level));
        }
        Ok(texels.iter().zip(&footprint).map(|(texel, (_, weight))| *weight * Vec3::from_slice(texel)).sum())
    }

    fn inverse_distances(&mut self, cube: u32, direction: Vec3) -> Result<InverseDistances, RenderError> {
        let (texels, footprint) = self.texels_around(cube, direction, 0)?;
        Ok(InverseDistances::of(std::array::from_fn(|k| (texels[k][3], footprint[k].1))))
    }

    fn lit(&self) -> Option<Arc<Lit>> {
        self.asides.lit.clone()
    }

    fn tree(&self) -> Option<Arc<ObjectTree>> {
        self.asides.tree.clone()
    }

    fn table(&self) -> Option<Arc<Measured>> {
        self.asides.table.clone()
    }

    fn normal_map(&self) -> Option<Arc<NormalMap>> {
        self.asides.normal_map.clone()
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        self.field
    }
}
