// The GPU's twin of shade.rs: the same functions by the same names. Runs over the list of the object's pixels.

struct Shading {
    specular_reflectance: vec3<f32>,
    exponent: f32,
    face_size: u32,
    map_size: u32,
    // The cube map of the baseline: one after the sample points.
    baseline_cube: u32,
    // Differs from every earlier pass's.
    stamp: u32,
    // Texels along a face of the coarse level.
    coarse_size: u32,
    // Of the band, row by row; the others are left as they are.
    first_pixel: u32,
    end_pixel: u32,
    padding: u32,
}

@group(1) @binding(0) var<storage, read> object_triangles: array<u32>;
@group(1) @binding(1) var<storage, read> object_vertices: array<ObjectVertex>;
@group(1) @binding(2) var<uniform> shading: Shading;
@group(1) @binding(3) var<storage, read> sample_points: array<vec4<f32>>;
// Four 16-bit indices a texel, the first in the low half.
@group(1) @binding(4) var<storage, read> sample_maps: array<vec2<u32>>;
@group(1) @binding(5) var<storage, read> indirection: array<u32>;
@group(1) @binding(6) var<storage, read_write> touched: array<atomic<u32>>;
// Every face's texels as RGB9E5.
@group(1) @binding(7) var<storage, read> coarse: array<u32>;

// Component and Blend, as kernel.rs numbers them.
override COMPONENT: u32 = 0u;
override BLEND: u32 = 0u;
// Whether the coarse level stands in for pages that are not resident.
override COARSE: bool = false;

const RECONSTRUCTION: u32 = 0u;
const MIRROR: u32 = 1u;
const DISTANCE: u32 = 0u;
const ANGLE: u32 = 1u;
const AVERAGE: u32 = 2u;
const REFLECTION: u32 = 3u;
const NORMAL: u32 = 4u;
const ENVIRONMENT_MAP: u32 = 5u;

const NO_SAMPLE: u32 = 0xffffu;
const HIT: u32 = 1u;
const FILLED: u32 = 2u;
const UNKNOWN_ANSWER: u32 = 3u;
// cos 65°
const COS_HORIZON: f32 = 0.42261826;

struct Shaded {
    radiance: vec3<f32>,
    provenance: u32,
}

struct BlendWeights {
    weights: vec4<f32>,
    answer: u32,
}

fn provenance_of(answer: u32, sample: u32) -> u32 {
    return (answer << 30u) | sample;
}

fn cube_texel(cube: u32, texel: CubeTexel) -> vec3<f32> {
    return page_texel(6u * cube + texel.face, texel.column, texel.row);
}

// The four texels around a direction and their weights, sum 1.
struct Footprint {
    t00: CubeTexel,
    t10: CubeTexel,
    t01: CubeTexel,
    t11: CubeTexel,
    weights: vec4<f32>,
}

fn footprint(direction: vec3<f32>, size: u32) -> Footprint {
    let n = i32(size);
    let position = face_from_direction(direction);
    let at = (position.st + 1.0) * (0.5 * f32(n)) - 0.5;
    let base = floor(at);
    let f = at - base;
    let x = i32(base.x);
    let y = i32(base.y);
    let t00 = neighbour(position.face, x, y, n);
    let t10 = neighbour(position.face, x + 1, y, n);
    let t01 = neighbour(position.face, x, y + 1, n);
    let t11 = neighbour(position.face, x + 1, y + 1, n);
    let w00 = select(0.0, (1.0 - f.x) * (1.0 - f.y), t00.exists);
    let w10 = select(0.0, f.x * (1.0 - f.y), t10.exists);
    let w01 = select(0.0, (1.0 - f.x) * f.y, t01.exists);
    let w11 = select(0.0, f.x * f.y, t11.exists);
    let sum = w00 + w10 + w01 + w11;
    // Where a texel does not exist another one's page is read with weight 0.
    let some = choose(t11, t00);
    return Footprint(some, choose(some, t10), choose(some, t01), choose(some, t11), vec4(w00, w10, w01, w11) / sum);
}

