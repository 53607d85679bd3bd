//! glTF 2.0, `.glb` and `.gltf`: triangles with node transforms, base colours as Lambertian albedo, emission, point lights and
//! perspective cameras.
//!
//! The `gltf` crate parses and validates the JSON; accessors are read here with every bound checked, because the crate's own
//! readers panic on files that validate (accessors of count 0, or of another type than the attribute's). Left out, with a note:
//! alpha, metalness, normal maps, skins, sparse accessors' owners, spot and directional lights.

use std::collections::{BTreeSet, HashSet};

use ::gltf as foreign;
use foreign::json;
use glam::{Mat4, Quat, Vec2, Vec3};

use super::FormatError;
use crate::geometry::TriangleMesh;

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

    // Bytes of a buffer view and its stride.
    fn view(&self, index: usize) -> Result<(&[u8], Option<usize>), FormatError> {
        let outside = || wrong(format!("buffer view {index} lies outside its buffer"));
        let view = self.root.buffer_views.get(index).ok_or_else(outside)?;
        let start = usize::try_from(view.byte_offset.map_or(0, |o| o.0)).map_err(|_| outside())?;
        let length = usize::try_from(view.byte_length.0).map_err(|_| outside())?;
        let buffer = self.buffers.get(view.buffer.value()).ok_or_else(outside)?;
        let bytes = start.checked_add(length).and_then(|end| buffer.get(start..end)).ok_or_else(outside)?;
        Ok((bytes, view.byte_stride.map(|s| s.0)))
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

    // Elements of an accessor: (bytes, stride, count, component type, normalised). Every element lies inside the bytes.
    fn elements(&self, index: usize, dimension: usize) -> Result<Elements<'_>, FormatError> {
        use json::validation::Checked::Valid;
        let broken = |what: &str| wrong(format!("accessor {index} {what}"));
        let accessor = self.root.accessors.get(index).ok_or_else(|| broken("does not exist"))?;
        if accessor.sparse.is_some() {
            return Err(broken("is sparse, which is not supported"));
        }
        let (Valid(component), Valid(shape)) = (accessor.component_type, accessor.type_) else {
            return Err(broken("has an unknown type"));
        };
        if shape.multiplicity() != dimension {
            return Err(broken(&format!("has {} components, {dimension} expected", shape.multiplicity())));
        }
        let view = accessor.buffer_view.ok_or_else(|| broken("has no data"))?;
        let (bytes, stride) = self.view(view.value())?;
        let size = component.0.size() * dimension;
        let stride = stride.unwrap_or(size);
        let outside = || broken("reaches beyond its buffer view");
        let start = usize::try_from(accessor.byte_offset.map_or(0, |o| o.0)).map_err(|_| outside())?;
        let count = usize::try_from(accessor.count.0).map_err(|_| outside())?;
        let last = count.checked_sub(1).ok_or_else(|| broken("is empty"))?;
        let end = last.checked_mul(stride).and_then(|l| l.checked_add(size)).and_then(|l| l.checked_add(start)).ok_or_else(outside)?;
        if stride < size || end > bytes.len() {
            return Err(outside());
        }
        Ok(Elements { bytes: &bytes[start..], stride, count, component: component.0, normalized: accessor.normalized })
    }

    fn floats<const N: usize>(&self, index: usize) -> Result<Vec<[f32; N]>, FormatError> {
        let elements = self.elements(index, N)?;
        let size = elements.component.size();
        let mut values = Vec::with_capacity(elements.count);
        for i in 0..elements.count {
            let mut value = [0.0; N];
            for (k, v) in value.iter_mut().enumerate() {
                *v = elements.float(i * elements.stride + k * size);
            }
            values.push(value);
        }
        Ok(values)
    }

    fn indices(&self, index: usize) -> Result<Vec<u32>, FormatError> {
        use json::accessor::ComponentType;
        let elements = self.elements(index, 1)?;
        let at = |i: usize| &elements.bytes[i * elements.stride..];
        let all = 0..elements.count;
        match elements.component {
            ComponentType::U8 => Ok(all.map(|i| at(i)[0] as u32).collect()),
            ComponentType::U16 => Ok(all.map(|i| u16::from_le_bytes([at(i)[0], at(i)[1]]) as u32).collect()),
            ComponentType::U32 => Ok(all.map(|i| u32::from_le_bytes([at(i)[0], at(i)[1], at(i)[2], at(i)[3]])).collect()),
            _ => Err(wrong(format!("accessor {index} does not hold indices"))),
        }
    }
}

