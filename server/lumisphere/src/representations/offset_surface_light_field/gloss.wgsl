// Twin of gloss.rs: the same functions by the same names. Part of kernel.wgsl.

const OVERLAP: f32 = 4.0;

// Whether sample points are integrated one by one.
override INTEGRATES_FIRST: bool = false;
// Whether one look takes in the whole highlight.
override PREFILTERED: bool = false;

@group(2) @binding(7) var measured_table: texture_2d<f32>;

fn measured_texel(at: u32) -> vec4<f32> {
    return textureLoad(measured_table, place_of(at), 0);
}

fn glossy(
    at: Sight,
    across: Sight,
    down: Sight,
    reflecting: Reflecting,
    tangent: vec3<f32>,
    candidates: vec4<u32>,
) -> Shaded {
    let nearest = first_of(candidates != vec4(NO_SAMPLE));
    if nearest == 4u && BLEND != ENVIRONMENT_MAP {
        return Shaded(vec3(0.0), PROVENANCE_UNKNOWN);
    }
    let named = select(element(candidates, nearest), shading.baseline_cube, BLEND == ENVIRONMENT_MAP);
    let frame = frame_along(reflecting.normal, tangent);
    let wo = local_from_world(frame, -at.direction);
    let pixel = reflecting.mirrored;
    let covered = length(cross(pixel.across, pixel.down));
    var blend = BlendWeights(vec4(1.0, 0.0, 0.0, 0.0), HIT);
    if INTEGRATES_FIRST {
        blend = blend_weights(
            candidates,
            toward_sample(at.position, candidates.x, at.normal),
            toward_sample(at.position, candidates.y, at.normal),
            toward_sample(at.position, candidates.z, at.normal),
            toward_sample(at.position, candidates.w, at.normal),
            at.normal,
            pixel.direction,
        );
    }
    var radiance = vec3(0.0);
    var is_filled = blend.answer != HIT;
    if PREFILTERED {
        let highlight = highlight_about(wo);
        let look = over_highlight(frame, highlight, at.normal, pixel);
        let found = radiance_toward(at, across, down, look, candidates);
        let density = brdf_pdf(gloss, wo, highlight.wi);
        let is_lost = !(density > 0.0) || enters(reflecting, look.direction, at);
        let weight = select(brdf_eval(gloss, wo, highlight.wi) * (highlight.wi.z / density), vec3(0.0), is_lost);
        radiance = weight * found.radiance;
        is_filled = (found.provenance >> 30u) != HIT;
    } else {
        let sharing = shading.first_direction + shading.directions;
        for (var k = 0u; k < select(1u, 4u, INTEGRATES_FIRST); k++) {
            let share = component(blend.weights, k);
            if share <= 0.0 {
                continue;
            }
            let own = select(0u, element(candidates, k), INTEGRATES_FIRST);
            var integral = vec3(0.0);
            for (var number = shading.first_direction; number < sharing; number++) {
                let drawn = brdf_sample(gloss, wo, place(number, own));
                let toward = world_from_local(frame, drawn.wi);
                if drawn.pdf > 0.0 && !enters(reflecting, toward, at) {
                    let weight = brdf_eval(gloss, wo, drawn.wi) * (drawn.wi.z / drawn.pdf);
                    let solid_angle = OVERLAP / (f32(sharing) * drawn.pdf) + covered;
                    let look = spread(toward, solid_angle);
                    if INTEGRATES_FIRST {
                        integral += weight * read_cube(own, look);
                    } else {
                        let found = radiance_toward(at, across, down, look, candidates);
                        integral += weight * found.radiance;
                        is_filled |= (found.provenance >> 30u) != HIT;
                    }
                }
            }
            radiance += share * integral;
        }
        radiance /= f32(shading.directions);
    }
    if RELIT {
        for (var number = 0u; number < light.point_light_count; number++) {
            let to_light = light.point_lights[number].position - at.position;
            let toward = normalize_or(to_light, vec3(0.0));
            let wi = local_from_world(frame, toward);
            if wi.z > 0.0 && !enters(reflecting, toward, at) {
                let seen = light_visibility(at, candidates, light.point_lights[number].position);
                let arriving = light.point_lights[number].intensity * (seen * wi.z / dot(to_light, to_light));
                radiance += brdf_eval(gloss, wo, wi) * arriving;
            }
        }
    }
    return Shaded(radiance, provenance_of(select(HIT, FILLED, is_filled), named));
}

fn place(number: u32, own: u32) -> vec2<f32> {
    let stratum = 0xffffffffu / shading.directions;
    let part = ((number / shading.directions) * GOLDEN + 0x80000000u) >> 16u;
    let within = (stratum >> 16u) * part + (((stratum & 0xffffu) * part) >> 16u);
    let across = (number % shading.directions) * stratum + within + own * 2447445413u;
    let around = number * GOLDEN + 0x80000000u + own * 3367900313u;
    return vec2(f32(across >> 8u), f32(around >> 8u)) / 16777216.0;
}

const GOLDEN: u32 = 2654435769u;

// Not filtered, a kernel reads a single direction whatever its derivatives.
fn spread(direction: vec3<f32>, solid_angle: f32) -> DirectionDifferential {
    let frame = frame_around(direction);
    let side = sqrt(solid_angle);
    return DirectionDifferential(direction, side * frame.tangent, side * frame.bitangent);
}
