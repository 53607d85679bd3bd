//! What a point of the surface looks like: the functions of `kernel.wgsl`, by the same names.

use glam::{Vec2, Vec3};

use super::{ParameterMap, Settings, Show, Texel};
use crate::fitting::{Flags, LEAST_COSINE};
use crate::geometry::TangentFrame;
use crate::representations::{Answer, Provenance, RenderError};

/// Where a texel's numbers come from.
pub(super) trait ReadQuads {
    /// The quads of a texel, in order.
    fn quads(&mut self, texel: &Texel) -> Result<&[[f32; 4]], RenderError>;
}

/// A finished point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shaded {
    pub radiance: Vec3,
    pub provenance: Provenance,
}

/// A point of the object's front.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfacePoint {
    pub part: u32,
    pub uv: Vec2,
    /// Unit.
    pub normal: Vec3,
    /// Along u, of any length.
    pub tangent: Vec3,
    /// Unit, world space, to the viewer.
    pub toward_viewer: Vec3,
}

pub(super) fn shade_point(
    map: &ParameterMap,
    settings: Settings,
    point: &SurfacePoint,
    quads: &mut dyn ReadQuads,
) -> Result<Shaded, RenderError> {
    let nearest = nearest_texel(map, point);
    match settings.show {
        Show::Radiance => blend(map, point, quads),
        Show::Models => Ok(overlay(map, nearest, model_color(map.texels.texels[nearest].code.number()))),
        Show::Flags => Ok(overlay(map, nearest, flags_color(map.texels.texels[nearest].flags))),
    }
}

/// Direction to the viewer in the point's frame, kept a half degree above its horizon: no model was asked further down.
fn local_direction(point: &SurfacePoint) -> Vec3 {
    let d = TangentFrame::along(point.normal, point.tangent).local_from_world(point.toward_viewer);
    Vec3::new(d.x, d.y, d.z.max(LEAST_COSINE)).normalize()
}

// Of the texels that have a model, by their weights among themselves.
fn blend(map: &ParameterMap, point: &SurfacePoint, quads: &mut dyn ReadQuads) -> Result<Shaded, RenderError> {
    let d = local_direction(point).to_array();
    let (mut sum, mut total, mut is_sure) = (Vec3::ZERO, 0.0, true);
    for (index, weight) in around(map, point) {
        let texel = map.texels.texels[index];
        let Some(model) = texel.code.unpack(quads.quads(&texel)?) else {
            is_sure &= weight == 0.0;
            continue;
        };
        is_sure &= !texel.flags.contains(Flags::UNRESOLVED);
        sum += weight * Vec3::from(model.eval(d));
        total += weight;
    }
    if !(total > 0.0) {
        return Ok(Shaded { radiance: Vec3::ZERO, provenance: Provenance::UNKNOWN });
    }
    let answer = if is_sure { Answer::Hit } else { Answer::Filled };
    Ok(Shaded { radiance: (sum / total).max(Vec3::ZERO), provenance: Provenance::new(answer, nearest_texel(map, point) as u32) })
}

// The four texels around a point, clamped to its part's edges, and their bilinear weights.
fn around(map: &ParameterMap, point: &SurfacePoint) -> [(usize, f32); 4] {
    let (size, at) = (map.texels.size, texel_position(map, point));
    let (low, f) = (at.floor(), at - at.floor());
    let index = |dx: f32, dy: f32| {
        let last = size as f32 - 1.0;
        let (column, row) = ((low.x + dx).clamp(0.0, last) as usize, (low.y + dy).clamp(0.0, last) as usize);
        (point.part as usize * size + row) * size + column
    };
    [
        (index(0.0, 0.0), (1.0 - f.x) * (1.0 - f.y)),
        (index(1.0, 0.0), f.x * (1.0 - f.y)),
        (index(0.0, 1.0), (1.0 - f.x) * f.y),
        (index(1.0, 1.0), f.x * f.y),
    ]
}

fn nearest_texel(map: &ParameterMap, point: &SurfacePoint) -> usize {
    let (size, at) = (map.texels.size, texel_position(map, point));
    let last = size as f32 - 1.0;
    let (column, row) = ((at.x + 0.5).floor().clamp(0.0, last) as usize, (at.y + 0.5).floor().clamp(0.0, last) as usize);
    (point.part as usize * size + row) * size + column
}

// In texels, centres at whole numbers.
fn texel_position(map: &ParameterMap, point: &SurfacePoint) -> Vec2 {
    point.uv * map.texels.size as f32 - 0.5
}

fn overlay(map: &ParameterMap, index: usize, color: Vec3) -> Shaded {
    let has_model = map.texels.texels[index].code.number() != 0;
    let answer = if has_model { Answer::Hit } else { Answer::Unknown };
    Shaded { radiance: if has_model { color } else { Vec3::ZERO }, provenance: Provenance::new(answer, index as u32) }
}

/// Grey, brown, then blue to red with every lobe; harmonics are violet, the brighter the more bands.
fn model_color(number: u8) -> Vec3 {
    match number {
        0 => Vec3::ZERO,
        1 => Vec3::splat(0.5),
        2 => Vec3::new(0.4, 0.25, 0.1),
        3 => Vec3::new(0.05, 0.2, 0.8),
        4 => Vec3::new(0.05, 0.6, 0.2),
        5 => Vec3::new(0.9, 0.6, 0.05),
        6 => Vec3::new(0.9, 0.1, 0.05),
        _ => Vec3::new(0.4, 0.1, 0.5) * (0.5 + 0.05 * f32::from(number % 16)),
    }
}

/// Dark grey where nothing is flagged; red unresolved, green clipped, blue misfit, brighter where there were outliers.
fn flags_color(flags: Flags) -> Vec3 {
    let on = |flag: Flags| if flags.contains(flag) { 0.7 } else { 0.1 };
    let color = Vec3::new(on(Flags::UNRESOLVED), on(Flags::CLIPPED), on(Flags::MISFIT));
    if flags.contains(Flags::OUTLIERS) { color + 0.3 } else { color }
}
