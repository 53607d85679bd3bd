//! From an observation map to a stored parameter map: every texel fitted, its model packed behind the one before.
//!
//! Pages of observations are read one batch after the other, so memory does not grow with the map. After every batch the models' numbers so
//! far are stored: a job that is killed goes on there.

use std::collections::BTreeMap;
use std::time::Instant;

use rayon::prelude::*;
use thiserror::Error;

use super::models::{AllowedModels, FittedTexel, fit_texels};
use super::storage::{NOT_YET, StoredTexels, TEXELS};
use super::{ModelCode, ParameterMap, Parameters, QUADS_PER_PAGE, TexelTable, texel_order, to_parts};
use crate::capture::PartsError;
use crate::capture::observation_map::{Observation, ObservationMap, ObservedTexel, State, TEXELS_PER_PAGE};
use crate::capture::parts::{decode, encode};
use crate::fitting::harmonics::HarmonicsFitError;
use crate::fitting::{Flags, Noise, SettingsError};
use crate::progress::{Cancelled, Progress};
use crate::textures::{Codec, Page, PageId, PixelFormat, Staging, StoreError, encode_as};

/// How to fit and store.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstructSettings {
    /// What models are allowed.
    pub models: AllowedModels,
    /// Of a dark observation, in units of radiance; None: a 1000th of the mean observation, for those that were rendered.
    pub noise_floor: Option<f32>,
    /// Of an observation, as a part of it; at least 0.
    pub relative_noise: f32,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
}

/// What came of the fits, over all texels that were observed.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct FitSummary {
    /// Texels that were fitted in this run; an earlier run's are not among them.
    pub texels: u64,
    /// Seconds of this run's fits.
    pub seconds: f64,
    /// How many texels have which model.
    pub histogram: BTreeMap<String, u64>,
    /// How many have which flag.
    pub flags: BTreeMap<&'static str, u64>,
    /// Of the fits of this run: root mean square of what the models leave of observations that are not clipped.
    pub rms_residual: f64,
}

