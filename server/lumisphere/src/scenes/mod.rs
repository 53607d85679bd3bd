//! Scenes: geometry, materials, light and cameras; read from files or generated.

mod scene;

pub use scene::{Albedo, Environment, EnvironmentMap, Material, NamedCamera, Object, PointLight, Scene, Surface, Texture};
