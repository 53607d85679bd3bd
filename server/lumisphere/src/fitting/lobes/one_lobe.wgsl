// Twin of solve.rs, with what it calls (`point.rs`, `normal.rs`, `dense.rs`), and of `scan.rs` beside no lobe: starts and fits of one lobe,
// `constant + amplitude · max(axis · d, 0)^m`, with weights of each channel's own. One invocation a texel or a start; the three channels lie side
// by side in a vec3.
//
// Logarithm and power are `lanes.rs`': what Vulkan promises of its own (an absolute 2⁻²¹ near 1) is not enough for exponents of hundreds.

struct Terms {
    // Of the prior: mean of ln m, deviation⁻² of it and of an amplitude; zeros without.
    log_exponent: f32,
    shape_pull: f32,
    amplitude_pull: f32,
    tolerance: f32,
    iterations: u32,
    count: u32,
    peaks: u32,
    padding: u32,
}

struct Start {
    axis: vec3<f32>,
    log_exponent: f32,
    constant: vec3<f32>,
    // Numbers that weigh anything.
    observed: f32,
    amplitude: vec3<f32>,
    // Least variance of a number.
    least_variance: f32,
    // Place of the first sample's first number, and how many samples there are.
    first: u32,
    samples: u32,
    padding_0: u32,
    padding_1: u32,
}

struct Fitted {
    axis: vec3<f32>,
    log_exponent: f32,
    constant: vec3<f32>,
    cost: f32,
    amplitude: vec3<f32>,
    initial_cost: f32,
    carried: f32,
    log_exponent_variance: f32,
    iterations: u32,
    converged: u32,
}

// Peaks, and behind them the centroid of the first; what a lobe towards each would gain, for each exponent.
struct Look {
    places: array<vec4<f32>, 4>,
    gains: array<array<f32, 5>, 4>,
}

@group(0) @binding(0) var<storage, read> terms: Terms;
// `Sample`s: 16 texels side by side, nine rows each (direction, value, root of the weight).
@group(0) @binding(1) var<storage, read> numbers: array<f32>;
@group(0) @binding(2) var<storage, read> starts: array<Start>;
@group(0) @binding(3) var<storage, read_write> fits: array<Fitted>;
@group(0) @binding(4) var<storage, read_write> looks: array<Look>;

const LANES = 16u;
const SAMPLE = 9u * LANES;
const LEAST_COSINE = 1e-6;
const LEAST_PIVOT = 30.0 * 1.1920929e-7;
const LEAST_NORMAL = 1.2e-38;
const ROUNDING = 4.107e-14; // (1.7 · 2⁻²³)²
const MOST_LOG_EXPONENT = 6.9077554; // ln 1000
const LONGEST_TURN = 0.35;
const LONGEST_SHARPENING = 1.5;
const FIRST_DAMPING = 1e-3;
const DAMPING_THAT_FAILED = 6.0;
const DAMPING_THAT_SERVED = 0.2;
const LEAST_DAMPING = 1e-7;
const MOST_DAMPING = 1e7;
// Exponents tried at a peak, and the cosine of the least angle between two.
const EXPONENTS = 5;
const APART = 0.94;

// Of a positive normal number (Cephes `logf`).
fn natural_log(value: f32) -> f32 {
    let shifted = bitcast<u32>(value) + (0x3f800000u - 0x3f3504f3u);
    let exponent = f32(i32(shifted >> 23u) - 127);
    let x = bitcast<f32>((shifted & 0x007fffffu) + 0x3f3504f3u) - 1.0;
    var p = 7.0376836e-2;
    p = p * x - 1.151461e-1;
    p = p * x + 1.1676999e-1;
    p = p * x - 1.2420141e-1;
    p = p * x + 1.4249323e-1;
    p = p * x - 1.6668058e-1;
    p = p * x + 2.0000715e-1;
    p = p * x - 2.4999994e-1;
    p = p * x + 3.333333e-1;
    let square = x * x;
    let tail = square * -0.5 + ((p * x) * square + exponent * -2.1219444e-4);
    return exponent * 0.693359375 + (x + tail);
}

