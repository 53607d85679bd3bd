//! Rays against the four-wide tree: nearest hit, any hit, and the signed count of all hits.
//!
//! Boxes by slabs (Kay & Kajiya 1986) with the far distance widened by the rounding error (Ize 2013); triangles by Möller &
//! Trumbore 1997 in four lanes. Directions need not be unit vectors: distances are in multiples of their length.

use glam::{Vec3, Vec4};

use super::bvh::{Bvh, LEAF, Node, Packet};

/// What a ray met: distance in multiples of its direction, barycentric weights of the second and third corner, input index.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RawHit {
    pub distance: f32,
    pub u: f32,
    pub v: f32,
    pub triangle: u32,
}

/// Nodes still to visit. One a thread or tile, reused, so that no ray allocates.
#[derive(Debug)]
pub(crate) struct Stack(Vec<(f32, u32)>);

impl Stack {
    pub fn new() -> Self {
        Self(Vec::with_capacity(128))
    }
}

// 1 + 2γ₃ for f32: the slab test then misses no box that the exact ray meets (Ize 2013).
pub(super) const FAR_SLACK: f32 = 1.000_001;

/// A ray with every coordinate copied to four lanes.
struct WideRay {
    origin: [Vec4; 3],
    direction: [Vec4; 3],
    inverse: [Vec4; 3],
    // 1 where the direction is negative: the maximum is then the near plane.
    negative: [usize; 3],
}

/// 1/x, but finite at 0, so that a ray inside a slab's plane gives 0 and not 0 · ∞ = NaN.
#[inline(always)]
pub(super) fn finite_inverse(x: f32) -> f32 {
    const SMALLEST: f32 = 1e-20;
    if x.abs() > SMALLEST { 1.0 / x } else { (1.0 / SMALLEST).copysign(x) }
}

impl WideRay {
    #[inline(always)]
    fn new(origin: Vec3, direction: Vec3) -> Self {
        let lanes = |v: Vec3| [Vec4::splat(v.x), Vec4::splat(v.y), Vec4::splat(v.z)];
        Self {
            origin: lanes(origin),
            direction: lanes(direction),
            inverse: lanes(Vec3::new(finite_inverse(direction.x), finite_inverse(direction.y), finite_inverse(direction.z))),
            negative: [
                direction.x.is_sign_negative() as usize,
                direction.y.is_sign_negative() as usize,
                direction.z.is_sign_negative() as usize,
            ],
        }
    }

    #[inline(always)]
    fn is_finite(&self) -> bool {
        self.origin.iter().chain(&self.direction).all(|v| v.is_finite())
    }

    /// Entry distances of the four boxes and a bit for each that is entered before `limit`.
    #[inline(always)]
    fn boxes(&self, node: &Node, limit: f32) -> (Vec4, u32) {
        let plane = |axis: usize, side: usize| (node.bounds[axis][side & 1] - self.origin[axis]) * self.inverse[axis];
        let [x, y, z] = self.negative;
        let near = plane(0, x).max(plane(1, y).max(plane(2, z).max(Vec4::ZERO)));
        let far = plane(0, 1 - x).min(plane(1, 1 - y).min(plane(2, 1 - z).min(Vec4::splat(limit))));
        (near, near.cmple(far * FAR_SLACK).bitmask())
    }

    /// Distance and barycentric weights in the four triangles, and a bit for each that is hit in (0, limit).
    #[inline(always)]
    fn triangles(&self, packet: &Packet, limit: f32) -> (Vec4, Vec4, Vec4, u32) {
        let ([ux, uy, uz], [vx, vy, vz]) = (packet.edge_u, packet.edge_v);
        let [dx, dy, dz] = self.direction;
        let (cx, cy, cz) = (packet.corner[0] - self.origin[0], packet.corner[1] - self.origin[1], packet.corner[2] - self.origin[2]);
        let (nx, ny, nz) = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx);
        let (rx, ry, rz) = (cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx);
        // An edge-on or empty triangle gives 1/0: u, v or their sum is then infinite or NaN and every comparison fails.
        let inverse = (dx * nx + dy * ny + dz * nz).recip();
        let u = (vx * rx + vy * ry + vz * rz) * inverse;
        let v = -(ux * rx + uy * ry + uz * rz) * inverse;
        let t = (cx * nx + cy * ny + cz * nz) * inverse;
        let inside = u.cmpge(Vec4::ZERO) & v.cmpge(Vec4::ZERO) & (u + v).cmple(Vec4::ONE);
        let ahead = t.cmpgt(Vec4::ZERO) & t.cmplt(Vec4::splat(limit));
        (t, u, v, (inside & ahead).bitmask())
    }
}

