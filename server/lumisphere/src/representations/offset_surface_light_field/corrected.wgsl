// Twin of corrected.rs: the same functions by the same names. Part of kernel.wgsl.

const MARCH_STEPS: u32 = 12u;
const REFINEMENTS: u32 = 5u;
const MOST_DISAGREEMENT: f32 = 0.1;
const MOST_STEEPNESS: f32 = 0.3;
const LEAST_DISTANCE: f32 = 1e-30;
const FALLBACK_EXPONENT: f32 = 4.0;
const LEAST_SQUARE: f32 = 1e-12;

struct InverseDistances {
    mean: f32,
    least: f32,
    most: f32,
}

// What is not there counts as infinitely far: coarse levels hold no distances.
fn inverse_distances(cube: u32, direction: vec3<f32>) -> InverseDistances {
    let position = face_from_direction(direction);
    var found = InverseDistances(0.0, 3e38, 0.0);
    var sum = 0.0;
    for (var number = 0u; number < 4u; number++) {
        let at = corner(position, shading.face_size, number);
        if at.texel.exists {
            let distance = cube_texel(cube, at.texel, 0u).w;
            // By its bits: compilers may assume that there is no infinity.
            let is_finite = distance >= LEAST_DISTANCE && bitcast<u32>(distance) < 0x7f800000u;
            let inverse = select(0.0, 1.0 / distance, is_finite);
            found.mean += at.weight * inverse;
            found.least = min(found.least, inverse);
            found.most = max(found.most, inverse);
            sum += at.weight;
        }
    }
    found.mean /= sum;
    return found;
}

fn disagreement(a: f32, b: f32) -> f32 {
    let larger = max(a, b);
    return select(0.0, abs(a - b) / larger, larger > 0.0);
}

fn sees(cube: u32, p: vec3<f32>, x: vec3<f32>) -> bool {
    let offset = x - p;
    return disagreement(1.0 / length(offset), inverse_distances(cube, offset).mean) < MOST_DISAGREEMENT;
}

fn first_surface(cube: u32, p: vec3<f32>, x: vec3<f32>, r: vec3<f32>) -> f32 {
    let distance = length(x - p);
    if !(distance > 0.0) {
        return inverse_distances(cube, r).mean;
    }
    let e = (x - p) / distance;
    var front = 0.0;
    var behind = 0.0;
    var gap_front = 0.0;
    var gap_behind = 0.0;
    var is_in_front = false;
    var step = 0u;
    var refinements = 0u;
    for (var read = 0u; read < MARCH_STEPS + 2u * REFINEMENTS; read++) {
        var s = 0.0;
        if refinements > 0u {
            s = front + (behind - front) * (gap_front / (gap_front - gap_behind));
        } else {
            step += 1u;
            s = f32(step) / f32(MARCH_STEPS);
        }
        let direction = (1.0 - s) * e + s * r;
        let seen = inverse_distances(cube, direction);
        let size = length(direction);
        let gap = select(1.0 / distance, (1.0 - s) / (distance * size) - seen.mean, size > 0.0);
        if refinements > 0u {
            refinements -= 1u;
            if refinements == 0u {
                if disagreement(seen.least, seen.most) < MOST_STEEPNESS {
                    return (1.0 - s) / (distance * s);
                }
                is_in_front = false;
            }
            if gap > 0.0 {
                front = s;
                gap_front = gap;
                gap_behind *= 0.5;
            } else {
                behind = s;
                gap_behind = gap;
                gap_front *= 0.5;
            }
        } else if gap > 0.0 {
            is_in_front = true;
            front = s;
            gap_front = gap;
        } else if is_in_front {
            refinements = REFINEMENTS;
            behind = s;
            gap_behind = gap;
        }
        if refinements == 0u && step == MARCH_STEPS {
            break;
        }
    }
    return -1.0;
}

fn first_met(candidates: vec4<u32>, x: vec3<f32>, r: vec3<f32>) -> f32 {
    var inverse = -1.0;
    for (var k = 0u; k < 4u; k++) {
        let candidate = element(candidates, k);
        if candidate != NO_SAMPLE {
            inverse = max(inverse, first_surface(candidate, sample_points[candidate].xyz, x, r));
        }
    }
    return inverse;
}

fn agreeing_weights(candidates: vec4<u32>, x: vec3<f32>, n: vec3<f32>, r: vec3<f32>, inverse: f32) -> vec4<f32> {
    var weights = vec4(0.0);
    for (var k = 0u; k < 4u; k++) {
        let candidate = element(candidates, k);
        if candidate != NO_SAMPLE {
            let p = sample_points[candidate].xyz;
            let look = inverse * (x - p) + r;
            let seen = inverse_distances(candidate, look);
            let agreement = 1.0 - disagreement(inverse / length(look), seen.mean) / MOST_DISAGREEMENT;
            let cosine = max(dot(n, toward(x, p, n)), 0.0);
            let square = max(dot(x - p, x - p), LEAST_SQUARE);
            weights += only(k) * (max(agreement, 0.0) * (cosine * cosine) * (cosine * cosine) / square);
        }
    }
    return weights;
}

fn corrected(at: Sight, across: Sight, down: Sight, r: DirectionDifferential, candidates: vec4<u32>) -> Shaded {
    let x = at.position;
    let n = at.normal;
    var inverse = first_met(candidates, x, r.direction);
    var blend = BlendWeights(vec4(0.0), HIT);
    if inverse >= 0.0 {
        blend.weights = agreeing_weights(candidates, x, n, r.direction, inverse);
    }
    if all(blend.weights == vec4(0.0)) {
        inverse = 0.0;
        let valid = candidates != vec4(NO_SAMPLE);
        let nearest = first_of(valid);
        if nearest == 4u {
            return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
        }
        let weights = normalized(sharpened(cosines_above(x, n, candidates), valid, FALLBACK_EXPONENT));
        blend = BlendWeights(select(weights, only(nearest), all(weights == vec4(0.0))), FILLED);
    }
    let w = blend.weights;
    let sum = w.x + w.y + w.z + w.w;
    let heaviest = element(candidates, first_of(w == vec4(max(max(w.x, w.y), max(w.z, w.w)))));
    var radiance = vec3(0.0);
    for (var k = 0u; k < 4u; k++) {
        let weight = component(w, k);
        if weight > 0.0 {
            let candidate = element(candidates, k);
            let look = looking(inverse, x - sample_points[candidate].xyz, r, across, down);
            radiance += weight / sum * read_cube(candidate, look);
        }
    }
    return Shaded(radiance, provenance_of(blend.answer, heaviest));
}

fn looking(inverse: f32, offset: vec3<f32>, r: DirectionDifferential, across: Sight, down: Sight) -> DirectionDifferential {
    return DirectionDifferential(
        inverse * offset + r.direction,
        inverse * across.position + r.across,
        inverse * down.position + r.down,
    );
}
