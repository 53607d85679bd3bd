//! Eight rays at a time against the tree: one node read, one child's box against all eight. Pays where the rays stay together, as those of a
//! texel do. The arithmetic is that of `traverse`, operation by operation: a ray meets the same in a packet as alone.

use glam::{Vec3, Vec4};

use super::bvh::{Bvh, LANES, LEAF, Node, Packet};
use super::lanes::{Kernel, Lanes, WIDTH, dispatch};
use super::traverse::{FAR_SLACK, RawHit, finite_inverse};

/// Rays in a packet.
pub(super) const RAYS: usize = WIDTH;

/// Eight rays. Directions need not be unit vectors.
#[derive(Debug, Clone)]
pub(super) struct RayPacket {
    origin: [[f32; RAYS]; 3],
    direction: [[f32; RAYS]; 3],
    inverse: [[f32; RAYS]; 3],
    /// Where each ray ends, in multiples of its direction; `SPENT` for a lane without a ray.
    limit: [f32; RAYS],
}

/// Nodes still to visit. One a thread or tile, reused, so that no ray allocates.
#[derive(Debug, Default)]
pub(super) struct PacketStack(Vec<Entry>);

#[derive(Debug, Clone, Copy)]
struct Entry {
    near: [f32; RAYS],
    node: u32,
}

// The limit of a ray that asks for nothing more: no box begins before it.
const SPENT: f32 = -1.0;

impl RayPacket {
    /// No rays.
    pub const EMPTY: Self = Self { origin: [[0.0; RAYS]; 3], direction: [[1.0; RAYS]; 3], inverse: [[1.0; RAYS]; 3], limit: [SPENT; RAYS] };

    /// Puts a ray into a lane. A ray that is not finite meets nothing.
    #[inline]
    pub fn set(&mut self, lane: usize, origin: Vec3, direction: Vec3, limit: f32) {
        for axis in 0..3 {
            self.origin[axis][lane] = origin[axis];
            self.direction[axis][lane] = direction[axis];
            self.inverse[axis][lane] = finite_inverse(direction[axis]);
        }
        self.limit[lane] = if origin.is_finite() && direction.is_finite() { limit } else { SPENT };
    }
}

impl Bvh {
    /// The nearest triangle of each ray.
    pub(super) fn nearest_of_packet(&self, rays: &RayPacket, stack: &mut PacketStack) -> [Option<RawHit>; RAYS] {
        dispatch(Nearest { bvh: self, rays, stack })
    }

    /// Bit k: something lies on ray k.
    pub(super) fn any_of_packet(&self, rays: &RayPacket, stack: &mut PacketStack) -> u32 {
        dispatch(Any { bvh: self, rays, stack })
    }
}

#[cfg(test)]
impl Bvh {
    pub(super) fn nearest_of_packet_portably(&self, rays: &RayPacket, stack: &mut PacketStack) -> [Option<RawHit>; RAYS] {
        super::lanes::portable(Nearest { bvh: self, rays, stack })
    }

    pub(super) fn any_of_packet_portably(&self, rays: &RayPacket, stack: &mut PacketStack) -> u32 {
        super::lanes::portable(Any { bvh: self, rays, stack })
    }
}

struct Nearest<'a> {
    bvh: &'a Bvh,
    rays: &'a RayPacket,
    stack: &'a mut PacketStack,
}

struct Any<'a> {
    bvh: &'a Bvh,
    rays: &'a RayPacket,
    stack: &'a mut PacketStack,
}

impl Kernel for Nearest<'_> {
    type Output = [Option<RawHit>; RAYS];

    #[inline(always)]
    fn run<L: Lanes>(self) -> Self::Output {
        let rays = WideRays::<L>::new(self.rays);
        let none = L::splat(f32::from_bits(u32::MAX));
        let mut best = Best { distance: L::load(&self.rays.limit), u: none, v: none, triangle: none };
        walk(self.bvh, &rays, best.distance, self.stack, &mut best);
        best.hits()
    }
}

impl Kernel for Any<'_> {
    type Output = u32;

    #[inline(always)]
    fn run<L: Lanes>(self) -> u32 {
        let rays = WideRays::<L>::new(self.rays);
        let limit = L::load(&self.rays.limit);
        let mut met = Met { limit, found: 0, asking: L::bits(L::splat(0.0).lt(limit)) };
        walk(self.bvh, &rays, limit, self.stack, &mut met);
        met.found
    }
}

/// What becomes of triangles that rays meet. A trait and not a closure: a closure would not be compiled for the kernel's processor.
trait Visit<L: Lanes> {
    /// Distances beyond which nothing matters any more, or None to stop.
    fn visit(&mut self, rays: &WideRays<L>, packet: &Packet) -> Option<L>;
}

