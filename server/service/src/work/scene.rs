//! Scenes of jobs: generated, or read from uploaded blobs.

use std::collections::BTreeMap;

use lumisphere::scenes::{
    BUILTIN_SCENE_PATH, BuiltinOptions, DEFAULT_FILE_LIMIT_BYTES, EnvironmentFile, FileError, LoadOptions, Scene, SceneFiles,
    builtin_files, load, normalised,
};
use lumisphere::textures::{ContentHash, Store, StoreError};

use crate::errors::{ApiError, Reason};
use crate::wire::clipped;
use crate::wire::scenes::{SceneBase, SceneSource};

/// A bundle whose files are blobs.
struct BundleInStore<'a> {
    store: &'a Store,
    files: BTreeMap<&'a str, ContentHash>,
}

impl SceneFiles for BundleInStore<'_> {
    fn read(&self, path: &str) -> Result<Vec<u8>, FileError> {
        let path = normalised(path)?;
        let hash = self.files.get(path.as_str()).ok_or_else(|| FileError::Missing { path: path.clone() })?;
        read_bounded(self.store, hash, &path)
    }
}

/// A blob whole, but not one that would fill the memory.
fn read_bounded(store: &Store, hash: &ContentHash, path: &str) -> Result<Vec<u8>, FileError> {
    let failed = |error: StoreError| FileError::Io { path: path.into(), source: std::io::Error::other(error) };
    match store.blob_bytes(hash).map_err(failed)? > DEFAULT_FILE_LIMIT_BYTES {
        true => Err(FileError::TooLarge { path: path.into(), limit_bytes: DEFAULT_FILE_LIMIT_BYTES }),
        false => store.read_blob(hash).map_err(failed),
    }
}

/// Reads the scene, with its other environment if there is one.
pub fn load_scene(source: &SceneSource, store: &Store) -> Result<Scene, ApiError> {
    let environment = source.environment.as_ref().map(|e| {
        let bytes = read_bounded(store, &e.content, &e.file_name).map_err(|e| ApiError::new(Reason::SceneInvalid, e.to_string()))?;
        Ok::<_, ApiError>(EnvironmentFile { name: e.file_name.clone(), bytes, scale: e.scale, rotation_deg: e.rotation_deg })
    });
    let options = LoadOptions { environment: environment.transpose()? };
    Ok(match &source.base {
        SceneBase::Builtin { name, parameters } => {
            load(&builtin_files(name, &builtin_options(parameters)?)?, BUILTIN_SCENE_PATH, &options)?
        }
        SceneBase::Bundle { scene_path, files } => {
            let files = files.iter().map(|(path, hash)| (path.as_str(), *hash)).collect();
            load(&BundleInStore { store, files }, scene_path, &options)?
        }
    })
}

/// The generator's parameters by name; the defaults are those of the documentation.
fn builtin_options(parameters: &BTreeMap<String, String>) -> Result<BuiltinOptions, ApiError> {
    let mut options = BuiltinOptions::full();
    for (name, value) in parameters {
        let place = match name.as_str() {
            "seed" => &mut options.seed,
            "texture_px" => &mut options.texture_px,
            "sky_px" => &mut options.sky_px,
            "patch_steps" => &mut options.patch_steps,
            _ => {
                let message =
                    format!("built-in scenes have no parameter {:?}; seed, texture_px, sky_px or patch_steps expected", clipped(name));
                return Err(ApiError::new(Reason::SceneInvalid, message));
            }
        };
        *place = value.parse().map_err(|_| {
            ApiError::new(Reason::SceneInvalid, format!("parameter {name} is {:?}, a whole number expected", clipped(value)))
        })?;
    }
    Ok(options)
}

/// Hashes of what a version was made from, by name.
pub fn inputs(source: &SceneSource) -> BTreeMap<String, ContentHash> {
    let files = match &source.base {
        SceneBase::Builtin { .. } => &[][..],
        SceneBase::Bundle { files, .. } => files,
    };
    let files = files.iter().map(|(path, hash)| (format!("scene/{path}"), *hash));
    files.chain(source.environment.iter().map(|e| ("environment".to_string(), e.content))).collect()
}

#[cfg(test)]
mod tests {
    use lumisphere::textures::StoreOptions;

    use super::*;

    fn builtin(parameters: &[(&str, &str)]) -> SceneSource {
        let parameters = parameters.iter().map(|(n, v)| (n.to_string(), v.to_string())).collect();
        SceneSource { base: SceneBase::Builtin { name: "six_colours".into(), parameters }, environment: None }
    }

    #[test]
    fn generated_scenes_take_named_parameters_and_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        assert!(!load_scene(&builtin(&[("texture_px", "64")]), &store).unwrap().objects.is_empty());
        for bad in [[("colour", "1")], [("seed", "one")], [("texture_px", "-1")], [("texture_px", "1000000")]] {
            assert_eq!(load_scene(&builtin(&bad), &store).unwrap_err().reason(), Reason::SceneInvalid, "{bad:?}");
        }
    }

    #[test]
    fn a_bundle_is_read_from_its_blobs_and_nothing_beside_them() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let made = builtin_files("six_colours", &BuiltinOptions::small()).unwrap();
        let files: Vec<(String, ContentHash)> =
            made.files.iter().map(|(path, bytes)| (path.clone(), store.put_upload(bytes).unwrap())).collect();
        let bundle =
            |files: Vec<_>| SceneSource { base: SceneBase::Bundle { scene_path: BUILTIN_SCENE_PATH.into(), files }, environment: None };
        assert!(!load_scene(&bundle(files.clone()), &store).unwrap().objects.is_empty());
        let truncated = store.put_upload(&made.files[BUILTIN_SCENE_PATH][..20]).unwrap();
        let broken = files.iter().map(|(p, h)| (p.clone(), if p == BUILTIN_SCENE_PATH { truncated } else { *h })).collect();
        assert_eq!(load_scene(&bundle(broken), &store).unwrap_err().reason(), Reason::SceneInvalid);
    }
}