// e to that power; below −40 as at −40 (Cephes `exp2f`).
fn exponential(value: f32) -> f32 {
    let x = clamp(value, -40.0, 80.0) * 1.442695;
    let whole = round(x);
    let f = x - whole;
    var p = 1.5353362e-4;
    p = p * f + 1.3398874e-3;
    p = p * f + 9.618437e-3;
    p = p * f + 5.5503325e-2;
    p = p * f + 2.4022648e-1;
    p = p * f + 6.931472e-1;
    p = p * f + 1.0;
    return bitcast<f32>(bitcast<u32>(p) + (bitcast<u32>(i32(whole)) << 23u));
}

// Direction, value or root of the weight of the sample whose first number is there.
fn row(at: u32, which: u32) -> vec3<f32> {
    let first = at + 3u * which * LANES;
    return vec3(numbers[first], numbers[first + LANES], numbers[first + 2u * LANES]);
}

// Made unit; +Z where there is nothing to make it of.
fn unit(v: vec3<f32>) -> vec3<f32> {
    let square = dot(v, v);
    if !(square > 1e-12) {
        return vec3(0.0, 0.0, 1.0);
    }
    return v / sqrt(square);
}

// 1/√pivot, 0 for a column that depends on those before it.
fn inverse_root(pivot: f32, diagonal: f32) -> f32 {
    let sound = max(diagonal, LEAST_NORMAL) * LEAST_PIVOT < pivot;
    return select(0.0, 1.0 / sqrt(select(1.0, pivot, sound)), sound);
}

fn inverse_roots(pivot: vec3<f32>, diagonal: vec3<f32>) -> vec3<f32> {
    let sound = max(diagonal, vec3(LEAST_NORMAL)) * LEAST_PIVOT < pivot;
    return select(vec3(0.0), 1.0 / sqrt(select(vec3(1.0), pivot, sound)), sound);
}

// Constant and amplitude of each channel.
struct Pair {
    constant: vec3<f32>,
    lobe: vec3<f32>,
}

// A symmetric matrix over them.
struct Gram {
    constant: vec3<f32>,
    across: vec3<f32>,
    lobe: vec3<f32>,
}

// `x` of `gram · x = right`, by Cholesky.
fn solved_pair(gram: Gram, right: Pair) -> Pair {
    let first = inverse_roots(gram.constant, gram.constant);
    let below = gram.across * first;
    let second = inverse_roots(gram.lobe - below * below, gram.lobe);
    var x: Pair;
    x.constant = right.constant * first;
    x.lobe = (right.lobe - below * x.constant) * second;
    x.lobe = x.lobe * second;
    x.constant = (x.constant - below * x.lobe) * first;
    return x;
}

// By how much a change lowers the sum of squares: 2 δᵀh − δᵀGδ.
fn gain_of(gram: Gram, slope: Pair, change: Pair) -> vec3<f32> {
    let constant = 2.0 * slope.constant - gram.constant * change.constant - gram.across * change.lobe;
    let lobe = 2.0 * slope.lobe - gram.across * change.constant - gram.lobe * change.lobe;
    return constant * change.constant + lobe * change.lobe;
}

struct Bounded {
    change: Pair,
    constant_is_free: vec3<bool>,
    lobe_is_free: vec3<bool>,
    gain: vec3<f32>,
}

// Least squares over unknowns that are not negative, from `old`: the best of the four subsets that may be free.
fn non_negative(gram: Gram, slope: Pair, old: Pair) -> Bounded {
    let yes = vec3<bool>(true);
    let both = solved_pair(gram, slope);
    var best = Bounded(both, yes, yes, gain_of(gram, slope, both));
    let is_feasible = !(old.constant + both.constant < vec3(0.0)) & !(old.lobe + both.lobe < vec3(0.0));
    if all(is_feasible) {
        return best;
    }
    best.gain = select(vec3(-1e30), best.gain, is_feasible);

    let neither = Pair(-old.constant, -old.lobe);
    best = better_of(best, Bounded(neither, !yes, !yes, gain_of(gram, slope, neither)), !is_feasible);

    let of_constant = inverse_roots(gram.constant, gram.constant);
    let constant = (slope.constant + gram.across * old.lobe) * of_constant * of_constant;
    let constant_alone = Pair(constant, -old.lobe);
    let constant_fits = !is_feasible & !(old.constant + constant < vec3(0.0));
    best = better_of(best, Bounded(constant_alone, yes, !yes, gain_of(gram, slope, constant_alone)), constant_fits);

    let of_lobe = inverse_roots(gram.lobe, gram.lobe);
    let lobe = (slope.lobe + gram.across * old.constant) * of_lobe * of_lobe;
    let lobe_alone = Pair(-old.constant, lobe);
    let lobe_fits = !is_feasible & !(old.lobe + lobe < vec3(0.0));
    return better_of(best, Bounded(lobe_alone, !yes, yes, gain_of(gram, slope, lobe_alone)), lobe_fits);
}

