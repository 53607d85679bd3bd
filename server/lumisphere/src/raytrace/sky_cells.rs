//! Which direction to look for the sky's light in: drawn in proportion to luminance × the cosine to a surface's normal.
//!
//! The map is cut into cells (median splits; the cell with the most light × extent first), so that a sun ends up in cells of its own and
//! the rest in pieces of a few degrees. A table holds, for every bin of normals, the cells' light × cosine; within a cell texels are drawn
//! by luminance. What the cosine varies by inside a cell and a bin is all that is left to chance, and no direction above a surface has
//! density zero where light comes from: a surface needs no second strategy (Clarberg et al. 2005 draw from the same product by wavelets).

use std::f32::consts::{PI, TAU};
use std::ops::Range;

use glam::{Vec2, Vec3};

use super::coherence::{from_octahedral, octahedral};
use super::distribution::{Choice, choose_in, cumulate, probability};

/// The directions of a surface's normal that share a table, or none in particular.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct NormalBin(u16);

// Bins along an edge of the octahedral square: 8 to 16 degrees wide.
const BINS: usize = 16;

// Pieces that a map is cut into.
const CELLS: usize = 256;

// A cell that no normal of a bin sees well keeps this share of its light: the table samples the cosine, and must not miss any.
const SMALLEST_COSINE: f32 = 0.01;

// A share of the light that is spread evenly over the sphere when the map is cut, so that dark regions are cut as well.
const EVEN_SHARE: f64 = 0.05;

impl NormalBin {
    /// For what reflects otherwise than by the cosine: the sky's light as such.
    pub const ANY: Self = Self((BINS * BINS) as u16);

    /// The bin of a unit normal.
    #[inline]
    pub fn of(normal: Vec3) -> Self {
        let at = octahedral(normal) * BINS as f32;
        let cell = |x: f32| (x as usize).min(BINS - 1);
        Self((cell(at.y) * BINS + cell(at.x)) as u16)
    }

    /// Normals spread over the bin.
    fn normals(self) -> impl Iterator<Item = Vec3> {
        const EDGE: usize = 4;
        let corner = Vec2::new((self.0 as usize % BINS) as f32, (self.0 as usize / BINS) as f32);
        (0..EDGE * EDGE).map(move |k| {
            let within = (Vec2::new((k % EDGE) as f32, (k / EDGE) as f32) + 0.5) / EDGE as f32;
            from_octahedral((corner + within) / BINS as f32)
        })
    }
}

/// A rectangle of texels.
#[derive(Debug, Clone, Copy)]
struct Cell {
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
    /// Where its cumulative weights start in `SkyCells::texels`: of its rows, then of the columns of each row. None for an even cell,
    /// in which all texels are drawn alike.
    table: Option<usize>,
}

/// The sampling tables of a map.
#[derive(Debug, Clone)]
pub(super) struct SkyCells {
    width: usize,
    height: usize,
    cells: Vec<Cell>,
    /// Which cell each texel lies in; `NO_CELL` for cells without light.
    cell_of: Vec<u16>,
    /// Cumulative weights of the cells, for every bin and then for `NormalBin::ANY`.
    by_normal: Vec<f32>,
    /// Cumulative weights inside the cells.
    texels: Vec<f32>,
}

// Relative deviation of texels' light up to which a cell counts as even: small beside what the cosine varies by.
const EVEN: f64 = 0.2;

const NO_CELL: u16 = u16::MAX;

