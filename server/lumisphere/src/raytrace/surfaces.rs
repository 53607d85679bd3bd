//! The scene's triangles and textures, flattened for shading: one record a triangle, no pointer to follow but one.

use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::traverse::RawHit;
use crate::geometry::{Mapping, NormalMap, Tangent, TriangleMesh, side_of_v, tangent_along_u, turned_normal};
use crate::radiometry::brdf::{AshikhminShirley, BrdfModel, CookTorrance, directional_albedo};
use crate::scenes::{Albedo, Material, Scene, Texture};

/// One triangle with everything shading asks for. Normals and winding may disagree in a file: `front` follows the normals.
#[derive(Debug, Clone)]
pub(super) struct SurfaceTriangle {
    pub corners: [Vec3; 3],
    pub normals: [Vec3; 3],
    pub uvs: [Vec2; 3],
    /// Unit geometric normal on the side that the shading normals point to.
    pub front: Vec3,
    /// How far a ray must start from the surface to be clear of rounding: see `offset_along`.
    pub rounding: f32,
    /// Which object, and which triangle of its mesh.
    pub object: u32,
    pub triangle: u32,
}

/// A normal map on an object.
#[derive(Debug, Clone)]
pub(super) struct Bumps {
    pub map: Arc<NormalMap>,
    pub mapping: Mapping,
}

/// How a surface reflects, ready to evaluate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Reflectance {
    Lambert(Vec3),
    LambertTexture(usize),
    Mirror(Vec3),
    Glossy {
        /// Index into `Look::brdfs`.
        brdf: usize,
        /// Of the Lambertian surface that it becomes when it is made diffuse.
        albedo: Vec3,
    },
    Textured(GlossMaps),
    /// A `Textured` one made diffuse.
    TexturedLambert(GlossMaps),
}

/// What a `Material::Glossy` is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct GlossMaps {
    diffuse: Albedo,
    specular: Albedo,
    roughness: Albedo,
}

/// Texture with its channels side by side: one cache line a footprint row instead of three.
#[derive(Debug, Clone)]
pub(super) struct TexelGrid {
    width: usize,
    height: usize,
    texels: Vec<Vec3>,
}

// Barycentric interpolation of a position rounds by at most a few ULP of the largest coordinate (pbrt-v4 §6.8.4: γ₇); the
// plane test of the triangle itself, over edges as long as twice that, about four times as much. 32 ULP clears both and scale with the scene.
const ROUNDING_ULPS: f32 = 32.0;

impl SurfaceTriangle {
    fn new(mesh: &TriangleMesh, object: usize, triangle: usize) -> Self {
        let [a, b, c] = mesh.triangles[triangle].map(|i| i as usize);
        let corners = mesh.corners(triangle);
        let normals = [mesh.normals[a], mesh.normals[b], mesh.normals[c]];
        let geometric = mesh.area_vector(triangle).normalize_or(normals[0]);
        let front = if geometric.dot(normals[0] + normals[1] + normals[2]) < 0.0 { -geometric } else { geometric };
        let largest = corners.iter().fold(0f32, |m, p| m.max(p.abs().max_element()));
        Self {
            corners,
            normals,
            uvs: [mesh.uvs[a], mesh.uvs[b], mesh.uvs[c]],
            front,
            rounding: ROUNDING_ULPS * f32::EPSILON * largest,
            object: object as u32,
            triangle: triangle as u32,
        }
    }

    /// Point at barycentric weights (1−u−v, u, v).
    #[inline]
    pub fn position(&self, u: f32, v: f32) -> Vec3 {
        let [a, b, c] = self.corners;
        a + u * (b - a) + v * (c - a)
    }

    /// Interpolated unit shading normal, on its stored side.
    #[inline]
    pub fn shading_normal(&self, u: f32, v: f32) -> Vec3 {
        let [a, b, c] = self.normals;
        (a + u * (b - a) + v * (c - a)).normalize_or(self.front)
    }

    /// Interpolated texture coordinates.
    #[inline]
    pub fn uv(&self, u: f32, v: f32) -> Vec2 {
        let [a, b, c] = self.uvs;
        a + u * (b - a) + v * (c - a)
    }

    /// Direction in which the texture's u grows, any length.
    pub fn tangent(&self) -> Vec3 {
        tangent_along_u(self.corners, self.uvs)
    }

    /// The same, and where v grows about the stored side of the shading normals.
    fn tangent_and_side(&self) -> Tangent {
        let [a, b, c] = self.corners;
        let is_wound_about_front = (b - a).cross(c - a).dot(self.front) >= 0.0;
        let side = side_of_v(self.uvs);
        Tangent { along_u: self.tangent(), side_of_v: if is_wound_about_front { side } else { -side } }
    }

    /// `shading_normal` as a map turns it, still on its stored side.
    pub fn bumped_normal(&self, u: f32, v: f32, bumps: &Bumps) -> Vec3 {
        turned_normal(self.shading_normal(u, v), &self.tangent_and_side(), bumps.map.slopes(self.uv(u, v), &bumps.mapping))
    }

    /// Area in squared scene units.
    pub fn area(&self) -> f32 {
        let [a, b, c] = self.corners;
        0.5 * (b - a).cross(c - a).length()
    }
}

/// Where a ray that leaves the surface toward `direction` starts: off the surface by its rounding error, on the side it leaves to.
#[inline]
pub(super) fn offset_along(position: Vec3, normal: Vec3, rounding: f32, direction: Vec3) -> Vec3 {
    position + rounding.copysign(normal.dot(direction)) * normal
}

/// How far a ray must start from a surface of unknown triangle, in a scene whose coordinates reach `extent`.
pub(super) fn rounding_at(position: Vec3, extent: f32) -> f32 {
    ROUNDING_ULPS * f32::EPSILON * position.abs().max_element().max(extent)
}

