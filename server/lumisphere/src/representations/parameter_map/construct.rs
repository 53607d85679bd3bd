//! From an observation map to a stored parameter map: every texel fitted, its model packed behind the one before.
//!
//! Pages of observations are read one batch after the other, so memory does not grow with the map. Every batch's models are kept with the staging
//! area: a job that is killed goes on behind them, and what there is can be seen meanwhile ([`PartialMap`]). With all of them there, a bound on bytes
//! says which models have to be smaller (`budget.rs`); then they are packed (`packed_pages.rs`).

use std::time::Instant;

use rayon::prelude::*;
use thiserror::Error;

use super::budget::{Keeping, Savings};
use super::kept_models::KeptModels;
use super::models::{AllowedModels, FittedTexel, HowToFit, Observed, Rungs, Solver, fit_texels};
use super::packed_pages::{Packed, StorePage, pack};
use super::registration::{Comparison, Registration, Tile};
use super::summary::{BudgetReport, FitSummary, Tally};
use super::{ModelCode, ParameterMap, Parameters, PartialFit, TexelTable, to_parts};
use crate::capture::PartsError;
use crate::capture::observation_map::{Observation, ObservationMap, ObservedTexel, State, TEXELS_PER_PAGE};
#[cfg(feature = "gpu")]
use crate::fitting::DeviceFitError;
use crate::fitting::harmonics::HarmonicsFitError;
use crate::fitting::{Model, Noise, Outliers, Precision, SettingsError, spread};
#[cfg(feature = "gpu")]
use crate::gpu::GpuError;
use crate::progress::{Cancelled, Progress, Unattended};
use crate::textures::{Codec, Page, PageId, PixelFormat, Staging, StoreError};

/// How to fit and store.
#[derive(Debug, Clone, PartialEq)]
pub struct ConstructSettings {
    /// What models are allowed.
    pub models: AllowedModels,
    /// Of a dark observation, in units of radiance; None: a 1000th of the mean observation, for those that were rendered.
    pub noise_floor: Option<f32>,
    /// Of an observation, as a part of it; at least 0.
    pub relative_noise: f32,
    /// What becomes of observations that stand alone against their neighbours. Harmonics keep them.
    pub outliers: Outliers,
    /// Of lobes' last digits.
    pub precision: Precision,
    /// All that the version stores may take no more: models are as small as that asks for.
    pub max_bytes: Option<u64>,
    /// How pages hold numbers.
    pub pixel_format: PixelFormat,
    /// How pages are packed.
    pub codec: Codec,
}

/// What is fitted.
pub struct FitSource<'a> {
    /// Where what was seen.
    pub map: &'a ObservationMap,
    /// Reads a page of observations.
    pub read: &'a ReadObservations<'a>,
    /// Dataset and version, for people.
    pub name: &'a str,
    /// What the caller will store beside the map, at most.
    pub beside_bytes: u64,
    /// What fits single lobes.
    pub solver: Solver,
}

/// Reads a page of observations.
pub type ReadObservations<'a> = dyn Fn(PageId) -> Result<std::sync::Arc<Page>, StoreError> + Sync + 'a;

