//! Texels' models one behind the other, in pages.

use rayon::prelude::*;

use super::budget::Keeping;
use super::models::FittedTexel;
use super::summary::Tally;
use super::{FitError, ModelCode, ParameterMap, QUADS_PER_PAGE};
use crate::fitting::Flags;
use crate::textures::{Codec, EncodedPage, PageId, PixelFormat, StoreError, encode_as};

/// Takes pages in their order.
pub(super) type StorePage<'a> = dyn FnMut(PageId, EncodedPage) -> Result<(), FitError> + 'a;

// Pages that are encoded side by side.
const AT_ONCE: usize = 16;
const VALUES: usize = 4 * QUADS_PER_PAGE as usize;

/// What pages do not say.
pub(super) struct Packed {
    /// Of every texel of the map; of those that were not packed, none.
    pub codes: Vec<(ModelCode, Flags)>,
    pub tally: Tally,
    /// Texels that have a smaller model than the fit chose.
    pub reduced: u64,
}

/// Packs batches of texels, in the map's order, each with the model that `keeping` says. There is always one page.
pub(super) fn pack(
    batches: impl Iterator<Item = Result<Vec<FittedTexel>, FitError>>,
    texels: usize,
    mut keeping: Keeping,
    format: (PixelFormat, Codec),
    store: &mut StorePage<'_>,
) -> Result<Packed, FitError> {
    let mut packed = Packed { codes: vec![(ModelCode::NONE, Flags::NONE); texels], tally: Tally::new(), reduced: 0 };
    let mut pages = Pages { numbers: Vec::new(), next: 0, format };
    for batch in batches {
        for texel in batch? {
            let Some(rung) = keeping.next(&texel) else { continue };
            let code = ModelCode::from_number(rung.code).unwrap_or(ModelCode::NONE);
            packed.codes[texel.index as usize] = (code, Flags::from_bits(rung.flags));
            packed.reduced += u64::from(texel.rungs.last() != Some(rung));
            packed.tally.add(&texel, rung);
            pages.numbers.extend(rung.quads.as_flattened());
        }
        pages.store_whole(AT_ONCE, store)?;
    }
    let missing = (VALUES - pages.numbers.len() % VALUES) % VALUES;
    let is_first = pages.next == 0 && pages.numbers.is_empty();
    pages.numbers.resize(if is_first { VALUES } else { pages.numbers.len() + missing }, 0.0);
    pages.store_whole(1, store)?;
    Ok(packed)
}

struct Pages {
    numbers: Vec<f32>,
    next: u32,
    format: (PixelFormat, Codec),
}

impl Pages {
    /// Stores what whole pages there are, if there are `least`.
    fn store_whole(&mut self, least: usize, store: &mut StorePage<'_>) -> Result<(), FitError> {
        let whole = self.numbers.len() / VALUES;
        if whole < least {
            return Ok(());
        }
        let (pixel, codec) = self.format;
        let shape = ParameterMap::page_shape(pixel);
        let encoded: Vec<Result<EncodedPage, StoreError>> =
            self.numbers[..whole * VALUES].par_chunks(VALUES).map(|page| encode_as(codec, &shape, page)).collect();
        for page in encoded {
            store(PageId(self.next), page?)?;
            self.next += 1;
        }
        self.numbers.drain(..whole * VALUES);
        Ok(())
    }
}
