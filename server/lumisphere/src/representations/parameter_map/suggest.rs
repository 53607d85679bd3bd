//! Which directions to photograph next: a few hundred texels of a fitted map, what was seen of them, and `fitting::suggest`.
//!
//! Who calls it: a server's job, for a map and the observations that it was fitted to. Where it fails: what hides a texel from a direction is not
//! looked at, its horizon is; and a texel stands for its neighbours.

use std::sync::Arc;

use glam::{Mat3, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

use super::models::residual;
use super::{ModelCode, ParameterMap};
use crate::capture::observation_map::{
    Coverage, Observation, ObservationMap, ObservedTexel, State, TEXELS_PER_PAGE, directions_about, mean_normal,
};
use crate::directions::Scheme;
use crate::fitting::suggest::{KnownTexel, suggest};
use crate::fitting::{Model, spread};
use crate::progress::{Cancelled, Progress};
use crate::textures::{Page, PageId, StoreError};

/// What to choose from.
#[derive(Debug, Clone, PartialEq)]
pub struct SuggestSettings {
    /// How many directions, 1 to [`MOST_SUGGESTIONS`].
    pub count: usize,
    /// Directions to choose from, about `axis`: at most [`MOST_CANDIDATES`], opposites included.
    pub candidates: Scheme,
    /// Whether their opposites may be chosen, too.
    pub coverage: Coverage,
    /// The scheme's zenith, unit; None: the surface's mean normal, or +Y where there is none.
    pub axis: Option<Vec3>,
}

/// Most directions of one answer.
pub const MOST_SUGGESTIONS: usize = 64;
/// Most directions to choose from: what is held of each is some hundred kilobytes.
pub const MOST_CANDIDATES: usize = 2600;
// Texels that stand for the map.
const TEXELS: usize = 256;

/// What to photograph next.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Suggestions {
    /// Best first.
    pub directions: Vec<SuggestedDirection>,
    /// The scheme's zenith, world space.
    pub axis: [f32; 3],
    /// How many directions there were to choose from.
    pub candidates: usize,
    /// How many texels were asked.
    pub texels: usize,
}

/// A direction to photograph from.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SuggestedDirection {
    /// From the surface to the camera: unit, world space.
    pub direction: [f32; 3],
    /// Information that a photograph from there is expected to add to those before it: nats a texel.
    pub gain_nats: f64,
}

/// Why nothing is suggested.
#[derive(Debug, Error)]
pub enum SuggestError {
    /// The map was not fitted to these observations.
    #[error("the parameter map was fitted to {}, other observations than these", .0)]
    OtherObservations(String),
    /// A setting out of range.
    #[error("{setting} is {value}, {expected} expected")]
    Setting {
        /// Which.
        setting: &'static str,
        /// As given.
        value: String,
        /// What would do.
        expected: String,
    },
    /// No texel has a model.
    #[error("no texel of the parameter map has a model")]
    NoModels,
    /// A page does not have the shape that its map announces.
    #[error("page {page} of the {of} is {width}x{height}, which its map does not announce")]
    PageShape {
        /// "observations" or "models".
        of: &'static str,
        /// Which.
        page: u32,
        /// As read.
        width: u32,
        /// As read.
        height: u32,
    },
    /// Asked to stop.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// A page cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// A dataset version and how its pages are read.
pub struct Paged<'a, T> {
    /// What it is.
    pub map: &'a T,
    /// Reads a page.
    pub read: &'a super::ReadObservations<'a>,
}

/// The directions that would tell most of the models of `fitted`, which was fitted to `observed`.
pub fn suggest_directions(
    fitted: &Paged<'_, ParameterMap>,
    observed: &Paged<'_, ObservationMap>,
    settings: &SuggestSettings,
    progress: &dyn Progress,
) -> Result<Suggestions, SuggestError> {
    check(fitted.map, observed.map, settings)?;
    let axis = settings.axis.unwrap_or_else(|| mean_normal(&observed.map.surface));
    let candidates: Vec<[f32; 3]> =
        directions_about(&settings.candidates, settings.coverage, axis).into_iter().map(|d| d.to_array()).collect();
    let has_model = |place: &usize| fitted.map.texels.texels[observed.map.texels[*place].index as usize].code != ModelCode::NONE;
    let places: Vec<usize> = (0..observed.map.texels.len()).filter(has_model).collect();
    let chosen: Vec<usize> = spread(places.len().min(TEXELS), places.len()).map(|at| places[at]).collect();
    let mut texels = Vec::new();
    for (done, place) in chosen.iter().enumerate() {
        progress.report("reading texels", done as u64, chosen.len() as u64);
        if progress.is_cancelled() {
            return Err(Cancelled.into());
        }
        texels.extend(known(fitted, observed, *place)?);
    }
    if texels.is_empty() {
        return Err(SuggestError::NoModels);
    }
    progress.report("choosing directions", 0, 1);
    let known: Vec<KnownTexel<'_>> = texels.par_iter().map(Known::as_texel).collect();
    let directions = suggest(&known, &candidates, settings.count);
    let directions = directions.iter().map(|s| SuggestedDirection { direction: s.direction, gain_nats: s.gain }).collect();
    Ok(Suggestions { directions, axis: axis.to_array(), candidates: candidates.len(), texels: texels.len() })
}

