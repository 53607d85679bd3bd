// Twin of trace.rs. What a pixel sees of the object. Expects the tables of object_tables.rs, `object_triangles` (three corners and the part) and
// `object_vertices` (two elements each: position and u, normal and v), from the kernel that includes it.

struct ObjectVertex {
    position: vec3<f32>,
    normal: vec3<f32>,
    uv: vec2<f32>,
}

struct ObjectTriangle {
    a: ObjectVertex,
    b: ObjectVertex,
    c: ObjectVertex,
    part: u32,
}

// Derivatives by the pixel's column or row.
struct SurfaceDifferential {
    position: vec3<f32>,
    normal: vec3<f32>,
    uv: vec2<f32>,
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
    side_of_v: f32,
}

const LEAST_SINE: f32 = 0.02;

fn object_vertex(index: u32) -> ObjectVertex {
    let place = textureLoad(object_vertices, place_of(2u * index), 0);
    let normal = textureLoad(object_vertices, place_of(2u * index + 1u), 0);
    return ObjectVertex(place.xyz, normal.xyz, vec2(place.w, normal.w));
}

fn object_triangle(index: u32) -> ObjectTriangle {
    let corners = textureLoad(object_triangles, place_of(index), 0);
    return ObjectTriangle(object_vertex(corners.x), object_vertex(corners.y), object_vertex(corners.z), corners.w);
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
    uv_along_b: vec2<f32>,
    uv_along_c: vec2<f32>,
}

fn differential(t: SeenTriangle, by: vec3<f32>) -> SurfaceDifferential {
    let position = t.distance * (by - t.direction * (dot(t.plane, by) / t.sine));
    let along_b = dot(cross(position, t.e2), t.area) / t.squared;
    let along_c = dot(cross(t.e1, position), t.area) / t.squared;
    let turned = along_b * t.normal_along_b + along_c * t.normal_along_c;
    let normal = (turned - t.normal * dot(t.normal, turned)) / t.length;
    let uv = along_b * t.uv_along_b + along_c * t.uv_along_c;
    let exists = t.squared > 0.0 && t.length > 0.0;
    return SurfaceDifferential(select(vec3(0.0), position, exists), select(vec3(0.0), normal, exists), select(vec2(0.0), uv, exists));
}

// Twin of tangent_frame.rs.
fn tangent_along_u(t: ObjectTriangle) -> vec3<f32> {
    let to_b = t.b.uv - t.a.uv;
    let to_c = t.c.uv - t.a.uv;
    let turn = to_b.x * to_c.y - to_b.y * to_c.x;
    let e1 = t.b.position - t.a.position;
    let e2 = t.c.position - t.a.position;
    return (e1 * to_c.y - e2 * to_b.y) * sign(turn);
}

fn side_of_v(t: ObjectTriangle) -> f32 {
    let to_b = t.b.uv - t.a.uv;
    let to_c = t.c.uv - t.a.uv;
    return select(1.0, -1.0, to_b.x * to_c.y - to_b.y * to_c.x < 0.0);
}

fn object_point(direction: vec3<f32>, triangle: u32) -> ObjectPoint {
    let corners = object_triangle(triangle);
    let a = corners.a;
    let b = corners.b;
    let c = corners.c;
    let at = meet(direction, a.position, b.position, c.position);
    let w = at.weights;
    let uv = w.x * a.uv + w.y * b.uv + w.z * c.uv;
    let normal = w.x * a.normal + w.y * b.normal + w.z * c.normal;
    var t: SeenTriangle;
    t.e1 = b.position - a.position;
    t.e2 = c.position - a.position;
    t.area = cross(t.e1, t.e2);
    t.squared = dot(t.area, t.area);
    t.plane = t.area * inverseSqrt(t.squared);
    let sine = dot(t.plane, direction);
    t.sine = select(max(sine, LEAST_SINE), min(sine, -LEAST_SINE), sine < 0.0);
    t.direction = direction;
    t.distance = at.distance;
    t.length = length(normal);
    t.normal = normal / t.length;
    t.normal_along_b = b.normal - a.normal;
    t.normal_along_c = c.normal - a.normal;
    t.uv_along_b = b.uv - a.uv;
    t.uv_along_c = c.uv - a.uv;
    let by = ray_derivatives(camera, direction);
    let across = differential(t, by.across);
    let down = differential(t, by.down);
    let unit = normalize_or(normal, -direction);
    return ObjectPoint(uv, unit, at.distance, corners.part, at.front, across, down, tangent_along_u(corners), side_of_v(corners));
}
