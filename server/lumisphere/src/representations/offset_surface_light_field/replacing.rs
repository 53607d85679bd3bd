//! Another object where one was captured: the light field of a new object, made from the stored light of an old one's, without the scene and
//! without paths through it. Called by jobs.
//!
//! A texel of a new cube map shows, along a ray, what is met first among the new object and what was around the old one (`Background`):
//! - the new object: `ρ/π · E`, E baked at its vertices from the stored light and shadowed by itself (`stage.rs`);
//! - the surroundings: their radiance as the old light field holds it (`surroundings.rs`), never from texels that show the old object, and with
//!   the new one's shadow in place of the old one's (`changed_light.rs`);
//! - nothing: the environment.
//!
//! Everything else, placing, coarser levels, sample maps, is what `construct.rs` does. Texels whose rays miss everything are infinitely far, so the
//! shares of the sky that frames in other light ask for are those of the new object.
//!
//! Wrong by construction: the light that the old object reflected stays on what was around it, the new one reflects none there; point lights are not
//! stored: they do not light the new object, and their shadows stay the old one's; what is not diffuse is seen as from another place, in the old light.

mod changed_light;
mod old_object;
mod stage;
mod surroundings;

use std::ops::Range;

use glam::{Quat, Vec2, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

use super::construct::{ConstructError, check_epsilon, points_off, sample_maps_of, within};
use super::density::Density;
use super::relight::environment_over;
use super::{OffsetSurfaceLightField, Parameters, Placing, Replaced, Spacing, to_parts};
use crate::capture::{Background, CaptureError, SurfaceMesh, coarser_levels, store_cube_maps};
use crate::directions::{CubeMap, FACES, Texel, texel_direction};
use crate::geometry::{MeshError, Ray, TriangleMesh};
use crate::progress::{Cancelled, Progress};
use crate::raytrace::{Tracer, texture_bytes, working_bytes};
use crate::representations::{CountingSource, Original, PageSource, RenderError};
use crate::scenes::{Albedo, Material, Object, Scene, Surface};
use crate::textures::{Codec, PixelFormat, Staging};

use changed_light::ChangedLight;
use stage::{Stage, unlit};
pub use surroundings::Surrounding;
use surroundings::{LightReader, Source, Surroundings};

/// The order in which surroundings are looked up that shows them best (docs/measurements.md, "Another object in the same light"): what is diffuse as it
/// is baked, under its own texture; anything else as a cube map saw it.
pub const BAKED_FIRST: [Surrounding; 3] = [Surrounding::Background, Surrounding::CubeMaps, Surrounding::Baseline];

/// Of the new baseline: the old one's light is that without any object.
const BASELINE_FIRST: [Surrounding; 3] = [Surrounding::Baseline, Surrounding::CubeMaps, Surrounding::Background];

/// Most rays of a texel.
const MOST_RAYS: u32 = 1024;
/// Texels along a tile's edge, which are looked up at the same sample points.
const TILE: usize = 8;
/// Texels along a face's edge, of which is told where their light came from.
const TOLD: usize = 8;

/// What to put where, and how to store it. Lengths are in the light field's scene's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplaceSettings {
    /// Name of the new object in its scene.
    pub object: String,
    /// Where it stands.
    pub placement: Placement,
    /// What the parameters call the light field that is read.
    pub light: String,
    /// Distance of the sample points from the surface; None: half the distance between neighbouring sample points.
    pub epsilon: Option<f32>,
    /// How densely sample points lie.
    pub spacing: Spacing,
    /// Texels along a cube-map face.
    pub face_size_texels: u32,
    /// Texels along a sample map.
    pub sample_map_size_texels: u32,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
    /// Rays per texel, made a square number: 1 to 1024.
    pub rays_per_texel: u32,
    /// Where surroundings are looked up first; [`BAKED_FIRST`].
    pub order: [Surrounding; 3],
    /// Bytes that the new object and its surroundings may take while rays are traced.
    pub scene_bytes: u64,
}

/// Where the new object stands: grown and turned about its foot, the middle of its bounds' lowest side, and moved with that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Where the foot comes to lie; None: where its scene has it.
    pub stand_at: Option<Vec3>,
    /// About +Y.
    pub turn_deg: f32,
    /// Above 0.
    pub scale: f32,
}

impl Placement {
    /// As in its scene.
    pub const NONE: Self = Self { stand_at: None, turn_deg: 0.0, scale: 1.0 };

    /// Of a mesh that stands so.
    pub fn bounds(&self, mesh: &TriangleMesh) -> (Vec3, Vec3) {
        self.place(mesh).map_or_else(|_| mesh.bounds(), |placed| placed.bounds())
    }

