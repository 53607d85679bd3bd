//! The tracer: a scene made ready for rays, and the questions about geometry.

use std::cell::RefCell;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use thiserror::Error;

use super::bvh::Bvh;
use super::lights::Lights;
use super::low_discrepancy::SampleSequence;
use super::path::{Look, Once, PathTracer, World};
use super::render::TraceSettings;
use super::surfaces::{self, Bumps, Reflectance, SurfacePoint, SurfaceTriangle, TexelGrid};
use super::traverse::Stack;
use super::warp::even_directions;
use crate::geometry::{Mapping, NormalMap, Ray};
use crate::radiometry::brdf::BrdfModel;
use crate::radiometry::dielectric::Dielectric;
use crate::scenes::{Albedo, Environment, Material, Relighting, Scene};

/// How one chosen object looks, whatever its material says.
#[derive(Debug, Clone, PartialEq)]
pub enum Appearance {
    /// Its own material.
    AsAuthored,
    /// Lambertian: its own albedo; of a mirror or GGX material its reflectance, of a glossy one R_s + (1 − R_s) R_d, of another what it
    /// reflects of light along the normal.
    Diffuse,
    /// A camera ray that hits the object sees mirror reflections over the scene in which the object is `Diffuse`: what an offset surface
    /// light field should converge to. They cost no bounce, so the last reflected ray sees what a cube map with the same settings holds. Cube
    /// maps, irradiance and all other rays see `Diffuse`.
    Mirrors(Mirrors),
    /// The same with any BRDF: ∫ f(wo, wi) L(wi) cos θ dωi over the scene in which the object is `Diffuse`, as the camera ray sees it.
    /// Its +X lies along the texture's u.
    OneGlossy {
        /// All of it, a diffuse part too.
        brdf: BrdfModel,
    },
    /// A camera ray that hits the object is reflected outside, or goes through (`Dielectric::passage`) and leaves into the scene in which the
    /// object is `Diffuse`: what refraction in an offset surface light field should converge to. Costs no bounce.
    OneRefraction {
        /// The body that the object's surface is of.
        dielectric: Dielectric,
    },
    /// A perfect mirror at every hit.
    PhysicalMirror {
        /// In [0, 1] per channel.
        reflectance: Vec3,
    },
    /// The BRDF at every hit.
    PhysicalGlossy {
        /// All of it.
        brdf: BrdfModel,
    },
}

/// How an object mirrors, itself too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mirrors {
    /// In [0, 1] per channel, of each reflection.
    pub reflectance: Vec3,
    /// One after the other, at most; at least 1. The last one, or one that shows its back, shows the object diffuse.
    pub reflections: u32,
    /// In those between.
    pub under: Under,
}

/// What shows through an object's mirror.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Under {
    /// It is nothing but a mirror.
    Nothing,
    /// The diffuse object: radiances are added.
    Diffuse,
}

impl Mirrors {
    /// A single reflection.
    pub fn one(reflectance: Vec3) -> Self {
        Self { reflectance, reflections: 1, under: Under::Nothing }
    }
}

/// A scene ready for rays. Cheap to clone, free of locks; keeps nothing borrowed from the scene.
#[derive(Debug, Clone)]
pub struct Tracer {
    pub(super) world: Arc<World>,
    pub(super) look: Arc<Look>,
    authored: Arc<Vec<Reflectance>>,
}

/// Why a scene cannot be traced.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum TraceError {
    /// Nothing to hit.
    #[error("scene has no triangles")]
    Empty,
    /// More triangles than the tree can name.
    #[error("scene has {triangles} triangles, at most {limit} expected", limit = Tracer::MAX_TRIANGLES)]
    TooManyTriangles {
        /// How many it has.
        triangles: usize,
    },
    /// An object names a material, or a material a texture, that is not there.
    #[error("object \"{object}\" names a material or texture that the scene does not have")]
    UnknownMaterial {
        /// The object's name.
        object: String,
    },
    /// A position, normal or texture coordinate is NaN or infinite, or an index names no vertex.
    #[error("object \"{object}\" has a vertex that is not finite or an index beyond its vertices")]
    BadMesh {
        /// The object's name.
        object: String,
    },
}