impl Bvh {
    /// The nearest triangle in (0, limit).
    pub fn nearest(&self, origin: Vec3, direction: Vec3, limit: f32, stack: &mut Stack) -> Option<RawHit> {
        let ray = WideRay::new(origin, direction);
        let mut best = RawHit { distance: limit, u: 0.0, v: 0.0, triangle: u32::MAX };
        self.walk(&ray, limit, stack, |packet| {
            let (t, u, v, mut hits) = ray.triangles(packet, best.distance);
            while hits != 0 {
                let lane = hits.trailing_zeros() as usize & 3;
                hits &= hits - 1;
                if t[lane] < best.distance {
                    best = RawHit { distance: t[lane], u: u[lane], v: v[lane], triangle: packet.triangle[lane] };
                }
            }
            Some(best.distance)
        });
        (best.triangle != u32::MAX).then_some(best)
    }

    /// Whether any triangle lies in (0, limit).
    pub fn any(&self, origin: Vec3, direction: Vec3, limit: f32, stack: &mut Stack) -> bool {
        let ray = WideRay::new(origin, direction);
        let mut found = false;
        self.walk(&ray, limit, stack, |packet| {
            found = ray.triangles(packet, limit).3 != 0;
            (!found).then_some(limit)
        });
        found
    }

    /// Every triangle along the half line, once each, in order of index.
    pub fn every(&self, origin: Vec3, direction: Vec3, stack: &mut Stack) -> Vec<u32> {
        let ray = WideRay::new(origin, direction);
        let mut met = Vec::new();
        self.walk(&ray, f32::INFINITY, stack, |packet| {
            let mut hits = ray.triangles(packet, f32::INFINITY).3;
            while hits != 0 {
                met.push(packet.triangle[hits.trailing_zeros() as usize & 3]);
                hits &= hits - 1;
            }
            Some(f32::INFINITY)
        });
        // A triangle that was split lies in several leaves.
        met.sort_unstable();
        met.dedup();
        met
    }

    /// Visits leaves front to back. `leaf` returns the distance beyond which nothing matters any more, or None to stop.
    #[inline(always)]
    fn walk(&self, ray: &WideRay, mut limit: f32, stack: &mut Stack, mut leaf: impl FnMut(&Packet) -> Option<f32>) {
        // A ray of NaN would seem to meet unused children, which lead back to the root.
        if self.nodes.is_empty() || !ray.is_finite() {
            return;
        }
        let stack = &mut stack.0;
        stack.clear();
        let mut current = 0u32;
        loop {
            if current & LEAF != 0 {
                match leaf(&self.packets[(current & !LEAF) as usize]) {
                    Some(nearer) => limit = nearer,
                    None => return,
                }
            } else if let Some(nearest) = open_node(ray, &self.nodes[current as usize], limit, stack) {
                current = nearest;
                continue;
            }
            loop {
                let Some((entry, next)) = stack.pop() else { return };
                if entry < limit {
                    current = next;
                    break;
                }
            }
        }
    }
}

/// The nearest child that the ray enters; the others go onto the stack, farthest first. None when it enters none.
#[inline(always)]
fn open_node(ray: &WideRay, node: &Node, limit: f32, stack: &mut Vec<(f32, u32)>) -> Option<u32> {
    let (near, mut hits) = ray.boxes(node, limit);
    if hits == 0 {
        return None;
    }
    let near = near.to_array();
    let mut take = || {
        let lane = hits.trailing_zeros() as usize & 3;
        hits &= hits - 1;
        ((near[lane], node.children[lane]), hits != 0)
    };
    let (mut nearest, more) = take();
    if !more {
        return Some(nearest.1);
    }
    let (mut second, more) = take();
    if second.0 < nearest.0 {
        std::mem::swap(&mut nearest, &mut second);
    }
    if !more {
        stack.push(second);
        return Some(nearest.1);
    }
    // Three or four: insertion into the stack's end keeps it sorted, farthest first.
    let bottom = stack.len();
    stack.push(second);
    let mut more = more;
    while more {
        let (mut next, left) = take();
        more = left;
        if next.0 < nearest.0 {
            std::mem::swap(&mut nearest, &mut next);
        }
        let mut at = stack.len();
        stack.push(next);
        while at > bottom && stack[at - 1].0 < next.0 {
            stack[at] = stack[at - 1];
            at -= 1;
        }
        stack[at] = next;
    }
    Some(nearest.1)
}