    fn place(&self, mesh: &TriangleMesh) -> Result<TriangleMesh, MeshError> {
        if *self == Self::NONE {
            return Ok(mesh.clone());
        }
        let (low, high) = mesh.bounds();
        let foot = Vec3::new(0.5 * (low.x + high.x), low.y, 0.5 * (low.z + high.z));
        let (turn, to) = (Quat::from_rotation_y(self.turn_deg.to_radians()), self.stand_at.unwrap_or(foot));
        let positions = mesh.positions.iter().map(|p| to + turn * (self.scale * (*p - foot))).collect();
        let normals = mesh.normals.iter().map(|n| turn * *n).collect();
        TriangleMesh::new(positions, normals, mesh.uvs.clone(), mesh.triangles.clone())
    }
}

/// Why no light field came of it.
#[derive(Debug, Error)]
pub enum ReplaceError {
    /// The object reflects in a way that stored irradiance does not tell.
    #[error("object {object:?} is not diffuse, a diffuse albedo expected")]
    NotDiffuse {
        /// As given.
        object: String,
    },
    /// Some of it lies where nothing was captured.
    #[error("object {object:?} reaches from {} to {} along {axis}, within {} to {} expected, where light was captured", found.start, found.end, expected.start, expected.end)]
    Outside {
        /// As given.
        object: String,
        /// "x", "y" or "z".
        axis: &'static str,
        /// Of the object.
        found: Range<f32>,
        /// Of the sample points and the old object.
        expected: Range<f32>,
    },
    /// A placement that leaves nothing of the mesh.
    #[error("object {object:?} cannot be placed so: {source}")]
    Placement {
        /// As given.
        object: String,
        /// Why.
        source: MeshError,
    },
    /// It and its surroundings take too much memory.
    #[error(
        "the object and what is around it would take about {bytes} bytes of memory while rays are traced, at most {limit_bytes} expected"
    )]
    TooLarge {
        /// An estimate.
        bytes: u64,
        /// As given.
        limit_bytes: u64,
    },
    /// As of any light field.
    #[error(transparent)]
    Construct(#[from] ConstructError),
    /// The stored light cannot be read.
    #[error(transparent)]
    Render(#[from] RenderError),
}

impl From<CaptureError> for ReplaceError {
    fn from(error: CaptureError) -> Self {
        Self::Construct(error.into())
    }
}

impl From<Cancelled> for ReplaceError {
    fn from(cancelled: Cancelled) -> Self {
        Self::Construct(cancelled.into())
    }
}

/// Where the light of the new cube maps came from, each a part of all texels: of 8² a face, so that what another attempt has stored is told, too.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Shares {
    /// The new object.
    pub object: f64,
    /// Infinity.
    pub environment: f64,
    /// Cube maps of the old sample points.
    pub cube_maps: f64,
    /// The one taken without the old object.
    pub baseline: f64,
    /// Baked light.
    pub background: f64,
    /// Nowhere: black.
    pub unknown: f64,
}

impl Shares {
    fn add(&mut self, source: Source, part: f64) {
        *match source {
            Source::Object => &mut self.object,
            Source::Infinity => &mut self.environment,
            Source::Light(Surrounding::CubeMaps) => &mut self.cube_maps,
            Source::Light(Surrounding::Baseline) => &mut self.baseline,
            Source::Light(Surrounding::Background) => &mut self.background,
            Source::Unknown => &mut self.unknown,
        } += part;
    }
}

