// Twin of mod.rs and of the models beside it: the same functions by the same names (eval, sample and pdf of each model, prefixed by it),
// the same arithmetic in the same order. `BRDF_MODEL` picks one when a pipeline is made: the others cost nothing.

override BRDF_MODEL: u32 = 0u;

const LAMBERT = 0u;
const PHONG = 1u;
const ASHIKHMIN_SHIRLEY = 2u;
const COOK_TORRANCE = 3u;
const WARD = 4u;
const LAFORTUNE = 5u;
const MEASURED = 6u;

// A lobe of Lafortune's model; a black one has share 0.
struct LobeUniform {
    reflectance: vec3<f32>,
    exponent: f32,
    direction: vec3<f32>,
    share: f32,
}

// The numbers of any model (uniform.rs says which model uses which; of a measured one its highlight's share).
struct BrdfUniform {
    diffuse: vec3<f32>,
    exponent: f32,
    specular: vec3<f32>,
    specular_share: f32,
    f90: vec3<f32>,
    model: u32,
    across: vec2<f32>,
    // Sides of the highlight.
    highlight: vec2<f32>,
    first: LobeUniform,
    second: LobeUniform,
    third: LobeUniform,
}

// pdf 0: no direction was drawn.
struct BrdfSample {
    wi: vec3<f32>,
    pdf: f32,
}

struct HalfVector {
    h: vec3<f32>,
    along: f32,
}

const BRDF_PI: f32 = 3.14159265358979;
const BRDF_TAU: f32 = 6.28318530717959;
const BRDF_INVERSE_PI: f32 = 0.318309886183791;
const HORIZON: f32 = 1e-6;
const SERIES: f32 = 0.0625;
const LARGEST_SINE2: f32 = 0.9999999;

fn above_horizon(wo: vec3<f32>, wi: vec3<f32>) -> bool {
    return wo.z > HORIZON && wi.z > HORIZON;
}

fn half_vector(wo: vec3<f32>, wi: vec3<f32>) -> HalfVector {
    let sum = wo + wi;
    let size = length(sum);
    return HalfVector(sum / size, 0.5 * size);
}

fn fifth_power(x: f32) -> f32 {
    let square = x * x;
    return square * square * x;
}

fn fresnel(f0: vec3<f32>, f90: vec3<f32>, cosine: f32) -> vec3<f32> {
    return f0 + (f90 - f0) * fifth_power(max(1.0 - cosine, 0.0));
}

fn max_element(v: vec3<f32>) -> f32 {
    return max(max(v.x, v.y), v.z);
}

fn share_of_second(first: vec3<f32>, second: vec3<f32>) -> f32 {
    let a = max_element(first);
    let b = max_element(second);
    return select(0.0, b / (a + b), b > 0.0);
}

// lobes.rs

fn disc(u: vec2<f32>) -> vec2<f32> {
    let p = 2.0 * u - 1.0;
    if p.x == 0.0 && p.y == 0.0 {
        return vec2(0.0);
    }
    let wide = abs(p.x) > abs(p.y);
    let radius = select(p.y, p.x, wide);
    let angle = select(BRDF_PI / 2.0 - BRDF_PI / 4.0 * (p.x / p.y), BRDF_PI / 4.0 * (p.y / p.x), wide);
    return radius * vec2(cos(angle), sin(angle));
}

fn cosine_hemisphere(u: vec2<f32>) -> vec3<f32> {
    let d = disc(u);
    return vec3(d, sqrt(max(1.0 - dot(d, d), 0.0)));
}

fn cosine_pdf(wi: vec3<f32>) -> f32 {
    return max(wi.z, 0.0) * BRDF_INVERSE_PI;
}

fn log_ratio(x: f32) -> f32 {
    if x < SERIES {
        return 1.0 + x * (0.5 + x * (1.0 / 3.0 + x * (0.25 + x * (0.2 + x * (1.0 / 6.0)))));
    }
    return -log(1.0 - x) / x;
}

fn one_minus_exp(t: f32) -> f32 {
    if t < SERIES {
        return t * (1.0 - t / 2.0 * (1.0 - t / 3.0 * (1.0 - t / 4.0 * (1.0 - t / 5.0))));
    }
    return 1.0 - exp(-t);
}

fn cosine_power(x: f32, exponent: f32) -> f32 {
    if x < 1.0 {
        return exp(-exponent * x * log_ratio(x));
    }
    return 0.0;
}

