//! Bounding volume hierarchy: built by `obvhs` (PLOC, Meister & Bittner 2018; reinsertion, Meister & Bittner 2018), then
//! collapsed to four children a node and four triangles a leaf, so that every step of a traversal fills one SIMD register.
//!
//! The builder runs on one thread and draws no random numbers: the same triangles give the same tree.

use glam::{Vec3, Vec3A, Vec4};
use obvhs::{
    aabb::Aabb,
    bvh2::{Bvh2, leaf_collapser::collapse, node::Bvh2Node, reinsertion::ReinsertionOptimizer},
    ploc::{PlocBuilder, PlocSearchDistance, SortPrecision},
    splits::split_aabbs_preset,
    triangle::Triangle,
};

/// Children of a node and triangles of a leaf: the lanes of one `Vec4`.
pub(super) const LANES: usize = 4;

/// Marks a child that is a leaf; the other bits name its packet.
pub(super) const LEAF: u32 = 1 << 31;

/// Four boxes side by side. 128 bytes: two cache lines.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Node {
    /// `bounds[axis][0]` = the four minima, `[1]` = the four maxima. Unused children are inverted (+∞, −∞): never hit.
    pub bounds: [[Vec4; 2]; 3],
    /// Node index, or `LEAF | packet index`.
    pub children: [u32; LANES],
}

/// Four triangles side by side: a corner and the two edges from it. Unused lanes have no area: never hit.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
pub(super) struct Packet {
    /// x, y, z of the first corner.
    pub corner: [Vec4; 3],
    /// x, y, z of second − first corner.
    pub edge_u: [Vec4; 3],
    /// x, y, z of third − first corner.
    pub edge_v: [Vec4; 3],
    /// Which triangle of the input each lane is.
    pub triangle: [u32; LANES],
}

/// The tree. `nodes[0]` is the root; no nodes when there are no triangles.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bvh {
    pub(super) nodes: Vec<Node>,
    pub(super) packets: Vec<Packet>,
}

impl Bvh {
    /// Builds the tree over triangles given by their corners, all finite. Fewer than 2³¹ of them.
    pub fn build(triangles: &[[Vec3; 3]]) -> Self {
        let mut bvh = Self::default();
        if triangles.is_empty() {
            return bvh;
        }
        let binary = build_binary(triangles);
        let root = binary.nodes[0];
        bvh.nodes.push(Node::EMPTY);
        // (wide node to fill, binary nodes that become its children)
        let mut open = vec![(0usize, widen(&binary, root))];
        while let Some((index, children)) = open.pop() {
            for (lane, child) in children.iter().enumerate() {
                let name = if child.is_leaf() {
                    bvh.push_packet(&binary, child, triangles)
                } else {
                    bvh.nodes.push(Node::EMPTY);
                    open.push((bvh.nodes.len() - 1, widen(&binary, *child)));
                    bvh.nodes.len() as u32 - 1
                };
                bvh.nodes[index].set_child(lane, child.aabb(), name);
            }
        }
        bvh
    }

    /// Nodes, then packets, four numbers at a time, and where packets begin: as `refraction.wgsl` reads them. A node is the least and greatest
    /// coordinates of its children axis by axis, then the children: a node's number, or −1 − a packet's. A packet is corners, two edges,
    /// and triangles, −1 for none. None where a number is too large to be exact.
    #[cfg(feature = "gpu")]
    pub fn as_vectors(&self) -> Option<(Vec<[f32; 4]>, usize)> {
        const EXACT: usize = 1 << 24;
        if self.nodes.len().max(4 * self.packets.len()) >= EXACT
            || self.packets.iter().flat_map(|p| p.triangle).any(|t| t != u32::MAX && t as usize >= EXACT)
        {
            return None;
        }
        let mut vectors = Vec::with_capacity(7 * self.nodes.len() + 10 * self.packets.len());
        for node in &self.nodes {
            // Of children that are not there both sides lie beyond everything: in whatever order they are taken, they are not met.
            let is_there = |lane: usize| node.bounds[0][0][lane] <= node.bounds[0][1][lane];
            let side = |bounds: &Vec4| std::array::from_fn(|lane| if is_there(lane) { bounds[lane] } else { BEYOND });
            vectors.extend(node.bounds.iter().flatten().map(side));
            vectors.push(node.children.map(|child| if child & LEAF == 0 { child as f32 } else { -1.0 - (child & !LEAF) as f32 }));
        }
        let first_packet = vectors.len();
        for Packet { corner, edge_u, edge_v, triangle } in &self.packets {
            vectors.extend(corner.iter().chain(edge_u).chain(edge_v).map(Vec4::to_array));
            vectors.push(triangle.map(|t| if t == u32::MAX { -1.0 } else { t as f32 }));
        }
        Some((vectors, first_packet))
    }

