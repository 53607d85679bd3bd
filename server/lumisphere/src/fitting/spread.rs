//! Few places that stand for many. Who calls it: whoever looks at some texels of a map only.

/// `count` of `of` places, one in each stretch, at no fixed distance: tiles of a row must not all come from one column.
pub(crate) fn spread(count: usize, of: usize) -> impl Iterator<Item = usize> {
    (0..count).map(move |i| {
        let (a, b) = (i * of / count, (i + 1) * of / count);
        a + ((i as f64 * 0.618_034).fract() * (b - a) as f64) as usize
    })
}
