//! A checkerboard's inner corners in a photograph, in order.

use glam::{DVec2, IVec2};

use super::Checkerboard;
use super::corners::{Corner, find_corners, placed, smoothed};
use super::grey::Grey;
use super::lattice::{Lattice, lattices};

/// What of the board was found.
#[derive(Debug, Clone, PartialEq)]
pub enum Detection {
    /// Every corner, in the order of [`Checkerboard::corner`]; pixel centres at half integers, y down.
    Found(Vec<DVec2>),
    /// The board runs out of the photograph.
    PartlyOutOfView {
        /// Corners seen.
        found: usize,
    },
    /// Within the photograph, but something hides corners, or they are blurred.
    Incomplete {
        /// Corners seen.
        found: usize,
    },
    /// A checkerboard with more corners than the board has.
    OtherBoard {
        /// Inner corners along its longer side.
        columns: usize,
        /// Along the shorter.
        rows: usize,
    },
    /// No checkerboard.
    NotFound,
}

// Corners are sought where the longer side is about this; squares of a board that fills the picture are then 20 to 100 pixels wide.
const SEARCH_SIDE_PX: usize = 1000;

// Fewer linked corners, or a smaller part of the board's, are any pattern: white noise of a whole photograph has up to 8 of them.
const LEAST_CORNERS: usize = 6;
const LEAST_PART: usize = 5;

/// Looks for the board, first in the photograph reduced to about 1000 pixels, then finer, then coarser; what is found is placed in the
/// full photograph. Squares must be at least 8 pixels wide, the board matt and flat.
pub fn find_checkerboard(photograph: &Grey, board: &Checkerboard) -> Detection {
    let mut levels = vec![photograph.clone()];
    while let Some(last) = levels.last()
        && last.width.min(last.height) >= 200
    {
        levels.push(last.halved());
    }
    let first = levels.iter().position(|l| l.width.max(l.height) <= SEARCH_SIDE_PX).unwrap_or(levels.len() - 1);
    let order = (0..=first).rev().chain(first + 1..levels.len());
    let mut best = Detection::NotFound;
    for level in order {
        match in_level(&levels[level], board) {
            (Detection::Found(corners), spacing) => return in_full(photograph, corners, spacing, level as i32),
            (other, _) if other.weight() > best.weight() => best = other,
            _ => {}
        }
    }
    best
}

impl Detection {
    // How much of a board it tells of.
    fn weight(&self) -> usize {
        match self {
            Self::Found(corners) => corners.len(),
            Self::PartlyOutOfView { found } | Self::Incomplete { found } => *found,
            Self::OtherBoard { columns, rows } => columns * rows,
            Self::NotFound => 0,
        }
    }
}

// Corners in pixels of the level, and each one's distance to its nearest neighbour.
fn in_level(level: &Grey, board: &Checkerboard) -> (Detection, Vec<f64>) {
    let corners = find_corners(level);
    let mut best = Detection::NotFound;
    for lattice in lattices(&corners).iter().filter(|l| l.places.len() >= LEAST_CORNERS.max(board.corner_count() / LEAST_PART)) {
        let windows = windows(lattice, board);
        let Some(most) = windows.iter().map(|w| w.found).max() else { continue };
        let detection = match windows.as_slice() {
            // Whatever else hangs on to it (a lattice may grow into the background), one rectangle of the board's size is complete.
            [window] if window.found == board.corner_count() => {
                let order = ordered(window, lattice, &corners, board);
                let at = |i: usize| corners[i].at;
                let spacing = |&i: &usize| order.iter().filter(|&&j| j != i).map(|&j| at(i).distance(at(j))).fold(f64::INFINITY, f64::min);
                let spacings = order.iter().map(spacing).collect();
                return (Detection::Found(order.into_iter().map(at).collect()), spacings);
            }
            [window, ..] if window.found < board.corner_count() => {
                let leaves = leaves_the_photograph(level, lattice, &corners, window);
                if leaves { Detection::PartlyOutOfView { found: most } } else { Detection::Incomplete { found: most } }
            }
            _ => {
                let size = lattice.bounds().1 - lattice.bounds().0 + 1;
                Detection::OtherBoard { columns: size.max_element() as usize, rows: size.min_element() as usize }
            }
        };
        if detection.weight() > best.weight() {
            best = detection;
        }
    }
    (best, Vec::new())
}

// A rectangle of the board's size, upright or lying, over a lattice.
#[derive(Debug, Clone, Copy)]
struct Window {
    least: IVec2,
    greatest: IVec2,
    found: usize,
}

