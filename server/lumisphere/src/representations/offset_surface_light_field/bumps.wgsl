// Twin of bumps.rs and of geometry/normal_map.rs: the same functions by the same names. Part of kernel.wgsl.

// Whether a map turns the normals.
override BUMPED: bool = false;

// Slopes, row by row.
@group(2) @binding(8) var normal_map: texture_2d<f32>;

struct Reflecting {
    normal: vec3<f32>,
    mirrored: DirectionDifferential,
}

fn enters(reflecting: Reflecting, wi: vec3<f32>, at: Sight) -> bool {
    return BUMPED && any(reflecting.normal != at.normal) && !(dot(wi, at.normal) > 0.0);
}

// First and second of the texels around x, and the share of the second.
struct Beside {
    first: u32,
    second: u32,
    share: f32,
}

fn texels_beside(x: f32, size: u32) -> Beside {
    let below = floor(x);
    let first = select(min(u32(max(below, 0.0)), size - 1u), size - 1u, below < 0.0);
    return Beside(first, select(first + 1u, 0u, first + 1u == size), x - below);
}

fn slope_texel(row: u32, column: u32) -> vec2<f32> {
    return textureLoad(normal_map, place_of(row * shading.normal_map_size.x + column), 0).xy;
}

fn slopes_at(uv: vec2<f32>) -> vec2<f32> {
    let size = shading.normal_map_size;
    let at = shading.normal_repeat * uv;
    let across = texels_beside((at.x - floor(at.x)) * f32(size.x) - 0.5, size.x);
    let down = 1.0 - at.y;
    let along = texels_beside((down - floor(down)) * f32(size.y) - 0.5, size.y);
    let t00 = slope_texel(along.first, across.first);
    let t01 = slope_texel(along.second, across.first);
    let upper = t00 + across.share * (slope_texel(along.first, across.second) - t00);
    let lower = t01 + across.share * (slope_texel(along.second, across.second) - t01);
    return shading.normal_strength * (upper + along.share * (lower - upper));
}

fn turned_normal(normal: vec3<f32>, tangent: vec3<f32>, side_of_v: f32, slopes: vec2<f32>) -> vec3<f32> {
    let frame = frame_along(normal, tangent);
    let turned = normalize_or(normal + slopes.x * frame.tangent + side_of_v * slopes.y * frame.bitangent, normal);
    return select(turned, normal, all(slopes == vec2(0.0)));
}

// Its derivatives are read where reads are filtered only.
fn turned_beside(normal: vec3<f32>, at: Sight, by: Sight, point: ObjectPoint, slopes: vec2<f32>) -> Sight {
    let neighbour = turned_normal(normalize_or(at.normal + by.normal, at.normal), point.tangent, point.side_of_v, slopes);
    return Sight(by.position, neighbour - normal, by.direction);
}

fn reflecting_at(at: Sight, across: Sight, down: Sight, point: ObjectPoint) -> Reflecting {
    let smooth_mirrored = mirrored(at, across, down);
    if !BUMPED {
        return Reflecting(at.normal, smooth_mirrored);
    }
    let scale = 1.0 / shading.pixel_scale;
    let slopes = slopes_at(point.uv);
    let slopes_across = slopes_at(point.uv + scale * point.across.uv);
    let slopes_down = slopes_at(point.uv + scale * point.down.uv);
    let normal = turned_normal(at.normal, point.tangent, point.side_of_v, slopes);
    let turned = mirrored(
        Sight(at.position, normal, at.direction),
        turned_beside(normal, at, across, point, slopes_across),
        turned_beside(normal, at, down, point, slopes_down),
    );
    let is_flat = all(slopes == vec2(0.0)) && (!FILTERED || (all(slopes_across == vec2(0.0)) && all(slopes_down == vec2(0.0))));
    if is_flat || !(dot(turned.direction, at.normal) > 0.0) {
        return Reflecting(normal, smooth_mirrored);
    }
    return Reflecting(normal, turned);
}