fn one_minus_cosine(a: vec3<f32>, b: vec3<f32>) -> f32 {
    let off = a - b;
    return 0.5 * dot(off, off);
}

fn power_pdf(axis: vec3<f32>, exponent: f32, wi: vec3<f32>) -> f32 {
    return (exponent + 1.0) / BRDF_TAU * cosine_power(one_minus_cosine(axis, wi), exponent);
}

fn power_lobe(axis: vec3<f32>, exponent: f32, u: vec2<f32>) -> vec3<f32> {
    let off = one_minus_exp(-log(1.0 - u.x) / (exponent + 1.0));
    let radius = sqrt(max(off * (2.0 - off), 0.0));
    let local = vec3(radius * cos(BRDF_TAU * u.y), radius * sin(BRDF_TAU * u.y), 1.0 - off);
    return normalize(world_from_local(frame_around(axis), local));
}

// phong.rs

fn turned_about_normal(w: vec3<f32>) -> vec3<f32> {
    return vec3(-w.x, -w.y, w.z);
}

fn phong_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    let lobe = (brdf.exponent + 2.0) / BRDF_TAU * cosine_power(one_minus_cosine(turned_about_normal(wo), wi), brdf.exponent);
    return brdf.diffuse * BRDF_INVERSE_PI + brdf.specular * lobe;
}

fn phong_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let share = brdf.specular_share;
    return (1.0 - share) * cosine_pdf(wi) + share * power_pdf(turned_about_normal(wo), brdf.exponent, wi);
}

// ashikhmin_shirley.rs

fn ashikhmin_shirley_share(brdf: BrdfUniform, wo: vec3<f32>) -> f32 {
    return share_of_second(brdf.diffuse * (1.0 - brdf.specular), fresnel(brdf.specular, vec3(1.0), wo.z));
}

fn ashikhmin_shirley_half_pdf(brdf: BrdfUniform, h: vec3<f32>) -> f32 {
    let sine2 = min(h.x * h.x + h.y * h.y, LARGEST_SINE2);
    let turned = brdf.across.x * h.x * h.x + brdf.across.y * h.y * h.y;
    let norm = sqrt((brdf.across.x + 1.0) * (brdf.across.y + 1.0)) / BRDF_TAU;
    return norm * exp(-0.5 * turned * log_ratio(sine2));
}

fn ashikhmin_shirley_sample_half(brdf: BrdfUniform, u: vec2<f32>) -> vec3<f32> {
    let angle = BRDF_TAU * u.y;
    let across = normalize(vec2(cos(angle) * sqrt(brdf.across.y + 1.0), sin(angle) * sqrt(brdf.across.x + 1.0)));
    let n = brdf.across.x * across.x * across.x + brdf.across.y * across.y * across.y;
    let t = -log(1.0 - u.x) / (n + 1.0);
    return vec3(across * sqrt(one_minus_exp(2.0 * t)), exp(-t));
}

fn ashikhmin_shirley_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    let half = half_vector(wo, wi);
    let shape = ashikhmin_shirley_half_pdf(brdf, half.h) / (4.0 * half.along * max(wo.z, wi.z));
    let specular = fresnel(brdf.specular, vec3(1.0), half.along) * shape;
    let rims = (1.0 - fifth_power(1.0 - 0.5 * wo.z)) * (1.0 - fifth_power(1.0 - 0.5 * wi.z));
    return brdf.diffuse * (1.0 - brdf.specular) * (28.0 / (23.0 * BRDF_PI) * rims) + specular;
}

fn ashikhmin_shirley_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let half = half_vector(wo, wi);
    let share = ashikhmin_shirley_share(brdf, wo);
    return (1.0 - share) * cosine_pdf(wi) + share * ashikhmin_shirley_half_pdf(brdf, half.h) / (4.0 * half.along);
}

// cook_torrance.rs

fn cook_torrance_distribution(brdf: BrdfUniform, m: vec3<f32>) -> f32 {
    let slope = m.xy / brdf.across;
    let d = dot(slope, slope) + m.z * m.z;
    return 1.0 / (BRDF_PI * brdf.across.x * brdf.across.y * d * d);
}

fn cook_torrance_lambda(brdf: BrdfUniform, w: vec3<f32>) -> f32 {
    let stretched = brdf.across * w.xy;
    return 0.5 * (sqrt(1.0 + dot(stretched, stretched) / (w.z * w.z)) - 1.0);
}

