// Twin of trace.rs. What a pixel sees of the object. Expects `object_triangles` and `object_vertices` from the kernel that includes it.

struct ObjectVertex {
    x: f32, y: f32, z: f32,
    normal_x: f32, normal_y: f32, normal_z: f32,
    u: f32, v: f32,
    part: u32,
}

struct ObjectPoint {
    uv: vec2<f32>,
    normal: vec3<f32>,
    distance: f32,
    part: u32,
    front: bool,
}

fn vertex_position(v: ObjectVertex) -> vec3<f32> {
    return vec3(v.x, v.y, v.z);
}

fn vertex_normal(v: ObjectVertex) -> vec3<f32> {
    return vec3(v.normal_x, v.normal_y, v.normal_z);
}

fn object_point(direction: vec3<f32>, triangle: u32) -> ObjectPoint {
    let a = object_vertices[object_triangles[3u * triangle]];
    let b = object_vertices[object_triangles[3u * triangle + 1u]];
    let c = object_vertices[object_triangles[3u * triangle + 2u]];
    let at = meet(direction, vertex_position(a), vertex_position(b), vertex_position(c));
    let w = at.weights;
    let uv = w.x * vec2(a.u, a.v) + w.y * vec2(b.u, b.v) + w.z * vec2(c.u, c.v);
    let normal = w.x * vertex_normal(a) + w.y * vertex_normal(b) + w.z * vertex_normal(c);
    return ObjectPoint(uv, normalize_or(normal, -direction), at.distance, a.part, at.front);
}
