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
    // The finest level that is always resident, and the coarsest of all.
    coarse_level: u32,
    coarsest_level: u32,
    // Pages of level 0.
    face_count: u32,
    // Of the band, row by row; the others are left as they are.
    first_pixel: u32,
    end_pixel: u32,
    // Pixels of the frame along an edge of one of this pass's: derivatives are divided by it.
    pixel_scale: f32,
    // Of GLOSSY.
    directions: u32,
    // Rows of a page that come together: 2 to this power.
    block_shift: u32,
    // Of GLOSSY: those before it are of earlier passes.
    first_direction: u32,
    // Of SOLID and THIN: of the body, and where its tree's packets begin.
    refraction_index: f32,
    first_packet: u32,
    // In `mirror`, at most.
    reflections: u32,
    // Of BUMPED: texels along u and v, what slopes are multiplied with, and how often the map repeats.
    normal_map_size: vec2<u32>,
    normal_strength: f32,
    normal_repeat: f32,
}

@group(1) @binding(0) var object_triangles: texture_2d<u32>;
@group(1) @binding(1) var object_vertices: texture_2d<f32>;
@group(1) @binding(2) var<storage, read> shading: Shading;
@group(1) @binding(3) var<storage, read> sample_points: array<vec4<f32>>;
// Four 16-bit indices a texel, the first in the low half.
@group(1) @binding(4) var<storage, read> sample_maps: array<vec2<u32>>;
@group(1) @binding(5) var<storage, read> indirection: array<u32>;
@group(1) @binding(6) var<storage, read_write> touched: array<atomic<u32>>;
@group(1) @binding(7) var<storage, read> gloss: BrdfUniform;

// Component and Blend, as kernel.rs numbers them.
override COMPONENT: u32 = 0u;
override BLEND: u32 = 0u;
// Whether MIRROR and FULL reflect more than once.
override SEES_ITSELF: bool = false;
// Whether the object was captured as authored.
override AS_AUTHORED: bool = false;
// Whether reads are over what a pixel covers.
override FILTERED: bool = true;
// Whether coarse levels stand in for pages that are not resident.
override STAND_IN: bool = false;

const RECONSTRUCTION: u32 = 0u;
const MIRROR: u32 = 1u;
const GLOSSY: u32 = 3u;
const SOLID: u32 = 4u;
const THIN: u32 = 5u;
const DISTANCE: u32 = 0u;
const ANGLE: u32 = 1u;
const AVERAGE: u32 = 2u;
const REFLECTION: u32 = 3u;
const NORMAL: u32 = 4u;
const ENVIRONMENT_MAP: u32 = 5u;
const CORRECTED: u32 = 6u;

const NO_SAMPLE: u32 = 0xffffu;
const HIT: u32 = 1u;
const FILLED: u32 = 2u;
const UNKNOWN_ANSWER: u32 = 3u;
// cos 65°
const COS_HORIZON: f32 = 0.42261826;
const FOOTPRINT_WIDTH: f32 = 0.75;
const MOST_TURN: f32 = 0.15;

// A surface point, its normal and the direction to it; or their derivatives by the pixel.
struct Sight {
    position: vec3<f32>,
    normal: vec3<f32>,
    direction: vec3<f32>,
}

struct Shaded {
    radiance: vec3<f32>,
    provenance: u32,
}

struct BlendWeights {
    weights: vec4<f32>,
    answer: u32,
}

// Number k of four candidates.
struct OwnSample {
    k: u32,
    answer: u32,
}

fn provenance_of(answer: u32, sample: u32) -> u32 {
    return (answer << 30u) | sample;
}

// Which of its page's blocks of rows has a row of a level.
fn block_of(row: u32, level: u32) -> u32 {
    return (row << level) >> shading.block_shift;
}

fn is_there(face: u32, block: u32) -> bool {
    return ((indirection[shading.face_count + face] >> block) & 1u) == 1u;
}