fn cook_torrance_sample_facet(brdf: BrdfUniform, wo: vec3<f32>, u: vec2<f32>) -> vec3<f32> {
    let stretched = normalize(vec3(brdf.across * wo.xy, wo.z));
    let z = (1.0 - u.x) * (1.0 + stretched.z) - stretched.z;
    let radius = sqrt(max(1.0 - z * z, 0.0));
    let h = vec3(radius * cos(BRDF_TAU * u.y), radius * sin(BRDF_TAU * u.y), z) + stretched;
    let m = vec3(brdf.across * h.xy, max(h.z, 0.0));
    let size = length(m);
    return select(vec3(0.0, 0.0, 1.0), m / size, size > 0.0);
}

fn cook_torrance_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    let half = half_vector(wo, wi);
    let masking = 1.0 + cook_torrance_lambda(brdf, wo) + cook_torrance_lambda(brdf, wi);
    let shape = cook_torrance_distribution(brdf, half.h) / (4.0 * wo.z * wi.z * masking);
    return fresnel(brdf.specular, brdf.f90, half.along) * shape;
}

fn cook_torrance_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let half = half_vector(wo, wi);
    return cook_torrance_distribution(brdf, half.h) / (4.0 * wo.z * (1.0 + cook_torrance_lambda(brdf, wo)));
}

// ward.rs

fn ward_slope_pdf(brdf: BrdfUniform, h: vec3<f32>) -> f32 {
    let slope = h.xy / (brdf.across * h.z);
    return exp(-dot(slope, slope)) / (BRDF_PI * brdf.across.x * brdf.across.y);
}

fn ward_sample_half(brdf: BrdfUniform, u: vec2<f32>) -> vec3<f32> {
    let radius = sqrt(-log(1.0 - u.x));
    return normalize(vec3(brdf.across * radius * vec2(cos(BRDF_TAU * u.y), sin(BRDF_TAU * u.y)), 1.0));
}

fn ward_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    let half = half_vector(wo, wi);
    let up = wo.z + wi.z;
    let bounded = 2.0 * half.along / (up * up);
    return brdf.diffuse * BRDF_INVERSE_PI + brdf.specular * (ward_slope_pdf(brdf, half.h) * bounded * bounded);
}

fn ward_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let half = half_vector(wo, wi);
    let share = brdf.specular_share;
    let highlight = ward_slope_pdf(brdf, half.h) / (4.0 * half.along * half.h.z * half.h.z * half.h.z);
    return (1.0 - share) * cosine_pdf(wi) + share * highlight;
}

// lafortune.rs

// xyz: unit axis, w: height of the peak; zero where there is none.
fn lafortune_axis(lobe: LobeUniform, wo: vec3<f32>) -> vec4<f32> {
    let lost = dot(1.0 - lobe.direction * lobe.direction, wo * wo);
    let axis = lobe.direction * wo;
    let size = length(axis);
    if !(size > 0.0) {
        return vec4(0.0);
    }
    return vec4(axis / size, cosine_power(lost, 0.5 * lobe.exponent));
}

fn lafortune_lobe_eval(lobe: LobeUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    let axis = lafortune_axis(lobe, wo);
    let shape = axis.w * cosine_power(one_minus_cosine(axis.xyz, wi), lobe.exponent);
    return lobe.reflectance * ((lobe.exponent + 2.0) / BRDF_TAU * shape);
}

fn lafortune_lobe_pdf(lobe: LobeUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let axis = lafortune_axis(lobe, wo);
    return select(0.0, lobe.share * power_pdf(axis.xyz, lobe.exponent, wi), any(axis.xyz != vec3(0.0)));
}

fn lafortune_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    return brdf.diffuse * BRDF_INVERSE_PI
        + lafortune_lobe_eval(brdf.first, wo, wi)
        + lafortune_lobe_eval(brdf.second, wo, wi)
        + lafortune_lobe_eval(brdf.third, wo, wi);
}

fn lafortune_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let diffuse_share = max(1.0 - (brdf.first.share + brdf.second.share + brdf.third.share), 0.0);
    return diffuse_share * cosine_pdf(wi)
        + lafortune_lobe_pdf(brdf.first, wo, wi)
        + lafortune_lobe_pdf(brdf.second, wo, wi)
        + lafortune_lobe_pdf(brdf.third, wo, wi);
}

