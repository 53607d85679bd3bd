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
const MOST_UNITS: f32 = 65536.0;
const MOST_TAPS: f32 = 4.0;

fn moved(by: vec3<f32>, d: vec3<f32>, along: vec3<f32>, a: f32) -> vec3<f32> {
    return (by - d * (dot(by, along) / a)) / a;
}

struct Taps {
    count: u32,
    step: vec3<f32>,
    texels: f32,
}

fn taps_over(toward: DirectionDifferential, size: u32) -> Taps {
    let d = toward.direction;
    let m = abs(d);
    let is_x = m.x >= m.y && m.x >= m.z;
    let is_y = !is_x && m.y >= m.z;
    let along = select(select(vec3(0.0, 0.0, 1.0), vec3(0.0, 1.0, 0.0), is_y), vec3(1.0, 0.0, 0.0), is_x);
    let a = dot(d, along);
    let across = moved(toward.across, d, along, a);
    let down = moved(toward.down, d, along, a);
    let wide = dot(across, across);
    let high = dot(down, down);
    let longer = sqrt(max(wide, high));
    if !(wide + high < MOST_UNITS) {
        return Taps(1u, vec3(0.0), MOST_TEXELS);
    }
    let texels = longer * (0.5 * f32(size));
    if texels <= 1.0 {
        return Taps(1u, vec3(0.0), texels);
    }
    let shorter = max(length(cross(across, down)) / longer * (0.5 * f32(size)), 1.0);
    let count = min(floor(texels / shorter + 0.5), MOST_TAPS);
    let step = select(toward.down, toward.across, wide > high) / count;
    // Compilers may assume that there is no NaN; a loop over it must end all the same.
    return Taps(clamp(u32(count), 1u, u32(MOST_TAPS)), step, texels / count);
}

fn tap_direction(taps: Taps, center: vec3<f32>, tap: u32) -> vec3<f32> {
    return center + (f32(tap) - 0.5 * f32(taps.count - 1u)) * taps.step;
}

fn level_for_texels(texels: f32, coarsest: u32) -> PyramidLevel {
    let bits = bitcast<u32>(max(texels, 1.0));
    let fine = (bits >> 23u) - 127u;
    let fraction = bitcast<f32>((bits & 0x007fffffu) | 0x3f800000u) - 1.0;
    let last = fine >= coarsest;
    return PyramidLevel(select(fine, coarsest, last), select(fraction, 0.0, last));
}
