//! glTF 2.0, `.glb` and `.gltf`: triangles with node transforms, base colours as Lambertian albedo, emission, point lights and
//! perspective cameras.
//!
//! The `gltf` crate parses and validates the JSON; accessors are read here with every bound checked, because the crate's own
//! readers panic on files that validate (accessors of count 0, or of another type than the attribute's). Left out, with a note:
//! alpha, metalness, normal maps, skins, spot and directional lights. Sparse accessors are an error.

mod accessors;
#[cfg(test)]
mod tests;
mod uris;

use std::collections::{BTreeSet, HashSet};

use ::gltf as foreign;
use foreign::json;
use glam::{Mat4, Quat, Vec2, Vec3};

use super::FormatError;
use crate::geometry::TriangleMesh;
use uris::{data_uri, percent_decoded};

/// A file's content, +Y up as glTF is, in the file's world.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfModel {
    /// One a node and primitive.
    pub objects: Vec<GltfObject>,
    /// Named by `GltfObject::material`.
    pub materials: Vec<GltfMaterial>,
    /// Encoded pictures that the materials name, in the file's order; those that none names are empty.
    pub images: Vec<Vec<u8>>,
    /// Perspective cameras.
    pub cameras: Vec<GltfCamera>,
    /// Point lights.
    pub point_lights: Vec<GltfPointLight>,
    /// What was left out, one sentence each.
    pub notes: Vec<String>,
}

/// One primitive at one node.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfObject {
    /// The node's or mesh's; not unique.
    pub name: String,
    /// In the file's world; uv with v up.
    pub mesh: TriangleMesh,
    /// Index into `GltfModel::materials`.
    pub material: usize,
}

/// A material as far as we show it.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfMaterial {
    /// Linear factor.
    pub base_color: Vec3,
    /// Picture (sRGB) that the factor multiplies; index into `GltfModel::images`.
    pub texture: Option<usize>,
    /// Radiance: factor times strength.
    pub emission: Vec3,
}

/// A perspective camera at a node.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfCamera {
    /// The node's or camera's.
    pub name: String,
    /// Looks along −Z.
    pub world_from_camera: Mat4,
    /// Vertical field of view.
    pub vfov_deg: f32,
    /// Width / height; 4/3 where the file gives none.
    pub aspect: f32,
}

/// A point light at a node.
#[derive(Debug, Clone, PartialEq)]
pub struct GltfPointLight {
    /// In the file's world.
    pub position: Vec3,
    /// The file's candela, taken as W/sr.
    pub intensity: Vec3,
}

/// Why a glTF file was not read: itself, or (with the caller's own error) a file it names.
#[derive(Debug)]
pub enum GltfError<E> {
    /// The file.
    Format(FormatError),
    /// What `read_file` said.
    File(E),
}

impl<E> From<FormatError> for GltfError<E> {
    fn from(error: FormatError) -> Self {
        Self::Format(error)
    }
}

/// Triangles beyond this, instances counted each, are refused.
const MAX_TRIANGLES: usize = 1 << 24;
/// Nodes deeper than this are refused.
const MAX_DEPTH: usize = 64;

/// Bytes of a URI.
type Resolve<'a, E> = dyn FnMut(&str) -> Result<Vec<u8>, GltfError<E>> + 'a;

fn wrong(message: impl Into<String>) -> FormatError {
    FormatError::File(message.into())
}

/// Reads a file. `read_file` gives the bytes of a URI relative to it (percent-decoded; `data:` is handled here).
pub fn read<E>(bytes: &[u8], read_file: &mut dyn FnMut(&str) -> Result<Vec<u8>, E>) -> Result<GltfModel, GltfError<E>> {
    let (root, blob) = parse(bytes)?;
    let mut resolve = |uri: &str| match uri.strip_prefix("data:") {
        Some(data) => Ok(data_uri(data)?),
        None => read_file(&percent_decoded(uri)).map_err(GltfError::File),
    };
    let buffers = buffers(&root, blob, &mut resolve)?;
    let mut reader = Reader { root: &root, buffers, model: GltfModel::empty(), triangles: 0, noted: BTreeSet::new() };
    reader.materials()?;
    reader.nodes()?;
    reader.images(&mut resolve)?;
    Ok(reader.finish()?)
}