fn better_of(a: Bounded, b: Bounded, b_may_be: vec3<bool>) -> Bounded {
    let better = b_may_be & (a.gain < b.gain);
    let change = Pair(select(a.change.constant, b.change.constant, better), select(a.change.lobe, b.change.lobe, better));
    let constant_is_free = (b.constant_is_free & better) | (a.constant_is_free & !better);
    let lobe_is_free = (b.lobe_is_free & better) | (a.lobe_is_free & !better);
    return Bounded(change, constant_is_free, lobe_is_free, select(a.gain, b.gain, better));
}

// A shape with everything that follows from it. Symmetric matrices over two tangent steps of the axis and ln m: diagonal, and (10, 20, 21).
struct Point {
    axis: vec3<f32>,
    log_exponent: f32,
    along: vec3<f32>,
    up: vec3<f32>,
    constant: vec3<f32>,
    amplitude: vec3<f32>,
    cost: f32,
    carried: f32,
    diagonal: vec3<f32>,
    off_diagonal: vec3<f32>,
    slope: vec3<f32>,
}

// One shape with the best linear unknowns, of which those given are a guess; `ridge` times the square of each amplitude is added to what they
// minimise.
fn evaluate(start: u32, axis: vec3<f32>, log_exponent: f32, linear: Pair, ridge: f32) -> Point {
    var here: Point;
    here.axis = axis;
    here.log_exponent = log_exponent;
    let radius = sqrt(axis.x * axis.x + axis.y * axis.y);
    var turn = vec2(1.0, 0.0);
    if radius > 1e-5 {
        turn = axis.xy / radius;
    }
    here.along = vec3(-turn.y, turn.x, 0.0);
    here.up = vec3(-axis.z * turn.x, -axis.z * turn.y, radius);

    // AᵀWA, AᵀWD, DᵀWD, AᵀWr, DᵀWr and rᵀWr of each channel; D's columns: along, up, ln m.
    var gram = Gram(vec3(0.0), vec3(0.0), vec3(0.0));
    var constant_d = array<vec3<f32>, 3>();
    var lobe_d = array<vec3<f32>, 3>();
    var d_d = array<vec3<f32>, 3>();
    var d_d_below = array<vec3<f32>, 3>();
    var slope = Pair(vec3(0.0), vec3(0.0));
    var d_r = array<vec3<f32>, 3>();
    var squares = vec3(0.0);
    let m = exponential(log_exponent);
    let samples = starts[start].samples;
    var at = starts[start].first;
    for (var i = 0u; i < samples; i++) {
        let d = row(at, 0u);
        let value = row(at, 1u);
        let root = row(at, 2u);
        at += SAMPLE;
        let cosine = dot(axis, d);
        let safe = max(cosine, LEAST_COSINE);
        let log = natural_log(safe);
        // cᵐ⁻¹ serves the lobe and its derivative by the axis.
        let power = select(0.0, exponential((m - 1.0) * log), cosine > 0.0);
        let lobe = power * safe;
        let by = vec3(power * m * dot(here.along, d), power * m * dot(here.up, d), lobe * m * log);
        let r = value - linear.constant - linear.lobe * lobe;
        let w = root * root;
        let w_lobe = w * lobe;
        let w_r = w * r;
        gram.constant += w;
        gram.across += w_lobe;
        gram.lobe += w_lobe * lobe;
        for (var k = 0; k < 3; k++) {
            constant_d[k] += w * by[k];
            lobe_d[k] += w_lobe * by[k];
            d_d[k] += w * (by[k] * by[k]);
            d_r[k] += w_r * by[k];
        }
        d_d_below[0] += w * (by.y * by.x);
        d_d_below[1] += w * (by.z * by.x);
        d_d_below[2] += w * (by.z * by.y);
        slope.constant += w_r;
        slope.lobe += w_r * lobe;
        squares += w_r * r;
    }

    here.carried = max(gram.lobe.x, max(gram.lobe.y, gram.lobe.z));
    gram.lobe += ridge;
    slope.lobe -= ridge * linear.lobe;
    let solved = non_negative(gram, slope, linear);
    // The gain counts the prior's part: its square at the end less its square before.
    let of_prior = ridge * solved.change.lobe * (solved.change.lobe + 2.0 * linear.lobe);
    here.cost = max(dot(squares - solved.gain - of_prior, vec3(1.0)), 0.0);
    here.constant = max(linear.constant + solved.change.constant, vec3(0.0));
    here.amplitude = max(linear.lobe + solved.change.lobe, vec3(0.0));

    // Kaufman's Jacobian: derivatives without what the unknowns that are free make up for.
    let both = solved.constant_is_free & solved.lobe_is_free;
    var held: Gram;
    held.constant = select(vec3(1.0), gram.constant, solved.constant_is_free);
    held.across = select(vec3(0.0), gram.across, both);
    held.lobe = select(vec3(1.0), gram.lobe, solved.lobe_is_free);
    var projected: array<Pair, 3>;
    for (var k = 0; k < 3; k++) {
        let column = Pair(
            select(vec3(0.0), constant_d[k], solved.constant_is_free),
            select(vec3(0.0), lobe_d[k], solved.lobe_is_free),
        );
        let x = solved_pair(held, column);
        projected[k].constant = select(vec3(0.0), x.constant, solved.constant_is_free);
        projected[k].lobe = select(vec3(0.0), x.lobe, solved.lobe_is_free);
        let left = d_r[k] - constant_d[k] * solved.change.constant - lobe_d[k] * solved.change.lobe;
        here.slope[k] = dot(here.amplitude, left);
    }
    let weight = here.amplitude * here.amplitude;
    for (var k = 0; k < 3; k++) {
        here.diagonal[k] = dot(weight, d_d[k] - constant_d[k] * projected[k].constant - lobe_d[k] * projected[k].lobe);
    }
    let along_up = d_d_below[0] - constant_d[1] * projected[0].constant - lobe_d[1] * projected[0].lobe;
    let along_m = d_d_below[1] - constant_d[2] * projected[0].constant - lobe_d[2] * projected[0].lobe;
    let up_m = d_d_below[2] - constant_d[2] * projected[1].constant - lobe_d[2] * projected[1].lobe;
    here.off_diagonal = vec3(dot(weight, along_up), dot(weight, along_m), dot(weight, up_m));
    return here;
}

