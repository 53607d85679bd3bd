//! The models of batches of texels between their fit and the map: kept with the staging area, so that a fit that is killed goes on behind them.

use super::FitError;
use super::models::FittedTexel;
use crate::capture::parts::{decode, encode};
use crate::textures::{Staging, StoreError};

// A new layout gets a new name: what an older server kept is not read.
const PART: &str = "models2";

/// Models by batch.
pub(super) struct KeptModels<'a> {
    pub staging: &'a Staging,
}

impl KeptModels<'_> {
    /// Keeps a batch, durably.
    pub fn keep(&self, batch: usize, texels: &Vec<FittedTexel>) -> Result<(), FitError> {
        Ok(self.staging.put_scratch(&name(batch), &encode(PART, texels)?)?)
    }

    /// A batch that was kept, by this run or an earlier one; what was damaged since is not.
    pub fn read(&self, batch: usize) -> Result<Option<Vec<FittedTexel>>, FitError> {
        match self.staging.scratch(&name(batch)) {
            Ok(bytes) => Ok(bytes.and_then(|bytes| decode(PART, &bytes).ok())),
            Err(StoreError::DamagedFile { .. }) => Ok(None),
            Err(e) => Err(e.into()),
        }
    }
}

fn name(batch: usize) -> String {
    format!("{PART}-{batch:06}")
}
