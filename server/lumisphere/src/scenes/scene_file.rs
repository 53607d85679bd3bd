//! The scene file, "neutral-scene/1" (the table in `scenes`): JSON beside the meshes and pictures it names.
//!
//! Read by the server (uploaded bundles), the client (to pack one) and the tests. Anything the format does not know is refused by
//! name, except the hints of other programs, so that a slip of the pen does not silently change a picture.

use std::path::PathBuf;

use glam::Vec3;

use super::assembly::Assembly;
use super::environment::{self, Layout};
use super::error::SceneError;
use super::files::{Recorder, SceneBundle, SceneFiles};
use super::json::{Fields, Json, Node};
use super::scene::{Environment, EnvironmentMap, NamedCamera, PointLight, Scene};
use super::{materials, objects};
use crate::geometry::{Camera, Intrinsics, Pose};
use crate::images::Image;

/// The one version of the format there is.
pub const FORMAT: &str = "neutral-scene/1";

/// What the caller of a scene decides, not its author.
#[derive(Debug, Clone)]
pub struct LoadOptions {
    /// Replaces the scene's environment.
    pub environment: Option<EnvironmentFile>,
}

/// A latitude–longitude environment given beside the scene.
#[derive(Debug, Clone)]
pub struct EnvironmentFile {
    /// For messages.
    pub name: String,
    /// EXR or Radiance .hdr.
    pub bytes: Vec<u8>,
    /// Factor on its radiance.
    pub scale: f32,
    /// About +Y, degrees, as `environment.rotation_deg`.
    pub rotation_deg: f32,
}

impl LoadOptions {
    /// The scene as its author wrote it.
    pub fn as_written() -> Self {
        Self { environment: None }
    }
}

/// Loads a scene. `path` names a scene file (`.json`), or a glTF (`.glb`, `.gltf`) or OBJ file with its own materials, which then is
/// the whole scene. Files that it names are read from `files`, beside it.
pub fn load(files: &dyn SceneFiles, path: &str, options: &LoadOptions) -> Result<Scene, SceneError> {
    let extension = PathBuf::from(path).extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let json = match extension.as_str() {
        "glb" | "gltf" => wrapped("gltf", path),
        "obj" => wrapped("mesh", path),
        _ => {
            let bytes = files.read(path).map_err(|source| SceneError::File { by: "the caller".into(), source })?;
            Json::parse(path, &bytes)?
        }
    };
    load_json(files, path, &json, options)
}

/// Every file that loading `path` reads, itself included: what a client uploads.
pub fn bundle(files: &dyn SceneFiles, path: &str) -> Result<SceneBundle, SceneError> {
    let recorder = Recorder::new(files);
    load(&recorder, path, &LoadOptions::as_written())?;
    Ok(recorder.into_bundle())
}

/// The paths of [`bundle`].
pub fn referenced_files(files: &dyn SceneFiles, path: &str) -> Result<Vec<String>, SceneError> {
    Ok(bundle(files, path)?.files.into_keys().collect())
}

// A scene of one model file.
fn wrapped(key: &str, path: &str) -> Json {
    let file = path.rsplit('/').next().unwrap_or(path);
    let name = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
    let text = |t: &str| Json::Text(t.to_owned());
    let object = Json::Map(vec![("name".into(), text(name)), (key.into(), text(file))]);
    Json::Map(vec![("format".into(), text(FORMAT)), ("name".into(), text(name)), ("objects".into(), Json::List(vec![object]))])
}

fn load_json(files: &dyn SceneFiles, path: &str, json: &Json, options: &LoadOptions) -> Result<Scene, SceneError> {
    let root = Node::root(path, json).fields()?;
    let mut assembly = Assembly::new(files, path);
    expect_text(&root, "format", FORMAT)?;
    // Both are what the format means anyway; a file that says otherwise is not understood.
    for (key, only) in [("up", "+Y"), ("handedness", "right")] {
        if root.optional(key).is_some() {
            expect_text(&root, key, only)?;
        }
    }
    assembly.scene.name = root.optional("name").map_or(Ok("unnamed"), |n| n.text())?.to_owned();
    materials::add(&mut assembly, root.optional("materials"))?;
    for node in root.required("objects")?.list()? {
        objects::add(&mut assembly, &node)?;
    }
    for (i, node) in root.optional("lights").map_or(Ok(Vec::new()), |n| n.list())?.iter().enumerate() {
        light(&mut assembly, node, i)?;
    }
    for node in root.optional("cameras").map_or(Ok(Vec::new()), |n| n.list())? {
        camera(&mut assembly, &node)?;
    }
    let written = root.optional("environment");
    assembly.scene.environment = match (&options.environment, written) {
        (Some(file), _) => given_environment(&mut assembly, file)?,
        (None, Some(node)) => written_environment(&mut assembly, &node)?,
        (None, None) => Environment::Constant(Vec3::ZERO),
    };
    root.finish()?;
    Ok(assembly.scene)
}

fn expect_text(fields: &Fields, key: &'static str, only: &str) -> Result<(), SceneError> {
    let node = fields.required(key)?;
    if node.text()? == only { Ok(()) } else { Err(node.wrong(format!("{only:?}"))) }
}

