// Twin of rasterize.rs. For tests: the whole G-buffer, laid out as `GBufferPixel` says, seven elements a pixel.

@group(2) @binding(0) var object_triangles: texture_2d<u32>;
@group(2) @binding(1) var object_vertices: texture_2d<f32>;
@group(2) @binding(2) var<storage, read_write> resolved: array<vec4<f32>>;

@compute @workgroup_size(64)
fn resolve(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= band_pixels() {
        return;
    }
    let at = vec2(id.x % camera.size.x, id.x / camera.size.x);
    let direction = direction_of(at);
    let list = list_of(at);
    let triangle = visible_triangle(at) - 1u;
    var a = vec4(0.0, 0.0, -2.0, camera.infinity);
    var b = vec3(0.0);
    var across = SurfaceDifferential(vec3(0.0), vec3(0.0), vec2(0.0));
    var down = across;
    var tangent = vec4(0.0);
    if list == OBJECT_LIST {
        let point = object_point(direction, triangle);
        a = vec4(point.uv, select(-4.0 - f32(point.part), f32(point.part), point.front), point.distance);
        b = point.normal;
        across = point.across;
        down = point.down;
        tangent = vec4(point.tangent, point.side_of_v);
    } else if list == SKY_LIST {
        b = environment_radiance(direction);
    } else {
        let point = background_point(direction, triangle - camera.object_end);
        a = vec4(point.uv, select(-1.0, -3.0, point.unknown), point.distance);
        b = point.radiance;
    }
    resolved[7u * id.x] = a;
    resolved[7u * id.x + 1u] = vec4(b, 0.0);
    resolved[7u * id.x + 2u] = vec4(across.position, across.uv.x);
    resolved[7u * id.x + 3u] = vec4(across.normal, across.uv.y);
    resolved[7u * id.x + 4u] = vec4(down.position, down.uv.x);
    resolved[7u * id.x + 5u] = vec4(down.normal, down.uv.y);
    resolved[7u * id.x + 6u] = tangent;
}