/// Why no parameter map came of it.
#[derive(Debug, Error)]
pub enum FitError {
    /// A page of observations does not have the shape that the map announces.
    #[error("page {page} of the observations is {width}x{height}, {}x{} expected", expected.0, expected.1)]
    PageShape {
        /// Which.
        page: u32,
        /// As read.
        width: u32,
        /// As read.
        height: u32,
        /// Columns and rows.
        expected: (u32, u32),
    },
    /// No fit can be made with such models or noise.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// No fit can be made with so many harmonics.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsFitError),
    /// Models would take more numbers than can be counted.
    #[error("the models of {texels} texels take more numbers than can be counted: fewer texels or smaller models expected")]
    TooLarge {
        /// How many.
        texels: usize,
    },
    /// Asked to stop; can be resumed.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// The store refused, or the observations cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A part cannot be encoded.
    #[error(transparent)]
    Parts(#[from] PartsError),
}

// Pages of observations fitted side by side: enough for the threads, few enough to lose little when killed.
const BATCH: usize = 32;

/// Reads a page of observations.
pub type ReadObservations<'a> = dyn Fn(PageId) -> Result<std::sync::Arc<Page>, StoreError> + Sync + 'a;

/// Fits `map`, whose pages `read` gives, and fills `staging` with pages and parts; the caller publishes. Can be called again on a staging area
/// that an earlier, identical call left unfinished. `observations` names them, for people.
pub fn construct(
    map: &ObservationMap,
    read: &ReadObservations<'_>,
    observations: &str,
    settings: &ConstructSettings,
    staging: &Staging,
    progress: &dyn Progress,
) -> Result<(Parameters, FitSummary), FitError> {
    let size = map.parameters.size_texels as usize;
    let texel_count = size * size * map.surface.parts as usize;
    let mut work = Work::resume(map, settings, staging, texel_count)?;
    let (begin, pages) = (Instant::now(), map.page_count());
    let noise = Noise { floor: noise_floor(map, read, settings)?, relative: settings.relative_noise };
    let mut summary = FitSummary::default();
    let (mut squares, mut samples) = (0f64, 0u64);
    let mut page = work.first_page;
    while page < pages {
        progress.report("fitting", page as u64 * TEXELS_PER_PAGE as u64, map.texels.len() as u64);
        if progress.is_cancelled() {
            return Err(Cancelled.into());
        }
        let batch = page..pages.min(page + BATCH);
        let fitted =
            batch.clone().into_par_iter().map(|page| fit_page(map, read, page, (settings.models, noise))).collect::<Result<Vec<_>, _>>()?;
        for texel in fitted.iter().flatten() {
            work.push(texel)?;
            (squares, samples) = (squares + texel.sum_of_squares, samples + texel.samples);
            summary.texels += 1;
        }
        page = batch.end;
        work.save()?;
    }
    progress.report("fitting", map.texels.len() as u64, map.texels.len() as u64);
    summary.seconds = begin.elapsed().as_secs_f64();
    summary.rms_residual = (squares / samples.max(1) as f64).sqrt();
    let texels = work.finish(size)?;
    summary.count(&texels);
    let parameters = Parameters {
        observed: map.parameters.clone(),
        observations: observations.into(),
        models: settings.models.to_string(),
        pixel_format: settings.pixel_format,
        histogram: summary.histogram.clone(),
    };
    let fitted = ParameterMap { parameters, surface: map.surface.clone(), background: map.background.clone(), texels };
    for (name, bytes) in to_parts(&fitted)? {
        staging.put_blob(name, &bytes)?;
    }
    Ok((fitted.parameters, summary))
}

fn fit_page(
    map: &ObservationMap,
    read: &ReadObservations<'_>,
    page: usize,
    (models, noise): (AllowedModels, Noise),
) -> Result<Vec<FittedTexel>, FitError> {
    let pixels = read_page(map, read, page)?;
    let columns = map.texels_of_page(page);
    let observed =
        columns.iter().enumerate().map(|(column, texel)| (texel, observations_of(map, texel, &pixels, column))).collect::<Vec<_>>();
    fit_texels(&observed, models, noise)
}

fn read_page(map: &ObservationMap, read: &ReadObservations<'_>, page: usize) -> Result<std::sync::Arc<Page>, FitError> {
    let pixels = read(PageId(page as u32))?;
    if map.is_shaped(&pixels) {
        return Ok(pixels);
    }
    let (shape, expected) = (pixels.shape(), map.page_shape(PixelFormat::F32));
    let expected = (expected.width, expected.height);
    Err(FitError::PageShape { page: page as u32, width: shape.width, height: shape.height, expected })
}

// Quantisation and the tracer's noise are not known here: a 1000th of what is usual is less than either, and ends the search for ever larger
// models of exact data.
const FLOOR_PER_MEAN: f64 = 1e-3;
// Pages whose mean stands for the map's.
const PAGES_FOR_MEAN: usize = 16;

fn noise_floor(map: &ObservationMap, read: &ReadObservations<'_>, settings: &ConstructSettings) -> Result<f32, FitError> {
    if let Some(floor) = settings.noise_floor {
        return Ok(floor);
    }
    let (mut sum, mut count) = (0f64, 0u64);
    for page in (0..map.page_count()).step_by(map.page_count().div_ceil(PAGES_FOR_MEAN).max(1)) {
        let page = read_page(map, read, page)?;
        for texel in page.to_f32().chunks_exact(4) {
            let observation = Observation::from_texel([texel[0], texel[1], texel[2], texel[3]]);
            if observation.state != State::Missing {
                sum += observation.radiance.iter().map(|c| f64::from(c.abs())).sum::<f64>();
                count += 3;
            }
        }
    }
    let mean = sum / count.max(1) as f64;
    Ok(((FLOOR_PER_MEAN * mean) as f32).max(f32::MIN_POSITIVE.sqrt()))
}

// What was seen of a texel: direction in its frame, and the entry.
fn observations_of(map: &ObservationMap, texel: &ObservedTexel, page: &Page, column: usize) -> Vec<([f32; 3], Observation)> {
    let rows = map.observers.iter().enumerate();
    rows.map(|(row, observer)| {
        let direction = texel.direction_to(observer).to_array();
        (direction, Observation::from_texel(page.texel(column as u32, row as u32)))
    })
    .collect()
}

/// Models on their way into pages.
struct Work<'a> {
    staging: &'a Staging,
    settings: &'a ConstructSettings,
    codes: Vec<u8>,
    flags: Vec<u8>,
    size: u32,
    /// The first page of observations that is not fitted.
    first_page: usize,
    /// Pages of quads that are stored.
    stored: u32,
    /// Quad that the first of `quads` is, in the map; a multiple of a page's.
    begin: u64,
    quads: Vec<f32>,
}