/// Every triangle of every object, in order.
pub(super) fn flatten(scene: &Scene) -> Vec<SurfaceTriangle> {
    let of_object = |(index, object): (usize, &crate::scenes::Object)| -> Vec<SurfaceTriangle> {
        (0..object.mesh.triangles.len()).map(|t| SurfaceTriangle::new(&object.mesh, index, t)).collect()
    };
    scene.objects.iter().enumerate().flat_map(of_object).collect()
}

impl Reflectance {
    // Below this roughness the microfacet density overflows the precision of f32 directions; the surface is a mirror to the eye.
    const SMOOTHEST: f32 = 1e-3;

    /// Adds the BRDF that it needs, if any, to `brdfs`.
    pub fn new(material: &Material, brdfs: &mut Vec<BrdfModel>) -> Self {
        match material {
            Material::Diffuse { albedo: Albedo::Constant(albedo) } => Self::Lambert(*albedo),
            Material::Diffuse { albedo: Albedo::Texture(texture) } => Self::LambertTexture(*texture),
            Material::Mirror { reflectance } => Self::Mirror(*reflectance),
            Material::Ggx { alpha, reflectance } => match CookTorrance::new(Vec2::splat(*alpha), *reflectance, *reflectance) {
                Ok(brdf) if *alpha > Self::SMOOTHEST => {
                    brdfs.push(brdf.into());
                    Self::Glossy { brdf: brdfs.len() - 1, albedo: *reflectance }
                }
                // Smoother than that, or numbers that no loader lets pass.
                _ => Self::Mirror(*reflectance),
            },
            Material::Glossy { diffuse, specular, roughness } => {
                Self::Textured(GlossMaps { diffuse: *diffuse, specular: *specular, roughness: *roughness })
            }
            Material::Brdf(brdf) => Self::glossy(brdf.clone(), brdfs),
        }
    }

    /// The surface of any BRDF, which is added to `brdfs`. Made diffuse, it reflects what the BRDF does along the normal.
    pub fn glossy(brdf: BrdfModel, brdfs: &mut Vec<BrdfModel>) -> Self {
        const SAMPLES: u32 = 4096;
        let albedo = directional_albedo(&brdf, Vec3::Z, SAMPLES).min(Vec3::ONE);
        brdfs.push(brdf);
        Self::Glossy { brdf: brdfs.len() - 1, albedo }
    }

    /// The Lambertian surface of the same colour.
    pub fn diffuse(self) -> Self {
        match self {
            Self::Mirror(albedo) | Self::Glossy { albedo, .. } => Self::Lambert(albedo),
            Self::Textured(maps) => Self::TexturedLambert(maps),
            lambert => lambert,
        }
    }
}

impl GlossMaps {
    /// The model at a place of the texture.
    pub fn brdf(&self, textures: &[TexelGrid], uv: Vec2) -> AshikhminShirley {
        let [diffuse, specular, roughness] = [self.diffuse, self.specular, self.roughness].map(|map| look_up(map, textures, uv));
        AshikhminShirley::from_texels(diffuse, specular, roughness.truncate())
    }

    /// What it reflects along the normal but for the rims of both lobes: R_s, and R_d of what is left.
    pub fn albedo(&self, textures: &[TexelGrid], uv: Vec2) -> Vec3 {
        let [diffuse, specular] = [self.diffuse, self.specular].map(|map| look_up(map, textures, uv));
        specular + (Vec3::ONE - specular) * diffuse
    }
}

fn look_up(map: Albedo, textures: &[TexelGrid], uv: Vec2) -> Vec3 {
    match map {
        Albedo::Constant(value) => value,
        Albedo::Texture(texture) => textures[texture].sample(uv),
    }
}

impl TexelGrid {
    pub fn new(texture: &Texture) -> Self {
        let image = &texture.image;
        let texels = (0..image.width * image.height).map(|i| Vec3::from(image.rgb(i))).collect();
        Self { width: image.width, height: image.height, texels }
    }

    /// Linear RGB at (u, v), bilinear, repeating: what `Texture::sample` gives.
    pub fn sample(&self, uv: Vec2) -> Vec3 {
        // Coordinates of the sample among texel centres, in [−½, size − ½].
        let x = (uv.x - uv.x.floor()) * self.width as f32 - 0.5;
        let y = (1.0 - uv.y - (1.0 - uv.y).floor()) * self.height as f32 - 0.5;
        let (left, right, fx) = neighbours(x, self.width);
        let (top, bottom, fy) = neighbours(y, self.height);
        let row = |r: usize| self.texels[r * self.width + left].lerp(self.texels[r * self.width + right], fx);
        row(top).lerp(row(bottom), fy)
    }
}

// The two texels around position x ∈ [−½, size − ½] and the share of the second; repeats.
#[inline]
fn neighbours(x: f32, size: usize) -> (usize, usize, f32) {
    let below = x.floor();
    let first = if below < 0.0 { size - 1 } else { (below as usize).min(size - 1) };
    let second = if first + 1 == size { 0 } else { first + 1 };
    (first, second, x - below)
}

/// Barycentric weights and record of a hit.
#[derive(Debug, Clone, Copy)]
pub(super) struct SurfacePoint<'a> {
    pub triangle: &'a SurfaceTriangle,
    pub u: f32,
    pub v: f32,
    pub distance: f32,
}

impl<'a> SurfacePoint<'a> {
    pub fn new(triangles: &'a [SurfaceTriangle], hit: RawHit) -> Self {
        Self { triangle: &triangles[hit.triangle as usize], u: hit.u, v: hit.v, distance: hit.distance }
    }
}