/// Where a ray met a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// From the ray's origin, in scene units.
    pub distance: f32,
    /// World space; closer to the surface than `ray.at(distance)`.
    pub position: Vec3,
    /// Unit, on the side that the shading normals point to (not turned toward the ray).
    pub geometric_normal: Vec3,
    /// Unit, interpolated, as stored (not turned toward the ray).
    pub shading_normal: Vec3,
    /// Texture coordinates; on a patch, its (u, v).
    pub uv: Vec2,
    /// Index into `Scene::objects`.
    pub object: usize,
    /// Index into that object's `mesh.triangles`.
    pub triangle: usize,
}

impl Tracer {
    /// Leaves are named by 31 bits, and splitting long triangles may multiply them.
    pub const MAX_TRIANGLES: usize = 1 << 28;

    /// Builds the tree and copies what shading needs. Deterministic.
    pub fn new(scene: &Scene) -> Result<Self, TraceError> {
        check(scene)?;
        let mut brdfs = Vec::new();
        let by_material: Vec<Reflectance> = scene.materials.iter().map(|m| Reflectance::new(m, &mut brdfs)).collect();
        let reflectance: Vec<Reflectance> = scene.objects.iter().map(|o| by_material[o.material]).collect();
        let textures = scene.textures.iter().map(TexelGrid::new).collect();
        let triangles = surfaces::flatten(scene);
        let lights = Lights::new(scene, &triangles, bounding_radius(&triangles));
        let bvh = Arc::new(build_tree(&triangles));
        let world = World { bvh, extent: extent(&triangles), triangles: triangles.into(), textures, lights };
        let authored = Arc::new(reflectance);
        Ok(Self { world: Arc::new(world), look: Arc::new(Look::authored(authored.to_vec(), brdfs)), authored })
    }

    /// The same scene with one object looking otherwise; other objects keep the look they have here. An object that the scene
    /// does not have changes nothing. Shares everything large.
    pub fn with_appearance(&self, object: usize, appearance: Appearance) -> Self {
        let mut look = (*self.look).clone();
        if let Some(authored) = self.authored.get(object).copied() {
            look.once[object] = None;
            look.reflectance[object] = match appearance {
                Appearance::AsAuthored => authored,
                Appearance::Diffuse => authored.diffuse(),
                Appearance::Mirrors(mirrors) => {
                    look.once[object] = Some(Once::Mirror(mirrors));
                    authored.diffuse()
                }
                Appearance::OneGlossy { brdf } => {
                    look.brdfs.push(brdf);
                    look.once[object] = Some(Once::Glossy(look.brdfs.len() - 1));
                    authored.diffuse()
                }
                Appearance::OneRefraction { dielectric } => {
                    look.once[object] = Some(Once::Clear(dielectric));
                    authored.diffuse()
                }
                Appearance::PhysicalGlossy { brdf } => Reflectance::glossy(brdf, &mut look.brdfs),
                Appearance::PhysicalMirror { reflectance } => Reflectance::Mirror(reflectance),
            };
        }
        Self { world: self.world.clone(), look: Arc::new(look), authored: self.authored.clone() }
    }

    /// The same scene with a normal map on one object, where that is a mirror or is seen otherwise by camera rays alone; Lambertian surfaces
    /// stay as they are. A mirror's ray that would enter the surface leaves as if there were no map, nor an interpolated normal; what of a
    /// glossy lobe would is lost. An object that the scene does not have changes nothing.
    pub fn with_normal_map(&self, object: usize, map: Arc<NormalMap>, mapping: Mapping) -> Self {
        let mut look = (*self.look).clone();
        if let Some(bumps) = look.bumps.get_mut(object) {
            *bumps = Some(Bumps { map, mapping });
        }
        Self { world: self.world.clone(), look: Arc::new(look), authored: self.authored.clone() }
    }

