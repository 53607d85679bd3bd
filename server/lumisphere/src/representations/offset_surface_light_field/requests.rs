//! The requests for texels that a frame makes, without reading any: weights and directions do not depend on what is stored. (Those of
//! depth-corrected reads do; they are refused.)

use glam::{Vec2, Vec3};

use super::corrected::InverseDistances;
use super::shade::{ReadCube, SINGLE, mirror_direction, radiance_toward, shade_object, sight};
use super::{OffsetSurfaceLightField, Settings};
use crate::directions::{DirectionDifferential, bilinear_footprint};
use crate::geometry::Camera;
use crate::raytrace::{SampleSequence, Stack};
use crate::representations::g_buffer::{GBufferPixel, GBufferTracer, Seen};
use crate::representations::{Lobe, Recording, RenderError, Settings as AnySettings, TexelRequest};
use crate::textures::PageId;

/// Calls `sink` for every request of the frame, in its order.
pub(super) fn record_requests(
    field: &OffsetSurfaceLightField,
    tracer: &GBufferTracer,
    recording: &Recording<'_>,
    sink: &mut dyn FnMut(TexelRequest),
) -> Result<(), RenderError> {
    let AnySettings::OffsetSurfaceLightField(settings) = recording.settings else {
        return Err(RenderError::OtherKind { settings: recording.settings.kind() });
    };
    if settings.light.changes_light() || settings.needs_tree() || settings.bumps.is_some() {
        return Err(RenderError::ReadsMore);
    }
    settings.check_original(field.parameters.original)?;
    let camera = recording.camera;
    let (width, height) = (camera.intrinsics().width_px, camera.intrinsics().height_px);
    let mut stack = Stack::new();
    for (i, j) in recording.order.pixels(width, height) {
        let pixel = tracer.pixel(camera, i, j, &mut stack);
        let (Seen::Object { part } | Seen::ObjectBack { part }) = Seen::from_code(pixel.a[2]) else { continue };
        let row = field.sample_maps.row(pixel.a[1]);
        sink(TexelRequest::SampleMap { part, row });
        let mut cubes = Requests { field, sink };
        match &recording.lobe {
            None => {
                shade_object(field, settings, camera, (i, j), &pixel, &mut cubes)?;
            }
            Some(lobe) => glossy(field, settings, lobe, camera, (i, j), &pixel, &mut cubes)?,
        }
    }
    Ok(())
}

/// Reads of every drawn direction above the surface; each looks at a single one.
fn glossy(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    lobe: &Lobe,
    camera: &Camera,
    (i, j): (u32, u32),
    pixel: &GBufferPixel,
    cubes: &mut Requests<'_>,
) -> Result<(), RenderError> {
    let [u, v, code, _] = pixel.a;
    let (Seen::Object { part } | Seen::ObjectBack { part }) = Seen::from_code(code) else { return Ok(()) };
    let (at, _) = sight(settings.filter, camera, (i, j), pixel);
    let candidates = field.sample_maps.at(part, u, v);
    let r = mirror_direction(at.normal, at.direction);
    for sample in 0..lobe.samples {
        let number = u64::from(j) << 32 | u64::from(i);
        let toward = about(r, lobe.exponent, SampleSequence::new(lobe.seed, number, sample).pair());
        if toward.dot(at.normal) > 0.0 {
            let toward = DirectionDifferential::single(toward);
            radiance_toward(field, settings, &at, &[SINGLE; 2], &toward, candidates, cubes)?;
        }
    }
    Ok(())
}

/// A direction about `axis` (unit) with density (n + 1)/2π · cosⁿ.
fn about(axis: Vec3, exponent: f32, u: Vec2) -> Vec3 {
    let cos = u.x.powf(1.0 / (exponent + 1.0));
    let sin = (1.0 - cos * cos).max(0.0).sqrt();
    let (s, t) = axis.any_orthonormal_pair();
    let around = Vec2::from_angle(std::f32::consts::TAU * u.y) * sin;
    around.x * s + around.y * t + cos * axis
}

/// Says what is asked for and answers with black.
struct Requests<'a> {
    field: &'a OffsetSurfaceLightField,
    sink: &'a mut dyn FnMut(TexelRequest),
}

impl ReadCube for Requests<'_> {
    fn read_level(&mut self, cube: u32, direction: Vec3, level: u32) -> Result<Vec3, RenderError> {
        let footprint = bilinear_footprint(direction, self.field.level_size(level) as usize);
        let place = |k: usize| {
            let (page, row) = self.field.texel_place(cube, level, footprint[k].0);
            (PageId(page), row)
        };
        (self.sink)(TexelRequest::LookUp([place(0), place(1), place(2), place(3)]));
        Ok(Vec3::ZERO)
    }

    fn inverse_distances(&mut self, _cube: u32, _direction: Vec3) -> Result<InverseDistances, RenderError> {
        Err(RenderError::DependsOnPages)
    }

    fn field(&self) -> &OffsetSurfaceLightField {
        self.field
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ∫ cos · (n + 1)/2π · cosⁿ over the hemisphere = (n + 1)/(n + 2).
    #[test]
    fn a_lobe_has_the_mean_cosine_of_its_density() {
        let axis = Vec3::new(0.6, -0.64, 0.48);
        for exponent in [1.0, 10.0, 1000.0] {
            let cosines = (0..4096).map(|s| about(axis, exponent, SampleSequence::new(3, 5, s).pair()).dot(axis));
            let mean = cosines.sum::<f32>() / 4096.0;
            assert!((mean - (exponent + 1.0) / (exponent + 2.0)).abs() < 2e-3 / exponent.sqrt(), "n = {exponent}: {mean}");
        }
    }
}