// L of L Lᵀ, the diagonal held as its reciprocal; below it (10, 20, 21).
struct Factor {
    diagonal: vec3<f32>,
    below: vec3<f32>,
}

fn factored(diagonal: vec3<f32>, below: vec3<f32>) -> Factor {
    var l: Factor;
    l.diagonal.x = inverse_root(diagonal.x, diagonal.x);
    l.below.x = below.x * l.diagonal.x;
    l.below.y = below.y * l.diagonal.x;
    l.diagonal.y = inverse_root(diagonal.y - l.below.x * l.below.x, diagonal.y);
    l.below.z = (below.z - l.below.y * l.below.x) * l.diagonal.y;
    l.diagonal.z = inverse_root(diagonal.z - l.below.y * l.below.y - l.below.z * l.below.z, diagonal.z);
    return l;
}

fn solved_triple(l: Factor, right: vec3<f32>) -> vec3<f32> {
    var x = right;
    x.x = x.x * l.diagonal.x;
    x.y = (x.y - l.below.x * x.x) * l.diagonal.y;
    x.z = (x.z - l.below.y * x.x - l.below.z * x.y) * l.diagonal.z;
    x.z = x.z * l.diagonal.z;
    x.y = (x.y - l.below.z * x.z) * l.diagonal.y;
    x.x = (x.x - l.below.x * x.y - l.below.y * x.z) * l.diagonal.x;
    return x;
}

// The prior for residuals of that variance.
fn pull_of(variance: f32) -> vec2<f32> {
    return variance * vec2(terms.shape_pull, terms.amplitude_pull);
}

