// Twin of trace.rs. Which triangle each pixel sees: all that is rasterised, so that a triangle of a few pixels costs no more than those pixels.
// Depth is reversed and infinite: near / depth, cleared to 0, greater wins. A pixel holds the triangle's number + 1, 0 for none.

@group(0) @binding(0) var<storage, read> camera: Camera;

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) @interpolate(flat, first) triangle: u32,
}

fn clip_from_world(position: vec3<f32>) -> vec4<f32> {
    let offset = position - camera.position;
    let x = dot(camera.right, offset);
    let y = dot(camera.up, offset);
    let depth = -dot(camera.backward, offset);
    let size = vec2<f32>(camera.size);
    let center = vec2(camera.center.x, camera.center.y - f32(camera.first_row));
    let column = 2.0 / size.x * (camera.focal_x * x + center.x * depth) - depth;
    let row = depth - 2.0 / size.y * (center.y * depth - camera.focal_y * y);
    return vec4(column, row, camera.near, depth);
}

// A triangle's first corner belongs to it alone and carries its number.
@vertex
fn corner(@location(0) position: vec3<f32>, @location(1) triangle: u32) -> Corner {
    return Corner(clip_from_world(position), triangle);
}

@fragment
fn visible(corner: Corner) -> @location(0) u32 {
    return corner.triangle + 1u;
}