// The direction alone; its pdf is `lafortune_pdf`.
fn lafortune_sample(brdf: BrdfUniform, wo: vec3<f32>, u: vec2<f32>) -> vec3<f32> {
    var lobe = brdf.first;
    var rest = u.x;
    var left = 1.0;
    if rest >= lobe.share {
        rest -= lobe.share;
        left -= lobe.share;
        lobe = brdf.second;
        if rest >= lobe.share {
            rest -= lobe.share;
            left -= lobe.share;
            lobe = brdf.third;
            if rest >= lobe.share {
                rest -= lobe.share;
                left -= lobe.share;
                return cosine_hemisphere(vec2(clamp(rest / left, 0.0, 1.0), u.y));
            }
        }
    }
    let axis = lafortune_axis(lobe, wo);
    if all(axis.xyz == vec3(0.0)) {
        return vec3(0.0);
    }
    return power_lobe(axis.xyz, lobe.exponent, vec2(rest / lobe.share, u.y));
}

// measured.rs. Whoever includes this defines `measured_texel(at: u32) -> vec4<f32>`: the values, then a texel for each cell of θ_h.

const MEASURED_HALVES: u32 = 90u;
const MEASURED_TILTS: u32 = 90u;
const MEASURED_TURNS: u32 = 180u;
const MEASURED_VALUES: u32 = 1458000u;
const TAN_OF_AN_EIGHTH: f32 = 0.41421357;

fn measured_angle(y: f32, x: f32) -> f32 {
    let low = min(y, abs(x));
    let high = max(y, abs(x));
    var ratio = 0.0;
    if high > 0.0 {
        ratio = low / high;
    }
    let is_steep = ratio > TAN_OF_AN_EIGHTH;
    let t = select(ratio, (ratio - 1.0) / (ratio + 1.0), is_steep);
    let z = t * t;
    let series = (((8.053745e-2 * z - 1.3877686e-1) * z + 1.9977711e-1) * z - 3.333295e-1) * z * t + t;
    let within = select(series, BRDF_PI / 4.0 + series, is_steep);
    let quadrant = select(within, BRDF_PI / 2.0 - within, y > abs(x));
    return select(quadrant, BRDF_PI - quadrant, x < 0.0);
}

fn measured_half_cell(h: vec3<f32>) -> u32 {
    let theta = measured_angle(sqrt(h.x * h.x + h.y * h.y), h.z);
    return min(u32(sqrt(theta / (BRDF_PI / 2.0)) * f32(MEASURED_HALVES)), MEASURED_HALVES - 1u);
}

fn measured_index(wo: vec3<f32>, wi: vec3<f32>) -> u32 {
    let half = half_vector(wo, wi);
    let h = half.h;
    let theta_d = measured_angle(0.5 * length(wi - wo), half.along);
    let radius = sqrt(h.x * h.x + h.y * h.y);
    var azimuth = vec2(1.0, 0.0);
    if radius > 0.0 {
        azimuth = h.xy / radius;
    }
    let x = (azimuth.x * wi.x + azimuth.y * wi.y) * h.z - wi.z * radius;
    let y = azimuth.x * wi.y - azimuth.y * wi.x;
    let turn = measured_angle(abs(y), select(x, -x, y < 0.0));
    let tilt_cell = min(u32(theta_d / (BRDF_PI / 2.0) * f32(MEASURED_TILTS)), MEASURED_TILTS - 1u);
    let turn_cell = min(u32(turn / BRDF_PI * f32(MEASURED_TURNS)), MEASURED_TURNS - 1u);
    return (measured_half_cell(h) * MEASURED_TILTS + tilt_cell) * MEASURED_TURNS + turn_cell;
}

fn measured_eval(wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    return measured_texel(measured_index(wo, wi)).rgb;
}

fn measured_half_pdf(h: vec3<f32>) -> f32 {
    let cell = measured_texel(MEASURED_VALUES + measured_half_cell(h));
    return (cell.y - cell.x) / (BRDF_TAU * (cell.w - cell.z));
}