/// Which rays met anything.
struct Met<L> {
    limit: L,
    found: u32,
    asking: u32,
}

impl<L: Lanes> Visit<L> for Met<L> {
    #[inline(always)]
    fn visit(&mut self, rays: &WideRays<L>, packet: &Packet) -> Option<L> {
        for lane in 0..LANES {
            if packet.triangle[lane] == u32::MAX {
                break;
            }
            let hit = rays.triangle(packet, lane, self.limit).3;
            let bits = L::bits(hit);
            if bits != 0 {
                self.found |= bits;
                self.limit = L::select(hit, L::splat(SPENT), self.limit);
            }
        }
        if self.found == self.asking { None } else { Some(self.limit) }
    }
}

impl<L: Lanes> Visit<L> for Best<L> {
    #[inline(always)]
    fn visit(&mut self, rays: &WideRays<L>, packet: &Packet) -> Option<L> {
        for lane in 0..LANES {
            if packet.triangle[lane] == u32::MAX {
                break;
            }
            let (t, u, v, hit) = rays.triangle(packet, lane, self.distance);
            if L::bits(hit) != 0 {
                self.distance = L::select(hit, t, self.distance);
                self.u = L::select(hit, u, self.u);
                self.v = L::select(hit, v, self.v);
                self.triangle = L::select(hit, L::splat(f32::from_bits(packet.triangle[lane])), self.triangle);
            }
        }
        Some(self.distance)
    }
}

struct Best<L> {
    distance: L,
    u: L,
    v: L,
    triangle: L,
}

impl<L: Lanes> Best<L> {
    #[inline(always)]
    fn hits(self) -> [Option<RawHit>; RAYS] {
        let [mut distance, mut u, mut v, mut triangle] = [[0.0; RAYS]; 4];
        self.distance.store(&mut distance);
        self.u.store(&mut u);
        self.v.store(&mut v);
        self.triangle.store(&mut triangle);
        std::array::from_fn(|k| {
            let triangle = triangle[k].to_bits();
            (triangle != u32::MAX).then_some(RawHit { distance: distance[k], u: u[k], v: v[k], triangle })
        })
    }
}

struct WideRays<L: Lanes> {
    origin: [L; 3],
    direction: [L; 3],
    inverse: [L; 3],
    // Where the direction is negative: the maximum is then the near plane.
    negative: [L::Mask; 3],
    /// The sign of every axis where all rays share it: 1 = negative. Then the planes need no choice lane by lane.
    together: Option<[usize; 3]>,
}

impl<L: Lanes> WideRays<L> {
    #[inline(always)]
    fn new(rays: &RayPacket) -> Self {
        let inverse = load::<L>(&rays.inverse);
        // 1/−0 is negative too, as the sign bit that `traverse` asks.
        let zero = L::splat(0.0);
        let negative = [inverse[0].lt(zero), inverse[1].lt(zero), inverse[2].lt(zero)];
        let asking = L::bits(zero.lt(L::load(&rays.limit)));
        let signs = [L::bits(negative[0]) & asking, L::bits(negative[1]) & asking, L::bits(negative[2]) & asking];
        let side = [usize::from(signs[0] != 0), usize::from(signs[1] != 0), usize::from(signs[2] != 0)];
        let mixed = [0, 1, 2].iter().any(|axis| signs[*axis] != 0 && signs[*axis] != asking);
        Self { origin: load(&rays.origin), direction: load(&rays.direction), inverse, negative, together: (!mixed).then_some(side) }
    }

    /// Entry distances into one child's box, and which rays enter it before `limit`.
    #[inline(always)]
    fn one_box(&self, node: &Node, child: usize, limit: L) -> (L, L::Mask) {
        let ([x0, x1], [y0, y1], [z0, z1]) = match self.together {
            Some([x, y, z]) => (self.slab(node, child, 0, x), self.slab(node, child, 1, y), self.slab(node, child, 2, z)),
            None => (self.mixed_slab(node, child, 0), self.mixed_slab(node, child, 1), self.mixed_slab(node, child, 2)),
        };
        let near = x0.max(y0.max(z0.max(L::splat(0.0))));
        let far = x1.min(y1.min(z1.min(limit)));
        (near, near.le(far * L::splat(FAR_SLACK)))
    }

    /// Distances of the planes of one axis, near and far, where all rays enter through side `side`.
    #[inline(always)]
    fn slab(&self, node: &Node, child: usize, axis: usize, side: usize) -> [L; 2] {
        let [near, far] = [L::splat(node.bounds[axis][side & 1][child]), L::splat(node.bounds[axis][1 - (side & 1)][child])];
        [(near - self.origin[axis]) * self.inverse[axis], (far - self.origin[axis]) * self.inverse[axis]]
    }