/// Fills `staging` with pages and parts of the light field of `scene`'s object in the light of `field`; the caller publishes. Of the scene nothing
/// but the object's mesh, parts and albedo is used. Can be called again on a staging area that an earlier, identical call left unfinished.
pub fn replace(
    (field, source): (&OffsetSurfaceLightField, &dyn PageSource),
    scene: &Scene,
    settings: &ReplaceSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<(Parameters, Shares), ReplaceError> {
    check(settings)?;
    let (object, albedo) = find(scene, &settings.object)?;
    let surface = placed(object, settings)?;
    within_the_volume(field, &surface.mesh, &settings.object)?;
    let (low, high) = surface.mesh.bounds();
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).length());

    progress.report("placing sample points", 0, 1);
    let dark = dark_scene(&field.background, &object.name, &surface.mesh);
    let texture = match albedo {
        Albedo::Texture(t) => Some(&scene.textures[t]),
        Albedo::Constant(_) => None,
    };
    let bytes = working_bytes(&dark) + texture_bytes(field.background.textures.iter().chain(texture));
    if bytes > settings.scene_bytes {
        return Err(ReplaceError::TooLarge { bytes, limit_bytes: settings.scene_bytes });
    }
    let tracer = Tracer::new(&dark).map_err(ConstructError::from)?;
    drop(dark);
    let (sample_points, epsilon) = points_off(&surface, (settings.spacing, &Density::uniform()), settings.epsilon, &tracer)?;
    progress.report("placing sample points", 1, 1);

    let pages = CountingSource::new(source);
    let surroundings = Surroundings::new(field, &pages, progress)?;
    let Parameters { max_bounces, seed, .. } = field.parameters;
    let changed = {
        let old = dark_scene(&field.background, &field.parameters.object, &field.surface.mesh);
        let old = Tracer::new(&old).map_err(ConstructError::from)?;
        ChangedLight::new(&field.background, (&old, &tracer), seed, progress)?
    };
    let background = changed.background.clone();
    let fine = unlit(&surface.mesh, albedo, radius);
    let fine_mesh = fine.mesh.clone();
    let mut with_object = Stage::with_object(changed, fine, texture);
    with_object.light_object(&fine_mesh, &tracer, &surroundings, (max_bounces, seed), progress)?;
    let without_object = Stage::empty(&field.background, &surface.mesh);

    let filling = Filling {
        surroundings: &surroundings,
        background: &field.background,
        size: settings.face_size_texels as usize,
        steps: rays_along_an_edge(settings.rays_per_texel),
    };
    let viewpoint = |k: usize| match sample_points.get(k) {
        Some(point) => (&with_object, settings.order, point.position),
        // As captures are: in the light without any object.
        None => (&without_object, BASELINE_FIRST, center),
    };
    let count = sample_points.len() + 1;
    let fill = |k: usize| filling.cube_map(viewpoint(k), progress);
    let format = (settings.codec, settings.pixel_format);
    store_cube_maps(count, settings.face_size_texels, format, &fill, staging, ("filling cube maps", progress))?;
    let shares = filling.shares(count, &viewpoint, progress)?;

    let sample_maps = sample_maps_of(&surface, &sample_points, (epsilon, settings.sample_map_size_texels), &tracer, progress);
    let parameters = Parameters {
        object: settings.object.clone(),
        epsilon,
        face_size_texels: settings.face_size_texels,
        coarser_levels: coarser_levels(settings.face_size_texels),
        sample_map_size_texels: settings.sample_map_size_texels,
        spacing: settings.spacing,
        placing: Placing::Uniform,
        object_center: center.to_array(),
        samples_per_texel: (filling.steps * filling.steps) as u32,
        max_bounces,
        seed,
        original: Original::Diffuse,
        thinned_from: None,
        replaced: Some(Replaced { object: field.parameters.object.clone(), light: settings.light.clone() }),
    };
    let made = OffsetSurfaceLightField { parameters, surface, sample_points, sample_maps, background };
    for (name, bytes) in to_parts(&made).map_err(ConstructError::from)? {
        staging.put_blob(name, &bytes).map_err(ConstructError::from)?;
    }
    Ok((made.parameters, shares))
}

fn check(settings: &ReplaceSettings) -> Result<(), ConstructError> {
    within("face size", settings.face_size_texels, 4, 1024, "4 to 1024 texels")?;
    within("sample map size", settings.sample_map_size_texels, 1, 1024, "1 to 1024 texels")?;
    within("rays per texel", settings.rays_per_texel, 1, MOST_RAYS, "1 to 1024")?;
    check_epsilon(settings.epsilon)?;
    let Placement { stand_at, turn_deg, scale } = settings.placement;
    let setting = |setting, value: String, expected| ConstructError::Setting { setting, value, expected };
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(setting("scale", scale.to_string(), "a finite factor above zero"));
    }
    if !turn_deg.is_finite() {
        return Err(setting("turn", turn_deg.to_string(), "finite degrees"));
    }
    match stand_at {
        Some(at) if !at.is_finite() => Err(setting("place", at.to_string(), "finite coordinates")),
        _ => Ok(()),
    }
}

// Squares: texels are divided evenly.
fn rays_along_an_edge(rays: u32) -> usize {
    (1..).find(|n| n * n >= rays as usize).unwrap_or(1)
}

