//! Points, directions, cameras and surfaces. Knows nothing of light.

mod bezier_patch;
mod camera;
mod distortion;
mod normal_map;
mod photograph_camera;
mod pose;
mod ray;
mod subdivision;
mod tangent_frame;
mod triangle_mesh;

pub use bezier_patch::{BezierPatch, PatchPoint};
pub use camera::{Camera, CameraError, Intrinsics};
pub use distortion::{Distortion, DistortionError};
pub use normal_map::{Mapping, NormalMap, Tangent, turned_normal};
pub use photograph_camera::PhotographCamera;
pub use pose::{Pose, PoseError};
pub use ray::Ray;
pub use subdivision::subdivide;
pub use tangent_frame::{TangentFrame, side_of_v, tangent_along_u};
pub use triangle_mesh::{MeshError, TriangleMesh};
