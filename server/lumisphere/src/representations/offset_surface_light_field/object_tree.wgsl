// Twin of object_tree.rs: the same functions by the same names. Part of kernel.wgsl.

// The object's tree (raytrace/bvh.rs): nodes of NODE_TEXELS, four least and four greatest coordinates an axis, then the children, those that
// are leaves as −1 − packet; from `shading.first_packet` on packets of PACKET_TEXELS: corners, edges, triangles. A table of table.rs.
@group(2) @binding(6) var object_tree: texture_2d<f32>;

const NODE_TEXELS: u32 = 7u;
const PACKET_TEXELS: u32 = 10u;
const STACK_SIZE: u32 = 64u;
const FAR_SLACK: f32 = 1.000001;
const LEAST_COMPONENT: f32 = 1e-20;

struct RawHit {
    distance: f32,
    u: f32,
    v: f32,
    // −1 for none.
    triangle: f32,
}

struct SurfacePoint {
    exists: bool,
    position: vec3<f32>,
    shading: vec3<f32>,
    geometric: vec3<f32>,
    uv: vec2<f32>,
    part: u32,
}

fn tree_texel(index: u32) -> vec4<f32> {
    return textureLoad(object_tree, place_of(index), 0);
}

fn finite_inverse(x: f32) -> f32 {
    let large = select(1.0 / LEAST_COMPONENT, -1.0 / LEAST_COMPONENT, x < 0.0);
    return select(large, 1.0 / x, abs(x) > LEAST_COMPONENT);
}

fn nearest(origin: vec3<f32>, direction: vec3<f32>) -> RawHit {
    let inverse = vec3(finite_inverse(direction.x), finite_inverse(direction.y), finite_inverse(direction.z));
    var best = RawHit(3e38, 0.0, 0.0, -1.0);
    var stack: array<vec2<f32>, STACK_SIZE>;
    stack[0] = vec2(0.0, 0.0);
    var count = 1u;
    while count > 0u {
        count -= 1u;
        let entry = stack[count];
        if entry.x < best.distance {
            if entry.y < 0.0 {
                best = nearer(best, origin, direction, u32(-1.0 - entry.y));
            } else {
                let first = NODE_TEXELS * u32(entry.y);
                let x0 = (tree_texel(first) - origin.x) * inverse.x;
                let x1 = (tree_texel(first + 1u) - origin.x) * inverse.x;
                let y0 = (tree_texel(first + 2u) - origin.y) * inverse.y;
                let y1 = (tree_texel(first + 3u) - origin.y) * inverse.y;
                let z0 = (tree_texel(first + 4u) - origin.z) * inverse.z;
                let z1 = (tree_texel(first + 5u) - origin.z) * inverse.z;
                let children = tree_texel(first + 6u);
                let near = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), vec4(0.0)));
                let far = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), vec4(best.distance)));
                for (var lane = 0u; lane < 4u; lane++) {
                    let entered = component(near, lane);
                    if entered <= component(far, lane) * FAR_SLACK && count < STACK_SIZE {
                        // The nearest on top.
                        var place = count;
                        stack[count] = vec2(entered, component(children, lane));
                        count += 1u;
                        if place > 0u && stack[place - 1u].x < entered {
                            let other = stack[place - 1u];
                            stack[place - 1u] = stack[place];
                            stack[place] = other;
                        }
                    }
                }
            }
        }
    }
    return best;
}

fn nearer(before: RawHit, origin: vec3<f32>, direction: vec3<f32>, packet: u32) -> RawHit {
    let first = shading.first_packet + PACKET_TEXELS * packet;
    var best = before;
    let ux = tree_texel(first + 3u);
    let uy = tree_texel(first + 4u);
    let uz = tree_texel(first + 5u);
    let vx = tree_texel(first + 6u);
    let vy = tree_texel(first + 7u);
    let vz = tree_texel(first + 8u);
    let triangles = tree_texel(first + 9u);
    let cx = tree_texel(first) - origin.x;
    let cy = tree_texel(first + 1u) - origin.y;
    let cz = tree_texel(first + 2u) - origin.z;
    let nx = uy * vz - uz * vy;
    let ny = uz * vx - ux * vz;
    let nz = ux * vy - uy * vx;
    let rx = cy * direction.z - cz * direction.y;
    let ry = cz * direction.x - cx * direction.z;
    let rz = cx * direction.y - cy * direction.x;
    let determinant = direction.x * nx + direction.y * ny + direction.z * nz;
    let u = (vx * rx + vy * ry + vz * rz) / determinant;
    let v = -(ux * rx + uy * ry + uz * rz) / determinant;
    let t = (cx * nx + cy * ny + cz * nz) / determinant;
    for (var lane = 0u; lane < 4u; lane++) {
        let exists = component(triangles, lane) >= 0.0 && component(determinant, lane) != 0.0;
        let at = vec3(component(t, lane), component(u, lane), component(v, lane));
        if exists && at.x > 0.0 && at.x < best.distance && at.y >= 0.0 && at.z >= 0.0 && at.y + at.z <= 1.0 {
            best = RawHit(at.x, at.y, at.z, component(triangles, lane));
        }
    }
    return best;
}

fn outward(shaded: vec3<f32>, geometric: vec3<f32>, direction: vec3<f32>) -> vec3<f32> {
    if dot(shaded, direction) > 0.0 {
        return shaded;
    }
    return select(-geometric, geometric, dot(geometric, direction) > 0.0);
}

// `next` of object_tree.rs.
fn next_surface(position: vec3<f32>, normal: vec3<f32>, direction: vec3<f32>) -> SurfacePoint {
    let origin = position + select(camera.near, -camera.near, dot(normal, direction) < 0.0) * normal;
    let hit = nearest(origin, direction);
    if hit.triangle < 0.0 {
        return SurfacePoint(false, vec3(0.0), vec3(0.0), vec3(0.0), vec2(0.0), 0u);
    }
    let met = object_triangle(u32(hit.triangle));
    let w = vec3(1.0 - hit.u - hit.v, hit.u, hit.v);
    let normals = w.x * met.a.normal + w.y * met.b.normal + w.z * met.c.normal;
    let area = cross(met.b.position - met.a.position, met.c.position - met.a.position);
    let geometric = normalize_or(area, -direction);
    let uv = w.x * met.a.uv + w.y * met.b.uv + w.z * met.c.uv;
    return SurfacePoint(true, origin + hit.distance * direction, normalize_or(normals, geometric), geometric, uv, met.part);
}
