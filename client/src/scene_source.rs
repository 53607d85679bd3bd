//! What `--scene` and `--environment` mean: a scene that ships with the server, or files to pack and upload.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use bytes::Bytes;
use clap::Args;
use lumisphere::scenes::{DEFAULT_FILE_LIMIT_BYTES, SceneFolder, bundle};
use lumisphere_proto::v1alpha1 as wire;
use tonic::transport::Channel;
use wire::datasets_client::DatasetsClient;
use wire::scene_source::Source;

use crate::context::Context;
use crate::exit::Failure;
use crate::output::bytes_text;
use crate::progress::Meter;
use crate::upload::{Blob, upload};

/// Geometry, materials and light.
#[derive(Debug, Clone, Args)]
pub struct SceneFlags {
    /// A scene that ships with the server (gazebo, patchwork, glossy_plane, furnace, six_colours), or a file: neutral-scene/1 .json, .glb, .gltf or .obj
    #[arg(long, value_name = "FILE|NAME")]
    pub scene: String,
    /// Parameter of a scene that ships with the server; may be repeated
    #[arg(long = "scene-parameter", value_name = "KEY=VALUE", value_parser = parse_pair)]
    pub parameters: Vec<(String, String)>,
    /// Light from infinity instead of the scene's: an EXR or Radiance .hdr file
    #[arg(long, value_name = "FILE")]
    pub environment: Option<PathBuf>,
    /// Factor on the environment's radiance
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, requires = "environment")]
    pub environment_scale: f32,
    /// Turn of the environment about +Y
    #[arg(long, value_name = "DEGREES", default_value_t = 0.0, allow_negative_numbers = true, requires = "environment")]
    pub environment_rotation_deg: f32,
}

impl SceneFlags {
    /// A scene as it is.
    pub fn plain(scene: &str) -> Self {
        Self { scene: scene.into(), parameters: Vec::new(), environment: None, environment_scale: 1.0, environment_rotation_deg: 0.0 }
    }
}

fn parse_pair(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("KEY=VALUE expected")?;
    Ok((key.to_string(), value.to_string()))
}

/// Uploads what must be uploaded and names the rest.
pub async fn to_wire(context: &Context, client: &mut DatasetsClient<Channel>, flags: &SceneFlags) -> anyhow::Result<wire::SceneSource> {
    let source = match scene_file(&flags.scene) {
        Some(path) => {
            if !flags.parameters.is_empty() {
                return Err(Failure::Usage("--scene-parameter is for scenes that ship with the server".into()).into());
            }
            Source::Bundle(upload_bundle(context, client, path).await?)
        }
        None => Source::Builtin(wire::BuiltinScene { name: flags.scene.clone(), parameters: flags.parameters.iter().cloned().collect() }),
    };
    let environment = match &flags.environment {
        Some(path) => Some(upload_environment(context, client, path, flags).await?),
        None => None,
    };
    Ok(wire::SceneSource { source: Some(source), environment })
}

/// A name has neither folder nor ending.
fn scene_file(scene: &str) -> Option<&Path> {
    let path = Path::new(scene);
    (path.extension().is_some() || scene.contains(['/', '\\'])).then_some(path)
}

async fn upload_bundle(context: &Context, client: &mut DatasetsClient<Channel>, path: &Path) -> anyhow::Result<wire::SceneBundle> {
    let (name, files) = pack(path)?;
    let total: usize = files.iter().map(|(_, bytes)| bytes.len()).sum();
    context.output.say(&format!("scene {}: {} files, {}", path.display(), files.len(), bytes_text(total as u64)));
    Ok(wire::SceneBundle { scene_path: name, files: upload_files(context, client, files).await? })
}

/// Uploads files, and lists them as the wire does.
pub async fn upload_files(
    context: &Context,
    client: &mut DatasetsClient<Channel>,
    files: Vec<(String, Bytes)>,
) -> anyhow::Result<Vec<wire::SceneFile>> {
    let mut listed = Vec::with_capacity(files.len());
    let mut meter = Meter::new(context.output);
    for (file, bytes) in files {
        let blob = Blob::from_bytes(bytes);
        upload(context, client, &blob, &mut meter, &format!("uploading {file}")).await.with_context(|| format!("uploading {file}"))?;
        listed.push(wire::SceneFile { path: file, blake3: blob.blake3 });
    }
    meter.finish();
    Ok(listed)
}

/// The scene's path within the bundle, and every file that loading it reads. A scene that cannot be loaded is refused here, before
/// anything is sent.
fn pack(path: &Path) -> anyhow::Result<(String, Vec<(String, Bytes)>)> {
    if !path.is_file() {
        return Err(Failure::NotFound(format!("no such scene file: {}", path.display())).into());
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = path.file_name().and_then(|n| n.to_str()).ok_or_else(|| Failure::Usage(format!("not a UTF-8 name: {}", path.display())))?;
    let bad_scene = |e: &dyn std::fmt::Display| Failure::Usage(format!("{}: {e}", path.display()));
    let files = SceneFolder::open(folder, DEFAULT_FILE_LIMIT_BYTES).map_err(|e| bad_scene(&e))?;
    let packed = bundle(&files, name).map_err(|e| bad_scene(&e))?;
    Ok((name.to_string(), packed.files.into_iter().map(|(path, bytes)| (path, Bytes::from(bytes))).collect()))
}

async fn upload_environment(
    context: &Context,
    client: &mut DatasetsClient<Channel>,
    path: &Path,
    flags: &SceneFlags,
) -> anyhow::Result<wire::EnvironmentOverride> {
    let blob = Blob::from_file(path)?;
    let file_name = path.file_name().and_then(|n| n.to_str()).unwrap_or("environment").to_string();
    let mut meter = Meter::new(context.output);
    upload(context, client, &blob, &mut meter, &format!("uploading {file_name}")).await?;
    meter.finish();
    Ok(wire::EnvironmentOverride {
        blake3: blob.blake3,
        file_name,
        scale: Some(flags.environment_scale),
        rotation_deg: flags.environment_rotation_deg,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_the_servers_scenes_and_paths_are_files() {
        assert_eq!(scene_file("gazebo"), None);
        for file in ["scene.json", "./gazebo", "a/b.glb"] {
            assert_eq!(scene_file(file), Some(Path::new(file)));
        }
    }

    #[test]
    fn a_missing_scene_file_is_exit_code_3_and_a_broken_one_2() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.json");
        assert_eq!(crate::exit::code(&pack(&path).unwrap_err()), 3);
        std::fs::write(&path, "{\"format\": \"neutral-scene/1\"").unwrap();
        assert_eq!(crate::exit::code(&pack(&path).unwrap_err()), 2);
    }

    #[test]
    fn a_scene_is_packed_with_all_that_it_names_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("triangle.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\n");
        write(
            "scene.json",
            r#"{"format": "neutral-scene/1", "materials": {"m": {"type": "diffuse", "albedo": [0.5, 0.5, 0.5]}},
            "objects": [{"name": "t", "mesh": "triangle.obj", "material": "m"}]}"#,
        );
        write("unrelated.txt", "private");
        let (name, files) = pack(&folder.path().join("scene.json")).unwrap();
        assert_eq!(name, "scene.json");
        assert_eq!(files.iter().map(|(path, _)| path.as_str()).collect::<Vec<_>>(), ["scene.json", "triangle.obj"]);
    }
}