impl SkyCells {
    /// `weights`: light of each texel, row by row. None without light. `direction` of a position in texels.
    pub fn new(width: usize, height: usize, weights: &[f64], direction: impl Fn(Vec2) -> Vec3) -> Option<Self> {
        let light =
            |(rows, columns): &Region| -> f64 { rows.clone().map(|r| row_of(weights, width, r, columns).iter().sum::<f64>()).sum() };
        let (lit, lights): (Vec<Region>, Vec<f64>) =
            cut(width, height, weights).into_iter().map(|r| (r.clone(), light(&r))).filter(|(_, light)| *light > 0.0).unzip();
        if lit.is_empty() {
            return None;
        }
        let (mut texels, mut cell_of) = (Vec::new(), vec![NO_CELL; width * height]);
        for (index, (rows, columns)) in lit.iter().enumerate() {
            rows.clone().for_each(|r| cell_of[r * width..][columns.clone()].fill(index as u16));
        }
        let cells: Vec<Cell> =
            lit.iter().zip(&lights).map(|(region, light)| Cell::new(region, *light, width, weights, &mut texels)).collect();
        let toward: Vec<[Vec3; 4]> = cells.iter().map(|cell| cell.directions(&direction)).collect();
        let bin = |bin: u16| {
            let normals: Vec<Vec3> = NormalBin(bin).normals().collect();
            let weights: Vec<f64> = lights.iter().zip(&toward).map(|(light, toward)| light * f64::from(cosine(&normals, toward))).collect();
            cumulate(&weights, weights.iter().sum())
        };
        let any = cumulate(&lights, lights.iter().sum());
        let by_normal = (0..NormalBin::ANY.0).flat_map(bin).chain(any).collect();
        Some(Self { width, height, cells, cell_of, by_normal, texels })
    }

    /// A position in texels and its density on the map, which has area 1.
    #[inline]
    pub fn sample(&self, bin: NormalBin, u: Vec2) -> (Vec2, f32) {
        let chosen = choose_in(self.of_bin(bin), u.x);
        let cell = &self.cells[chosen.index];
        let (within, share) = cell.sample(&self.texels, Vec2::new(chosen.rest, u.y));
        let at = Vec2::new(cell.column as f32, cell.row as f32) + within;
        (at, chosen.probability * share * (self.width * self.height) as f32)
    }

    /// The density of `sample` at a position in texels.
    #[inline]
    pub fn density(&self, bin: NormalBin, at: Vec2) -> f32 {
        let (column, row) = ((at.x as usize).min(self.width - 1), (at.y as usize).min(self.height - 1));
        let index = self.cell_of[row * self.width + column];
        if index == NO_CELL {
            return 0.0;
        }
        let cell = &self.cells[index as usize];
        let share = cell.share(&self.texels, row - cell.row, column - cell.column);
        probability(self.of_bin(bin), index as usize) * share * (self.width * self.height) as f32
    }

    fn of_bin(&self, bin: NormalBin) -> &[f32] {
        &self.by_normal[bin.0 as usize * self.cells.len()..][..self.cells.len()]
    }
}

impl Cell {
    /// `light`: of all its texels, above zero. Appends its table, unless it is even.
    fn new((rows, columns): &Region, light: f64, width: usize, weights: &[f64], texels: &mut Vec<f32>) -> Self {
        let of_row = |r: usize| row_of(weights, width, r, columns);
        let count = (rows.len() * columns.len()) as f64;
        let squares: f64 = rows.clone().flat_map(of_row).map(|w| (w * count / light - 1.0).powi(2)).sum();
        let table = ((squares / count).sqrt() > EVEN).then(|| {
            let start = texels.len();
            let sums: Vec<f64> = rows.clone().map(|r| of_row(r).iter().sum()).collect();
            texels.extend(cumulate(&sums, light));
            // A row without light is never drawn: what stands in its table does not matter.
            rows.clone().zip(&sums).for_each(|(r, sum)| texels.extend(cumulate(of_row(r), if *sum > 0.0 { *sum } else { 1.0 })));
            start
        });
        Self { row: rows.start, column: columns.start, rows: rows.len(), columns: columns.len(), table }
    }

    /// A position in texels from the cell's corner, and the probability of that texel.
    #[inline]
    fn sample(&self, texels: &[f32], u: Vec2) -> (Vec2, f32) {
        let size = Vec2::new(self.columns as f32, self.rows as f32);
        let Some(start) = self.table else { return (u * size, 1.0 / (size.x * size.y)) };
        let row = choose_in(&texels[start..][..self.rows], u.y);
        let column = choose_in(&texels[start + self.rows + row.index * self.columns..][..self.columns], u.x);
        let at = |choice: Choice| choice.index as f32 + choice.rest;
        (Vec2::new(at(column), at(row)), row.probability * column.probability)
    }

    /// The probability of a texel.
    #[inline]
    fn share(&self, texels: &[f32], row: usize, column: usize) -> f32 {
        let Some(start) = self.table else { return 1.0 / (self.rows * self.columns) as f32 };
        let columns = &texels[start + self.rows + row * self.columns..][..self.columns];
        probability(&texels[start..][..self.rows], row) * probability(columns, column)
    }

