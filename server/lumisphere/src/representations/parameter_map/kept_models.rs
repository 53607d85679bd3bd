//! The models of batches of texels between their fit and the map: kept with the staging area, so that a fit that is killed goes on behind them.

use super::FitError;
use super::models::FittedTexel;
use crate::capture::parts::{decode, encode};
use crate::textures::Staging;

const PART: &str = "models";

/// Models by batch.
pub(super) struct KeptModels<'a> {
    pub staging: &'a Staging,
}

impl KeptModels<'_> {
    /// Keeps a batch, durably.
    pub fn keep(&self, batch: usize, texels: &Vec<FittedTexel>) -> Result<(), FitError> {
        Ok(self.staging.put_scratch(&name(batch), &encode(PART, texels)?)?)
    }

    /// A batch that was kept, by this run or an earlier one.
    pub fn read(&self, batch: usize) -> Result<Option<Vec<FittedTexel>>, FitError> {
        let bytes = self.staging.scratch(&name(batch))?;
        Ok(bytes.map(|bytes| decode(PART, &bytes)).transpose()?)
    }
}

fn name(batch: usize) -> String {
    format!("{PART}-{batch:06}")
}