struct Elements<'a> {
    bytes: &'a [u8],
    stride: usize,
    count: usize,
    component: json::accessor::ComponentType,
    normalized: bool,
}

impl Elements<'_> {
    // The component at a byte offset, which `Reader::elements` has checked.
    fn float(&self, at: usize) -> f32 {
        use json::accessor::ComponentType;
        let b = &self.bytes[at..];
        let (value, largest) = match self.component {
            ComponentType::F32 => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            ComponentType::I8 => (b[0] as i8 as f32, i8::MAX as f32),
            ComponentType::U8 => (b[0] as f32, u8::MAX as f32),
            ComponentType::I16 => (i16::from_le_bytes([b[0], b[1]]) as f32, i16::MAX as f32),
            ComponentType::U16 => (u16::from_le_bytes([b[0], b[1]]) as f32, u16::MAX as f32),
            ComponentType::U32 => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32, u32::MAX as f32),
        };
        if self.normalized { (value / largest).max(-1.0) } else { value }
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

// What follows "data:": a media type, then ";base64," and the data.
fn data_uri(data: &str) -> Result<Vec<u8>, FormatError> {
    let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
    encoded.and_then(base64).ok_or_else(|| wrong("data URI is not base64"))
}

fn base64(text: &str) -> Option<Vec<u8>> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => Some(c - b'A'),
        b'a'..=b'z' => Some(c - b'a' + 26),
        b'0'..=b'9' => Some(c - b'0' + 52),
        b'+' => Some(62),
        b'/' => Some(63),
        _ => None,
    };
    let digits: Vec<u8> = text.trim_end_matches('=').bytes().map(digit).collect::<Option<_>>()?;
    let mut bytes = Vec::with_capacity(digits.len() / 4 * 3 + 2);
    for group in digits.chunks(4) {
        let word = group.iter().enumerate().fold(0u32, |w, (i, d)| w | (*d as u32) << (18 - 6 * i));
        bytes.extend(&word.to_be_bytes()[1..group.len()]);
    }
    (digits.len() % 4 != 1).then_some(bytes)
}