fn find<'s>(scene: &'s Scene, name: &str) -> Result<(&'s Object, Albedo), ReplaceError> {
    let index = scene.object(name).ok_or_else(|| ConstructError::UnknownObject {
        object: name.into(),
        known: scene.objects.iter().map(|o| o.name.clone()).collect(),
    })?;
    let object = &scene.objects[index];
    match &scene.materials[object.material] {
        Material::Diffuse { albedo } => Ok((object, *albedo)),
        Material::Mirror { .. } | Material::Ggx { .. } | Material::Glossy { .. } | Material::Brdf(_) => {
            Err(ReplaceError::NotDiffuse { object: name.into() })
        }
    }
}

fn placed(object: &Object, settings: &ReplaceSettings) -> Result<SurfaceMesh, ReplaceError> {
    let surface = SurfaceMesh::of(object);
    let mesh = settings.placement.place(&surface.mesh);
    let mesh = mesh.map_err(|source| ReplaceError::Placement { object: settings.object.clone(), source })?;
    // Slivers may be gone by rounding, and their parts with them; order stays.
    let mut left = mesh.triangles.iter().peekable();
    let parts = surface.mesh.triangles.iter().zip(&surface.part_of_triangle);
    let part_of_triangle = parts.filter(|(t, _)| left.next_if_eq(t).is_some()).map(|(_, part)| *part).collect();
    Ok(SurfaceMesh { mesh, part_of_triangle, parts: surface.parts })
}

/// Light is known where sample points are, and where the old object itself was.
fn within_the_volume(field: &OffsetSurfaceLightField, mesh: &TriangleMesh, object: &str) -> Result<(), ReplaceError> {
    let (low, high) = field.sample_points.iter().fold(field.surface.mesh.bounds(), |(l, h), p| (l.min(p.position), h.max(p.position)));
    let (found_low, found_high) = mesh.bounds();
    for (at, axis) in ["x", "y", "z"].into_iter().enumerate() {
        // Rounding of a foot that stands where the old one stood.
        let slack = 1e-5 * (high[at] - low[at]);
        if !(found_low[at] >= low[at] - slack && found_high[at] <= high[at] + slack) {
            let (found, expected) = (found_low[at]..found_high[at], low[at]..high[at]);
            return Err(ReplaceError::Outside { object: object.into(), axis, found, expected });
        }
    }
    Ok(())
}

/// The surroundings and the object, black: for questions about geometry and for light straight from where it is emitted.
fn dark_scene(background: &Background, object: &str, mesh: &TriangleMesh) -> Scene {
    let black = |name: String, mesh: &TriangleMesh, emission: Vec3| Object {
        name,
        mesh: mesh.clone(),
        surface: Surface::Mesh,
        material: 0,
        emission: (emission != Vec3::ZERO).then_some(emission),
    };
    let around = background.surfaces.iter().enumerate();
    let mut objects: Vec<Object> = around.map(|(i, s)| black(format!("surface {i}"), &s.mesh, s.emission)).collect();
    objects.push(black(object.into(), mesh, Vec3::ZERO));
    Scene {
        name: String::new(),
        objects,
        materials: vec![Material::Diffuse { albedo: Albedo::Constant(Vec3::ZERO) }],
        textures: Vec::new(),
        point_lights: Vec::new(),
        environment: background.environment.clone(),
        cameras: Vec::new(),
        notes: Vec::new(),
    }
}

/// From where a cube map is taken: what is around it, where that is looked up first, and its place.
type View<'a> = (&'a Stage, [Surrounding; 3], Vec3);

/// How cube maps are filled.
struct Filling<'a> {
    surroundings: &'a Surroundings<'a>,
    background: &'a Background,
    size: usize,
    /// Rays along a texel's edge.
    steps: usize,
}

/// What sample points are asked for in a tile, by the proxy that they are asked about.
struct Asked<'p> {
    pool: &'p [u16],
    by_proxy: Vec<(u32, Vec<u16>)>,
}

