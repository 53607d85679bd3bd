//! Several mirror reflections: the object as it sees itself. `reflections.wgsl` has the same functions by the same names.
//!
//! The stored maps show the object diffuse, so a single read is one reflection. Where the mirrored ray meets the object's front again, at
//! x₂, the surface there is taken for a mirror, too, and so on, at most as often as the settings say:
//! - `Mirror`, an object that is nothing else: `C_sᵏ Σⱼ βⱼ Lᵢ(pⱼ; r_k)` at the last point x_k;
//! - `Full`, a diffuse object with a mirror's coat: `Σ_k C_sᵏ Σⱼ βⱼ Lᵢ(pⱼ; r_k)` over all of them.
//!
//! The paper asks for this by capturing the scene again with the object as rendered before, once a level, with other cube maps for every C_s.
//! Following the ray through the object's own triangles takes no capture and no bytes, and any C_s.
//!
//! How much of a cube map a pixel covers at x_k is the difference between its ray and those of two neighbours, each one pixel on in the
//! tangent plane; where a neighbour's misses, or meets another fold, the surface there is taken for a plane. From the back of a surface
//! nothing is captured: a ray that meets it ends before.

use glam::Vec3;

use super::object_tree::{ObjectPoint, ObjectTree};
use super::shade::{NOTHING, ReadCube, SINGLE, Shaded, Sight, mirror_direction, mirrored, neighbour, radiance_toward, worse};
use super::{Component, Filter, OffsetSurfaceLightField, Settings};
use crate::radiometry::dielectric::outward;
use crate::representations::RenderError;

/// Normals of neighbours that differ more are of two folds.
const MOST_NORMALS_APART: f32 = 1.0;

/// Radiance of all reflections.
pub(super) fn reflections(
    field: &OffsetSurfaceLightField,
    settings: &Settings,
    at: &Sight,
    by: &[Sight; 2],
    candidates: [u16; 4],
    cubes: &mut dyn ReadCube,
) -> Result<Shaded, RenderError> {
    let Some(tree) = cubes.tree() else { return Ok(NOTHING) };
    let (mut at, mut by, mut candidates) = (*at, *by, candidates);
    let (mut before, mut sum) = (Vec3::ONE, None::<Shaded>);
    for number in 1..=settings.reflections {
        let r = mirrored(&at, &by);
        let next = if number < settings.reflections { next_sight(&tree, &at, r.direction) } else { None };
        if next.is_none() || settings.component != Component::Mirror {
            let seen = radiance_toward(field, settings, &at, &by, &r, candidates, cubes)?;
            let radiance = before * seen.radiance;
            sum = Some(match sum {
                None => Shaded { radiance, ..seen },
                Some(sum) => Shaded { radiance: sum.radiance + radiance, provenance: worse(sum.provenance, seen.provenance) },
            });
        }
        let Some((there, point)) = next else { break };
        before *= settings.specular_reflectance;
        by = match settings.filter {
            Filter::Bilinear => [SINGLE; 2],
            Filter::Footprint => [(by[0], r.across), (by[1], r.down)].map(|(by, turn)| {
                let beside = neighbour(&at, &by);
                let other = next_sight(&tree, &beside, mirror_direction(beside.normal, beside.direction));
                let along = by.position + at.position.distance(there.position) * turn;
                sights_apart(&there, other.map(|(sight, _)| sight), Sight { position: along, normal: Vec3::ZERO, direction: turn })
            }),
        };
        (at, candidates) = (there, field.sample_maps.at(point.part, point.uv.x, point.uv.y));
    }
    Ok(sum.unwrap_or(NOTHING))
}

/// The front that a ray from x along `direction` meets, as the ray sees it. A facet that x does not lie before is its own, or one of a convex
/// surface that shading makes round: near the silhouette what is mirrored by the interpolated normal passes below it.
fn next_sight(tree: &ObjectTree, from: &Sight, direction: Vec3) -> Option<(Sight, ObjectPoint)> {
    let point = tree.next(from.position, from.normal, direction)?;
    let normal = outward(point.shading, point.geometric, -direction);
    let before = point.geometric.dot(from.position - point.position);
    (point.geometric.dot(direction) < 0.0 && before > 0.5 * tree.near())
        .then_some((Sight { position: point.position, normal, direction }, point))
}

/// By how much two sights differ, or what a plane there would make it.
fn sights_apart(sight: &Sight, other: Option<Sight>, level: Sight) -> Sight {
    match other {
        Some(other) if (other.normal - sight.normal).length() < MOST_NORMALS_APART => Sight {
            position: other.position - sight.position,
            normal: other.normal - sight.normal,
            direction: other.direction - sight.direction,
        },
        _ => level,
    }
}