// Those that hold most of the lattice's corners.
fn windows(lattice: &Lattice, board: &Checkerboard) -> Vec<Window> {
    let (columns, rows) = (board.columns() as i32, board.rows() as i32);
    let sizes = if columns == rows { vec![IVec2::new(columns, rows)] } else { vec![IVec2::new(columns, rows), IVec2::new(rows, columns)] };
    let (least, greatest) = lattice.bounds();
    let mut best: Vec<Window> = Vec::new();
    for size in sizes {
        // A window that sticks out over both ends of the lattice sees no more of it.
        let last = (greatest - size + 1).max(least);
        for y in least.y..=last.y {
            for x in least.x..=last.x {
                let (low, high) = (IVec2::new(x, y), IVec2::new(x, y) + size - 1);
                let found = lattice.places.keys().filter(|p| p.cmpge(low).all() && p.cmple(high).all()).count();
                let most = best.first().map_or(0, |w| w.found);
                if found > most {
                    best.clear();
                }
                if found >= most && found > 0 {
                    best.push(Window { least: low, greatest: high, found });
                }
            }
        }
    }
    best
}

// The board's corners in order, from a window that is complete. Empty where it is not.
fn ordered(window: &Window, lattice: &Lattice, corners: &[Corner], board: &Checkerboard) -> Vec<usize> {
    let Window { least, greatest, .. } = *window;
    let (columns, rows) = (board.columns() as i32, board.rows() as i32);
    // On the board x to y is counter-clockwise as one looks at it, in the lattice clockwise: a row of the board follows the lattice's turn
    // the other way round.
    let ends = [least, IVec2::new(greatest.x, least.y), greatest, IVec2::new(least.x, greatest.y)];
    let along = [[IVec2::Y, IVec2::X], [IVec2::NEG_X, IVec2::Y], [IVec2::NEG_Y, IVec2::NEG_X], [IVec2::X, IVec2::NEG_Y]];
    let mut candidates: Vec<(bool, f64, Vec<usize>)> = Vec::new();
    for (origin, [column, row]) in ends.into_iter().zip(along) {
        let place = |i: i32| origin + column * (i % columns) + row * (i / columns);
        let inside = |i: i32| Some(place(i)).filter(|p| p.cmpge(least).all() && p.cmple(greatest).all());
        let order = (0..columns * rows).map(|i| lattice.places.get(&inside(i)?).copied()).collect::<Option<Vec<_>>>();
        let Some(order) = order else { continue };
        // The square outside of the origin lies between its two outward neighbours.
        let outside = (origin - column - row).min(origin);
        let at = order.first().map_or(DVec2::ZERO, |&i| corners[i].at);
        candidates.push((lattice.is_bright(outside), at.x - at.y, order));
    }
    // Dark outside if any; of equals the one furthest to the lower left.
    candidates.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    candidates.into_iter().next().map_or(Vec::new(), |(_, _, order)| order)
}

// Whether most of the corners that would follow along some side of what is seen of the board are outside of the photograph, or too near
// its edge to be proved by the ring.
fn leaves_the_photograph(level: &Grey, lattice: &Lattice, corners: &[Corner], window: &Window) -> bool {
    const MARGIN_PX: f64 = 7.0;
    let (low, high) = (DVec2::splat(MARGIN_PX), DVec2::new(level.width as f64, level.height as f64) - MARGIN_PX);
    let at = |place: IVec2| lattice.places.get(&place).map(|&i| corners[i].at);
    let within = |p: &IVec2| p.cmpge(window.least).all() && p.cmple(window.greatest).all();
    [IVec2::X, IVec2::NEG_X, IVec2::Y, IVec2::NEG_Y].into_iter().any(|step| {
        let ends = lattice.places.keys().filter(|&&place| within(&place) && at(place + step).is_none());
        let next: Vec<DVec2> = ends.filter_map(|&place| Some(2.0 * at(place)? - at(place - step)?)).collect();
        let outside = next.iter().filter(|p| p.cmplt(low).any() || p.cmpgt(high).any()).count();
        2 * outside > next.len()
    })
}

// The corners placed in the full photograph, each in a window that no neighbouring corner reaches into.
fn in_full(photograph: &Grey, corners: Vec<DVec2>, spacings: Vec<f64>, level: i32) -> Detection {
    const WINDOW_OF_SPACING: f64 = 0.35;
    const WINDOW_PX: std::ops::RangeInclusive<f64> = 4.0..=12.0;
    let smooth = smoothed(photograph);
    let scale = 2f64.powi(level);
    let mut found = Vec::with_capacity(corners.len());
    for (at, spacing) in corners.iter().zip(spacings) {
        // Pixel centres at whole numbers, of pixels `scale` times larger.
        let start = (*at + 0.5) * scale - 0.5;
        let half = (WINDOW_OF_SPACING * spacing * scale).clamp(*WINDOW_PX.start(), *WINDOW_PX.end());
        match placed(&smooth, start, half).or_else(|| placed(&smooth, start, *WINDOW_PX.start())) {
            Some(at) => found.push(at + 0.5),
            None => return Detection::Incomplete { found: found.len() },
        }
    }
    Detection::Found(found)
}
