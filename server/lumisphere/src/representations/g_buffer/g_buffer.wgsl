// Sorts a band's pixels by what they see, and finishes those that do not see the object: background and environment. Twin of trace.rs.
// Each kind has its own list and its own dispatch, since lanes of a processor would otherwise pay for every kind at every pixel.

@group(1) @binding(0) var environment: texture_2d<f32>;
// Three corners and the material; the first triangle is number `camera.object_end`.
@group(1) @binding(1) var background_triangles: texture_2d<u32>;
// VERTEX_TEXELS a vertex, by the constants below.
@group(1) @binding(2) var background_vertices: texture_2d<f32>;
// MATERIAL_TEXELS a material: emission and texels per length, as bits of f32; first level and how many.
@group(1) @binding(3) var materials: texture_2d<u32>;
// First texel, width, height.
@group(1) @binding(4) var levels: texture_2d<u32>;
// R and G, B and nothing, as pairs of f16.
@group(1) @binding(5) var texels: texture_2d<u32>;

const MATERIAL_TEXELS: u32 = 2u;
const VERTEX_TEXELS: u32 = 4u;
// Position and u.
const POSITION: u32 = 0u;
// Normal and v.
const NORMAL: u32 = 1u;
// On each side: the radiance itself where there is no texture, else irradiance / π; and 1 where the surface is not diffuse.
const FRONT: u32 = 2u;
const BACK: u32 = 3u;

// Whether the background's triangles shaded now have textures.
override TEXTURED: bool = false;

const LEAST_COSINE: f32 = 0.05;
// Pixels that one invocation sorts: it adds to each list once, since lists are shared by all.
const RUN: u32 = 32u;

fn list_of(at: vec2<u32>) -> u32 {
    let seen = visible_triangle(at);
    let background = select(PLAIN_LIST, TEXTURED_LIST, seen > camera.plain_end);
    return select(select(OBJECT_LIST, background, seen > camera.object_end), SKY_LIST, seen == 0u);
}

fn one_of(list: u32) -> vec4<u32> {
    return select(vec4(0u), vec4(1u), vec4(list) == vec4(0u, 1u, 2u, 3u));
}

fn reserve(list: u32, count: u32) -> u32 {
    let place = atomicAdd(&work.lists[list].count, count);
    atomicMax(&work.lists[list].groups, (place + count + GROUP_SIZE - 1u) / GROUP_SIZE);
    return place;
}

@compute @workgroup_size(8, 8)
fn sort_pixels(@builtin(global_invocation_id) id: vec3<u32>) {
    let first = RUN * id.x;
    let end = min(first + RUN, camera.size.x);
    if first >= end || id.y >= camera.size.y {
        return;
    }
    var counts = vec4(0u);
    for (var column = first; column < end; column++) {
        counts += one_of(list_of(vec2(column, id.y)));
    }
    var places = vec4(reserve(0u, counts.x), reserve(1u, counts.y), reserve(2u, counts.z), reserve(3u, counts.w));
    for (var column = first; column < end; column++) {
        let list = list_of(vec2(column, id.y));
        let one = one_of(list);
        let own = places * one;
        work.pixels[list * band_pixels() + own.x + own.y + own.z + own.w] = (id.y << 16u) | column;
        places += one;
    }
}

// −1 … n as 0 … n − 1. (A remainder of integers costs a processor more than all the rest of a pixel.)
fn wrapped(at: i32, n: u32) -> u32 {
    let below = select(at, at + i32(n), at < 0);
    return u32(select(below, below - i32(n), below >= i32(n)));
}

fn level_texel(level: vec4<u32>, column: i32, row: i32) -> vec3<f32> {
    let texel = level.x + wrapped(row, level.z) * level.y + wrapped(column, level.y);
    let packed = textureLoad(texels, place_of(texel), 0);
    return vec3(unpack2x16float(packed.x), unpack2x16float(packed.y).x);
}

fn level_color(index: u32, uv: vec2<f32>) -> vec3<f32> {
    let level = textureLoad(levels, place_of(index), 0);
    let repeated = uv - floor(uv);
    let x = repeated.x * f32(level.y) - 0.5;
    let y = (1.0 - repeated.y) * f32(level.z) - 0.5;
    let x0 = floor(x);
    let y0 = floor(y);
    let fx = x - x0;
    let fy = y - y0;
    let column = i32(x0);
    let row = i32(y0);
    let t00 = level_texel(level, column, row);
    let t01 = level_texel(level, column, row + 1);
    let top = t00 + fx * (level_texel(level, column + 1, row) - t00);
    let bottom = t01 + fx * (level_texel(level, column + 1, row + 1) - t01);
    return top + fy * (bottom - top);
}

