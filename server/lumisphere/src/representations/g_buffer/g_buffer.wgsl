// Rasterises object, background and environment into the G-buffer. Twin of trace.rs; the layout of `a` and `b` is in mod.rs.
// Depth is reversed and infinite: near / depth, cleared to 0, greater wins.

struct Material {
    albedo: vec3<f32>,
    first_level: u32,
    emission: vec3<f32>,
    level_count: u32,
    texels_per_length: f32,
    unknown: u32,
    padding: vec2<u32>,
}

struct Level {
    first_texel: u32,
    width: u32,
    height: u32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> camera: Camera;
@group(0) @binding(1) var environment: texture_2d<f32>;
@group(0) @binding(2) var<storage, read> materials: array<Material>;
@group(0) @binding(3) var<storage, read> levels: array<Level>;
// R and G, B and nothing, as pairs of f16.
@group(0) @binding(4) var<storage, read> texels: array<vec2<u32>>;

// Whether the background's triangles drawn now have textures.
override TEXTURED: bool = false;

const BACKGROUND: f32 = -1.0;
const NOTHING: f32 = -2.0;
const UNKNOWN: f32 = -3.0;
const FRAC_1_PI: f32 = 0.318309886183791;
const LEAST_COSINE: f32 = 0.05;

struct GBuffer {
    @location(0) a: vec4<f32>,
    @location(1) b: vec4<f32>,
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

struct ObjectCorner {
    @builtin(position) clip: vec4<f32>,
    @location(0) offset: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) @interpolate(flat, either) part: u32,
}

@vertex
fn object_corner(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) part: u32,
) -> ObjectCorner {
    return ObjectCorner(clip_from_world(position), position - camera.position, normal, uv, part);
}

fn normalize_or(v: vec3<f32>, fallback: vec3<f32>) -> vec3<f32> {
    let squared = dot(v, v);
    return select(fallback, v * inverseSqrt(squared), squared > 0.0);
}

@fragment
fn object(corner: ObjectCorner, @builtin(front_facing) front: bool) -> GBuffer {
    let distance = length(corner.offset);
    let code = select(-4.0 - f32(corner.part), f32(corner.part), front);
    let normal = normalize_or(corner.normal, -corner.offset / distance);
    return GBuffer(vec4(corner.uv, code, distance), vec4(normal, 0.0));
}

struct BackgroundCorner {
    @builtin(position) clip: vec4<f32>,
    @location(0) offset: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) @interpolate(flat, either) material: u32,
    @location(4) irradiance_front: vec3<f32>,
    @location(5) irradiance_back: vec3<f32>,
}

@vertex
fn background_corner(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) uv: vec2<f32>,
    @location(3) material: u32,
    @location(4) irradiance_front: vec3<f32>,
    @location(5) irradiance_back: vec3<f32>,
) -> BackgroundCorner {
    let offset = position - camera.position;
    return BackgroundCorner(clip_from_world(position), offset, normal, uv, material, irradiance_front, irradiance_back);
}

fn level_texel(level: Level, column: i32, row: i32) -> vec3<f32> {
    let x = u32(column + i32(level.width)) % level.width;
    let y = u32(row + i32(level.height)) % level.height;
    let packed = texels[level.first_texel + y * level.width + x];
    return vec3(unpack2x16float(packed.x), unpack2x16float(packed.y).x);
}

fn level_color(index: u32, uv: vec2<f32>) -> vec3<f32> {
    let level = levels[index];
    let repeated = uv - floor(uv);
    let x = repeated.x * f32(level.width) - 0.5;
    let y = (1.0 - repeated.y) * f32(level.height) - 0.5;
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

@fragment
fn background(corner: BackgroundCorner, @builtin(front_facing) front: bool) -> GBuffer {
    let distance = length(corner.offset);
    let material = materials[corner.material];
    let irradiance = select(corner.irradiance_back, corner.irradiance_front, front);
    var albedo = material.albedo;
    if TEXTURED {
        let direction = corner.offset / distance;
        let cosine = abs(dot(normalize_or(corner.normal, -direction), direction));
        let footprint = material.texels_per_length * distance * camera.pixel_angle / sqrt(max(cosine, LEAST_COSINE));
        albedo = texture_color(material.first_level, material.level_count, corner.uv, footprint);
    }
    let emission = select(vec3(0.0), material.emission, front);
    let radiance = emission + albedo * irradiance * FRAC_1_PI;
    let code = select(BACKGROUND, UNKNOWN, material.unknown == 1u);
    return GBuffer(vec4(corner.uv, code, distance), vec4(radiance, 0.0));
}

// One triangle over the whole band at infinite depth: it shades what nothing else has covered.
@vertex
fn sky_corner(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
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

@fragment
fn sky(@builtin(position) position: vec4<f32>) -> GBuffer {
    let direction = pixel_direction(camera, u32(position.x), u32(position.y));
    return GBuffer(vec4(0.0, 0.0, NOTHING, camera.infinity), vec4(environment_radiance(direction), 0.0));
}
