//! Datasets, their files, and the cache out.

use lumisphere::textures::{ContentHash, Manifest};
use prost::Message;

use super::{proto, timestamp};

/// Name of the blob in which a capture keeps where its version came from.
pub const ORIGIN: &str = "origin";

/// One version, from its manifest; `origin` from the blob of that name.
pub fn dataset_version(manifest: &Manifest, origin: Option<Origin>) -> proto::DatasetVersion {
    let (scene_source, object_bounds) = origin.map_or((None, None), |o| (o.0.scene_source, o.0.object_bounds));
    proto::DatasetVersion {
        version: manifest.version,
        create_time: Some(timestamp(manifest.created_unix_millis)),
        size_bytes: manifest.stored_bytes(),
        page_count: manifest.pages.count.into(),
        parameters_json: manifest.parameters.to_string(),
        scene_source,
        object_bounds,
    }
}

/// A version of which nothing but its number can be read.
pub fn damaged_version(version: u64) -> proto::DatasetVersion {
    proto::DatasetVersion { version, ..Default::default() }
}

/// Where a version came from: a `DatasetVersion` of which only `scene_source` and `object_bounds` are set.
#[derive(Debug, Clone)]
pub struct Origin(proto::DatasetVersion);

impl Origin {
    /// To be kept in the blob [`ORIGIN`].
    pub fn new(scene: Option<proto::SceneSource>, bounds: (glam::Vec3, glam::Vec3)) -> Self {
        let (min, max) = (Some(super::camera::vector(bounds.0)), Some(super::camera::vector(bounds.1)));
        let object_bounds = Some(proto::Box3 { min, max });
        Self(proto::DatasetVersion { scene_source: scene, object_bounds, ..Default::default() })
    }

    /// The blob's bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.0.encode_to_vec()
    }

    /// None for bytes that are none.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        proto::DatasetVersion::decode(bytes).ok().map(Self)
    }

    /// The scene that the version was captured from.
    pub fn scene(&self) -> Option<&proto::SceneSource> {
        self.0.scene_source.as_ref()
    }

    /// Around the object, world space.
    pub fn bounds(&self) -> Option<(glam::Vec3, glam::Vec3)> {
        let bounds = self.0.object_bounds?;
        Some((super::camera::vec3(bounds.min?), super::camera::vec3(bounds.max?)))
    }
}

/// Bytes of the manifest as they are downloaded: JSON.
pub fn manifest_bytes(manifest: &Manifest) -> Vec<u8> {
    serde_json::to_vec_pretty(manifest).expect("a manifest has string keys and finite numbers")
}

/// The manifest first, then segments, then blobs.
pub fn dataset_files(manifest: &Manifest) -> proto::ListDatasetFilesResponse {
    use proto::DatasetFileRole as Role;
    let file = |role: Role, name: String, hash: &ContentHash, size_bytes| proto::DatasetFile {
        role: role as i32,
        name,
        blake3: hash.to_string(),
        size_bytes,
    };
    let bytes = manifest_bytes(manifest);
    let own = file(Role::Manifest, "manifest.json".into(), &ContentHash::of(&bytes), bytes.len() as u64);
    let segments = manifest.segments.iter().map(|s| file(Role::Segment, format!("{}.seg", s.blake3), &s.blake3, s.bytes));
    let blobs = manifest.blobs.iter().map(|(name, b)| file(Role::Blob, name.clone(), &b.blake3, b.bytes));
    proto::ListDatasetFilesResponse { version: manifest.version, files: [own].into_iter().chain(segments).chain(blobs).collect() }
}
