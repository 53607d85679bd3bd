// The GPU's twin of shade.rs: the same functions by the same names. Runs over the list of the object's pixels.

struct Shading {
    // Texels along the edge of a part.
    size: u32,
    show_what: u32,
}

struct Texel {
    // Model's number in the low byte, flags in the next.
    code: u32,
    first_pair: u32,
    constant: vec4<f32>,
}

// Of quads.
struct Pair {
    first: vec4<f32>,
    second: vec4<f32>,
}

@group(1) @binding(0) var object_triangles: texture_2d<u32>;
@group(1) @binding(1) var object_vertices: texture_2d<f32>;
@group(1) @binding(2) var<storage, read> shading: Shading;
// Elements of device_tables.rs: heads of the texels, and pairs.
@group(1) @binding(3) var heads: texture_2d<u32>;
@group(1) @binding(4) var pairs: texture_2d<u32>;

// What the map's models have at most. Lanes of a processor pay for every branch, taken or not.
override LOBES: u32 = 4u;
override HEMISPHERICAL: bool = true;
override SPHERICAL: bool = true;
// Whether numbers have four bytes.
override IS_WIDE: bool = true;

const RADIANCE: u32 = 0u;
const MODELS: u32 = 1u;

const HIT: u32 = 1u;
const FILLED: u32 = 2u;
const LEAST_COSINE: f32 = 0.01;
const UNRESOLVED: u32 = 1u;
const CLIPPED: u32 = 2u;
const OUTLIERS: u32 = 4u;
const MISFIT: u32 = 8u;

struct Shaded {
    radiance: vec3<f32>,
    provenance: u32,
}

fn provenance(answer: u32, sample_index: u32) -> u32 {
    return (answer << 30u) | min(sample_index, 0x3fffffffu);
}

fn halves(words: vec2<u32>) -> vec4<f32> {
    return vec4(unpack2x16float(words.x), unpack2x16float(words.y));
}

fn pair(at: u32) -> Pair {
    if IS_WIDE {
        let first = textureLoad(pairs, place_of(2u * at), 0);
        return Pair(bitcast<vec4<f32>>(first), bitcast<vec4<f32>>(textureLoad(pairs, place_of(2u * at + 1u), 0)));
    }
    let words = textureLoad(pairs, place_of(at), 0);
    return Pair(halves(words.xy), halves(words.zw));
}

fn texel(at: u32) -> Texel {
    if IS_WIDE {
        let words = textureLoad(heads, place_of(2u * at), 0);
        return Texel(words.x, words.y, bitcast<vec4<f32>>(textureLoad(heads, place_of(2u * at + 1u), 0)));
    }
    let words = textureLoad(heads, place_of(at), 0);
    return Texel(words.x, words.y, halves(words.zw));
}

// The unit direction of a point of the hemi-octahedral square.
fn axis(u: f32, v: f32) -> vec3<f32> {
    let x = 0.5 * (u + v);
    let y = 0.5 * (u - v);
    return normalize(vec3(x, y, 1.0 - abs(x) - abs(y)));
}

// xᵐ for x ≥ 0 without pow's pole at 0.
fn power(x: f32, exponent: f32) -> f32 {
    return select(0.0, exp2(exponent * log2(max(x, 1e-30))), x > 0.0);
}

fn lobe(at: u32, d: vec3<f32>) -> vec3<f32> {
    let numbers = pair(at);
    let height = dot(axis(numbers.second.x + numbers.second.z, numbers.second.y + numbers.second.w), d);
    return numbers.first.xyz * power(height, exp(numbers.first.w));
}

// Twin of directions/spherical_harmonics.rs. The functions, and the sum that reads them, are those of directions/harmonics_wgsl.rs.
fn evaluate_basis(is_hemispherical: bool, d: vec3<f32>) {
    if is_hemispherical {
        let height = clamp(d.z, 0.0, 1.0);
        let squeeze = 2.0 * sqrt(height / (1.0 + height));
        evaluate_functions(vec3(squeeze * d.xy, 2.0 * height - 1.0), sqrt(2.0));
    } else {
        evaluate_functions(d, 1.0);
    }
}

// Eight coefficients, four to three quads: R G B R | G B R G | B R G B.
fn octet(at: u32, low: vec4<f32>, high: vec4<f32>) -> vec3<f32> {
    let a = pair(at);
    let b = pair(at + 1u);
    let c = pair(at + 2u);
    var sum = a.first.xyz * low.x + vec3(a.first.w, a.second.xy) * low.y + vec3(a.second.zw, b.first.x) * low.z + b.first.yzw * low.w;
    sum += b.second.xyz * high.x + vec3(b.second.w, c.first.xy) * high.y + vec3(c.first.zw, c.second.x) * high.z;
    return sum + c.second.yzw * high.w;
}

fn eval(model: Texel, d: vec3<f32>) -> vec3<f32> {
    let code = model.code & 0xffu;
    if HEMISPHERICAL || SPHERICAL {
        if code > 16u {
            if HEMISPHERICAL && SPHERICAL {
                evaluate_basis(code < 32u, d);
            }
            let bands = code & 15u;
            return max(sum_of_harmonics(model.first_pair, bands * bands), vec3(0.0));
        }
    }
    var sum = model.constant.xyz;
    if code == 2u {
        sum *= power(max(d.z, LEAST_COSINE), model.constant.w);
    }
    // One by one: a loop costs lavapipe more than what is in it.
    if LOBES > 0u {
        if code > 2u {
            sum += lobe(model.first_pair, d);
        }
    }
    if LOBES > 1u {
        if code > 3u {
            sum += lobe(model.first_pair + 1u, d);
        }
    }
    if LOBES > 2u {
        if code > 4u {
            sum += lobe(model.first_pair + 2u, d);
        }
    }
    if LOBES > 3u {
        if code > 5u {
            sum += lobe(model.first_pair + 3u, d);
        }
    }
    return sum;
}

