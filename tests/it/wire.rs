//! Short ways to write and read messages.

use lumisphere_proto::v1alpha1 as wire;
use tonic::{Code, Status};
use tonic_types::StatusExt;
use wire::offset_surface_light_field_settings::{Blend, Component};

fn vector([x, y, z]: [f32; 3]) -> Option<wire::Vector3> {
    Some(wire::Vector3 { x, y, z })
}

/// Looks along −Z from (0, 1, 3): the tiny scene's box is in the middle.
pub fn camera(width_px: u32, height_px: u32) -> wire::Camera {
    camera_around(0.0, width_px, height_px)
}

/// The same, turned about the box by an angle in radians.
pub fn camera_around(angle: f32, width_px: u32, height_px: u32) -> wire::Camera {
    let (sin, cos) = angle.sin_cos();
    let pose = wire::Pose {
        position: vector([3.0 * sin, 1.0, 3.0 * cos]),
        right: vector([cos, 0.0, -sin]),
        up: vector([0.0, 1.0, 0.0]),
        backward: vector([sin, 0.0, cos]),
    };
    let intrinsics =
        wire::Intrinsics { width_px, height_px, focal_x_px: height_px as f32, focal_y_px: 0.0, center_x_px: None, center_y_px: None };
    wire::Camera { pose: Some(pose), intrinsics: Some(intrinsics) }
}

/// Settings of the one representation.
pub fn settings(component: Component, blend: Blend) -> wire::RenderSettings {
    let settings = wire::OffsetSurfaceLightFieldSettings {
        component: component.into(),
        blend: blend.into(),
        exponent: None,
        specular_reflectance: None,
        filter: 0,
        gloss: None,
        relighting: None,
        reflections: 0,
        refraction: None,
        normal_map: None,
    };
    wire::RenderSettings {
        representation: Some(wire::render_settings::Representation::OffsetSurfaceLightField(settings)),
        ..Default::default()
    }
}

/// Only an encoding.
pub fn output(encoding: wire::Encoding) -> wire::OutputSettings {
    wire::OutputSettings { encoding: encoding.into(), ..Default::default() }
}

/// A small frame of the tiny dataset, both terms, lossless.
pub fn frame_request(dataset: &str) -> wire::RenderFrameRequest {
    wire::RenderFrameRequest {
        dataset: dataset.into(),
        version: 0,
        camera: Some(camera(32, 24)),
        settings: Some(settings(Component::Full, Blend::Average)),
        output: Some(output(wire::Encoding::RawZstd)),
        pose_id: 0,
    }
}

/// Code and reason of an error.
pub fn code_and_reason(status: &Status) -> (Code, String) {
    (status.code(), status.get_details_error_info().map(|info| info.reason).unwrap_or_default())
}

/// Fields that an INVALID_ARGUMENT names.
pub fn fields(status: &Status) -> Vec<String> {
    status.get_details_bad_request().map(|b| b.field_violations.into_iter().map(|v| v.field).collect()).unwrap_or_default()
}

/// Rows from the top, R G B interleaved, of a RAW_ZSTD frame.
pub fn raw_pixels(bytes: &[u8]) -> Vec<f32> {
    let raw = zstd::decode_all(bytes).expect("one zstd frame");
    raw.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes"))).collect()
}
