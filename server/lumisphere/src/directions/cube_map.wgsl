// Twin of cube_map.rs: the same functions by the same names, the same arithmetic in the same order.

struct FacePosition {
    face: u32,
    st: vec2<f32>,
}

// One texel of a cube map; `exists` is false beyond a cube's corner.
struct CubeTexel {
    face: u32,
    column: u32,
    row: u32,
    exists: bool,
}

fn direction_from_face(face: u32, s: f32, t: f32) -> vec3<f32> {
    switch face {
        case 0u: { return vec3(1.0, -t, -s); }
        case 1u: { return vec3(-1.0, -t, s); }
        case 2u: { return vec3(s, 1.0, t); }
        case 3u: { return vec3(s, -1.0, -t); }
        case 4u: { return vec3(s, -t, 1.0); }
        default: { return vec3(-s, -t, -1.0); }
    }
}

// Written without branches: each lane pays for every branch on a processor that runs lanes together.
fn face_from_direction(d: vec3<f32>) -> FacePosition {
    let a = abs(d);
    let is_x = a.x >= a.y && a.x >= a.z;
    let is_y = !is_x && a.y >= a.z;
    let major = select(select(d.z, d.y, is_y), d.x, is_x);
    let axis = select(select(4u, 2u, is_y), 0u, is_x);
    let positive = major > 0.0;
    let s_x = select(d.z, -d.z, positive);
    let s_z = select(-d.x, d.x, positive);
    let s = select(select(s_z, d.x, is_y), s_x, is_x);
    let t_y = select(-d.z, d.z, positive);
    let t = select(-d.y, t_y, is_y);
    return FacePosition(axis + select(1u, 0u, positive), vec2(s, t) / abs(major));
}

fn across(v: i32, n: i32) -> f32 {
    let inside = (2.0 * f32(v) + 1.0) / f32(n) - 1.0;
    return select(select(inside, 1.0001, v >= n), -1.0001, v < 0);
}

fn nearest_texel(c: f32, n: i32) -> u32 {
    return u32(clamp(i32((c + 1.0) * 0.5 * f32(n)), 0, n - 1));
}

fn neighbour(face: u32, x: i32, y: i32, n: i32) -> CubeTexel {
    let inside_x = x >= 0 && x < n;
    let inside_y = y >= 0 && y < n;
    let beyond = face_from_direction(direction_from_face(face, across(x, n), across(y, n)));
    let inside = inside_x && inside_y;
    let column = select(nearest_texel(beyond.st.x, n), u32(clamp(x, 0, n - 1)), inside);
    let row = select(nearest_texel(beyond.st.y, n), u32(clamp(y, 0, n - 1)), inside);
    return CubeTexel(select(beyond.face, face, inside), column, row, inside_x || inside_y);
}