    /// Directions spread over the cell.
    fn directions(&self, direction: impl Fn(Vec2) -> Vec3) -> [Vec3; 4] {
        let at = |x: f32, y: f32| Vec2::new(self.column as f32 + x * self.columns as f32, self.row as f32 + y * self.rows as f32);
        [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)].map(|(x, y)| direction(at(x, y)))
    }
}

/// What a cell's light is weighted with: the root mean square cosine, which leaves the least variance over normals and directions.
fn cosine(normals: &[Vec3], toward: &[Vec3]) -> f32 {
    let squares: f32 = normals.iter().flat_map(|n| toward.iter().map(|d| n.dot(*d).max(0.0).powi(2))).sum();
    (squares / (normals.len() * toward.len()) as f32).sqrt().max(SMALLEST_COSINE)
}

type Region = (Range<usize>, Range<usize>);

fn row_of<'a>(weights: &'a [f64], width: usize, row: usize, columns: &Range<usize>) -> &'a [f64] {
    &weights[row * width..][columns.clone()]
}

/// Cuts the map at medians until there are `CELLS` regions, or none larger than a texel. Neighbours in the list are neighbours on the map.
fn cut(width: usize, height: usize, weights: &[f64]) -> Vec<Region> {
    let total: f64 = weights.iter().sum();
    let sine = |row: usize| f64::from((PI * (row as f32 + 0.5) / height as f32).sin());
    // ∫ sin over the rows is 2 · height / π.
    let even = EVEN_SHARE * total * f64::from(PI) / (2 * width * height) as f64;
    let spread: Vec<f64> = weights.iter().enumerate().map(|(i, w)| w + even * sine(i / width)).collect();
    let measure = |(rows, columns): &Region| -> f64 {
        let light: f64 = rows.clone().map(|r| row_of(&spread, width, r, columns).iter().sum::<f64>()).sum();
        light * f64::from(extents(rows, columns, width, height).max_element())
    };
    let whole = (0..height, 0..width);
    let mut regions = vec![(measure(&whole), whole)];
    while regions.len() < CELLS {
        let splittable = regions.iter().enumerate().filter(|(_, (_, (rows, columns)))| rows.len() * columns.len() > 1);
        let Some((largest, _)) = splittable.max_by(|a, b| a.1.0.total_cmp(&b.1.0)) else { break };
        let parts = split(&regions[largest].1, width, height, &spread);
        regions.splice(largest..=largest, parts.map(|region| (measure(&region), region)));
    }
    regions.into_iter().map(|(_, region)| region).collect()
}

/// Radians along the meridian and along the widest parallel.
fn extents(rows: &Range<usize>, columns: &Range<usize>, width: usize, height: usize) -> Vec2 {
    let polar = |row: usize| PI * row as f32 / height as f32;
    let widest = (PI / 2.0).clamp(polar(rows.start), polar(rows.end)).sin();
    Vec2::new(polar(rows.len()), TAU * columns.len() as f32 / width as f32 * widest)
}

/// Across the longer side, where half of the light lies before.
fn split((rows, columns): &Region, width: usize, height: usize, weights: &[f64]) -> [Region; 2] {
    let extents = extents(rows, columns, width, height);
    if columns.len() == 1 || rows.len() > 1 && extents.x > extents.y {
        let sums: Vec<f64> = rows.clone().map(|r| row_of(weights, width, r, columns).iter().sum()).collect();
        let at = rows.start + median(&sums);
        [(rows.start..at, columns.clone()), (at..rows.end, columns.clone())]
    } else {
        let sum = |c: usize| rows.clone().map(|r| weights[r * width + c]).sum::<f64>();
        let at = columns.start + median(&columns.clone().map(sum).collect::<Vec<_>>());
        [(rows.clone(), columns.start..at), (rows.clone(), at..columns.end)]
    }
}

/// How many of the sums, at least one and not all, come closest to half of them.
fn median(sums: &[f64]) -> usize {
    let half = 0.5 * sums.iter().sum::<f64>();
    let mut before = 0.0;
    for (index, sum) in sums.iter().enumerate() {
        if before + 0.5 * sum >= half {
            return index.clamp(1, sums.len() - 1);
        }
        before += sum;
    }
    sums.len() / 2
}