fn read_cube(cube: u32, direction: vec3<f32>) -> vec3<f32> {
    let at = footprint(direction, shading.face_size);
    var radiance = at.weights.x * cube_texel(cube, at.t00);
    radiance += at.weights.y * cube_texel(cube, at.t10);
    radiance += at.weights.z * cube_texel(cube, at.t01);
    radiance += at.weights.w * cube_texel(cube, at.t11);
    if COARSE {
        let all = is_resident(cube, at.t00) && is_resident(cube, at.t10) && is_resident(cube, at.t01) && is_resident(cube, at.t11);
        radiance = select(read_coarse(cube, direction), radiance, all);
    }
    return radiance;
}

fn is_resident(cube: u32, texel: CubeTexel) -> bool {
    return indirection[6u * cube + texel.face] != NOT_RESIDENT;
}

fn coarse_texel(cube: u32, texel: CubeTexel) -> vec3<f32> {
    let n = shading.coarse_size;
    let word = coarse[((6u * cube + texel.face) * n + texel.row) * n + texel.column];
    // Mantissas of 9 bits below the point, exponent biased by 15.
    let step = bitcast<f32>(((word >> 27u) + 103u) << 23u);
    return step * vec3(f32(word & 0x1ffu), f32((word >> 9u) & 0x1ffu), f32((word >> 18u) & 0x1ffu));
}

fn read_coarse(cube: u32, direction: vec3<f32>) -> vec3<f32> {
    let at = footprint(direction, shading.coarse_size);
    var radiance = at.weights.x * coarse_texel(cube, at.t00);
    radiance += at.weights.y * coarse_texel(cube, at.t10);
    radiance += at.weights.z * coarse_texel(cube, at.t01);
    radiance += at.weights.w * coarse_texel(cube, at.t11);
    return radiance;
}

fn choose(some: CubeTexel, wanted: CubeTexel) -> CubeTexel {
    return CubeTexel(
        select(some.face, wanted.face, wanted.exists),
        select(some.column, wanted.column, wanted.exists),
        select(some.row, wanted.row, wanted.exists),
        true,
    );
}

fn candidates_at(part: u32, uv: vec2<f32>) -> vec4<u32> {
    let texel = clamp(vec2<i32>(uv * f32(shading.map_size)), vec2(0), vec2(i32(shading.map_size) - 1));
    let packed = sample_maps[(part * shading.map_size + u32(texel.y)) * shading.map_size + u32(texel.x)];
    return vec4(packed.x & 0xffffu, packed.x >> 16u, packed.y & 0xffffu, packed.y >> 16u);
}

fn toward(x: vec3<f32>, p: vec3<f32>, n: vec3<f32>) -> vec3<f32> {
    let offset = p - x;
    let distance = length(offset);
    return select(n, offset / distance, distance > 0.0);
}

// Invalid candidates are read as the first sample point; their weight is zero.
fn toward_sample(x: vec3<f32>, candidate: u32, n: vec3<f32>) -> vec3<f32> {
    let p = sample_points[select(candidate, 0u, candidate == NO_SAMPLE)].xyz;
    return toward(x, p, n);
}

fn first_of(flags: vec4<bool>) -> u32 {
    return select(select(select(select(4u, 3u, flags.w), 2u, flags.z), 1u, flags.y), 0u, flags.x);
}

fn element(v: vec4<u32>, k: u32) -> u32 {
    return select(select(select(v.w, v.z, k == 2u), v.y, k == 1u), v.x, k == 0u);
}

fn only(k: u32) -> vec4<f32> {
    return select(vec4(0.0), vec4(1.0), vec4(k) == vec4(0u, 1u, 2u, 3u));
}

