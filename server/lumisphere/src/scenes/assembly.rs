//! A scene while it is being put together: names already used, pictures already read, limits still to be kept.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use glam::Vec3;

use super::error::SceneError;
use super::files::{SceneFiles, sibling};
use super::json::Node;
use super::scene::{Albedo, Environment, Material, Object, Scene, Surface, Texture};
use crate::geometry::TriangleMesh;
use crate::images::{Image, ReadLimits, decode_image};
use crate::radiometry::brdf::Measured;

/// Triangles one scene may hold: 64 bytes each with its vertices and its place in a hierarchy, 1 GiB.
pub(super) const MAX_TRIANGLES: usize = 1 << 24;

/// Texels all textures of one scene may hold together: 12 bytes each, 1.6 GB.
const MAX_TEXELS: usize = 1 << 27;

pub(super) struct Assembly<'a> {
    pub files: &'a dyn SceneFiles,
    /// The scene file's own path: what it names is beside it.
    pub file: &'a str,
    pub scene: Scene,
    /// Measured materials already read, by path.
    pub tables: HashMap<String, Arc<Measured>>,
    materials: HashMap<String, usize>,
    names: HashSet<(&'static str, String)>,
    pictures: HashMap<String, usize>,
    triangles: usize,
    texels: usize,
}

impl<'a> Assembly<'a> {
    pub fn new(files: &'a dyn SceneFiles, file: &'a str) -> Self {
        let scene = Scene {
            name: String::new(),
            objects: Vec::new(),
            materials: Vec::new(),
            textures: Vec::new(),
            point_lights: Vec::new(),
            environment: Environment::Constant(Vec3::ZERO),
            cameras: Vec::new(),
            notes: Vec::new(),
        };
        Self {
            files,
            file,
            scene,
            tables: HashMap::new(),
            materials: HashMap::new(),
            names: HashSet::new(),
            pictures: HashMap::new(),
            triangles: 0,
            texels: 0,
        }
    }

    /// Path, from the files' root, of what the scene file calls `path`.
    pub fn beside(&self, path: &str) -> String {
        sibling(self.file, path)
    }

    /// A file that `by` names.
    pub fn read(&self, path: &str, by: &Node) -> Result<Vec<u8>, SceneError> {
        self.files.read(path).map_err(|source| SceneError::File { by: by.at(), source })
    }

    pub fn add_material(&mut self, name: &str, material: Material) -> usize {
        self.scene.materials.push(material);
        let index = self.scene.materials.len() - 1;
        self.materials.insert(name.to_owned(), index);
        index
    }

    /// The material a node names.
    pub fn material(&self, node: &Node) -> Result<usize, SceneError> {
        let mut known: Vec<&str> = self.materials.keys().map(String::as_str).collect();
        known.sort();
        let unknown = || node.wrong(format!("the name of a material ({})", known.join(", ")));
        self.materials.get(node.text()?).copied().ok_or_else(unknown)
    }

    /// Takes a name for a kind of thing ("object", "camera", "light"); false when it is taken already.
    pub fn take_name(&mut self, kind: &'static str, name: &str) -> bool {
        self.names.insert((kind, name.to_owned()))
    }

    /// Adds an object whose name is taken; errors beyond the limit of triangles.
    pub fn add_object(
        &mut self,
        name: &str,
        mesh: TriangleMesh,
        surface: Surface,
        material: usize,
        emission: Option<Vec3>,
    ) -> Result<(), SceneError> {
        self.triangles += mesh.triangles.len();
        if self.triangles > MAX_TRIANGLES {
            return Err(SceneError::TooMuch { file: self.file.to_owned(), what: "triangles", limit: MAX_TRIANGLES });
        }
        // Zero radiance is no light.
        let emission = emission.filter(|e| *e != Vec3::ZERO);
        self.scene.objects.push(Object { name: name.to_owned(), mesh, surface, material, emission });
        Ok(())
    }

    /// The texture of a picture file, times `factor`; read once however often it is used.
    pub fn texture(&mut self, path: &str, factor: Vec3, by: &Node) -> Result<Albedo, SceneError> {
        let key = format!("{path} {factor}");
        if let Some(index) = self.pictures.get(&key) {
            return Ok(Albedo::Texture(*index));
        }
        let bytes = self.read(path, by)?;
        let index = self.add_texture(&bytes, factor, path)?;
        self.pictures.insert(key, index);
        Ok(Albedo::Texture(index))
    }

    /// Decodes and adds a picture; `shown_as` names it in errors.
    pub fn add_texture(&mut self, bytes: &[u8], factor: Vec3, shown_as: &str) -> Result<usize, SceneError> {
        let image = self.picture(bytes, shown_as)?;
        let image = scaled_albedo(image, factor).map_err(|message| SceneError::Image { file: shown_as.to_owned(), message })?;
        self.scene.textures.push(Texture { image });
        Ok(self.scene.textures.len() - 1)
    }

    /// Decodes a picture into linear planes, within the scene's limits.
    pub fn picture(&mut self, bytes: &[u8], shown_as: &str) -> Result<Image, SceneError> {
        let image =
            decode_image(bytes, ReadLimits::SCENE).map_err(|e| SceneError::Image { file: shown_as.to_owned(), message: e.to_string() })?;
        self.texels += image.width * image.height;
        if self.texels > MAX_TEXELS {
            return Err(SceneError::TooMuch { file: self.file.to_owned(), what: "texels", limit: MAX_TEXELS });
        }
        Ok(image)
    }
}

// Three planes, each value times its factor; refuses what no albedo can be.
fn scaled_albedo(mut image: Image, factor: Vec3) -> Result<Image, String> {
    image.planes.truncate(3);
    for (plane, factor) in image.planes.iter_mut().zip(factor.to_array()) {
        plane.iter_mut().for_each(|v| *v *= factor);
        if let Some(v) = plane.iter().find(|v| !(0.0..=1.0).contains(*v)) {
            return Err(format!("texture of a material holds {v}, 0 to 1 expected"));
        }
    }
    Ok(image)
}
