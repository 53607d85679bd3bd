// Twin of trace.rs. What a pixel sees of the object. Expects `object_triangles` and `object_vertices` from the kernel that includes it.

struct ObjectVertex {
    x: f32, y: f32, z: f32,
    normal_x: f32, normal_y: f32, normal_z: f32,
    u: f32, v: f32,
    part: u32,
}

// Derivatives by the pixel's column or row.
struct SurfaceDifferential {
    position: vec3<f32>,
    normal: vec3<f32>,
}

struct ObjectPoint {
    uv: vec2<f32>,
    normal: vec3<f32>,
    distance: f32,
    part: u32,
    front: bool,
    across: SurfaceDifferential,
    down: SurfaceDifferential,
    tangent: vec3<f32>,
}

const LEAST_SINE: f32 = 0.02;

fn vertex_position(v: ObjectVertex) -> vec3<f32> {
    return vec3(v.x, v.y, v.z);
}

fn vertex_normal(v: ObjectVertex) -> vec3<f32> {
    return vec3(v.normal_x, v.normal_y, v.normal_z);
}

// A seen triangle with the ray that meets it, and what of it all derivatives share.
struct SeenTriangle {
    e1: vec3<f32>,
    e2: vec3<f32>,
    area: vec3<f32>,
    squared: f32,
    plane: vec3<f32>,
    sine: f32,
    direction: vec3<f32>,
    distance: f32,
    normal: vec3<f32>,
    length: f32,
    normal_along_b: vec3<f32>,
    normal_along_c: vec3<f32>,
}

fn differential(t: SeenTriangle, by: vec3<f32>) -> SurfaceDifferential {
    let position = t.distance * (by - t.direction * (dot(t.plane, by) / t.sine));
    let along_b = dot(cross(position, t.e2), t.area) / t.squared;
    let along_c = dot(cross(t.e1, position), t.area) / t.squared;
    let turned = along_b * t.normal_along_b + along_c * t.normal_along_c;
    let normal = (turned - t.normal * dot(t.normal, turned)) / t.length;
    let exists = t.squared > 0.0 && t.length > 0.0;
    return SurfaceDifferential(select(vec3(0.0), position, exists), select(vec3(0.0), normal, exists));
}

// Twin of tangent_frame.rs.
fn tangent_along_u(a: ObjectVertex, b: ObjectVertex, c: ObjectVertex) -> vec3<f32> {
    let to_b = vec2(b.u - a.u, b.v - a.v);
    let to_c = vec2(c.u - a.u, c.v - a.v);
    let turn = to_b.x * to_c.y - to_b.y * to_c.x;
    let e1 = vertex_position(b) - vertex_position(a);
    let e2 = vertex_position(c) - vertex_position(a);
    return (e1 * to_c.y - e2 * to_b.y) * sign(turn);
}

fn object_point(direction: vec3<f32>, triangle: u32) -> ObjectPoint {
    let a = object_vertices[object_triangles[3u * triangle]];
    let b = object_vertices[object_triangles[3u * triangle + 1u]];
    let c = object_vertices[object_triangles[3u * triangle + 2u]];
    let at = meet(direction, vertex_position(a), vertex_position(b), vertex_position(c));
    let w = at.weights;
    let uv = w.x * vec2(a.u, a.v) + w.y * vec2(b.u, b.v) + w.z * vec2(c.u, c.v);
    let normal = w.x * vertex_normal(a) + w.y * vertex_normal(b) + w.z * vertex_normal(c);
    var t: SeenTriangle;
    t.e1 = vertex_position(b) - vertex_position(a);
    t.e2 = vertex_position(c) - vertex_position(a);
    t.area = cross(t.e1, t.e2);
    t.squared = dot(t.area, t.area);
    t.plane = t.area * inverseSqrt(t.squared);
    let sine = dot(t.plane, direction);
    t.sine = select(max(sine, LEAST_SINE), min(sine, -LEAST_SINE), sine < 0.0);
    t.direction = direction;
    t.distance = at.distance;
    t.length = length(normal);
    t.normal = normal / t.length;
    t.normal_along_b = vertex_normal(b) - vertex_normal(a);
    t.normal_along_c = vertex_normal(c) - vertex_normal(a);
    let by = ray_derivatives(camera, direction);
    let across = differential(t, by.across);
    let down = differential(t, by.down);
    return ObjectPoint(uv, normalize_or(normal, -direction), at.distance, a.part, at.front, across, down, tangent_along_u(a, b, c));
}