fn objective_of(here: Point, pull: vec2<f32>) -> f32 {
    let off = here.log_exponent - terms.log_exponent;
    return here.cost + pull.x * off * off + pull.y * dot(here.amplitude, here.amplitude);
}

// A damped Gauss–Newton step within its caps, and by how much it is expected to lower the objective.
struct Step {
    by: vec3<f32>,
    predicted: f32,
}

fn step_from(here: Point, pull: vec2<f32>, damping: f32) -> Step {
    var g = here.slope;
    var h = here.diagonal;
    var below = here.off_diagonal;
    g.z += pull.x * (terms.log_exponent - here.log_exponent);
    h.z += pull.x;
    // A bound that the slope pushes against holds its unknown.
    let low = here.log_exponent < 1e-6 && g.z < 0.0;
    let high = !(here.log_exponent < MOST_LOG_EXPONENT - 1e-6) && g.z > 0.0;
    if low || high {
        g.z = 0.0;
        h.z = 1.0;
        below = vec3(below.x, 0.0, 0.0);
    }
    if here.axis.z < 1e-6 && g.y < 0.0 {
        g.y = 0.0;
        h.y = 1.0;
        below = vec3(0.0, below.y, 0.0);
    }
    var by = solved_triple(factored(h + damping * h + 1e-20, below), g);
    let turn = length(by.xy);
    by = vec3(by.xy * (LONGEST_TURN / max(turn, LONGEST_TURN)), clamp(by.z, -LONGEST_SHARPENING, LONGEST_SHARPENING));
    let curved = vec3(
        h.x * by.x + below.x * by.y + below.y * by.z,
        below.x * by.x + h.y * by.y + below.z * by.z,
        below.y * by.x + below.z * by.y + h.z * by.z,
    );
    return Step(by, dot(2.0 * g - curved, by));
}

// Everything of the start, nothing fitted: a texel without samples.
fn nothing_fitted(start: Start) -> Fitted {
    return Fitted(start.axis, start.log_exponent, start.constant, 0.0, start.amplitude, 0.0, 0.0, 0.0, 0u, 0u);
}

@compute @workgroup_size(64)
fn fit_one_lobe(@builtin(global_invocation_id) invocation: vec3<u32>) {
    let which = invocation.x;
    if which >= terms.count {
        return;
    }
    let start = starts[which];
    if !(start.observed > 0.0) {
        fits[which] = nothing_fitted(start);
        return;
    }
    let freedom = max(start.observed - 9.0, 1.0);
    let rounding = start.observed * ROUNDING;
    let least_variance = start.least_variance;
    let guess = Pair(start.constant, start.amplitude);
    var here = evaluate(which, unit(start.axis), start.log_exponent, guess, pull_of(least_variance).y);
    let initial_cost = here.cost;
    var damping = FIRST_DAMPING;
    var iterations = 0u;
    var converged = 0u;
    for (var i = 0u; i < terms.iterations; i++) {
        let pull = pull_of(max(here.cost / freedom, least_variance));
        let objective = objective_of(here, pull);
        let moved = step_from(here, pull, damping);
        if !(objective * terms.tolerance < moved.predicted) || here.cost < rounding {
            converged = 1u;
            break;
        }
        var axis = here.axis + moved.by.x * here.along + moved.by.y * here.up;
        axis.z = max(axis.z, 0.0);
        let log_exponent = clamp(here.log_exponent + moved.by.z, 0.0, MOST_LOG_EXPONENT);
        let trial = evaluate(which, unit(axis), log_exponent, Pair(here.constant, here.amplitude), pull.y);
        let reached = objective_of(trial, pull);
        iterations += 1u;
        if reached < objective {
            here = trial;
            damping = damping * DAMPING_THAT_SERVED;
        } else {
            damping = damping * DAMPING_THAT_FAILED;
        }
        damping = max(damping, LEAST_DAMPING);
        // Rounding decides once the objective moves by no more than a few of its last digits.
        if abs(objective - reached) < objective * terms.tolerance || damping > MOST_DAMPING {
            converged = 1u;
            break;
        }
    }
    let variance = solved_triple(factored(here.diagonal, here.off_diagonal), vec3(0.0, 0.0, 1.0)).z;
    // Of a pivot that is nearly nothing it may be infinite, which says no more than this.
    let known_variance = select(1e30, min(variance, 1e30), variance > 0.0);
    fits[which] = Fitted(
        here.axis, here.log_exponent, here.constant, here.cost, here.amplitude, initial_cost, here.carried, known_variance, iterations, converged,
    );
}

