//! The scene file's objects: a mesh, patches, a model file or a shape; placed, oriented, with material and emission.

use glam::{Mat4, Vec2, Vec3};

use super::assembly::{Assembly, MAX_TRIANGLES};
use super::error::SceneError;
use super::files::sibling;
use super::json::{Fields, Node};
use super::model;
use super::scene::{Albedo, Material, Surface};
use super::shapes;
use super::tea_set::{self, TeaSet};
use super::tessellate::{MAX_STEPS, Resolution, tessellate};
use super::transform;
use crate::formats::bpt::{self, UpAxis};
use crate::formats::obj;
use crate::geometry::{BezierPatch, MeshError, TriangleMesh};

/// Adds one entry of `objects`.
pub(super) fn add(assembly: &mut Assembly, node: &Node) -> Result<(), SceneError> {
    let fields = node.fields()?;
    let name_node = fields.required("name")?;
    let name = name_node.name()?;
    if !assembly.take_name("object", name) {
        return Err(name_node.duplicate(name));
    }
    let world = fields.optional("transform").map_or(Ok(Mat4::IDENTITY), |n| transform::parse(&n))?;
    let entry = Entry { name, world, fields: &fields };
    let kinds = ["mesh", "patches", "gltf", "shape"].map(|key| fields.optional(key));
    match kinds {
        [Some(mesh), None, None, None] => entry.mesh(assembly, &mesh)?,
        [None, Some(patches), None, None] => entry.patches(assembly, &patches)?,
        [None, None, Some(gltf), None] => model::add_gltf(assembly, &gltf, name, world)?,
        [None, None, None, Some(shape)] => {
            let mesh = shapes::build(&shape, assembly.file, name)?;
            let material = entry.material(assembly)?;
            entry.add_mesh(assembly, mesh, material)?;
        }
        _ => return Err(node.wrong("an object with exactly one of \"mesh\", \"patches\", \"gltf\" or \"shape\"")),
    }
    // A count that other programs note; checked for meshes, where it shows a file that was cut off.
    fields.optional("triangles");
    fields.finish()
}

/// Adds an area light: a shape that shines and reflects nothing. The fields are the shape's, and `radiance`.
pub(super) fn add_area_light(assembly: &mut Assembly, fields: Fields, name: &str, radiance: Vec3) -> Result<(), SceneError> {
    if !assembly.take_name("object", name) {
        return Err(fields.node().duplicate(name));
    }
    let mesh = shapes::build_from(&fields, assembly.file, name)?;
    fields.finish()?;
    let black = assembly.add_material(&format!("{name} (light)"), Material::Diffuse { albedo: Albedo::Constant(Vec3::ZERO) });
    assembly.add_object(name, mesh, Surface::Mesh, black, Some(radiance))
}

struct Entry<'a> {
    name: &'a str,
    world: Mat4,
    fields: &'a Fields<'a>,
}

