//! A surface whose normal a map turns (`geometry::normal_map`): `bumps.wgsl` has the same functions by the same names.
//!
//! What is stored was seen around the smooth surface, and stays so: which sample points are read, how they are blended, what hides what, and the
//! object's own light go by its own normal n. The turned normal n' is that by which it reflects: the mirror direction `2 n' (n'·v) − v`, and the
//! frame of a BRDF. As in the path tracer, a mirror's ray that would enter the surface, `r · n ≤ 0`, leaves as without a map; of a lobe the part
//! that would is lost.
//!
//! How much of a cube map a pixel covers follows from the turned normals at its neighbours', read from the map there. A pixel that covers
//! many texels of a map sees the one at its centre: its texels should be no finer than a pixel.

use std::sync::Arc;

use glam::{Vec2, Vec3};
use thiserror::Error;

use super::shade::{ReadCube, Sight, mirrored};
use super::{Component, Filter, Settings};
use crate::directions::DirectionDifferential;
use crate::geometry::{Mapping, NormalMap, Tangent, turned_normal};
use crate::representations::RenderError;
use crate::representations::g_buffer::GBufferPixel;
use crate::textures::ContentHash;

/// Which map turns the normals, and how it lies on the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bumps {
    /// Of its file; it comes with the request ([`FrameRequest::normal_map`](crate::representations::FrameRequest::normal_map)).
    pub map: ContentHash,
    /// Strength and repeats.
    pub mapping: Mapping,
}

/// Largest strength, of either sign.
pub const MOST_STRENGTH: f32 = 16.0;
/// Most repeats: a texel of the smallest map is then wide enough for texture coordinates in f32.
pub const MOST_REPEATS: f32 = 4096.0;

/// What a normal map cannot be on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum BumpsError {
    /// It shows what was captured.
    #[error("a normal map with {component}, which it does not change: mirror, full or glossy expected")]
    Component {
        /// By its name.
        component: &'static str,
    },
    /// Rays would meet the map again.
    #[error("a normal map with {reflections} reflections, 1 expected")]
    Reflections {
        /// As asked for.
        reflections: u32,
    },
}

impl Bumps {
    /// `9f86d081-strength-0.5-repeat-3`, for reports; the hash by its first digits.
    pub fn name(&self) -> String {
        let hash = self.map.to_string();
        format!("{}-strength-{}-repeat-{}", &hash[..8], self.mapping.strength, self.mapping.repeat)
    }
}

impl Settings {
    /// Whether the map, if there is one, can turn what is shown.
    pub fn check_bumps(&self) -> Result<(), BumpsError> {
        if self.bumps.is_none() {
            return Ok(());
        }
        match self.component {
            Component::Reconstruction | Component::Refraction(_) => Err(BumpsError::Component { component: self.component.name() }),
            Component::Mirror | Component::Full if self.reflections > 1 => Err(BumpsError::Reflections { reflections: self.reflections }),
            Component::Mirror | Component::Full | Component::Glossy(_) => Ok(()),
        }
    }
}

/// How a pixel's surface reflects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reflecting {
    /// About which: the surface's own, or as the map turns it.
    pub normal: Vec3,
    /// What it mirrors.
    pub mirrored: DirectionDifferential,
}

impl Reflecting {
    /// Whether light from the unit vector `wi` enters the surface, though it is above the turned one.
    pub fn enters(&self, wi: Vec3, at: &Sight) -> bool {
        self.normal != at.normal && !(wi.dot(at.normal) > 0.0)
    }
}

/// By the map, where there is one.
pub(super) fn reflecting_at(
    settings: &Settings,
    at: &Sight,
    by: &[Sight; 2],
    pixel: &GBufferPixel,
    cubes: &dyn ReadCube,
) -> Result<Reflecting, RenderError> {
    let smooth = || Reflecting { normal: at.normal, mirrored: mirrored(at, by) };
    let Some(Bumps { map: hash, mapping }) = settings.bumps else { return Ok(smooth()) };
    let map: Arc<NormalMap> = cubes.normal_map().ok_or(RenderError::NoNormalMap { map: hash })?;
    let uv = Vec2::new(pixel.a[0], pixel.a[1]);
    let [x, y, z, side_of_v] = pixel.tangent;
    let tangent = Tangent { along_u: Vec3::new(x, y, z), side_of_v };
    let slopes = map.slopes(uv, &mapping);
    let beside = [0, 1].map(|k| {
        let surface = &pixel.differentials[k];
        map.slopes(uv + Vec2::new(surface.position[3], surface.normal[3]), &mapping)
    });
    let is_flat = slopes == Vec2::ZERO && (settings.filter == Filter::Bilinear || beside == [Vec2::ZERO; 2]);
    if is_flat {
        return Ok(smooth());
    }
    let normal = turned_normal(at.normal, &tangent, slopes);
    let turned_by = match settings.filter {
        Filter::Bilinear => *by,
        Filter::Footprint => [0, 1].map(|k| {
            let neighbour = turned_normal((at.normal + by[k].normal).normalize_or(at.normal), &tangent, beside[k]);
            Sight { normal: neighbour - normal, ..by[k] }
        }),
    };
    let turned = mirrored(&Sight { normal, ..*at }, &turned_by);
    let leaves = turned.direction.dot(at.normal) > 0.0;
    Ok(Reflecting { normal, mirrored: if leaves { turned } else { mirrored(at, by) } })
}