/// Whoever follows a fit; asked and told between two batches.
pub trait FollowFit: Progress {
    /// What came of the texels so far, an earlier run's included.
    fn fitted(&self, so_far: &FitSummary);
    /// A map of the texels so far could be stored now.
    fn offer(&self, partial: &PartialMap<'_>) -> Result<(), FitError>;
}

impl FollowFit for Unattended {
    fn fitted(&self, _so_far: &FitSummary) {}
    fn offer(&self, _partial: &PartialMap<'_>) -> Result<(), FitError> {
        Ok(())
    }
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
    /// The graphics device that was to fit is lost, out of memory, or answers with what is no lobe.
    #[cfg(feature = "gpu")]
    #[error("the fit's graphics device: {0}")]
    Device(GpuError),
    /// No fit can be made with so many harmonics.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsFitError),
    /// Models would take more numbers than can be counted.
    #[error("the models of {texels} texels take more numbers than can be counted: fewer texels or smaller models expected")]
    TooLarge {
        /// How many.
        texels: usize,
    },
    /// Not even the smallest models fit.
    #[error("{max_bytes} bytes for a map that takes {least} with the smallest model at every texel: at least {least} expected")]
    MaxBytes {
        /// The bound.
        max_bytes: u64,
        /// What is possible.
        least: u64,
    },
    /// Models that were kept are gone, or were damaged, before they were packed.
    #[error("the kept models of batch {batch} are gone or damaged; fitting again makes them anew")]
    Lost {
        /// Of texels, in the map's order.
        batch: usize,
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

#[cfg(feature = "gpu")]
impl From<DeviceFitError> for FitError {
    fn from(error: DeviceFitError) -> Self {
        match error {
            DeviceFitError::Settings(error) => Self::Settings(error),
            DeviceFitError::Device(error) => Self::Device(error),
        }
    }
}

// Pages of observations fitted side by side: enough for the threads, few enough to lose little when killed.
const BATCH: usize = 32;
// Sizes that are tried for a bound on bytes lie so many parts of what can be saved apart.
const SIZES: u64 = 1 << 12;
// Pages whose texels say whether photographs lie on each other: two thousand texels are enough.
const PAGES_COMPARED: usize = 32;

/// Those of a map's pages.
pub(super) fn compared_pages(pages: usize) -> impl Iterator<Item = usize> {
    spread(pages.min(PAGES_COMPARED), pages)
}

/// Fits what `source` has and fills `staging` with pages and parts; the caller publishes. Can be called again on a staging area that an earlier,
/// identical call left unfinished.
pub fn construct(
    source: &FitSource<'_>,
    settings: &ConstructSettings,
    staging: &Staging,
    follow: &dyn FollowFit,
) -> Result<(Parameters, FitSummary), FitError> {
    let fit = Fit { source, settings, models: KeptModels { staging } };
    let how = fit.how()?;
    let (of_this_run, seconds) = fit.all(&how, follow)?;
    let registration = Some(fit.registration(how.noise, follow)?);
    let (keeping, budget) = fit.choose(follow)?;
    follow.report("packing", 0, 1);
    let (parameters, packed) = fit.store(fit.batches(), keeping, staging, None)?;
    let budget = budget.map(|(bytes, before)| BudgetReport { bytes, texels_reduced: packed.reduced, ..before });
    Ok((parameters, FitSummary { registration, budget, ..packed.tally.summary(of_this_run, seconds) }))
}

/// Models of the first texels, while others are still to be fitted.
pub struct PartialMap<'a> {
    fit: &'a Fit<'a>,
    batches: usize,
}

impl PartialMap<'_> {
    /// Fills another staging area with a map of them; the other texels have no model.
    pub fn store(&self, staging: &Staging) -> Result<Parameters, FitError> {
        let map = self.fit.source.map;
        let fitted = map.texels.len().min(self.batches * BATCH * TEXELS_PER_PAGE) as u64;
        let partial = PartialFit { texels_fitted: fitted, texels: map.texels.len() as u64 };
        Ok(self.fit.store(self.batches, Keeping::ALL, staging, Some(partial))?.0)
    }
}

/// One fit of one map.
struct Fit<'a> {
    source: &'a FitSource<'a>,
    settings: &'a ConstructSettings,
    models: KeptModels<'a>,
}