impl<'a> Work<'a> {
    /// Where an earlier run stopped: at the first texel whose numbers are not all in stored pages.
    fn resume(map: &ObservationMap, settings: &'a ConstructSettings, staging: &'a Staging, texels: usize) -> Result<Self, FitError> {
        let size = map.parameters.size_texels;
        let mut codes = vec![ModelCode::NONE.number(); texels];
        map.texels.iter().for_each(|t| codes[t.index as usize] = NOT_YET);
        let mut work =
            Self { staging, settings, codes, flags: vec![0; texels], size, first_page: 0, stored: 0, begin: 0, quads: Vec::new() };
        let saved = staging.blob(TEXELS)?.map(|bytes| decode::<StoredTexels>(TEXELS, &bytes)).transpose()?;
        let Some(saved) = saved.filter(|s| s.codes.len() == texels && s.flags.len() == texels && s.size == size) else { return Ok(work) };
        work.stored = staging.pages_present().len() as u32;
        let whole = u64::from(work.stored) * u64::from(QUADS_PER_PAGE);
        let mut quad = 0;
        for (at, texel) in map.texels.iter().enumerate() {
            let index = texel.index as usize;
            let Some(code) = ModelCode::from_number(saved.codes[index]) else { break };
            // Fitting goes on at a whole page of observations.
            if at % TEXELS_PER_PAGE == 0 {
                (work.first_page, work.begin) = (at / TEXELS_PER_PAGE, quad);
            }
            quad += u64::from(code.quads());
            if quad > whole {
                break;
            }
            (work.codes[index], work.flags[index]) = (saved.codes[index], saved.flags[index]);
        }
        // What is in front of that in its page of quads is stored already; zeros stand for it.
        let within = work.begin % u64::from(QUADS_PER_PAGE);
        work.begin -= within;
        work.quads = vec![0.0; 4 * within as usize];
        Ok(work)
    }

    fn push(&mut self, texel: &FittedTexel) -> Result<(), FitError> {
        let index = texel.index as usize;
        (self.codes[index], self.flags[index]) = (texel.code.number(), texel.flags.bits());
        self.quads.extend(texel.quads.as_flattened());
        while self.quads.len() >= 4 * QUADS_PER_PAGE as usize {
            self.store_page()?;
        }
        Ok(())
    }

    fn store_page(&mut self) -> Result<(), FitError> {
        let shape = ParameterMap::page_shape(self.settings.pixel_format);
        let rest = self.quads.split_off(self.quads.len().min(shape.values()));
        let mut page = std::mem::replace(&mut self.quads, rest);
        page.resize(shape.values(), 0.0);
        let number = (self.begin / u64::from(QUADS_PER_PAGE)) as u32;
        self.begin += u64::from(QUADS_PER_PAGE);
        if number >= self.stored {
            self.staging.append_encoded(PageId(number), &encode_as(self.settings.codec, &shape, &page)?)?;
            self.stored = number + 1;
        }
        Ok(())
    }

    fn save(&self) -> Result<(), FitError> {
        let stored = StoredTexels { size: self.size, codes: self.codes.clone(), flags: self.flags.clone() };
        self.staging.put_blob(TEXELS, &encode(TEXELS, &stored)?)?;
        Ok(())
    }

    fn finish(mut self, size: usize) -> Result<TexelTable, FitError> {
        if !self.quads.is_empty() || self.begin == 0 {
            self.store_page()?;
        }
        let known = |(code, flags): (&u8, &u8)| (ModelCode::from_number(*code).unwrap_or(ModelCode::NONE), Flags::from_bits(*flags));
        let pairs: Vec<(ModelCode, Flags)> = self.codes.iter().zip(&self.flags).map(known).collect();
        TexelTable::new(size, &pairs).ok_or(FitError::TooLarge { texels: pairs.len() })
    }
}

impl FitSummary {
    fn count(&mut self, table: &TexelTable) {
        for at in texel_order(table.size, table.texels.len()) {
            let texel = table.texels[at];
            if texel.code == ModelCode::NONE {
                continue;
            }
            *self.histogram.entry(texel.code.name()).or_default() += 1;
            for (flag, name) in
                [(Flags::UNRESOLVED, "unresolved"), (Flags::CLIPPED, "clipped"), (Flags::OUTLIERS, "outliers"), (Flags::MISFIT, "misfit")]
            {
                *self.flags.entry(name).or_default() += u64::from(texel.flags.contains(flag));
            }
        }
    }
}