// A sample beside the constant: weighted residual, its sum over the channels in units of the noise, mean weight.
struct Left {
    residual: vec3<f32>,
    height: f32,
    weight: f32,
}

fn left_of(at: u32, constant: vec3<f32>) -> Left {
    let root = row(at, 2u);
    let r = row(at, 1u) - constant;
    let w = root * root;
    return Left(r * w, dot(root, r), (w.x + w.y + w.z) / 3.0);
}

// The direction with the largest residual, away from the first `found` of `places`.
fn highest(start: Start, places: ptr<function, array<vec3<f32>, 4>>, found: u32) -> vec3<f32> {
    var most = -1e30;
    var peak = vec3(0.0, 0.0, 1.0);
    for (var i = 0u; i < start.samples; i++) {
        let at = start.first + i * SAMPLE;
        let here = left_of(at, start.constant);
        let d = row(at, 0u);
        var is_higher = most < here.height && here.weight > 0.0;
        for (var k = 0u; k < found; k++) {
            is_higher = is_higher && dot((*places)[k], d) < APART;
        }
        if is_higher {
            most = here.height;
            peak = d;
        }
    }
    return peak;
}

// The middle of the residuals around a peak.
fn centroid(start: Start, peak: vec3<f32>) -> vec3<f32> {
    var sum = peak * 1e-6;
    for (var i = 0u; i < start.samples; i++) {
        let at = start.first + i * SAMPLE;
        let d = row(at, 0u);
        if dot(peak, d) > APART {
            let height = max(left_of(at, start.constant).height, 0.0);
            sum += height * height * d;
        }
    }
    return unit(sum);
}

// What a lobe towards `place` would gain beside the constant, whose own element and slope are given.
fn gains(start: Start, place: vec3<f32>, constant_weight: f32, constant_slope: vec3<f32>) -> array<f32, 5> {
    var own = array<f32, 5>();
    var across = array<f32, 5>();
    var product = array<vec3<f32>, 5>();
    for (var i = 0u; i < start.samples; i++) {
        let at = start.first + i * SAMPLE;
        let here = left_of(at, start.constant);
        let cosine = max(dot(place, row(at, 0u)), 0.0);
        // c², c⁸, c³² …
        var power = cosine * cosine;
        for (var k = 0; k < EXPONENTS; k++) {
            own[k] += power * power * here.weight;
            across[k] += power * here.weight;
            product[k] += power * here.residual;
            let square = power * power;
            power = square * square;
            // Powers of small cosines leave the normal numbers.
            power = select(0.0, power, power > 1e-16);
        }
    }
    let inverse = inverse_root(constant_weight, constant_weight);
    var gain = array<f32, 5>();
    for (var k = 0; k < EXPONENTS; k++) {
        let known = across[k] * inverse * inverse;
        let left = own[k] - known * across[k];
        if own[k] * 1e-4 < left && left > 1e-20 {
            let height = max(product[k] - known * constant_slope, vec3(0.0));
            gain[k] = dot(height, height) / left;
        }
    }
    return gain;
}

@compute @workgroup_size(64)
fn look_for_one_lobe(@builtin(global_invocation_id) invocation: vec3<u32>) {
    let which = invocation.x;
    if which >= terms.count {
        return;
    }
    let start = starts[which];
    var constant_weight = 0.0;
    var constant_slope = vec3(0.0);
    for (var i = 0u; i < start.samples; i++) {
        let here = left_of(start.first + i * SAMPLE, start.constant);
        constant_weight += here.weight;
        constant_slope += here.residual;
    }
    var places = array<vec3<f32>, 4>();
    for (var p = 0u; p <= terms.peaks; p++) {
        if p < terms.peaks {
            places[p] = highest(start, &places, p);
        } else {
            places[p] = centroid(start, places[0]);
        }
        looks[which].places[p] = vec4(places[p], 0.0);
        looks[which].gains[p] = gains(start, places[p], constant_weight, constant_slope);
    }
}