fn reconstruct(x: vec3<f32>, n: vec3<f32>, candidates: vec4<u32>) -> Shaded {
    let valid = candidates != vec4(NO_SAMPLE);
    let cosines = vec4(
        dot(n, toward_sample(x, candidates.x, n)),
        dot(n, toward_sample(x, candidates.y, n)),
        dot(n, toward_sample(x, candidates.z, n)),
        dot(n, toward_sample(x, candidates.w, n)),
    );
    let within = first_of(valid & (cosines > vec4(COS_HORIZON)));
    let nearest = first_of(valid);
    if nearest == 4u {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let candidate = element(candidates, select(within, nearest, within == 4u));
    let radiance = read_cube(candidate, -toward_sample(x, candidate, n));
    return Shaded(radiance, provenance_of(select(HIT, FILLED, within == 4u), candidate));
}

fn mirror_direction(n: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
    return d - 2.0 * dot(n, d) * n;
}

fn logarithm(x: f32) -> f32 {
    let bits = bitcast<u32>(max(x, 1.1754944e-38));
    let mantissa = bitcast<f32>((bits & 0x007fffffu) | 0x3f000000u);
    let low = mantissa < 0.70710678;
    let exponent = f32(bits >> 23u) - 126.0 - select(0.0, 1.0, low);
    let f = select(mantissa, mantissa + mantissa, low) - 1.0;
    let z = f * f;
    var y = 7.0376836e-2;
    y = y * f - 1.151461e-1;
    y = y * f + 1.1676998e-1;
    y = y * f - 1.2420141e-1;
    y = y * f + 1.4249323e-1;
    y = y * f - 1.6668057e-1;
    y = y * f + 2.0000715e-1;
    y = y * f - 2.4999994e-1;
    y = y * f + 3.3333331e-1;
    y = y * f * z + exponent * -2.1219444e-4 - 0.5 * z;
    return f + y + exponent * 0.693359375;
}

fn exponential(x: f32) -> f32 {
    let n = floor(max(x, -87.0) * 1.44269504 + 0.5);
    let f = max(x, -87.0) - n * 0.693359375 - n * -2.1219444e-4;
    var y = 1.9875691e-4;
    y = y * f + 1.3981999e-3;
    y = y * f + 8.333452e-3;
    y = y * f + 4.1665796e-2;
    y = y * f + 1.6666665e-1;
    y = y * f + 0.5;
    let result = (y * f * f + f + 1.0) * bitcast<f32>(u32(i32(n) + 127) << 23u);
    return select(0.0, result, x > -87.0);
}

fn power(base: f32, exponent: f32) -> f32 {
    let result = exponential(exponent * logarithm(base));
    return select(select(0.0, result, base > 0.0), 1.0, exponent == 0.0);
}

fn sharpened(cosines: vec4<f32>, valid: vec4<bool>, exponent: f32) -> vec4<f32> {
    let clamped = select(vec4(0.0), max(cosines, vec4(0.0)), valid);
    let highest = max(max(clamped.x, clamped.y), max(clamped.z, clamped.w));
    let ratio = select(vec4(0.0), clamped / highest, vec4(highest > 0.0));
    let powers = vec4(power(ratio.x, exponent), power(ratio.y, exponent), power(ratio.z, exponent), power(ratio.w, exponent));
    return select(vec4(0.0), powers, valid);
}

fn normalized(weights: vec4<f32>) -> vec4<f32> {
    let sum = weights.x + weights.y + weights.z + weights.w;
    return select(vec4(0.0), weights / sum, vec4(sum > 0.0));
}

fn largest(values: vec4<f32>, valid: vec4<bool>) -> u32 {
    let v = select(vec4(-2.0), values, valid);
    let highest = max(max(v.x, v.y), max(v.z, v.w));
    return first_of(v == vec4(highest));
}

// `toward_*`: unit vectors from x to each candidate's sample point.
fn blend_weights(
    candidates: vec4<u32>,
    toward_0: vec3<f32>,
    toward_1: vec3<f32>,
    toward_2: vec3<f32>,
    toward_3: vec3<f32>,
    n: vec3<f32>,
    r: vec3<f32>,
) -> BlendWeights {
    let valid = candidates != vec4(NO_SAMPLE);
    let nearest = first_of(valid);
    if nearest == 4u {
        return BlendWeights(vec4(0.0), UNKNOWN_ANSWER);
    }
    var weights = only(nearest);
    if BLEND == ANGLE || BLEND == REFLECTION {
        let cosines = vec4(dot(toward_0, r), dot(toward_1, r), dot(toward_2, r), dot(toward_3, r));
        if BLEND == ANGLE {
            weights = only(largest(cosines, valid));
        } else {
            weights = normalized(sharpened(cosines, valid, shading.exponent));
        }
    } else if BLEND == AVERAGE {
        weights = normalized(select(vec4(0.0), vec4(1.0), valid));
    } else if BLEND == NORMAL {
        let cosines = vec4(dot(toward_0, n), dot(toward_1, n), dot(toward_2, n), dot(toward_3, n));
        weights = normalized(sharpened(cosines, valid, shading.exponent));
    }
    let vanished = all(weights == vec4(0.0));
    return BlendWeights(select(weights, only(nearest), vanished), select(HIT, FILLED, vanished));
}

fn weighted_cube(weight: f32, candidate: u32, r: vec3<f32>) -> vec3<f32> {
    if weight > 0.0 {
        return weight * read_cube(candidate, r);
    }
    return vec3(0.0);
}

fn mirror(x: vec3<f32>, n: vec3<f32>, d: vec3<f32>, candidates: vec4<u32>) -> Shaded {
    let r = mirror_direction(n, d);
    if BLEND == ENVIRONMENT_MAP {
        let radiance = shading.specular_reflectance * read_cube(shading.baseline_cube, r);
        return Shaded(radiance, provenance_of(HIT, shading.baseline_cube));
    }
    let blend = blend_weights(
        candidates,
        toward_sample(x, candidates.x, n),
        toward_sample(x, candidates.y, n),
        toward_sample(x, candidates.z, n),
        toward_sample(x, candidates.w, n),
        n,
        r,
    );
    if blend.answer == UNKNOWN_ANSWER {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let w = blend.weights;
    let heaviest = element(candidates, first_of(w == vec4(max(max(w.x, w.y), max(w.z, w.w)))));
    var radiance = vec3(0.0);
    if BLEND == DISTANCE || BLEND == ANGLE {
        // All the weight is on one sample point.
        radiance = read_cube(heaviest, r);
    } else {
        radiance += weighted_cube(w.x, candidates.x, r);
        radiance += weighted_cube(w.y, candidates.y, r);
        radiance += weighted_cube(w.z, candidates.z, r);
        radiance += weighted_cube(w.w, candidates.w, r);
    }
    return Shaded(shading.specular_reflectance * radiance, provenance_of(blend.answer, heaviest));
}

fn worse(own: u32, reflected: u32) -> u32 {
    return select(own, reflected, (reflected >> 30u) > (own >> 30u));
}

fn shade_object(direction: vec3<f32>, point: ObjectPoint) -> Shaded {
    let n = point.normal;
    let x = camera.position + point.distance * direction;
    let candidates = candidates_at(point.part, point.uv);
    var shaded: Shaded;
    if COMPONENT == RECONSTRUCTION {
        shaded = reconstruct(x, n, candidates);
    } else if COMPONENT == MIRROR {
        shaded = mirror(x, n, direction, candidates);
    } else {
        let own = reconstruct(x, n, candidates);
        let reflected = mirror(x, n, direction, candidates);
        shaded = Shaded(own.radiance + reflected.radiance, worse(own.provenance, reflected.provenance));
    }
    return Shaded(shaded.radiance, select(PROVENANCE_UNKNOWN, shaded.provenance, point.front));
}

@compute @workgroup_size(64)
fn shade(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= atomicLoad(&work.lists[OBJECT_LIST].count) {
        return;
    }
    let at = listed_pixel(OBJECT_LIST, id.x);
    let index = at.y * camera.size.x + at.x;
    if index < shading.first_pixel || index >= shading.end_pixel {
        return;
    }
    let direction = direction_of(at);
    let point = object_point(direction, visible_triangle(at) - 1u);
    let shaded = shade_object(direction, point);
    write_pixel(at, shaded.radiance, point.distance, shaded.provenance);
}