impl Fit<'_> {
    fn batches(&self) -> usize {
        self.source.map.page_count().div_ceil(BATCH)
    }

    fn texels(&self) -> usize {
        let size = self.source.map.parameters.size_texels as usize;
        size * size * self.source.map.surface.parts as usize
    }

    fn how(&self) -> Result<HowToFit, FitError> {
        let settings = self.settings;
        Ok(HowToFit {
            models: settings.models,
            noise: Noise { floor: self.noise_floor()?, relative: settings.relative_noise },
            outliers: settings.outliers,
            precision: settings.precision,
            rungs: if settings.max_bytes.is_some() { Rungs::AndSmaller } else { Rungs::Chosen },
        })
    }

    /// Fits what no earlier run has; how many texels, in how many seconds.
    fn all(&self, how: &HowToFit, follow: &dyn FollowFit) -> Result<(u64, f64), FitError> {
        let map = self.source.map;
        let (mut tally, mut of_this_run, mut seconds) = (Tally::new(), 0, 0.0);
        for batch in 0..self.batches() {
            let (done, total) = ((batch * BATCH * TEXELS_PER_PAGE) as u64, map.texels.len() as u64);
            follow.report("fitting", done.min(total), total);
            if follow.is_cancelled() {
                return Err(Cancelled.into());
            }
            let known = self.models.read(batch)?;
            let is_new = known.is_none();
            let texels = match known {
                Some(texels) => texels,
                None => {
                    let begun = Instant::now();
                    let texels = self.batch(batch, how)?;
                    (of_this_run, seconds) = (of_this_run + texels.len() as u64, seconds + begun.elapsed().as_secs_f64());
                    self.models.keep(batch, &texels)?;
                    texels
                }
            };
            texels.iter().filter_map(|t| Some((t, t.rungs.last()?))).for_each(|(texel, rung)| tally.add(texel, rung));
            follow.fitted(&tally.summary(of_this_run, seconds));
            if is_new && batch + 1 < self.batches() {
                follow.offer(&PartialMap { fit: self, batches: batch + 1 })?;
            }
        }
        follow.report("fitting", map.texels.len() as u64, map.texels.len() as u64);
        Ok((of_this_run, seconds))
    }

    /// What `all` has kept.
    fn kept(&self, batch: usize) -> Result<Vec<FittedTexel>, FitError> {
        self.models.read(batch)?.ok_or(FitError::Lost { batch })
    }

    fn batch(&self, batch: usize, how: &HowToFit) -> Result<Vec<FittedTexel>, FitError> {
        let solver = &self.source.solver;
        let pages = (batch * BATCH..self.source.map.page_count().min((batch + 1) * BATCH)).into_par_iter();
        match solver {
            Solver::Processor => {
                let fitted = pages.map(|page| fit_texels(&self.page(page)?, how, solver)).collect::<Result<Vec<_>, _>>()?;
                Ok(fitted.into_iter().flatten().collect())
            }
            // All at once: a device wants many.
            #[cfg(feature = "gpu")]
            Solver::Device(_) => {
                let observed = pages.map(|page| self.page(page)).collect::<Result<Vec<_>, _>>()?;
                fit_texels(&observed.into_iter().flatten().collect::<Vec<_>>(), how, solver)
            }
        }
    }

    fn page(&self, page: usize) -> Result<Vec<Observed<'_>>, FitError> {
        let (map, pixels) = (self.source.map, self.read(page)?);
        let columns = map.texels_of_page(page).iter().enumerate();
        Ok(columns.map(|(column, texel)| (texel, observations_of(map, texel, &pixels, column))).collect())
    }

    /// Which photographs lie beside the others, by some pages' models.
    fn registration(&self, noise: Noise, follow: &dyn FollowFit) -> Result<Registration, FitError> {
        let (map, compared) = (self.source.map, self.source.map.page_count().min(PAGES_COMPARED));
        let mut comparison = Comparison::new(map.observers.len(), noise);
        for (done, page) in compared_pages(map.page_count()).enumerate() {
            follow.report("comparing photographs", done as u64, compared as u64);
            if follow.is_cancelled() {
                return Err(Cancelled.into());
            }
            let (pixels, kept, first) = (self.read(page)?, self.kept(page / BATCH)?, page % BATCH * TEXELS_PER_PAGE);
            let texels = map.texels_of_page(page);
            let model = |texel: &FittedTexel| texel.rungs.last().and_then(|rung| ModelCode::from_number(rung.code)?.unpack(&rung.quads));
            let models: Vec<Option<Model>> = kept.iter().skip(first).take(texels.len()).map(model).collect();
            let seen = |column: usize, row: usize| {
                let direction = texels[column].direction_to(&map.observers[row]).to_array();
                (direction, Observation::from_texel(pixels.texel(column as u32, row as u32)))
            };
            comparison.add(&Tile { texels, models: &models, size: map.parameters.size_texels, seen: &seen });
        }
        Ok(comparison.report())
    }

    fn read(&self, page: usize) -> Result<std::sync::Arc<Page>, FitError> {
        let (map, pixels) = (self.source.map, (self.source.read)(PageId(page as u32))?);
        if map.is_shaped(&pixels) {
            return Ok(pixels);
        }
        let (shape, expected) = (pixels.shape(), map.page_shape(PixelFormat::F32));
        let expected = (expected.width, expected.height);
        Err(FitError::PageShape { page: page as u32, width: shape.width, height: shape.height, expected })
    }

    fn noise_floor(&self) -> Result<f32, FitError> {
        if let Some(floor) = self.settings.noise_floor {
            return Ok(floor);
        }
        let (mut sum, mut count, pages) = (0f64, 0u64, self.source.map.page_count());
        for page in (0..pages).step_by(pages.div_ceil(PAGES_FOR_MEAN).max(1)) {
            for texel in self.read(page)?.to_f32().chunks_exact(4) {
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

    /// Which models are kept; with a bound, the bytes that they take, and what all would.
    fn choose(&self, follow: &dyn FollowFit) -> Result<(Keeping, Option<(u64, BudgetReport)>), FitError> {
        let Some(max_bytes) = self.settings.max_bytes else { return Ok((Keeping::ALL, None)) };
        let mut savings = Savings::new();
        for batch in 0..self.batches() {
            self.kept(batch)?.iter().for_each(|texel| savings.add(texel));
        }
        let (bytes_before, rms_residual_before) = self.measure(Keeping::ALL)?;
        let before = BudgetReport { max_bytes, bytes_before, rms_residual_before, ..BudgetReport::default() };
        if bytes_before <= max_bytes {
            return Ok((Keeping::ALL, Some((bytes_before, before))));
        }
        let keeping = |size: u64| savings.keeping(savings.least() + (savings.all - savings.least()) * size / SIZES);
        // Bytes follow quads; the largest size that fits is sought between one that does and one that does not.
        let (mut fits, mut bytes, mut too_large) = (0, self.measure(keeping(0))?.0, SIZES);
        if bytes > max_bytes {
            return Err(FitError::MaxBytes { max_bytes, least: bytes });
        }
        while too_large - fits > 1 {
            follow.report("choosing models", u64::from(SIZES.ilog2() - (too_large - fits).ilog2()), u64::from(SIZES.ilog2()));
            if follow.is_cancelled() {
                return Err(Cancelled.into());
            }
            let middle = u64::midpoint(fits, too_large);
            let measured = self.measure(keeping(middle))?.0;
            if measured <= max_bytes { (fits, bytes) = (middle, measured) } else { too_large = middle }
        }
        Ok((keeping(fits), Some((bytes, before))))
    }

    /// Bytes of a version with these models, and the residual that they leave.
    fn measure(&self, keeping: Keeping) -> Result<(u64, f64), FitError> {
        let mut bytes = self.source.beside_bytes;
        let packed = self.pack(self.batches(), keeping, &mut |_, page| {
            bytes += page.stored_bytes();
            Ok(())
        })?;
        let parts = to_parts(&self.map(&packed, None)?)?;
        Ok((bytes + parts.iter().map(|(_, part)| part.len() as u64).sum::<u64>(), packed.tally.rms_residual()))
    }

    /// Pages and parts of the first batches' models.
    fn store(
        &self,
        batches: usize,
        keeping: Keeping,
        staging: &Staging,
        partial: Option<PartialFit>,
    ) -> Result<(Parameters, Packed), FitError> {
        let present = staging.pages_present();
        let packed = self.pack(batches, keeping, &mut |page, encoded| {
            if !present.contains(&page) {
                staging.append_encoded(page, &encoded)?;
            }
            Ok(())
        })?;
        let map = self.map(&packed, partial)?;
        for (name, bytes) in to_parts(&map)? {
            staging.put_blob(name, &bytes)?;
        }
        Ok((map.parameters, packed))
    }

    fn pack(&self, batches: usize, keeping: Keeping, store: &mut StorePage<'_>) -> Result<Packed, FitError> {
        let texels = (0..batches).map(|batch| self.kept(batch));
        pack(texels, self.texels(), keeping, (self.settings.pixel_format, self.settings.codec), store)
    }

    fn map(&self, packed: &Packed, partial: Option<PartialFit>) -> Result<ParameterMap, FitError> {
        let (observed, settings) = (self.source.map, self.settings);
        let texels = TexelTable::new(observed.parameters.size_texels as usize, &packed.codes);
        let parameters = Parameters {
            observed: observed.parameters.clone(),
            observations: self.source.name.into(),
            models: settings.models.to_string(),
            outliers: settings.outliers,
            precision: settings.precision,
            max_bytes: settings.max_bytes,
            pixel_format: settings.pixel_format,
            histogram: packed.tally.summary(0, 0.0).histogram,
            partial,
        };
        let (surface, background) = (observed.surface.clone(), observed.background.clone());
        let texels = texels.ok_or(FitError::TooLarge { texels: packed.codes.len() })?;
        Ok(ParameterMap { parameters, surface, background, texels })
    }
}

// Quantisation and the tracer's noise are not known here: a 1000th of what is usual is less than either, and ends the search for ever larger
// models of exact data.
const FLOOR_PER_MEAN: f64 = 1e-3;
// Pages whose mean stands for the map's.
const PAGES_FOR_MEAN: usize = 16;

// What was seen of a texel: direction in its frame, and the entry.
fn observations_of(map: &ObservationMap, texel: &ObservedTexel, page: &Page, column: usize) -> Vec<([f32; 3], Observation)> {
    let rows = map.observers.iter().enumerate();
    rows.map(|(row, observer)| {
        let direction = texel.direction_to(observer).to_array();
        (direction, Observation::from_texel(page.texel(column as u32, row as u32)))
    })
    .collect()
}
