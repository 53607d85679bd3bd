//! What was read from uploaded files and used last, by the files' hashes.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use lumisphere::textures::ContentHash;

use crate::errors::ApiError;

/// At most so many.
pub struct UsedLast<T> {
    most: usize,
    kept: Mutex<VecDeque<(ContentHash, Arc<T>)>>,
}

impl<T> UsedLast<T> {
    /// None yet.
    pub fn new(most: usize) -> Self {
        Self { most, kept: Mutex::default() }
    }

    /// That one, as `read` reads it unless it is there. Under the lock: read once, whoever asks.
    pub fn get(&self, hash: ContentHash, read: impl FnOnce() -> Result<T, ApiError>) -> Result<Arc<T>, ApiError> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = kept.iter().position(|(known, _)| *known == hash).and_then(|at| kept.remove(at)) {
            let value = known.1.clone();
            kept.push_back(known);
            return Ok(value);
        }
        let value = Arc::new(read()?);
        kept.push_back((hash, value.clone()));
        if kept.len() > self.most {
            kept.pop_front();
        }
        Ok(value)
    }

    /// How many there are.
    #[cfg(test)]
    pub fn len(&self) -> usize {
        self.kept.lock().unwrap().len()
    }
}
