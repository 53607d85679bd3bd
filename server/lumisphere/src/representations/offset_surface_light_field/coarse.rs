//! The coarse levels on the device: every cube map's faces from one level of its pyramid on, small enough to be always resident. What covers
//! as many texels reads them and asks for no page; for pages that are not there they stand in.

use std::sync::Arc;

use rayon::prelude::*;

use super::OffsetSurfaceLightField;
use crate::capture::{halved, with_sky_shares};
use crate::directions::FACES;
use crate::representations::RenderError;
use crate::representations::page_source::CountingSource;
use crate::textures::{Page, PageId, PageShape, PixelFormat};

/// The coarse levels take at most this part of the budget: the first is as coarse as that asks for. (Slots of large faces are large: below
/// sixteen of them there are none.)
const BUDGET_SHARE: u64 = 16;
/// The finest faces that are always resident: 1/64 of faces of 128², and they show where light comes from.
const MOST_TEXELS: u32 = 16;

/// Which levels are always resident, and where: 4ˡ faces of level l fill a slot, row by row, in the order of the faces of level 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Coarse {
    /// The finest of them; one more than the coarsest level of all where none is.
    pub level: u32,
    /// That they fill.
    pub slots: usize,
}

impl Coarse {
    /// For slots of `pixel`s and a budget for all of them.
    pub fn planned(field: &OffsetSurfaceLightField, pixel: PixelFormat, budget_bytes: u64) -> Self {
        let levels = 1..=field.parameters.coarser_levels;
        // With its levels of detail a slot takes up to a third more.
        let slot_bytes = 4 * pixel.bytes() as u64 * u64::from(field.parameters.face_size_texels).pow(2) * 4 / 3;
        let plan = |level| Self { level, slots: field.face_count().div_ceil(1 << (2 * level)) };
        let fits = |plan: &Self| plan.slots as u64 * slot_bytes <= budget_bytes / BUDGET_SHARE;
        // The coarsest of all, at least, where sizes cannot be halved so far.
        let coarsest = field.parameters.coarser_levels;
        let small = levels.filter(|level| field.level_size(*level) <= MOST_TEXELS || *level == coarsest);
        small.map(plan).find(fits).unwrap_or(Self { level: field.parameters.coarser_levels + 1, slots: 0 })
    }

    /// Whether there are any.
    pub fn exists(self) -> bool {
        self.slots > 0
    }

    /// How many levels pages of level 0 hold themselves, the finest included.
    pub fn levels_before(self) -> u32 {
        self.level
    }

    /// What every slot holds: the finest of the coarse levels, R, G, B and share of sky (0 where none is stored), of `pixel`'s format; the
    /// coarser ones follow by halving.
    pub fn read(self, field: &OffsetSurfaceLightField, pixel: PixelFormat, pages: &CountingSource<'_>) -> Result<Vec<Page>, RenderError> {
        let read = |cube: usize| read_level(field, cube, self.level, pages);
        let cubes: Vec<Arc<Page>> = (0..field.cube_count()).into_par_iter().map(read).collect::<Result<_, _>>()?;
        let edge = field.parameters.face_size_texels;
        let shape = PageShape { width: edge, height: edge, channels: 4, pixel };
        (0..self.slots).into_par_iter().map(|slot| Ok(Page::from_f32(shape, &self.assemble(field, slot, &cubes))?)).collect()
    }

    // The texels of a slot; those of no face are 0.
    fn assemble(self, field: &OffsetSurfaceLightField, slot: usize, cubes: &[Arc<Page>]) -> Vec<f32> {
        let (edge, size) = (field.parameters.face_size_texels as usize, field.level_size(self.level));
        let per_edge = 1 << self.level;
        let mut values = vec![0f32; 4 * edge * edge];
        let first = slot * per_edge * per_edge;
        for face in first..field.face_count().min(first + per_edge * per_edge) {
            let place = face - first;
            let (left, top) = (place % per_edge * size as usize, place / per_edge * size as usize);
            for (row, column) in (0..size).flat_map(|r| (0..size).map(move |c| (r, c))) {
                let texel = cubes[face / FACES].texel(column, (face % FACES) as u32 * size + row);
                let at = 4 * ((top + row as usize) * edge + left + column as usize);
                values[at..at + 4].copy_from_slice(&texel);
            }
        }
        values
    }
}

fn read_level(field: &OffsetSurfaceLightField, cube: usize, level: u32, pages: &CountingSource<'_>) -> Result<Arc<Page>, RenderError> {
    let number = field.level_page(cube, level);
    let page = pages.page(PageId(number))?;
    field.check_page(number, page.shape())?;
    Ok(page)
}

/// A face and `levels − 1` coarser levels of it, which hold shares of sky in place of its distances.
pub(super) fn with_levels_of_a_face(face: Arc<Page>, levels: u32) -> Result<Vec<Arc<Page>>, RenderError> {
    if levels < 2 {
        return Ok(vec![face]);
    }
    let mut pages = with_levels(Arc::new(with_sky_shares(&face)?), levels)?;
    pages[0] = face;
    Ok(pages)
}

/// A square page of four channels and `levels − 1` halvings of it.
pub(super) fn with_levels(page: Arc<Page>, levels: u32) -> Result<Vec<Arc<Page>>, RenderError> {
    let mut pages = vec![page];
    for level in 1..levels as usize {
        pages.push(Arc::new(halved(&pages[level - 1], 4)?));
    }
    Ok(pages)
}