    fn push_packet(&mut self, binary: &Bvh2, leaf: &Bvh2Node, triangles: &[[Vec3; 3]]) -> u32 {
        let mut packet = Packet::EMPTY;
        let first = leaf.first_index as usize;
        for (lane, triangle) in binary.primitive_indices[first..first + leaf.prim_count as usize].iter().enumerate() {
            packet.set_lane(lane, triangles[*triangle as usize], *triangle);
        }
        self.packets.push(packet);
        LEAF | (self.packets.len() as u32 - 1)
    }
}

impl Node {
    const EMPTY: Self = Self { bounds: [[Vec4::INFINITY, Vec4::NEG_INFINITY]; 3], children: [0; LANES] };

    fn set_child(&mut self, lane: usize, bounds: &Aabb, name: u32) {
        for axis in 0..3 {
            self.bounds[axis][0][lane] = bounds.min[axis];
            self.bounds[axis][1][lane] = bounds.max[axis];
        }
        self.children[lane] = name;
    }
}

impl Packet {
    const EMPTY: Self = Self { corner: [Vec4::ZERO; 3], edge_u: [Vec4::ZERO; 3], edge_v: [Vec4::ZERO; 3], triangle: [u32::MAX; LANES] };

    fn set_lane(&mut self, lane: usize, [a, b, c]: [Vec3; 3], triangle: u32) {
        for axis in 0..3 {
            self.corner[axis][lane] = a[axis];
            self.edge_u[axis][lane] = b[axis] - a[axis];
            self.edge_v[axis][lane] = c[axis] - a[axis];
        }
        self.triangle[lane] = triangle;
    }
}

#[cfg(feature = "gpu")]
const BEYOND: f32 = 3e38;

/// The binary tree with at most `LANES` triangles a leaf. Long triangles are split into several boxes first.
fn build_binary(triangles: &[[Vec3; 3]]) -> Bvh2 {
    let triangles: Vec<Triangle> = triangles
        .iter()
        .map(|corners| {
            let [v0, v1, v2] = corners.map(Vec3A::from);
            Triangle { v0, v1, v2 }
        })
        .collect();
    let mut boxes: Vec<Aabb> = triangles.iter().map(Triangle::aabb).collect();
    let mut indices: Vec<u32> = (0..triangles.len() as u32).collect();
    let largest = boxes.iter().map(Aabb::half_area).fold(0f32, f32::max);
    let mean = boxes.iter().map(Aabb::half_area).sum::<f32>() / boxes.len() as f32;
    split_aabbs_preset(&mut boxes, &mut indices, &triangles, mean, largest);
    let mut binary = PlocBuilder::with_capacity(boxes.len()).build(PlocSearchDistance::Medium, &boxes, indices, SortPrecision::U64, 3);
    binary.uses_spatial_splits = true;
    let mut reinsertion = ReinsertionOptimizer::default();
    reinsertion.run(&mut binary, REINSERTED_SHARE, None);
    collapse(&mut binary, LANES as u32, COLLAPSE_TRAVERSAL_COST);
    reinsertion.run(&mut binary, REINSERTED_SHARE, None);
    binary
}

/// Share of the nodes tried for reinsertion; not yet tuned by measurement.
const REINSERTED_SHARE: f32 = 0.1;

/// Cost of a box test in triangle tests: a packet tests four triangles at the price of one, so leaves want to be full.
const COLLAPSE_TRAVERSAL_COST: f32 = 3.0;

/// Up to four descendants of a binary node: its children, the largest opened while there is room (a leaf stays alone).
fn widen(binary: &Bvh2, node: Bvh2Node) -> Vec<Bvh2Node> {
    let mut children = vec![node];
    while children.len() < LANES {
        let largest = (0..children.len())
            .filter(|c| !children[*c].is_leaf())
            .max_by(|a, b| children[*a].aabb().half_area().total_cmp(&children[*b].aabb().half_area()));
        let Some(largest) = largest else { break };
        let first = children[largest].first_index as usize;
        children[largest] = binary.nodes[first];
        children.push(binary.nodes[first + 1]);
    }
    children
}
