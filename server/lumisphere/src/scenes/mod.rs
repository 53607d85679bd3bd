//! Scenes: geometry, materials, light and cameras; read from files or generated.

mod assembly;
mod builtin;
mod environment;
mod error;
mod files;
mod json;
#[cfg(test)]
mod loading_tests;
mod model;
mod noise;
mod objects;
mod scene;
mod scene_file;
mod shapes;
mod tea_set;
mod tessellate;
mod transform;

pub use builtin::{BUILTIN_NAMES, BUILTIN_SCENE_PATH, BuiltinOptions, builtin, builtin_files};
pub use environment::{Layout, from_faces, from_picture};
pub use error::SceneError;
pub use files::{DEFAULT_FILE_LIMIT_BYTES, FileError, SceneBundle, SceneFiles, SceneFolder, normalised};
pub use scene::{Albedo, Environment, EnvironmentMap, Material, NamedCamera, Object, PointLight, Scene, Surface, Texture};
pub use scene_file::{EnvironmentFile, FORMAT, LoadOptions, bundle, load, referenced_files};
pub use tea_set::{HISTORIC_TEAPOT_PATCHES, TeaSet, patches as tea_set_patches};
pub use tessellate::{MAX_STEPS, Resolution, tessellate};
