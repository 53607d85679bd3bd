// Twin of relight.rs: the same functions by the same names. Part of kernel.wgsl.

// Whether the environment is turned.
override TURNED: bool = false;
// Whether any light is another than was captured.
override RELIT: bool = false;

const TOLERANCE: f32 = 0.05;
const MOST_REFLECTANCE: f32 = 0.31830989;

// The environment's cube map: its levels below each other, faces below each other in each.
@group(2) @binding(4) var environment_cube: texture_2d<f32>;
// Six texels a sample point, 256 sample points a row: vector irradiances as stored, as shown; R, G, B each.
@group(2) @binding(5) var irradiances: texture_2d<f32>;

struct PointLight {
    position: vec3<f32>,
    intensity: vec3<f32>,
}

struct LightInfo {
    turn_cos: f32,
    turn_sin: f32,
    // Texels along a face of the environment's first level, and the dataset's level of that size.
    environment_size: u32,
    environment_base: u32,
    point_light_count: u32,
    point_lights: array<PointLight, 4>,
}

@group(1) @binding(8) var<storage, read> light: LightInfo;

// rotate_y(−turn) · direction
fn before(direction: vec3<f32>) -> vec3<f32> {
    let c = light.turn_cos;
    let s = light.turn_sin;
    return vec3(c * direction.x - s * direction.z, direction.y, s * direction.x + c * direction.z);
}

fn environment_level(level: u32) -> u32 {
    return max(level, light.environment_base) - light.environment_base;
}

fn environment_texel(level: u32, texel: CubeTexel) -> vec3<f32> {
    let size = light.environment_size >> environment_level(level);
    let row = 12u * (light.environment_size - size) + texel.face * size + texel.row;
    return textureLoad(environment_cube, vec2(texel.column, row), 0).rgb;
}

fn environment_toward(direction: vec3<f32>, level: u32) -> vec3<f32> {
    let position = face_from_direction(direction);
    var radiance = vec3(0.0);
    var sum = 0.0;
    for (var number = 0u; number < 4u; number++) {
        let at = corner(position, light.environment_size >> environment_level(level), number);
        if at.texel.exists {
            radiance += at.weight * environment_texel(level, at.texel);
            sum += at.weight;
        }
    }
    return radiance / sum;
}

// By its bits: compilers may assume that there is no infinity.
fn sky_share(fourth: f32, level: u32) -> f32 {
    return select(select(0.0, 1.0, bitcast<u32>(fourth) == 0x7f800000u), fourth, level > 0u);
}

fn near_light(radiance: vec3<f32>, share: f32, level: u32, texel: CubeTexel) -> vec3<f32> {
    if share >= 1.0 {
        return vec3(0.0);
    }
    if share > 0.0 {
        return max(radiance - share * environment_texel(level, texel), vec3(0.0));
    }
    return radiance;
}

fn plane_irradiance(candidate: u32, first: u32, n: vec3<f32>) -> vec3<f32> {
    let at = vec2(6u * (candidate & 255u) + first, candidate >> 8u);
    let red = textureLoad(irradiances, at, 0).xyz;
    let green = textureLoad(irradiances, at + vec2(1u, 0u), 0).xyz;
    let blue = textureLoad(irradiances, at + vec2(2u, 0u), 0).xyz;
    return max(vec3(dot(red, n), dot(green, n), dot(blue, n)), vec3(0.0));
}

fn nearness(x: vec3<f32>, n: vec3<f32>, p: vec3<f32>) -> f32 {
    let cosine = max(dot(n, toward(x, p, n)), 0.0);
    return (cosine * cosine) * (cosine * cosine) / max(dot(x - p, x - p), LEAST_SQUARE);
}

fn relit(at: Sight, candidates: vec4<u32>, own: vec3<f32>) -> vec3<f32> {
    let x = at.position;
    let n = at.normal;
    var stored = vec3(0.0);
    var shown = vec3(0.0);
    var sum = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let candidate = element(candidates, k);
        if candidate != NO_SAMPLE {
            let weight = nearness(x, n, sample_points[candidate].xyz);
            stored += weight * plane_irradiance(candidate, 0u, n);
            shown += weight * plane_irradiance(candidate, 3u, n);
            sum += weight;
        }
    }
    if !(sum > 0.0) {
        return own;
    }
    let reflectance = min(select(vec3(0.0), own / stored, stored > vec3(0.0)), vec3(MOST_REFLECTANCE / sum));
    var added = shown - stored;
    for (var number = 0u; number < light.point_light_count; number++) {
        let to_light = light.point_lights[number].position - x;
        let squared = dot(to_light, to_light);
        let cosine = dot(n, to_light) / sqrt(squared);
        if cosine > 0.0 {
            let seen = light_visibility(at, candidates, light.point_lights[number].position);
            added += sum * (seen * cosine / squared) * light.point_lights[number].intensity;
        }
    }
    return max(own + reflectance * added, vec3(0.0));
}

fn light_visibility(at: Sight, candidates: vec4<u32>, y: vec3<f32>) -> f32 {
    let x = at.position;
    let n = at.normal;
    let distance = length(y - x);
    let r = (y - x) / distance;
    var seen = 0.0;
    var sum = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let candidate = element(candidates, k);
        if candidate != NO_SAMPLE {
            let p = sample_points[candidate].xyz;
            let weight = nearness(x, n, p);
            let met = first_surface(candidate, p, x, r);
            var hides = met * distance;
            if met < 0.0 {
                hides = inverse_distances(candidate, y - p).mean * length(y - p);
            }
            seen += select(0.0, weight, hides < 1.0 + TOLERANCE);
            sum += weight;
        }
    }
    return select(0.0, seen / sum, sum > 0.0);
}
