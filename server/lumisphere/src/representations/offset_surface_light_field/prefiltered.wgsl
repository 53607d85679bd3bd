// Twin of prefiltered.rs: the same functions by the same names. Part of kernel.wgsl.

// Sides of the highlight about `wi`, in tangent space: as AnalyticBrdf::highlight_about.
struct Highlight {
    wi: vec3<f32>,
    across: vec3<f32>,
    down: vec3<f32>,
}

fn highlight_about(wo: vec3<f32>) -> Highlight {
    let sides = gloss.highlight;
    let mirrored = turned_about_normal(wo);
    if BRDF_MODEL == PHONG {
        let frame = frame_around(mirrored);
        return Highlight(mirrored, sides.x * frame.tangent, sides.y * frame.bitangent);
    }
    return Highlight(mirrored, sides.x * vec3(wo.z, 0.0, wo.x), sides.y * vec3(0.0, wo.z, wo.y));
}

fn over_highlight(frame: TangentFrame, highlight: Highlight, normal: vec3<f32>, pixel: DirectionDifferential) -> DirectionDifferential {
    let direction = world_from_local(frame, highlight.wi);
    let plane = frame_around(direction);
    var sides = array(world_from_local(frame, highlight.across), world_from_local(frame, highlight.down), pixel.across, pixel.down);
    var xx = 0.0;
    var xy = 0.0;
    var yy = 0.0;
    for (var k = 0u; k < 4u; k++) {
        let x = dot(sides[k], plane.tangent);
        let y = dot(sides[k], plane.bitangent);
        xx += x * x;
        xy += x * y;
        yy += y * y;
    }
    let middle = 0.5 * (xx + yy);
    let half = 0.5 * (xx - yy);
    let root = sqrt(half * half + xy * xy);
    var along = select(vec2(xy, root - half), vec2(half + root, xy), half >= 0.0);
    let size = length(along);
    along = select(vec2(1.0, 0.0), along / size, size > 0.0);
    let long = sqrt(middle + root);
    let short = sqrt(max(middle - root, 0.0));
    let cosine = dot(normal, direction);
    let across = long * (along.x * plane.tangent + along.y * plane.bitangent);
    let down = short * (along.x * plane.bitangent - along.y * plane.tangent);
    return DirectionDifferential(direction, short_of_the_horizon(across, cosine), short_of_the_horizon(down, cosine));
}
