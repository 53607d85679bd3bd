//! The named parts of an observation map beside its pages.

use super::{MOST_OBSERVATIONS, MOST_TEXELS, MOST_TEXELS_PER_EDGE, ObservationMap, ObservationParameters, ObservedTexel, Observer};
use crate::capture::parts::{PartsError, decode, encode};

// Not a part but checked with them.
const PARAMETERS: &str = "parameters";
const SURFACE: &str = "surface";
const BACKGROUND: &str = "background";
const OBSERVERS: &str = "observers";
const TEXELS: &str = "texels";

/// The named parts to store beside the pages.
pub fn to_parts(map: &ObservationMap) -> Result<Vec<(&'static str, Vec<u8>)>, PartsError> {
    Ok(vec![
        (SURFACE, encode(SURFACE, &map.surface)?),
        (BACKGROUND, encode(BACKGROUND, &map.background)?),
        (OBSERVERS, encode(OBSERVERS, &map.observers)?),
        (TEXELS, encode(TEXELS, &map.texels)?),
    ])
}

/// Builds the map from its parameters and parts; `part(name)` gives a part's bytes, or why it cannot.
pub fn from_parts<E: From<PartsError>>(
    parameters: ObservationParameters,
    part: &dyn Fn(&'static str) -> Result<Vec<u8>, E>,
) -> Result<ObservationMap, E> {
    let map = ObservationMap {
        parameters,
        surface: decode(SURFACE, &part(SURFACE)?)?,
        background: decode(BACKGROUND, &part(BACKGROUND)?)?,
        observers: decode(OBSERVERS, &part(OBSERVERS)?)?,
        texels: decode(TEXELS, &part(TEXELS)?)?,
    };
    for (part, outcome) in [
        (PARAMETERS, check_parameters(&map.parameters, map.surface.parts)),
        (SURFACE, map.surface.check()),
        (BACKGROUND, map.background.check()),
        (OBSERVERS, check_observers(&map.observers)),
        (TEXELS, check_texels(&map)),
    ] {
        outcome.map_err(|reason| PartsError { part, reason })?;
    }
    Ok(map)
}

fn check_parameters(parameters: &ObservationParameters, parts: u32) -> Result<(), String> {
    let size = parameters.size_texels;
    let all = u64::from(parts) * u64::from(size).pow(2);
    match (1..=MOST_TEXELS_PER_EDGE).contains(&size) && all <= MOST_TEXELS {
        true => Ok(()),
        false => {
            Err(format!("{size} texels along an edge of {parts} parts, 1 to {MOST_TEXELS_PER_EDGE} and {MOST_TEXELS} in all expected"))
        }
    }
}

fn check_observers(observers: &[Observer]) -> Result<(), String> {
    if observers.is_empty() || observers.len() > MOST_OBSERVATIONS as usize {
        return Err(format!("{} observations, 1 to {MOST_OBSERVATIONS} expected", observers.len()));
    }
    let is_sound = |observer: &Observer| match observer {
        Observer::At(place) => place.is_finite(),
        Observer::Toward(direction) => direction.is_normalized(),
    };
    match observers.iter().position(|o| !is_sound(o)) {
        Some(at) => Err(format!("observation {at} is from {:?}, a finite place or a unit direction expected", observers[at])),
        None => Ok(()),
    }
}

// Indices are below the map's size and ascend in its order, so that none comes twice.
fn check_texels(map: &ObservationMap) -> Result<(), String> {
    let size = map.parameters.size_texels as usize;
    let is_sound = |t: &ObservedTexel| t.position.is_finite() && t.normal.is_normalized() && t.tangent.is_finite();
    if let Some(at) = map.texels.iter().position(|t| !is_sound(t)) {
        return Err(format!("texel {at} has no finite place and unit normal"));
    }
    let mut given = map.texels.iter().map(|t| t.index as usize).peekable();
    for part in 0..map.surface.parts as usize {
        for at in super::tiled_order(size) {
            given.next_if_eq(&(part * size * size + at));
        }
    }
    match given.next() {
        Some(index) => Err(format!("texel {index} is out of order, twice, or beyond {} parts of {size}x{size}", map.surface.parts)),
        None => Ok(()),
    }
}
