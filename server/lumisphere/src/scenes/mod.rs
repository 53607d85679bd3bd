//! Scenes: geometry, materials, light and cameras; read from files or generated.
//!
//! # The scene file
//! JSON, `"format": "neutral-scene/1"`; right-handed, +Y up. Paths are relative to it and may not leave its folder. Files that others
//! wrote in this format load unchanged; keys it does not know are refused, but for remarks (`about`, `comment`, `author`, `license`,
//! `source`, `credits`, `generator`, `hint_*`). What is marked + extends the format.
//!
//! | key | value |
//! | --- | --- |
//! | `materials.NAME` | `{type: "diffuse", albedo: [r,g,b] or albedo_texture: file}` · `{type: "mirror", reflectance}` · `{type: "ggx", alpha, reflectance}`; + `"phong"`, `"ashikhmin_shirley"`, `"cook_torrance"`, `"ward"`, `"lafortune"` with the keys of `radiometry::brdf::BrdfParameters`, `{type: "measured", file}` (MERL's binary tables), `{type: "glossy", diffuse, specular, roughness}` (Ashikhmin & Shirley's model; each a constant, or under `diffuse_texture`, `specular_texture`, `roughness_texture` a picture; roughness: one number, [along u, along v], or red and green); +X of an anisotropic one lies along the texture's u. Textures: v runs up, repeat, bilinear; PNG and JPEG are sRGB, EXR and .hdr linear |
//! | `objects[]` | `name`, one geometry, `material`; `emission` [r,g,b]: radiance of a one-sided light, front = where normals point |
//! | ` mesh` | OBJ file; + without `material` it is cut into objects `name/part` by its own MTL. `triangles`, where given, must be its count |
//! | ` patches` + | `"builtin:teapot"`, `"builtin:teacup"`, `"builtin:teaspoon"` or a `.bpt` file (`up_axis` "+Y" or "+Z"); `first_patches` n; `tessellation` `{per_edge: n}` or `{max_edge: length}` |
//! | ` gltf` + | `.glb` or `.gltf`; brings its materials, cameras and point lights; objects are named `name/node` |
//! | ` shape` + | `{type: "rect", corner, edge_u, edge_v}` · `{type: "disc", center, normal, radius}` · `{type: "box", min, max}` · `{type: "beam", from, to, width, height, up}` · `{type: "sphere", center, radius}` · `{type: "lathe", profile: [[radius, height], …], flat_sides}` · `{type: "cloth", radius, drop, folds, fold_depth}` · `{type: "blob", center, radii, roughness, seed}`; round ones take `segments` |
//! | ` transform` + | 16 numbers column by column, or `{translate, rotate_deg: [x,y,z], scale}`: scale, then turns about X, Y, Z, then move |
//! | ` flip`, `uv_scale` + | the other side in front; factor [u,v] on texture coordinates |
//! | `lights[]` + | `{type: "point", position, intensity}` (W/sr) · `{type: "disc" or "rect", …as the shape, radiance, name}` |
//! | `environment` | `{file, scale, rotation_deg}` · `{radiance}` · null; + `layout` "lat-long" (default), "lat-long-openexr", "cube-opengl", "cube-openexr", and `files` for six faces +X −X +Y −Y +Z −Z |
//! | `cameras[]` | `name, origin, target, up, vfov_deg, width, height` |

mod assembly;
mod builtin;
mod environment;
mod error;
mod files;
mod json;
#[cfg(test)]
mod loading_tests;
mod materials;
mod model;
mod noise;
mod objects;
mod relighting;
mod scene;
mod scene_file;
mod shapes;
mod tea_set;
mod tessellate;
mod transform;

pub use builtin::{BUILTIN_NAMES, BUILTIN_SCENE_PATH, BuiltinOptions, PatchworkOptions, PlaneLamp, PlaneOptions, builtin, builtin_files};
pub use environment::{Layout, from_faces, from_picture};
pub use error::SceneError;
pub use files::{DEFAULT_FILE_LIMIT_BYTES, FileError, SceneBundle, SceneFiles, SceneFolder, normalised};
pub use relighting::{MOST_POINT_LIGHTS, Relighting};
pub use scene::{Albedo, Environment, EnvironmentMap, Material, NamedCamera, Object, PointLight, Scene, Surface, Texture};
pub use scene_file::{EnvironmentFile, FORMAT, LoadOptions, bundle, load, referenced_files};
pub use tea_set::{HISTORIC_TEAPOT_PATCHES, TeaSet, patches as tea_set_patches};
pub use tessellate::{MAX_STEPS, Resolution, tessellate};
