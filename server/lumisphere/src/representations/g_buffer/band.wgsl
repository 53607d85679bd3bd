// Twin of rasterize.rs. What every pass over a band of a frame shares: which triangle a pixel sees, the lists of pixels by what they see,
// the finished pixels.

// Arguments of an indirect dispatch over a list's pixels, and how many there are.
struct List {
    groups: atomic<u32>,
    groups_y: u32,
    groups_z: u32,
    count: atomic<u32>,
}

// List l's pixels begin at l times the band's pixels; columns in the low half, rows in the high one.
struct Work {
    lists: array<List, 4>,
    pixels: array<u32>,
}

@group(0) @binding(0) var<storage, read> camera: Camera;
@group(0) @binding(1) var visibility: texture_2d<u32>;
@group(0) @binding(2) var<storage, read_write> work: Work;
// Per pixel R, G, B; then for all pixels distance; then provenance.
@group(0) @binding(3) var<storage, read_write> output: array<u32>;

const GROUP_SIZE: u32 = 64u;
const OBJECT_LIST: u32 = 0u;
const PLAIN_LIST: u32 = 1u;
const TEXTURED_LIST: u32 = 2u;
const SKY_LIST: u32 = 3u;

const PROVENANCE_BACKGROUND: u32 = 0x3fffffffu;
const PROVENANCE_UNKNOWN: u32 = 0xffffffffu;

fn band_pixels() -> u32 {
    return camera.size.x * camera.size.y;
}

// 0 for none, else the triangle's number + 1.
fn visible_triangle(at: vec2<u32>) -> u32 {
    return textureLoad(visibility, at, 0).x;
}

fn direction_of(at: vec2<u32>) -> vec3<f32> {
    return pixel_direction(camera, at.x, at.y);
}

// Pixel `place` of a list: column and row in the band.
fn listed_pixel(list: u32, place: u32) -> vec2<u32> {
    let packed = work.pixels[list * band_pixels() + place];
    return vec2(packed & 0xffffu, packed >> 16u);
}

struct Meeting {
    // Of the triangle's corners, within [0, 1], sum 1.
    weights: vec3<f32>,
    distance: f32,
    // Whether the corners run counter-clockwise as seen.
    front: bool,
}

// Where the ray from the camera meets a triangle that is known to be seen (Möller and Trumbore 1997). The rasteriser snaps corners
// to 1/256 pixel, so the ray may pass just outside: the nearest weights inside stand for it.
fn meet(direction: vec3<f32>, a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> Meeting {
    let e1 = b - a;
    let e2 = c - a;
    let p = cross(direction, e2);
    let determinant = dot(e1, p);
    let offset = camera.position - a;
    let q = cross(offset, e1);
    let exists = determinant != 0.0;
    let u = clamp(select(0.0, dot(offset, p) / determinant, exists), 0.0, 1.0);
    let v = clamp(select(0.0, dot(direction, q) / determinant, exists), 0.0, 1.0 - u);
    let distance = dot(u * e1 + v * e2 - offset, direction);
    return Meeting(vec3(1.0 - u - v, u, v), distance, dot(cross(e1, e2), direction) < 0.0);
}

fn normalize_or(v: vec3<f32>, fallback: vec3<f32>) -> vec3<f32> {
    let squared = dot(v, v);
    return select(fallback, v * inverseSqrt(squared), squared > 0.0);
}

// By its bits, since compilers may assume that there is no NaN.
fn is_finite(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7f800000u) != 0x7f800000u;
}

fn write_pixel(at: vec2<u32>, radiance: vec3<f32>, distance: f32, provenance: u32) {
    let index = at.y * camera.size.x + at.x;
    let finite = is_finite(radiance.x) && is_finite(radiance.y) && is_finite(radiance.z);
    let color = select(vec3(0u), bitcast<vec3<u32>>(radiance), finite);
    output[3u * index] = color.x;
    output[3u * index + 1u] = color.y;
    output[3u * index + 2u] = color.z;
    output[3u * band_pixels() + index] = bitcast<u32>(select(camera.infinity, distance, is_finite(distance)));
    output[4u * band_pixels() + index] = select(PROVENANCE_UNKNOWN, provenance, finite);
}
