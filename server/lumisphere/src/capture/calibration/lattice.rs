//! Corners into lattices: whose edge leads to whom.
//!
//! A corner's edge leads to the nearest corner in its direction whose own edge leads back, with the same side bright: that is what a
//! square's edge looks like from both ends. Links that both ends agree on give every corner whole coordinates.

use std::collections::{HashMap, VecDeque};

use glam::{DVec2, IVec2};

use super::corners::Corner;

/// Corners by whole coordinates. +x turned to +y is by growing angle in the image (clockwise, as y runs down).
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Lattice {
    pub places: HashMap<IVec2, usize>,
    /// Whether the square between (x, y) and (x + 1, y + 1) is bright where x + y is even.
    pub even_is_bright: bool,
}

const STEPS: [IVec2; 4] = [IVec2::X, IVec2::Y, IVec2::NEG_X, IVec2::NEG_Y];

/// Every lattice, largest first.
pub(super) fn lattices(corners: &[Corner]) -> Vec<Lattice> {
    let links = mutual_links(corners);
    let mut visited = vec![false; corners.len()];
    let mut found = Vec::new();
    for seed in 0..corners.len() {
        if !visited[seed] {
            found.push(grown(corners, &links, seed, &mut visited));
        }
    }
    // Stable, so of equal ones the strongest corner's comes first.
    found.sort_by_key(|lattice| std::cmp::Reverse(lattice.places.len()));
    found
}

// For each corner's edge the corner it leads to and that one's edge back.
type Links = Vec<[Option<(usize, usize)>; 4]>;

fn mutual_links(corners: &[Corner]) -> Links {
    let one_way: Links = (0..corners.len()).map(|i| std::array::from_fn(|edge| leads_to(corners, i, edge))).collect();
    let agreed = |i: usize, edge: usize| one_way[i][edge].filter(|&(j, back)| one_way[j][back] == Some((i, edge)));
    (0..corners.len()).map(|i| std::array::from_fn(|edge| agreed(i, edge))).collect()
}

fn leads_to(corners: &[Corner], from: usize, edge: usize) -> Option<(usize, usize)> {
    // Of the ring's edges, which noise and the lens turn, against the line to the neighbour: cos 17°.
    const ALONG: f64 = 0.956;
    let own = &corners[from].edges[edge];
    let direction = own.direction();
    let mut best: Option<(f64, usize, usize)> = None;
    for (j, other) in corners.iter().enumerate() {
        let line = other.at - corners[from].at;
        let distance = line.length();
        if !(distance > 0.0 && line.dot(direction) > ALONG * distance) || best.is_some_and(|(d, ..)| d <= distance) {
            continue;
        }
        // The same square lies on the same side of the line, so seen from the other end the change is the other way.
        let back = other.edges.iter().position(|e| e.rising != own.rising && e.direction().dot(-line) > ALONG * distance);
        if let Some(back) = back {
            best = Some((distance, j, back));
        }
    }
    best.map(|(_, j, back)| (j, back))
}

// Everything linked to the seed that belongs to a closed square. A corner's `turn` is the step its edge 0 stands for.
fn grown(corners: &[Corner], links: &Links, seed: usize, visited: &mut [bool]) -> Lattice {
    visited[seed] = true;
    let mut places = HashMap::from([(IVec2::ZERO, seed)]);
    let mut turns = HashMap::from([(seed, 0)]);
    let mut queue = VecDeque::from([(seed, IVec2::ZERO, 0)]);
    while let Some((from, place, turn)) = queue.pop_front() {
        for (edge, link) in links[from].iter().enumerate() {
            let Some((to, back)) = *link else { continue };
            let step = (edge + turn) % 4;
            let next = place + STEPS[step];
            if visited[to] || places.contains_key(&next) || !even(corners, &places, place, step, corners[to].at) {
                continue;
            }
            // Its edge `back` is the step the other way.
            let turn = (step + 2 + 4 - back) % 4;
            visited[to] = true;
            places.insert(next, to);
            turns.insert(to, turn);
            queue.push_back((to, next, turn));
        }
    }
    // Between edges 0 and 1 of the seed lies the square toward (1, 1).
    Lattice { places: closed(links, &places, &turns), even_is_bright: corners[seed].edges[0].rising }
}

// The places that have a square whose four sides are links: chains of chance links, in noise or grass, hardly ever close.
fn closed(links: &Links, places: &HashMap<IVec2, usize>, turns: &HashMap<usize, usize>) -> HashMap<IVec2, usize> {
    let linked = |place: IVec2, step: usize| {
        let (Some(&from), Some(&to)) = (places.get(&place), places.get(&(place + STEPS[step]))) else { return false };
        let edge = (step + 4 - turns.get(&from).copied().unwrap_or(0)) % 4;
        links[from][edge].is_some_and(|(other, _)| other == to)
    };
    let has_square = |place: &IVec2| {
        (0..4).any(|step| {
            let next = (step + 1) % 4;
            let (across, along) = (*place + STEPS[step], *place + STEPS[next]);
            linked(*place, step) && linked(across, next) && linked(*place, next) && linked(along, step)
        })
    };
    places.iter().filter(|(place, _)| has_square(place)).map(|(&place, &corner)| (place, corner)).collect()
}

// Whether a step is about as long as the one before it in the same line, where there is one: perspective changes lengths slowly.
fn even(corners: &[Corner], places: &HashMap<IVec2, usize>, place: IVec2, step: usize, to: DVec2) -> bool {
    const MOST_CHANGE: f64 = 1.7;
    let at = |place: IVec2| places.get(&place).map(|&i| corners[i].at);
    let (Some(here), Some(before)) = (at(place), at(place - STEPS[step])) else { return true };
    let ratio = to.distance(here) / here.distance(before);
    ratio < MOST_CHANGE && ratio > MOST_CHANGE.recip()
}

impl Lattice {
    /// Least and greatest coordinates.
    pub fn bounds(&self) -> (IVec2, IVec2) {
        self.places.keys().fold((IVec2::MAX, IVec2::MIN), |(least, greatest), &place| (least.min(place), greatest.max(place)))
    }

    /// Whether the square between `place` and `place` + (1, 1) is bright.
    pub fn is_bright(&self, place: IVec2) -> bool {
        ((place.x + place.y) % 2 == 0) == self.even_is_bright
    }
}