fn parse(bytes: &[u8]) -> Result<(json::Root, Option<Vec<u8>>), FormatError> {
    // The crate subtracts its header from the announced length unchecked.
    if bytes.starts_with(b"glTF") {
        let length = bytes.get(8..12).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        if !length.is_some_and(|l| l as usize >= 12 && l as usize <= bytes.len()) {
            let announced = length.map_or("cut off in its header".into(), |l| format!("{} bytes of {l}", bytes.len()));
            return Err(wrong(format!("glTF file is incomplete: {announced}")));
        }
    }
    let file = foreign::Gltf::from_slice(bytes).map_err(|e| wrong(format!("not a glTF 2.0 file: {e}")))?;
    Ok((file.document.into_json(), file.blob))
}

// Every buffer's bytes; shorter ones than announced are errors.
fn buffers<E>(root: &json::Root, mut blob: Option<Vec<u8>>, resolve: &mut Resolve<E>) -> Result<Vec<Vec<u8>>, GltfError<E>> {
    let mut buffers = Vec::new();
    for (i, buffer) in root.buffers.iter().enumerate() {
        let bytes = match &buffer.uri {
            Some(uri) => resolve(uri)?,
            None => blob.take().ok_or_else(|| wrong(format!("buffer {i} has no data")))?,
        };
        if (bytes.len() as u64) < buffer.byte_length.0 {
            return Err(wrong(format!("buffer {i} has {} bytes, {} announced", bytes.len(), buffer.byte_length.0)).into());
        }
        buffers.push(bytes);
    }
    Ok(buffers)
}

struct Reader<'a> {
    root: &'a json::Root,
    buffers: Vec<Vec<u8>>,
    model: GltfModel,
    triangles: usize,
    noted: BTreeSet<String>,
}

impl GltfModel {
    fn empty() -> Self {
        Self { objects: vec![], materials: vec![], images: vec![], cameras: vec![], point_lights: vec![], notes: vec![] }
    }
}