impl Entry<'_> {
    fn material(&self, assembly: &Assembly) -> Result<usize, SceneError> {
        assembly.material(&self.fields.required("material")?)
    }

    fn emission(&self) -> Result<Option<Vec3>, SceneError> {
        self.fields.optional("emission").map(|n| n.light()).transpose()
    }

    // True when the author wants the other side in front.
    fn flipped(&self) -> Result<bool, SceneError> {
        self.fields.optional("flip").map_or(Ok(false), |n| n.flag())
    }

    fn wrong_geometry(&self, assembly: &Assembly, source: MeshError) -> SceneError {
        SceneError::Geometry { file: assembly.file.to_owned(), object: self.name.to_owned(), source }
    }

    fn add_mesh(&self, assembly: &mut Assembly, mut mesh: TriangleMesh, material: usize) -> Result<(), SceneError> {
        if let Some(scale) = self.fields.optional("uv_scale") {
            let scale = Vec2::from(scale.numbers::<2>()?);
            mesh.uvs.iter_mut().for_each(|uv| *uv *= scale);
        }
        let mesh = transform::place_mesh(transform::wind_by_normals(mesh), self.world).map_err(|e| self.wrong_geometry(assembly, e))?;
        let mesh = if self.flipped()? { transform::turn_inside_out(mesh) } else { mesh };
        assembly.add_object(self.name, mesh, Surface::Mesh, material, self.emission()?)
    }

    // With a material the file is one object; without, the OBJ's own materials cut it into several.
    fn mesh(&self, assembly: &mut Assembly, node: &Node) -> Result<(), SceneError> {
        let path = assembly.beside(node.text()?);
        let broken = |source| SceneError::Format { file: path.clone(), source };
        let file = obj::read(&assembly.read(&path, node)?).map_err(broken)?;
        if let Some(count) = self.fields.optional("triangles") {
            let written = count.count(0..=u32::MAX)? as usize;
            if written != file.triangle_count() {
                return Err(count.wrong(format!("the {} triangles of {path} (is that file complete?)", file.triangle_count())));
            }
        }
        if self.fields.optional("material").is_some() {
            let material = self.material(assembly)?;
            self.add_mesh(assembly, file.mesh().map_err(broken)?, material)
        } else {
            model::add_obj(assembly, node, self.name, self.world, &path, &file)
        }
    }

    fn patches(&self, assembly: &mut Assembly, node: &Node) -> Result<(), SceneError> {
        let mut patches = self.read_patches(assembly, node)?;
        if let Some(first) = self.fields.optional("first_patches") {
            patches.truncate(first.count(1..=patches.len() as u32)? as usize);
        }
        let mut patches = transform::place_patches(&patches, self.world);
        if self.flipped()? {
            patches = patches.iter().map(BezierPatch::flipped).collect();
        }
        let resolution = self.fields.optional("tessellation").map_or(Ok(Resolution::PerEdge(10)), |n| resolution(&n))?;
        if patches.len() * 2 * resolution.steps(&patches).pow(2) as usize > MAX_TRIANGLES {
            return Err(SceneError::TooMuch { file: assembly.file.to_owned(), what: "triangles", limit: MAX_TRIANGLES });
        }
        let (mesh, patch_of_triangle) = tessellate(&patches, resolution).map_err(|e| self.wrong_geometry(assembly, e))?;
        let material = self.material(assembly)?;
        assembly.add_object(self.name, mesh, Surface::Patches { patches, patch_of_triangle }, material, self.emission()?)
    }

    fn read_patches(&self, assembly: &Assembly, node: &Node) -> Result<Vec<BezierPatch>, SceneError> {
        let text = node.text()?;
        if let Some(piece) = text.strip_prefix("builtin:") {
            let unknown = || node.wrong("\"builtin:teapot\", \"builtin:teacup\", \"builtin:teaspoon\" or a file");
            return Ok(tea_set::patches(TeaSet::from_name(piece).ok_or_else(unknown)?));
        }
        let up = match self.fields.optional("up_axis") {
            None => UpAxis::Y,
            Some(n) => match n.text()? {
                "+Y" => UpAxis::Y,
                "+Z" => UpAxis::Z,
                _ => return Err(n.wrong("\"+Y\" or \"+Z\"")),
            },
        };
        let path = sibling(assembly.file, text);
        bpt::read(&assembly.read(&path, node)?, up).map_err(|source| SceneError::Format { file: path, source })
    }
}

fn resolution(node: &Node) -> Result<Resolution, SceneError> {
    let fields = node.fields()?;
    let resolution = match (fields.optional("per_edge"), fields.optional("max_edge")) {
        (Some(steps), None) => Resolution::PerEdge(steps.count(1..=MAX_STEPS)?),
        (None, Some(edge)) => Resolution::MaxEdge(edge.length()?),
        _ => return Err(node.wrong("a tessellation with either \"per_edge\" or \"max_edge\"")),
    };
    fields.finish()?;
    Ok(resolution)
}