fn check(fitted: &ParameterMap, observed: &ObservationMap, settings: &SuggestSettings) -> Result<(), SuggestError> {
    let is_same = fitted.parameters.observed == observed.parameters
        && fitted.surface == observed.surface
        && fitted.texels.texels.len() == observed.surface.parts as usize * (observed.parameters.size_texels as usize).pow(2);
    if !is_same {
        return Err(SuggestError::OtherObservations(fitted.parameters.observations.clone()));
    }
    let within = |setting, value: usize, most: usize| match (1..=most).contains(&value) {
        true => Ok(()),
        false => Err(SuggestError::Setting { setting, value: value.to_string(), expected: format!("1 to {most}") }),
    };
    within("number of directions", settings.count, MOST_SUGGESTIONS)?;
    within("number of candidates", settings.candidates.count().saturating_mul(settings.coverage.sides()), MOST_CANDIDATES)?;
    match settings.axis {
        Some(axis) if !axis.is_normalized() => {
            Err(SuggestError::Setting { setting: "axis", value: axis.to_string(), expected: "a unit vector".into() })
        }
        Some(_) | None => Ok(()),
    }
}

struct Known {
    model: Model,
    directions: Vec<[f32; 3]>,
    local_from_world: Mat3,
    noise: f32,
}

impl Known {
    fn as_texel(&self) -> KnownTexel<'_> {
        KnownTexel { model: &self.model, directions: &self.directions, local_from_shared: self.local_from_world, noise: self.noise }
    }
}

// A texel's model and where it was seen, clipped or not; None where it has no model.
fn known(fitted: &Paged<'_, ParameterMap>, observed: &Paged<'_, ObservationMap>, place: usize) -> Result<Option<Known>, SuggestError> {
    let texel = &observed.map.texels[place];
    let Some(model) = model(fitted, texel)? else { return Ok(None) };
    let page = (place / TEXELS_PER_PAGE) as u32;
    let pixels = (observed.read)(PageId(page))?;
    if !observed.map.is_shaped(&pixels) {
        return Err(shape("observations", page, &pixels));
    }
    let column = (place % TEXELS_PER_PAGE) as u32;
    let seen = observed
        .map
        .observers
        .iter()
        .enumerate()
        .map(|(row, observer)| (texel.direction_to(observer).to_array(), Observation::from_texel(pixels.texel(column, row as u32))));
    let (mut directions, mut squares, mut whole) = (Vec::new(), 0.0, 0);
    for entry in seen.filter(|(direction, entry)| direction[2] > 0.0 && entry.state != State::Missing) {
        directions.push(entry.0);
        // What a clipped value should be is not known.
        if let Some(residual) = residual(&model, &entry) {
            (squares, whole) = (squares + residual, whole + 1);
        }
    }
    let noise = (squares / (3 * whole).max(1) as f64).sqrt() as f32;
    let frame = texel.frame();
    let local_from_world = Mat3::from_cols_array_2d(&[Vec3::X, Vec3::Y, Vec3::Z].map(|world| frame.local_from_world(world).to_array()));
    Ok(Some(Known { model, directions, local_from_world, noise }))
}

fn model(fitted: &Paged<'_, ParameterMap>, texel: &ObservedTexel) -> Result<Option<Model>, SuggestError> {
    let entry = fitted.map.texels.texels[texel.index as usize];
    let (mut page, mut quads): (Option<(u32, Arc<Page>)>, _) = (None, Vec::new());
    for quad in entry.first_quad..entry.first_quad + entry.code.quads() {
        let (at, column, row) = ParameterMap::place(quad);
        let pixels = match page.take() {
            Some((read, pixels)) if read == at.0 => pixels,
            _ => (fitted.read)(at)?,
        };
        if pixels.shape() != ParameterMap::page_shape(fitted.map.parameters.pixel_format) {
            return Err(shape("models", at.0, &pixels));
        }
        quads.push(pixels.texel(column, row));
        page = Some((at.0, pixels));
    }
    Ok(entry.code.unpack(&quads))
}

fn shape(of: &'static str, page: u32, pixels: &Page) -> SuggestError {
    SuggestError::PageShape { of, page, width: pixels.shape().width, height: pixels.shape().height }
}
