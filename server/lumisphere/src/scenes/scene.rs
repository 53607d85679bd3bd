//! What a scene is, in memory: everything in world space, colours linear, every index valid (loaders check).

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{BezierPatch, Camera, TriangleMesh};
use crate::images::Image;
use crate::radiometry::brdf::BrdfModel;

/// Geometry, materials, light and cameras.
#[derive(Debug, Clone)]
pub struct Scene {
    /// For people.
    pub name: String,
    /// Surfaces; area lights among them.
    pub objects: Vec<Object>,
    /// Named by `Object::material`.
    pub materials: Vec<Material>,
    /// Named by `Albedo::Texture`.
    pub textures: Vec<Texture>,
    /// Lights without extent.
    pub point_lights: Vec<PointLight>,
    /// Radiance from infinity.
    pub environment: Environment,
    /// Views that the scene's author gave.
    pub cameras: Vec<NamedCamera>,
    /// What the loader left out or replaced, one sentence each, for people; empty for generated scenes.
    pub notes: Vec<String>,
}

/// One surface with one material, two-sided for reflection.
#[derive(Debug, Clone)]
pub struct Object {
    /// Unique within the scene.
    pub name: String,
    /// World space. For patches: their tessellation, whose uv are the patch's own (u, v).
    pub mesh: TriangleMesh,
    /// What parametrises the mesh.
    pub surface: Surface,
    /// Index into `Scene::materials`.
    pub material: usize,
    /// Radiance of a one-sided area light; its front is the side the normals point to.
    pub emission: Option<Vec3>,
}

/// The parametrisation behind a mesh. A *part* is one texture region: a patch, or the whole UV-mapped mesh.
#[derive(Debug, Clone)]
pub enum Surface {
    /// One part, the mesh's own uv in [0, 1]².
    Mesh,
    /// A part each patch, uv = the patch's (u, v); patches in world space, their normals outward.
    Patches {
        /// World space.
        patches: Vec<BezierPatch>,
        /// Which patch each triangle of `Object::mesh` belongs to.
        patch_of_triangle: Vec<u32>,
    },
}

/// How a surface reflects.
#[derive(Debug, Clone, PartialEq)]
pub enum Material {
    /// Lambertian.
    Diffuse {
        /// Reflectance in [0, 1] per channel.
        albedo: Albedo,
    },
    /// Perfect mirror.
    Mirror {
        /// In [0, 1] per channel.
        reflectance: Vec3,
    },
    /// Microfacet conductor without Fresnel term (F = 1), GGX distribution.
    Ggx {
        /// Roughness α in (0, 1].
        alpha: f32,
        /// In [0, 1] per channel.
        reflectance: Vec3,
    },
    /// Ashikhmin & Shirley's model with parameters that may change over the surface: several materials in one.
    Glossy {
        /// R_d, in [0, 1] per channel.
        diffuse: Albedo,
        /// R_s, reflectance at normal incidence, in [0, 1] per channel.
        specular: Albedo,
        /// Red and green: roughness α along the texture's u and v, in [0, 1]. Blue says nothing.
        roughness: Albedo,
    },
    /// Any other; +X of its tangent frame lies along the texture's u.
    Brdf(BrdfModel),
}

/// A constant will do for most surfaces.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Albedo {
    /// The same everywhere.
    Constant(Vec3),
    /// Index into `Scene::textures`.
    Texture(usize),
}

/// Linear RGB by (u, v); v = 0 is the bottom row, repeats, bilinear.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Texture {
    /// Three channels, linear; row 0 is the top.
    pub image: Image,
}

/// Isotropic light at a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointLight {
    /// World space.
    pub position: Vec3,
    /// Radiant intensity, W/sr per channel.
    pub intensity: Vec3,
}

/// Light from infinity.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Environment {
    /// The same radiance from everywhere; zero for none.
    Constant(Vec3),
    /// A measured or generated map.
    Map(EnvironmentMap),
}

/// Latitude–longitude radiance, already scaled; `rotation` turns it about +Y.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct EnvironmentMap {
    /// Three channels, linear, OpenEXR's orientation (`directions::direction_from_lat_long`).
    pub image: Image,
    /// Radians about +Y: the map's direction d lights the world's `rotate_y(rotation) · d`.
    pub rotation: f32,
}

/// A view with a name.
#[derive(Debug, Clone)]
pub struct NamedCamera {
    /// Unique within the scene.
    pub name: String,
    /// Where and how.
    pub camera: Camera,
}

impl Texture {
    /// Linear RGB at (u, v), bilinear, repeating.
    pub fn sample(&self, u: f32, v: f32) -> Vec3 {
        let (w, h) = (self.image.width, self.image.height);
        let (x, y) = (u.rem_euclid(1.0) * w as f32 - 0.5, (1.0 - v).rem_euclid(1.0) * h as f32 - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let texel = |dx: i64, dy: i64| {
            let column = (x0 as i64 + dx).rem_euclid(w as i64) as usize;
            let row = (y0 as i64 + dy).rem_euclid(h as i64) as usize;
            Vec3::from(self.image.rgb(row * w + column))
        };
        texel(0, 0).lerp(texel(1, 0), fx).lerp(texel(0, 1).lerp(texel(1, 1), fx), fy)
    }
}

impl Environment {
    /// Radiance arriving from `direction` (unit, world, away from the receiver), bilinear.
    pub fn radiance(&self, direction: Vec3) -> Vec3 {
        match self {
            Self::Constant(radiance) => *radiance,
            Self::Map(map) => map.radiance(direction),
        }
    }
}

impl EnvironmentMap {
    /// Radiance arriving from `direction` (unit, world), bilinear, wrapping in longitude.
    pub fn radiance(&self, direction: Vec3) -> Vec3 {
        let at = crate::directions::lat_long_from_direction(glam::Quat::from_rotation_y(-self.rotation) * direction);
        let (w, h) = (self.image.width, self.image.height);
        let (x, y) = (at.x * w as f32 - 0.5, (at.y * h as f32 - 0.5).clamp(0.0, h as f32 - 1.0));
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let texel = |dx: i64, dy: i64| {
            let column = (x0 as i64 + dx).rem_euclid(w as i64) as usize;
            let row = (y0 as i64 + dy).min(h as i64 - 1) as usize;
            Vec3::from(self.image.rgb(row * w + column))
        };
        texel(0, 0).lerp(texel(1, 0), fx).lerp(texel(0, 1).lerp(texel(1, 1), fx), fy)
    }
}

impl Scene {
    /// Index of the object of that name.
    pub fn object(&self, name: &str) -> Option<usize> {
        self.objects.iter().position(|o| o.name == name)
    }

    /// Albedo of a diffuse material at (u, v); None for the others.
    pub fn albedo(&self, material: usize, u: f32, v: f32) -> Option<Vec3> {
        match &self.materials[material] {
            Material::Diffuse { albedo: Albedo::Constant(albedo) } => Some(*albedo),
            Material::Diffuse { albedo: Albedo::Texture(t) } => Some(self.textures[*t].sample(u, v)),
            Material::Mirror { .. } | Material::Ggx { .. } | Material::Glossy { .. } | Material::Brdf(_) => None,
        }
    }
}
