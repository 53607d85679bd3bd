//! Rays sorted so that those that go the same way stand together, for packets. The order changes no result.

use glam::{Vec2, Vec3};

// Cells along an edge of the octahedral square, a power of two: cells of about 5 degrees.
const CELLS: u32 = 32;

/// Cell of the octahedral square that a direction (of any length) falls into, along a Z-order curve: near keys, near directions.
#[inline]
pub(super) fn direction_key(direction: Vec3) -> usize {
    let at = octahedral(direction);
    // A NaN becomes cell 0.
    let cell = |v: f32| ((v * CELLS as f32) as u32).min(CELLS - 1);
    (spread(cell(at.x)) | spread(cell(at.y)) << 1) as usize
}

/// Place of a direction (of any length) in the octahedral square [0, 1]², +Y in its middle.
#[inline]
pub(super) fn octahedral(direction: Vec3) -> Vec2 {
    let d = direction / (direction.x.abs() + direction.y.abs() + direction.z.abs());
    let folded = if d.y >= 0.0 { Vec2::new(d.x, d.z) } else { Vec2::new((1.0 - d.z.abs()).copysign(d.x), (1.0 - d.x.abs()).copysign(d.z)) };
    0.5 * (folded + 1.0)
}

/// The unit vector at a place of that square.
pub(super) fn from_octahedral(at: Vec2) -> Vec3 {
    let p = 2.0 * at - 1.0;
    let y = 1.0 - p.x.abs() - p.y.abs();
    let (x, z) = if y >= 0.0 { (p.x, p.y) } else { ((1.0 - p.y.abs()).copysign(p.x), (1.0 - p.x.abs()).copysign(p.y)) };
    Vec3::new(x, y, z).normalize()
}

/// The bits of x < 2⁸ with a gap after each.
#[inline]
fn spread(mut x: u32) -> u32 {
    x = (x | x << 4) & 0x0f0f;
    x = (x | x << 2) & 0x3333;
    (x | x << 1) & 0x5555
}

/// Stable counting sort by a `direction_key`. `order` is scratch.
pub(super) fn sort_by_key<T: Copy>(items: &mut [T], order: &mut Vec<u32>, key: impl Fn(&T) -> usize) {
    let mut starts = [0u32; (CELLS * CELLS) as usize + 1];
    order.clear();
    order.extend(items.iter().map(|item| key(item) as u32));
    order.iter().for_each(|k| starts[*k as usize + 1] += 1);
    (0..starts.len() - 1).for_each(|k| starts[k + 1] += starts[k]);
    let unsorted = items.to_vec();
    for (item, key) in unsorted.into_iter().zip(order.iter()) {
        let place = &mut starts[*key as usize];
        items[*place as usize] = item;
        *place += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raytrace::warp::even_directions;

    #[test]
    fn sorting_keeps_every_item_and_the_order_of_equals_and_brings_directions_together() {
        let mut items: Vec<(usize, Vec3)> = even_directions(5000).enumerate().map(|(i, d)| (i * 7 % 5000, d)).collect();
        let before = items.clone();
        sort_by_key(&mut items, &mut Vec::new(), |i| direction_key(i.1));
        let key = |i: &(usize, Vec3)| direction_key(i.1);
        let place = |i: &(usize, Vec3)| before.iter().position(|b| b.0 == i.0).unwrap();
        assert!(items.windows(2).all(|w| key(&w[0]) < key(&w[1]) || key(&w[0]) == key(&w[1]) && place(&w[0]) < place(&w[1])));
        assert_eq!(items.len(), before.len());
        let spread = |items: &[(usize, Vec3)]| items.windows(2).map(|w| w[0].1.dot(w[1].1).clamp(-1.0, 1.0).acos()).sum::<f32>() / 5000.0;
        // Cells are about 0.1 rad wide; the jumps of the curve add to that. Unsorted neighbours are 2.4 rad apart at the equator.
        assert!(spread(&items) < 0.2 && spread(&before) > 1.0, "{} {}", spread(&items), spread(&before));
    }

    #[test]
    fn the_octahedral_square_holds_every_direction_once() {
        for d in even_directions(1000) {
            assert!((from_octahedral(octahedral(d)) - d).length() < 1e-5, "{d}");
            assert!((octahedral(3.0 * d) - octahedral(d)).length() < 1e-5);
        }
    }
}