// Of a level: coarse ones are in slots of their own, 4ˡ faces to a slot; finer ones in their face's. Leaves word of rows that were wanted.
// Rows that are not there have any value, but where they would mislead the search for others, zero.
fn cube_texel(cube: u32, texel: CubeTexel, level: u32) -> vec4<f32> {
    let face = 6u * cube + texel.face;
    let first = shading.coarse_level;
    let is_coarse = level >= first;
    let place = vec2(face & ((1u << first) - 1u), (face >> first) & ((1u << first) - 1u));
    let origin = select(vec2(0u), place * (shading.face_size >> first), is_coarse);
    let word = indirection[select(face, 2u * shading.face_count + (face >> (2u * first)), is_coarse)];
    if !is_coarse {
        let blocks = ((shading.face_size - 1u) >> shading.block_shift) + 1u;
        let block = block_of(texel.row, level);
        atomicStore(&touched[face * blocks + block], shading.stamp);
        if (BLEND == CORRECTED || RELIT) && !is_there(face, block) {
            return vec4(0.0);
        }
    }
    return slot_texel(word, origin, texel.column, texel.row, select(level, level - first, is_coarse));
}

// One of the four texels around a direction, number 0 to 3, and its weight: 0 where there is none, beyond a cube's corner.
struct Corner {
    texel: CubeTexel,
    weight: f32,
}

fn corner(position: FacePosition, size: u32, number: u32) -> Corner {
    let n = i32(size);
    let at = (position.st + 1.0) * (0.5 * f32(n)) - 0.5;
    let base = floor(at);
    let f = at - base;
    let right = (number & 1u) == 1u;
    let below = number >= 2u;
    let texel = neighbour(position.face, i32(base.x) + select(0, 1, right), i32(base.y) + select(0, 1, below), n);
    let weight = select(1.0 - f.x, f.x, right) * select(1.0 - f.y, f.y, below);
    return Corner(texel, select(0.0, weight, texel.exists));
}

// Loops, here and below, keep the program small: compilers inline every call, and a processor's takes seconds over the whole.
fn read_level(cube: u32, direction: vec3<f32>, level: u32) -> vec3<f32> {
    let position = face_from_direction(direction);
    var radiance = vec3(0.0);
    var sky = 0.0;
    var sum = 0.0;
    for (var number = 0u; number < 4u; number++) {
        let at = corner(position, shading.face_size >> level, number);
        if at.texel.exists {
            let texel = cube_texel(cube, at.texel, level);
            if TURNED {
                let share = sky_share(texel.w, level);
                radiance += at.weight * near_light(texel.rgb, share, level, at.texel);
                sky += at.weight * share;
            } else {
                radiance += at.weight * texel.rgb;
            }
            sum += at.weight;
        }
    }
    if TURNED {
        radiance += sky * environment_toward(before(direction), level);
    }
    return radiance / sum;
}

fn is_resident(cube: u32, direction: vec3<f32>, level: u32) -> bool {
    let position = face_from_direction(direction);
    var resident = true;
    for (var number = 0u; number < 4u; number++) {
        let at = corner(position, shading.face_size >> level, number);
        resident &= !at.texel.exists || is_there(6u * cube + at.texel.face, block_of(at.texel.row, level));
    }
    return resident || level >= shading.coarse_level;
}