impl Reader<'_> {
    fn note(&mut self, text: String) {
        self.noted.insert(text);
    }

    fn finish(mut self) -> Result<GltfModel, FormatError> {
        if self.model.objects.is_empty() {
            return Err(wrong("glTF file has no triangle in its scene"));
        }
        self.model.notes = self.noted.into_iter().collect();
        Ok(self.model)
    }

    // The file's materials, then the one of primitives that name none: white.
    fn materials(&mut self) -> Result<(), FormatError> {
        for (i, material) in self.root.materials.iter().enumerate() {
            let name = material.name.clone().unwrap_or_else(|| i.to_string());
            let pbr = &material.pbr_metallic_roughness;
            let [r, g, b, _] = pbr.base_color_factor.0;
            let strength = material.extensions.as_ref().and_then(|e| e.emissive_strength.as_ref()).map_or(1.0, |s| s.emissive_strength.0);
            let base_color = Vec3::new(r, g, b);
            let emission = Vec3::from(material.emissive_factor.0) * strength;
            if !(base_color.is_finite() && emission.is_finite() && emission.min_element() >= 0.0) {
                return Err(wrong(format!("material {name:?} has colours that are not finite or negative")));
            }
            if !matches!(material.alpha_mode, json::validation::Checked::Valid(json::material::AlphaMode::Opaque)) {
                self.note(format!("material {name:?}: alpha is not applied, the surface is opaque"));
            }
            if material.emissive_texture.is_some() && emission != Vec3::ZERO {
                self.note(format!("material {name:?}: its emission map is not applied, the whole surface shines"));
            }
            let texture = pbr.base_color_texture.as_ref().and_then(|t| self.root.textures.get(t.index.value())).map(|t| t.source.value());
            self.model.materials.push(GltfMaterial { base_color, texture, emission });
        }
        self.model.materials.push(GltfMaterial { base_color: Vec3::ONE, texture: None, emission: Vec3::ZERO });
        Ok(())
    }

    // The pictures that materials name.
    fn images<E>(&mut self, resolve: &mut Resolve<E>) -> Result<(), GltfError<E>> {
        let used: HashSet<usize> = self.model.materials.iter().filter_map(|m| m.texture).collect();
        for (i, image) in self.root.images.iter().enumerate() {
            let bytes = match (&image.buffer_view, &image.uri) {
                _ if !used.contains(&i) => Vec::new(),
                (Some(view), _) => self.view(view.value())?.0.to_vec(),
                (None, Some(uri)) => resolve(uri)?,
                (None, None) => return Err(wrong(format!("image {i} has neither data nor a file")).into()),
            };
            self.model.images.push(bytes);
        }
        Ok(())
    }

    // Every node of the default scene (all root nodes' trees where there is no scene).
    fn nodes(&mut self) -> Result<(), FormatError> {
        let scene = self.root.scene.map_or(0, |s| s.value());
        let roots: Vec<usize> = match self.root.scenes.get(scene) {
            Some(scene) => scene.nodes.iter().map(|n| n.value()).collect(),
            None => {
                let children: HashSet<usize> =
                    self.root.nodes.iter().flat_map(|n| n.children.iter().flatten().map(|c| c.value())).collect();
                (0..self.root.nodes.len()).filter(|n| !children.contains(n)).collect()
            }
        };
        let mut seen = HashSet::new();
        for root in roots {
            self.node(root, Mat4::IDENTITY, 0, &mut seen)?;
        }
        Ok(())
    }

    fn node(&mut self, index: usize, world_from_parent: Mat4, depth: usize, seen: &mut HashSet<usize>) -> Result<(), FormatError> {
        let node = self.root.nodes.get(index).ok_or_else(|| wrong(format!("node {index} does not exist")))?;
        if !seen.insert(index) || depth > MAX_DEPTH {
            return Err(wrong(format!("node {index} has two parents, is its own ancestor, or lies more than {MAX_DEPTH} levels deep")));
        }
        let world = world_from_parent * local_transform(node);
        if !(world.is_finite()) {
            return Err(wrong(format!("node {index} has a transform that is not finite")));
        }
        let name = node.name.clone();
        if let Some(mesh) = node.mesh {
            self.mesh(mesh.value(), world, name.clone())?;
        }
        if node.skin.is_some() {
            self.note(format!("node {index}: its skin is not applied"));
        }
        if let Some(camera) = node.camera {
            self.camera(camera.value(), world, name);
        }
        if let Some(light) = node.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref()) {
            self.light(light.light.value(), world);
        }
        for child in node.children.iter().flatten() {
            self.node(child.value(), world, depth + 1, seen)?;
        }
        Ok(())
    }

    fn camera(&mut self, index: usize, world_from_camera: Mat4, node: Option<String>) {
        let Some(camera) = self.root.cameras.get(index) else { return };
        let Some(lens) = &camera.perspective else {
            return self.note(format!("camera {index} is not perspective and is left out"));
        };
        let name = node.or_else(|| camera.name.clone()).unwrap_or_else(|| format!("camera {index}"));
        let aspect = lens.aspect_ratio.filter(|a| a.is_finite() && *a > 0.0).unwrap_or(4.0 / 3.0);
        self.model.cameras.push(GltfCamera { name, world_from_camera, vfov_deg: lens.yfov.to_degrees(), aspect });
    }

    fn light(&mut self, index: usize, world: Mat4) {
        use json::extensions::scene::khr_lights_punctual::Type;
        let lights = self.root.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref());
        let Some(light) = lights.and_then(|l| l.lights.get(index)) else { return };
        if !matches!(light.type_, json::validation::Checked::Valid(Type::Point)) {
            return self.note(format!("light {index} is not a point light and is left out"));
        }
        let intensity = Vec3::from(light.color) * light.intensity;
        if !(intensity.is_finite() && intensity.min_element() >= 0.0) {
            return self.note(format!("light {index} has an intensity that is not finite or negative and is left out"));
        }
        self.model.point_lights.push(GltfPointLight { position: world.w_axis.truncate(), intensity });
    }

    fn mesh(&mut self, index: usize, world: Mat4, node: Option<String>) -> Result<(), FormatError> {
        let mesh = self.root.meshes.get(index).ok_or_else(|| wrong(format!("mesh {index} does not exist")))?;
        let name = node.or_else(|| mesh.name.clone()).unwrap_or_else(|| format!("mesh {index}"));
        for (i, primitive) in mesh.primitives.iter().enumerate() {
            let place = format!("mesh {name:?}, primitive {i}");
            let read = self.primitive(primitive, world).map_err(|e| wrong(format!("{place}: {e}")))?;
            let Some(read) = read else {
                self.note(format!("{place} is made of points or lines, or without positions, and is left out"));
                continue;
            };
            let material = primitive.material.map_or(self.model.materials.len() - 1, |m| m.value());
            self.model.objects.push(GltfObject { name: name.clone(), mesh: read, material });
        }
        Ok(())
    }

    // None for what has no surface.
    fn primitive(&mut self, primitive: &json::mesh::Primitive, world: Mat4) -> Result<Option<TriangleMesh>, FormatError> {
        use json::mesh::{Mode, Semantic};
        use json::validation::Checked::Valid;
        let attribute = |semantic| primitive.attributes.get(&Valid(semantic)).map(|a| a.value());
        let Some(positions) = attribute(Semantic::Positions) else { return Ok(None) };
        let positions: Vec<Vec3> = self.floats::<3>(positions)?.into_iter().map(Vec3::from).collect();
        let order: Vec<u32> = match primitive.indices {
            Some(indices) => self.indices(indices.value())?,
            None => (0..positions.len() as u32).collect(),
        };
        let triangles: Vec<[u32; 3]> = match primitive.mode {
            Valid(Mode::Triangles) => order.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
            Valid(Mode::TriangleStrip) => {
                order.windows(3).enumerate().map(|(i, t)| if i % 2 == 0 { [t[0], t[1], t[2]] } else { [t[1], t[0], t[2]] }).collect()
            }
            Valid(Mode::TriangleFan) => order.get(1..).unwrap_or_default().windows(2).map(|t| [order[0], t[0], t[1]]).collect(),
            _ => return Ok(None),
        };
        self.triangles += triangles.len();
        if self.triangles > MAX_TRIANGLES {
            return Err(wrong(format!("more than {MAX_TRIANGLES} triangles")));
        }
        let texture_set = self.texture_set(primitive.material.map(|m| m.value()));
        let uvs = match attribute(Semantic::TexCoords(texture_set)) {
            // glTF's v runs down.
            Some(uvs) => self.floats::<2>(uvs)?.into_iter().map(|[u, v]| Vec2::new(u, 1.0 - v)).collect(),
            None => vec![Vec2::ZERO; positions.len()],
        };
        let normals = match attribute(Semantic::Normals) {
            Some(normals) => Some(self.floats::<3>(normals)?.into_iter().map(Vec3::from).collect()),
            None => None,
        };
        assemble(positions, normals, uvs, triangles, world).map(Some)
    }

    fn texture_set(&self, material: Option<usize>) -> u32 {
        let material = material.and_then(|m| self.root.materials.get(m));
        material.and_then(|m| m.pbr_metallic_roughness.base_color_texture.as_ref()).map_or(0, |t| t.tex_coord)
    }
}

