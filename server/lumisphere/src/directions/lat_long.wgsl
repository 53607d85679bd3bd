// Twin of lat_long.rs. WGSL leaves the accuracy of its atan2 and acos to the device (4096 ULP), so the arc tangent is our own:
// reduction and polynomial of Cephes' atanf (S. L. Moshier), 2 ULP.

const PI: f32 = 3.14159265358979;

fn arc_tangent_2(y: f32, x: f32) -> f32 {
    let low = min(abs(x), abs(y));
    let high = max(abs(x), abs(y));
    let t = select(0.0, low / high, high > 0.0);
    // Beyond tan 22.5° measured from 45°.
    let upper = t > 0.41421356;
    let r = select(t, (t - 1.0) / (t + 1.0), upper);
    let z = r * r;
    let polynomial = (((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1) * z * r + r;
    let octant = select(0.0, 0.25 * PI, upper) + polynomial;
    let quadrant = select(octant, 0.5 * PI - octant, abs(y) > abs(x));
    let half = select(quadrant, PI - quadrant, x < 0.0);
    return select(half, -half, y < 0.0);
}

// Image position in [0, 1]², v down, of a direction of any length above zero.
fn lat_long_from_direction(d: vec3<f32>) -> vec2<f32> {
    let turn = arc_tangent_2(d.x, -d.z) / (2.0 * PI);
    return vec2(turn - floor(turn), arc_tangent_2(length(d.xz), d.y) / PI);
}
