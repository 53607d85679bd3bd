//! Scenes of jobs and of ground truth: generated, or read from uploaded blobs.

use std::collections::BTreeMap;

use lumisphere::raytrace::working_bytes;
use lumisphere::scenes::{
    BUILTIN_SCENE_PATH, DEFAULT_FILE_LIMIT_BYTES, EnvironmentFile, FileError, LoadOptions, Scene, SceneFiles, builtin_files, load,
    normalised,
};
use lumisphere::textures::{ContentHash, Store, StoreError};

use crate::catalog::OpenedVersion;
use crate::errors::{ApiError, Reason};
use crate::wire::scenes::{SceneBase, SceneSource, scene_source};

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
pub fn read_bounded(store: &Store, hash: &ContentHash, path: &str) -> Result<Vec<u8>, FileError> {
    let failed = |error: StoreError| FileError::Io { path: path.into(), source: std::io::Error::other(error) };
    match store.blob_bytes(hash).map_err(failed)? > DEFAULT_FILE_LIMIT_BYTES {
        true => Err(FileError::TooLarge { path: path.into(), limit_bytes: DEFAULT_FILE_LIMIT_BYTES }),
        false => store.read_blob(hash).map_err(failed),
    }
}

/// From which scene a version was made.
pub fn scene_of(version: &OpenedVersion) -> Result<SceneSource, ApiError> {
    let source = version.origin.as_ref().and_then(|o| o.scene()).ok_or_else(|| {
        let message = format!("dataset {} version {} does not say from which scene it was captured", version.dataset, version.version);
        ApiError::new(Reason::SceneUnknown, message)
    })?;
    scene_source(Some(source.clone()), "scene")
}

/// Reads the scene, with its other environment if there is one; not one that would take more than `limit_bytes` while it is traced.
pub fn load_scene(source: &SceneSource, store: &Store, limit_bytes: u64) -> Result<Scene, ApiError> {
    Ok(load_measured(source, store, limit_bytes)?.0)
}

/// The same, and the bytes that it would take.
pub fn load_measured(source: &SceneSource, store: &Store, limit_bytes: u64) -> Result<(Scene, u64), ApiError> {
    let scene = read_scene(source, store)?;
    let bytes = working_bytes(&scene);
    if bytes > limit_bytes {
        let message = format!(
            "the scene would take about {bytes} bytes of memory while it is traced, at most {limit_bytes} (job_scene_bytes) expected"
        );
        return Err(ApiError::new(Reason::SceneTooLarge, message).with("bytes", bytes).with("limit_bytes", limit_bytes));
    }
    Ok((scene, bytes))
}

fn read_scene(source: &SceneSource, store: &Store) -> Result<Scene, ApiError> {
    let environment = source.environment.as_ref().map(|e| {
        let bytes = read_bounded(store, &e.content, &e.file_name).map_err(|e| ApiError::new(Reason::SceneInvalid, e.to_string()))?;
        Ok::<_, ApiError>(EnvironmentFile { name: e.file_name.clone(), bytes, scale: e.scale, rotation_deg: e.rotation_deg })
    });
    let options = LoadOptions { environment: environment.transpose()? };
    Ok(match &source.base {
        SceneBase::Builtin { name, options: generator } => load(&builtin_files(name, generator)?, BUILTIN_SCENE_PATH, &options)?,
        SceneBase::Bundle { scene_path, files } => {
            let files = files.iter().map(|(path, hash)| (path.as_str(), *hash)).collect();
            load(&BundleInStore { store, files }, scene_path, &options)?
        }
    })
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
    use lumisphere::scenes::BuiltinOptions;
    use lumisphere::textures::StoreOptions;

    use super::*;

    #[test]
    fn a_bundle_is_read_from_its_blobs_and_nothing_beside_them() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let made = builtin_files("six_colours", &BuiltinOptions::small()).unwrap();
        let files: Vec<(String, ContentHash)> =
            made.files.iter().map(|(path, bytes)| (path.clone(), store.put_upload(bytes).unwrap())).collect();
        let bundle =
            |files: Vec<_>| SceneSource { base: SceneBase::Bundle { scene_path: BUILTIN_SCENE_PATH.into(), files }, environment: None };
        let loaded = load_scene(&bundle(files.clone()), &store, u64::MAX).unwrap();
        assert!(!loaded.objects.is_empty());
        let bytes = working_bytes(&loaded);
        assert!(load_scene(&bundle(files.clone()), &store, bytes).is_ok());
        let refused = load_scene(&bundle(files.clone()), &store, bytes - 1).unwrap_err();
        assert_eq!(refused.reason(), Reason::SceneTooLarge);
        let truncated = store.put_upload(&made.files[BUILTIN_SCENE_PATH][..20]).unwrap();
        let broken = files.iter().map(|(p, h)| (p.clone(), if p == BUILTIN_SCENE_PATH { truncated } else { *h })).collect();
        assert_eq!(load_scene(&bundle(broken), &store, u64::MAX).unwrap_err().reason(), Reason::SceneInvalid);
    }
}