fn local_transform(node: &json::Node) -> Mat4 {
    if let Some(matrix) = &node.matrix {
        return Mat4::from_cols_array(matrix);
    }
    let rotation = node.rotation.map_or(Quat::IDENTITY, |r| Quat::from_array(r.0)).normalize();
    let (scale, translation) = (node.scale.map_or(Vec3::ONE, Vec3::from), node.translation.map_or(Vec3::ZERO, Vec3::from));
    Mat4::from_scale_rotation_translation(scale, rotation, translation)
}

// The mesh in the file's world. Without normals every triangle gets its own, as the specification says.
fn assemble(
    positions: Vec<Vec3>,
    normals: Option<Vec<Vec3>>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
    world: Mat4,
) -> Result<TriangleMesh, FormatError> {
    let linear = glam::Mat3::from_mat4(world);
    if linear.determinant() == 0.0 {
        return Err(wrong("its node's transform has no volume"));
    }
    let mirrored = linear.determinant() < 0.0;
    let triangles: Vec<[u32; 3]> = triangles.into_iter().map(|[a, b, c]| if mirrored { [a, c, b] } else { [a, b, c] }).collect();
    let placed: Vec<Vec3> = positions.iter().map(|p| world.transform_point3(*p)).collect();
    let Some(normals) = normals else {
        return faceted(&placed, &uvs, &triangles);
    };
    let normal_matrix = linear.inverse().transpose();
    let normals = normals.iter().map(|n| normal_matrix * *n).collect();
    Ok(TriangleMesh::new(placed, normals, uvs, triangles)?)
}

// Three vertices a triangle; TriangleMesh fills in the zero normals with the triangle's own.
fn faceted(positions: &[Vec3], uvs: &[Vec2], triangles: &[[u32; 3]]) -> Result<TriangleMesh, FormatError> {
    let corners: Vec<usize> = triangles.iter().flatten().map(|i| *i as usize).collect();
    if let Some(beyond) = corners.iter().find(|i| **i >= positions.len() || **i >= uvs.len()) {
        return Err(wrong(format!("a triangle names vertex {beyond} of {}", positions.len())));
    }
    let order = (0..triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    let (positions, uvs) = (corners.iter().map(|i| positions[*i]).collect(), corners.iter().map(|i| uvs[*i]).collect());
    Ok(TriangleMesh::new(positions, vec![Vec3::ZERO; corners.len()], uvs, order)?)
}
