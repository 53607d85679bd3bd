//! Which lane fits which texel: texels that still climb are packed, so that no lane idles for those that are done.

use super::lanes::GROUP;

/// Lanes of a group that must take part for it to be fitted in place.
const IN_PLACE: usize = 12;

/// Which texel each lane fits, and for which item of a list it does so.
pub struct LaneList {
    /// Up to 16 texels.
    pub texels: Vec<usize>,
    items: [Option<usize>; GROUP],
}

impl LaneList {
    /// (lane, index of the item) of the lanes that are wanted.
    pub fn wanted(&self) -> impl Iterator<Item = (usize, usize)> {
        self.items.iter().enumerate().filter_map(|(lane, item)| item.map(|i| (lane, i)))
    }
}

/// Spreads items over lanes: groups of which most texels take part stay as they are, the rest is packed.
pub fn in_groups(texels: impl Iterator<Item = usize>) -> Vec<LaneList> {
    let items: Vec<usize> = texels.collect();
    let mut lists = Vec::new();
    let mut rest = Vec::new();
    let mut at = 0;
    while at < items.len() {
        let group = items[at] / GROUP;
        let end = at + items[at..].iter().take_while(|&&texel| texel / GROUP == group).count();
        let mut slots = [None; GROUP];
        let mut doubles = Vec::new();
        for (i, texel) in items.iter().enumerate().take(end).skip(at) {
            match &mut slots[texel % GROUP] {
                slot @ None => *slot = Some(i),
                Some(_) => doubles.push(i),
            }
        }
        if slots.iter().flatten().count() >= IN_PLACE {
            let last = slots.iter().rposition(Option::is_some).unwrap_or_default();
            lists.push(LaneList { texels: (group * GROUP..=group * GROUP + last).collect(), items: slots });
            rest.extend(doubles);
        } else {
            rest.extend(at..end);
        }
        at = end;
    }
    for chunk in rest.chunks(GROUP) {
        let mut slots = [None; GROUP];
        for (slot, &i) in slots.iter_mut().zip(chunk) {
            *slot = Some(i);
        }
        lists.push(LaneList { texels: chunk.iter().map(|&i| items[i]).collect(), items: slots });
    }
    lists
}