    /// The same where each ray has its own side.
    #[inline(always)]
    fn mixed_slab(&self, node: &Node, child: usize, axis: usize) -> [L; 2] {
        let [low, high] = [L::splat(node.bounds[axis][0][child]), L::splat(node.bounds[axis][1][child])];
        let (near, far) = (L::select(self.negative[axis], high, low), L::select(self.negative[axis], low, high));
        [(near - self.origin[axis]) * self.inverse[axis], (far - self.origin[axis]) * self.inverse[axis]]
    }

    /// Distances and barycentric weights in one triangle, and which rays hit it in (0, limit).
    #[inline(always)]
    fn triangle(&self, packet: &Packet, lane: usize, limit: L) -> (L, L, L, L::Mask) {
        let ([ux, uy, uz], [vx, vy, vz]) = (corner(&packet.edge_u, lane), corner(&packet.edge_v, lane));
        let [px, py, pz] = corner(&packet.corner, lane);
        let (nx, ny, nz) = (L::splat(uy * vz - uz * vy), L::splat(uz * vx - ux * vz), L::splat(ux * vy - uy * vx));
        let (ux, uy, uz, vx, vy, vz) = (L::splat(ux), L::splat(uy), L::splat(uz), L::splat(vx), L::splat(vy), L::splat(vz));
        let [dx, dy, dz] = self.direction;
        let (cx, cy, cz) = (L::splat(px) - self.origin[0], L::splat(py) - self.origin[1], L::splat(pz) - self.origin[2]);
        let (rx, ry, rz) = (cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx);
        let inverse = (dx * nx + dy * ny + dz * nz).recip();
        let u = (vx * rx + vy * ry + vz * rz) * inverse;
        let v = (ux * rx + uy * ry + uz * rz).negate() * inverse;
        let t = (cx * nx + cy * ny + cz * nz) * inverse;
        let zero = L::splat(0.0);
        let inside = zero.le(u) & zero.le(v) & (u + v).le(L::splat(1.0));
        (t, u, v, inside & zero.lt(t) & t.lt(limit))
    }
}

#[inline(always)]
fn load<L: Lanes>(coordinates: &[[f32; RAYS]; 3]) -> [L; 3] {
    [L::load(&coordinates[0]), L::load(&coordinates[1]), L::load(&coordinates[2])]
}

#[inline(always)]
fn corner(coordinates: &[Vec4; 3], lane: usize) -> [f32; 3] {
    [coordinates[0][lane], coordinates[1][lane], coordinates[2][lane]]
}

/// Visits leaves, near ones first.
#[inline(always)]
fn walk<L: Lanes>(bvh: &Bvh, rays: &WideRays<L>, mut limit: L, stack: &mut PacketStack, visitor: &mut impl Visit<L>) {
    if bvh.nodes.is_empty() {
        return;
    }
    let stack = &mut stack.0;
    stack.clear();
    let mut current = 0u32;
    loop {
        if current & LEAF != 0 {
            match visitor.visit(rays, &bvh.packets[(current & !LEAF) as usize]) {
                Some(nearer) => limit = nearer,
                None => return,
            }
        } else {
            open_node(rays, &bvh.nodes[current as usize], limit, stack);
        }
        loop {
            let Some(entry) = stack.pop() else { return };
            if L::bits(L::load(&entry.near).lt(limit)) != 0 {
                current = entry.node;
                break;
            }
        }
    }
}

/// Puts the children that any ray enters onto the stack, the one that is nearest to its first ray last.
#[inline(always)]
fn open_node<L: Lanes>(rays: &WideRays<L>, node: &Node, limit: L, stack: &mut Vec<Entry>) {
    // All boxes before the first branch: their latencies overlap.
    let (mut nears, mut entered) = ([L::splat(0.0); LANES], [0; LANES]);
    for child in 0..LANES {
        let (near, mask) = rays.one_box(node, child, limit);
        // A ray that stays outside has no reason to come back.
        nears[child] = L::select(mask, near, L::splat(f32::INFINITY));
        entered[child] = L::bits(mask);
    }
    let bottom = stack.len();
    let mut keys = [0.0; LANES];
    for child in 0..LANES {
        if entered[child] == 0 {
            continue;
        }
        let mut entry = Entry { near: [0.0; RAYS], node: node.children[child] };
        nears[child].store(&mut entry.near);
        let key = entry.near[entered[child].trailing_zeros() as usize & (RAYS - 1)];
        let mut at = stack.len();
        stack.push(entry);
        while at > bottom && keys[at - 1 - bottom] < key {
            stack[at] = stack[at - 1];
            keys[at - bottom] = keys[at - 1 - bottom];
            at -= 1;
        }
        stack[at] = entry;
        keys[at - bottom] = key;
    }
}
