// Twin of differential.rs: the same functions by the same names.

struct DirectionDifferential {
    direction: vec3<f32>,
    across: vec3<f32>,
    down: vec3<f32>,
}

struct PyramidLevel {
    fine: u32,
    fraction: f32,
}

const MOST_TEXELS: f32 = 65536.0;

fn single(direction: vec3<f32>) -> DirectionDifferential {
    return DirectionDifferential(direction, vec3(0.0), vec3(0.0));
}

fn moved(by: vec3<f32>, d: vec3<f32>, along: vec3<f32>, a: f32) -> f32 {
    let step = (by - d * (dot(by, along) / a)) / a;
    return dot(step, step);
}

fn texels_per_pixel(toward: DirectionDifferential, size: u32) -> f32 {
    let d = toward.direction;
    let m = abs(d);
    let is_x = m.x >= m.y && m.x >= m.z;
    let is_y = !is_x && m.y >= m.z;
    let along = select(select(vec3(0.0, 0.0, 1.0), vec3(0.0, 1.0, 0.0), is_y), vec3(1.0, 0.0, 0.0), is_x);
    let a = dot(d, along);
    let across = moved(toward.across, d, along, a);
    let down = moved(toward.down, d, along, a);
    return select(MOST_TEXELS, sqrt(max(across, down)) * (0.5 * f32(size)), across + down < MOST_TEXELS);
}

fn level_for_texels(texels: f32, coarsest: u32) -> PyramidLevel {
    let bits = bitcast<u32>(max(texels, 1.0));
    let fine = (bits >> 23u) - 127u;
    let fraction = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u) - 1.0;
    let last = fine >= coarsest;
    return PyramidLevel(select(fine, coarsest, last), select(fraction, 0.0, last));
}
