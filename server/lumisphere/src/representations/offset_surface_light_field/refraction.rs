//! The object as a clear body: what it mirrors, and what is seen through it, weighted by Fresnel's equations. `refraction.wgsl` has the same
//! functions by the same names.
//!
//! `L = R · L_mirror + T · Lᵢ(x'; d')`: the way of the eye's ray through the body (`Dielectric::passage`) is traced through the object's own
//! triangles, and what lies beyond is read where it leaves, at x' toward d', as a mirror's light is read at x (by any [`Blend`](super::Blend)).
//! How much of a cube map a pixel covers there is the difference between its way and those of two neighbours, each one pixel on in the tangent
//! plane.
//!
//! Where a ray never leaves (more total reflections than are followed), or where no sample point serves the place at which it does (the object
//! touches something there, and it is dark), the pixel shows the mirror's part alone and is unknown. Where the surface has no other side, the
//! environment map at the object's centre is read, and the pixel is filled.
//! Light that is partly reflected inside is left out, and a body is clear: nothing else is seen in it.

use glam::{Vec2, Vec3};

use super::object_tree::ObjectTree;
use super::shade::{NOTHING, ReadCube, SINGLE, Shaded, Sight, mirrored, neighbour, radiance_toward, worse};
use super::{Filter, OffsetSurfaceLightField, Settings};
use crate::directions::DirectionDifferential;
use crate::radiometry::dielectric::{BodyPoint, Dielectric, Passage, outward};
use crate::representations::RenderError;
use crate::representations::provenance::{Answer, Provenance};

/// Farther apart than this many radians two neighbours' ways are not of one fold.
const MOST_APART: f32 = 1.0;

/// Where a ray inside the object meets its surface.
#[derive(Debug, Clone, Copy, PartialEq)]
struct InnerPoint {
    body: BodyPoint,
    uv: Vec2,
    part: u32,
}

impl AsRef<BodyPoint> for InnerPoint {
    fn as_ref(&self) -> &BodyPoint {
        &self.body
    }
}

fn next_inside(tree: &ObjectTree, from: &BodyPoint, direction: Vec3) -> Option<InnerPoint> {
    let point = tree.next(from.position, from.normal, direction)?;
    let body = BodyPoint { position: point.position, normal: outward(point.shading, point.geometric, direction) };
    Some(InnerPoint { body, uv: point.uv, part: point.part })
}

fn passage(tree: &ObjectTree, dielectric: &Dielectric, at: &Sight) -> Option<Passage<InnerPoint>> {
    let entry = BodyPoint { position: at.position, normal: at.normal };
    dielectric.passage(&entry, at.direction, |from, direction| next_inside(tree, from, direction))
}

/// Radiance of the object as a clear body.
pub(super) fn refraction(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    dielectric: &Dielectric,
    at: &Sight,
    by: &[Sight; 2],
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let Some(tree) = cubes.tree() else { return Ok(NOTHING) };
    let white = Settings { specular_reflectance: Vec3::ONE, ..*settings };
    let outside = radiance_toward(field, &white, at, by, &mirrored(at, by), candidates, cubes)?;
    let reflected = dielectric.reflectance(-at.normal.dot(at.direction)) * outside.radiance;
    let Some(way) = passage(&tree, dielectric, at) else {
        return Ok(Shaded { radiance: reflected, provenance: Provenance::UNKNOWN });
    };
    let ways = by.map(|by| match settings.filter {
        Filter::Bilinear => (Vec3::ZERO, Vec3::ZERO),
        Filter::Footprint => apart(&way, passage(&tree, dielectric, &neighbour(at, &by)), &by),
    });
    let look = DirectionDifferential { direction: way.direction, across: ways[0].1, down: ways[1].1 };
    let beyond = match way.exit {
        Some(exit) => {
            let at = Sight { position: exit.body.position, normal: exit.body.normal, direction: way.direction };
            let by = ways.map(|(position, _)| Sight { position, ..SINGLE });
            radiance_toward(field, &white, &at, &by, &look, field.sample_maps.at(exit.part, exit.uv.x, exit.uv.y), cubes)?
        }
        None => {
            let baseline = field.sample_points.len() as u32;
            Shaded { radiance: cubes.read_cube(baseline, &look)?, provenance: Provenance::new(Answer::Filled, baseline) }
        }
    };
    let radiance = reflected + way.transmittance * beyond.radiance;
    Ok(Shaded { radiance, provenance: worse(outside.provenance, beyond.provenance) })
}

/// By how much two ways differ where they leave: position and direction. Where the other is of another fold, what the eye's rays do.
fn apart(way: &Passage<InnerPoint>, other: Option<Passage<InnerPoint>>, by: &Sight) -> (Vec3, Vec3) {
    let eyes = (Vec3::ZERO, by.direction);
    let Some(other) = other else { return eyes };
    let direction = other.direction - way.direction;
    match (way.exit, other.exit) {
        _ if !(direction.length() < MOST_APART) => eyes,
        (Some(a), Some(b)) => (b.body.position - a.body.position, direction),
        (None, None) => (by.position, direction),
        _ => eyes,
    }
}
