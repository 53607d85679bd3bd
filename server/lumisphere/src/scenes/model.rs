//! Model files that bring their own materials (glTF, OBJ with MTL): one file becomes several objects named `entry/part`.

use std::collections::HashMap;

use glam::{Mat4, Vec3};

use super::assembly::Assembly;
use super::error::SceneError;
use super::files::sibling;
use super::json::Node;
use super::scene::{Albedo, Material, NamedCamera, PointLight, Surface};
use super::transform;
use crate::formats::{FormatError, gltf, obj};
use crate::geometry::{Camera, CameraError, Intrinsics, Pose, TriangleMesh};

/// Vertical size of the pictures that a glTF camera asks for; the format has only an aspect ratio.
const CAMERA_HEIGHT_PX: u32 = 480;

/// Adds everything of a glTF file: `gltf` is the node that names it, `name` the entry's.
pub(super) fn add_gltf(assembly: &mut Assembly, node: &Node, name: &str, world: Mat4) -> Result<(), SceneError> {
    let path = assembly.beside(node.text()?);
    let bytes = assembly.read(&path, node)?;
    let model = {
        let by = node.at();
        let files = assembly.files;
        gltf::read(&bytes, &mut |uri| {
            files.read(&sibling(&path, uri)).map_err(|source| SceneError::File { by: format!("{path}, {by}"), source })
        })
    };
    let model = model.map_err(|e| match e {
        gltf::GltfError::Format(source) => SceneError::Format { file: path.clone(), source },
        gltf::GltfError::File(error) => error,
    })?;
    let materials = gltf_materials(assembly, &model, &path)?;
    for object in model.objects {
        let (material, emission) = (materials[object.material], model.materials[object.material].emission);
        add_part(assembly, name, &path, world, Part { name: &object.name, mesh: object.mesh, material, emission })?;
    }
    for light in model.point_lights {
        let position = world.transform_point3(light.position);
        assembly.scene.point_lights.push(PointLight { position, intensity: light.intensity });
    }
    for camera in &model.cameras {
        let placed = place_camera(camera, world).map_err(|message| SceneError::Format {
            file: path.clone(),
            source: FormatError::File(format!("camera {:?}: {message}", camera.name)),
        })?;
        let name = free_name(assembly, "camera", &format!("{name}/{}", camera.name));
        assembly.scene.cameras.push(NamedCamera { name, camera: placed });
    }
    assembly.scene.notes.extend(model.notes.into_iter().map(|n| format!("{path}: {n}")));
    Ok(())
}

fn gltf_materials(assembly: &mut Assembly, model: &gltf::GltfModel, path: &str) -> Result<Vec<usize>, SceneError> {
    let mut textures: HashMap<(usize, String), usize> = HashMap::new();
    let mut indices = Vec::new();
    for (i, material) in model.materials.iter().enumerate() {
        let albedo = match material.texture {
            None => Albedo::Constant(material.base_color.clamp(Vec3::ZERO, Vec3::ONE)),
            Some(image) => {
                let key = (image, material.base_color.to_string());
                let index = match textures.get(&key) {
                    Some(index) => *index,
                    None => {
                        let factor = material.base_color.clamp(Vec3::ZERO, Vec3::ONE);
                        assembly.add_texture(&model.images[image], factor, &format!("{path}, image {image}"))?
                    }
                };
                textures.insert(key, index);
                Albedo::Texture(index)
            }
        };
        indices.push(assembly.add_material(&format!("{path}#{i}"), Material::Diffuse { albedo }));
    }
    Ok(indices)
}

// The camera in the world; an entry's scale moves it but does not stretch it.
fn place_camera(camera: &gltf::GltfCamera, world: Mat4) -> Result<Camera, String> {
    let placed = world * camera.world_from_camera;
    let axis = |c: glam::Vec4| c.truncate();
    let (back, up) = (axis(placed.z_axis), axis(placed.y_axis));
    let position = axis(placed.w_axis);
    let pose = Pose::look_at(position, position - back, up).map_err(|e| e.to_string())?;
    let width = (CAMERA_HEIGHT_PX as f32 * camera.aspect).round().clamp(1.0, 65536.0) as u32;
    let intrinsics = Intrinsics::from_vfov(camera.vfov_deg, width, CAMERA_HEIGHT_PX).map_err(|e: CameraError| e.to_string())?;
    Camera::new(intrinsics, pose).map_err(|e| e.to_string())
}