// In texels, centres at whole numbers.
fn texel_position(uv: vec2<f32>) -> vec2<f32> {
    return uv * f32(shading.size) - 0.5;
}

fn texel_index(part: u32, column: f32, row: f32) -> u32 {
    let last = f32(shading.size) - 1.0;
    return (part * shading.size + u32(clamp(row, 0.0, last))) * shading.size + u32(clamp(column, 0.0, last));
}

fn nearest_texel(part: u32, uv: vec2<f32>) -> u32 {
    let at = floor(texel_position(uv) + 0.5);
    return texel_index(part, at.x, at.y);
}

// Twin of TangentFrame::along, local_from_world.
fn local_direction(normal: vec3<f32>, along: vec3<f32>, toward_viewer: vec3<f32>) -> vec3<f32> {
    let flat_part = along - normal * dot(normal, along);
    let squared = dot(flat_part, flat_part);
    let side = select(-1.0, 1.0, normal.z >= 0.0);
    let a = -1.0 / (side + normal.z);
    let any_tangent = vec3(1.0 + side * normal.x * normal.x * a, side * normal.x * normal.y * a, -side * normal.x);
    let tangent = select(any_tangent, flat_part * inverseSqrt(squared), squared > 0.0);
    let d = vec3(dot(toward_viewer, tangent), dot(toward_viewer, cross(normal, tangent)), dot(toward_viewer, normal));
    return normalize(vec3(d.xy, max(d.z, LEAST_COSINE)));
}

// Of the texels that have a model, by their weights among themselves.
fn blend(point: ObjectPoint, direction: vec3<f32>) -> Shaded {
    let d = local_direction(point.normal, point.tangent, -direction);
    // All texels of this pixel share the direction, and the functions if they share the basis.
    if HEMISPHERICAL != SPHERICAL {
        evaluate_basis(HEMISPHERICAL, d);
    }
    let at = texel_position(point.uv);
    let low = floor(at);
    let f = at - low;
    var sum = vec3(0.0);
    var total = 0.0;
    var is_sure = true;
    for (var k = 0u; k < 4u; k++) {
        let step = vec2(f32(k & 1u), f32(k >> 1u));
        let toward = select(1.0 - f, f, step > vec2(0.5));
        let weight = toward.x * toward.y;
        let corner = texel(texel_index(point.part, low.x + step.x, low.y + step.y));
        if (corner.code & 0xffu) == 0u {
            is_sure = is_sure && weight == 0.0;
            continue;
        }
        is_sure = is_sure && ((corner.code >> 8u) & UNRESOLVED) == 0u;
        sum += weight * eval(corner, d);
        total += weight;
    }
    if !(total > 0.0) {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let answer = select(FILLED, HIT, is_sure);
    return Shaded(max(sum / total, vec3(0.0)), provenance(answer, nearest_texel(point.part, point.uv)));
}

fn model_color(code: u32) -> vec3<f32> {
    switch code {
        case 0u: { return vec3(0.0); }
        case 1u: { return vec3(0.5); }
        case 2u: { return vec3(0.4, 0.25, 0.1); }
        case 3u: { return vec3(0.05, 0.2, 0.8); }
        case 4u: { return vec3(0.05, 0.6, 0.2); }
        case 5u: { return vec3(0.9, 0.6, 0.05); }
        case 6u: { return vec3(0.9, 0.1, 0.05); }
        default: { return vec3(0.4, 0.1, 0.5) * (0.5 + 0.05 * f32(code & 15u)); }
    }
}

fn on(bits: u32, bit: u32) -> f32 {
    return select(0.1, 0.7, (bits & bit) != 0u);
}

fn flags_color(bits: u32) -> vec3<f32> {
    let color = vec3(on(bits, UNRESOLVED), on(bits, CLIPPED), on(bits, MISFIT));
    return select(color, color + 0.3, (bits & OUTLIERS) != 0u);
}

fn overlay(index: u32) -> Shaded {
    let code = texel(index).code;
    if (code & 0xffu) == 0u {
        return Shaded(vec3(0.0), provenance(3u, index));
    }
    let color = select(flags_color(code >> 8u), model_color(code & 0xffu), shading.show_what == MODELS);
    return Shaded(color, provenance(HIT, index));
}

fn shade_point(point: ObjectPoint, direction: vec3<f32>) -> Shaded {
    if !point.front {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    if shading.show_what == RADIANCE {
        return blend(point, direction);
    }
    return overlay(nearest_texel(point.part, point.uv));
}

@compute @workgroup_size(64)
fn shade(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= atomicLoad(&work.lists[OBJECT_LIST].count) {
        return;
    }
    let at = listed_pixel(OBJECT_LIST, id.x);
    let direction = direction_of(at);
    let point = object_point(direction, visible_triangle(at) - 1u);
    let shaded = shade_point(point, direction);
    write_pixel(at, shaded.radiance, point.distance, shaded.provenance);
}
