// Twin of tangent_frame.rs: the same functions by the same names, those that make a frame prefixed.

struct TangentFrame {
    tangent: vec3<f32>,
    bitangent: vec3<f32>,
    normal: vec3<f32>,
}

fn frame_around(normal: vec3<f32>) -> TangentFrame {
    let side = select(1.0, -1.0, normal.z < 0.0);
    let a = -1.0 / (side + normal.z);
    let b = normal.x * normal.y * a;
    let tangent = vec3(1.0 + side * normal.x * normal.x * a, side * b, -side * normal.x);
    return TangentFrame(tangent, vec3(b, side + normal.y * normal.y * a, -normal.y), normal);
}

fn frame_along(normal: vec3<f32>, tangent: vec3<f32>) -> TangentFrame {
    let across = tangent - normal * dot(normal, tangent);
    let size = length(across);
    if !(size > 0.0) {
        return frame_around(normal);
    }
    let unit = across / size;
    return TangentFrame(unit, cross(normal, unit), normal);
}

fn world_from_local(frame: TangentFrame, local: vec3<f32>) -> vec3<f32> {
    return local.x * frame.tangent + local.y * frame.bitangent + local.z * frame.normal;
}

fn local_from_world(frame: TangentFrame, world: vec3<f32>) -> vec3<f32> {
    return vec3(dot(world, frame.tangent), dot(world, frame.bitangent), dot(world, frame.normal));
}