fn texture_color(first_level: u32, level_count: u32, uv: vec2<f32>, footprint: f32) -> vec3<f32> {
    let bits = bitcast<u32>(max(footprint, 1.0));
    let level = min((bits >> 23u) - 127u, level_count - 1u);
    let coarser = min(level + 1u, level_count - 1u);
    let fraction = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u) - 1.0;
    let fine = level_color(first_level + level, uv);
    return fine + fraction * (level_color(first_level + coarser, uv) - fine);
}

struct BackgroundPoint {
    uv: vec2<f32>,
    distance: f32,
    radiance: vec3<f32>,
    unknown: bool,
}

fn corner(vertex: u32, what: u32) -> vec4<f32> {
    return textureLoad(background_vertices, place_of(VERTEX_TEXELS * vertex + what), 0);
}

fn background_point(direction: vec3<f32>, triangle: u32) -> BackgroundPoint {
    let corners = textureLoad(background_triangles, place_of(triangle), 0);
    let a = corner(corners.x, POSITION);
    let b = corner(corners.y, POSITION);
    let c = corner(corners.z, POSITION);
    let at = meet(direction, a.xyz, b.xyz, c.xyz);
    let w = at.weights;
    let side = select(BACK, FRONT, at.front);
    let shown = corner(corners.x, side);
    var radiance = w.x * shown.xyz + w.y * corner(corners.y, side).xyz + w.z * corner(corners.z, side).xyz;
    let normal = w.x * corner(corners.x, NORMAL) + w.y * corner(corners.y, NORMAL) + w.z * corner(corners.z, NORMAL);
    let uv = vec2(w.x * a.w + w.y * b.w + w.z * c.w, normal.w);
    if TEXTURED {
        let surface = textureLoad(materials, place_of(MATERIAL_TEXELS * corners.w), 0);
        let texture = textureLoad(materials, place_of(MATERIAL_TEXELS * corners.w + 1u), 0);
        if texture.y > 0u {
            let cosine = abs(dot(normalize_or(normal.xyz, -direction), direction));
            let footprint = bitcast<f32>(surface.w) * at.distance * camera.pixel_angle / sqrt(max(cosine, LEAST_COSINE));
            let emission = select(vec3(0.0), bitcast<vec3<f32>>(surface.xyz), at.front);
            radiance = emission + radiance * texture_color(texture.x, texture.y, uv, footprint);
        }
    }
    return BackgroundPoint(uv, at.distance, radiance, shown.w == 1.0);
}

@compute @workgroup_size(64)
fn background(@builtin(global_invocation_id) id: vec3<u32>) {
    let list = select(PLAIN_LIST, TEXTURED_LIST, TEXTURED);
    if id.x >= atomicLoad(&work.lists[list].count) {
        return;
    }
    let at = listed_pixel(list, id.x);
    let point = background_point(direction_of(at), visible_triangle(at) - 1u - camera.object_end);
    write_pixel(at, point.radiance, point.distance, select(PROVENANCE_BACKGROUND, PROVENANCE_UNKNOWN, point.unknown));
}

fn environment_radiance(direction: vec3<f32>) -> vec3<f32> {
    // rotate_y(−rotation) · direction
    let c = camera.environment_cos;
    let s = camera.environment_sin;
    let turned = vec3(c * direction.x - s * direction.z, direction.y, s * direction.x + c * direction.z);
    let at = lat_long_from_direction(turned);
    let size = vec2<i32>(textureDimensions(environment));
    let x = at.x * f32(size.x) - 0.5;
    let y = clamp(at.y * f32(size.y) - 0.5, 0.0, f32(size.y) - 1.0);
    let x0 = floor(x);
    let y0 = floor(y);
    let fx = x - x0;
    let fy = y - y0;
    let left = select(i32(x0), size.x - 1, x0 < 0.0);
    let right = select(i32(x0) + 1, 0, i32(x0) + 1 >= size.x);
    let top = i32(y0);
    let bottom = min(top + 1, size.y - 1);
    let t00 = textureLoad(environment, vec2(left, top), 0).rgb;
    let t10 = textureLoad(environment, vec2(right, top), 0).rgb;
    let t01 = textureLoad(environment, vec2(left, bottom), 0).rgb;
    let t11 = textureLoad(environment, vec2(right, bottom), 0).rgb;
    let upper = t00 + fx * (t10 - t00);
    let lower = t01 + fx * (t11 - t01);
    return upper + fy * (lower - upper);
}

@compute @workgroup_size(64)
fn sky(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= atomicLoad(&work.lists[SKY_LIST].count) {
        return;
    }
    let at = listed_pixel(SKY_LIST, id.x);
    write_pixel(at, environment_radiance(direction_of(at)), camera.infinity, PROVENANCE_BACKGROUND);
}
