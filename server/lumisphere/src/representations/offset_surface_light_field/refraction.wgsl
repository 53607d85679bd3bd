// Twin of refraction.rs and of radiometry/dielectric.rs: the same functions by the same names. Part of kernel.wgsl.

const MOST_INTERNAL: u32 = 4u;
const MOST_APART: f32 = 1.0;

const LOST: u32 = 0u;
const WITHOUT_EXIT: u32 = 1u;
const LEAVES: u32 = 2u;

struct InnerPoint {
    exists: bool,
    position: vec3<f32>,
    normal: vec3<f32>,
    uv: vec2<f32>,
    part: u32,
}

struct Passage {
    state: u32,
    exit: InnerPoint,
    direction: vec3<f32>,
    transmittance: f32,
}

fn fresnel_reflectance(cosine_outside: f32, index: f32) -> f32 {
    let cosine = clamp(cosine_outside, 0.0, 1.0);
    let inside = sqrt(max(1.0 - (1.0 - cosine * cosine) / (index * index), 0.0));
    let crossing = index * inside;
    let along = index * cosine;
    if !(cosine + crossing > 0.0 && along + inside > 0.0) {
        return 1.0;
    }
    let perpendicular = (cosine - crossing) / (cosine + crossing);
    let parallel = (along - inside) / (along + inside);
    return 0.5 * (perpendicular * perpendicular + parallel * parallel);
}

fn reflectance(cosine: f32) -> f32 {
    let of_surface = fresnel_reflectance(cosine, shading.refraction_index);
    return select(of_surface, 2.0 * of_surface / (1.0 + of_surface), COMPONENT == THIN);
}

fn next_inside(position: vec3<f32>, normal: vec3<f32>, direction: vec3<f32>) -> InnerPoint {
    let point = next_surface(position, normal, direction);
    return InnerPoint(point.exists, point.position, outward(point.shading, point.geometric, direction), point.uv, point.part);
}

struct Refracted {
    exists: bool,
    direction: vec3<f32>,
}

fn refracted(d: vec3<f32>, n: vec3<f32>, ratio: f32) -> Refracted {
    let cosine = clamp(-dot(n, d), 0.0, 1.0);
    let squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine);
    if !(squared > 0.0) {
        return Refracted(false, d);
    }
    return Refracted(true, normalize(ratio * d + (ratio * cosine - sqrt(squared)) * n));
}

fn passage(at: Sight) -> Passage {
    let entering = 1.0 - reflectance(-dot(at.normal, at.direction));
    let is_thin = COMPONENT == THIN;
    var direction = at.direction;
    var state = WITHOUT_EXIT;
    if !is_thin {
        let inside = refracted(at.direction, at.normal, 1.0 / shading.refraction_index);
        direction = inside.direction;
        state = select(LOST, WITHOUT_EXIT, inside.exists);
    }
    var from_position = at.position;
    var from_normal = at.normal;
    var exit = InnerPoint(false, vec3(0.0), vec3(0.0), vec2(0.0), 0u);
    if state == LOST {
        return Passage(LOST, exit, direction, 0.0);
    }
    for (var reflections = 0u; reflections <= MOST_INTERNAL; reflections++) {
        exit = next_inside(from_position, from_normal, direction);
        if !exit.exists {
            return Passage(WITHOUT_EXIT, exit, direction, entering);
        }
        if is_thin {
            return Passage(LEAVES, exit, direction, entering * (1.0 - reflectance(abs(dot(exit.normal, direction)))));
        }
        let out = refracted(direction, -exit.normal, shading.refraction_index);
        if out.exists {
            return Passage(LEAVES, exit, out.direction, entering * (1.0 - reflectance(dot(exit.normal, out.direction))));
        }
        direction = normalize(direction - 2.0 * dot(direction, exit.normal) * exit.normal);
        from_position = exit.position;
        from_normal = exit.normal;
    }
    return Passage(LOST, exit, direction, 0.0);
}

fn refraction(at: Sight, across: Sight, down: Sight, candidates: vec4<u32>) -> Shaded {
    let outside = radiance_toward(at, across, down, mirrored(at, across, down), candidates);
    let reflected = reflectance(-dot(at.normal, at.direction)) * outside.radiance;
    // The way itself, then two neighbours': in a loop, since compilers inline every call.
    var way = Passage(LOST, InnerPoint(false, vec3(0.0), vec3(0.0), vec2(0.0), 0u), vec3(0.0), 0.0);
    var by_across = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
    var by_down = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
    for (var number = 0u; number < select(1u, 3u, FILTERED); number++) {
        var by = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
        if number == 1u {
            by = across;
        } else if number == 2u {
            by = down;
        }
        let found = passage(neighbour_sight(at, by));
        if number == 0u {
            way = found;
        } else if number == 1u {
            by_across = apart(way, found, by);
        } else {
            by_down = apart(way, found, by);
        }
        if way.state == LOST {
            break;
        }
    }
    if way.state == LOST {
        return Shaded(reflected, PROVENANCE_UNKNOWN);
    }
    let look = DirectionDifferential(way.direction, by_across.direction, by_down.direction);
    var beyond: Shaded;
    if way.state == LEAVES {
        let there = Sight(way.exit.position, way.exit.normal, way.direction);
        beyond = radiance_toward(there, by_across, by_down, look, candidates_at(way.exit.part, way.exit.uv));
    } else {
        beyond = Shaded(read_cube(shading.baseline_cube, look), provenance_of(FILLED, shading.baseline_cube));
    }
    return Shaded(reflected + way.transmittance * beyond.radiance, worse(outside.provenance, beyond.provenance));
}

// Position and direction.
fn apart(way: Passage, other: Passage, by: Sight) -> Sight {
    let eyes = Sight(vec3(0.0), vec3(0.0), by.direction);
    let direction = other.direction - way.direction;
    if other.state != way.state || !(length(direction) < MOST_APART) {
        return eyes;
    }
    return Sight(select(by.position, other.exit.position - way.exit.position, way.state == LEAVES), vec3(0.0), direction);
}
