// Twin of reflections.rs: the same functions by the same names. Part of kernel.wgsl.

const MOST_NORMALS_APART: f32 = 1.0;

struct NextSight {
    exists: bool,
    sight: Sight,
    uv: vec2<f32>,
    part: u32,
}

fn reflections(first: Sight, first_across: Sight, first_down: Sight, first_candidates: vec4<u32>) -> Shaded {
    var at = first;
    var across = first_across;
    var down = first_down;
    var candidates = first_candidates;
    var before = vec3(1.0);
    var sum = Shaded(vec3(0.0), 0u);
    var is_first = true;
    for (var number = 1u; number <= shading.reflections; number++) {
        let r = mirrored(at, across, down);
        var met = NextSight(false, at, vec2(0.0), 0u);
        var by_across = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
        var by_down = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
        if number < shading.reflections {
            // The ray itself, then two neighbours': in a loop, since compilers inline every call.
            for (var ray = 0u; ray < select(1u, 3u, FILTERED); ray++) {
                var by = Sight(vec3(0.0), vec3(0.0), vec3(0.0));
                var turn = vec3(0.0);
                if ray == 1u {
                    by = across;
                    turn = r.across;
                } else if ray == 2u {
                    by = down;
                    turn = r.down;
                }
                let beside = neighbour_sight(at, by);
                var direction = r.direction;
                if ray > 0u {
                    direction = mirror_direction(beside.normal, beside.direction);
                }
                let found = next_sight(beside, direction);
                let level = Sight(by.position + distance(at.position, met.sight.position) * turn, vec3(0.0), turn);
                if ray == 0u {
                    met = found;
                } else if ray == 1u {
                    by_across = sights_apart(met.sight, found, level);
                } else {
                    by_down = sights_apart(met.sight, found, level);
                }
                if !met.exists {
                    break;
                }
            }
        }
        if !met.exists || COMPONENT != MIRROR {
            let seen = radiance_toward(at, across, down, r, candidates);
            sum = Shaded(sum.radiance + before * seen.radiance, select(worse(sum.provenance, seen.provenance), seen.provenance, is_first));
            is_first = false;
        }
        if !met.exists {
            break;
        }
        before *= shading.specular_reflectance;
        at = met.sight;
        across = by_across;
        down = by_down;
        candidates = candidates_at(met.part, met.uv);
    }
    return sum;
}

fn next_sight(start: Sight, direction: vec3<f32>) -> NextSight {
    let point = next_surface(start.position, start.normal, direction);
    let normal = outward(point.shading, point.geometric, -direction);
    let before = dot(point.geometric, start.position - point.position);
    let is_front = dot(point.geometric, direction) < 0.0 && before > 0.5 * camera.near;
    return NextSight(point.exists && is_front, Sight(point.position, normal, direction), point.uv, point.part);
}

fn sights_apart(sight: Sight, other: NextSight, level: Sight) -> Sight {
    let normal = other.sight.normal - sight.normal;
    if other.exists && length(normal) < MOST_NORMALS_APART {
        return Sight(other.sight.position - sight.position, normal, other.sight.direction - sight.direction);
    }
    return level;
}