/// Adds an OBJ file in the parts that its own materials make.
pub(super) fn add_obj(
    assembly: &mut Assembly,
    node: &Node,
    name: &str,
    world: Mat4,
    path: &str,
    file: &obj::ObjFile,
) -> Result<(), SceneError> {
    let mut library: HashMap<String, obj::MtlMaterial> = HashMap::new();
    for mtl in &file.material_libraries {
        let mtl = sibling(path, mtl);
        let materials = obj::read_materials(&assembly.read(&mtl, node)?);
        let materials = materials.map_err(|source| SceneError::Format { file: mtl.clone(), source })?;
        library.extend(materials.into_iter().map(|m| (m.name.clone(), m)));
    }
    for (i, used) in file.materials.iter().enumerate() {
        let broken = |source| SceneError::Format { file: path.to_owned(), source };
        let mesh = match file.mesh_of(i) {
            Ok(mesh) => mesh,
            Err(FormatError::Mesh(crate::geometry::MeshError::Empty)) if file.materials.len() > 1 => {
                assembly.scene.notes.push(format!("{path}: the part of material {used:?} has no area and is left out"));
                continue;
            }
            Err(error) => return Err(broken(error)),
        };
        let (material, emission) = match used {
            None => (
                assembly.add_material(&format!("{path}#none"), Material::Diffuse { albedo: Albedo::Constant(Vec3::splat(0.5)) }),
                Vec3::ZERO,
            ),
            Some(used) => {
                let mtl = library.get(used).ok_or_else(|| {
                    broken(FormatError::File(format!(
                        "material {used:?} is in none of its {} material files",
                        file.material_libraries.len()
                    )))
                })?;
                (mtl_material(assembly, mtl, path, node)?, mtl.emission)
            }
        };
        let part = Part { name: used.as_deref().unwrap_or("part"), mesh, material, emission };
        add_part(assembly, name, path, world, part)?;
    }
    Ok(())
}

fn mtl_material(assembly: &mut Assembly, mtl: &obj::MtlMaterial, path: &str, node: &Node) -> Result<usize, SceneError> {
    let diffuse = mtl.diffuse.clamp(Vec3::ZERO, Vec3::ONE);
    let albedo = match &mtl.diffuse_map {
        None => Albedo::Constant(diffuse),
        // Exporters that mean "the map alone" write black beside it.
        Some(map) => assembly.texture(&sibling(path, map), if diffuse == Vec3::ZERO { Vec3::ONE } else { diffuse }, node)?,
    };
    for map in &mtl.ignored_maps {
        assembly.scene.notes.push(format!("{path}: material {:?}: {map} is not applied", mtl.name));
    }
    Ok(assembly.add_material(&format!("{path}#{}", mtl.name), Material::Diffuse { albedo }))
}

struct Part<'a> {
    name: &'a str,
    mesh: TriangleMesh,
    material: usize,
    emission: Vec3,
}

fn add_part(assembly: &mut Assembly, entry: &str, path: &str, world: Mat4, part: Part) -> Result<(), SceneError> {
    let name = free_name(assembly, "object", &format!("{entry}/{}", part.name));
    let placed = transform::place_mesh(transform::wind_by_normals(part.mesh), world).map_err(|source| SceneError::Geometry {
        file: path.to_owned(),
        object: name.clone(),
        source,
    })?;
    assembly.add_object(&name, placed, Surface::Mesh, part.material, Some(part.emission))
}

// Model files may use a name twice; ours are unique.
fn free_name(assembly: &mut Assembly, kind: &'static str, wanted: &str) -> String {
    let mut name = wanted.to_owned();
    let mut count = 1;
    while !assembly.take_name(kind, &name) {
        count += 1;
        name = format!("{wanted} {count}");
    }
    name
}