fn percent_decoded(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let (mut out, mut i) = (Vec::new(), 0);
    while i < bytes.len() {
        let code = (bytes[i] == b'%').then(|| uri.get(i + 1..i + 3)).flatten().and_then(|h| u8::from_str_radix(h, 16).ok());
        out.push(code.unwrap_or(bytes[i]));
        i += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    // A triangle, as text with everything inside it; `{…}` may be replaced by the tests.
    fn triangle() -> String {
        let floats: Vec<u8> = [0f32, 0., 0., 1., 0., 0., 0., 1., 0.].iter().flat_map(|f| f.to_le_bytes()).collect();
        let encoded = encode(&floats);
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
            "nodes":[{{"name":"n","mesh":0,"translation":[1,2,3],"children":[1]}},{{"camera":0,"name":"eye"}}],
            "cameras":[{{"type":"perspective","perspective":{{"yfov":1.0,"znear":0.1,"aspectRatio":1.5}}}}],
            "materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[0.2,0.4,0.6,1]}},"emissiveFactor":[1,0.5,0],
                "extensions":{{"KHR_materials_emissive_strength":{{"emissiveStrength":4}}}},"alphaMode":"MASK"}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"material":0}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}}],
            "bufferViews":[{{"buffer":0,"byteLength":36}}],
            "buffers":[{{"byteLength":36,"uri":"data:application/octet-stream;base64,{encoded}"}}]}}"#
        )
    }

    fn encode(bytes: &[u8]) -> String {
        const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        let group = |g: &[u8]| {
            let word = g.iter().enumerate().fold(0u32, |w, (i, b)| w | (*b as u32) << (16 - 8 * i));
            (0..=g.len()).map(|i| DIGITS[(word >> (18 - 6 * i)) as usize & 63] as char).collect::<String>()
        };
        bytes.chunks(3).map(group).collect()
    }

    fn read_text(text: &str) -> Result<GltfModel, GltfError<String>> {
        read(text.as_bytes(), &mut |uri| Err(format!("asked for {uri}")))
    }

    fn message(text: &str) -> String {
        match read_text(text) {
            Err(GltfError::Format(e)) => e.to_string(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn geometry_colour_emission_and_camera_arrive() {
        let model = read_text(&triangle()).unwrap();
        assert_eq!(model.objects[0].mesh.positions[1], Vec3::new(2.0, 2.0, 3.0));
        assert_eq!(model.objects[0].mesh.normals[0], Vec3::Z);
        let material = &model.materials[model.objects[0].material];
        assert_eq!((material.base_color, material.emission), (Vec3::new(0.2, 0.4, 0.6), Vec3::new(4.0, 2.0, 0.0)));
        assert_eq!((model.cameras[0].name.as_str(), model.cameras[0].aspect), ("eye", 1.5));
        assert!((model.cameras[0].vfov_deg - 57.29578).abs() < 1e-4);
        assert_eq!(model.cameras[0].world_from_camera.w_axis.truncate(), Vec3::new(1.0, 2.0, 3.0));
        assert!(model.notes[0].contains("alpha is not applied"));
    }

    #[test]
    fn a_mirroring_node_keeps_the_front() {
        let model = read_text(&triangle().replace(r#""translation":[1,2,3]"#, r#""scale":[-1,1,1]"#)).unwrap();
        assert!(model.objects[0].mesh.positions.contains(&Vec3::NEG_X));
        assert!(model.objects[0].mesh.area_vector(0).z > 0.0, "it faced +z, which the mirror leaves alone");
    }

    #[test]
    fn what_is_broken_is_named() {
        assert!(message(&triangle().replace(r#""count":3"#, r#""count":4"#)).contains("accessor 0 reaches beyond its buffer view"));
        assert!(message(&triangle().replace(r#""count":3"#, r#""count":0"#)).contains("accessor 0 is empty"));
        assert!(message(&triangle().replace(r#""type":"VEC3""#, r#""type":"VEC2""#)).contains("accessor 0 has 2 components"));
        assert!(message(&triangle().replace(r#""byteLength":36,"uri"#, r#""byteLength":37,"uri"#)).contains("36 bytes, 37 announced"));
        assert!(message(&triangle().replace(r#""byteLength":36}"#, r#""byteLength":40}"#)).contains("lies outside its buffer"));
        assert!(message(&triangle().replace(r#""children":[1]"#, r#""children":[0]"#)).contains("own ancestor"));
        assert!(message(&triangle().replace(r#""translation":[1,2,3]"#, r#""scale":[0,1,1]"#)).contains("no volume"));
        assert!(message(&triangle().replace("AAAAAA", "AA*AAA")).contains("base64"));
        assert!(message("{}").contains("not a glTF"));
        assert!(message(&triangle().replace(r#""nodes":[0]"#, r#""nodes":[]"#)).contains("no triangle"));
        assert!(
            matches!(read_text(&triangle().replace("data:application/octet-stream;base64,", "a%20b.bin?")), Err(GltfError::File(f)) if f.starts_with("asked for a b.bin"))
        );
    }

    #[test]
    fn a_binary_file_cut_off_anywhere_is_an_error() {
        let json = triangle();
        let mut glb = b"glTF\x02\0\0\0".to_vec();
        let padded = json.len().div_ceil(4) * 4;
        glb.extend((20 + padded as u32).to_le_bytes());
        glb.extend((padded as u32).to_le_bytes());
        glb.extend(b"JSON");
        glb.extend(json.bytes().chain(std::iter::repeat(b' ')).take(padded));
        assert!(read(&glb, &mut |_| Err(())).is_ok());
        for length in 0..glb.len() {
            assert!(read(&glb[..length], &mut |_| Err(())).is_err(), "{length} bytes");
        }
        glb[8..12].copy_from_slice(&4u32.to_le_bytes());
        assert!(read(&glb, &mut |_| Err(())).is_err(), "a length below its own header");
    }

    #[test]
    fn base64_decodes_every_remainder() {
        for bytes in [&b""[..], b"a", b"ab", b"abc", b"abcd"] {
            assert_eq!(base64(&encode(bytes)).unwrap(), bytes);
        }
        assert_eq!(base64("YQ==").unwrap(), b"a");
        assert_eq!(base64("A"), None);
    }
}
