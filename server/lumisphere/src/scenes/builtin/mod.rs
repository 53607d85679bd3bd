//! Scenes that the product generates: no licence, any resolution, exact answers.
//!
//! Each is written as a scene file with its pictures ([`builtin_files`]) and read by the ordinary loader, so what is exported is what
//! is rendered. The file's `generator` holds name, version, seed and sizes: with the same version the same bytes come out.

mod furnace;
mod gazebo;
mod glossy_plane;
mod options;
mod patchwork;
mod patterns;
mod six_colours;
mod sky;

use serde_json::Value;

use super::error::SceneError;
use super::files::SceneBundle;
use super::scene::Scene;
use super::scene_file::{LoadOptions, load};

pub use options::{BuiltinOptions, PatchworkOptions, PlaneLamp, PlaneOptions};

/// What there is.
pub const BUILTIN_NAMES: [&str; 6] = ["gazebo", "furnace", "furnace_inside", "six_colours", "glossy_plane", "patchwork"];

/// Path of the scene file in what [`builtin_files`] returns.
pub const BUILTIN_SCENE_PATH: &str = "scene.json";

/// Raised whenever a generator's output changes.
const GENERATOR_VERSION: u32 = 1;

/// A generated scene, read by the ordinary loader.
pub fn builtin(name: &str, options: &BuiltinOptions) -> Result<Scene, SceneError> {
    load(&builtin_files(name, options)?, BUILTIN_SCENE_PATH, &LoadOptions::as_written())
}

/// The files of a generated scene: `scene.json` and the pictures it names.
pub fn builtin_files(name: &str, options: &BuiltinOptions) -> Result<SceneBundle, SceneError> {
    let options = options.clone().checked()?;
    let mut parts = Parts::default();
    let mut scene = match name {
        "gazebo" => gazebo::scene(&options, &mut parts)?,
        "furnace" => furnace::ball(),
        "furnace_inside" => furnace::inside(),
        "six_colours" => six_colours::scene(),
        "glossy_plane" => glossy_plane::scene(&options.plane),
        "patchwork" => patchwork::scene(&options, &mut parts)?,
        _ => {
            return Err(SceneError::UnknownBuiltin { name: name.to_owned(), known: BUILTIN_NAMES.join(", ") });
        }
    };
    scene["format"] = super::FORMAT.into();
    scene["name"] = name.into();
    let mut generator = serde_json::json!({
        "name": format!("lumisphere {name}"), "version": GENERATOR_VERSION, "seed": options.seed,
        "texture_px": options.texture_px, "sky_px": options.sky_px, "patch_steps": options.patch_steps,
    });
    // What a generator asks for besides, it writes there itself.
    if let (Some(all), Value::Object(own)) = (generator.as_object_mut(), scene["generator"].take()) {
        all.extend(own);
    }
    scene["generator"] = generator;
    if let Some((file, bytes)) = &options.environment {
        parts.add(file, bytes.clone())?;
        scene["environment"] = serde_json::json!({ "file": file });
    }
    let text = serde_json::to_vec_pretty(&scene).expect("a JSON value without special keys always has a text");
    parts.add(BUILTIN_SCENE_PATH, text)?;
    Ok(parts.bundle)
}

/// Files while a scene is generated.
#[derive(Default)]
struct Parts {
    bundle: SceneBundle,
}

impl Parts {
    fn add(&mut self, path: &str, bytes: Vec<u8>) -> Result<(), SceneError> {
        self.bundle.insert(path, bytes).map_err(|source| SceneError::File { by: "the generator's options".into(), source })
    }

    fn add_picture(&mut self, path: &str, bytes: Result<Vec<u8>, crate::images::ImageError>) -> Result<(), SceneError> {
        let bytes = bytes.map_err(|e| SceneError::Image { file: path.to_owned(), message: e.to_string() })?;
        self.add(path, bytes)
    }
}

/// A view for the scene file.
fn camera(name: &str, origin: [f32; 3], target: [f32; 3], vfov_deg: f32) -> Value {
    serde_json::json!({ "name": name, "origin": origin, "target": target, "up": [0, 1, 0], "vfov_deg": vfov_deg, "width": 640, "height": 480 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::Surface;

    #[test]
    fn every_built_in_scene_loads_and_is_the_same_again() {
        for name in BUILTIN_NAMES {
            let files = builtin_files(name, &BuiltinOptions::small()).unwrap();
            assert_eq!(files, builtin_files(name, &BuiltinOptions::small()).unwrap(), "{name}");
            let scene = builtin(name, &BuiltinOptions::small()).unwrap();
            assert!(!scene.objects.is_empty() && !scene.cameras.is_empty(), "{name}");
            assert!(scene.notes.is_empty(), "{name}: {:?}", scene.notes);
        }
    }

    #[test]
    fn a_seed_changes_the_pictures_and_is_written_down() {
        let files = |seed| builtin_files("gazebo", &BuiltinOptions { seed, ..BuiltinOptions::small() }).unwrap().files;
        let (a, b) = (files(1), files(2));
        assert_ne!(a["grass.png"], b["grass.png"]);
        let json: Value = serde_json::from_slice(&b[BUILTIN_SCENE_PATH]).unwrap();
        assert_eq!(json["generator"]["seed"], 2);
    }

    #[test]
    fn what_one_generator_alone_is_asked_for_is_written_down_too() {
        let options = BuiltinOptions::small();
        let json: Value = serde_json::from_slice(&builtin_files("patchwork", &options).unwrap().files[BUILTIN_SCENE_PATH]).unwrap();
        assert_eq!((&json["generator"]["relief_steps"], &json["generator"]["texture_px"]), (&48.into(), &256.into()));
    }

    #[test]
    fn unknown_names_and_sizes_are_refused() {
        assert!(builtin("gazbo", &BuiltinOptions::small()).unwrap_err().to_string().contains("gazebo, furnace"));
        let huge = BuiltinOptions { texture_px: 1 << 20, ..BuiltinOptions::small() };
        assert!(builtin("gazebo", &huge).unwrap_err().to_string().contains("texture_px is 1048576"));
    }

    #[test]
    fn the_gazebo_holds_the_historic_teapot_within_its_budget() {
        let scene = builtin("gazebo", &BuiltinOptions { texture_px: 64, sky_px: 64, ..BuiltinOptions::full() }).unwrap();
        let triangles: usize = scene.objects.iter().map(|o| o.mesh.triangles.len()).sum();
        assert!(triangles < 60_000, "{triangles}");
        let teapot = &scene.objects[scene.object("teapot").unwrap()];
        let Surface::Patches { patches, patch_of_triangle } = &teapot.surface else { panic!("the teapot is made of patches") };
        assert_eq!(patches.len(), 28);
        assert_eq!(patch_of_triangle.iter().max(), Some(&27));
        for cup in ["cup", "second cup", "spoon"] {
            assert!(scene.object(cup).is_some(), "{cup}");
        }
    }

    #[test]
    fn a_given_environment_lights_the_gazebo() {
        let image = crate::images::Image { width: 4, height: 2, planes: vec![vec![0.25; 8]; 3] };
        let bytes = crate::images::encode_exr_rgb(&image, crate::images::ExrStorage::Float).unwrap();
        let options = BuiltinOptions { environment: Some(("mine.exr".into(), bytes)), ..BuiltinOptions::small() };
        let scene = builtin("gazebo", &options).unwrap();
        assert_eq!(scene.environment.radiance(glam::Vec3::Y), glam::Vec3::splat(0.25));
        assert!(!builtin_files("gazebo", &options).unwrap().files.contains_key("sky.exr"));
    }
}