fn light(assembly: &mut Assembly, node: &Node, index: usize) -> Result<(), SceneError> {
    let fields = node.fields()?;
    let kind = fields.required("type")?;
    let name = fields.optional("name").map_or(Ok(format!("light {index}")), |n| n.name().map(str::to_owned))?;
    match kind.text()? {
        "point" => {
            let position = fields.required("position")?.vec3()?;
            let intensity = fields.required("intensity")?.light()?;
            fields.finish()?;
            assembly.scene.point_lights.push(PointLight { position, intensity });
        }
        "disc" | "rect" => {
            let radiance = fields.required("radiance")?.light()?;
            objects::add_area_light(assembly, fields, &name, radiance)?;
        }
        _ => return Err(kind.wrong("\"point\", \"disc\" or \"rect\" (or an object with \"emission\")")),
    }
    Ok(())
}

fn camera(assembly: &mut Assembly, node: &Node) -> Result<(), SceneError> {
    let fields = node.fields()?;
    let name_node = fields.required("name")?;
    let name = name_node.name()?;
    if !assembly.take_name("camera", name) {
        return Err(name_node.duplicate(name));
    }
    let vec3 = |key| fields.required(key).and_then(|n| n.vec3());
    let (origin, target) = (vec3("origin")?, vec3("target")?);
    let up = fields.optional("up").map_or(Ok(Vec3::Y), |n| n.vec3())?;
    let vfov_deg = fields.required("vfov_deg")?.number()?;
    let size = |key| fields.required(key).and_then(|n| n.count(1..=65536));
    let (width, height) = (size("width")?, size("height")?);
    let pose = Pose::look_at(origin, target, up).map_err(|e| node.wrong(format!("a camera with origin, target and up apart ({e})")))?;
    let camera =
        Intrinsics::from_vfov(vfov_deg, width, height).and_then(|i| Camera::new(i, pose)).map_err(|e| node.wrong(e.to_string()))?;
    fields.finish()?;
    assembly.scene.cameras.push(NamedCamera { name: name.to_owned(), camera });
    Ok(())
}

fn written_environment(assembly: &mut Assembly, node: &Node) -> Result<Environment, SceneError> {
    let fields = node.fields()?;
    if let Some(radiance) = fields.optional("radiance") {
        let radiance = radiance.light()?;
        fields.finish()?;
        return Ok(Environment::Constant(radiance));
    }
    let scale = fields.optional("scale").map_or(Ok(1.0), |n| n.number_in(0.0..=1e9))?;
    let rotation_deg = fields.optional("rotation_deg").map_or(Ok(0.0), |n| n.number())?;
    let layout = match fields.optional("layout") {
        None => None,
        Some(n) => Some(Layout::from_name(n.text()?).ok_or_else(|| n.wrong(Layout::NAMES))?),
    };
    let (name, image) = match (fields.optional("file"), fields.optional("files")) {
        (Some(file), None) => {
            let path = assembly.beside(file.text()?);
            let bytes = assembly.read(&path, &file)?;
            let image = assembly.picture(&bytes, &path)?;
            let map = environment::from_picture(image, layout.unwrap_or(Layout::LatLong));
            (path.clone(), map.map_err(|message| SceneError::Image { file: path, message })?)
        }
        (None, Some(files)) => (files.at(), cube_of_files(assembly, &files, layout)?),
        _ => return Err(node.wrong("an environment with one of \"radiance\", \"file\" or \"files\"")),
    };
    fields.finish()?;
    Ok(map(assembly, &name, image, scale, rotation_deg))
}

// Six faces, +X −X +Y −Y +Z −Z, a file each. Whose convention they follow cannot be guessed.
fn cube_of_files(assembly: &mut Assembly, files: &Node, layout: Option<Layout>) -> Result<Image, SceneError> {
    let paths = files.list()?;
    let layout = layout.filter(|l| matches!(l, Layout::CubeOpenGl | Layout::CubeOpenExr));
    let (Some(layout), 6) = (layout, paths.len()) else {
        return Err(files.wrong("six files +X −X +Y −Y +Z −Z and a \"layout\", \"cube-opengl\" or \"cube-openexr\""));
    };
    let mut faces = Vec::new();
    for node in &paths {
        let path = assembly.beside(node.text()?);
        let bytes = assembly.read(&path, node)?;
        faces.push(assembly.picture(&bytes, &path)?);
    }
    environment::from_faces(&faces, layout).map_err(|message| SceneError::Image { file: files.at(), message })
}

fn given_environment(assembly: &mut Assembly, file: &EnvironmentFile) -> Result<Environment, SceneError> {
    let wrong = |message: String| SceneError::Image { file: file.name.clone(), message };
    if !(file.scale.is_finite() && file.scale >= 0.0 && file.rotation_deg.is_finite()) {
        return Err(wrong(format!("scale {} and rotation {} degrees, finite numbers expected", file.scale, file.rotation_deg)));
    }
    let image = assembly.picture(&file.bytes, &file.name)?;
    let image = environment::from_picture(image, Layout::LatLong).map_err(wrong)?;
    Ok(map(assembly, &file.name, image, file.scale, file.rotation_deg))
}

fn map(assembly: &mut Assembly, name: &str, image: Image, scale: f32, rotation_deg: f32) -> Environment {
    let (image, mended) = environment::make_radiance(image, scale);
    if mended.negative + mended.infinite > 0 {
        let (n, i) = (mended.negative, mended.infinite);
        assembly.scene.notes.push(format!("environment {name}: {n} negative values set to 0, {i} infinite ones to 65504"));
    }
    Environment::Map(EnvironmentMap { image, rotation: rotation_deg.to_radians() })
}