impl Filling<'_> {
    fn cube_map(&self, from: View<'_>, progress: &dyn Progress) -> Result<CubeMap, ReplaceError> {
        let pool = self.surroundings.pool(from.2);
        let across = self.size.div_ceil(TILE);
        let tile = |light: &mut LightReader<'_>, number: usize| {
            if progress.is_cancelled() {
                return Err(ReplaceError::from(Cancelled));
            }
            let mut asked = Asked { pool: &pool, by_proxy: Vec::new() };
            let mut texels = Vec::with_capacity(TILE * TILE);
            for at in self.tile(number) {
                texels.push(self.texel(from, at, &mut asked, light, &mut |_| ())?);
            }
            Ok(texels)
        };
        let tiles: Vec<_> = (0..FACES * across * across)
            .into_par_iter()
            .map_init(|| self.surroundings.reader(), tile)
            .collect::<Result<_, ReplaceError>>()?;
        let mut cube = CubeMap::black(self.size);
        for (number, texels) in tiles.into_iter().enumerate() {
            for (at, texel) in self.tile(number).zip(texels) {
                let index = cube.index(at);
                cube.texels[index] = texel;
            }
        }
        Ok(cube)
    }

    /// The texels of a tile: tiles lie row by row, face by face.
    fn tile(&self, number: usize) -> impl Iterator<Item = Texel> + use<> {
        let across = self.size.div_ceil(TILE);
        let (face, top, left) = (number / across / across, number / across % across * TILE, number % across * TILE);
        let (bottom, right) = ((top + TILE).min(self.size), (left + TILE).min(self.size));
        (top..bottom).flat_map(move |row| (left..right).map(move |column| Texel { face, column, row }))
    }

    /// Mean radiance over the texel, and how far what is at its centre is; `told` is told where every ray's light came from.
    fn texel(
        &self,
        (stage, order, position): View<'_>,
        at: Texel,
        asked: &mut Asked<'_>,
        light: &mut LightReader<'_>,
        told: &mut dyn FnMut(Source),
    ) -> Result<[f32; 4], ReplaceError> {
        let toward = |x: f32, y: f32| texel_direction(at.face, self.size, at.column as f32 + x, at.row as f32 + y);
        let angle = 2.0 / (self.size * self.steps) as f32;
        let (mut sum, mut missed) = (Vec3::ZERO, 0);
        for k in 0..self.steps * self.steps {
            let place = (Vec2::new((k % self.steps) as f32, (k / self.steps) as f32) + 0.5) / self.steps as f32;
            let ray = Ray { origin: position, direction: toward(place.x, place.y) };
            let Some(met) = stage.look(ray, angle, light.stack()) else {
                missed += 1;
                told(Source::Infinity);
                continue;
            };
            let (radiance, source) = if met.is_object {
                (met.radiance, Source::Object)
            } else {
                let known = asked.by_proxy.iter().position(|(proxy, _)| *proxy == met.proxy);
                let found = known.unwrap_or_else(|| {
                    asked.by_proxy.push((met.proxy, self.surroundings.ranked(asked.pool, position, met.position)));
                    asked.by_proxy.len() - 1
                });
                self.surroundings.seen(&met, order, &asked.by_proxy[found].1, light)?
            };
            told(source);
            sum += radiance;
        }
        let rays = (self.steps * self.steps) as f32;
        let mut radiance = sum / rays;
        if missed > 0 {
            radiance += missed as f32 / rays * environment_over(&self.background.environment, self.size, at);
        }
        let central = Ray { origin: position, direction: toward(0.5, 0.5) };
        let distance = stage.look(central, angle, light.stack()).map_or(f32::INFINITY, |met| met.distance);
        Ok([radiance.x, radiance.y, radiance.z, distance])
    }

    fn shares<'v>(
        &self,
        count: usize,
        viewpoint: &(dyn Fn(usize) -> View<'v> + Sync),
        progress: &dyn Progress,
    ) -> Result<Shares, ReplaceError> {
        progress.report("counting shares", 0, 1);
        let told = TOLD.min(self.size);
        let of_cube = |light: &mut LightReader<'_>, k: usize| {
            if progress.is_cancelled() {
                return Err(ReplaceError::from(Cancelled));
            }
            let from = viewpoint(k);
            let pool = self.surroundings.pool(from.2);
            let mut shares = Shares::default();
            for texel in 0..FACES * told * told {
                let place = |c: usize| (2 * c + 1) * self.size / (2 * told);
                let at = Texel { face: texel / told / told, row: place(texel / told % told), column: place(texel % told) };
                let mut asked = Asked { pool: &pool, by_proxy: Vec::new() };
                self.texel(from, at, &mut asked, light, &mut |source| shares.add(source, 1.0))?;
            }
            Ok(shares)
        };
        let cubes: Vec<Shares> =
            (0..count).into_par_iter().map_init(|| self.surroundings.reader(), of_cube).collect::<Result<_, ReplaceError>>()?;
        let rays = (count * FACES * told * told * self.steps * self.steps) as f64;
        let sum = |of: fn(&Shares) -> f64| cubes.iter().map(of).sum::<f64>() / rays;
        Ok(Shares {
            object: sum(|s| s.object),
            environment: sum(|s| s.environment),
            cube_maps: sum(|s| s.cube_maps),
            baseline: sum(|s| s.baseline),
            background: sum(|s| s.background),
            unknown: sum(|s| s.unknown),
        })
    }
}