fn read_cube(cube: u32, toward: DirectionDifferential) -> vec3<f32> {
    var taps = Taps(1u, vec3(0.0), 1.0);
    var level = PyramidLevel(0u, 0.0);
    if FILTERED {
        taps = taps_over(toward, shading.face_size);
        level = level_for_texels(FOOTPRINT_WIDTH * taps.texels, shading.coarsest_level);
    }
    var radiance = vec3(0.0);
    for (var tap = 0u; tap < taps.count; tap++) {
        let direction = tap_direction(taps, toward.direction, tap);
        var between = level;
        if STAND_IN {
            let coarser = min(level.fine + 1u, shading.coarsest_level);
            let resident = is_resident(cube, direction, level.fine) && (!FILTERED || is_resident(cube, direction, coarser));
            between = PyramidLevel(select(shading.coarse_level, level.fine, resident), select(0.0, level.fraction, resident));
        }
        for (var step = 0u; step < 2u; step++) {
            let weight = select(1.0 - between.fraction, between.fraction, step == 1u);
            if weight > 0.0 {
                radiance += weight * read_level(cube, direction, between.fine + step);
            }
        }
    }
    return radiance / f32(taps.count);
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

fn component(v: vec4<f32>, k: u32) -> f32 {
    return select(select(select(v.w, v.z, k == 2u), v.y, k == 1u), v.x, k == 0u);
}

// Of the angles between n and the directions from x to the candidates' sample points.
fn cosines_above(x: vec3<f32>, n: vec3<f32>, candidates: vec4<u32>) -> vec4<f32> {
    return vec4(
        dot(n, toward_sample(x, candidates.x, n)),
        dot(n, toward_sample(x, candidates.y, n)),
        dot(n, toward_sample(x, candidates.z, n)),
        dot(n, toward_sample(x, candidates.w, n)),
    );
}

fn only(k: u32) -> vec4<f32> {
    return select(vec4(0.0), vec4(1.0), vec4(k) == vec4(0u, 1u, 2u, 3u));
}

fn within_the_surface(by: Sight) -> vec3<f32> {
    return by.position * (MOST_TURN / max(length(by.normal), MOST_TURN));
}

fn short_of_the_horizon(derivative: vec3<f32>, cosine: f32) -> vec3<f32> {
    let most = 0.5 * max(cosine, 0.0);
    let length = length(derivative);
    return select(derivative, derivative * (most / length), length > most);
}

fn own_sample(at: Sight, candidates: vec4<u32>) -> OwnSample {
    let x = at.position;
    let valid = candidates != vec4(NO_SAMPLE);
    let cosines = cosines_above(x, at.normal, candidates);
    let within = first_of(valid & (cosines > vec4(COS_HORIZON)));
    let unseen = OwnSample(select(within, first_of(valid), within == 4u), select(HIT, FILLED, within == 4u));
    if BLEND != CORRECTED {
        return unseen;
    }
    var seeing = vec4(false);
    for (var k = 0u; k < 4u; k++) {
        let lane = vec4(k) == vec4(0u, 1u, 2u, 3u);
        let candidate = element(candidates, k);
        if any(lane & valid) && sees(candidate, sample_points[candidate].xyz, x) {
            seeing |= lane;
            if component(cosines, k) > COS_HORIZON {
                return OwnSample(k, HIT);
            }
        }
    }
    return OwnSample(select(unseen.k, largest(cosines, seeing), any(seeing)), FILLED);
}

fn own_weights(at: Sight, candidates: vec4<u32>) -> BlendWeights {
    if AS_AUTHORED {
        let x = at.position;
        let n = at.normal;
        var admits = (candidates != vec4(NO_SAMPLE)) & (cosines_above(x, n, candidates) > vec4(COS_HORIZON));
        if BLEND == CORRECTED {
            for (var k = 0u; k < 4u; k++) {
                let lane = vec4(k) == vec4(0u, 1u, 2u, 3u);
                let candidate = element(candidates, k);
                if any(lane & admits) && !sees(candidate, sample_points[candidate].xyz, x) {
                    admits &= !lane;
                }
            }
        }
        if any(admits) {
            return blend_weights(
                select(vec4(NO_SAMPLE), candidates, admits),
                toward_sample(x, candidates.x, n),
                toward_sample(x, candidates.y, n),
                toward_sample(x, candidates.z, n),
                toward_sample(x, candidates.w, n),
                n,
                -at.direction,
            );
        }
    }
    let own = own_sample(at, candidates);
    return BlendWeights(only(own.k), own.answer);
}

// What a sample point shows of x.
fn read_own(candidate: u32, at: Sight, across: Sight, down: Sight) -> vec3<f32> {
    let x = at.position;
    let p = sample_points[candidate].xyz;
    let distance = length(p - x);
    let per_length = select(0.0, 1.0 / distance, distance > 0.0);
    let up = toward(x, p, at.normal);
    let cosine = dot(at.normal, up);
    let toward_x = DirectionDifferential(
        -up,
        short_of_the_horizon(within_the_surface(across) * per_length, cosine),
        short_of_the_horizon(within_the_surface(down) * per_length, cosine),
    );
    return read_cube(candidate, toward_x);
}

fn reconstruct(at: Sight, across: Sight, down: Sight, candidates: vec4<u32>) -> Shaded {
    if all(candidates == vec4(NO_SAMPLE)) {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let own = own_weights(at, candidates);
    let w = own.weights;
    let heaviest = element(candidates, first_of(w == vec4(max(max(w.x, w.y), max(w.z, w.w)))));
    var radiance = vec3(0.0);
    if !AS_AUTHORED || BLEND == DISTANCE || BLEND == ANGLE {
        // All the weight is on one sample point.
        radiance = read_own(heaviest, at, across, down);
    } else {
        for (var k = 0u; k < 4u; k++) {
            let weight = component(w, k);
            if weight > 0.0 {
                radiance += weight * read_own(element(candidates, k), at, across, down);
            }
        }
    }
    if RELIT {
        radiance = relit(at, candidates, radiance);
    }
    return Shaded(radiance, provenance_of(own.answer, heaviest));
}

fn mirror_direction(n: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
    return d - 2.0 * dot(n, d) * n;
}

fn mirrored_derivative(at: Sight, by: Sight) -> vec3<f32> {
    let n = at.normal;
    let d = at.direction;
    return by.direction - 2.0 * ((dot(n, by.direction) + dot(by.normal, d)) * n + dot(n, d) * by.normal);
}

fn mirrored(at: Sight, across: Sight, down: Sight) -> DirectionDifferential {
    let r = mirror_direction(at.normal, at.direction);
    return DirectionDifferential(r, mirrored_derivative(at, across), mirrored_derivative(at, down));
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
    if BLEND == ANGLE || BLEND == REFLECTION || BLEND == CORRECTED {
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

fn mirror(at: Sight, across: Sight, down: Sight, r: DirectionDifferential, candidates: vec4<u32>) -> Shaded {
    if SEES_ITSELF {
        return reflections(at, across, down, candidates);
    }
    return radiance_toward(at, across, down, r, candidates);
}

fn radiance_toward(at: Sight, across: Sight, down: Sight, r: DirectionDifferential, candidates: vec4<u32>) -> Shaded {
    let x = at.position;
    let n = at.normal;
    if BLEND == CORRECTED {
        let shaded = corrected(at, across, down, r, candidates);
        return Shaded(shading.specular_reflectance * shaded.radiance, shaded.provenance);
    }
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
        r.direction,
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
        for (var k = 0u; k < 4u; k++) {
            let weight = component(w, k);
            if weight > 0.0 {
                radiance += weight * read_cube(element(candidates, k), r);
            }
        }
    }
    return Shaded(shading.specular_reflectance * radiance, provenance_of(blend.answer, heaviest));
}

fn worse(own: u32, reflected: u32) -> u32 {
    return select(own, reflected, (reflected >> 30u) > (own >> 30u));
}

fn neighbour_sight(at: Sight, by: Sight) -> Sight {
    let normal = normalize_or(at.normal + by.normal, at.normal);
    return Sight(at.position + by.position, normal, normalize_or(at.direction + by.direction, at.direction));
}

fn scaled(surface: SurfaceDifferential, direction: vec3<f32>) -> Sight {
    let scale = 1.0 / shading.pixel_scale;
    return Sight(surface.position * scale, surface.normal * scale, direction * scale);
}

fn shade_object(direction: vec3<f32>, point: ObjectPoint) -> Shaded {
    let at = Sight(camera.position + point.distance * direction, point.normal, direction);
    let by = ray_derivatives(camera, direction);
    let across = scaled(point.across, by.across);
    let down = scaled(point.down, by.down);
    let candidates = candidates_at(point.part, point.uv);
    let reflecting = reflecting_at(at, across, down, point);
    var shaded: Shaded;
    if COMPONENT == RECONSTRUCTION {
        shaded = reconstruct(at, across, down, candidates);
    } else if COMPONENT == MIRROR {
        shaded = mirror(at, across, down, reflecting.mirrored, candidates);
    } else if COMPONENT == GLOSSY {
        shaded = glossy(at, across, down, reflecting, point.tangent, candidates);
    } else if COMPONENT == SOLID || COMPONENT == THIN {
        shaded = refraction(at, across, down, candidates);
    } else {
        let own = reconstruct(at, across, down, candidates);
        let reflected = mirror(at, across, down, reflecting.mirrored, candidates);
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
