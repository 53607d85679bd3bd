// The camera of a band of a frame: rows first_row … first_row + size.y − 1. Twin of geometry/camera.rs.

struct Camera {
    position: vec3<f32>,
    // Depth before which nothing is seen.
    near: f32,
    right: vec3<f32>,
    focal_x: f32,
    up: vec3<f32>,
    focal_y: f32,
    backward: vec3<f32>,
    // Radians that a pixel subtends.
    pixel_angle: f32,
    center: vec2<f32>,
    // Of the band, in pixels.
    size: vec2<u32>,
    first_row: u32,
    // Of the environment's rotation.
    environment_cos: f32,
    environment_sin: f32,
    // +∞, which WGSL cannot write.
    infinity: f32,
    // Triangles are numbered: the object's, the background's with one colour, those with textures.
    object_end: u32,
    plain_end: u32,
    padding: vec2<u32>,
}

// Unit direction through the centre of the band's pixel (i, j).
fn pixel_direction(camera: Camera, i: u32, j: u32) -> vec3<f32> {
    let at = vec2(f32(i) + 0.5, f32(j + camera.first_row) + 0.5);
    let d = (at - camera.center) / vec2(camera.focal_x, camera.focal_y);
    return normalize(d.x * camera.right - d.y * camera.up - camera.backward);
}

struct RayDerivatives {
    across: vec3<f32>,
    down: vec3<f32>,
}

fn ray_derivatives(camera: Camera, direction: vec3<f32>) -> RayDerivatives {
    let depth = -dot(camera.backward, direction);
    return RayDerivatives(camera.right * (depth / camera.focal_x), -camera.up * (depth / camera.focal_y));
}
