// Twin of gloss.rs: the same functions by the same names. Part of kernel.wgsl.

const OVERLAP: f32 = 4.0;

struct TangentFrame {
    tangent: vec3<f32>,
    bitangent: vec3<f32>,
    normal: vec3<f32>,
}

fn frame_around(normal: vec3<f32>) -> TangentFrame {
    let side = select(1.0, -1.0, normal.z < 0.0);
    let a = -1.0 / (side + normal.z);
    let b = normal.x * normal.y * a;
    let tangent = vec3(1.0 + side * normal.x * normal.x * a, side * b, -side * normal.x);
    return TangentFrame(tangent, vec3(b, side + normal.y * normal.y * a, -normal.y), normal);
}

fn frame_along(normal: vec3<f32>, tangent: vec3<f32>) -> TangentFrame {
    let across = tangent - normal * dot(normal, tangent);
    let size = length(across);
    if !(size > 0.0) {
        return frame_around(normal);
    }
    let unit = across / size;
    return TangentFrame(unit, cross(normal, unit), normal);
}

fn world_from_local(frame: TangentFrame, local: vec3<f32>) -> vec3<f32> {
    return local.x * frame.tangent + local.y * frame.bitangent + local.z * frame.normal;
}

fn local_from_world(frame: TangentFrame, world: vec3<f32>) -> vec3<f32> {
    return vec3(dot(world, frame.tangent), dot(world, frame.bitangent), dot(world, frame.normal));
}

fn glossy(at: Sight, across: Sight, down: Sight, tangent: vec3<f32>, candidates: vec4<u32>) -> Shaded {
    let nearest = first_of(candidates != vec4(NO_SAMPLE));
    if nearest == 4u && BLEND != ENVIRONMENT_MAP {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let named = select(element(candidates, nearest), shading.baseline_cube, BLEND == ENVIRONMENT_MAP);
    let frame = frame_along(at.normal, tangent);
    let wo = local_from_world(frame, -at.direction);
    let pixel = mirrored(at, across, down);
    let covered = length(cross(pixel.across, pixel.down));
    var radiance = vec3(0.0);
    var is_filled = false;
    for (var number = 0u; number < shading.directions; number++) {
        let drawn = brdf_sample(gloss, wo, place(number));
        if drawn.pdf > 0.0 {
            let weight = brdf_eval(gloss, wo, drawn.wi) * (drawn.wi.z / drawn.pdf);
            let solid_angle = OVERLAP / (f32(shading.directions) * drawn.pdf) + covered;
            let look = spread(world_from_local(frame, drawn.wi), solid_angle);
            let found = radiance_toward(at, across, down, look, candidates);
            radiance += weight * found.radiance;
            is_filled |= (found.provenance >> 30u) != HIT;
        }
    }
    return Shaded(radiance / f32(shading.directions), provenance_of(select(HIT, FILLED, is_filled), named));
}

fn place(number: u32) -> vec2<f32> {
    let x = (number + 1u) * 3242174889u;
    let y = (number + 1u) * 2447445413u;
    return vec2(f32(x >> 8u), f32(y >> 8u)) / 16777216.0;
}

// Not filtered, a kernel reads a single direction whatever its derivatives.
fn spread(direction: vec3<f32>, solid_angle: f32) -> DirectionDifferential {
    let frame = frame_around(direction);
    let side = sqrt(solid_angle);
    return DirectionDifferential(direction, side * frame.tangent, side * frame.bitangent);
}