    /// The same scene without one object's surface and emission; indices of the others stay. Builds a new tree. A scene whose
    /// only object is removed is empty space under its sky and point lights.
    pub fn without_object(&self, object: usize) -> Self {
        let triangles: Vec<SurfaceTriangle> = self.world.triangles.iter().filter(|t| t.object as usize != object).cloned().collect();
        let lights = self.world.lights.for_triangles(&triangles, bounding_radius(&triangles));
        let bvh = Arc::new(build_tree(&triangles));
        let world = World { bvh, extent: extent(&triangles), triangles: triangles.into(), textures: self.world.textures.clone(), lights };
        Self { world: Arc::new(world), look: self.look.clone(), authored: self.authored.clone() }
    }

    /// The same scene in other light: `environment` is the one that this was made with. Shares everything large but the sky's tables.
    pub fn relit(&self, environment: &Environment, light: &Relighting) -> Self {
        if !light.changes_light() {
            return self.clone();
        }
        let World { bvh, triangles, textures, lights, extent } = &*self.world;
        let lights = lights.relit(&light.environment(environment), light.point_lights(), triangles, bounding_radius(triangles));
        let world = World { bvh: bvh.clone(), triangles: triangles.clone(), textures: textures.clone(), lights, extent: *extent };
        Self { world: Arc::new(world), look: self.look.clone(), authored: self.authored.clone() }
    }

    /// Nearest surface in (0, `t_max`) along the ray.
    pub fn intersect(&self, ray: &Ray, t_max: f32) -> Option<Hit> {
        let hit = with_stack(|stack| self.world.bvh.nearest(ray.origin, ray.direction, t_max, stack))?;
        Some(Hit::new(SurfacePoint::new(&self.world.triangles, hit)))
    }

    /// Whether any surface crosses the open segment from `a` to `b`. Points on a surface must be moved off it by the caller.
    pub fn occluded(&self, a: Vec3, b: Vec3) -> bool {
        with_stack(|stack| self.world.bvh.any(a, b - a, 1.0, stack))
    }

    /// Whether a point lies inside a body: around which one object's surface winds more than `INSIDE_WINDING` times (generalised
    /// winding number, Jacobson et al. 2013, along evenly spread directions). Holes are forgiven (an open pot, intersecting
    /// patches), single sheets have no inside, and normals must point outward. A sample point inside sees only the back of things.
    pub fn is_inside_geometry(&self, point: Vec3) -> bool {
        self.winding_numbers(point).iter().any(|w| *w > INSIDE_WINDING)
    }

    /// How often each object winds around a point: 1 inside a closed surface with outward normals, 0 outside, in between near
    /// open ones, −1 inside one with inward normals.
    fn winding_numbers(&self, point: Vec3) -> Vec<f32> {
        let mut stack = Stack::new();
        let mut crossings = vec![0i32; self.authored.len()];
        for direction in even_directions(WINDING_DIRECTIONS) {
            for triangle in self.world.bvh.every(point, direction, &mut stack) {
                let triangle = &self.world.triangles[triangle as usize];
                // Leaving through a front face counts up, entering counts down.
                crossings[triangle.object as usize] += if triangle.front.dot(direction) > 0.0 { 1 } else { -1 };
            }
        }
        crossings.iter().map(|c| *c as f32 / WINDING_DIRECTIONS as f32).collect()
    }

    /// Irradiance on one side of a surface element: at `point`, from the half space of `normal` (unit). Mean of `samples` paths
    /// (at least one); `settings.samples_per_pixel` is not used. Holds emitters seen directly and light of up to
    /// `settings.max_bounces` reflections. `point` may lie on a surface: paths start off it by the rounding error of the scene's coordinates.
    pub fn irradiance(&self, point: Vec3, normal: Vec3, samples: u32, settings: &TraceSettings) -> Vec3 {
        let mut paths = self.paths(settings.max_bounces);
        let position = point + surfaces::rounding_at(point, self.world.extent) * normal;
        // The place itself seeds the numbers: neighbours of a bake get different ones in any order.
        let place = point.to_array().iter().fold(0u64, |h, c| h.rotate_left(21) ^ u64::from(c.to_bits()));
        let samples = samples.max(1);
        let mut sum = Vec3::ZERO;
        for first in (0..samples).step_by(PATHS_AT_ONCE) {
            paths.clear();
            for sample in first..samples.min(first + PATHS_AT_ONCE as u32) {
                paths.push_element(position, normal, SampleSequence::new(settings.seed, place, sample));
            }
            paths.trace();
            sum += paths.radiance().sum::<Vec3>();
        }
        sum / samples as f32
    }