fn measured_sample_half(u: vec2<f32>) -> vec3<f32> {
    // The first cell that the probabilities up to it pass u.x in; 90 cells take 7 halvings.
    var first = 0u;
    var last = MEASURED_HALVES - 1u;
    for (var halving = 0u; halving < 7u; halving++) {
        if first < last {
            let middle = (first + last) / 2u;
            if measured_texel(MEASURED_VALUES + middle).y <= u.x {
                first = middle + 1u;
            } else {
                last = middle;
            }
        }
    }
    let cell = measured_texel(MEASURED_VALUES + first);
    let within = clamp((u.x - cell.x) / (cell.y - cell.x), 0.0, 1.0);
    let off = cell.z + within * (cell.w - cell.z);
    let radius = sqrt(max(off * (2.0 - off), 0.0));
    return normalize(vec3(radius * cos(BRDF_TAU * u.y), radius * sin(BRDF_TAU * u.y), 1.0 - off));
}

fn measured_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    let half = half_vector(wo, wi);
    let share = brdf.specular_share;
    return (1.0 - share) * cosine_pdf(wi) + share * measured_half_pdf(half.h) / (4.0 * half.along);
}

// mod.rs

// sr⁻¹ per channel, without the cosine. Directions: unit, tangent space.
fn brdf_eval(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> vec3<f32> {
    if !above_horizon(wo, wi) {
        return vec3(0.0);
    }
    switch BRDF_MODEL {
        case PHONG: { return phong_eval(brdf, wo, wi); }
        case ASHIKHMIN_SHIRLEY: { return ashikhmin_shirley_eval(brdf, wo, wi); }
        case COOK_TORRANCE: { return cook_torrance_eval(brdf, wo, wi); }
        case WARD: { return ward_eval(brdf, wo, wi); }
        case LAFORTUNE: { return lafortune_eval(brdf, wo, wi); }
        case MEASURED: { return measured_eval(wo, wi); }
        default: { return brdf.diffuse * BRDF_INVERSE_PI; }
    }
}

// Per steradian.
fn brdf_pdf(brdf: BrdfUniform, wo: vec3<f32>, wi: vec3<f32>) -> f32 {
    if !above_horizon(wo, wi) {
        return 0.0;
    }
    switch BRDF_MODEL {
        case PHONG: { return phong_pdf(brdf, wo, wi); }
        case ASHIKHMIN_SHIRLEY: { return ashikhmin_shirley_pdf(brdf, wo, wi); }
        case COOK_TORRANCE: { return cook_torrance_pdf(brdf, wo, wi); }
        case WARD: { return ward_pdf(brdf, wo, wi); }
        case LAFORTUNE: { return lafortune_pdf(brdf, wo, wi); }
        case MEASURED: { return measured_pdf(brdf, wo, wi); }
        default: { return cosine_pdf(wi); }
    }
}

// u ∈ [0, 1)².
fn brdf_sample(brdf: BrdfUniform, wo: vec3<f32>, u: vec2<f32>) -> BrdfSample {
    if !(wo.z > HORIZON) {
        return BrdfSample(vec3(0.0), 0.0);
    }
    var wi: vec3<f32>;
    if BRDF_MODEL == COOK_TORRANCE {
        let m = cook_torrance_sample_facet(brdf, wo, u);
        wi = 2.0 * dot(wo, m) * m - wo;
    } else if BRDF_MODEL == LAFORTUNE {
        wi = lafortune_sample(brdf, wo, u);
    } else if BRDF_MODEL == LAMBERT {
        wi = cosine_hemisphere(u);
    } else {
        var share = brdf.specular_share;
        if BRDF_MODEL == ASHIKHMIN_SHIRLEY {
            share = ashikhmin_shirley_share(brdf, wo);
        }
        if u.x >= share {
            wi = cosine_hemisphere(vec2((u.x - share) / (1.0 - share), u.y));
        } else if BRDF_MODEL == PHONG {
            wi = power_lobe(turned_about_normal(wo), brdf.exponent, vec2(u.x / share, u.y));
        } else {
            var h: vec3<f32>;
            if BRDF_MODEL == WARD {
                h = ward_sample_half(brdf, vec2(u.x / share, u.y));
            } else if BRDF_MODEL == MEASURED {
                h = measured_sample_half(vec2(u.x / share, u.y));
            } else {
                h = ashikhmin_shirley_sample_half(brdf, vec2(u.x / share, u.y));
            }
            wi = 2.0 * dot(wo, h) * h - wo;
        }
    }
    return BrdfSample(wi, brdf_pdf(brdf, wo, wi));
}
