// The GPU's twin of shade.rs and of packing.rs's reading half: the same functions by the same names. Runs over the list of the object's pixels.

struct Shading {
    // Texels along the edge of a part.
    size: u32,
    show_what: u32,
}

struct Texel {
    first_quad: u32,
    // Model's number in the low byte, flags in the next.
    code: u32,
}

@group(1) @binding(0) var object_triangles: texture_2d<u32>;
@group(1) @binding(1) var object_vertices: texture_2d<f32>;
@group(1) @binding(2) var<storage, read> shading: Shading;
// As `Texel`.
@group(1) @binding(3) var texels: texture_2d<u32>;
// All quads, one behind the other.
@group(1) @binding(4) var quads: texture_2d<f32>;
// Factors of the harmonics' recurrences: rise and fall of (l, m) at 10 l + m, then `first` of m at 100 + m.
@group(1) @binding(5) var recurrence: texture_2d<f32>;

// What the map's models have at most. Lanes of a processor pay for every branch, taken or not.
override LOBES: u32 = 4u;
override HARMONICS: bool = true;

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

fn quad(at: u32) -> vec4<f32> {
    return textureLoad(quads, place_of(at), 0);
}

fn texel(at: u32) -> Texel {
    let words = textureLoad(texels, place_of(at), 0);
    return Texel(words.x, words.y);
}

fn recurrence_factors(at: u32) -> vec2<f32> {
    return textureLoad(recurrence, vec2(at, 0u), 0).xy;
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
    let amplitude = quad(at);
    let place = quad(at + 1u);
    let height = dot(axis(place.x + place.z, place.y + place.w), d);
    return amplitude.xyz * power(height, exp(amplitude.w));
}

// Of the bands and basis of `known_code`, toward the direction that all texels of this pixel share.
var<private> known_code: u32 = 0u;
var<private> functions: array<f32, 100>;

// Twin of directions/spherical_harmonics.rs.
fn evaluate_functions(bands: u32, is_hemispherical: bool, d: vec3<f32>) {
    var p = d;
    var scale = 1.0;
    if is_hemispherical {
        let height = clamp(d.z, 0.0, 1.0);
        let squeeze = 2.0 * sqrt(height / (1.0 + height));
        p = vec3(squeeze * d.xy, 2.0 * height - 1.0);
        scale = sqrt(2.0);
    }
    var cosine = 1.0;
    var sine = 0.0;
    for (var m = 0u; m < bands; m++) {
        var before = 0.0;
        var legendre = scale * recurrence_factors(100u + m).x;
        for (var l = m; l < bands; l++) {
            if l > m {
                let factors = recurrence_factors(10u * l + m);
                let next = factors.x * p.z * legendre - factors.y * before;
                before = legendre;
                legendre = next;
            }
            let middle = l * (l + 1u);
            functions[middle + m] = legendre * cosine;
            if m > 0u {
                functions[middle - m] = legendre * sine;
            }
        }
        let turned = vec2(p.x * cosine - p.y * sine, p.x * sine + p.y * cosine);
        cosine = turned.x;
        sine = turned.y;
    }
}

// Four coefficients a turn: R G B R | G B R G | B R G B.
fn harmonics(first_quad: u32, code: u32, d: vec3<f32>) -> vec3<f32> {
    let bands = code & 15u;
    if code != known_code {
        evaluate_functions(bands, code < 32u, d);
        known_code = code;
    }
    let count = bands * bands;
    var sum = vec3(0.0);
    var at = first_quad;
    for (var i = 0u; i < count; i += 4u) {
        let a = quad(at);
        let b = quad(at + 1u);
        let c = quad(at + 2u);
        sum += a.xyz * functions[i];
        // Behind the last coefficient there are zeros, and whatever function is read must be finite.
        let last = count - 1u;
        sum += vec3(a.w, b.xy) * functions[min(i + 1u, last)];
        sum += vec3(b.zw, c.x) * functions[min(i + 2u, last)];
        sum += c.yzw * functions[min(i + 3u, last)];
        at += 3u;
    }
    return max(sum, vec3(0.0));
}

fn eval(model: Texel, d: vec3<f32>) -> vec3<f32> {
    let code = model.code & 0xffu;
    if HARMONICS {
        if code > 16u {
            return harmonics(model.first_quad, code, d);
        }
    }
    let first = quad(model.first_quad);
    var sum = first.xyz;
    if code == 2u {
        sum *= power(max(d.z, LEAST_COSINE), first.w);
    }
    if LOBES > 0u {
        if code > 2u {
            sum += lobe(model.first_quad + 1u, d);
        }
    }
    if LOBES > 1u {
        for (var j = 1u; j + 2u < code; j++) {
            sum += lobe(model.first_quad + 1u + 2u * j, d);
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
