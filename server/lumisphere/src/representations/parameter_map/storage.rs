//! The bytes of a parameter map: three named parts beside the pages of quads, and the parameters in the manifest.

use serde::{Deserialize, Serialize};

use super::{ModelCode, ParameterMap, Parameters, TexelTable};
use crate::capture::observation_map::MOST_TEXELS_PER_EDGE;
use crate::capture::parts::{PartsError, decode, encode};
use crate::fitting::Flags;

const SURFACE: &str = "surface";
const BACKGROUND: &str = "background";
const TEXELS: &str = "texels";

/// [`TexelTable`] without what follows from it.
#[derive(Serialize, Deserialize)]
struct StoredTexels {
    size: u32,
    codes: Vec<u8>,
    flags: Vec<u8>,
}

/// The named parts to store beside the pages.
pub fn to_parts(map: &ParameterMap) -> Result<Vec<(&'static str, Vec<u8>)>, PartsError> {
    let texels = &map.texels.texels;
    let stored = StoredTexels {
        size: map.texels.size as u32,
        codes: texels.iter().map(|t| t.code.number()).collect(),
        flags: texels.iter().map(|t| t.flags.bits()).collect(),
    };
    Ok(vec![
        (SURFACE, encode(SURFACE, &map.surface)?),
        (BACKGROUND, encode(BACKGROUND, &map.background)?),
        (TEXELS, encode(TEXELS, &stored)?),
    ])
}

/// Builds the representation from its parameters and parts; `part(name)` gives a part's bytes, or why it cannot.
pub fn from_parts<E: From<PartsError>>(
    parameters: Parameters,
    part: &dyn Fn(&'static str) -> Result<Vec<u8>, E>,
) -> Result<ParameterMap, E> {
    let surface: crate::capture::SurfaceMesh = decode(SURFACE, &part(SURFACE)?)?;
    let stored: StoredTexels = decode(TEXELS, &part(TEXELS)?)?;
    let texels = table(&stored, surface.parts).map_err(|reason| PartsError { part: TEXELS, reason })?;
    let map = ParameterMap { parameters, surface, background: decode(BACKGROUND, &part(BACKGROUND)?)?, texels };
    for (part, outcome) in [(SURFACE, map.surface.check()), (BACKGROUND, map.background.check())] {
        outcome.map_err(|reason| PartsError { part, reason })?;
    }
    Ok(map)
}

fn table(stored: &StoredTexels, parts: u32) -> Result<TexelTable, String> {
    let StoredTexels { size, codes, flags } = stored;
    if !(1..=MOST_TEXELS_PER_EDGE).contains(size) {
        return Err(format!("{size} texels along an edge, 1 to {MOST_TEXELS_PER_EDGE} expected"));
    }
    let expected = u64::from(*size).pow(2) * u64::from(parts);
    if (codes.len() as u64, flags.len() as u64) != (expected, expected) {
        return Err(format!("{} models and {} flags for {parts} parts of {size}x{size}", codes.len(), flags.len()));
    }
    let known = |number: &u8| ModelCode::from_number(*number).ok_or(format!("a texel has model {number}, which does not exist"));
    let codes: Vec<ModelCode> = codes.iter().map(known).collect::<Result<_, _>>()?;
    let pairs: Vec<(ModelCode, Flags)> = codes.into_iter().zip(flags.iter().map(|bits| Flags::from_bits(*bits))).collect();
    TexelTable::new(*size as usize, &pairs).ok_or("more numbers than can be counted".into())
}