    pub(super) fn paths(&self, max_bounces: u32) -> PathTracer<'_> {
        PathTracer::new(&self.world, &self.look, max_bounces)
    }
}

/// The thread's own stack: a single ray is asked for too often to allocate.
fn with_stack<T>(ask: impl FnOnce(&mut Stack) -> T) -> T {
    thread_local! {
        static STACK: RefCell<Stack> = RefCell::new(Stack::new());
    }
    STACK.with_borrow_mut(ask)
}

// Paths of an irradiance that go side by side: what they carry fits the second-level cache.
const PATHS_AT_ONCE: usize = 4096;

/// Directions of the winding number: its error at an open surface is then about 0.02.
const WINDING_DIRECTIONS: u32 = 128;

// ½ is the value just below an endless open floor; an open pot winds 0.8 around its inside.
const INSIDE_WINDING: f32 = 0.6;

impl Hit {
    fn new(point: SurfacePoint) -> Self {
        let SurfacePoint { triangle, u, v, distance } = point;
        Self {
            distance,
            position: triangle.position(u, v),
            geometric_normal: triangle.front,
            shading_normal: triangle.shading_normal(u, v),
            uv: triangle.uv(u, v),
            object: triangle.object as usize,
            triangle: triangle.triangle as usize,
        }
    }
}

fn build_tree(triangles: &[SurfaceTriangle]) -> Bvh {
    let corners: Vec<[Vec3; 3]> = triangles.iter().map(|t| t.corners).collect();
    Bvh::build(&corners)
}

/// Half the diagonal of the geometry's bounding box.
fn bounding_radius(triangles: &[SurfaceTriangle]) -> f32 {
    let corners = triangles.iter().flat_map(|t| t.corners);
    let (low, high) = corners.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
    if triangles.is_empty() { 0.0 } else { 0.5 * (high - low).length() }
}

/// Largest absolute coordinate.
fn extent(triangles: &[SurfaceTriangle]) -> f32 {
    triangles.iter().flat_map(|t| t.corners).fold(0f32, |m, p| m.max(p.abs().max_element()))
}

/// Loaders promise a valid scene; one built by hand may not be.
fn check(scene: &Scene) -> Result<(), TraceError> {
    let triangles: usize = scene.objects.iter().map(|o| o.mesh.triangles.len()).sum();
    if triangles == 0 {
        return Err(TraceError::Empty);
    }
    if triangles > Tracer::MAX_TRIANGLES {
        return Err(TraceError::TooManyTriangles { triangles });
    }
    for object in &scene.objects {
        let texture_known = |map: &Albedo| match map {
            Albedo::Constant(_) => true,
            Albedo::Texture(texture) => *texture < scene.textures.len(),
        };
        let texture_known = match scene.materials.get(object.material) {
            Some(Material::Diffuse { albedo }) => texture_known(albedo),
            Some(Material::Glossy { diffuse, specular, roughness }) => [diffuse, specular, roughness].into_iter().all(texture_known),
            material => material.is_some(),
        };
        if !texture_known {
            return Err(TraceError::UnknownMaterial { object: object.name.clone() });
        }
        let mesh = &object.mesh;
        let count = mesh.positions.len().min(mesh.normals.len()).min(mesh.uvs.len());
        let finite = mesh.positions.iter().chain(&mesh.normals).all(|v| v.is_finite()) && mesh.uvs.iter().all(|v| v.is_finite());
        if !finite || mesh.triangles.iter().flatten().any(|i| *i as usize >= count) {
            return Err(TraceError::BadMesh { object: object.name.clone() });
        }
    }
    Ok(())
}
